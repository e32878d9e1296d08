"""Callbacks, logged keys and their values, and what ends bootstrapping."""

import copy
from contextlib import nullcontext
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.callbacks import (
    BaseCallback,
    CheckpointCallback,
    EvalCallback,
    EveryNTimesteps,
    StopTrainingOnMaxEpisodes,
    StopTrainingOnRewardThreshold,
)
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.logger import configure
from stable_baselines3.common.noise import NormalActionNoise
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from sb3_symphony import REDQ, DroQ, Symphony
from sb3_symphony.common.buffers import FadingReplayBuffer, PrioritizedReplayBuffer
from sb3_symphony.common.noise import DecayingNormalActionNoise, StickyActionNoise

TIME = {"time/episodes", "time/fps", "time/time_elapsed", "time/total_timesteps"}
ROLLOUT = {"rollout/ep_rew_mean", "rollout/ep_len_mean"}
TRAIN = {f"train/{key}" for key in ("learning_rate", "n_updates", "actor_loss", "critic_loss")}
OURS = {f"train/{key}" for key in ("q_mean", "q_std", "target_q_mean", "update_ratio", "noise_std")}
OWN = {
    Symphony: {"train/actor_value", "train/advantage", "train/batch_size"},
    REDQ: {"train/ent_coef", "train/ent_coef_loss"},
    DroQ: {"train/ent_coef", "train/ent_coef_loss"},
}
NOT_IN_TENSORBOARD = {"time/episodes", "time/time_elapsed", "time/total_timesteps", "train/n_updates"}


class Record(BaseCallback):
    """What the updates of each rollout logged."""

    def _on_training_start(self) -> None:
        self.values: list[dict[str, Any]] = []

    def _on_rollout_start(self) -> None:
        if "train/update_ratio" in self.logger.name_to_value:
            self.values.append(dict(self.logger.name_to_value))

    def _on_step(self) -> bool:
        return True


def no_extra_updates(algorithm: Any) -> dict[str, Any]:
    return dict(initial_gradient_steps=(0, 0), episode_gradient_steps=0) if algorithm is Symphony else {}


# ---------------------------------------------------------------- logger


def test_keys(make, algorithm, tmp_path):
    model = make()
    model.set_logger(configure(str(tmp_path), ["csv"]))
    model.learn(100, log_interval=1)
    (header, *rows) = (tmp_path / "progress.csv").read_text().splitlines()
    assert set(header.split(",")) == TIME | ROLLOUT | TRAIN | OURS | OWN[algorithm]
    assert len(rows) == 4  # one per episode
    for key, value in zip(header.split(","), rows[-1].split(","), strict=True):
        assert np.isfinite(float(value)), key


def test_tensorboard(make, algorithm, tmp_path):
    make(tensorboard_log=str(tmp_path)).learn(100, log_interval=1)
    events = EventAccumulator(str(tmp_path / f"{algorithm.__name__}_1"))
    events.Reload()
    tags = set(events.Tags()["scalars"])
    assert tags == (TIME | ROLLOUT | TRAIN | OURS | OWN[algorithm]) - NOT_IN_TENSORBOARD
    assert [event.step for event in events.Scalars("train/critic_loss")] == [25, 50, 75, 100]
    assert all(np.isfinite(event.value) for tag in tags for event in events.Scalars(tag))


def test_tensorboard_folders(make, tmp_path):
    model = make(tensorboard_log=str(tmp_path))
    model.learn(30, tb_log_name="a")
    model.learn(30, tb_log_name="a", reset_num_timesteps=False)
    model.learn(30, tb_log_name="a")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a_1", "a_2"]


def test_no_log_interval(make, tmp_path):
    model = make()
    model.set_logger(configure(str(tmp_path), ["csv"]))
    model.learn(100, log_interval=None)
    assert (tmp_path / "progress.csv").read_text() == ""
    assert model.logger.name_to_value.keys() >= TRAIN | OURS


@pytest.mark.parametrize("log_interval, dumps", [(1, 4), (2, 2), (100, 0)])
def test_log_interval_counts_episodes(make, tmp_path, log_interval, dumps):
    model = make()
    model.set_logger(configure(str(tmp_path), ["csv"]))
    model.learn(100, log_interval=log_interval)
    lines = (tmp_path / "progress.csv").read_text().splitlines()
    assert max(0, len(lines) - 1) == dumps


def test_logged_values(make):
    """The mean over the updates of one call, and finite."""
    model = make(gradient_steps=3, policy_delay=1)
    losses = []
    model.learn(30)
    fit = model._regression.fit

    def spy(*args: Any) -> Any:
        result = fit(*args)
        losses.append((result.loss.item(), result.q_values.mean().item(), args[2].mean().item()))
        return result

    model._regression.fit = spy
    model.train(gradient_steps=5, batch_size=16)
    logged = model.logger.name_to_value
    for index, key in enumerate(("critic_loss", "q_mean", "target_q_mean")):
        assert logged[f"train/{key}"] == pytest.approx(np.mean([each[index] for each in losses]), rel=1e-5)
    assert len(losses) == 5 and logged["train/n_updates"] == model._n_updates


def test_no_update_is_no_error(make):
    """As SB3's own take it."""
    model = make().learn(60)
    n_updates = model._n_updates
    model.train(0, 16)
    assert model._n_updates == n_updates


def test_no_actor_loss_without_actor_update(make):
    """The key appears with the first update of the actor, as in TD3."""
    record = Record()
    make(policy_delay=1000).learn(60, callback=record, log_interval=None)
    assert all("train/actor_loss" not in values and "train/critic_loss" in values for values in record.values)


@pytest.mark.parametrize("n_envs", [1, 2, 3])
@pytest.mark.parametrize("train_freq, gradient_steps, ratio", [(1, 1, 1.0), (1, 6, 6.0), (4, 6, 1.5), (2, -1, None)])
def test_update_ratio(make, algorithm, n_envs, train_freq, gradient_steps, ratio):
    """Updates per transition since the log was written. The first call after the warm-up is not typical."""
    record = Record()
    model = make(n_envs=n_envs, train_freq=train_freq, gradient_steps=gradient_steps, **no_extra_updates(algorithm))
    model.learn(48, log_interval=None)
    model.dump_logs()
    model.learn(60, callback=record, log_interval=None, reset_num_timesteps=False)
    expected = 1.0 if ratio is None else ratio / n_envs
    assert len(record.values) > 3
    assert [values["train/update_ratio"] for values in record.values] == pytest.approx([expected] * len(record.values))


def test_update_ratio_counts_all_updates(small, tmp_path):
    """Each line of the log those since the line before: 25 calls, one of them at an episode's start."""
    model = small(Symphony, initial_gradient_steps=(0, 0), episode_gradient_steps=7)
    model.set_logger(configure(str(tmp_path), ["csv"]))
    model.learn(100, log_interval=1)
    header, *rows = (line.split(",") for line in (tmp_path / "progress.csv").read_text().splitlines())
    ratios, updates = ([float(row[header.index(f"train/{key}")]) for row in rows] for key in ("update_ratio", "n_updates"))
    assert ratios == pytest.approx([1.0, 32 / 25, 32 / 25, 32 / 25])
    assert np.diff(updates).tolist() == [32, 32, 32]


def test_update_ratio_of_a_long_call(make):
    """On what is in the buffer already. Values are those of the latest 1 000 updates, the ratio counts all."""
    model = make().learn(40, log_interval=None)
    model.dump_logs()
    model.train(gradient_steps=1100, batch_size=4)
    assert model.logger.name_to_value["train/update_ratio"] == 1100


def test_update_ratio_after_a_second_learn(make, algorithm):
    """The count of steps restarts, the ratio stays positive and right."""
    model = make(**no_extra_updates(algorithm)).learn(60)
    record = Record()
    model.learn(60, callback=record, log_interval=None)
    ratios = [values["train/update_ratio"] for values in record.values]
    assert all(ratio > 0 for ratio in ratios) and ratios[-1] == 1.0


def test_update_ratio_of_a_second_training_as_long_as_the_first(make, algorithm):
    """Its first updates come when the count is what it was at the latest ones of the first."""
    model = make(train_freq=50, gradient_steps=5, **no_extra_updates(algorithm))
    for _ in range(2):
        model.learn(50, log_interval=None)
        assert model.logger.name_to_value["train/update_ratio"] == pytest.approx(5 / (50 - model.learning_starts))
        model.dump_logs()


@pytest.mark.parametrize("n_envs", [1, 2])
@pytest.mark.parametrize(
    "noise, expected",
    [
        (None, 0.0),
        (NormalActionNoise(np.zeros(1), 0.2 * np.ones(1)), 0.2),
        (DecayingNormalActionNoise(1, sigma=0.4, decay_steps=100, decay="linear"), 0.16),
        (StickyActionNoise(1, sigma=0.3, decay="constant", episode_scale=(0, 1), independent=0.2), (0.03 + 0.04) ** 0.5),
    ],
    ids=str,
)
def test_noise_std_of_symphony(small, noise, expected, n_envs):
    model = small(Symphony, action_noise=copy.deepcopy(noise), n_envs=n_envs)
    model.learn(60, log_interval=None)
    assert model.logger.name_to_value["train/noise_std"] == pytest.approx(expected)


def test_noise_std_of_a_stochastic_actor(small):
    model = small(REDQ, policy_kwargs=dict(net_arch=[]))
    model.actor.log_std.weight.data.zero_()
    model.actor.log_std.bias.data.fill_(np.log(0.3))
    model.learn(21, log_interval=None)
    assert model.logger.name_to_value["train/noise_std"] == pytest.approx(0.3, rel=0.02)


def test_gsde_logs_std(small, tmp_path):
    model = small(REDQ, use_sde=True)
    model.set_logger(configure(str(tmp_path), ["csv"]))
    model.learn(60, log_interval=1)
    assert "train/std" in (tmp_path / "progress.csv").read_text().splitlines()[0].split(",")


@pytest.mark.parametrize("stats_window_size", [1, 3])
def test_stats_window_size(make, stats_window_size):
    model = make(stats_window_size=stats_window_size)
    model.learn(130)
    assert model.ep_info_buffer.maxlen == stats_window_size and len(model.ep_info_buffer) == stats_window_size


# ---------------------------------------------------------------- callbacks


def test_callbacks(make, algorithm, pendulum, tmp_path):
    evaluation = EvalCallback(
        pendulum(),
        callback_on_new_best=StopTrainingOnRewardThreshold(reward_threshold=1e9),
        eval_freq=30,
        n_eval_episodes=2,
        best_model_save_path=str(tmp_path),
        log_path=str(tmp_path),
        verbose=0,
    )
    checkpoints = CheckpointCallback(40, str(tmp_path), save_replay_buffer=True)
    every = EveryNTimesteps(25, Record())
    make().learn(100, callback=[evaluation, checkpoints, every])
    assert list(np.load(tmp_path / "evaluations.npz")["timesteps"]) == [30, 60, 90]
    assert algorithm.load(tmp_path / "best_model").num_timesteps in (30, 60, 90)
    loaded = algorithm.load(tmp_path / "rl_model_80_steps", env=pendulum())
    loaded.load_replay_buffer(tmp_path / "rl_model_replay_buffer_80_steps.pkl")
    loaded.learn(20, reset_num_timesteps=False)
    assert loaded.num_timesteps == 100


def test_training_may_be_stopped(make, pendulum):
    model = make()
    model.learn(200, callback=lambda locals_, globals_: model.num_timesteps < 47)
    assert model.num_timesteps == 47
    model = make()
    stop = StopTrainingOnRewardThreshold(reward_threshold=-1e9)
    model.learn(200, callback=EvalCallback(pendulum(), callback_on_new_best=stop, eval_freq=30, verbose=0))
    assert model.num_timesteps == 30
    model = make(n_envs=2)
    model.learn(1000, callback=StopTrainingOnMaxEpisodes(max_episodes=2))
    assert model.num_timesteps == 100


@pytest.mark.parametrize("raises", [False, True])
@pytest.mark.parametrize("n_steps, last", [(1, 47), (1, 50), (3, 47), (3, 50)])
def test_learning_after_a_stop(make, n_steps, last, raises):
    """The step that the callback stopped at is not stored: what follows it is a new episode, not the same one's next step."""
    model = make(n_steps=n_steps, gamma=0.5, gradient_steps=0)  # episodes of 25 steps

    def stop(locals_, globals_):
        if raises and model.num_timesteps == last:
            raise KeyboardInterrupt
        return model.num_timesteps < last

    with pytest.raises(KeyboardInterrupt) if raises else nullcontext():
        model.learn(200, callback=stop)
    model.learn(20, reset_num_timesteps=False)
    buffer = model.replay_buffer
    assert buffer.pos == last - 1 + 20
    rewards = buffer.rewards[: buffer.pos, 0]
    before = buffer._get_samples(np.arange(last - 4, last - 1))
    expected = [
        sum(0.5**k * reward for k, reward in enumerate(rewards[i : min(i + n_steps, last - 1)]))
        for i in range(last - 4, last - 1)
    ]
    assert before.rewards.flatten().tolist() == pytest.approx(expected)
    assert before.dones.sum() == 0  # they bootstrap
    continuous = [np.array_equal(buffer.next_observations[i], buffer.observations[i + 1]) for i in range(25, buffer.pos - 1)]
    assert continuous == [i != last - 2 for i in range(25, buffer.pos - 1)]


def test_progress_bar(make):
    make().learn(40, progress_bar=True)


# ---------------------------------------------------------------- termination and truncation


class Constant(gym.Env):
    """Reward 1, whatever is done. Every step ends the episode: by termination or by a time limit."""

    observation_space = spaces.Box(-1, 1, (1,))
    action_space = spaces.Box(-1, 1, (1,))

    def __init__(self, terminates: bool, length: int = 1) -> None:
        self.terminates, self.length, self.steps = terminates, length, 0

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[np.ndarray, dict]:
        super().reset(seed=seed)
        self.steps = 0
        return np.ones(1, np.float32), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        self.steps += 1
        ends = self.steps >= self.length
        return np.ones(1, np.float32), 1.0, self.terminates and ends, not self.terminates and ends, {}


@pytest.mark.parametrize("n_envs", [1, 2])
@pytest.mark.parametrize("replay_buffer_class", [None, FadingReplayBuffer, PrioritizedReplayBuffer])
@pytest.mark.parametrize("n_steps", [1, 3])
@pytest.mark.parametrize("terminates", [True, False])
def test_time_limits_do_not_end_bootstrapping(make, algorithm, n_envs, replay_buffer_class, n_steps, terminates):
    """The target of every transition, with a target critic that says 10 everywhere."""
    env = make_vec_env(lambda: Constant(terminates), n_envs=n_envs)
    extra = dict(action_noise=None) if algorithm is Symphony else dict(ent_coef=0.0)
    model = make(env, replay_buffer_class=replay_buffer_class, n_steps=n_steps, gamma=0.8, **extra).learn(40)
    samples = model.replay_buffer.sample(50)
    assert (samples.dones == (1.0 if terminates else 0.0)).all()

    for parameter in model.critic_target.parameters():
        parameter.data.zero_()
    model.critic_target.q_networks.layers[-1].bias.data.fill_(10.0)
    targets = []
    fit = model._regression.fit
    model._regression.fit = lambda obs, actions, target, *args: (targets.append(target), fit(obs, actions, target, *args))[1]
    model.train(gradient_steps=1, batch_size=16)
    expected = 1.0 if terminates else 1.0 + 0.8 * 10.0
    np.testing.assert_allclose(targets[0].numpy(), expected, rtol=1e-6)


@pytest.mark.parametrize("terminates, value", [(True, 1.0), (False, 5.0)])
def test_learned_value(make, algorithm, terminates, value):
    """r / (1 - gamma) where time limits end the episodes, r where termination does. The actor stays what has acted."""
    extra = dict(action_noise=None, critic_learning_rate=3e-3) if algorithm is Symphony else dict(ent_coef=0.0)
    env = make_vec_env(lambda: Constant(terminates))
    policy_kwargs = dict(dropout_rate=0.0)
    extra.update(gamma=0.8, tau=0.05, learning_rate=3e-3, policy_delay=1_000_000)
    model = make(env, policy_kwargs=policy_kwargs, **extra).learn(40)
    model.train(gradient_steps=800, batch_size=16)
    samples = model.replay_buffer.sample(100)
    with th.no_grad():
        learned = model.critic(samples.observations, samples.actions)
    assert learned.mean().item() == pytest.approx(value, rel=0.05)


def test_n_step_returns_stop_at_the_end_of_an_episode(make, algorithm):
    """Episodes of 2 steps, horizon 3: 1 + gamma or 1 if they terminate, plus the discounted bootstrap if truncated."""
    extra = dict(action_noise=None) if algorithm is Symphony else dict(ent_coef=0.0)
    for terminates, expected in ((True, {1.0, 1.8}), (False, {1.0 + 0.8 * 10, 1.8 + 0.64 * 10})):
        env = make_vec_env(lambda t=terminates: Constant(t, length=2))
        model = make(env, n_steps=3, gamma=0.8, **extra).learn(40)
        for parameter in model.critic_target.parameters():
            parameter.data.zero_()
        model.critic_target.q_networks.layers[-1].bias.data.fill_(10.0)
        targets = []
        fit = model._regression.fit
        model._regression.fit = lambda o, a, target, *args, fit=fit, t=targets: (t.append(target), fit(o, a, target, *args))[1]
        model.train(gradient_steps=1, batch_size=64)
        assert {round(each, 4) for each in targets[0].flatten().tolist()} == {round(each, 4) for each in expected}
