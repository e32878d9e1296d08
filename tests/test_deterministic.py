"""One seed, one result: bit for bit, on the CPU."""

from typing import Any

import numpy as np
import pytest
import torch as th
from stable_baselines3.common.callbacks import BaseCallback, EvalCallback
from stable_baselines3.common.noise import OrnsteinUhlenbeckActionNoise

from sb3_symphony import REDQ, DroQ, Symphony
from sb3_symphony.common.buffers import PrioritizedReplayBuffer
from sb3_symphony.common.noise import PinkActionNoise


class Record(BaseCallback):
    """Everything logged after each rollout, except what a clock says."""

    def _on_training_start(self) -> None:
        self.values: list[dict[str, Any]] = []

    def _on_step(self) -> bool:
        return True

    def _on_rollout_start(self) -> None:
        self.values.append({k: v for k, v in self.logger.name_to_value.items() if not k.startswith(("time/", "eval/"))})


def run(model: Any, steps: int = 90, callbacks: tuple = ()) -> tuple[th.Tensor, list[dict[str, Any]]]:
    record = Record()
    model.learn(steps, callback=[record, *callbacks], log_interval=None)
    assert record.values[-1]["train/n_updates"] > 10
    return th.nn.utils.parameters_to_vector(model.policy.parameters()).detach(), record.values


OPTIONS = {
    "plain": dict(),
    "three envs": dict(n_envs=3),
    "n_steps, autograd": dict(n_steps=3, policy_kwargs=dict(critic_engine="autograd")),
    "prioritised": dict(replay_buffer_class=PrioritizedReplayBuffer),
    "dropout": dict(policy_kwargs=dict(dropout_rate=0.2)),
    "rem": dict(target_mode="rem"),
    "pink": dict(action_noise=lambda: PinkActionNoise(1, block_steps=20)),
    "Ornstein-Uhlenbeck": dict(action_noise=lambda: OrnsteinUhlenbeckActionNoise(np.zeros(1), np.ones(1))),
}


@pytest.mark.parametrize("options", OPTIONS.values(), ids=OPTIONS)
def test_same_seed_same_result(make, options):
    def model() -> Any:
        return make(**{key: value() if key == "action_noise" else value for key, value in options.items()}, seed=3)

    first, logged_first = run(model())
    second, logged_second = run(model())
    assert th.equal(first, second)
    assert logged_first == logged_second


@pytest.mark.parametrize("cls", [REDQ, DroQ])
@pytest.mark.parametrize("options", [dict(use_sde=True, sde_sample_freq=4), dict(subset_size=1.5)], ids=str)
def test_same_seed_same_result_redq(small, cls, options):
    assert th.equal(run(small(cls, **options, seed=3))[0], run(small(cls, **options, seed=3))[0])


@pytest.mark.parametrize("warmup_policy", ["actor", "uniform"])
def test_same_seed_same_result_symphony(small, warmup_policy):
    options = dict(warmup_policy=warmup_policy, batch_size=None, seed=3)
    assert th.equal(run(small(Symphony, **options))[0], run(small(Symphony, **options))[0])


def test_other_seed_other_result(make):
    first, logged_first = run(make(seed=3))
    second, logged_second = run(make(seed=4))
    assert not th.equal(first, second)
    assert logged_first[-1]["train/critic_loss"] != logged_second[-1]["train/critic_loss"]


def test_initial_weights_follow_the_seed(make):
    def initial(seed: int) -> th.Tensor:
        return th.nn.utils.parameters_to_vector(make(seed=seed).policy.parameters()).detach()

    assert th.equal(initial(5), initial(5))
    assert not th.equal(initial(5), initial(6))


@pytest.mark.parametrize("n_envs", [1, 2])
def test_evaluation_changes_nothing(make, pendulum, n_envs):
    """Neither weights, nor what is logged, nor the exploration: during warm-up, too."""
    plain, logged_plain = run(make(n_envs=n_envs))
    evaluation = EvalCallback(pendulum(seed=9), eval_freq=7, n_eval_episodes=2, deterministic=True, verbose=0)
    evaluated, logged = run(make(n_envs=n_envs), callbacks=(evaluation,))
    assert evaluation.n_calls >= 45 and np.isfinite(evaluation.best_mean_reward)
    assert th.equal(plain, evaluated)
    last = logged_plain[-1]
    assert {key: logged[-1].get(key, last[key]) for key in last} == last


def test_logging_changes_nothing(make, tmp_path):
    first = run(make())[0]
    model = make(tensorboard_log=str(tmp_path), stats_window_size=5)
    model.learn(90, log_interval=1)
    assert th.equal(first, th.nn.utils.parameters_to_vector(model.policy.parameters()))


@pytest.mark.parametrize("gradient_steps", [1, 4])
def test_actor_is_independent_of_how_updates_are_drawn(make, gradient_steps, monkeypatch):
    """Drawing all minibatches of a call at once, or a few at a time, gives a model that trains either way."""
    import sb3_symphony.common.off_policy as module

    monkeypatch.setattr(module, "MAX_SAMPLE_BYTES", 1)
    model = make(gradient_steps=gradient_steps)
    parameters, values = run(model)
    assert th.isfinite(parameters).all() and np.isfinite(values[-1]["train/critic_loss"])
