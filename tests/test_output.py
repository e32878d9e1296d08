"""Files named on the command line: refused early, written whole."""

import json
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from sb3_symphony.experiment.config import ConfigError, TrainOptions
from sb3_symphony.experiment.output import alone, json_report, output_file, output_folder, write_output
from sb3_symphony.experiment.train import train


@contextmanager
def ordinary_user() -> Iterator[None]:
    """Permissions do not hold for root."""
    if os.geteuid() != 0:
        yield
        return
    os.seteuid(65534)
    try:
        yield
    finally:
        os.seteuid(0)


@pytest.fixture
def folder(monkeypatch):
    """A folder that every user can look into; pytest's own cannot be."""
    with tempfile.TemporaryDirectory() as name:
        os.chmod(name, 0o755)
        monkeypatch.chdir(name)
        yield Path(name)
        monkeypatch.undo()


def test_good_names(folder):
    assert output_file("a.json", "--json") == Path("a.json")
    assert output_file("a.ONNX", "-o", (".onnx",)) == Path("a.ONNX")
    assert output_folder("new/folder", "--reward-log").is_dir()
    assert [path.name for path in folder.iterdir()] == ["new"] and not list((folder / "new" / "folder").iterdir())


def test_results_are_told_if_they_cannot_be_written(folder, monkeypatch, capsys):
    def full(descriptor):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    tell = json_report("a.json")
    with pytest.raises(ConfigError, match=r"--json: 'a\.json' cannot be written — No space left"):
        tell({"mean_reward": 3})
    assert json.loads(capsys.readouterr().out) == {"mean_reward": 3} and not list(folder.iterdir())


def test_json_has_null_for_what_is_not_finite(capsys):
    json_report("-")({"a": [1.0, float("nan")], "b": {"c": (float("inf"), 2)}})
    assert json.loads(capsys.readouterr().out) == {"a": [1.0, None], "b": {"c": [None, 2]}}


def test_bad_names(folder):
    (folder / "file").touch()
    for call, message in (
        (
            lambda: output_file("a.zip", "-o", (".onnx", ".pb")),
            "-o: 'a.zip' — expected a file name that ends with .onnx or .pb",
        ),
        (lambda: output_file(".", "-o"), "-o: '.' cannot be written — it is a folder"),
        (lambda: output_file("new/", "-o"), "-o: 'new/' cannot be written — it is a folder"),
        (lambda: output_file("no/a", "-o"), "-o: 'no/a' cannot be written — there is no folder no"),
        (lambda: output_file("a" * 300, "-o"), f"-o: '{'a' * 300}' cannot be written — File name too long"),
        (lambda: output_file("/dev/null", "-o"), "-o: '/dev/null' cannot be written — it is no regular file"),
        (lambda: output_folder("file", "-o"), "-o: 'file' cannot be written — it is no folder"),
        (lambda: output_folder("file/below", "-o"), "-o: 'file/below' cannot be written — Not a directory"),
    ):
        with pytest.raises(ConfigError) as error:
            call()
        assert str(error.value) == message
    assert [path.name for path in folder.iterdir()] == ["file"]
    (folder / "loop").symlink_to("loop")
    with pytest.raises(ConfigError, match="'loop' cannot be written"):
        output_file("loop", "-o")


@pytest.mark.skipif(os.name != "posix", reason="permissions of POSIX")
def test_without_permission(folder):
    locked = folder / "locked"
    locked.mkdir()
    (locked / "out.json").write_text("mine")
    locked.chmod(0o555)
    with ordinary_user():
        for call in (
            lambda: output_file("locked/out.json", "-o"),
            lambda: output_folder("locked", "-o"),
            lambda: output_folder("locked/new", "-o"),
            lambda: write_output(Path("locked/out.json"), b"other", "-o"),
        ):
            with pytest.raises(ConfigError, match=r"-o: .locked.*. cannot be written — Permission denied"):
                call()
        with pytest.raises(ConfigError, match=r"locked/\.lock' cannot be locked — Permission denied"), alone(locked, "in use"):
            pass
    assert (locked / "out.json").read_text() == "mine" and len(list(locked.iterdir())) == 1
    locked.chmod(0o700)
    with ordinary_user():
        for arguments in ({"conf_file": "locked/a.yml"}, {"resume": "locked/run"}):
            with pytest.raises(ConfigError, match=r": 'locked/.*'"):
                train(TrainOptions(algo="td3", env="Pendulum-v1", **arguments))


def test_writing(folder):
    (folder / "out").write_bytes(b"before")
    write_output(folder / "out", b"after", "-o")
    assert (folder / "out").read_bytes() == b"after" and len(list(folder.iterdir())) == 1
    (folder / "link").symlink_to("out")
    write_output(folder / "link", b"through", "-o")
    assert (folder / "link").is_symlink() and (folder / "out").read_bytes() == b"through"
