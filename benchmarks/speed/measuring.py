"""What the speed benchmarks share: pinning to cores, and the record of how a file was made."""

import importlib.metadata
import json
import os
import platform
import sys
from datetime import date
from pathlib import Path

import torch as th

PACKAGES = ("sb3-symphony", "torch", "numpy", "numba", "stable-baselines3", "sb3-contrib", "sbx-rl", "jax")


def pin(threads: int) -> None:
    """Let this process use as many threads, on as many cores."""
    cores = sorted(os.sched_getaffinity(0))
    if len(cores) < threads:
        raise SystemExit(f"--threads {threads}: this process may use {len(cores)} core(s)")
    os.sched_setaffinity(0, cores[:threads])
    th.set_num_threads(threads)


def processor() -> str:
    """Name of the processor, as Linux knows it."""
    lines = Path("/proc/cpuinfo").read_text().splitlines() if Path("/proc/cpuinfo").exists() else []
    return next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), platform.processor())


def version(package: str) -> str | None:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None


def write(path: Path, rows: list[dict]) -> None:
    """A JSON file with the rows, and how, when and where they were made."""
    record = {
        "command": " ".join(["python", *sys.argv]),
        "date": date.today().isoformat(),
        "machine": {"processor": processor(), "instructions": th.backends.cpu.get_cpu_capability()},
        "versions": {name: version(name) for name in PACKAGES},
        "rows": rows,
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(record, indent=1) + "\n")
