"""An average of the actor's recent weights, for when no exploration is wanted."""

import copy
from collections.abc import Mapping
from typing import Any

import torch as th
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import PyTorchObs


class AveragedActor(BasePolicy):
    """
    Mixin, in front of SB3's ``SACPolicy`` or ``TD3Policy``: ``predict(..., deterministic=True)`` asks an average of
    the actor's weights over the last part of its updates, which walks more evenly than each of them. The part grows with the
    training. Training asks it in greedy episodes alone (:class:`~sb3_symphony.common.callbacks.GreedyEpisodes`): without
    those, the trained actor and the critics are the same as without an average.

    The t-th actor enters with weight 1 / (part · t), at most 1: for large t the polynomial-decay averaging of Shamir & Zhang
    (2013), "Stochastic Gradient Descent for Non-smooth Optimization", with η = 1 / part - 1. For policies: Nikishin et al.
    (2018), "Improving Stability in Deep Reinforcement Learning with Weight Averaging".
    """

    actor: Any
    actor_averaging: float  # part of all updates so far that the average reaches back; 0: no average
    averaged_actor: Any  # of the actor's class, None without
    n_averaged: th.Tensor  # (), updates so far

    def start_average(self) -> None:
        """To be called when the networks are built."""
        self.averaged_actor = None
        if self.actor_averaging > 0:
            distribution = getattr(self.actor, "action_dist", None)
            # gSDE's holds noise matrices with a graph, which cannot be copied; the average needs none
            self.averaged_actor = copy.deepcopy(self.actor, {id(distribution): copy.copy(distribution)}).requires_grad_(False)
            self.averaged_actor.set_training_mode(False)  # for good: it only predicts
            del self.averaged_actor.optimizer
            self.register_buffer("n_averaged", th.zeros((), dtype=th.long, device=self.device))

    def restart_average(self) -> None:
        """Forget all actors but the present one; to be called when it is given other weights than an update's."""
        if self.averaged_actor is not None:
            self.n_averaged.zero_()
            self.averaged_actor.load_state_dict(self.actor.state_dict())

    def load_state_dict(self, state_dict: Mapping[str, Any], strict: bool = True, assign: bool = False) -> Any:
        """
        Torch's. An actor that comes without an average (which ``strict`` would refuse) starts a new one.

        :param state_dict: parameters by name
        :param strict: whether all have to be there, and no others
        :param assign: see torch
        :return: names that are missing or unexpected
        """
        result = super().load_state_dict(state_dict, strict, assign)
        if not any(name.startswith("averaged_actor.") for name in state_dict):
            self.restart_average()
        return result

    def average_actor(self) -> None:
        """Move the average toward the actor; to be called after each of its updates."""
        if self.averaged_actor is not None:
            self.n_averaged += 1
            weight = (1 / (self.actor_averaging * self.n_averaged)).clamp(max=1)  # of the newest actor
            with th.no_grad():
                for own, averaged in zip(self.actor.parameters(), self.averaged_actor.parameters(), strict=True):
                    averaged.lerp_(own, weight)
            for own, averaged in zip(self.actor.buffers(), self.averaged_actor.buffers(), strict=True):
                averaged.copy_(own)  # statistics of batch normalisation

    def _predict(self, observation: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        averaged = deterministic and self.averaged_actor is not None and self.n_averaged > 0
        return (self.averaged_actor if averaged else self.actor)._predict(observation, deterministic)
