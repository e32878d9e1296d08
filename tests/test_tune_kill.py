"""A sweep of several processes that are killed at random: no trial is lost, none counts twice."""

import csv
import random
import threading
import time
from collections import Counter
from pathlib import Path

import optuna
import pytest
from optuna.trial import TrialState
from postgres_helpers import needs_postgres, postgres  # noqa: F401  # a fixture
from tune_helpers import descendants, files, kill, start

from sb3_symphony.experiment.sweep_report import reason_of
from sb3_symphony.experiment.sweep_storage import open_storage
from sb3_symphony.experiment.tune import RETRIES


class Process:
    """One of the processes of a sweep, and what it has printed."""

    def __init__(self, folder: Path, *flags: str) -> None:
        self.process = start(folder, *flags)
        self.lines: list[str] = []
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self) -> None:
        assert self.process.stdout is not None
        self.lines.extend(self.process.stdout)

    @property
    def alive(self) -> bool:
        """Whether it has not ended."""
        return self.process.poll() is None

    @property
    def at_work(self) -> bool:
        """Whether it takes part in the sweep."""
        return self.alive and bool(self.lines)


def under_fire(folder: Path, where: str, n_processes: int, n_kills: int, n_trials: int, seed: int) -> None:
    """
    Run a sweep to its end while its processes, trainings among them, are killed and the former started again.

    :param folder: where its files are
    :param where: storage
    :param n_processes: number of processes of the sweep
    :param n_kills: number of kills
    :param n_trials: number of trials
    :param seed: of the choice of victims and moments
    """
    flags = files(folder, n_timesteps=960)
    flags += ["--storage", where, "--n-trials", str(n_trials), "--heartbeat", "3", "--seeds-per-trial", "2"]
    flags += ["--n-startup-trials", "5"]
    rng = random.Random(seed)
    processes = [Process(folder, *flags) for _ in range(n_processes)]
    kills = 0
    deadline = time.monotonic() + 3600
    while any(process.alive for process in processes):
        assert time.monotonic() < deadline
        time.sleep(rng.uniform(0.5, 8) if kills < n_kills else 0.5)
        targets = [process for process in processes if process.at_work]
        if targets and kills < n_kills:
            pid = rng.choice(targets).process.pid
            victim = rng.choice([pid, *descendants(pid)])
            kill(victim)
            kills += 1
            print(f"kill {kills}: {'process' if victim == pid else 'below'} {victim}")
        for index, process in enumerate(processes):
            if not process.alive and process.process.returncode == -9:
                processes[index] = Process(folder, *flags)
    assert [process.process.returncode for process in processes] == [0] * n_processes, [p.lines[-3:] for p in processes]
    assert kills == n_kills


def check(folder: Path, where: str, n_trials: int) -> None:
    """
    :param folder: files of a sweep that has ended
    :param where: its storage
    :param n_trials: how many trials were wanted
    """
    storage = open_storage(where, lambda: None, 3)
    try:
        study = optuna.load_study(study_name="ppo-Line-v0", storage=storage.optuna)
        trials = study.trials
        best = study.best_value
    finally:
        storage.close()
    print({state.name: sum(trial.state == state for trial in trials) for state in TrialState})
    print(Counter(reason_of(trial) for trial in trials if trial.state == TrialState.FAIL))
    assert all(trial.state.is_finished() for trial in trials)
    chains: dict[int, list[optuna.trial.FrozenTrial]] = {}  # a trial and its repetitions
    for trial in trials:
        chains.setdefault((trial.system_attrs.get("retry_history") or [trial.number])[0], []).append(trial)
    assert len(chains) == n_trials
    for chain in chains.values():
        *before, last = chain
        assert all(trial.state == TrialState.FAIL and reason_of(trial) for trial in before)
        assert last.state in (TrialState.COMPLETE, TrialState.PRUNED) or len(chain) == RETRIES + 1
        assert all(trial.params.items() <= last.params.items() for trial in before)
    assert sum(trial.state == TrialState.COMPLETE for trial in trials) > 0

    with open(folder / "logs" / "ppo" / "tune" / "ppo-Line-v0" / "trials.csv") as file:
        rows = list(csv.DictReader(file))
    assert [int(row["number"]) for row in rows] == list(range(len(trials)))
    assert all(row["reason"] for row in rows if row["state"] == "fail")
    assert max(float(row["value"]) for row in rows if row["state"] == "complete") == best


@pytest.mark.slow
@needs_postgres
def test_four_processes_on_postgres(postgres, tmp_path):  # noqa: F811
    where = postgres.create_database("sweep")
    under_fire(tmp_path, where, n_processes=4, n_kills=20, n_trials=60, seed=0)
    check(tmp_path, where, 60)


@pytest.mark.slow
def test_three_processes_with_a_journal(tmp_path):
    where = str(tmp_path / "journal.log")
    under_fire(tmp_path, where, n_processes=3, n_kills=10, n_trials=30, seed=1)
    check(tmp_path, where, 30)
    left = {path.name for path in tmp_path.iterdir()} - {"logs", "space.yml", "conf.yml"}
    assert left == {"journal.log", "journal.log.lock", "journal.log.claim.lock"}
