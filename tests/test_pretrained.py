"""The agents that come with the package do what they are for."""

import pytest

from sb3_symphony.cli import main
from sb3_symphony.experiment.enjoy import enjoy
from sb3_symphony.experiment.evaluate import evaluate
from sb3_symphony.experiment.select import EnjoyOptions, EvaluateOptions, pretrained_folder

RUNS = sorted(pretrained_folder().glob("*/*_*"))


def test_they_are_there():
    names = [f"{run.parent.name}/{run.name}" for run in RUNS]
    assert {f"{algo}/BipedalWalker-v3_1" for algo in ("symphony", "redq", "droq")} <= set(names)


@pytest.mark.parametrize("run", RUNS, ids=lambda run: f"{run.parent.name}-{run.name}")
def test_agent(run, tmp_path, monkeypatch, capsys):
    """Found by its name alone where there are no other runs, without a warning of strangers' files."""
    monkeypatch.chdir(tmp_path)
    env = run.name.rpartition("_")[0]
    result = evaluate(EvaluateOptions(algo=run.parent.name, env=env, n_episodes=2, seed=0))
    assert result.selection.run == run
    assert max(episode.reward for episode in result.episodes) > 250  # it walks to the end; one may stumble
    assert "pickled" not in capsys.readouterr().err
    assert sum(path.stat().st_size for path in run.rglob("*")) < 1_000_000


@pytest.mark.parametrize(
    "command, written",
    [
        ("gait --skip 0 -n 60 --n-frames 0", "gait.png"),
        ("video -n 5", "symphony_BipedalWalker-v3.mp4"),
        ("export", "symphony_BipedalWalker-v3.onnx"),
    ],
)
def test_commands_do_not_write_into_the_package(tmp_path, monkeypatch, command, written):
    monkeypatch.chdir(tmp_path)
    before = sorted(pretrained_folder().rglob("*"))
    assert main(command.split()) == 0
    assert [path.name for path in tmp_path.iterdir()] == [written]
    assert sorted(pretrained_folder().rglob("*")) == before


def test_enjoy_without_training(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    enjoy(EnjoyOptions(render=False, n_timesteps=20))
    assert "symphony on BipedalWalker-v3" in capsys.readouterr().out
