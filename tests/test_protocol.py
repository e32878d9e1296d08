"""``train --protocol standard``: when it evaluates, and what it refuses."""

import numpy as np
import pytest
import yaml
from test_cli import fails

from sb3_symphony.experiment import protocol
from sb3_symphony.experiment.config import ConfigError, TrainOptions, load_config
from sb3_symphony.experiment.protocol import keep_protocol, solved_stride
from sb3_symphony.experiment.train import train

SMALL = {"policy_kwargs": {"net_arch": [8]}, "learning_starts": 50, "buffer_size": 1000, "batch_size": 16}


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def kept(**options):
    options = TrainOptions(protocol="standard", **options)
    return keep_protocol(options, load_config(options))


def test_what_it_settles():
    off, on = kept(algo="td3"), kept(algo="ppo")
    assert (off.eval_freq, off.eval_episodes, off.threshold, solved_stride(off)) == (2_500, 10, 300, 4)
    assert (on.eval_freq, on.eval_episodes, on.threshold, solved_stride(on)) == (25_000, 10, 300, 1)
    assert kept(env="Pendulum-v1").threshold is None  # registered without one
    assert kept(env="Pendulum-v1", threshold=-200).threshold == -200
    assert kept(eval_freq=2_500, eval_episodes=10) == off.model_copy(update={"algo": "symphony"})
    other = TrainOptions(eval_freq=77)
    assert keep_protocol(other, load_config(other)) is other and solved_stride(other) == 1


@pytest.mark.parametrize(
    "options, message",
    [
        ({"eval_freq": 500}, "--eval-freq: 500 — expected 2500 or nothing"),
        ({"eval_freq": 2500, "algo": "ppo"}, "--eval-freq: 2500 — expected 25000 or nothing"),
        ({"eval_episodes": 5}, "--eval-episodes: 5 — expected 10 or nothing"),
        ({"env_kwargs": {"hardcore": True}}, "env_kwargs: 'hardcore'"),
        ({"hyperparams": {"env_wrapper": "gymnasium.wrappers.FlattenObservation"}}, "FlattenObservation' — changes the task"),
        (
            {"hyperparams": {"env_wrapper": {"sb3_symphony.common.wrappers.EpisodeStepLimit": {"max_steps": 500}}}},
            "EpisodeStepLimit' — changes the task",
        ),
    ],
)
def test_what_contradicts_it(options, message):
    with pytest.raises(ConfigError) as error:
        kept(**options)
    assert message in str(error.value)


def test_transforms_of_what_is_learned_from_are_allowed():
    floor = {"floor": -10}
    wrappers = [{"sb3_symphony.common.wrappers.RewardFloor": floor}, {"gymnasium.wrappers.ClipReward": {"max_reward": 3}}]
    assert kept(hyperparams={"env_wrapper": wrappers, "normalize": True}).eval_freq == 2_500


def test_mistakes_leave_nothing(folder, capsys):
    assert "--eval-freq: 9 — expected 2500" in fails(capsys, "train", "--protocol", "standard", "--eval-freq", "9")
    assert "expected both or neither" in fails(capsys, "train", "--threshold", "300")
    assert "unknown protocol 'standart': did you mean 'standard'?" in fails(capsys, "train", "--protocol", "standart")
    assert list(folder.iterdir()) == []


@pytest.mark.parametrize("n_envs, resumed", [(1, False), (2, False), (1, True)])
def test_fewer_evaluations_once_solved(monkeypatch, n_envs, resumed):
    """The threshold is passed at the second evaluation and still at the third: from then on every fourth takes place."""
    monkeypatch.setattr(protocol, "EVAL_FREQ", 40)
    monkeypatch.setattr(protocol, "EVAL_EPISODES", 1)
    returns = iter([-300.0, -150.0, -160.0, -900.0, -100.0, -100.0])
    monkeypatch.setattr("stable_baselines3.common.callbacks.evaluate_policy", lambda *_, **__: ([next(returns)], [200]))
    options = TrainOptions(
        algo="td3",
        env="Pendulum-v1",
        n_timesteps=200 if resumed else 500,
        save_freq=100,
        seed=0,
        protocol="standard",
        threshold=-200,
        hyperparams={**SMALL, "n_envs": n_envs},
        verbose=0,
        progress=False,
    )
    run = train(options).run
    if resumed:
        train(TrainOptions(resume=str(run.path), n_timesteps=500))
    with np.load(run.path / "evaluations.npz") as data:
        assert data["timesteps"].tolist() == [40, 80, 120, 160, 320, 480]
    stored = yaml.safe_load((run.details / "args.yml").read_text())
    assert (stored["protocol"], stored["threshold"], stored["eval_freq"], stored["eval_episodes"]) == ("standard", -200, 40, 1)
