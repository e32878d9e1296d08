"""Training and evaluation mode: dropout is active where it should be, and running statistics are those of the critic."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from torch import nn

from sb3_symphony import REDQ, DroQ, Symphony

DROPOUT = dict(policy_kwargs=dict(dropout_rate=0.5, layer_norm=True))


class BatchNormExtractor(BaseFeaturesExtractor):
    """Flatten and normalise over the batch."""

    def __init__(self, observation_space: gym.Space) -> None:
        super().__init__(observation_space, 3)
        self.norm = nn.BatchNorm1d(3)

    def forward(self, observations: th.Tensor) -> th.Tensor:
        return self.norm(observations.flatten(1))


BATCH_NORM = dict(policy_kwargs=dict(features_extractor_class=BatchNormExtractor))


def modes(model: Any) -> tuple[bool, bool, bool]:
    """Training mode of actor, critics and their targets: that of their dropout layers, where there are any."""

    def mode(module: nn.Module) -> bool:
        dropouts = {part.training for part in module.modules() if isinstance(part, nn.Dropout)}
        (result,) = dropouts or {module.training}
        return result

    return mode(model.actor), mode(model.critic), mode(model.critic_target)


class RecordModes(BaseCallback):
    def _on_training_start(self) -> None:
        self.during_rollout: set[Any] = set()
        self.during_update: set[Any] = set()
        fit = self.model._regression.fit

        def spy(*args: Any, **kwargs: Any) -> Any:
            self.during_update.add(modes(self.model))
            return fit(*args, **kwargs)

        self.model._regression.fit = spy

    def _on_step(self) -> bool:
        self.during_rollout.add(modes(self.model))
        return True


@pytest.mark.parametrize("critic_engine", ["fused", "autograd"])
@pytest.mark.parametrize("options, target", [(dict(dropout_rate=0.0), False), (dict(dropout_rate=0.3), True)])
def test_modes(make, critic_engine, options, target):
    model = make(policy_kwargs=dict(critic_engine=critic_engine, **options))
    record = RecordModes()
    model.learn(60, callback=record)
    assert record.during_update == {(True, True, target)}
    assert record.during_rollout == {(False, False, False)}


def test_target_is_in_evaluation_mode_from_the_start(make):
    model = make(**DROPOUT)
    assert not model.critic_target.training
    model.predict(np.zeros(3, dtype=np.float32))
    assert modes(model) == (False, False, False)


def test_droq_has_dropout_and_layer_norm_by_default(small):
    model = small(DroQ)
    assert model.policy.dropout_rate == 0.01 and model.policy.layer_norm is True
    assert any(isinstance(layer, nn.Dropout) for layer in model.critic_target.q_networks.layers)
    assert small(DroQ, policy_kwargs=dict(dropout_rate=0.2)).policy.layer_norm is True
    for cls in (REDQ, Symphony):
        assert not any(isinstance(layer, nn.Dropout) for layer in small(cls).critic.q_networks.layers)


def test_dropout_is_active_in_the_targets_only_while_training(make):
    """Two passes differ in training mode, in critics and targets alike, and agree in evaluation mode."""
    model = make(**DROPOUT)
    obs, actions = th.randn(64, 3), th.randn(64, 1)
    for critic in (model.critic, model.critic_target):
        model.policy.set_training_mode(True)
        assert not th.equal(critic(obs, actions), critic(obs, actions))
        model.policy.set_training_mode(False)
        assert th.equal(critic(obs, actions), critic(obs, actions))


def test_masks_of_the_critics_are_independent(small):
    """Critics with equal weights differ by their masks."""
    model = small(DroQ, policy_kwargs=dict(dropout_rate=0.5))
    for parameter in model.critic.parameters():
        parameter.data[1:] = parameter.data[:1]
    model.policy.set_training_mode(True)
    first, second = model.critic(th.randn(64, 3), th.randn(64, 1))
    assert not th.equal(first, second)


def test_predict_ignores_dropout_and_batch_statistics(make):
    model = make(policy_kwargs=dict(dropout_rate=0.5, **BATCH_NORM["policy_kwargs"])).learn(60)
    observations = np.random.default_rng(0).normal(size=(8, 3)).astype(np.float32)
    together, _ = model.predict(observations, deterministic=True)
    again, _ = model.predict(observations, deterministic=True)
    np.testing.assert_array_equal(together, again)
    alone = np.stack([model.predict(each, deterministic=True)[0] for each in observations])
    np.testing.assert_allclose(together, alone, rtol=1e-4, atol=1e-5)


# ---------------------------------------------------------------- running statistics


def statistics(module: nn.Module) -> th.Tensor:
    return th.cat([value.flatten().clone() for name, value in module.named_buffers() if "running_" in name])


@pytest.mark.parametrize("options", [dict(), dict(dropout_rate=0.3)], ids=str)
@pytest.mark.parametrize("tau", [0.0, 0.005])
def test_running_statistics_reach_the_target(make, options, tau):
    """They are copied, whatever tau is, and without a learning rate they are all that changes."""
    policy_kwargs = {**BATCH_NORM["policy_kwargs"], **options}
    model = make(learning_rate=0.0, tau=tau, policy_kwargs=policy_kwargs, learning_starts=0, policy_delay=1000)
    if isinstance(model, Symphony):
        model.critic_lr_schedule = lambda _: 0.0
    model.learn(30)
    before = statistics(model.actor), statistics(model.critic), statistics(model.critic_target)
    weights = th.nn.utils.parameters_to_vector(model.critic_target.parameters()).detach()
    model.train(gradient_steps=3, batch_size=16)
    assert not th.equal(statistics(model.actor), before[0])
    assert not th.equal(statistics(model.critic), before[1])
    assert not th.equal(statistics(model.critic_target), before[2])
    assert th.equal(statistics(model.critic_target), statistics(model.critic))
    th.testing.assert_close(th.nn.utils.parameters_to_vector(model.critic_target.parameters()).detach(), weights)


def test_rollouts_leave_running_statistics_alone(make):
    model = make(learning_starts=10_000, **BATCH_NORM)
    before = [statistics(module) for module in (model.actor, model.critic, model.critic_target)]
    model.learn(60)
    model.predict(np.ones((5, 3), dtype=np.float32))
    for module, old in zip((model.actor, model.critic, model.critic_target), before, strict=True):
        assert th.equal(statistics(module), old)


@pytest.mark.parametrize("dropout_rate", [0.0, 0.3])
def test_batch_norm_of_the_target_never_uses_batch_statistics(make, dropout_rate):
    """Dropout is what makes the target's mode differ from SB3's: its batch normalisation stays in evaluation mode."""
    model = make(policy_kwargs=dict(dropout_rate=dropout_rate, **BATCH_NORM["policy_kwargs"]))
    model.policy.set_training_mode(True)
    norms = [part for part in model.critic_target.modules() if isinstance(part, nn.BatchNorm1d)]
    assert norms and not any(part.training for part in norms)
    assert all(part.training for part in model.critic.modules() if isinstance(part, nn.BatchNorm1d))


@pytest.mark.parametrize("cls, policy_delay", [(REDQ, 5), (Symphony, 5), (DroQ, 1)])
def test_batch_norm_has_statistics_of_each_minibatch(small, cls, policy_delay):
    """Ten updates: as many passes for next actions, whose statistics those of SB3's actors are, too."""
    model = small(cls, policy_delay=policy_delay, gradient_steps=1, learning_starts=20, **BATCH_NORM).learn(20)
    before = model.actor.features_extractor.norm.num_batches_tracked.item()
    model.train(10, 16)
    passes = model.actor.features_extractor.norm.num_batches_tracked.item() - before
    initial = sum(model.initial_gradient_steps) if cls is Symphony else 0
    assert passes == (10 + initial) + (10 + initial) // policy_delay
