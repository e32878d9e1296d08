"""
Fair controls: TD3 and SAC as Stable-Baselines3 computes them (tests compare), by the update engine and with the layer
normalisation, averaged actor and whatever else ours are given, see td3.yml and sac.yml. Names for ``algo``:
``controls.py:TD3Control`` and ``controls.py:SACControl``.
"""

from typing import ClassVar

import torch as th
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import ReplayBufferSamples, Schedule
from stable_baselines3.common.utils import polyak_update

from sb3_symphony import REDQ, Symphony
from sb3_symphony.common.off_policy import UpdateLogs
from sb3_symphony.symphony.policies import Actor, SymphonyPolicy


class TD3ControlPolicy(SymphonyPolicy):
    """Symphony's policy with a target for the actor."""

    actor_target: Actor

    def _build(self, lr_schedule: Schedule) -> None:
        super()._build(lr_schedule)
        self.actor_target = self.make_actor()
        self.actor_target.load_state_dict(self.actor.state_dict())
        self.actor_target.set_training_mode(False)


class TD3Control(Symphony):
    """TD3: the actor has a target and follows the first critic; all targets move when it does."""

    policy: TD3ControlPolicy
    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"MlpPolicy": TD3ControlPolicy}

    def _learn_from(self, segment: ReplayBufferSamples, batches: list[ReplayBufferSamples], logs: UpdateLogs) -> None:
        with th.no_grad():
            next_actions = self.policy.actor_target(segment.next_observations)
            noise = self.target_policy_noise * th.randn_like(next_actions).clamp(-2.5, 2.5)
            next_actions = (next_actions + noise).clamp(-1, 1)

        for batch, next_action in zip(batches, next_actions.chunk(len(batches)), strict=True):
            with th.no_grad():
                next_q_values = self._regression.target_q_values(batch.next_observations, next_action)
                target = batch.rewards + (1 - batch.dones) * self._discounts(batch) * next_q_values.min(dim=0).values
            self._fit_critics(batch, target, logs)

        if self._n_updates % self.policy_delay == 0:
            self._update_actor(batches[-1], logs)
            polyak_update(self.actor.parameters(), self.policy.actor_target.parameters(), self.tau)
            self.policy.average_actor()

    def _fit_critics(self, batch: ReplayBufferSamples, target: th.Tensor, logs: UpdateLogs) -> None:
        tau, self.tau = self.tau, self.tau if (self._n_updates + 1) % self.policy_delay == 0 else 0.0
        super()._fit_critics(batch, target, logs)
        self.tau = tau

    def _actor_values(self, q_values: th.Tensor) -> th.Tensor:
        return q_values[0]


class SACControl(REDQ):
    """SAC: REDQ with all critics in the target, whose actor follows their minimum."""

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = REDQ.policy_aliases

    def _actor_values(self, q_values: th.Tensor) -> th.Tensor:
        return q_values.min(dim=0).values
