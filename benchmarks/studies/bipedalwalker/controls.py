"""
Fair controls: Stable-Baselines3's TD3 and SAC with what they have no option for: layer normalisation in the critics, and
evaluations that ask an average of the actor; TD3 also with a penalty on saturated actions, which SAC's entropy contains. All
else that ours are given (n-step returns, update ratio, cut rewards, noise, sizes) they take as arguments, see td3.yml and
sac.yml. Names for ``algo``: ``controls.py:LayerNormTD3`` and ``controls.py:LayerNormSAC``.
"""

from typing import Any, ClassVar

import torch as th
from stable_baselines3 import SAC, TD3
from stable_baselines3.common.policies import BasePolicy, ContinuousCritic
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, create_mlp
from stable_baselines3.sac.policies import SACPolicy
from stable_baselines3.td3.policies import Actor, TD3Policy
from torch import nn

from sb3_symphony.common.averaging import AveragedActor
from sb3_symphony.symphony.symphony import SATURATED


def _normalized(critic: ContinuousCritic, net_arch: list[int], activation_fn: type[nn.Module]) -> ContinuousCritic:
    """The critic with new networks: linear → layer normalisation → activation."""
    input_dim = critic.q_networks[0][0].in_features
    critic.q_networks = []
    for i in range(critic.n_critics):
        layers = create_mlp(input_dim, 1, net_arch, activation_fn, post_linear_modules=[nn.LayerNorm])
        setattr(critic, f"qf{i}", network := nn.Sequential(*layers).to(critic.device))
        critic.q_networks.append(network)
    return critic


class _Averaged(AveragedActor):
    """The averaged actor as a keyword argument of SB3's policies."""

    def __init__(self, *args: Any, actor_averaging: float = 0.0, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.start_average(actor_averaging)

    def _get_constructor_parameters(self) -> dict[str, Any]:
        return {**super()._get_constructor_parameters(), "actor_averaging": self.actor_averaging}


class LayerNormTD3Policy(_Averaged, TD3Policy):
    """TD3's policy with such critics."""

    def __init__(self, *args: Any, saturation_penalty: float = 0.0, **kwargs: Any) -> None:
        self.saturation_penalty = saturation_penalty
        super().__init__(*args, **kwargs)

    def make_actor(self, features_extractor: BaseFeaturesExtractor | None = None) -> Actor:
        actor = super().make_actor(features_extractor)

        def penalise(module: nn.Module, inputs: tuple[th.Tensor, ...], before_tanh: th.Tensor) -> None:
            """Symphony's ``saturation_penalty``, added to the gradient, as TD3 makes its loss in the middle of ``train``."""
            if before_tanh.requires_grad:
                before = before_tanh.detach()
                slope = 2 * (before - before.clamp(-SATURATED, SATURATED)) / len(before)  # of the mean of the squared excess
                before_tanh.register_hook(lambda gradient: gradient + self.saturation_penalty * slope)

        actor.mu[-2].register_forward_hook(penalise)
        return actor

    def make_critic(self, features_extractor: BaseFeaturesExtractor | None = None) -> ContinuousCritic:
        return _normalized(super().make_critic(features_extractor), self.critic_kwargs["net_arch"], self.activation_fn)

    def _get_constructor_parameters(self) -> dict[str, Any]:
        return {**super()._get_constructor_parameters(), "saturation_penalty": self.saturation_penalty}


class LayerNormSACPolicy(_Averaged, SACPolicy):
    """SAC's policy with such critics."""

    def make_critic(self, features_extractor: BaseFeaturesExtractor | None = None) -> ContinuousCritic:
        return _normalized(super().make_critic(features_extractor), self.critic_kwargs["net_arch"], self.activation_fn)


class LayerNormTD3(TD3):
    """TD3 with layer normalisation in the critics, a penalty on saturated actions and an averaged actor."""

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"MlpPolicy": LayerNormTD3Policy}

    def train(self, gradient_steps: int, batch_size: int = 100) -> None:
        super().train(gradient_steps, batch_size)
        self.policy.average_actor()


class LayerNormSAC(SAC):
    """SAC with layer normalisation in the critics and an averaged actor."""

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"MlpPolicy": LayerNormSACPolicy}

    def train(self, gradient_steps: int, batch_size: int = 64) -> None:
        super().train(gradient_steps, batch_size)
        self.policy.average_actor()
