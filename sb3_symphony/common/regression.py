"""Critic regression: one step of all critics toward a given target."""

from typing import NamedTuple

import torch as th
from stable_baselines3.common.type_aliases import PyTorchObs
from stable_baselines3.common.utils import get_parameters_by_name, polyak_update

from sb3_symphony.common.ensembles import EnsembleCritic
from sb3_symphony.common.losses import CRITIC_LOSSES


class Fit(NamedTuple):
    """What a regression step computed, before the step: ``loss`` a scalar, ``q_values (n_critics, batch, 1)``."""

    loss: th.Tensor
    q_values: th.Tensor


class CriticRegression:
    """
    Steps the critics toward a target and their targets toward them, by plain autograd.

    :param critic: The critics; ``critic.optimizer`` is the optimiser that is stepped
    :param critic_target: Their targets
    :param loss: Error function by name, see :data:`sb3_symphony.common.losses.CRITIC_LOSSES`
    :param reduction: ``"independent"``: sum of each critic's loss; ``"ensemble_mean"``: loss of the critics' mean
    """

    def __init__(self, critic: EnsembleCritic, critic_target: EnsembleCritic, loss: str, reduction: str) -> None:
        self.critic, self.critic_target = critic, critic_target
        self.loss, self.reduction = CRITIC_LOSSES[loss], reduction
        # Running statistics of batch normalisation (in features extractors) are copied, as in SB3
        self.running_stats = get_parameters_by_name(critic, ["running_"])
        self.running_stats_target = get_parameters_by_name(critic_target, ["running_"])

    def fit(
        self,
        observations: PyTorchObs,
        actions: th.Tensor,
        target: th.Tensor,
        tau: float,
        weights: th.Tensor | None = None,
    ) -> Fit:
        """
        One optimiser step of the critics, then one Polyak step of their targets.

        :param observations: ``(batch, ...)``
        :param actions: ``(batch, action_dim)`` in [-1, 1]
        :param target: ``(batch, 1)``, without gradient
        :param tau: Polyak coefficient
        :param weights: Importance weights ``(batch, 1)`` of a prioritised replay
        :return: The loss and the critics' values before the step
        """
        q_values = self.critic(observations, actions)  # (n_critics, batch, 1)
        estimate = q_values if self.reduction == "independent" else q_values.mean(dim=0, keepdim=True)
        loss = self.loss(target - estimate, weights).sum()

        self.critic.optimizer.zero_grad()
        loss.backward()
        self.critic.optimizer.step()

        polyak_update(self.critic.parameters(), self.critic_target.parameters(), tau)
        polyak_update(self.running_stats, self.running_stats_target, 1.0)
        return Fit(loss.detach(), q_values.detach())
