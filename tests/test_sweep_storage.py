"""Where trials are kept: storages that go away and come back, and processes that die."""

import errno
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from contextlib import suppress

import optuna
import pytest
from optuna.exceptions import StorageInternalError
from optuna.trial import TrialState
from postgres_helpers import needs_postgres, postgres  # noqa: F401  # a fixture
from sqlalchemy.exc import ArgumentError, OperationalError, PendingRollbackError
from tune_helpers import kill

from sb3_symphony.experiment.config import ConfigError
from sb3_symphony.experiment.sweep_storage import (
    GRACE,
    WORKER,
    Patience,
    StorageAway,
    SweepStorage,
    _JournalFile,
    open_storage,
)

optuna.logging.set_verbosity(optuna.logging.WARNING)


def never() -> None:
    """The sweep is not to end."""


@pytest.fixture
def opened():
    """``opened(where, heartbeat=1)``: a storage, closed at the end of the test."""
    storages = []

    def open_one(where: str, heartbeat: int = 1, stopping: Callable[[], None] = never) -> SweepStorage:
        storages.append(open_storage(where, stopping, heartbeat))
        return storages[-1]

    yield open_one
    for storage in storages:
        storage.close()


def study_in(storage: SweepStorage) -> optuna.Study:
    """A study called ``s``."""
    return optuna.create_study(study_name="s", storage=storage.optuna, direction="maximize", load_if_exists=True)


def running_trial(storage: SweepStorage, study: optuna.Study, worker: str | None = None) -> int:
    """A trial as a process claims it."""
    trial_id = storage.optuna.create_new_trial(study._study_id)
    storage.beat([trial_id])
    storage.optuna.set_trial_user_attr(trial_id, WORKER, worker or storage.worker)
    return trial_id


def states(study: optuna.Study) -> list[TrialState]:
    """State of each trial."""
    return [trial.state for trial in study.get_trials(deepcopy=False)]


# Journal --------------------------------------------------------------------------------------------------------------


def test_what_a_cut_write_left_is_overwritten(tmp_path, opened):
    path = tmp_path / "journal.log"
    study = study_in(opened(str(path)))
    study.add_trial(optuna.create_trial(value=1.0))
    whole = path.read_bytes()
    for tail in (b"{", b'{"op_code":5,"worker_id":"x', b"x" * 10_000):
        path.write_bytes(whole + tail)
        again = study_in(opened(str(path)))
        assert [trial.value for trial in again.trials] == [1.0]
        again.set_user_attr("a", tail.decode())
        assert path.read_bytes().startswith(whole) and path.read_bytes().count(b"\n") > whole.count(b"\n")
        assert study_in(opened(str(path))).user_attrs == {"a": tail.decode()}


def test_full_disk_leaves_the_journal_whole_and_is_waited_for(tmp_path, opened, monkeypatch, capsys):
    path = tmp_path / "journal.log"
    study = study_in(opened(str(path)))
    before, contents, real = path.read_bytes(), [], os.fsync

    def full(descriptor: int) -> None:
        if len(contents) < 2:
            contents.append(path.read_bytes())
            raise OSError(errno.ENOSPC, "No space left on device")
        real(descriptor)

    monkeypatch.setattr(os, "fsync", full)
    study.set_user_attr("a", 1)
    assert contents[0] != before  # something had been written before it failed
    assert contents[1].startswith(before) and contents[1].count(b"\n") == before.count(b"\n") + 1
    assert study_in(opened(str(path))).user_attrs == {"a": 1}
    out = capsys.readouterr().out
    assert f"{path} is away (No space left on device): waiting for it, 20 s at most" in out and "is back after" in out


def test_patience_ends(tmp_path, opened, monkeypatch):
    path = tmp_path / "journal.log"
    storage = opened(str(path))
    study = study_in(storage)
    storage.patience.seconds = 0.3
    before = path.read_bytes()
    path.rename(tmp_path / "elsewhere.log")
    with pytest.raises(StorageAway, match=r"has been away for 0.3 s \(No such file.*the same command goes on"):
        study.set_user_attr("a", 1)
    assert not path.exists()  # a journal that is gone is not begun anew
    (tmp_path / "elsewhere.log").rename(path)
    assert path.read_bytes() == before
    study.set_user_attr("a", 2)
    assert study.user_attrs == {"a": 2}


def test_a_sweep_that_is_to_stop_does_not_wait(tmp_path, opened):
    def stopping() -> None:
        raise KeyboardInterrupt

    storage = opened(str(tmp_path / "journal.log"), stopping=stopping)
    study = study_in(storage)
    (tmp_path / "journal.log").unlink()
    with pytest.raises(KeyboardInterrupt):
        study.set_user_attr("a", 1)


@pytest.mark.parametrize(
    "content", [b"my notes", b"my notes\nare precious\n", b"[1, 2]\n", b'{"a": 1}\n', b"\xff\xfe\n", b"3\n"]
)
def test_other_files_are_not_taken_for_journals(tmp_path, content):
    path = tmp_path / "notes"
    path.write_bytes(content)
    with pytest.raises(ConfigError, match="is not a journal of Optuna — expected one, or the name of a new file"):
        open_storage(str(path), never, 1)
    assert path.read_bytes() == content and list(tmp_path.iterdir()) == [path]


def test_folder_is_no_journal(tmp_path):
    with pytest.raises(ConfigError, match="cannot be read — Is a directory"):
        open_storage(str(tmp_path), never, 1)
    (tmp_path / "file").write_text("")
    with pytest.raises(ConfigError, match="cannot be"):
        open_storage(str(tmp_path / "file" / "journal.log"), never, 1)


def test_trials_of_dead_processes_are_failed_at_once(tmp_path, opened):
    path = str(tmp_path / "journal.log")
    code = f"""
import sys, time
sys.path.insert(0, {os.path.dirname(__file__)!r})
from test_sweep_storage import never, open_storage, running_trial, study_in
storage = open_storage({path!r}, never, 1)
print(running_trial(storage, study_in(storage)), flush=True)
time.sleep(600)
"""
    process = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None and process.stdout.readline() == "0\n"
    storage = opened(path)
    study = study_in(storage)
    running_trial(storage, study)
    storage.bury(study)
    assert states(study) == [TrialState.RUNNING, TrialState.RUNNING]
    kill(process.pid)
    process.wait()
    storage.bury(study)
    assert states(study) == [TrialState.FAIL, TrialState.RUNNING]  # the other's, not the own one
    assert len(list(tmp_path.glob("*.alive"))) == 1


def test_trial_without_worker_is_failed(tmp_path, opened):
    storage = opened(str(tmp_path / "journal.log"))
    study = study_in(storage)
    storage.optuna.create_new_trial(study._study_id)  # and killed before it was claimed
    storage.bury(study)
    assert states(study) == [TrialState.FAIL]


# Both -----------------------------------------------------------------------------------------------------------------


@pytest.fixture(params=["journal", pytest.param("postgres", marks=needs_postgres)])
def where(request, tmp_path):
    """A journal, and a database of its own."""
    if request.param == "journal":
        return str(tmp_path / "journal.log")
    return request.getfixturevalue("postgres").create_database(f"d{time.time_ns()}")


def test_one_at_a_time_is_inside_the_lock(where, opened):
    inside, most, storages = [], [], [opened(where) for _ in range(4)]

    def enter(storage: SweepStorage) -> None:
        for _ in range(10):
            with storage.locked():
                inside.append(storage)
                time.sleep(0.002)
                most.append(len(inside))
                inside.remove(storage)

    threads = [threading.Thread(target=enter, args=(storage,)) for storage in storages]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert most == [1] * 40


def test_exceptions_leave_the_lock(where, opened):
    first, second = opened(where), opened(where)
    with pytest.raises(KeyboardInterrupt), first.locked():
        raise KeyboardInterrupt
    with second.locked():
        pass


# PostgreSQL -----------------------------------------------------------------------------------------------------------


@needs_postgres
def test_wrong_addresses(postgres, opened):  # noqa: F811
    for url, message in [
        (postgres.url(password="wrong"), "password authentication failed"),
        (postgres.url("nowhere"), 'database "nowhere" does not exist'),
        (postgres.url().replace(str(postgres.port), "1"), "(?i)connection refused"),
        (postgres.url().replace("postgresql", "postgress"), "unknown kind of storage 'postgress': did you mean 'postgresql'"),
        ("mysql://me@host/db", "unknown kind of storage 'mysql' — expected postgresql"),
        ("postgresql:/me@host/db", "not a URL — expected postgresql://user"),
        ("postgres:me@host/db", "not a URL — expected postgresql://user"),
        ("postgresql://me@host:port/db", "not a URL — expected postgresql://user"),
        ("postgresql+nonsense://me@host/db", "cannot be used"),
    ]:
        with pytest.raises(ConfigError, match=message) as error:
            opened(url)
        assert "secret" not in str(error.value) and "\n" not in str(error.value)


@needs_postgres
def test_many_may_create_the_tables(postgres, opened):  # noqa: F811
    url = postgres.create_database("fresh")
    errors = []

    def create() -> None:
        try:
            study_in(opened(url))
        except Exception as error:
            errors.append(error)

    threads = [threading.Thread(target=create) for _ in range(6)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert errors == []


@needs_postgres
def test_server_that_restarts_is_waited_for(postgres, opened, capsys):  # noqa: F811
    storage = opened(postgres.create_database("restart"))
    study = study_in(storage)
    trial_id = running_trial(storage, study)
    postgres.stop()
    threading.Timer(2.0, postgres.start).start()
    study.set_user_attr("a", 1)
    assert study.user_attrs == {"a": 1}
    assert storage.optuna.get_trial(trial_id).state == TrialState.RUNNING
    out = capsys.readouterr().out
    assert out.count("is away") == 1 and out.count("is back after") == 1 and "secret" not in out
    postgres.stop()
    threading.Timer(1.0, postgres.start).start()
    with storage.locked():
        assert states(study) == [TrialState.RUNNING]


@needs_postgres
def test_server_that_goes_inside_the_lock(postgres, opened):  # noqa: F811
    storage = opened(postgres.create_database("inside"))
    study = study_in(storage)
    with storage.locked():
        postgres.stop()
        threading.Timer(1.0, postgres.start).start()
        trial_id = running_trial_patiently(storage, study)
    with storage.locked():
        assert storage.optuna.get_trial(trial_id).state == TrialState.RUNNING


def running_trial_patiently(storage: SweepStorage, study: optuna.Study) -> int:
    """The same as ``running_trial`` while the storage is away."""
    return storage.patience(lambda: running_trial(storage, study))


@needs_postgres
def test_server_that_stays_away(postgres, opened):  # noqa: F811
    storage = opened(postgres.create_database("away"))
    study = study_in(storage)
    study.add_trial(optuna.create_trial(value=3.0))
    storage.patience.seconds = 0.5
    postgres.stop()
    try:
        with pytest.raises(StorageAway, match=r"postgresql://tester:\*\*\*@.*/away has been away for 0.5 s"):
            study.set_user_attr("a", 1)
    finally:
        postgres.start()
    assert study.best_value == 3.0  # kept


@needs_postgres
def test_trials_without_a_heartbeat_are_failed(postgres, opened):  # noqa: F811
    url = postgres.create_database("heartbeat")
    ours, theirs = opened(url), opened(url)
    study = study_in(ours)
    lost = running_trial(theirs, study)
    own = running_trial(ours, study)
    ours.bury(study)
    assert states(study) == [TrialState.RUNNING, TrialState.RUNNING]
    deadline = time.monotonic() + GRACE * 1 + 1.5
    while time.monotonic() < deadline:
        ours.beat([own])
        time.sleep(0.2)
    ours.patience.back = time.monotonic()  # just after it was away, nobody could have shown a sign
    ours.bury(study)
    assert states(study) == [TrialState.RUNNING, TrialState.RUNNING]
    ours.patience.back = -float("inf")
    ours.bury(study)
    assert states(study) == [TrialState.FAIL, TrialState.RUNNING]
    with pytest.raises(optuna.exceptions.UpdateFinishedTrialError):
        theirs.optuna.set_trial_state_values(lost, TrialState.COMPLETE, [1.0])


def test_a_second_try_in_a_session_that_has_lost_its_connection():
    """What Optuna raises where the storage goes away while it reads trials."""
    lost = OperationalError("SELECT", {}, Exception("server closed the connection unexpectedly\n\tThis probably means"))
    calls = []

    def read():
        calls.append(1)
        if len(calls) > 1:
            return "read"
        try:
            try:
                raise lost
            except OperationalError:
                raise PendingRollbackError("Can't reconnect until invalid transaction is rolled back")  # noqa: B904
        except PendingRollbackError as error:
            raise StorageInternalError("An exception is raised during the commit") from error

    assert Patience("storage", 10, never)(read) == "read"


def test_what_is_wrong_in_itself_is_not_waited_for():
    def read():
        raise StorageInternalError("An exception is raised during the commit") from ArgumentError("no such column")

    with pytest.raises(StorageInternalError):
        Patience("storage", 10, never)(read)


def test_a_record_that_fits_in_parts(small_disk):
    """Nothing of it is in the journal before there is room for the whole."""
    path, filler = small_disk / "journal.log", small_disk / "filler"
    first = b'"' + b"x" * 4087 + b'"\n'  # six bytes are left of its block
    path.write_bytes(first)
    with filler.open("wb", buffering=0) as file:
        with suppress(OSError):
            while file.write(bytes(4096)):
                pass
        file.truncate(file.tell() - 4096)

    def make_room() -> None:
        assert path.read_bytes() == first
        filler.unlink(missing_ok=True)

    journal = _JournalFile(path, Patience("journal", 10.0, make_room))
    journal.append_logs([{"long": "y" * 6000}])
    journal.append_logs([{"short": 1}])
    assert list(journal.read_logs(1)) == [{"long": "y" * 6000}, {"short": 1}]
