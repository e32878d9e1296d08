"""
Critic regression: one step of all critics toward a given target.

The only place with two implementations: plain autograd, for any network and optimiser, and a fused one for plain MLPs
with Adam. They compute the same numbers up to rounding, on the same parameters and optimiser state.
"""

import logging
from typing import NamedTuple

import torch as th
from stable_baselines3.common.torch_layers import FlattenExtractor
from stable_baselines3.common.type_aliases import PyTorchObs
from stable_baselines3.common.utils import get_parameters_by_name, polyak_update
from torch.optim.adam import adam

from sb3_symphony.common.ensembles import EnsembleCritic
from sb3_symphony.common.fused import FusedNetwork, uncovered
from sb3_symphony.common.losses import CRITIC_LOSSES

logger = logging.getLogger(__name__)

ENGINES = ("auto", "autograd", "fused")


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
        loss = self._loss(q_values, target, weights)

        self.critic.optimizer.zero_grad()
        loss.backward()
        self.critic.optimizer.step()

        polyak_update(self.critic.parameters(), self.critic_target.parameters(), tau)
        polyak_update(self.running_stats, self.running_stats_target, 1.0)
        return Fit(loss.detach(), q_values.detach())

    def _loss(self, q_values: th.Tensor, target: th.Tensor, weights: th.Tensor | None) -> th.Tensor:
        estimate = q_values if self.reduction == "independent" else q_values.mean(dim=0, keepdim=True)
        return self.loss(target - estimate, weights).sum()


class FusedRegression(CriticRegression):
    """The same by hand-written passes on workspaces kept between calls, with torch's fused Adam."""

    network: FusedNetwork | None = None

    def fit(
        self,
        observations: PyTorchObs,
        actions: th.Tensor,
        target: th.Tensor,
        tau: float,
        weights: th.Tensor | None = None,
    ) -> Fit:
        if self.network is None or len(self.network.input) != len(actions) or self.network.input.device != actions.device:
            self.network = FusedNetwork(self.critic.q_networks, len(actions))
        with th.no_grad():
            features = self.critic.extract_features(observations, self.critic.features_extractor)
            q_values = self.network.forward(features, actions)

        # The gradient with respect to the values, (n_critics, batch, 1), is left to autograd: any loss works
        leaf = q_values.clone().requires_grad_()
        loss = self._loss(leaf, target, weights)
        (grad,) = th.autograd.grad(loss, leaf)

        with th.no_grad():
            self.network.backward(grad)
            self._optimizer_step(self.network)
            targets: list[th.Tensor] = list(self.critic_target.q_networks.parameters())
            th._foreach_lerp_(targets, self.network.parameters, tau)
        return Fit(loss.detach(), leaf.detach())

    def _optimizer_step(self, network: FusedNetwork) -> None:
        optimizer = self.critic.optimizer
        group = optimizer.param_groups[0]
        for parameter in network.parameters:
            if not optimizer.state[parameter]:  # as Adam itself does at its first step
                step = th.zeros((), dtype=th.float32, device=parameter.device)
                optimizer.state[parameter] = dict(
                    step=step, exp_avg=th.zeros_like(parameter), exp_avg_sq=th.zeros_like(parameter)
                )
        states = [optimizer.state[parameter] for parameter in network.parameters]
        adam(
            network.parameters,
            network.grads,
            [state["exp_avg"] for state in states],
            [state["exp_avg_sq"] for state in states],
            [],
            [state["step"] for state in states],
            fused=True,
            amsgrad=False,
            maximize=False,
            beta1=group["betas"][0],
            beta2=group["betas"][1],
            lr=group["lr"],
            weight_decay=group["weight_decay"],
            eps=group["eps"],
            decoupled_weight_decay=isinstance(optimizer, th.optim.AdamW),
        )


def not_fusable(critic: EnsembleCritic) -> str | None:
    """
    Why critics cannot be fitted by :class:`FusedRegression`.

    :param critic: The critics
    :return: A reason, or ``None`` if they can
    """
    optimizer = critic.optimizer
    if type(critic.features_extractor) is not FlattenExtractor:
        return f"the features extractor is {type(critic.features_extractor).__name__}, not FlattenExtractor"
    if (layer := uncovered(critic.q_networks)) is not None:
        return f"no hand-written passes for {layer}"
    if type(optimizer) not in (th.optim.Adam, th.optim.AdamW):
        return f"the optimizer is {type(optimizer).__name__}, not Adam or AdamW"
    if not optimizer.defaults["fused"]:
        return f"the optimizer has fused={optimizer.defaults['fused']}"
    special = [name for name in ("amsgrad", "maximize", "capturable", "differentiable") if optimizer.defaults[name]]
    return f"the optimizer has {special[0]}=True" if special else None


def make_regression(
    critic: EnsembleCritic, critic_target: EnsembleCritic, loss: str, reduction: str, engine: str = "auto"
) -> CriticRegression:
    """
    The regression of given critics.

    :param critic: The critics, with their optimiser
    :param critic_target: Their targets
    :param loss: Error function by name
    :param reduction: ``"independent"`` or ``"ensemble_mean"``
    :param engine: ``"auto"`` (fused if possible), ``"autograd"`` or ``"fused"``
    :raises ValueError: if ``engine="fused"`` cannot be, saying why
    """
    reason = not_fusable(critic)
    if engine == "fused" and reason is not None:
        raise ValueError(f"critic_engine='fused' is not possible: {reason}; expected critic_engine='auto' or 'autograd'")
    if engine == "auto" and reason is not None:
        logger.info("critics are fitted by autograd: %s", reason)
    chosen = CriticRegression if engine == "autograd" or reason is not None else FusedRegression
    return chosen(critic, critic_target, loss, reduction)
