"""Noise that follows the returns of training episodes."""

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3 import PPO, TD3
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.noise import NormalActionNoise

from sb3_symphony.common.callbacks import QuietOnReturn
from sb3_symphony.common.noise import StickyActionNoise
from sb3_symphony.common.wrappers import RewardScale

RETURNS = [0, 20, 100, 150, 200, 300, 400, 60]


class Returns(gym.Env):
    """Episodes of two steps that return, one after the other, what they are told to."""

    observation_space = gym.spaces.Box(-1.0, 1.0, (2,))
    action_space = gym.spaces.Box(-1.0, 1.0, (1,))
    episode = -1

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.episode, self.steps = self.episode + 1, 0
        return np.zeros(2, dtype=np.float32), {}

    def step(self, action):
        self.steps += 1
        done = self.steps == 2
        return np.zeros(2, dtype=np.float32), RETURNS[self.episode % len(RETURNS)] if done else 0.0, done, False, {}


class Note(BaseCallback):
    """What the noise is at each step."""

    def _init_callback(self):
        self.seen = []

    def _on_step(self):
        noise = self.model.action_noise
        self.seen.append([each.independent for each in getattr(noise, "noises", [noise])])
        return True


def td3(env, **kwargs):
    noise = StickyActionNoise(1, independent=0.3)
    return TD3("MlpPolicy", env, action_noise=noise, learning_starts=100, buffer_size=100, seed=0, device="cpu", **kwargs)


def expected(n_recent, before=0.3):
    """Noise after 1, 2, … episodes."""
    means = [np.mean(RETURNS[max(n - n_recent, 0) : n]) for n in range(1, len(RETURNS) + 1)]
    values = np.interp(means, (50, 250), (0.2, 0.05))
    return [before] * (n_recent - 1) + list(values[n_recent - 1 :])


@pytest.mark.parametrize("n_recent", [1, 3])
@pytest.mark.parametrize("scaled", [False, True])
def test_noise_follows_the_reported_returns(n_recent, scaled):
    env = RewardScale(Returns(), scale=0.01) if scaled else Returns()
    note = Note()
    td3(env).learn(17, callback=[QuietOnReturn((50, 250), n_episodes=n_recent), note])
    after_episodes = [seen[0] for seen in note.seen[2::2]]  # SB3 notes an episode after the callback of its last step
    assert after_episodes == pytest.approx(expected(n_recent))
    assert note.seen[0] == note.seen[1] == [0.3]


def test_every_environment_gets_it():
    note = Note()
    model = td3(make_vec_env(Returns, n_envs=2))
    model.learn(2 * 17, callback=[QuietOnReturn((50, 250), n_episodes=2), note])
    # Both environments end alike episodes in the same step
    assert [seen[0] for seen in note.seen[2::2]] == pytest.approx(expected(1))
    assert all(first == second for first, second in note.seen)


def test_goes_on_alike_from_a_file(tmp_path):
    whole, rest = Note(), Note()
    td3(Returns()).learn(16, callback=[QuietOnReturn((50, 250), n_episodes=3), whole])
    env = Returns()
    half = td3(env).learn(8, callback=QuietOnReturn((50, 250), n_episodes=3))
    half.save(tmp_path / "half")
    loaded = TD3.load(tmp_path / "half", env=env, device="cpu")
    assert loaded.action_noise.independent == half.action_noise.independent
    env.episode -= 1  # learn() resets the environment once more
    loaded.learn(8, callback=[QuietOnReturn((50, 250), n_episodes=3), rest], reset_num_timesteps=False)
    assert rest.seen == whole.seen[8:]


@pytest.mark.parametrize(
    "arguments, message",
    [
        (dict(returns=(100,)), r"returns=\(100,\): expected two numbers"),
        (dict(returns=(250, 100)), r"returns=\(250, 100\): expected the smaller number first"),
        (dict(returns=(0, float("nan"))), "returns=nan"),
        (dict(returns=(0, 1), independent=(0.2, -0.1)), "independent=-0.1: expected a number >= 0"),
        (dict(returns=(0, 1), n_episodes=0), "n_episodes=0: expected an integer >= 1"),
    ],
)
def test_wrong_values(arguments, message):
    with pytest.raises(ValueError, match=message):
        QuietOnReturn(**arguments)


def test_refuses_other_noise():
    model = TD3("MlpPolicy", Returns(), action_noise=NormalActionNoise(np.zeros(1), np.ones(1)), device="cpu")
    for other in (model, TD3("MlpPolicy", Returns(), device="cpu"), PPO("MlpPolicy", Returns(), device="cpu")):
        with pytest.raises(TypeError, match="expected a StickyActionNoise"):
            other.learn(3, callback=QuietOnReturn((0, 1)))


def test_more_episodes_than_are_kept():
    with pytest.raises(ValueError, match="n_episodes=5: expected at most the model's stats_window_size, 3"):
        td3(Returns(), stats_window_size=3).learn(10, callback=QuietOnReturn((50, 250)))
