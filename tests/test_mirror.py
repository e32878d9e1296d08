"""Mirrored transitions: what is exchanged, how often, and that the walker's two legs are alike."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3 import SAC, TD3
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecNormalize

from sb3_symphony.common.buffers import FadingReplayBuffer, PrioritizedReplayBuffer
from sb3_symphony.common.mirror import Mirror, Reflection
from sb3_symphony.common.wrappers import FreshBox2DWorld
from sb3_symphony.experiment.config import TrainOptions, load_config

OBSERVATION = spaces.Box(-10, 10, (4,))
ACTION = spaces.Box(-1, 1, (3,))
SPEC = {"observation": {"swap": [[0, 2]], "negate": [3], "offset": [[0, 0.5], [2, -0.5]]}, "action": {"swap": [[0, 1]]}}


def test_reflection():
    reflection = Reflection("it", 5, swap=[[0, 2], [1, 3]], negate=[1, 3, 4], offset=[[0, 0.5], [2, -0.5]])
    vectors = th.tensor([[1.0, 2.0, 3.0, 4.0, 5.0], [0.0, 0.0, 0.0, 0.0, 1.0]])
    expected = th.tensor([[3.5, -4.0, 0.5, -2.0, -5.0], [0.5, 0.0, -0.5, 0.0, -1.0]])
    th.testing.assert_close(reflection(vectors), expected)
    th.testing.assert_close(reflection(reflection(vectors)), vectors)
    assert reflection(vectors.double()).dtype == th.float64


@pytest.mark.parametrize(
    "values, message",
    [
        (dict(swap=[[0, 4]]), r"it: index=4: expected an integer >= 0 and <= 3"),
        (dict(swap=[[0, -1]]), r"it: index=-1"),
        (dict(swap=[[0, 1.5]]), r"it: index=1.5"),
        (dict(swap=[0, 1]), r"swap=\[0, 1\]: expected a list of pairs"),
        (dict(swap=3), r"swap=3: expected a list of pairs"),
        (dict(swap=[[0, 1, 2]]), "expected a list of pairs"),
        (dict(swap=[[0, 1], [1, 2]]), "expected each index once"),
        (dict(swap=[[1, 1]]), "expected each index once"),
        (dict(swap=[[0, 1]], negate=[0]), "both of a pair negated or none"),
        (dict(swap=[[0, 1]], offset=[[0, 0.1]]), "offsets that cancel"),
        (dict(offset=[[0, 0.1]]), "offsets that cancel"),
        (dict(offset=[0.1]), r"offset=\[0.1\]: expected a list of pairs"),
        (dict(offset=[[0, float("nan")]]), "it: offset of 0=nan"),
        (dict(offset=[[7, 1.0]]), "it: index=7"),
        (dict(offset=[[0, 0.1], [0, 0.0]]), r"offset=\[\[0, 0.1\], \[0, 0.0\]\]: expected each index once"),
        (dict(negate=2), "negate=2: expected a list of indices"),
        (dict(negate=[True]), "it: index=True"),
    ],
    ids=str,
)
def test_reflection_refusals(values, message):
    with pytest.raises((ValueError, TypeError), match=message):
        Reflection("it", 4, **values)


@pytest.mark.parametrize(
    "values, message",
    [
        ({}, "expected a mapping with the keys observation and action"),
        ({"observation": {}, "actions": {}}, "keys observation and action"),
        ([1], "keys observation and action"),
        ({"observation": {"swpa": [[0, 1]]}, "action": {}}, "did you mean 'swap'"),
        ({"observation": [[0, 1]], "action": {}}, r"mirror: observation=\[\[0, 1\]\]: expected a mapping"),
        ({"observation": {}, "action": {"swap": [[0, 3]]}}, "mirror: action: index=3"),
    ],
    ids=str,
)
def test_mirror_refusals(values, message):
    with pytest.raises((ValueError, TypeError), match=message):
        FadingReplayBuffer(10, OBSERVATION, ACTION, mirror=values)


def test_only_vectors():
    with pytest.raises(ValueError, match="expected observations that are vectors"):
        Mirror({"observation": {}, "action": {}}, spaces.Box(0, 1, (2, 2)), ACTION)
    with pytest.raises(ValueError, match="expected actions that are vectors"):
        Mirror({"observation": {}, "action": {}}, OBSERVATION, spaces.Discrete(3))
    with pytest.raises(ValueError, match="of real numbers, got Box"):  # 3 of 8 bits, negated, would be 253
        Mirror({"observation": {}, "action": {}}, spaces.Box(0, 255, (2,), np.uint8), ACTION)


def filled(cls: type, n_envs: int = 1, **kwargs: Any) -> Any:
    """A buffer whose transitions can be told by their first observation, and what it holds."""
    buffer = cls(60, OBSERVATION, ACTION, n_envs=n_envs, device="cpu", mirror=SPEC, **kwargs)
    rng = np.random.default_rng(0)
    for i in range(20):
        obs, next_obs = rng.normal(size=(2, n_envs, 4))
        buffer.add(
            obs, next_obs, rng.normal(size=(n_envs, 3)), rng.normal(size=n_envs), np.full(n_envs, i % 7 == 6), [{}] * n_envs
        )
    return buffer


def mirrored(obs: np.ndarray) -> np.ndarray:
    return np.stack([obs[:, 2] + 0.5, obs[:, 1], obs[:, 0] - 0.5, -obs[:, 3]], axis=1)


@pytest.mark.parametrize("cls", [FadingReplayBuffer, PrioritizedReplayBuffer])
@pytest.mark.parametrize("n_steps", [1, 3])
@pytest.mark.parametrize("n_envs", [1, 2])
def test_samples(cls, n_steps, n_envs):
    """Each is a stored transition or its image, as a whole; returns, ends and discounts are those of the stored one."""
    buffer = filled(cls, n_envs, n_steps=n_steps)
    np.random.seed(0)
    samples = buffer.sample(4000)
    buffer.mirror = None
    plain = buffer.sample(4000)  # each row of the buffer, many times
    stored = {tuple(obs.round(4).tolist()): i for i, obs in enumerate(plain.observations.numpy())}
    n_mirrored = 0
    for i, obs in enumerate(samples.observations.numpy()):
        origin = stored.get(tuple(obs.round(4).tolist()))
        other = origin is None
        n_mirrored += other
        if other:
            origin = stored[tuple(np.round(mirrored(obs[None])[0], 4).tolist())]
        action, next_obs = plain.actions[origin].numpy(), plain.next_observations[origin].numpy()
        if other:
            action, next_obs = action[[1, 0, 2]], mirrored(next_obs[None])[0]
        np.testing.assert_allclose(samples.actions[i].numpy(), action, rtol=1e-5)
        np.testing.assert_allclose(samples.next_observations[i].numpy(), next_obs, rtol=1e-4, atol=1e-6)
        assert samples.rewards[i] == plain.rewards[origin] and samples.dones[i] == plain.dones[origin]
        if n_steps > 1:
            assert samples.discounts[i] == plain.discounts[origin]
    assert abs(n_mirrored - 2000) < 4 * 32  # four standard deviations


@pytest.mark.parametrize("cls", [TD3, SAC])
def test_under_sb3(cls):
    env = make_vec_env("Pendulum-v1")
    spec = {"observation": {"negate": [1, 2]}, "action": {"negate": [0]}}  # left and right of a pendulum
    kwargs = dict(mirror=spec, fade_factor=None)
    model = cls("MlpPolicy", env, learning_starts=20, replay_buffer_class=FadingReplayBuffer, replay_buffer_kwargs=kwargs)
    model.learn(40)
    assert model._n_updates == 20


def test_not_with_normalised_observations(make):
    kwargs = dict(mirror={"observation": {"negate": [1, 2]}, "action": {"negate": [0]}})
    env = VecNormalize(make_vec_env("Pendulum-v1"))
    model = make(env, replay_buffer_class=FadingReplayBuffer, replay_buffer_kwargs=kwargs)
    with pytest.raises(ValueError, match="norm_obs=False"):
        model.learn(40)
    assert model.num_timesteps == 0  # not after a warm-up
    env = VecNormalize(make_vec_env("Pendulum-v1"), norm_obs=False)
    make(env, replay_buffer_class=FadingReplayBuffer, replay_buffer_kwargs=kwargs).learn(40)


def test_saved_with_the_model(make, algorithm, tmp_path):
    """SB3 keeps arguments as JSON, whose keys are texts and whose tuples are lists."""
    kwargs = dict(mirror={"observation": {"negate": [1, 2], "offset": [(2, 0.0)]}, "action": {"negate": (0,)}})
    make(replay_buffer_class=FadingReplayBuffer, replay_buffer_kwargs=kwargs).learn(30).save(tmp_path / "model")
    model = algorithm.load(tmp_path / "model", env=make_vec_env("Pendulum-v1"))
    assert model.learn(30, reset_num_timesteps=False).replay_buffer.mirror.observation.signs.tolist() == [1, -1, -1]


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_the_walker_is_symmetric(seed):
    """What one leg does in a world, the other one does in its mirror image, by the shipped settings; but for the solver."""
    spec = load_config(TrainOptions(algo="redq")).arguments["replay_buffer_kwargs"]["mirror"]
    env, image = (FreshBox2DWorld(gym.make("BipedalWalker-v3")) for _ in range(2))
    mirror = Mirror(spec, env.observation_space, env.action_space)
    actions = np.random.default_rng(seed).uniform(-1, 1, size=(20, 4)).astype(np.float32)
    for each in (env, image):
        each.reset(seed=seed)
        for action in actions[:10]:
            each.step(action)
    walker: Any = image.unwrapped
    for left, right in zip(walker.legs[:2], walker.legs[2:], strict=True):
        (*first,), (*second,) = (
            (tuple(body.position), body.angle, tuple(body.linearVelocity), body.angularVelocity) for body in (left, right)
        )
        for body, values in ((left, second), (right, first)):
            body.position, body.angle, body.linearVelocity, body.angularVelocity = values
    for action in actions[10:]:
        observation = th.as_tensor(env.step(action)[0])[None]
        seen = image.step(mirror.action(th.as_tensor(action)[None])[0].numpy())[0]
        np.testing.assert_allclose(seen, mirror.observation(observation)[0].numpy(), atol=0.015)
