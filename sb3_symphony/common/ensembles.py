"""N critics as one module with stacked parameters ``(n_critics, in, out)``."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple, TypeVar

import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import BaseModel
from stable_baselines3.common.preprocessing import get_action_dim
from stable_baselines3.common.type_aliases import PyTorchObs
from torch import nn

from sb3_symphony.common.checks import check_choice, check_number
from sb3_symphony.common.layers import Dropout, LeakySine, StackedLayerNorm, StackedLinear
from sb3_symphony.common.losses import ValueBins

T = TypeVar("T")


class HiddenLayer(NamedTuple):
    """``Linear → Dropout → LayerNorm → activation``, DroQ's order; what is switched off is left out."""

    width: int
    activation_fn: type[nn.Module] | partial
    layer_norm: bool
    dropout_rate: float


def hidden_layers(
    net_arch: list[int],
    activation_fn: type[nn.Module] | Sequence[type[nn.Module]],
    layer_norm: bool | Sequence[bool] = False,
    dropout_rate: float = 0.0,
    leaky_slope: float = 0.1,
) -> list[HiddenLayer]:
    """
    The hidden layers of a network.

    :param net_arch: Their widths
    :param activation_fn: One class for all of them, or one for each; the last one of a shorter list goes on
    :param layer_norm: Whether to normalise before the activation, likewise for all or each
    :param dropout_rate: Probability that a unit is dropped, for all of them
    :param leaky_slope: Slope of the :class:`~sb3_symphony.common.layers.LeakySine` activations among them
    :return: One entry per width
    :raises ValueError: if a width, the rate or the slope is out of range
    """
    check_net_arch(net_arch)
    check_number("dropout_rate", dropout_rate, 0, below=1)
    check_number("leaky_slope", leaky_slope, 0)
    for name, values in (("activation_fn", activation_fn), ("layer_norm", layer_norm)):
        if isinstance(values, Sequence) and not values:
            raise ValueError(f"{name}={values!r}: expected at least one entry")

    for each in layer_norm if isinstance(layer_norm, Sequence) and not isinstance(layer_norm, str) else [layer_norm]:
        check_choice("layer_norm", each, (True, False))

    def at(values: T | Sequence[T], i: int) -> T:
        return values[min(i, len(values) - 1)] if isinstance(values, Sequence) else values

    activations = [at(activation_fn, i) for i in range(len(net_arch))]
    return [
        HiddenLayer(width, partial(LeakySine, leaky_slope) if cls is LeakySine else cls, at(layer_norm, i), dropout_rate)
        for i, (width, cls) in enumerate(zip(net_arch, activations, strict=True))
    ]


def check_net_arch(net_arch: list[int] | dict[str, list[int]] | None) -> None:
    """
    :param net_arch: Widths of hidden layers, or a dict of such lists
    :raises ValueError: if a width is out of range
    :raises TypeError: if a width is no whole number
    """
    for widths in net_arch.values() if isinstance(net_arch, dict) else [net_arch or []]:
        for width in widths:
            check_number("net_arch", width, 1, integer=True)


def with_adam_defaults(optimizer_class: type[th.optim.Optimizer], kwargs: dict[str, Any] | None) -> dict[str, Any]:
    """
    An optimiser's arguments, with torch's one-pass implementation where it has one: same numbers, 2 to 5 times faster.

    :param optimizer_class: The optimiser
    :param kwargs: Arguments given, which are left as they are
    """
    given = kwargs or {}
    one_pass = optimizer_class in (th.optim.Adam, th.optim.AdamW) and "foreach" not in given
    return {"fused": True, **given} if one_pass else given


def _modules(
    input_dim: int,
    output_dim: int,
    hidden: list[HiddenLayer],
    linear: Callable[[int, int], nn.Module],
    norm: Callable[[int], nn.Module],
) -> list[nn.Module]:
    """The layers of a network, from input to output, made of the given kinds of linear layer and normalisation."""
    modules: list[nn.Module] = []
    for width, activation_fn, layer_norm, dropout_rate in hidden:
        modules.append(linear(input_dim, width))
        modules += [Dropout(dropout_rate)] if dropout_rate > 0 else []
        modules += [norm(width)] if layer_norm else []
        modules.append(activation_fn())
        input_dim = width
    return [*modules, linear(input_dim, output_dim)]


def mlp(input_dim: int, output_dim: int, hidden: list[HiddenLayer]) -> nn.Sequential:
    """
    One ordinary network with the given hidden layers and a linear output.

    :param input_dim: Size of its input
    :param output_dim: Size of its output
    :param hidden: See :func:`hidden_layers`
    """
    return nn.Sequential(*_modules(input_dim, output_dim, hidden, nn.Linear, nn.LayerNorm))


class StackedMLP(nn.Module):
    """
    ``n_members`` independent networks of the same shape, computed together.

    :param n_members: Number of networks
    :param input_dim: Size of their input
    :param output_dim: Size of their output
    :param hidden: See :func:`hidden_layers`
    :param init: Initialisation of the linear layers, ``"default"`` (as torch) or ``"xavier"``
    :raises ValueError: if an activation has parameters, which the networks would share
    """

    def __init__(
        self, n_members: int, input_dim: int, output_dim: int, hidden: list[HiddenLayer], init: str = "default"
    ) -> None:
        super().__init__()
        linear = partial(StackedLinear, n_members, init=init)
        self.layers = nn.ModuleList(_modules(input_dim, output_dim, hidden, linear, partial(StackedLayerNorm, n_members)))
        for layer in self.layers:
            if not isinstance(layer, (StackedLinear, StackedLayerNorm)) and list(layer.parameters()):
                kind = type(layer).__name__
                raise ValueError(f"activation_fn={kind}: expected one without parameters, which the critics would share")

    def forward(self, x: th.Tensor, members: list[int] | None = None) -> th.Tensor:
        """
        :param x: ``(batch, input_dim)``
        :param members: Compute these networks only
        :return: ``(n_members, batch, output_dim)``
        """
        for layer in self.layers:
            x = layer(x, members) if isinstance(layer, (StackedLinear, StackedLayerNorm)) else layer(x)
        return x


class EnsembleCritic(BaseModel):
    """
    N independent Q-functions; equal to N separate networks with the same weights.

    :param observation_space: Observation space
    :param action_space: Action space
    :param net_arch: Widths of the hidden layers
    :param features_extractor: Network to extract features (a CNN when using images, a nn.Flatten() layer otherwise)
    :param features_dim: Number of features
    :param activation_fn: Activation function, one for all hidden layers or a list
    :param normalize_images: Whether to divide images by 255.0
    :param n_critics: Number of Q-functions
    :param share_features_extractor: Whether the extractor is the actor's, and so not trained by the critic's loss
    :param layer_norm: LayerNorm before the activation, one bool for all hidden layers or a list
    :param dropout_rate: Dropout after each hidden linear layer
    :param leaky_slope: Slope of the ``LeakySine`` activations
    :param init: Initialisation of the linear layers, ``"default"`` (as torch) or ``"xavier"``
    :param value_range: Lowest and highest value of critics that classify, see
        :class:`~sb3_symphony.common.losses.ValueBins`; ``None``: they have one output, the value
    :param n_bins: Their number of bins
    """

    features_extractor: Any

    def __init__(
        self,
        observation_space: spaces.Space,
        action_space: spaces.Box,
        net_arch: list[int],
        features_extractor: nn.Module,
        features_dim: int,
        activation_fn: type[nn.Module] | Sequence[type[nn.Module]] = nn.ReLU,
        normalize_images: bool = True,
        n_critics: int = 2,
        share_features_extractor: bool = True,
        layer_norm: bool | Sequence[bool] = False,
        dropout_rate: float = 0.0,
        leaky_slope: float = 0.1,
        init: str = "default",
        value_range: tuple[float, float] | None = None,
        n_bins: int = 51,
    ) -> None:
        super().__init__(
            observation_space,
            action_space,
            features_extractor=features_extractor,  # type: ignore[arg-type]  # SB3's own annotation of its subclasses
            normalize_images=normalize_images,
        )
        self.share_features_extractor = share_features_extractor
        self.n_critics = n_critics
        hidden = hidden_layers(net_arch, activation_fn, layer_norm, dropout_rate, leaky_slope)
        self.bins = None if value_range is None else ValueBins(value_range, n_bins)
        n_outputs = 1 if self.bins is None else n_bins
        self.q_networks = StackedMLP(n_critics, features_dim + get_action_dim(action_space), n_outputs, hidden, init)

    def forward(self, obs: PyTorchObs, actions: th.Tensor, members: list[int] | None = None) -> th.Tensor:
        """
        :param obs: Observations ``(batch, ...)``
        :param actions: Actions in [-1, 1] ``(batch, action_dim)``
        :param members: Indices of the critics to compute, all of them by default
        :return: ``(n_critics, batch, 1)``, where SB3's critics give a tuple of ``(batch, 1)``
        """
        outputs = self.outputs(obs, actions, members)
        return outputs if self.bins is None else self.bins.values(outputs)

    def outputs(self, obs: PyTorchObs, actions: th.Tensor, members: list[int] | None = None) -> th.Tensor:
        """What the networks give, before bins become a value: ``(n_critics, batch, 1 or n_bins)``; parameters as above."""
        # A shared features extractor is trained by the actor's loss alone, as in SB3
        with th.set_grad_enabled(th.is_grad_enabled() and not self.share_features_extractor):
            features = self.extract_features(obs, self.features_extractor)
        return self.q_networks(th.cat([features, actions], dim=1), members)


TARGET_MODES = ("min", "mean", "rem")


def combine(q_values: th.Tensor, mode: str, min_mix: float | th.Tensor = 1.0) -> th.Tensor:
    """
    One value out of an ensemble's.

    :param q_values: ``(n_critics, batch, 1)``
    :param mode: ``"min"``; ``"mean"``; ``"rem"``, the random convex combination of REM (Agarwal et al. 2020)
    :param min_mix: Weight of the minimum in mode ``"min"``; the rest is on the mean
    :return: ``(batch, 1)``
    """
    if mode == "mean":
        return q_values.mean(dim=0)
    if mode == "rem":
        weights = th.rand_like(q_values)
        return (q_values * weights).sum(dim=0) / weights.sum(dim=0)
    minimum = q_values.min(dim=0).values  # the gradient of each sample flows through its smallest critic only
    if isinstance(min_mix, th.Tensor):  # its value is on its device
        return th.lerp(q_values.mean(dim=0), minimum, min_mix.to(minimum.dtype))
    return minimum if min_mix == 1.0 else th.lerp(q_values.mean(dim=0), minimum, min_mix)
