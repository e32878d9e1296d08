"""Sweeps as they are run: processes, signals, and a database that goes away."""

import signal
import subprocess
import time
from contextlib import suppress
from pathlib import Path

import optuna
import pytest
from optuna.trial import TrialState
from postgres_helpers import needs_postgres, postgres  # noqa: F401  # a fixture
from tune_helpers import files, start

from sb3_symphony.experiment.sweep_report import reason_of
from sb3_symphony.experiment.sweep_storage import open_storage

COMPLETE, FAIL = TrialState.COMPLETE, TrialState.FAIL


def line_of(process: subprocess.Popen[str], beginning: str) -> str:
    """Wait until the process prints a line that begins so."""
    assert process.stdout is not None
    lines = []
    for line in process.stdout:
        lines.append(line)
        if line.startswith(beginning):
            return line
    raise AssertionError("".join(lines))


def trials_in(where: str) -> list[optuna.trial.FrozenTrial]:
    """Trials of the study there."""
    storage = open_storage(where, lambda: None, 1)
    try:
        return optuna.load_study(study_name="ppo-Line-v0", storage=storage.optuna).trials
    finally:
        storage.close()


def small(folder: Path, n_trials: int, where: str) -> list[str]:
    """Flags of a sweep whose trials take no time."""
    return [*files(folder), "--n-trials", str(n_trials), "--seeds-per-trial", "2", "--pruner", "none", "--storage", where]


def test_ctrl_c_and_go_on(tmp_path):
    where = str(tmp_path / "journal.log")
    process = start(tmp_path, *small(tmp_path, 500, where))
    line_of(process, "trial 1 ")
    process.send_signal(signal.SIGINT)
    out, _ = process.communicate(timeout=120)
    assert process.returncode == 130
    assert "stopping as soon as all can be saved" in out and "best: trial" in out
    before = trials_in(where)
    assert before[-1].state in (COMPLETE, FAIL) and all(trial.state.is_finished() for trial in before)

    process = start(tmp_path, *small(tmp_path, 5, where))
    out, _ = process.communicate(timeout=120)
    assert process.returncode == 0, out
    trials = trials_in(where)
    assert sum(trial.state == COMPLETE for trial in trials) >= 5
    assert [trial.value for trial in trials[: len(before)]] == [trial.value for trial in before]
    assert {reason_of(trial) for trial in trials if trial.state == FAIL} <= {"interrupted"}


@needs_postgres
def test_server_that_goes_away_in_the_middle(postgres, tmp_path):  # noqa: F811
    where = postgres.create_database("middle")
    process = start(tmp_path, *small(tmp_path, 6, where), "--heartbeat", "5")
    line_of(process, "trial 1 ")
    postgres.stop()
    try:
        line = line_of(process, "postgresql://")
        assert "is away" in line and "waiting for it, 100 s at most" in line and "secret" not in line
    finally:
        postgres.start()
    line_of(process, "postgresql://tester:***@")
    out, _ = process.communicate(timeout=120)
    assert process.returncode == 0, out
    trials = trials_in(where)
    assert sum(trial.state == COMPLETE for trial in trials) == 6
    assert all(trial.state == COMPLETE for trial in trials)  # nothing had to be repeated


@needs_postgres
def test_server_that_does_not_come_back(postgres, tmp_path):  # noqa: F811
    where = postgres.create_database("gone")
    flags = [*small(tmp_path, 6, where), "--heartbeat", "1"]
    process = start(tmp_path, *flags)
    line_of(process, "trial 1 ")
    postgres.stop()
    began = time.monotonic()
    try:
        out, _ = process.communicate(timeout=120)
    finally:
        postgres.start()
    assert process.returncode == 2 and time.monotonic() - began >= 20
    last = out.splitlines()[-1]
    assert last.startswith("sb3-symphony tune: error: postgresql://tester:***@") and "has been away for 20 s" in last
    assert "the same command goes on once it is back" in last
    kept = [trial.value for trial in trials_in(where)[:2]]
    assert None not in kept

    process = start(tmp_path, *flags)
    out, _ = process.communicate(timeout=120)
    assert process.returncode == 0, out
    trials = trials_in(where)
    assert sum(trial.state == COMPLETE for trial in trials) == 6
    assert [trial.value for trial in trials[:2]] == kept
    assert {reason_of(trial) for trial in trials if trial.state == FAIL} <= {"its process died"}


@pytest.mark.slow
def test_disk_that_fills_up(small_disk, tmp_path):
    """The journal is waited for; once there is room, the same command goes on, with all that had been found."""
    where, filler = small_disk / "journal.log", small_disk / "filler"
    flags = [*small(tmp_path, 6, str(where)), "--heartbeat", "1"]
    process = start(tmp_path, *flags)
    line_of(process, "trial 1 ")
    with filler.open("wb", buffering=0) as file, suppress(OSError):
        while file.write(bytes(1024)):
            pass
    out, _ = process.communicate(timeout=240)
    assert process.returncode == 2, out
    last = out.splitlines()[-1]
    assert f"error: {where} has been away for 20 s (No space left on device) — what it holds is kept" in last
    before = where.read_bytes()
    filler.unlink()
    kept = [trial.value for trial in trials_in(str(where))[:2]]
    assert None not in kept

    process = start(tmp_path, *flags)
    out, _ = process.communicate(timeout=240)
    assert process.returncode == 0, out
    assert where.read_bytes().startswith(before)
    trials = trials_in(str(where))
    assert sum(trial.state == COMPLETE for trial in trials) == 6 and [trial.value for trial in trials[:2]] == kept
