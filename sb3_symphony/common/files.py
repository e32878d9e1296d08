"""
Files that are there completely or not at all, and that tell when they have been damaged.

Nothing heavy is imported before it is needed.
"""

import hashlib
import io
import os
import pickle
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any


class DamagedFile(Exception):
    """A sealed file is missing, cut or changed."""


def _synchronise_folder(folder: Path) -> None:
    if os.name == "posix":  # elsewhere a folder cannot be opened
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def write_atomically(path: Path, content: bytes) -> None:
    """
    Write a file that is there completely or not at all, whenever the process or the machine stops.

    :param path: the file, or a link to it
    :param content: its content
    :raises OSError: if it cannot be written; a file that was there before stays as it was
    """
    write_together({path: content})


def write_together(contents: Mapping[Path, bytes]) -> None:
    """
    :func:`write_atomically` for files that belong together: none is replaced before all are written.

    :param contents: files, or links to them, and the content of each
    :raises OSError: if one cannot be written; files that were there before stay as they were
    """
    paths = [path.resolve() for path in contents]
    temporaries = [path.with_name(f".{path.name}.{os.getpid()}.tmp") for path in paths]
    try:
        for temporary, content in zip(temporaries, contents.values(), strict=True):
            with open(temporary, "wb") as file:
                file.write(content)
                file.flush()
                os.fsync(file.fileno())
        for temporary, path in zip(temporaries, paths, strict=True):
            os.replace(temporary, path)
    except BaseException:
        for temporary in temporaries:
            temporary.unlink(missing_ok=True)
        raise
    for folder in {path.parent for path in paths}:
        _synchronise_folder(folder)


@contextmanager
def completed(path: Path) -> Iterator[Path]:
    """
    For what writes a file itself: it is replaced once all is written, and left as it was if something goes wrong.

    :param path: the file
    :return: where to write meanwhile, a name with the same suffix beside it
    """
    unfinished = path.with_name(f".{path.stem}.{os.getpid()}.tmp{path.suffix}")
    try:
        yield unfinished
        unfinished.replace(path)
    finally:
        unfinished.unlink(missing_ok=True)


def seal(path: Path, content: Any) -> str:
    """
    Write an object, such that damage of the file will be noticed.

    :param path: the file
    :param content: anything that can be pickled
    :return: its checksum
    :raises OSError: see :func:`write_atomically`
    """
    import torch as th

    buffer = io.BytesIO()
    th.save(content, buffer, pickle_protocol=pickle.HIGHEST_PROTOCOL)
    digest = hashlib.sha256(buffer.getbuffer())
    write_atomically(path, digest.digest() + buffer.getvalue())
    return digest.hexdigest()


def checked_content(path: Path, expected: str | None = None) -> memoryview:
    """
    :param path: a sealed file
    :param expected: the checksum that it has to have
    :return: its content, still pickled
    :raises DamagedFile: if that has not its checksum, or another one than expected
    """
    try:
        content = path.read_bytes()
    except OSError as error:
        raise DamagedFile(f"{path.name}: {error.strerror}") from None
    sealed, digest = memoryview(content)[32:], content[:32]
    if hashlib.sha256(sealed).digest() != digest or expected not in (None, digest.hex()):
        raise DamagedFile(f"{path.name}: cut or changed")
    return sealed


def unseal(path: Path, expected: str | None = None) -> Any:
    """
    :param path: a sealed file, of somebody you trust
    :param expected: the checksum that it has to have
    :return: the object, tensors on the CPU
    :raises DamagedFile: see :func:`checked_content`; or if it cannot be read with the versions that are installed here
    """
    import torch as th

    sealed = checked_content(path, expected)
    try:
        return th.load(io.BytesIO(sealed), map_location="cpu", weights_only=False)
    except Exception as error:  # whole, but written by other versions: whatever unpickling raises
        raise DamagedFile(f"{path.name}: cannot be read here — {error}") from error
