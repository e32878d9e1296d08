from collections.abc import Sequence
from typing import Any

import torch as th
from gymnasium import spaces
from stable_baselines3.common.preprocessing import get_action_dim
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, CombinedExtractor, NatureCNN
from stable_baselines3.common.type_aliases import PyTorchObs, Schedule
from stable_baselines3.td3.policies import Actor as TD3Actor
from stable_baselines3.td3.policies import TD3Policy
from torch import nn

from sb3_symphony.common.ensembles import EnsembleCritic, hidden_layers, mlp, with_adam_defaults
from sb3_symphony.common.layers import LeakySine
from sb3_symphony.common.policies import EnsemblePolicy, LayerNorms

Activations = type[nn.Module] | Sequence[type[nn.Module]]


class Actor(TD3Actor):
    """
    Actor network (policy) for Symphony: TD3's, with Fourier blocks and LayerNorm.

    :param observation_space: Observation space
    :param action_space: Action space
    :param net_arch: Widths of the hidden layers
    :param features_extractor: Network to extract features (a CNN when using images, a nn.Flatten() layer otherwise)
    :param features_dim: Number of features
    :param activation_fn: Activation function, one for all hidden layers or a list
    :param normalize_images: Whether to divide images by 255.0
    :param layer_norm: LayerNorm before the activation, one bool for all hidden layers or a list
    :param leaky_slope: Slope of the ``LeakySine`` activations
    """

    def __init__(
        self,
        observation_space: spaces.Space,
        action_space: spaces.Box,
        net_arch: list[int],
        features_extractor: nn.Module,
        features_dim: int,
        activation_fn: Activations = (nn.Identity, LeakySine),
        normalize_images: bool = True,
        layer_norm: LayerNorms = (True, False),
        leaky_slope: float = 0.1,
    ) -> None:
        super().__init__(observation_space, action_space, [], features_extractor, features_dim, nn.Identity, normalize_images)
        self.net_arch, self.activation_fn = net_arch, activation_fn  # type: ignore[assignment]  # lists are allowed here
        self.layer_norm, self.leaky_slope = layer_norm, leaky_slope
        hidden = hidden_layers(net_arch, activation_fn, layer_norm, leaky_slope=leaky_slope)
        self.mu = nn.Sequential(*mlp(features_dim, get_action_dim(action_space), hidden), nn.Tanh())

    def before_tanh(self, obs: PyTorchObs) -> th.Tensor:
        """
        :param obs: Observations
        :return: What ``forward`` takes the tangens hyperbolicus of, ``(batch, n_actions)``. The actor's step goes through
            this one: who overrides one of them has to override both
        """
        return self.mu[:-1](self.extract_features(obs, self.features_extractor))

    def redraw(self) -> None:
        """New Xavier-uniform weights in linear layers, but for frozen ones; biases and LayerNorm stay (author's warm-up)."""
        for module in self.mu:
            if isinstance(module, nn.Linear) and module.weight.requires_grad:
                nn.init.xavier_uniform_(module.weight)

    def _get_constructor_parameters(self) -> dict[str, Any]:
        data = super()._get_constructor_parameters()
        data.update(layer_norm=self.layer_norm, leaky_slope=self.leaky_slope)
        return data


class SymphonyPolicy(EnsemblePolicy, TD3Policy):
    """
    Policy class (with both actor and critics) for Symphony.

    The default network is Read's: a linear layer with LayerNorm and no activation, then the Fourier block (linear,
    ``LeakySine``, linear). ``activation_fn`` and ``layer_norm`` take one value for all hidden layers or a list with one
    for each, whose last one goes on; for different actor and critic networks, a dict with the keys ``pi`` and ``qf``.

    :param observation_space: Observation space
    :param action_space: Action space
    :param lr_schedule: Learning rate schedule (could be constant)
    :param net_arch: The specification of the actor's and the critics' networks, two layers of 256 by default
    :param activation_fn: Activation function(s)
    :param features_extractor_class: Features extractor to use; ``None``: that of the class
    :param features_extractor_kwargs: Keyword arguments to pass to the features extractor
    :param normalize_images: Whether to normalize images or not, dividing by 255.0 (True by default)
    :param optimizer_class: The optimizer to use, ``th.optim.Adam`` by default
    :param optimizer_kwargs: Additional keyword arguments, excluding the learning rate, to pass to the optimizer
    :param n_critics: Number of critics
    :param share_features_extractor: Whether to share or not the features extractor between the actor and the critics
    :param layer_norm: LayerNorm before the activation(s)
    :param dropout_rate: Dropout after the critics' hidden linear layers, active in the targets too
    :param leaky_slope: Slope of the ``LeakySine`` activations
    :param value_range: Makes critics classify: lowest and highest value that their bins cover, for ``critic_loss="hl_gauss"``,
        see :class:`~sb3_symphony.common.losses.ValueBins`
    :param n_bins: Their number of bins
    :param critic_engine: How the critics are fitted: ``"fused"`` by hand-written passes, ``"autograd"``, or ``"auto"``,
        fused wherever it is possible. On a GPU ``"auto"`` records all updates as CUDA graphs, if networks are plain and their
        optimizers Adam or AdamW. The results are equal up to rounding. ``"bf16"`` is fused with large products in
        bfloat16: less precise, and up to 1.6 times as fast where networks are large and the processor has it. What only
        autograd knows of a built model (hooks, frozen layers, another optimizer) is left to it, whatever stands here
    :param actor_averaging: Above 0, ``predict(..., deterministic=True)`` asks an average of the actor's weights over about
        this part of its updates so far (0.125: the last eighth); training is the same without, but for ``GreedyEpisodes``
    """

    # Other classes than SB3's annotations
    actor: Actor
    critic: EnsembleCritic  # type: ignore[assignment]
    critic_target: EnsembleCritic  # type: ignore[assignment]

    def __init__(
        self,
        observation_space: spaces.Space,
        action_space: spaces.Box,
        lr_schedule: Schedule,
        net_arch: list[int] | dict[str, list[int]] | None = None,
        activation_fn: Activations | dict[str, Activations] = (nn.Identity, LeakySine),
        features_extractor_class: type[BaseFeaturesExtractor] | None = None,
        features_extractor_kwargs: dict[str, Any] | None = None,
        normalize_images: bool = True,
        optimizer_class: type[th.optim.Optimizer] = th.optim.Adam,
        optimizer_kwargs: dict[str, Any] | None = None,
        n_critics: int = 2,
        share_features_extractor: bool = False,
        layer_norm: LayerNorms | dict[str, LayerNorms] = (True, False),
        dropout_rate: float = 0.0,
        leaky_slope: float = 0.1,
        value_range: tuple[float, float] | None = None,
        n_bins: int = 51,
        critic_engine: str = "auto",
        actor_averaging: float = 0.0,
    ) -> None:
        self.keep_options(layer_norm, dropout_rate, value_range, n_bins, critic_engine, actor_averaging)
        self.leaky_slope = leaky_slope
        super().__init__(
            observation_space,
            action_space,
            lr_schedule,
            [256, 256] if net_arch is None else net_arch,
            activation_fn,  # type: ignore[arg-type]  # TD3Policy only hands it on, lists are allowed here
            features_extractor_class or self.default_features_extractor,
            features_extractor_kwargs,
            normalize_images,
            optimizer_class,
            with_adam_defaults(optimizer_class, optimizer_kwargs),
            n_critics,
            share_features_extractor,
        )
        self.start_average()

    def _build(self, lr_schedule: Schedule) -> None:
        self.actor = self.make_actor()
        critic_parameters: list[nn.Parameter]
        if self.share_features_extractor:
            self.critic = self.make_critic(self.actor.features_extractor)
            critic_parameters = list(self.critic.q_networks.parameters())
        else:
            self.critic = self.make_critic()
            critic_parameters = list(self.critic.parameters())
        # The target has its own features extractor. There is no target actor
        self.critic_target = self.make_critic()
        self.critic_target.load_state_dict(self.critic.state_dict())

        optimizer: Any = self.optimizer_class
        self.actor.optimizer = optimizer(self.actor.parameters(), lr=lr_schedule(1), **self.optimizer_kwargs)
        self.critic.optimizer = optimizer(critic_parameters, lr=lr_schedule(1), **self.optimizer_kwargs)
        self.critic_target.set_training_mode(False)

    def _network_kwargs(self, part: str) -> dict[str, Any]:
        options: dict[str, Any] = dict(activation_fn=self.activation_fn, layer_norm=self.layer_norm)
        for name, value in options.items():
            if isinstance(value, dict) and value.keys() != {"pi", "qf"}:
                raise ValueError(f"{name}={value!r}: expected one for both, or a dict with keys 'pi' and 'qf'")
        chosen = {name: value[part] if isinstance(value, dict) else value for name, value in options.items()}
        return {**chosen, "leaky_slope": self.leaky_slope}

    def make_actor(self, features_extractor: BaseFeaturesExtractor | None = None) -> Actor:
        actor_kwargs = self._update_features_extractor(self.actor_kwargs, features_extractor)
        return Actor(**{**actor_kwargs, **self._network_kwargs("pi")}).to(self.device)

    # SB3 annotates its own class of critics, which the ensemble stands in for
    def make_critic(self, features_extractor: BaseFeaturesExtractor | None = None) -> EnsembleCritic:  # type: ignore[override]
        critic_kwargs = self._update_features_extractor(self.critic_kwargs, features_extractor)
        kwargs = {**critic_kwargs, **self._network_kwargs("qf"), "dropout_rate": self.dropout_rate}
        return EnsembleCritic(**kwargs, value_range=self.value_range, n_bins=self.n_bins).to(self.device)

    def _get_constructor_parameters(self) -> dict[str, Any]:
        return {**super()._get_constructor_parameters(), "leaky_slope": self.leaky_slope}


MlpPolicy = SymphonyPolicy


class CnnPolicy(SymphonyPolicy):
    """:class:`SymphonyPolicy` for images: the default features extractor is ``NatureCNN``."""

    default_features_extractor = NatureCNN


class MultiInputPolicy(SymphonyPolicy):
    """:class:`SymphonyPolicy` for Dict observations: the default features extractor is ``CombinedExtractor``."""

    default_features_extractor = CombinedExtractor
