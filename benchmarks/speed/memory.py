"""
Memory of many updates: growth of the process, and pages that the kernel had to hand out anew (minor faults) per update.

    python benchmarks/speed/memory.py --output benchmarks/results/speed/memory.json
"""

import argparse
import resource
from pathlib import Path

from measuring import pin, write
from updates import Setting, redq, symphony

SETTINGS = {
    "redq": Setting("redq", "BipedalWalker"),
    "walker": Setting("walker", "BipedalWalker", 128, 2, 2, 128, layer_norm=True, n_steps=3, policy_delay=10),
    "symphony": Setting("symphony", "BipedalWalker", 128, 2, 2, 256),
}


def resident() -> float:
    """MiB in memory now."""
    fields = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines())
    return int(fields["VmRSS"].split()[0]) / 1024


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--updates", type=int, default=10_000)
    parser.add_argument("--output", type=Path, help="JSON file")
    arguments = parser.parse_args()
    pin(1)

    rows = []
    for name, setting in SETTINGS.items():
        for column, run in zip(
            ("critics", "train"), (symphony if name == "symphony" else redq)(setting, "fused"), strict=True
        ):
            for _ in range(20):
                run(20)
            before, faults = resident(), resource.getrusage(resource.RUSAGE_SELF).ru_minflt
            for _ in range(arguments.updates // 20):
                run(20)
            faults = (resource.getrusage(resource.RUSAGE_SELF).ru_minflt - faults) / arguments.updates
            growth = resident() - before
            rows.append(
                dict(setting=name, column=column, updates=arguments.updates, growth_mib=growth, faults_per_update=faults)
            )
            print(
                f"{name:9s} {column:8s} {arguments.updates} updates: {growth:+.1f} MiB, {faults:.2f} faults an update",
                flush=True,
            )
    if arguments.output is not None:
        write(arguments.output, rows)


if __name__ == "__main__":
    main()
