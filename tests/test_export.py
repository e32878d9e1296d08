"""Exported actors give the actions of `predict`."""

import sys
from pathlib import Path

import gymnasium as gym
import numpy as np
import onnx
import onnxruntime
import pytest
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecNormalize

from sb3_symphony.cli import main
from sb3_symphony.experiment.config import ConfigError
from sb3_symphony.experiment.export import export, onnx_model
from sb3_symphony.experiment.registry import ALGORITHMS, load_algorithm
from sb3_symphony.experiment.select import ExportOptions


class Unequal(gym.Env):
    """Observations of very different size in float64, actions with unequal limits of shape (2, 2)."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (4,), np.float64)
    action_space = gym.spaces.Box(np.array([[-3, -1], [0, 5]], np.float32), np.array([[1, 1], [0.5, 20]], np.float32))

    def observe(self):
        return self.np_random.normal([0, 1e4, -3, 1], [1, 1, 1e-3, 1e3])

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps = 0
        return self.observe(), {}

    def step(self, action):
        self.steps += 1
        return self.observe(), -float(np.abs(action).sum()), False, self.steps == 50, {}


if "Unequal-v0" not in gym.registry:
    gym.register("Unequal-v0", entry_point=Unequal)


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def run_onnx(content, observations):
    session = onnxruntime.InferenceSession(content, providers=["CPUExecutionProvider"])
    assert [item.name for item in session.get_inputs()] == ["observation"]
    assert [item.name for item in session.get_outputs()] == ["action"]
    return session.run(None, {"observation": observations})[0]


def exported(model, normalization=None):
    """Of vectors, whose raw observations are in the model's own space."""
    return onnx_model(model, model.observation_space, normalization)


def half_range(space):
    return (space.high - space.low) / 2


@pytest.mark.parametrize("algo", ALGORITHMS)
@pytest.mark.parametrize("normalize", [False, True])
def test_equal_to_predict(algo, normalize):
    env = make_vec_env("Unequal-v0", seed=0)
    if normalize:
        env = VecNormalize(env)
        env.reset()
        for _ in range(200):
            env.step([env.action_space.sample()])
        env.training = False
    small = {} if algo in ("ppo", "trpo") else {"buffer_size": 10}
    model = load_algorithm(algo)("MlpPolicy", env, seed=0, device="cpu", policy_kwargs={"net_arch": [32, 32]}, **small)
    if algo in ("ppo", "trpo"):
        model.policy.action_net.weight.data *= 300  # which starts near zero
        model.policy.action_net.bias.data[3] = 12.0  # amid its limits
    raw = np.random.default_rng(0).normal([0, 1e4, -3, 1], [1, 1, 1e-3, 1e3], size=(1000, 4))
    if not normalize:
        raw /= [1, 1e4, 1, 1e3]  # networks are for numbers near 1
    expected, _ = model.predict(env.normalize_obs(raw) if normalize else raw, deterministic=True)
    given = run_onnx(exported(model, env if normalize else None), raw)
    assert given.shape == expected.shape == (1000, 2, 2) and given.dtype == np.float32
    assert np.abs((given - expected) / half_range(env.action_space)).max() <= 1e-5
    assert np.std(given, axis=0).min() > 1e-3  # they do depend on the observation
    for row in (0, 7):  # any number of observations at once
        assert run_onnx(exported(model, env if normalize else None), raw[row : row + 1]) == pytest.approx(
            given[[row]], rel=1e-5
        )


@pytest.mark.parametrize("algo", ["sac", "ppo"])
def test_state_dependent_exploration(algo):
    model = load_algorithm(algo)("MlpPolicy", "Pendulum-v1", use_sde=True, seed=0, device="cpu")
    observations = np.random.default_rng(0).normal(size=(100, 3)).astype(np.float32)
    given = run_onnx(exported(model), observations)
    assert np.abs(given - model.predict(observations, deterministic=True)[0]).max() <= 1e-5


def test_actions_without_bounds_of_their_own_are_clipped():
    model = PPO("MlpPolicy", "Pendulum-v1", seed=0, device="cpu")
    model.policy.action_net.bias.data += 100
    observations = np.random.default_rng(0).normal(size=(10, 3)).astype(np.float32)
    assert (run_onnx(exported(model), observations) == 2.0).all()


def test_trained_batch_statistics_are_inside():
    small = {"learning_starts": 20, "buffer_size": 100, "batch_size": 16, "policy_kwargs": {"net_arch": [16]}}
    model = load_algorithm("crossq")("MlpPolicy", "Pendulum-v1", **small, seed=0, device="cpu")
    model.learn(120)
    observations = np.random.default_rng(0).normal(size=(100, 3)).astype(np.float32)
    given = run_onnx(exported(model), observations)
    assert np.abs(given - model.predict(observations, deterministic=True)[0]).max() <= 2e-5


def test_images():
    class Images(gym.Env):
        observation_space = gym.spaces.Box(0, 255, (3, 36, 36), np.uint8)
        action_space = gym.spaces.Box(-1, 1, (2,))

        def reset(self, *, seed=None, options=None):
            return self.observation_space.sample(), {}

    model = PPO("CnnPolicy", Images(), n_steps=8, batch_size=8, seed=0, device="cpu")
    images = np.random.default_rng(0).integers(0, 256, (5, 3, 36, 36), dtype=np.uint8)
    assert run_onnx(exported(model), images) == pytest.approx(model.predict(images, deterministic=True)[0], abs=1e-5)


class LastChannels(Unequal):
    """Images whose channels are their last dimension."""

    observation_space = gym.spaces.Box(0, 255, (36, 40, 3), np.uint8)
    action_space = gym.spaces.Box(-1, 1, (2,))

    def observe(self):
        return self.np_random.integers(0, 256, (36, 40, 3), dtype=np.uint8)


if "LastChannels-v0" not in gym.registry:
    gym.register("LastChannels-v0", entry_point=LastChannels)


@pytest.mark.parametrize("normalize", ["false", "{norm_obs: false}"])
@pytest.mark.parametrize("frame_stack", [[], ["frame_stack:2"]])
def test_images_with_their_channels_last(folder, capsys, normalize, frame_stack):
    """The file takes them as the environment gives them."""
    small = ["policy:CnnPolicy", "n_steps:32", "batch_size:32", "n_epochs:1", f"normalize:{normalize}", *frame_stack]
    argv = "train --algo ppo --env LastChannels-v0 -n 32 --eval-freq 0 --seed 0 --device cpu --quiet -params"
    assert main([*argv.split(), *small]) == 0
    assert main("export --algo ppo --env LastChannels-v0 -o images.onnx".split()) == 0
    assert "equal to predict on 1000 observations" in capsys.readouterr().out
    channels = 6 if frame_stack else 3
    image = np.random.default_rng(0).integers(0, 256, (1, 36, 40, channels), dtype=np.uint8)
    given = run_onnx((folder / "images.onnx").read_bytes(), image)
    model = PPO.load("logs/ppo/LastChannels-v0_1/LastChannels-v0.zip")
    assert given == pytest.approx(model.predict(np.moveaxis(image, -1, 1), deterministic=True)[0], abs=1e-5)
    properties = {item.key: item.value for item in onnx.load("images.onnx").metadata_props}
    assert f"(36, 40, {channels})" in properties["observation_space"]


def test_normalised_images(folder, capsys):
    """What VecNormalize makes of them is no image, the file's input is one."""
    small = ["n_steps:32", "batch_size:32", "n_epochs:1", "normalize:true", "policy_kwargs.net_arch:[8]"]
    argv = "train --algo ppo --env LastChannels-v0 -n 32 --eval-freq 0 --seed 0 --device cpu --quiet -params"
    assert main([*argv.split(), *small]) == 0
    assert main("export --algo ppo --env LastChannels-v0 -o images.onnx".split()) == 0
    assert "equal to predict on 1000 observations" in capsys.readouterr().out
    properties = {item.key: item.value for item in onnx.load("images.onnx").metadata_props}
    assert properties["observation_space"] == "Box(0, 255, (36, 40, 3), uint8)"
    image = np.zeros((1, 36, 40, 3), dtype=np.uint8)
    assert run_onnx((folder / "images.onnx").read_bytes(), image).shape == (1, 2)


def test_episodes_without_an_end(folder):
    class Endless(Unequal):
        def step(self, action):
            return (*super().step(action)[:3], False, {})

    gym.register("Endless-v0", entry_point=Endless)
    try:
        SAC("MlpPolicy", "Endless-v0", buffer_size=10, policy_kwargs={"net_arch": [8]}, device="cpu").save("sac")
        assert export(ExportOptions(model="sac.zip", algo="sac", env="Endless-v0")).path.is_file()
    finally:
        del gym.registry["Endless-v0"]


def test_command(folder, capsys):
    env = VecNormalize(make_vec_env("Unequal-v0", seed=0))
    PPO("MlpPolicy", env, n_steps=64, batch_size=64, seed=0, device="cpu").learn(128).save("ppo")
    env.save("ppo.pkl")
    argv = ["export", "--model", "ppo.zip", "--algo", "ppo", "--env", "Unequal-v0", "--vecnormalize", "ppo.pkl"]
    assert main(argv) == 0
    out = capsys.readouterr().out
    assert "saved ppo.onnx" in out and "equal to predict on 1000 observations" in out
    properties = {item.key: item.value for item in onnx.load("ppo.onnx").metadata_props}
    assert properties["algorithm"] == "ppo" and properties["environment"] == "Unequal-v0"
    assert "float64" in properties["observation_space"] and "(2, 2)" in properties["action_space"]
    assert main([*argv, "-o", "other.onnx"]) == 0
    assert (folder / "other.onnx").read_bytes() == (folder / "ppo.onnx").read_bytes()


def test_a_wrong_file_is_not_written(folder, monkeypatch):
    SAC("MlpPolicy", "Pendulum-v1", buffer_size=10, policy_kwargs={"net_arch": [8]}, device="cpu").save("sac")
    other = SAC("MlpPolicy", "Pendulum-v1", buffer_size=10, policy_kwargs={"net_arch": [8]}, device="cpu")
    content = exported(other)
    monkeypatch.setattr("sb3_symphony.experiment.export.onnx_model", lambda *args: content)
    with pytest.raises(RuntimeError, match="differs from predict"):
        export(ExportOptions(model="sac.zip", algo="sac", env="Pendulum-v1"))
    assert [path.name for path in folder.iterdir()] == ["sac.zip"]


def test_what_cannot_be_exported(folder, monkeypatch):
    small = {"policy_kwargs": {"net_arch": [8]}, "device": "cpu"}
    PPO("MlpPolicy", "CartPole-v1", **small).save("discrete")
    load_algorithm("ppo_lstm")("MlpLstmPolicy", "Pendulum-v1", **small).save("recurrent")
    SAC("MlpPolicy", "Pendulum-v1", buffer_size=10, **small).save("sac")
    before = sorted(path.name for path in folder.iterdir())
    for model, algo, env, output, message in (
        ("discrete", "ppo", "CartPole-v1", None, r"discrete\.zip: its actions are Discrete\(2\) — expected continuous"),
        ("recurrent", "ppo_lstm", "Pendulum-v1", None, "a recurrent policy keeps a state"),
        ("sac", "sac", "Pendulum-v1", "sac.zip", r"--output: 'sac\.zip' — expected a file name that ends with \.onnx"),
        ("sac", "sac", "Pendulum-v1", "no/sac.onnx", "there is no folder no"),
    ):
        with pytest.raises(ConfigError, match=message):
            export(ExportOptions(model=model, algo=algo, env=env, output=output))
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    with pytest.raises(ConfigError, match=r'onnxruntime is not installed: pip install "sb3-symphony\[export\]"'):
        export(ExportOptions(model="sac", algo="sac", env="Pendulum-v1"))
    assert sorted(path.name for path in folder.iterdir()) == before


def test_old_model(folder, capsys):
    old = Path(__file__).parent / "data" / "sb3_2.3"
    flags = f"--algo ppo --model {old / 'ppo.zip'} --vecnormalize {old / 'ppo_vecnormalize.pkl'} --env Pendulum-v1 -o old.onnx"
    assert main(["export", *flags.split()]) == 0
    assert (folder / "old.onnx").stat().st_size < 20_000
