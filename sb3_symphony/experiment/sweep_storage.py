"""
Where the trials of a sweep are kept: a journal file, or PostgreSQL for many machines.

Both may go away for a while (server restarted, disk full): an operation that fails for that reason is repeated until they
are back, or patience has run out. Both tell the trials of processes that live from those of processes that died.
"""

import json
import os
import re
import socket
import threading
import time
import uuid
import warnings
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from functools import partial, wraps
from pathlib import Path
from typing import IO, Any, TypeVar

import optuna
import sqlalchemy
from filelock import FileLock, Timeout
from optuna.exceptions import ExperimentalWarning, StorageInternalError
from optuna.storages import JournalStorage, RDBStorage, get_storage
from optuna.storages.journal import JournalFileBackend
from optuna.trial import TrialState
from sqlalchemy.exc import (
    ArgumentError,
    DBAPIError,
    InterfaceError,
    OperationalError,
    PendingRollbackError,
    SQLAlchemyError,
)

from sb3_symphony.common.checks import suggestion
from sb3_symphony.experiment.config import ConfigError

#: user attribute of a trial: the process that runs it
WORKER = "worker"
#: a trial without a sign of life for so many heartbeats belongs to a process that died
GRACE = 4
#: a storage that is away is waited for this many heartbeats
PATIENCE = 20

Result = TypeVar("Result")


class StorageAway(ConfigError):
    """A storage has been away for longer than a sweep waits."""


class Patience:
    """
    Repeats an operation while the storage is away.

    :param name: name of the storage, for messages
    :param seconds: how long to wait for it
    :param stopping: asked while waiting; raises if the sweep is to end
    """

    def __init__(self, name: str, seconds: float, stopping: Callable[[], None]) -> None:
        self.name = name
        self.seconds = seconds
        self.stopping = stopping
        self.back = -float("inf")  # when it came back the last time

    def __call__(self, operation: Callable[[], Result]) -> Result:
        """
        :param operation: what to do
        :return: its result
        :raises StorageAway: if patience has run out
        """
        went = None
        while True:
            try:
                result = operation()
            except (OSError, SQLAlchemyError, StorageInternalError) as error:
                reason = _why_away(error)
                if reason is None:
                    raise
                now = time.monotonic()
                if went is None:
                    went = now
                    print(f"{self.name} is away ({reason}): waiting for it, {self.seconds:g} s at most", flush=True)
                if now - went >= self.seconds:
                    raise StorageAway(
                        f"{self.name} has been away for {self.seconds:g} s ({reason}) — what it holds is kept; "
                        "the same command goes on once it is back"
                    ) from error
                self.stopping()
                time.sleep(min(1.0, self.seconds / 10))
            else:
                if went is not None:
                    self.back = time.monotonic()
                    print(f"{self.name} is back after {self.back - went:.0f} s", flush=True)
                return result


def _why_away(error: BaseException) -> str | None:
    """In words; None if the storage is there and the operation itself is wrong."""
    # Optuna wraps what went wrong, and its second try in a session that has lost its connection fails for that
    while isinstance(error, StorageInternalError | PendingRollbackError) and (error.__cause__ or error.__context__):
        error = error.__cause__ or error.__context__ or error
    if isinstance(error, OSError):
        return error.strerror or str(error)
    lost = isinstance(error, DBAPIError) and error.connection_invalidated
    return _first_line(error) if lost or isinstance(error, OperationalError | InterfaceError) else None


def _first_line(error: BaseException) -> str:
    lines = str(getattr(error, "orig", None) or error).strip().splitlines()
    return lines[0].rstrip(":. ") if lines else type(error).__name__


# ----------------------------------------------------------------------------------------------------------------------
# Journal
# ----------------------------------------------------------------------------------------------------------------------


class _JournalFile(JournalFileBackend):
    """Optuna's journal with a lock that a killed process does not keep, and without traces of writes that were cut short."""

    def __init__(self, path: Path, patience: Patience) -> None:
        super().__init__(str(path))
        self._path = path
        self._patience = patience
        self._write_lock = FileLock(f"{path}.lock")

    def append_logs(self, logs: list[dict[str, Any]]) -> None:
        """
        :param logs: records
        """
        content = "".join(json.dumps(log, separators=(",", ":")) + "\n" for log in logs)
        self._patience(partial(self._append, content.encode()))

    def _append(self, content: bytes) -> None:
        # Not "a": a journal that is gone is not begun anew. Unbuffered: what did not fit is not written when it is closed
        with self._write_lock, open(self._path, "r+b", buffering=0) as file:
            end = _end_of_last_line(file)
            file.seek(end)
            file.truncate()
            try:
                left = memoryview(content)
                while left:
                    left = left[file.write(left) :]
                os.fsync(file.fileno())
            except OSError:
                with suppress(OSError):
                    os.truncate(self._path, end)
                raise


def _end_of_last_line(file: IO[bytes]) -> int:
    end = file.seek(0, os.SEEK_END)
    while end:
        start = max(0, end - 4096)
        file.seek(start)
        newline = file.read(end - start).rfind(b"\n")
        if newline >= 0:
            return start + newline + 1
        end = start
    return 0


def _check_journal(path: Path) -> None:
    """No other file is taken for a journal and written to."""
    try:
        with open(path, "rb") as file:
            first = file.readline(2**20)
        known = not first or "op_code" in json.loads(first)
    except FileNotFoundError:
        return
    except OSError as error:
        raise ConfigError(f"--storage: '{path}' cannot be read — {error.strerror}") from None
    except (ValueError, TypeError):
        known = False
    if not known:
        raise ConfigError(f"--storage: '{path}' is not a journal of Optuna — expected one, or the name of a new file")


class JournalSweep:
    """
    Trials in a journal file. A process lives as long as the system holds the lock on its file beside the journal.

    :param path: journal file
    :param stopping: asked while waiting for the file; raises if the sweep is to end
    :param heartbeat: time scale of waiting, in seconds
    :raises ConfigError: if it is no journal, or cannot be written
    """

    def __init__(self, path: Path, stopping: Callable[[], None], heartbeat: int) -> None:
        self.name = str(path)
        self.worker = f"{socket.gethostname()}-{os.getpid()}-{uuid.uuid4().hex[:8]}"
        self._path = path
        self.patience = Patience(self.name, PATIENCE * heartbeat, stopping)
        self._lock = FileLock(f"{path}.claim.lock")
        self._alive: FileLock | None = None
        self._beating = threading.Lock()
        _check_journal(path)
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self.optuna: optuna.storages.BaseStorage = JournalStorage(_JournalFile(path, self.patience))
        except OSError as error:
            raise ConfigError(f"--storage: '{path}' cannot be written — {error.strerror}") from None
        except (ValueError, KeyError, TypeError) as error:
            raise ConfigError(f"--storage: '{path}' is damaged — {error}") from None

    def _sign(self, worker: str) -> Path:
        return self._path.with_name(f"{self._path.name}.{worker}.alive")

    @contextmanager
    def locked(self) -> Iterator[None]:
        """No other process of the sweep is inside such a block meanwhile."""
        with self._lock:
            yield

    def beat(self, trial_ids: list[int]) -> None:
        """
        Show that this process lives.

        :param trial_ids: trials that it runs
        """
        with self._beating:  # a claim and the thread that shows life may both be the first
            if self._alive is None:
                self._alive = FileLock(self._sign(self.worker), thread_local=False)
                self._alive.acquire()

    def bury(self, study: optuna.Study) -> None:
        """
        Fail the trials of processes that died.

        :param study: the study, locked
        """
        for trial in study.get_trials(deepcopy=False, states=(TrialState.RUNNING,)):
            worker = trial.user_attrs.get(WORKER)
            if worker is None or not self._lives(worker):
                self.optuna.set_trial_state_values(trial._trial_id, TrialState.FAIL)

    def _lives(self, worker: str) -> bool:
        sign = self._sign(worker)
        if not sign.exists():
            return False
        try:
            with FileLock(sign, timeout=0):
                pass
        except Timeout:
            return True
        with suppress(OSError):
            sign.unlink(missing_ok=True)  # not before: Windows keeps what is open
        return False

    def close(self) -> None:
        """Take away the sign of life."""
        if self._alive is not None:
            self._alive.release()
            with suppress(OSError):
                self._sign(self.worker).unlink(missing_ok=True)


# ----------------------------------------------------------------------------------------------------------------------
# PostgreSQL
# ----------------------------------------------------------------------------------------------------------------------

#: what Optuna's cache in front of the database asks it for
_OPERATIONS = (
    "create_new_study",
    "set_study_user_attr",
    "get_study_id_from_name",
    "get_study_name_from_id",
    "get_study_directions",
    "get_study_user_attrs",
    "get_study_system_attrs",
    "set_study_system_attr",
    "get_all_studies",
    "_create_new_trial",
    "_set_trial_param",
    "set_trial_state_values",
    "set_trial_intermediate_value",
    "set_trial_user_attr",
    "set_trial_system_attr",
    "get_trial",
    "get_trial_system_attrs",
    "_get_trials",
    "_get_best_trial_id",
    "_get_stale_trial_ids",
)


class _WaitingDatabase(RDBStorage):
    """Optuna's storage in a database that may go away. Each operation is a transaction of its own, so it can be repeated."""

    def __init__(self, url: str, patience: Patience, **kwargs: Any) -> None:
        self.patience = patience
        super().__init__(url, **kwargs)


def _waiting(name: str) -> Callable[..., Any]:
    operation = getattr(RDBStorage, name)

    @wraps(operation)
    def wait(self: _WaitingDatabase, *args: Any, **kwargs: Any) -> Any:
        return self.patience(partial(operation, self, *args, **kwargs))

    return wait


for _name in _OPERATIONS:
    setattr(_WaitingDatabase, _name, _waiting(_name))


class PostgresSweep:
    """
    Trials in PostgreSQL. A process lives as long as it records the heartbeats of its trials.

    :param url: ``postgresql://[user[:password]@][host[:port]]/database``
    :param stopping: asked while waiting for the server; raises if the sweep is to end
    :param heartbeat: seconds between heartbeats
    :raises ConfigError: if the server cannot be reached or refuses
    """

    def __init__(self, url: str, stopping: Callable[[], None], heartbeat: int) -> None:
        address = _address(url)
        self.name = address.render_as_string(hide_password=True).replace("postgresql+psycopg", "postgresql")
        self.worker = f"{socket.gethostname()}-{os.getpid()}-{uuid.uuid4().hex[:8]}"
        self._grace = GRACE * heartbeat
        self.patience = Patience(self.name, PATIENCE * heartbeat, stopping)
        text = address.render_as_string(hide_password=False).replace("{", "{{").replace("}", "}}")  # Optuna formats it
        # A machine that vanishes is noticed within a minute, too
        network = {"connect_timeout": 10, "tcp_user_timeout": 60_000, "keepalives_idle": 30, "keepalives_interval": 10}
        engine_kwargs: dict[str, Any] = {"pool_pre_ping": True, "connect_args": network}
        try:
            engine = sqlalchemy.create_engine(address, **engine_kwargs)
            with _advisory_lock(engine, "sb3_symphony tables"), warnings.catch_warnings():
                warnings.simplefilter("ignore", ExperimentalWarning)  # heartbeats have been in Optuna since 2.8
                self._database = _WaitingDatabase(
                    text,
                    self.patience,
                    engine_kwargs=engine_kwargs,
                    heartbeat_interval=heartbeat,
                    grace_period=self._grace,
                )
        except ImportError:
            raise ConfigError('--storage: PostgreSQL needs psycopg: pip install "sb3-symphony[distributed]"') from None
        except SQLAlchemyError as error:
            raise ConfigError(f"--storage: {self.name} cannot be used — {_first_line(error)}") from None
        except RuntimeError as error:
            raise ConfigError(f"--storage: {self.name} cannot be used — {error}") from None
        engine.dispose()
        self.optuna = get_storage(self._database)

    @contextmanager
    def locked(self) -> Iterator[None]:
        """No other process of the sweep is inside such a block meanwhile; the server frees the lock of one that died."""
        with ExitStack() as stack:
            self.patience(lambda: stack.enter_context(_advisory_lock(self._database.engine, "sb3_symphony claim")))
            try:
                yield
            finally:
                with suppress(SQLAlchemyError):  # the server has gone, and the lock with it
                    stack.close()

    def beat(self, trial_ids: list[int]) -> None:
        """
        Show that this process lives. Fails at once if the server is away.

        :param trial_ids: trials that it runs
        """
        for trial_id in trial_ids:
            self._database.record_heartbeat(trial_id)

    def bury(self, study: optuna.Study) -> None:
        """
        Fail the trials of processes that died.

        :param study: the study, locked
        """
        for trial in study.get_trials(deepcopy=False, states=(TrialState.RUNNING,)):
            if WORKER not in trial.user_attrs:  # its process died inside the lock, maybe before the first heartbeat
                self.optuna.set_trial_state_values(trial._trial_id, TrialState.FAIL)
        if time.monotonic() - self.patience.back < self._grace:
            return  # the others, too, could not show that they live
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ExperimentalWarning)
            optuna.storages.fail_stale_trials(study)

    def close(self) -> None:
        """Close the connections."""
        with suppress(SQLAlchemyError):  # where the server has gone, there is nothing to close
            self._database.remove_session()
            self._database.engine.dispose()


def _address(url: str) -> sqlalchemy.URL:
    try:
        address = sqlalchemy.make_url(url)
    except (ArgumentError, ValueError):
        raise ConfigError("--storage: not a URL — expected postgresql://user:password@host:5432/database") from None
    backend, _, driver = address.drivername.partition("+")
    if backend not in ("postgresql", "postgres"):
        near = suggestion(backend, ["postgresql"]) or " — expected postgresql://…, or the path of a journal file"
        raise ConfigError(f"--storage: unknown kind of storage '{backend}'{near}")
    return address.set(drivername=f"postgresql+{driver or 'psycopg'}")


@contextmanager
def _advisory_lock(engine: sqlalchemy.Engine, name: str) -> Iterator[None]:
    """A lock that lasts as long as a transaction; the server frees it when it loses the connection or hears no more."""
    with engine.connect() as connection, connection.begin():
        connection.execute(sqlalchemy.text("SET LOCAL idle_in_transaction_session_timeout = '60s'"))
        connection.execute(sqlalchemy.text("SELECT pg_advisory_xact_lock(hashtext(:name))"), {"name": name})
        yield


SweepStorage = JournalSweep | PostgresSweep


def is_url(where: str) -> bool:
    """
    :param where: URL of a database, or path of a journal file
    :return: whether it is a URL
    """
    return re.match(r"[A-Za-z][A-Za-z0-9+.-]+:", where) is not None  # a letter alone is a drive of Windows


def open_storage(where: str, stopping: Callable[[], None], heartbeat: int) -> SweepStorage:
    """
    :param where: URL of a database, or path of a journal file
    :param stopping: asked while waiting for a storage that is away; raises if the sweep is to end
    :param heartbeat: seconds between the signs of life of a process
    :return: the storage
    :raises ConfigError: if there is none
    """
    if is_url(where):
        return PostgresSweep(where, stopping, heartbeat)
    return JournalSweep(Path(where), stopping, heartbeat)
