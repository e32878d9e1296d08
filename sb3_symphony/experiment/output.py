"""Files that a command is told to write: refused before the work begins, and written whole or not at all."""

import errno
import json
import math
import os
import tempfile
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

from sb3_symphony.common.files import write_atomically
from sb3_symphony.experiment.config import ConfigError

_Item = TypeVar("_Item")


def output_file(name: str | Path, flag: str, suffixes: Sequence[str] = ()) -> Path:
    """
    Look whether a file could be written, so that nobody waits for results in vain.

    :param name: the file
    :param flag: the flag that names it, for messages
    :param suffixes: how its name may end, such as ``.json``; empty: in any way
    :return: the file
    :raises ConfigError: if it could not be written
    """
    path = Path(name)
    if suffixes and path.suffix.lower() not in suffixes:
        raise ConfigError(f"{flag}: '{name}' — expected a file name that ends with {' or '.join(suffixes)}")
    problem = None
    try:
        path.resolve()
        if path.is_dir() or str(name).endswith(("/", os.sep)):
            problem = "it is a folder"
        elif path.exists() and not path.is_file():  # a device or a pipe, which would be replaced
            problem = "it is no regular file"
        elif not path.parent.is_dir():
            problem = f"there is no folder {path.parent}"
    except OSError as error:  # such as a name that is too long
        problem = error.strerror
    except RuntimeError:  # from Python 3.13 on an OSError
        problem = "it is a loop of links"
    if problem:
        raise ConfigError(f"{flag}: '{name}' cannot be written — {problem}")
    _try_to_write(path.parent, name, flag)
    return path


def output_folder(name: str | Path, flag: str) -> Path:
    """
    :param name: a folder, made if need be
    :param flag: the flag that names it, for messages
    :return: the folder
    :raises ConfigError: if it cannot be made, or not be written into
    """
    path = Path(name)
    try:
        path.mkdir(parents=True, exist_ok=True)
    except FileExistsError:
        raise ConfigError(f"{flag}: '{name}' cannot be written — it is no folder") from None
    except OSError as error:
        raise ConfigError(f"{flag}: '{name}' cannot be written — {error.strerror}") from None
    _try_to_write(path, name, flag)
    return path


def check_folder(name: str | Path, flag: str) -> None:
    """
    Look whether a folder could be made and written into. Nothing is made.

    :param name: the folder
    :param flag: the flag that names it, for messages
    :raises ConfigError: if it could not
    """
    path = Path(name).absolute()
    try:
        str(path).encode()
    except UnicodeEncodeError:  # files of a run name it
        raise ConfigError(f"{flag}: {str(name)!r} cannot be written — expected a name in UTF-8") from None
    for folder in (path, *path.parents):
        try:
            os.stat(folder)
        except FileNotFoundError:
            continue  # to be made
        except OSError as error:  # no permission to look, a name that is too long, a file in between
            raise ConfigError(f"{flag}: '{name}' cannot be written — {error.strerror}") from None
        _try_to_write(folder, name, flag)
        return


def json_report(name: str | None) -> Callable[[Any], None]:
    """
    For a command with ``--json``: looks whether the file could be written before the work begins.

    :param name: the file; ``-`` for the terminal, where nothing else should be printed then; None for nothing
    :return: what to give the plain values to
    :raises ConfigError: if the file cannot be written
    """
    path = None if name in (None, "-") else output_file(name, "--json")

    def tell(values: Any) -> None:
        text = json.dumps(_with_null(values), indent=1, default=str)
        if name == "-":
            print(text)
        elif path is not None:
            try:
                write_output(path, (text + "\n").encode(), "--json")
            except ConfigError:
                print(text)  # what has taken minutes is not lost with it
                raise

    return tell


def _with_null(values: Any) -> Any:
    """JSON has no numbers that are not finite."""
    if isinstance(values, dict):
        return {key: _with_null(value) for key, value in values.items()}
    if isinstance(values, list | tuple):
        return [_with_null(value) for value in values]
    return None if isinstance(values, float) and not math.isfinite(values) else values


def columns(rows: Sequence[Sequence[str]], left: int) -> list[str]:
    """
    :param rows: cells of a table, as many in each row
    :param left: how many columns are aligned to the left; the others are to the right
    :return: its lines
    """
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    aligned = ([*map(str.ljust, row[:left], widths), *map(str.rjust, row[left:], widths[left:])] for row in rows)
    return ["  ".join(cells).rstrip() for cells in aligned]


def progress_bar(items: Iterable[_Item], what: str, shown: bool, total: float | None = None) -> Generator[_Item, None, None]:
    """
    :param items: what is worked through
    :param what: name of the bar
    :param shown: whether there is one: on standard error, with the time left, gone at the end
    :param total: number of items, or the most there can be; None: unknown, if they have no length
    :return: the items
    """
    from rich.console import Console
    from rich.progress import track

    yield from track(items, what, total, console=Console(stderr=True), transient=True, disable=not shown)


def _try_to_write(folder: Path, name: str | Path, flag: str) -> None:
    try:
        tempfile.TemporaryFile(dir=folder).close()
    except OSError as error:
        raise ConfigError(f"{flag}: '{name}' cannot be written — {error.strerror}") from None


def write_output(path: Path, content: bytes, flag: str) -> None:
    """
    :param path: result of :func:`output_file`; a file of that name is replaced, or left alone if writing fails
    :param content: what to write
    :param flag: the flag that names the file, for messages
    :raises ConfigError: if it cannot be written, because the disk is full for example
    """
    try:
        write_atomically(path, content)
    except OSError as error:
        raise ConfigError(f"{flag}: '{path}' cannot be written — {error.strerror}") from None


@contextmanager
def alone(folder: Path, message: str) -> Iterator[None]:
    """
    No other process is inside such a block meanwhile; the system releases the lock of one that was killed.

    :param folder: where the lock is
    :param message: what to say if another one is
    :raises ConfigError: if another one is, or that cannot be told
    """
    from filelock import FileLock, Timeout

    lock = FileLock(folder / ".lock", timeout=0)
    try:
        lock.acquire()
    except Timeout:
        raise ConfigError(message) from None
    except OSError as error:  # such as a file of another user
        raise ConfigError(f"'{lock.lock_file}' cannot be locked — {error.strerror}") from None
    try:
        yield
    finally:
        lock.release()


@contextmanager
def full_disk_told(paths: Sequence[Path], onward: str = "") -> Iterator[None]:
    """
    A full disk ends the block with one line.

    :param paths: what is written inside, for messages; nothing: errors are left alone
    :param onward: what to do once there is room, in words
    :raises ConfigError: if the disk is full
    """
    try:
        yield
    except OSError as error:
        if not paths or error.errno not in (errno.ENOSPC, errno.EDQUOT):
            raise
        hint = f" — once there is room, {onward}" if onward else ""
        places = " or ".join(f"'{path}'" for path in paths)
        raise ConfigError(f"{places} cannot be written: {error.strerror}{hint}") from error
