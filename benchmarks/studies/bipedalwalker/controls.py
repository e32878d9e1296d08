"""
Fair controls: Stable-Baselines3's TD3 and SAC with layer normalisation in the critics, for which they have no option. All
else that ours are given (n-step returns, update ratio, cut rewards, noise, sizes) they take as arguments, see td3.yml and
sac.yml. Names for ``algo``: ``controls.py:LayerNormTD3`` and ``controls.py:LayerNormSAC``.
"""

from typing import ClassVar

from stable_baselines3 import SAC, TD3
from stable_baselines3.common.policies import BasePolicy, ContinuousCritic
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, create_mlp
from stable_baselines3.sac.policies import SACPolicy
from stable_baselines3.td3.policies import TD3Policy
from torch import nn


def _normalized(critic: ContinuousCritic, net_arch: list[int], activation_fn: type[nn.Module]) -> ContinuousCritic:
    """The critic with new networks: linear → layer normalisation → activation."""
    input_dim = critic.q_networks[0][0].in_features
    critic.q_networks = []
    for i in range(critic.n_critics):
        layers = create_mlp(input_dim, 1, net_arch, activation_fn, post_linear_modules=[nn.LayerNorm])
        setattr(critic, f"qf{i}", network := nn.Sequential(*layers).to(critic.device))
        critic.q_networks.append(network)
    return critic


class LayerNormTD3Policy(TD3Policy):
    """TD3's policy with such critics."""

    def make_critic(self, features_extractor: BaseFeaturesExtractor | None = None) -> ContinuousCritic:
        return _normalized(super().make_critic(features_extractor), self.critic_kwargs["net_arch"], self.activation_fn)


class LayerNormSACPolicy(SACPolicy):
    """SAC's policy with such critics."""

    def make_critic(self, features_extractor: BaseFeaturesExtractor | None = None) -> ContinuousCritic:
        return _normalized(super().make_critic(features_extractor), self.critic_kwargs["net_arch"], self.activation_fn)


class LayerNormTD3(TD3):
    """TD3 with layer normalisation in the critics."""

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"MlpPolicy": LayerNormTD3Policy}


class LayerNormSAC(SAC):
    """SAC with layer normalisation in the critics."""

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"MlpPolicy": LayerNormSACPolicy}
