"""Files that are there completely or not at all."""

import io
import os

import pytest

from sb3_symphony.common.files import write_atomically


@pytest.mark.parametrize("step", ["write", "fsync", "replace"])
def test_failing_write_leaves_the_old_file(tmp_path, monkeypatch, step):
    def fail(*args):
        raise OSError(28, os.strerror(28))

    path = tmp_path / "file"
    write_atomically(path, b"old")
    if step == "write":
        monkeypatch.setattr("builtins.open", lambda *args: type("Full", (io.BytesIO,), {"write": fail})())
    else:
        monkeypatch.setattr(os, step, fail)
    with pytest.raises(OSError, match="No space left"):
        write_atomically(path, b"new")
    monkeypatch.undo()
    assert path.read_bytes() == b"old" and list(tmp_path.iterdir()) == [path]
    write_atomically(path, b"new")
    assert path.read_bytes() == b"new"


def test_interrupted_write_leaves_the_old_file(tmp_path, monkeypatch):
    path = tmp_path / "file"
    write_atomically(path, b"old")
    monkeypatch.setattr(os, "fsync", lambda descriptor: (_ for _ in ()).throw(KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        write_atomically(path, b"new")
    assert path.read_bytes() == b"old" and list(tmp_path.iterdir()) == [path]
