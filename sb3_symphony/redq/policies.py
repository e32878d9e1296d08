from typing import Any

import torch as th
from gymnasium import spaces
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, CombinedExtractor, NatureCNN
from stable_baselines3.common.type_aliases import Schedule
from stable_baselines3.sac.policies import Actor, SACPolicy
from torch import nn

from sb3_symphony.common.ensembles import EnsembleCritic, check_net_arch, with_adam_defaults
from sb3_symphony.common.policies import EnsemblePolicy, LayerNorms


def xavier_(module: nn.Module) -> None:
    """Xavier-uniform weights and zero biases in a linear layer, as in the authors' code."""
    if isinstance(module, nn.Linear):
        nn.init.xavier_uniform_(module.weight)
        nn.init.zeros_(module.bias)


class REDQPolicy(EnsemblePolicy, SACPolicy):
    """
    Policy class (with both actor and critics) for REDQ and DroQ: SB3's SAC actor and an ensemble of critics.

    :param observation_space: Observation space
    :param action_space: Action space
    :param lr_schedule: Learning rate schedule (could be constant)
    :param net_arch: The specification of the actor's and the critics' networks, two layers of 256 by default
    :param activation_fn: Activation function
    :param use_sde: Whether to use State Dependent Exploration or not
    :param log_std_init: Initial value for the log standard deviation
    :param use_expln: Use ``expln()`` function instead of ``exp()`` when using gSDE to ensure a positive standard deviation
    :param clip_mean: Clip the mean output when using gSDE to avoid numerical instability
    :param features_extractor_class: Features extractor to use; ``None``: that of the class
    :param features_extractor_kwargs: Keyword arguments to pass to the features extractor
    :param normalize_images: Whether to normalize images or not, dividing by 255.0 (True by default)
    :param optimizer_class: The optimizer to use, ``th.optim.Adam`` by default
    :param optimizer_kwargs: Additional keyword arguments, excluding the learning rate, to pass to the optimizer
    :param n_critics: Number of critics
    :param share_features_extractor: Whether to share or not the features extractor between the actor and the critics
    :param layer_norm: Whether the critics normalise each hidden layer before its activation
    :param dropout_rate: Dropout after the critics' hidden linear layers, active in the targets too (DroQ)
    :param value_range: Makes critics classify: lowest and highest value that their bins cover, for ``critic_loss="hl_gauss"``,
        see :class:`~sb3_symphony.common.losses.ValueBins`
    :param n_bins: Their number of bins
    :param critic_engine: How the critics are fitted: ``"fused"`` by hand-written passes, ``"autograd"``, or ``"auto"``,
        fused wherever it is possible; the results are equal up to rounding. ``"bf16"`` is fused with large products in
        bfloat16: less precise, and up to 1.6 times as fast where networks are large and the processor has it. What only
        autograd knows of a built model (hooks, frozen layers, another optimizer) is left to it, whatever stands here
    :param actor_averaging: Above 0, ``predict(..., deterministic=True)`` asks an average of the actor's weights over about
        this part of its updates so far (0.125: the last eighth); training is the same without, but for ``GreedyEpisodes``
    """

    # Another class of critics than SB3's annotation
    critic: EnsembleCritic  # type: ignore[assignment]
    critic_target: EnsembleCritic  # type: ignore[assignment]

    def __init__(
        self,
        observation_space: spaces.Space,
        action_space: spaces.Box,
        lr_schedule: Schedule,
        net_arch: list[int] | dict[str, list[int]] | None = None,
        activation_fn: type[nn.Module] = nn.ReLU,
        use_sde: bool = False,
        log_std_init: float = -3,
        use_expln: bool = False,
        clip_mean: float = 2.0,
        features_extractor_class: type[BaseFeaturesExtractor] | None = None,
        features_extractor_kwargs: dict[str, Any] | None = None,
        normalize_images: bool = True,
        optimizer_class: type[th.optim.Optimizer] = th.optim.Adam,
        optimizer_kwargs: dict[str, Any] | None = None,
        n_critics: int = 10,
        share_features_extractor: bool = False,
        layer_norm: LayerNorms = False,
        dropout_rate: float = 0.0,
        value_range: tuple[float, float] | None = None,
        n_bins: int = 51,
        critic_engine: str = "auto",
        actor_averaging: float = 0.0,
    ) -> None:
        check_net_arch(net_arch)  # before the parent, which builds the actor
        self.keep_options(layer_norm, dropout_rate, value_range, n_bins, critic_engine, actor_averaging)
        super().__init__(
            observation_space,
            action_space,
            lr_schedule,
            net_arch,
            activation_fn,
            use_sde,
            log_std_init,
            use_expln,
            clip_mean,
            features_extractor_class or self.default_features_extractor,
            features_extractor_kwargs,
            normalize_images,
            optimizer_class,
            with_adam_defaults(optimizer_class, optimizer_kwargs),
            n_critics,
            share_features_extractor,
        )
        self.start_average()

    def make_actor(self, features_extractor: BaseFeaturesExtractor | None = None) -> Actor:
        actor = super().make_actor(features_extractor)
        for part in (actor.latent_pi, actor.mu, actor.log_std):
            if isinstance(part, nn.Module):
                part.apply(xavier_)
        return actor

    # SB3 annotates its own class of critics, which the ensemble stands in for
    def make_critic(self, features_extractor: BaseFeaturesExtractor | None = None) -> EnsembleCritic:  # type: ignore[override]
        critic_kwargs = self._update_features_extractor(self.critic_kwargs, features_extractor)
        critic_kwargs.update(layer_norm=self.layer_norm, dropout_rate=self.dropout_rate, init="xavier")
        return EnsembleCritic(**critic_kwargs, value_range=self.value_range, n_bins=self.n_bins).to(self.device)

    def _get_constructor_parameters(self) -> dict[str, Any]:
        data = super()._get_constructor_parameters()
        data.update(share_features_extractor=self.share_features_extractor)  # which SACPolicy leaves out
        return data


MlpPolicy = REDQPolicy


class CnnPolicy(REDQPolicy):
    """:class:`REDQPolicy` for images: the default features extractor is ``NatureCNN``."""

    default_features_extractor = NatureCNN


class MultiInputPolicy(REDQPolicy):
    """:class:`REDQPolicy` for Dict observations: the default features extractor is ``CombinedExtractor``."""

    default_features_extractor = CombinedExtractor
