"""Checkpoints below the command line: files, replay segments, recorded episodes, the callback with any algorithm."""

import io
import os
import pickle
from functools import partial

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from resume_helpers import assert_same_results, difference
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.buffers import DictReplayBuffer, NStepReplayBuffer, ReplayBuffer
from stable_baselines3.common.callbacks import EvalCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.envs import BitFlippingEnv
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv
from stable_baselines3.her import HerReplayBuffer

from sb3_symphony import REDQ, Symphony
from sb3_symphony.common.buffers import SumTree
from sb3_symphony.common.checkpoint import (
    DamagedCheckpoint,
    ExactCheckpoints,
    RecordedEpisode,
    ReplaySegments,
    newest_checkpoint,
    record_episodes,
    write_atomically,
)
from sb3_symphony.common.wrappers import EpisodeStepLimit, FreshBox2DWorld, RewardFloor

# ----------------------------------------------------------------------------------------------------------------------
# Files
# ----------------------------------------------------------------------------------------------------------------------


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


# ----------------------------------------------------------------------------------------------------------------------
# Replay segments
# ----------------------------------------------------------------------------------------------------------------------

BOX = spaces.Box(-1.0, 1.0, (3,))
DICT = spaces.Dict({"a": BOX, "b": spaces.Box(0, 255, (2, 2), np.uint8)})


def filled(class_, space, size, n_envs, **kwargs):
    buffer = class_(size * n_envs, space, BOX, device="cpu", n_envs=n_envs, **kwargs)
    rng = np.random.default_rng(0)

    def observation():
        one = {key: rng.uniform(0, 99, (n_envs, *s.shape)) for key, s in (DICT if space is DICT else {"": BOX}).items()}
        return one if space is DICT else one[""]

    def add(n):
        for _ in range(n):
            done = rng.random(n_envs) < 0.2
            infos = [{"TimeLimit.truncated": bool(truncated)} for truncated in done & (rng.random(n_envs) < 0.5)]
            buffer.add(observation(), observation(), rng.uniform(-1, 1, (n_envs, 3)), rng.normal(size=n_envs), done, infos)

    return buffer, add


@pytest.mark.parametrize("small", [0, 10**3, 10**6])
@pytest.mark.parametrize("n_envs", [1, 3])
@pytest.mark.parametrize("class_, space", [(ReplayBuffer, BOX), (NStepReplayBuffer, BOX), (DictReplayBuffer, DICT)])
def test_segments_hold_the_buffer(tmp_path, monkeypatch, class_, space, n_envs, small):
    """Whatever is added between two savings: nothing, a bit, to the end of the ring and around it, all of it and more."""
    monkeypatch.setattr(ReplaySegments, "small", small)
    kwargs = {"n_steps": 3, "gamma": 0.9} if class_ is NStepReplayBuffer else {}
    buffer, add = filled(class_, space, 20, n_envs, **kwargs)
    segments, rows, needed = ReplaySegments(tmp_path), 0, []
    for new in (0, 1, 7, 0, 12, 1, 5, 20, 3, 47, 19):
        add(new)
        rows += new
        needed = segments.save(buffer, rows)
        copy, _ = filled(class_, space, 20, n_envs, **kwargs)
        ReplaySegments(tmp_path, needed).load(copy)
        n = buffer.size()
        for name in ("observations", "next_observations", "actions", "rewards", "dones", "timeouts"):
            a, b = getattr(buffer, name), getattr(copy, name)
            a, b = ({k: v[:n] for k, v in x.items()} if isinstance(x, dict) else x[:n] for x in (a, b))
            assert difference(a, b) is None
    if small != 10**3:
        assert len(needed) == (1 if small else 2)  # 19 rows and what is left of 20


def test_frequent_checkpoints_do_not_leave_many_files(tmp_path, monkeypatch):
    monkeypatch.setattr(ReplaySegments, "small", 2000)
    buffer, add = filled(ReplayBuffer, BOX, 1000, 1)  # 48 bytes per row: 41 rows in 2000 bytes
    segments, fsync = ReplaySegments(tmp_path), os.fsync
    for row in range(1, 301):
        add(1)
        if row % 7 == 0:  # a failure in between loses nothing
            monkeypatch.setattr(os, "fsync", lambda descriptor: (_ for _ in ()).throw(OSError("full")))
            with pytest.raises(OSError, match="full"):
                segments.save(buffer, row)
            monkeypatch.setattr(os, "fsync", fsync)
        needed = segments.save(buffer, row)
    assert len(needed) <= 300 // 41 + 1
    copy, _ = filled(ReplayBuffer, BOX, 1000, 1)
    ReplaySegments(tmp_path, needed).load(copy)
    assert difference(copy.observations[:300], buffer.observations[:300]) is None


def test_a_segment_holds_only_what_is_new(tmp_path, monkeypatch):
    monkeypatch.setattr(ReplaySegments, "small", 0)
    buffer, add = filled(ReplayBuffer, BOX, 5000, 1)
    segments, rows, sizes = ReplaySegments(tmp_path), 0, []
    for new in (1000, 100, 100, 2000, 100):
        add(new)
        rows += new
        sizes.append((tmp_path / segments.save(buffer, rows)[-1].file).stat().st_size)
    assert sizes[1] == pytest.approx(sizes[2], rel=0.01) == pytest.approx(sizes[4], rel=0.01)
    assert sizes[0] > 7 * sizes[1] and sizes[3] > 14 * sizes[1]


def test_sum_tree_is_pickled_without_what_is_empty():
    for n_leaves, n_used in ((1, 0), (1, 1), (5, 3), (1000, 400), (1024, 1024)):
        tree, rng = SumTree(n_leaves), np.random.default_rng(0)
        for _ in range(20):
            if n_used:
                leaves = rng.integers(0, n_used, 50)
                tree.set(leaves, rng.random(50))
        copy = pickle.loads(pickle.dumps(tree))
        assert vars(copy).keys() == vars(tree).keys()
        assert copy.nodes.tobytes() == tree.nodes.tobytes() and copy.n_leaves == tree.n_leaves
    assert len(pickle.dumps(SumTree(10**6))) < 300


# ----------------------------------------------------------------------------------------------------------------------
# Episodes
# ----------------------------------------------------------------------------------------------------------------------


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


class GlobalRandomEnv(gym.Env):
    """Draws from numpy's global generator, whose state at the episode's start nobody knows."""

    observation_space = BOX
    action_space = BOX

    def __init__(self, where):
        self.where = where

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.n = 0
        return self._draw("observation"), {}

    def _draw(self, what):
        return np.random.uniform(-1, 1, 3).astype(np.float32) if what == self.where else np.zeros(3, np.float32)

    def step(self, action):
        self.n += 1
        reward = float(self._draw("reward").sum())
        ends = self.where == "end" and self.n == 3
        return self._draw("observation"), reward, bool(ends), False, {}


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


# ----------------------------------------------------------------------------------------------------------------------
# The callback
# ----------------------------------------------------------------------------------------------------------------------


class Stop(Exception):
    pass


class SameStart(gym.Wrapper):
    def reset(self, *, seed=None, options=None):
        return super().reset(seed=0, options=options)


class StopAt(EvalCallback):
    """Something that counts and collects, and dies at a step."""

    def __init__(self, at, **kwargs):
        super().__init__(Monitor(SameStart(gym.make("Pendulum-v1", max_episode_steps=9))), eval_freq=20, verbose=0, **kwargs)
        self.at = at

    def _on_step(self):
        if self.num_timesteps == self.at:
            raise Stop
        return super()._on_step()


def learn(model, folder, steps, at=0, checkpoint=None, save_freq=30, evaluate=True, **kwargs):
    """Train with checkpoints; ``at``: die at that step."""
    record_episodes(model.env)
    stop = StopAt(at, log_path=str(folder)) if evaluate else StopAt(at)
    if not evaluate:
        stop.eval_freq = 0
    exact = ExactCheckpoints(folder / "checkpoints", save_freq, callbacks=[stop], checkpoint=checkpoint, **kwargs)
    try:
        model.learn(steps, callback=[stop, exact])
        assert exact.finished and exact.save(rollout_follows=False)
    except Stop:
        assert not exact.finished
    return stop


def compared(tmp_path, make, steps=110, at=100, **kwargs):
    whole, part = tmp_path / "whole", tmp_path / "part"
    expected = learn(make(), whole, steps, **kwargs)
    learn(make(), part, steps, at=at, **kwargs)
    checkpoint = newest_checkpoint(part / "checkpoints")
    assert checkpoint.steps == 90
    resumed = learn(make(), part, steps, checkpoint=checkpoint, **kwargs)
    assert resumed.evaluations_results == expected.evaluations_results
    assert_same_results(whole, part)


def test_our_algorithms(tmp_path, make):
    compared(tmp_path, make)


def test_prioritised(tmp_path, make):
    from sb3_symphony.common.buffers import PrioritizedReplayBuffer

    compared(tmp_path, lambda: make(replay_buffer_class=PrioritizedReplayBuffer, buffer_size=40))


@pytest.mark.parametrize("n_envs", [1, 2])
@pytest.mark.parametrize("copy_info_dict", [False, True])
def test_hindsight(tmp_path, small, n_envs, copy_info_dict):
    def make():
        env = make_vec_env(lambda: BitFlippingEnv(n_bits=4, continuous=True, max_steps=8), n_envs=n_envs)
        replay = dict(n_sampled_goal=2, copy_info_dict=copy_info_dict)
        kwargs = dict(replay_buffer_class=HerReplayBuffer, replay_buffer_kwargs=replay, buffer_size=60)
        return small(REDQ, env, policy="MultiInputPolicy", **kwargs)

    compared(tmp_path, make, evaluate=False)


def test_dict_observations(tmp_path, small):
    def make():
        env = make_vec_env(lambda: BitFlippingEnv(n_bits=4, continuous=True, max_steps=8))
        return small(Symphony, env, policy="MultiInputPolicy", buffer_size=50)

    compared(tmp_path, make, evaluate=False)


def test_checkpoints_are_kept_and_deleted(tmp_path, monkeypatch, small, pendulum):
    monkeypatch.setattr(ReplaySegments, "small", 0)
    model = small(Symphony, pendulum(), buffer_size=50)
    learn(model, tmp_path, 200, keep=3)
    folder = tmp_path / "checkpoints"
    assert sorted(int(path.stem[-9:]) for path in folder.glob("*.ckpt")) == [150, 180, 200]
    needed = set()
    for path in folder.glob("*.ckpt"):
        alone = tmp_path / path.stem
        alone.mkdir()
        os.link(path, alone / path.name)
        with pytest.raises(DamagedCheckpoint, match="segment: No such file"):
            newest_checkpoint(alone)
        for segment in folder.glob("*.segment"):
            os.link(segment, alone / segment.name)
        needed |= {segment.file for segment in newest_checkpoint(alone).state["segments"]}
    assert {path.name for path in folder.glob("*.segment")} == needed
    assert min(int(name.split("_")[2].split(".")[0]) for name in needed) == 120  # 150 - 50 and less is in none


def test_no_checkpoint_is_no_error(tmp_path):
    assert newest_checkpoint(tmp_path / "nowhere") is None
    assert newest_checkpoint(tmp_path) is None


@pytest.mark.parametrize("arguments", [{"save_freq": 0}, {"keep": 0}, {"save_freq": 1.5}])
def test_bad_arguments(tmp_path, arguments):
    with pytest.raises((ValueError, TypeError), match=next(iter(arguments))):
        ExactCheckpoints(tmp_path, **{"save_freq": 10, **arguments})


def test_what_cannot_be_recorded():
    with pytest.raises(TypeError, match="expected a DummyVecEnv of environments with a Monitor"):
        record_episodes(DummyVecEnv([lambda: gym.make("Pendulum-v1")]))


@pytest.mark.parametrize("buffer_size", [1000, 60, 45])
def test_buffer_that_was_not_empty(tmp_path, small, pendulum, buffer_size):
    compared(tmp_path, lambda: small(REDQ, pendulum(), buffer_size=buffer_size).learn(45))


def fresh(tmp_path, make, steps, at, capsys):
    """Resume where episodes cannot be replayed; returns the model."""
    model = make()
    stop = StopAt(at)
    stop.eval_freq = 0
    with pytest.raises(Stop):
        model.learn(steps, callback=[stop, ExactCheckpoints(tmp_path, 30)])
    model = make()
    exact = ExactCheckpoints(tmp_path, 30, checkpoint=newest_checkpoint(tmp_path))
    model.learn(steps, callback=exact)
    assert "resumed at 90 steps with fresh episodes, hence not bit for bit" in capsys.readouterr().out
    assert model.num_timesteps >= steps
    return model


def in_processes(recorded):
    def one(index):
        env = gym.make("Pendulum-v1", max_episode_steps=20 + index)
        return RecordedEpisode(Monitor(env)) if recorded else Monitor(env)

    env = SubprocVecEnv([partial(one, index) for index in range(2)])
    env.seed(0)
    return PPO("MlpPolicy", env, n_steps=15, batch_size=30, policy_kwargs=dict(net_arch=[8]), seed=0)


def test_environments_in_other_processes(tmp_path, monkeypatch):
    monkeypatch.setattr("test_checkpoint.record_episodes", lambda env: None)
    compared(tmp_path, partial(in_processes, recorded=True), steps=150, at=110, evaluate=False)


def test_environments_that_are_not_recorded_get_fresh_episodes(tmp_path, capsys):
    fresh(tmp_path, partial(in_processes, recorded=False), 150, 110, capsys).env.close()


@pytest.mark.parametrize("n_steps, optimize", [(1, False), (3, False), (1, True)])
def test_fresh_episodes_are_marked_in_the_replay(tmp_path, capsys, n_steps, optimize):
    """n-step returns, and the saving of next observations, must not reach across the gap; also after another resume."""

    def make():
        env = make_vec_env(lambda: Monitor(GlobalRandomEnv("observation")))
        replay = dict(handle_timeout_termination=False) if optimize else {}
        kwargs = dict(policy_kwargs=dict(net_arch=[8]), learning_starts=20, batch_size=8, buffer_size=500, seed=0)
        kwargs.update(n_steps=n_steps, optimize_memory_usage=optimize, replay_buffer_kwargs=replay)
        return SAC("MlpPolicy", env, **kwargs)

    buffer = fresh(tmp_path, make, 130, 110, capsys).replay_buffer
    marked = n_steps > 1 or optimize
    assert buffer.dones[:130].flatten().nonzero()[0].tolist() == ([89] if marked else [])
    if not optimize:
        assert buffer.timeouts[:130].flatten().nonzero()[0].tolist() == ([89] if marked else [])
        assert not (buffer.next_observations[89] == buffer.observations[90]).all()
    again = make()
    again.learn(150, callback=ExactCheckpoints(tmp_path, 30, checkpoint=newest_checkpoint(tmp_path)))
    assert again.replay_buffer.dones[89].all() == marked
    assert difference(again.replay_buffer.actions[:120], buffer.actions[:120]) is None


def test_state_of_callbacks(tmp_path, small, pendulum):
    stop = learn(small(REDQ, pendulum()), tmp_path, 70)
    state = newest_checkpoint(tmp_path / "checkpoints").state["callbacks"]["StopAt"]
    assert state["n_calls"] == 70 and state["evaluations_timesteps"] == [20, 40, 60]
    assert state["best_mean_reward"] == stop.best_mean_reward
    assert not state.keys() & {"eval_freq", "log_path", "verbose", "model", "eval_env"}  # settings, and what is no value
