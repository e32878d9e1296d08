"""
Where the cells of a grid run: in processes of this machine, by joblib's loky, or on a cluster, by Ray.

Both are used through the same small interface, :class:`Backend`. Ray's own backend for joblib
(``ray.util.joblib.register_ray``) would have made one of the two, but does not serve here: it hands out results only when
all are there (``return_as`` is refused), so nothing could be told of cells that end, and when one of its workers dies, with
a machine for example, the whole call ends with ``ActorDiedError``. A plain Ray task is begun again on another machine; a
cell then goes on from its checkpoint.
"""

import os
import socket
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, Protocol, TypeVar

from sb3_symphony.common.checks import last_line
from sb3_symphony.common.versions import package_versions
from sb3_symphony.experiment.config import ConfigError

Item = TypeVar("Item")
Result = TypeVar("Result")

#: how often in succession workers may die without any result
_DEATHS = 3
#: seconds to wait for a cluster
_TIMEOUT = 60.0


class Backend(Protocol):
    """Calls a function for many items, on several workers."""

    def map(self, function: Callable[[Item], Result], items: Sequence[Item]) -> Iterator[tuple[Item, Result | Exception]]:
        """
        :param function: importable function
        :param items: what to call it with
        :return: each item with its result, in the order of their ends; with an exception if its worker died for good
        """

    def check_folder(self, folder: Path) -> None:
        """
        :param folder: a folder that exists here
        :raises ConfigError: if a worker does not see the same folder
        """

    def close(self) -> None:
        """Leave no worker behind."""


# ----------------------------------------------------------------------------------------------------------------------
# One machine
# ----------------------------------------------------------------------------------------------------------------------


def _indexed(function: Callable[[Any], Any], index: int, item: Any) -> tuple[int, Any]:
    return index, function(item)


class Loky:
    """
    Processes of this machine.

    :param n_jobs: their number, by default that of the cores
    """

    def __init__(self, n_jobs: int | None) -> None:
        import joblib

        self.n_jobs = n_jobs or joblib.cpu_count()

    def map(self, function: Callable[[Item], Result], items: Sequence[Item]) -> Iterator[tuple[Item, Result | Exception]]:
        """See :meth:`Backend.map`."""
        from joblib import Parallel, delayed
        from joblib.externals.loky.process_executor import TerminatedWorkerError

        left = dict(enumerate(items))
        deaths = 0
        while left:
            # One by one: cells last long, and each is to begin as soon as a process is free
            parallel = Parallel(
                self.n_jobs, backend="loky", return_as="generator_unordered", batch_size=1, pre_dispatch=self.n_jobs
            )
            try:
                for index, result in parallel(delayed(_indexed)(function, index, item) for index, item in list(left.items())):
                    deaths = 0
                    yield left.pop(index), result
            except TerminatedWorkerError as error:  # all others have been ended too, and what they did is begun again
                deaths += 1
                if deaths == _DEATHS:
                    yield from ((item, error) for item in left.values())
                    return

    def check_folder(self, folder: Path) -> None:
        """See :meth:`Backend.check_folder`: it is the same machine."""

    def close(self) -> None:
        """See :meth:`Backend.close`."""
        from joblib.externals.loky import get_reusable_executor

        get_reusable_executor().shutdown(wait=True)


# ----------------------------------------------------------------------------------------------------------------------
# A cluster
# ----------------------------------------------------------------------------------------------------------------------


def _seen(token: str) -> tuple[str | None, dict[str, str]]:
    """What a machine sees: the content of a file, and versions of packages."""
    content = None
    with suppress(OSError):
        content = Path(token).read_text(encoding="utf-8")
    return content, package_versions()


#: how HTTP/2, which Ray's servers speak, begins, with settings that change nothing (RFC 9113, 3.4)
_GREETING = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n" + bytes(3) + b"\x04" + bytes(5)


def _reachable(address: str) -> None:
    """Where nobody answers, Ray takes two minutes to find out and then ends the process; where others do, it waits on."""
    host, colon, port = address.removeprefix("ray://").rpartition(":")
    if not (colon and host and port.isdecimal() and int(port) < 65_536):
        raise ConfigError(f"--address: '{address}' — expected auto, HOST:PORT or ray://HOST:PORT")
    try:
        with socket.create_connection((host, int(port)), timeout=5) as connection:
            if os.environ.get("RAY_USE_TLS", "0") != "0":
                return
            connection.sendall(_GREETING)
            answer = connection.recv(9)  # a frame's head: length, type, flags, stream
    except OSError as error:
        reason = error.strerror or str(error)
        raise ConfigError(f"--address: nobody answers at '{address}' — {reason} (`ray start --head` prints it)") from None
    if answer[3:4] != b"\x04":  # not of settings
        raise ConfigError(f"--address: what answers at '{address}' is no Ray cluster (`ray start --head` prints its address)")


class Ray:
    """
    Tasks on a Ray cluster, each on a core of its own.

    :param n_jobs: tasks at a time, by default as many as the cluster has cores
    :param address: the cluster; by default one is started here, and ended again
    :param gpus: whether each task needs a GPU
    :raises ConfigError: if Ray is not installed or the cluster cannot be reached
    """

    def __init__(self, n_jobs: int | None, address: str | None, gpus: bool) -> None:
        os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
        try:
            import ray
        except ImportError:
            raise ConfigError('--backend: ray is not installed — pip install "sb3-symphony[distributed]"') from None
        self.ray: Any = ray
        self.n_jobs = n_jobs
        self.gpus = gpus
        arguments: dict[str, Any] = {"log_to_driver": False, "logging_level": "ERROR"}
        if address is None:
            arguments |= {"address": "local", "num_cpus": n_jobs, "include_dashboard": False}
            arguments["object_store_memory"] = 80 * 2**20  # nothing goes through it; Ray wants at least 75 MB
        else:
            if address != "auto":
                _reachable(address)
            arguments["address"] = address
        try:
            ray.init(**arguments)
        except (ConnectionError, RuntimeError, ValueError) as error:
            if address is None:
                raise ConfigError(f"--backend: Ray cannot be started here — {error}") from None
            raise ConfigError(f"--address: '{address}' — {error} (is RAY_AUTH_MODE the cluster's?)") from None

    def map(self, function: Callable[[Item], Result], items: Sequence[Item]) -> Iterator[tuple[Item, Result | Exception]]:
        """See :meth:`Backend.map`."""
        task = self.ray.remote(num_cpus=1, num_gpus=int(self.gpus), max_retries=_DEATHS)(function)
        waiting = list(reversed(items))
        running: dict[Any, Item] = {}
        while waiting or running:
            while waiting and len(running) < (self.n_jobs or len(items)):
                item = waiting.pop()
                running[task.remote(item)] = item
            (ended,), _ = self.ray.wait(list(running))
            try:
                result = self.ray.get(ended)
            except self.ray.exceptions.RayError as error:
                result = error
            yield running.pop(ended), result

    def check_folder(self, folder: Path) -> None:
        """See :meth:`Backend.check_folder`; that Python and packages are the same is checked too."""
        from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

        token = folder / "token"
        content = os.urandom(16).hex()
        token.write_text(content, encoding="utf-8")
        nodes = [node for node in self.ray.nodes() if node["Alive"]]
        for node in nodes:
            where = NodeAffinitySchedulingStrategy(node["NodeID"], soft=False)
            look = self.ray.remote(num_cpus=0, scheduling_strategy=where)(_seen)
            name = f"{node['NodeManagerHostname']} ({node['NodeManagerAddress']})"
            try:
                seen, versions = self.ray.get(look.remote(str(token)), timeout=_TIMEOUT)
            except self.ray.exceptions.RayError as error:
                raise ConfigError(f"machine {name} cannot run cells — {last_line(error)}") from None
            if seen != content:
                raise ConfigError(f"machine {name} does not see '{folder}' — expected a folder that all machines share (-f)")
            differing = [f"{k} {v}, here {package_versions()[k]}" for k, v in versions.items() if v != package_versions()[k]]
            if differing:
                raise ConfigError(f"machine {name} has {'; '.join(differing)} — expected the same, or results would differ")

    def close(self) -> None:
        """See :meth:`Backend.close`: tasks that are still running are ended."""
        self.ray.shutdown()
