"""
What a trial costs beside its training: processes that share one study whose trainings take no time.

    python benchmarks/sweeps/overhead.py --storage postgresql://me@localhost/sweeps \
        --output benchmarks/results/sweeps/overhead_postgres.json

The study must not exist yet. Its search space is Symphony's, of 15 parameters; trials are claimed, sampled by TPE, report 20
evaluations each, may be pruned, and are ended as those of ``sb3-symphony tune``. Only the processes of the trainings are
played, as what they cost is measured apart. At last the study is filled up with finished trials, and one process goes on
alone, so that it shows how costs grow.
"""

import argparse
import functools
import importlib.metadata
import json
import os
import platform
import sys
import time
from collections import defaultdict
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from datetime import date
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import optuna

from sb3_symphony.experiment import tune
from sb3_symphony.experiment.callbacks import StopOnSignal
from sb3_symphony.experiment.config import RunConfig
from sb3_symphony.experiment.space import TuneOptions
from sb3_symphony.experiment.sweep_storage import open_storage
from sb3_symphony.experiment.trial import TrialProcesses

N_EVALUATIONS = 20


class NoTraining:
    """Stands for the trainings of a trial; returns depend on the parameters, so that there is something to find."""

    def __init__(self, options: Any, config: RunConfig, seeds: list[int], n_evaluations: int) -> None:
        height = -abs(np.log10(config.arguments["learning_rate"]) + 3.3) - abs(np.log10(config.arguments["tau"]) + 2)
        returns = height + np.linspace(-1, 0, n_evaluations) + np.random.default_rng().normal(0, 0.3, n_evaluations)
        self.returns = [list(map(float, returns)) for _ in seeds]
        self.reported = 0
        self.connections: list[Any] = []

    def poll(self) -> list[float]:
        """All evaluations at once."""
        self.reported = len(self.returns[0])
        return self.returns[0]

    @property
    def finished(self) -> bool:
        """Whether they have been polled."""
        return self.reported > 0

    def stop(self) -> None:
        """There are no processes."""


def timed(function: Callable[..., Any], record: Callable[[float], None]) -> Callable[..., Any]:
    """The same function, its wall-clock times recorded in milliseconds."""

    @functools.wraps(function)
    def call(*args: Any, **kwargs: Any) -> Any:
        start = time.perf_counter()
        try:
            return function(*args, **kwargs)
        finally:
            record(1000 * (time.perf_counter() - start))

    return call


def work(where: str, n_trials: int, begin: float) -> dict[str, Any]:
    """
    One process of the sweep.

    :param where: storage
    :param n_trials: trials of the study when it ends
    :param begin: moment at which all begin
    :return: seconds it worked and computed, and milliseconds of each part of each of its trials
    """
    tune.TrialProcesses = NoTraining  # in this process only
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    parts: dict[str, list[float]] = defaultdict(list)
    numbers: list[int] = []
    options = TuneOptions(storage=where, study_name="overhead", n_trials=n_trials, n_evaluations=N_EVALUATIONS)
    plan = tune.Plan.read(options)
    storage = open_storage(where, lambda: None, options.heartbeat)
    study = tune._open_study(plan, storage)
    sweep = tune.Sweep(plan, storage, study, StopOnSignal())
    sweep._wait = lambda: None if sweep._running else time.sleep(0.05)  # timed
    for name in ("claim", "_tell"):
        setattr(sweep, name, timed(getattr(sweep, name), parts[name].append))
    for name in ("should_prune", "report"):
        setattr(optuna.Trial, name, timed(getattr(optuna.Trial, name), parts[name].append))
    object.__setattr__(plan.space, "suggest", timed(plan.space.suggest, parts["suggest"].append))
    end = sweep._end

    def noted(running: Any, *args: Any) -> None:
        numbers.append(running.trial.number)
        end(running, *args)

    sweep._end = noted  # timed
    sys.stdout = open(os.devnull, "w")
    time.sleep(max(0.0, begin - time.time()))
    cpu, start = time.process_time(), time.perf_counter()
    sweep.run()
    result = {"seconds": time.perf_counter() - start, "cpu_seconds": time.process_time() - cpu, "trials": len(numbers)}
    storage.close()
    return {**result, "numbers": numbers, "parts": dict(parts)}


def summary(results: list[dict[str, Any]]) -> dict[str, Any]:
    """What the processes have measured, per trial."""
    trials = sum(result["trials"] for result in results)
    parts = {}
    for name in ("claim", "suggest", "report", "should_prune", "_tell"):
        values = np.concatenate([result["parts"][name] for result in results])
        quartiles = [round(float(value), 2) for value in np.percentile(values, [25, 50, 75])]
        parts[name.strip("_")] = {"calls": round(len(values) / trials, 1), "ms": quartiles}
    return {
        "processes": len(results),
        "trials": trials,
        "seconds": round(max(result["seconds"] for result in results), 1),
        "ms_per_trial_and_process": round(1000 * sum(result["seconds"] for result in results) / trials, 1),
        "cpu_ms_per_trial": round(1000 * sum(result["cpu_seconds"] for result in results) / trials, 1),
        "parts": parts,
    }


def fill(where: str, n_trials: int) -> None:
    """
    Add finished trials, copies of those of the study.

    :param where: storage
    :param n_trials: how many there are afterwards
    """
    storage = open_storage(where, lambda: None, 30)
    study = optuna.load_study(study_name="overhead", storage=storage.optuna)
    trials = study.trials
    for index in range(n_trials - len(trials)):
        study.add_trial(trials[index % len(trials)])
    storage.close()


def real_process(options: TuneOptions) -> list[float]:
    """
    Seconds from the start of a trial's process to its first result, in which it takes 20 steps of ``Pendulum-v1``.

    :param options: of a sweep
    :return: of ten trials, one after the other; the first also starts the process that others are forked from
    """
    plan = tune.Plan.read(options)
    config = tune.merge(plan.configuration, options.training(next(plan.space.examples())[1]))
    seconds = []
    for _ in range(10):
        start = time.perf_counter()
        processes = TrialProcesses(options.training({}).model_copy(update={"num_threads": 1}), config, [0], 1)
        while not processes.poll():
            time.sleep(0.001)
        processes.stop()
        seconds.append(round(time.perf_counter() - start, 3))
    return seconds


def processor() -> str:
    """Name of the processor, as Linux knows it."""
    lines = Path("/proc/cpuinfo").read_text().splitlines() if Path("/proc/cpuinfo").exists() else []
    return next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), platform.processor())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--storage", required=True, help="URL or journal file")
    parser.add_argument("--workers", type=int, default=8)
    parser.add_argument("--trials", type=int, default=500, help="trials of the shared study")
    parser.add_argument("--sizes", type=int, nargs="*", default=[1000, 4000, 10_000], help="trials it is filled up to")
    parser.add_argument("--output", type=Path, required=True, help="JSON file")
    arguments = parser.parse_args()

    packages = ("sb3-symphony", "optuna", "sqlalchemy", "psycopg", "torch")
    rows: dict[str, Any] = {}
    record = {
        "command": f"python {Path(sys.argv[0]).as_posix()} --workers {arguments.workers} --trials {arguments.trials}",
        "storage": arguments.storage.partition(":")[0] if "://" in arguments.storage else "journal",
        "date": date.today().isoformat(),
        "machine": {"processor": processor(), "cores": len(os.sched_getaffinity(0))},
        "versions": {name: importlib.metadata.version(name) for name in packages},
        "rows": rows,
    }

    def add(name: str, row: dict[str, Any]) -> None:
        rows[name] = row  # written at once: what was measured is not lost where a later part takes too long
        arguments.output.parent.mkdir(parents=True, exist_ok=True)
        arguments.output.write_text(json.dumps(record, indent=1) + "\n")
        print(name, json.dumps(row), flush=True)

    options = TuneOptions(env="Pendulum-v1", n_timesteps=20, eval_episodes=1, n_evaluations=1, hyperparams={})
    add("process", {"seconds": real_process(options)})
    with ProcessPoolExecutor(arguments.workers, get_context("spawn")) as pool:
        begin = time.time() + 5 * arguments.workers
        jobs = [pool.submit(work, arguments.storage, arguments.trials, begin) for _ in range(arguments.workers)]
        add("together", summary([job.result() for job in jobs]))
    for size in arguments.sizes:
        fill(arguments.storage, size)
        with ProcessPoolExecutor(1, get_context("spawn")) as pool:
            add(f"alone_at_{size}", summary([pool.submit(work, arguments.storage, size + 20, 0.0).result()]))


if __name__ == "__main__":
    main()
