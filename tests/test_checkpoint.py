"""Checkpoints below the command line: the callback with any algorithm."""

import os
from functools import partial

import gymnasium as gym
import pytest
from resume_helpers import GlobalRandomEnv, assert_same_results, difference
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.callbacks import BaseCallback, EvalCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.envs import BitFlippingEnv
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecMonitor
from stable_baselines3.her import HerReplayBuffer

from sb3_symphony import REDQ, Symphony
from sb3_symphony.common.buffers import FadingReplayBuffer, PrioritizedReplayBuffer
from sb3_symphony.common.checkpoint import ExactCheckpoints, checkpoint_files, newest_checkpoint
from sb3_symphony.common.files import DamagedFile
from sb3_symphony.common.recording import RecordedEpisode, record_episodes
from sb3_symphony.common.replay_files import ReplaySegments


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
    compared(tmp_path, lambda: make(replay_buffer_class=PrioritizedReplayBuffer, buffer_size=40))


@pytest.mark.parametrize("buffer_size", [500, 40])
def test_share_of_episodes_first_steps(tmp_path, make, buffer_size):
    replay = dict(start_share=0.3, start_steps=5)
    compared(
        tmp_path, partial(make, replay_buffer_class=FadingReplayBuffer, replay_buffer_kwargs=replay, buffer_size=buffer_size)
    )


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
        with pytest.raises(DamagedFile, match="segment: No such file"):
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


@pytest.mark.parametrize("buffer_size", [1000, 60, 45, 30])
def test_buffer_that_was_not_empty(tmp_path, small, pendulum, buffer_size):
    compared(tmp_path, lambda: small(REDQ, pendulum(), buffer_size=buffer_size).learn(45))


def test_a_training_that_begins_anew(tmp_path, small, pendulum):
    """Its reset ends the episode that was under way at the latest checkpoint."""
    model = small(REDQ, pendulum())
    record_episodes(model.env)
    exact = ExactCheckpoints(tmp_path, 30)
    exact.segments.small = 0  # write none of them again
    for _ in range(2):
        model.learn(40, callback=exact)
        assert exact.save(rollout_follows=False)
    stored, there = small(REDQ, pendulum()).replay_buffer, model.replay_buffer
    ReplaySegments(tmp_path, newest_checkpoint(tmp_path).state["segments"]).load(stored)
    assert there.timeouts[39] and not there.timeouts[79]
    for name in ("observations", "dones", "timeouts"):
        assert (getattr(stored, name) == getattr(there, name)).all()


@pytest.mark.parametrize("buffer_size", [1000, 60])
def test_a_training_that_goes_on(tmp_path, small, pendulum, buffer_size):
    """A second training with checkpoints, and a third one with the same callback; the count goes on."""
    model = small(REDQ, pendulum(), buffer_size=buffer_size).learn(45)
    record_episodes(model.env)
    exact = ExactCheckpoints(tmp_path, 30)
    for steps in (40, 40):
        model.learn(steps, reset_num_timesteps=False, callback=exact)
    resumed = small(REDQ, pendulum(), buffer_size=buffer_size)
    record_episodes(resumed.env)
    resumed.learn(125, callback=ExactCheckpoints(tmp_path, 30, checkpoint=newest_checkpoint(tmp_path)))
    for name in ("observations", "actions", "rewards"):
        stored, there = (getattr(each.replay_buffer, name) for each in (model, resumed))
        assert (stored == there).all()
    assert resumed.num_timesteps == model.num_timesteps == 125


@pytest.mark.parametrize("buffer_size, replaced", [(60, False), (400, True)])
def test_a_buffer_that_the_latest_checkpoint_does_not_know(tmp_path, small, pendulum, buffer_size, replaced):
    """It has wrapped more than twice since it was empty, or was loaded."""
    model = small(REDQ, pendulum(), buffer_size=buffer_size)
    record_episodes(model.env)
    exact = ExactCheckpoints(tmp_path, 30)
    exact.segments.small = 0  # write nothing again
    model.learn(125, callback=exact)
    if replaced:
        small(REDQ, pendulum(), buffer_size=buffer_size, seed=7).learn(200).save_replay_buffer(tmp_path / "other.pkl")
        model.load_replay_buffer(tmp_path / "other.pkl")
    model.learn(40, reset_num_timesteps=False, callback=exact)
    assert exact.save(rollout_follows=False)
    stored, there = small(REDQ, pendulum(), buffer_size=buffer_size).replay_buffer, model.replay_buffer
    ReplaySegments(tmp_path, newest_checkpoint(tmp_path).state["segments"]).load(stored)
    for name in ("observations", "actions", "rewards", "dones", "timeouts"):
        assert (getattr(stored, name) == getattr(there, name)).all()


def test_checkpoints_of_a_count_that_restarts(tmp_path, small, pendulum):
    model = small(REDQ, pendulum())
    record_episodes(model.env)
    exact = ExactCheckpoints(tmp_path, 30, keep=5)
    model.learn(100, callback=exact)
    assert sorted(checkpoint_files(tmp_path)) == [30, 60, 90]
    model.learn(70, callback=exact)
    assert sorted(checkpoint_files(tmp_path)) == [30, 60]
    assert newest_checkpoint(tmp_path).state["segments"][-1].stop == 160


def test_returns_that_a_vec_monitor_adds_up(tmp_path, small, pendulum):
    def episodes(steps, checkpoint=None):
        model = small(REDQ, VecMonitor(pendulum()))
        record_episodes(model.env)
        model.learn(steps, callback=ExactCheckpoints(tmp_path, 160, checkpoint=checkpoint))
        return [(episode["r"], episode["l"]) for episode in model.ep_info_buffer]

    assert len(episodes(165)) == 6
    resumed = episodes(230, newest_checkpoint(tmp_path))  # from the middle of an episode
    assert resumed == episodes(230) and len(resumed) == 9


def test_a_callback_may_change_the_exponent_of_weights(tmp_path, small, pendulum):
    class Rising(BaseCallback):
        def _on_step(self):
            self.model.replay_buffer.beta = min(1.0, 0.4 + self.num_timesteps / 200)
            return True

    def make():
        model = small(REDQ, pendulum(), replay_buffer_class=PrioritizedReplayBuffer)
        record_episodes(model.env)
        return model

    make().learn(70, callback=[Rising(), ExactCheckpoints(tmp_path, 60)])
    model = make()
    model.learn(62, callback=ExactCheckpoints(tmp_path, 60, checkpoint=newest_checkpoint(tmp_path)))
    assert model.replay_buffer.beta == 0.4 + 60 / 200


@pytest.mark.parametrize("algorithm", [REDQ, SAC])
def test_arguments_that_a_callback_has_changed(tmp_path, small, pendulum, algorithm):
    class Faster(BaseCallback):
        def _on_step(self):
            if self.num_timesteps == 40:
                self.model.gradient_steps = 3
            return True

    def learn(steps, checkpoint=None):
        model = small(REDQ, pendulum()) if algorithm is REDQ else SAC("MlpPolicy", pendulum(), learning_starts=20, seed=0)
        record_episodes(model.env)
        exact = ExactCheckpoints(tmp_path, 60, checkpoint=checkpoint)
        return model.learn(steps, callback=[Faster(), exact])

    expected = learn(100)
    learn(70)
    resumed = learn(100, newest_checkpoint(tmp_path))
    assert newest_checkpoint(tmp_path).state["arguments"] == {"gradient_steps": 3}
    assert resumed.gradient_steps == expected.gradient_steps == 3
    assert resumed._n_updates == expected._n_updates
    assert difference(resumed.get_parameters(), expected.get_parameters()) is None


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
    assert buffer.dones[:130].flatten().nonzero()[0].tolist() == [89]
    if not optimize:
        assert buffer.timeouts[:130].flatten().nonzero()[0].tolist() == [89]
        assert not (buffer.next_observations[89] == buffer.observations[90]).all()
    again = make()
    again.learn(150, callback=ExactCheckpoints(tmp_path, 30, checkpoint=newest_checkpoint(tmp_path)))
    assert again.replay_buffer.dones[89].all()
    assert difference(again.replay_buffer.actions[:120], buffer.actions[:120]) is None


def test_state_of_callbacks(tmp_path, small, pendulum):
    stop = learn(small(REDQ, pendulum()), tmp_path, 70)
    state = newest_checkpoint(tmp_path / "checkpoints").state["callbacks"]["StopAt"]
    assert state["n_calls"] == 70 and state["evaluations_timesteps"] == [20, 40, 60]
    assert state["best_mean_reward"] == stop.best_mean_reward
    assert not state.keys() & {"eval_freq", "log_path", "verbose", "model", "eval_env"}  # settings, and what is no value


class Every(BaseCallback):
    """Notes every n-th step."""

    def __init__(self, n):
        super().__init__()
        self.n = n
        self.seen = []

    def _on_step(self):
        if self.num_timesteps % self.n == 0:
            self.seen.append(self.num_timesteps)
        return True


def test_two_callbacks_of_a_class(tmp_path, small, pendulum):
    model = small(REDQ, pendulum())
    record_episodes(model.env)
    model.learn(
        60, callback=[first := Every(10), second := Every(25), ExactCheckpoints(tmp_path, 30, callbacks=[first, second])]
    )
    model = small(REDQ, pendulum())
    record_episodes(model.env)
    again = [Every(10), Every(25)]
    exact = ExactCheckpoints(tmp_path, 30, callbacks=again, checkpoint=newest_checkpoint(tmp_path))
    model.learn(100, callback=[*again, exact])
    assert [each.seen for each in again] == [list(range(10, 101, 10)), [25, 50, 75, 100]]
