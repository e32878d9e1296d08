"""
What Borowiecki (2023), "The Ministry of Silly Walks", tried in the critics of REDQ without gain, and REDQ's critics under
TD3, which he left for later. Names for ``algo``: ``redq_variants.py:SkipREDQ`` and so on.
"""

from abc import abstractmethod
from typing import Any, ClassVar

import numpy as np
import torch as th
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from torch import nn

from sb3_symphony.common.ensembles import EnsembleCritic, StackedMLP, hidden_layers
from sb3_symphony.common.layers import StackedLayerNorm, StackedLinear
from sb3_symphony.redq import REDQ
from sb3_symphony.redq.policies import REDQPolicy
from sb3_symphony.symphony import Symphony


class SkipMLP(StackedMLP):
    """Adds the input of each hidden layer to its output where both have the same width."""

    def forward(self, x: th.Tensor, members: list[int] | None = None) -> th.Tensor:
        block_input = x
        for layer in self.layers:
            if isinstance(layer, StackedLinear):
                block_input = x
            x = layer(x, members) if isinstance(layer, StackedLinear | StackedLayerNorm) else layer(x)
            if not isinstance(layer, StackedLinear | StackedLayerNorm | nn.Dropout) and x.shape == block_input.shape:
                x = x + block_input  # after the activation
        return x


class DuelingMLP(nn.Module):
    """
    V(s) + A(s, a), without subtracting a mean, as actions are continuous.

    :param n_members: number of critics
    :param features_dim: number of features of an observation, which come first in the input
    :param input_dim: number of these and the action's dimensions
    :param hidden: see :func:`~sb3_symphony.common.ensembles.hidden_layers`, for both networks
    """

    def __init__(self, n_members: int, features_dim: int, input_dim: int, hidden: list) -> None:
        super().__init__()
        self.features_dim = features_dim
        self.value = StackedMLP(n_members, features_dim, 1, hidden, "xavier")
        self.advantage = StackedMLP(n_members, input_dim, 1, hidden, "xavier")

    def forward(self, x: th.Tensor, members: list[int] | None = None) -> th.Tensor:
        return self.value(x[:, : self.features_dim], members) + self.advantage(x, members)


class StackedBatchNorm(nn.Module):
    """
    Batch normalisation of ``(n_members, batch, features)``, each member and feature by itself.

    :param n_members: number of members
    :param features: size of the last axis
    :param momentum: weight of a new batch in the running statistics
    """

    def __init__(self, n_members: int, features: int, momentum: float = 0.1) -> None:
        super().__init__()
        self.weight = nn.Parameter(th.ones(n_members, 1, features))
        self.bias = nn.Parameter(th.zeros(n_members, 1, features))
        self.register_buffer("running_mean", th.zeros(n_members, 1, features))
        self.register_buffer("running_var", th.ones(n_members, 1, features))
        self.momentum = momentum

    def forward(self, x: th.Tensor, members: list[int] | None = None) -> th.Tensor:
        mean, var, weight, bias = self.running_mean, self.running_var, self.weight, self.bias
        if members is not None:
            mean, var, weight, bias = mean[members], var[members], weight[members], bias[members]
        if self.training and members is None:
            mean, unbiased = x.mean(dim=1, keepdim=True), x.var(dim=1, keepdim=True)
            var = x.var(dim=1, keepdim=True, correction=0)
            with th.no_grad():
                self.running_mean.lerp_(mean, self.momentum)
                self.running_var.lerp_(unbiased, self.momentum)
        return (x - mean) * th.rsqrt(var + 1e-5) * weight + bias


class BatchNormMLP(nn.Module):
    """
    Linear → batch normalisation → activation, in each hidden layer.

    :param n_members: number of critics
    :param input_dim: number of inputs
    :param hidden: see :func:`~sb3_symphony.common.ensembles.hidden_layers`
    """

    def __init__(self, n_members: int, input_dim: int, hidden: list) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        for layer in hidden:
            layers += [StackedLinear(n_members, input_dim, layer.width, "xavier"), StackedBatchNorm(n_members, layer.width)]
            layers.append(layer.activation_fn())
            input_dim = layer.width
        self.layers = nn.ModuleList([*layers, StackedLinear(n_members, input_dim, 1, "xavier")])

    def forward(self, x: th.Tensor, members: list[int] | None = None) -> th.Tensor:
        for layer in self.layers:
            x = layer(x, members) if isinstance(layer, StackedLinear | StackedBatchNorm) else layer(x)
        return x


class _OtherCritics(REDQPolicy):
    """A policy whose critics are other networks. They are fitted by plain autograd, as the fused passes do not know them."""

    # SB3 annotates its own class of critics, which the ensemble stands in for
    def make_critic(self, features_extractor: BaseFeaturesExtractor | None = None) -> EnsembleCritic:
        critic = super().make_critic(features_extractor)
        hidden = hidden_layers(self.critic_kwargs["net_arch"], self.activation_fn, self.layer_norm, self.dropout_rate)
        critic.q_networks = self.networks(critic, hidden).to(self.device)
        return critic

    @abstractmethod
    def networks(self, critic: EnsembleCritic, hidden: list) -> nn.Module:
        """
        :param critic: critics, whose networks are to be replaced
        :param hidden: their hidden layers
        :return: the new networks
        """


class SkipPolicy(_OtherCritics):
    """Skip connections."""

    def networks(self, critic: EnsembleCritic, hidden: list) -> nn.Module:
        return SkipMLP(critic.n_critics, _input_dim(critic), 1, hidden, "xavier")


class DuelingPolicy(_OtherCritics):
    """Dueling critics."""

    def networks(self, critic: EnsembleCritic, hidden: list) -> nn.Module:
        return DuelingMLP(critic.n_critics, critic.features_extractor.features_dim, _input_dim(critic), hidden)


class BatchNormPolicy(_OtherCritics):
    """Batch normalisation; targets use the running statistics, which they copy, as in Stable-Baselines3."""

    def networks(self, critic: EnsembleCritic, hidden: list) -> nn.Module:
        return BatchNormMLP(critic.n_critics, _input_dim(critic), hidden)


def _input_dim(critic: EnsembleCritic) -> int:
    return critic.q_networks.layers[0].weight.shape[1]


class SkipREDQ(REDQ):
    """REDQ with skip connections in the critics."""

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"MlpPolicy": SkipPolicy}


class DuelingREDQ(REDQ):
    """REDQ with dueling critics."""

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"MlpPolicy": DuelingPolicy}


class BatchNormREDQ(REDQ):
    """REDQ with batch normalisation in the critics."""

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"MlpPolicy": BatchNormPolicy}


class REDQTD3(Symphony):
    """
    REDQ's critics under TD3: a deterministic actor that follows the mean of all critics, smoothed targets that take the
    minimum over a random pair of them. Unlike TD3, the actor has no target network. The random pair is the only thing that
    is not a setting, see redq_td3.yml.
    """

    subset_size = 2

    def _setup_model(self) -> None:
        super()._setup_model()
        of_members = self._regression.target_q_values

        def target_q_values(observations: Any, actions: th.Tensor) -> th.Tensor:
            members = np.random.permutation(self.n_critics)[: self.subset_size].tolist()
            return of_members(observations, actions, members)

        self._regression.target_q_values = target_q_values  # of this regression alone
