"""Episodes that are recorded, and made again from their actions."""

import ctypes
import pickle
import types

import gymnasium as gym
import numpy as np
import pytest
from resume_helpers import GlobalRandomEnv, difference
from stable_baselines3.common.monitor import Monitor

from sb3_symphony.common.recording import RecordedEpisode
from sb3_symphony.common.wrappers import EpisodeStepLimit, FreshBox2DWorld, RewardFloor


def recorded(env_id, wrapper=None):
    env = gym.make(env_id)
    if "Walker-" in env_id or "Lander" in env_id:
        env = FreshBox2DWorld(env)
    env = Monitor(env)
    return RecordedEpisode(env if wrapper is None else wrapper(env))


ENVIRONMENTS = ["Pendulum-v1", "CartPole-v1", "BipedalWalker-v3", "LunarLander-v3", "Hopper-v5", "HalfCheetah-v5"]


@pytest.mark.parametrize("env_id", ENVIRONMENTS)
@pytest.mark.parametrize("steps", [0, 7, 150])
def test_replayed_episode_goes_on_alike(env_id, steps):
    """After any number of episodes: the same observations, rewards, ends of episodes and next episodes."""
    if env_id in ("Hopper-v5", "HalfCheetah-v5"):
        pytest.importorskip("mujoco")
    env, rng = recorded(env_id), np.random.default_rng(0)
    env.action_space.seed(0)
    env.reset(seed=3)

    def go_on(env, actions):
        seen = []
        for action in actions:
            observation, reward, terminated, truncated, _ = env.step(action)
            seen.append((observation, reward, terminated, truncated))
            if terminated or truncated:
                seen.append(env.reset()[0])
        return seen

    go_on(env, [env.action_space.sample() for _ in range(steps + rng.integers(10))])
    state = pickle.loads(pickle.dumps(env.recorded_state()))
    actions = [env.action_space.sample() for _ in range(300)]
    expected = go_on(env, actions)

    other = recorded(env_id)
    other.reset(seed=99)  # as learn() does before it is resumed
    go_on(other, [other.action_space.sample() for _ in range(20)])
    assert other.replay(state)
    assert difference(go_on(other, actions), expected) is None
    for name in ("episode_returns", "episode_lengths", "total_steps", "rewards"):
        assert getattr(other.monitor, name) == getattr(env.monitor, name)


def test_replay_of_an_episode_after_a_replay():
    """What a replayed episode remembers is again enough for the next checkpoint."""
    env = recorded("BipedalWalker-v3")
    env.reset(seed=0)
    for action in np.random.default_rng(0).uniform(-1, 1, (20, 4)):
        env.step(action)
    again = recorded("BipedalWalker-v3")
    assert again.replay(env.recorded_state())
    assert difference(again.recorded_state(), env.recorded_state()) is None


def test_wrappers_have_their_counts_again():
    def wrapper(env):
        limited = EpisodeStepLimit(RewardFloor(env, -1.0), max_steps=10, until_total_steps=25)
        return gym.wrappers.NormalizeObservation(limited)

    env, other = recorded("Pendulum-v1", wrapper), recorded("Pendulum-v1", wrapper)
    env.reset(seed=0)
    for _ in range(36):  # cut after 10, 20 and 30 steps, since 20 < 25, and then no more
        if any(env.step(np.array([1.0]))[2:4]):
            env.reset()
    other.reset(seed=5)
    assert other.replay(env.recorded_state())
    limits = [env.get_wrapper_attr("total_steps"), other.get_wrapper_attr("total_steps")]
    assert limits[0] == limits[1] == 36
    assert difference(other.step(np.array([0.5])), env.step(np.array([0.5]))) is None


def test_a_monitor_that_refuses_early_resets():
    def make():
        return RecordedEpisode(Monitor(gym.make("Pendulum-v1"), allow_early_resets=False))

    env, other = make(), make()
    env.reset(seed=0)
    env.step(np.array([1.0]))
    other.reset(seed=5)
    other.step(np.array([1.0]))
    assert other.replay(env.recorded_state())
    assert difference(other.step(np.array([0.5])), env.step(np.array([0.5]))) is None
    other.start_anew(env.recorded_state())
    other.reset()
    with pytest.raises(RuntimeError, match="early"):
        other.reset()


class Arm(gym.Env):
    """Its state is a part of its own, and an array that it never replaces."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (2,))
    action_space = gym.spaces.Box(-1.0, 1.0, (1,))

    def __init__(self):
        self.data = types.SimpleNamespace(speed=0.0)
        self.angles = np.zeros(1)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.data.speed, self.angles[:] = self.np_random.uniform(), 0.0
        return np.zeros(2, dtype=np.float32), {}

    def step(self, action):
        self.data.speed += float(action[0])
        self.angles += self.data.speed
        return np.array([self.data.speed, self.angles[0]], dtype=np.float32), 0.0, False, False, {}


class PaidByTheSimulator(gym.Wrapper):
    def __init__(self, env, view):
        super().__init__(env)
        self.data, self.angles = env.unwrapped.data, env.unwrapped.angles[:] if view else env.unwrapped.angles
        self.best = 0.0

    def step(self, action):
        observation, _, *rest = super().step(action)
        self.best = max(self.best, self.angles[0])
        return observation, self.data.speed + 10 * self.angles[0] + 100 * self.best, *rest


@pytest.mark.parametrize("view", [False, True])
@pytest.mark.parametrize("outside", [False, True])
def test_what_wrappers_see_of_the_simulator_stays_that(view, outside):
    def make():
        env = Monitor(Arm()) if outside else Arm()
        env = PaidByTheSimulator(env, view)
        return RecordedEpisode(env if outside else Monitor(env))

    env, other = make(), make()
    env.reset(seed=0)
    for move in (0.5, -0.5, 0.25):
        env.step(np.array([move]))
    other.reset(seed=1)
    assert other.replay(env.recorded_state())
    for move in (0.5, -1.0):
        assert difference(other.step(np.array([move])), env.step(np.array([move]))) is None
    other.start_anew(env.recorded_state())
    rewards = []
    for each in (env, other):
        each.reset()
        rewards.append(each.step(np.array([0.5]))[1])
    assert rewards[0] == rewards[1]


def test_without_a_monitor_inside():
    with pytest.raises(TypeError, match=r"RecordedEpisode: .* expected a Monitor inside"):
        RecordedEpisode(gym.make("Pendulum-v1"))


def test_rewards_that_come_out_otherwise_are_noticed():
    """Those of a wrapper around the monitor, which does not see them."""

    class Drawn(gym.RewardWrapper):
        def reward(self, reward):
            return reward + np.random.uniform()

    env = RecordedEpisode(Drawn(Monitor(Arm())))
    env.reset(seed=0)
    env.step(np.array([0.5]))
    assert not env.replay(env.recorded_state())


@pytest.mark.parametrize("where, moves", [("observation", 0), ("reward", 1)])
def test_what_cannot_be_replayed_is_noticed(tmp_path, where, moves):
    """At once: a robot must not repeat moves that were made for another situation."""
    env = RecordedEpisode(Monitor(GlobalRandomEnv(where), str(tmp_path / "0")))
    env.reset(seed=0)
    for _ in range(5):
        env.step(np.zeros(3))
    assert not env.replay(env.recorded_state())
    assert env.monitor.results_writer is not None and env.unwrapped.n == moves


def test_an_episode_that_ends_in_its_replay_is_noticed(tmp_path):
    env = RecordedEpisode(Monitor(GlobalRandomEnv("nowhere"), str(tmp_path / "0")))
    env.reset(seed=0)
    for _ in range(5):
        env.step(np.zeros(3))
    state, before = env.recorded_state(), (tmp_path / "0.monitor.csv").read_text()
    env.unwrapped.where = "end"
    assert not env.replay(state)
    assert (tmp_path / "0.monitor.csv").read_text() == before  # it never happened


class SkipFrames(gym.Wrapper):
    """Two steps for each action; its driver cannot be pickled."""

    def __init__(self, env):
        super().__init__(env)
        self.driver = ctypes.pointer(ctypes.c_int(1))

    def step(self, action):
        _, first, *_ = self.env.step(action)
        observation, second, *others = self.env.step(action)
        return observation, first + second, *others


def test_several_steps_of_the_monitor_for_each_action():
    env, other = (recorded("Pendulum-v1", SkipFrames) for _ in range(2))
    env.reset(seed=1)
    other.reset(seed=2)
    for action in np.linspace(-1, 1, 20, dtype=np.float32):
        env.step(np.array([action]))
    state = env.recorded_state()
    assert other.replay(state) and len(other.monitor.rewards) == 40
    state["monitor"]["rewards"][3] += 1e-9
    assert not other.replay(state) and len(other.actions) == 2
