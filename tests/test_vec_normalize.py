"""VecNormalize: raw storage, normalised samples."""

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.envs import BitFlippingEnv
from stable_baselines3.common.vec_env import VecNormalize
from stable_baselines3.her import HerReplayBuffer

from sb3_symphony.common.buffers import FadingReplayBuffer, PrioritizedReplayBuffer

BUFFERS = [None, FadingReplayBuffer, PrioritizedReplayBuffer]


@pytest.mark.parametrize("replay_buffer_class", BUFFERS)
@pytest.mark.parametrize("n_steps", [1, 3])
@pytest.mark.parametrize("n_envs", [1, 2])
def test_training_sees_current_statistics(make, pendulum, replay_buffer_class, n_steps, n_envs):
    """Observations and rewards are stored raw, and normalised with the statistics at the time of sampling."""
    env = VecNormalize(pendulum(n_envs), gamma=0.9)
    model = make(env, replay_buffer_class=replay_buffer_class, n_steps=n_steps, gamma=0.9)
    model.learn(60)
    rewards = model.replay_buffer.rewards[: 60 // n_envs]
    assert rewards.min() < -4 and rewards.max() <= 0  # Pendulum's raw rewards
    angles = model.replay_buffer.observations[: 60 // n_envs, :, :2]
    np.testing.assert_allclose((angles**2).sum(-1), 1.0, rtol=1e-5)  # cosine and sine

    fitted = []
    fit = model._regression.fit

    def spy(observations, actions, target, *args):
        fitted.append((observations, target))
        return fit(observations, actions, target, *args)

    model._regression.fit = spy
    env.obs_rms.mean[:] = 100.0  # as if the statistics had moved on
    env.obs_rms.var[:] = 1.0
    model.train(gradient_steps=2, batch_size=16)
    assert all((observations == -env.clip_obs).all() for observations, _ in fitted)


def test_rewards_are_normalised_with_current_statistics(make, pendulum):
    env = VecNormalize(pendulum(), norm_obs=False, clip_reward=1e9)
    model = make(env, gamma=0.0)  # the target is the reward
    model.learn(60)
    targets = []
    fit = model._regression.fit
    model._regression.fit = lambda obs, actions, target, *args: (targets.append(target), fit(obs, actions, target, *args))[1]
    raw = model.replay_buffer.rewards[:60].flatten()
    for variance in (1.0, 1e-4):
        targets.clear()
        env.ret_rms.var = np.array(variance)
        model.train(gradient_steps=2, batch_size=16)
        expected = np.sort(raw / np.sqrt(variance + env.epsilon))
        drawn = th.cat(targets).flatten().numpy()
        nearest = expected[np.abs(expected[:, None] - drawn).argmin(0)]
        np.testing.assert_allclose(drawn, nearest, rtol=1e-4)


def test_truncated_episodes_store_the_raw_terminal_observation(make, pendulum):
    model = make(VecNormalize(pendulum()))
    model.learn(60)
    buffer = model.replay_buffer
    assert buffer.timeouts[24, 0] == 1 and buffer.dones[24, 0] == 1
    terminal = buffer.next_observations[24, 0]
    assert (terminal[:2] ** 2).sum() == pytest.approx(1.0, rel=1e-4)
    assert not np.allclose(terminal, buffer.observations[25, 0])


@pytest.mark.parametrize("options", [dict(norm_reward=False), dict(norm_obs=False), dict(training=False)], ids=str)
def test_options(make, pendulum, options):
    make(VecNormalize(pendulum(2), **options)).learn(60)


def test_save_load_and_evaluate(make, algorithm, pendulum, tmp_path):
    env = VecNormalize(pendulum())
    model = make(env).learn(60)
    assert model.get_vec_normalize_env() is env
    model.save(tmp_path / "model")
    env.save(tmp_path / "vecnormalize.pkl")
    restored = VecNormalize.load(tmp_path / "vecnormalize.pkl", pendulum())
    loaded = algorithm.load(tmp_path / "model", env=restored)
    np.testing.assert_array_equal(restored.obs_rms.mean, env.obs_rms.mean)
    loaded.learn(40, reset_num_timesteps=False)
    observation = env.normalize_obs(np.array([[1.0, 0.0, 0.0]], dtype=np.float32))
    assert np.isfinite(loaded.predict(observation)[0]).all()


class Reach(gym.Env):
    """Move a point to a goal; episodes of 8 steps."""

    def __init__(self) -> None:
        box = spaces.Box(-50, 50, (2,))
        self.observation_space = spaces.Dict(observation=box, achieved_goal=box, desired_goal=box)
        self.action_space = spaces.Box(-1, 1, (2,))

    def compute_reward(self, achieved: np.ndarray, desired: np.ndarray, info: object) -> np.ndarray:
        return -np.linalg.norm(achieved - desired, axis=-1)

    def _observe(self) -> dict[str, np.ndarray]:
        return dict(observation=self.place.copy(), achieved_goal=self.place.copy(), desired_goal=self.goal.copy())

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[dict[str, np.ndarray], dict]:
        super().reset(seed=seed)
        self.place, self.steps = np.full(2, 30, np.float32), 0
        self.goal = self.np_random.uniform(-50, 50, 2).astype(np.float32)
        return self._observe(), {}

    def step(self, action: np.ndarray) -> tuple[dict[str, np.ndarray], float, bool, bool, dict]:
        self.place = self.place + action.astype(np.float32)
        self.steps += 1
        return self._observe(), float(self.compute_reward(self.place, self.goal, {})), False, self.steps >= 8, {}


@pytest.mark.parametrize("n_envs", [1, 2])
def test_her_with_normalisation(make, n_envs):
    """Goals are relabelled raw, then normalised like all else."""
    env = VecNormalize(make_vec_env(Reach, n_envs=n_envs))
    model = make(env, policy="MultiInputPolicy", replay_buffer_class=HerReplayBuffer)
    model.learn(80)
    stored = model.replay_buffer.observations["observation"][: 80 // n_envs]
    assert stored.min() > 20  # raw: the start is at 30, a step at most 1
    samples = model.replay_buffer.sample(200, env=env)
    assert samples.observations["observation"].abs().max() <= env.clip_obs
    assert samples.observations["observation"].abs().mean() < 3
    assert np.isfinite(model.logger.name_to_value["train/critic_loss"])


def test_her_with_normalised_rewards_only(make):
    env = VecNormalize(make_vec_env(lambda: BitFlippingEnv(n_bits=4, continuous=True, max_steps=8)), norm_obs=False)
    make(env, policy="MultiInputPolicy", replay_buffer_class=HerReplayBuffer).learn(60)
