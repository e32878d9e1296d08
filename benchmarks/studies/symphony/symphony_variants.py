"""
Later versions of Symphony by its original author (Ishuov, https://github.com/timurgepard/Simphony, February and March 2024):
the variance head of the second, the next-state term of 2.1, the saturated stem of the third. Names for ``algo``:
``symphony_variants.py:SymphonyV2`` and so on; the settings of each are in v2.yml, v2.1.yml and v3.yml.

The author's heads share their first layer; here each is a network of its own. The variance head is a single one.
"""

from collections.abc import Iterator
from typing import Any, ClassVar

import gymnasium as gym
import torch as th
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.preprocessing import get_flattened_obs_dim
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.type_aliases import ReplayBufferSamples, Schedule
from stable_baselines3.common.utils import polyak_update, update_learning_rate
from torch import nn

from sb3_symphony.common.ensembles import EnsembleCritic, combine
from sb3_symphony.common.layers import LeakySine
from sb3_symphony.common.losses import rehae, rehe
from sb3_symphony.common.off_policy import UpdateLogs
from sb3_symphony.symphony import Symphony
from sb3_symphony.symphony.policies import SymphonyPolicy

#: the author's factor of the variance, and of its discounted successor
SCALE = 3e-3


class VariancePolicy(SymphonyPolicy):
    """Adds a head that predicts the discounted variance of rewards, and its target."""

    variance: EnsembleCritic
    variance_target: EnsembleCritic

    def _build(self, lr_schedule: Schedule) -> None:
        super()._build(lr_schedule)
        self.variance, self.variance_target = self._make_variance(), self._make_variance()
        self.variance_target.load_state_dict(self.variance.state_dict())
        optimizer: Any = self.optimizer_class
        self.variance.optimizer = optimizer(self.variance.parameters(), lr=lr_schedule(1), **self.optimizer_kwargs)

    def _make_variance(self) -> EnsembleCritic:
        kwargs = {**self._update_features_extractor(self.critic_kwargs, None), **self._network_kwargs("qf"), "n_critics": 1}
        return EnsembleCritic(**kwargs).to(self.device)


class SymphonyV2(Symphony):
    """The second version: three critics and the variance head, which the actor's loss follows as it follows the critics."""

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"MlpPolicy": VariancePolicy}

    def _setup_model(self) -> None:
        super()._setup_model()
        if self.policy_delay != 1:
            raise ValueError(f"policy_delay={self.policy_delay}: expected 1, as the author's code has it")
        self.variance_baseline = th.zeros((), device=self.device)

    def train(self, gradient_steps: int, batch_size: int | None = None) -> None:
        update_learning_rate(self.policy.variance.optimizer, self.critic_lr_schedule(self._current_progress_remaining))
        super().train(gradient_steps, batch_size)

    def variance_of_target(self, batch: ReplayBufferSamples) -> th.Tensor:
        """
        :param batch: transitions
        :return: what the variance head learns, shape ``(batch, 1)``, without gradient
        """
        with th.no_grad():
            following = self.policy.variance_target(batch.next_observations, self.actor(batch.next_observations))[0]
            return SCALE * (SCALE * batch.rewards.var() + (1 - batch.dones) * self._discounts(batch) * following)

    def _update_actor(self, batch: ReplayBufferSamples, logs: UpdateLogs) -> None:
        variance: EnsembleCritic = self.policy.variance
        # As the critics: a step toward the target, then the target's own
        loss = rehe(self.variance_of_target(batch) - variance(batch.observations, batch.actions)).sum()
        variance.optimizer.zero_grad()
        loss.backward()
        variance.optimizer.step()
        polyak_update(variance.parameters(), self.policy.variance_target.parameters(), self.tau)

        terms = self.actor_terms(batch)
        actor_loss = -sum(rehae(values, baseline) for values, baseline in terms)
        self._step_actor(actor_loss)
        for (values, _), own in zip(terms[:2], (self.baseline, self.variance_baseline), strict=True):
            own.copy_(values.detach().mean())
        logs["actor_loss"].append(actor_loss.detach())
        logs["variance_loss"].append(loss.detach())

    def actor_terms(self, batch: ReplayBufferSamples) -> list[tuple[th.Tensor, th.Tensor]]:
        """
        :param batch: transitions
        :return: values that the actor is to raise, and what each is compared with; those of critics and variance come first
        """
        return self.values_at(batch.observations, self.baseline, self.variance_baseline)

    def values_at(
        self, observations: th.Tensor, baseline: th.Tensor, variance_baseline: th.Tensor
    ) -> list[tuple[th.Tensor, th.Tensor]]:
        """
        :param observations: where, shape ``(batch, ...)``
        :param baseline: what the mean value is compared with
        :param variance_baseline: what the mean of the variance head is compared with
        :return: the pairs of :meth:`actor_terms`
        """
        actions = self.actor(observations)
        q_values = combine(self.critic(observations, actions), self.target_mode, self.actor_mix)
        return [(q_values, baseline), (self.policy.variance(observations, actions)[0], variance_baseline)]

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        state_dicts, tensors = super()._get_torch_save_params()
        return [*state_dicts, "policy.variance.optimizer"], [*tensors, "variance_baseline"]


class MinMaxExtractor(BaseFeaturesExtractor):
    """
    Maps each number of an observation linearly to [-2, 2], by limits that are set once; a number that never changed to 0.

    :param observation_space: a Box of one axis
    """

    def __init__(self, observation_space: gym.Space) -> None:
        super().__init__(observation_space, features_dim=get_flattened_obs_dim(observation_space))
        self.register_buffer("low", th.full((self.features_dim,), -2.0))
        self.register_buffer("high", th.full((self.features_dim,), 2.0))

    def forward(self, observations: th.Tensor) -> th.Tensor:
        width = self.high - self.low
        scaled = 4 * (observations - self.low) / width.clamp(min=1e-9) - 2
        return th.where(width > 0, scaled, th.zeros_like(scaled))


class MinMaxPolicy(VariancePolicy):
    """:class:`VariancePolicy` whose networks see observations through :class:`MinMaxExtractor`."""

    default_features_extractor = MinMaxExtractor

    def set_limits(self, low: th.Tensor, high: th.Tensor) -> None:
        """
        :param low: smallest values seen, shape ``(observation,)``; rounded down to multiples of 0.1, and doubled
        :param high: largest values seen, likewise up
        """
        for part in (self.actor, self.critic, self.critic_target, self.variance, self.variance_target):
            part.features_extractor.low.copy_(2 * th.floor(10 * low) / 10)
            part.features_extractor.high.copy_(2 * th.ceil(10 * high) / 10)


class SaturatedStem(nn.Module):
    """2·tanh(x / 2), the third version's first activation."""

    def forward(self, x: th.Tensor) -> th.Tensor:
        return 2 * th.tanh(x / 2)


class V3Policy(MinMaxPolicy):
    """:class:`MinMaxPolicy` with the third version's stem."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **{"activation_fn": (SaturatedStem, LeakySine), "layer_norm": False, **kwargs})


class SymphonyV3(SymphonyV2):
    """The third version: observations scaled by what the warm-up saw, and a saturated stem; its disturbance is a setting."""

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"MlpPolicy": V3Policy}

    def train(self, gradient_steps: int, batch_size: int | None = None) -> None:
        if self._n_updates == 0:
            assert self.replay_buffer is not None
            # As the author has it: over the whole storage, with rows of zeros as long as it is not full
            stored = th.as_tensor(self.replay_buffer.observations[: self.replay_buffer.size()], dtype=th.float32)
            stored = stored.reshape(-1, stored.shape[-1])
            low, high = stored.amin(dim=0), stored.amax(dim=0)
            self.policy.set_limits(low.clamp(max=0).to(self.device), high.clamp(min=0).to(self.device))
        super().train(gradient_steps, batch_size)


class SymphonyV21(SymphonyV3):
    """Version 2.1: scaled observations, and the actor is also to raise the values of the next states."""

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"MlpPolicy": MinMaxPolicy}

    def _segments(
        self, gradient_steps: int, batch_size: int, **sample_kwargs: Any
    ) -> Iterator[tuple[ReplayBufferSamples, list[ReplayBufferSamples]]]:
        for segment, batches in super()._segments(gradient_steps, batch_size, **sample_kwargs):
            with th.no_grad():  # before the critics' step, by which the values are to be raised
                before = self.values_at(batches[-1].next_observations, self.baseline, self.variance_baseline)
                self._before = [values.mean() for values, _ in before]
            yield segment, batches

    def actor_terms(self, batch: ReplayBufferSamples) -> list[tuple[th.Tensor, th.Tensor]]:
        q_before, variance_before = self._before
        return [*super().actor_terms(batch), *self.values_at(batch.next_observations, q_before, variance_before)]

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "_before"]
