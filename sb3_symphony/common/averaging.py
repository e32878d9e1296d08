"""An average of the actor's recent weights, for when no exploration is wanted."""

import copy
from typing import Any

import torch as th
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import PyTorchObs
from stable_baselines3.common.utils import polyak_update


class AveragedActor(BasePolicy):
    """
    Mixin, in front of SB3's ``SACPolicy`` or ``TD3Policy``: ``predict(..., deterministic=True)`` asks an exponential
    average of the actor's weights over its last ``1 / actor_tau`` or so updates, which walks more evenly than each of them.
    Training never asks it: with or without, the trained actor and the critics are the same.

    Source: Polyak averaging; for policies, Nikishin et al. (2018), "Improving Stability in Deep Reinforcement Learning with
    Weight Averaging".
    """

    actor: Any
    averaged_actor: Any  # of the actor's class, None without

    def start_average(self, actor_tau: float) -> None:
        """
        To be called when the networks are built.

        :param actor_tau: share of the actor in the average, at each of its updates; 1: no average
        """
        self.actor_tau = actor_tau
        self.averaged_actor = None
        if actor_tau < 1:
            self.averaged_actor = copy.deepcopy(self.actor).requires_grad_(False)
            del self.averaged_actor.optimizer

    def average_actor(self) -> None:
        """Move the average toward the actor; to be called after each of its updates."""
        if self.averaged_actor is not None:
            polyak_update(self.actor.parameters(), self.averaged_actor.parameters(), self.actor_tau)
            for own, averaged in zip(self.actor.buffers(), self.averaged_actor.buffers(), strict=True):
                averaged.copy_(own)  # statistics of batch normalisation

    def _predict(self, observation: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        asked = self.averaged_actor if deterministic and self.averaged_actor is not None else self.actor
        return asked._predict(observation, deterministic)
