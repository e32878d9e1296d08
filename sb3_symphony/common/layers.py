"""Layers that both algorithms share: the sine activation, dropout, and layers with one set of parameters per member."""

import math

import numpy as np
import torch as th
from torch import nn
from torch.nn import functional as F

from sb3_symphony.common.kernels import positions_from_gaps


class LeakySine(nn.Module):
    """
    The activation of Symphony's Fourier block: ``LeakyReLU(sin(x))``, with values in ``[-slope, 1]``.

    Source: Read (2024), "Dancing like the Inbetweeners: learning to walk with Symphony"; Ishuov's ``FourierSeries``.

    :param slope: Factor applied to negative values of the sine, 0.1 in both sources
    """

    def __init__(self, slope: float = 0.1) -> None:
        super().__init__()
        self.slope = slope

    def forward(self, x: th.Tensor) -> th.Tensor:
        return F.leaky_relu(th.sin(x), self.slope)

    def extra_repr(self) -> str:
        return f"slope={self.slope}"


def draw_dropped(n_elements: int, rate: float) -> np.ndarray:
    """
    Draw what dropout drops: each element with probability ``rate``.

    At the small rates of DroQ the few gaps between dropped elements, which are geometric, are drawn in a tenth of the time
    that one draw per element takes.

    :param n_elements: Number of elements, at least 1
    :param rate: Above 0
    :return: Positions of the dropped elements, rising, int64
    """
    if rate > 0.1:
        return th.empty(n_elements, dtype=th.uint8).bernoulli_(1 - rate).eq(0).nonzero().view(-1).numpy()
    drawn: list[np.ndarray] = []
    last = -1
    while last < n_elements:  # once, nearly always
        gaps = th.empty(int(1.2 * rate * n_elements) + 8, dtype=th.int64).geometric_(rate).numpy()
        last, count = positions_from_gaps(gaps, last, n_elements)
        drawn.append(gaps[:count])
    return drawn[0] if len(drawn) == 1 else np.concatenate(drawn)


class Dropout(nn.Dropout):
    """That of torch, on the CPU with the draws of :func:`draw_dropped`."""

    @property
    def scale(self) -> float:
        """What elements that are kept are multiplied with in training."""
        return 1 / (1 - self.p) if self.p < 1 else 0.0

    def forward(self, x: th.Tensor) -> th.Tensor:
        if not self.training or self.p == 0 or x.device.type != "cpu":
            return super().forward(x)
        mask = th.full(x.shape, self.scale, dtype=x.dtype)
        mask.view(-1)[th.from_numpy(draw_dropped(mask.numel(), self.p))] = 0
        return x * mask


class StackedLinear(nn.Module):
    """
    ``n_members`` independent linear layers as one batched product.

    The input has shape ``(n_members, batch, in_features)``, or ``(batch, in_features)`` when all members share it;
    the output ``(n_members, batch, out_features)``.

    :param n_members: Number of layers
    :param in_features: Size of each input sample
    :param out_features: Size of each output sample
    :param init: ``"default"``, that of ``torch.nn.Linear``, or ``"xavier"`` (uniform, gain 1, bias zero)
    """

    def __init__(self, n_members: int, in_features: int, out_features: int, init: str = "default") -> None:
        super().__init__()
        self.weight = nn.Parameter(th.empty(n_members, in_features, out_features))
        self.bias = nn.Parameter(th.empty(n_members, 1, out_features))
        self.reset_parameters(init)

    def reset_parameters(self, init: str = "default") -> None:
        # The bounds come from one member's fans: torch's initialisers would read them off the stacked shape
        _, in_features, out_features = self.weight.shape
        if init == "xavier":
            bound = math.sqrt(6.0 / (in_features + out_features))
            nn.init.uniform_(self.weight, -bound, bound)
            nn.init.zeros_(self.bias)
        else:
            bound = 1.0 / math.sqrt(in_features)
            nn.init.uniform_(self.weight, -bound, bound)
            nn.init.uniform_(self.bias, -bound, bound)

    def forward(self, x: th.Tensor, members: list[int] | None = None) -> th.Tensor:
        weight, bias = (self.weight, self.bias) if members is None else (self.weight[members], self.bias[members])
        return th.baddbmm(bias, x.expand(len(weight), -1, -1), weight)

    def extra_repr(self) -> str:
        n_members, in_features, out_features = self.weight.shape
        return f"n_members={n_members}, in_features={in_features}, out_features={out_features}"


class StackedLayerNorm(nn.Module):
    """
    ``n_members`` independent layer normalisations (over the last axis) of a ``(n_members, batch, features)`` tensor.

    :param n_members: Number of layers
    :param features: Size of the last axis
    :param eps: Added to the variance
    """

    def __init__(self, n_members: int, features: int, eps: float = 1e-5) -> None:
        super().__init__()
        self.weight = nn.Parameter(th.ones(n_members, 1, features))
        self.bias = nn.Parameter(th.zeros(n_members, 1, features))
        self.eps = eps

    def forward(self, x: th.Tensor, members: list[int] | None = None) -> th.Tensor:
        weight, bias = (self.weight, self.bias) if members is None else (self.weight[members], self.bias[members])
        return th.addcmul(bias, F.layer_norm(x, x.shape[-1:], eps=self.eps), weight)

    def extra_repr(self) -> str:
        return f"n_members={len(self.weight)}, features={self.weight.shape[-1]}, eps={self.eps}"
