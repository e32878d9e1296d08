"""
Losses by name.

``m`` is the mean absolute error of a batch and ``e`` one error. Sources: Read (2024) for ReHE and ReHAE, Ishuov's
repositories for the elementwise forms, whose shape is that of a Huber loss.
"""

import math
from collections.abc import Callable

import torch as th
from torch import nn
from torch.nn import functional as F

from sb3_symphony.common.checks import check_number, check_pair

CriticLoss = Callable[..., th.Tensor]
ActorLoss = Callable[[th.Tensor, th.Tensor], th.Tensor]


def _mean(x: th.Tensor, weights: th.Tensor | None) -> th.Tensor:
    """Batch mean of ``x (n_critics, batch, 1)``, one per critic: ``(n_critics,)``."""
    return (x if weights is None else x * weights).mean(dim=(1, 2))


def mse(error: th.Tensor, weights: th.Tensor | None = None) -> th.Tensor:
    """
    Squared error.

    :param error: ``(n_critics, batch, 1)``
    :param weights: Importance weights ``(batch, 1)`` of a prioritised replay
    :return: The loss of each critic ``(n_critics,)``
    """
    return _mean(error.square(), weights)


def huber(error: th.Tensor, weights: th.Tensor | None = None) -> th.Tensor:
    """Huber's loss with threshold 1. Parameters and return value as in :func:`mse`."""
    return _mean(F.huber_loss(error, th.zeros_like(error), reduction="none"), weights)


def rehe(error: th.Tensor, weights: th.Tensor | None = None) -> th.Tensor:
    """
    Rectified Huber error of a *batch mean*: ``m * tanh(m)`` (Read 2024).

    The gradient with respect to each error has the same length, so critics regress to the conditional median.
    Parameters and return value as in :func:`mse`.
    """
    m = _mean(error.abs(), weights)
    return m * m.tanh()


def rehe_elementwise(error: th.Tensor, weights: th.Tensor | None = None) -> th.Tensor:
    """The rectified Huber error of each sample, ``mean(e * tanh(e / 2))``. Parameters and return value as in :func:`mse`."""
    return _mean(error * (error / 2).tanh(), weights)


def _share(slope: th.Tensor, weights: th.Tensor | None) -> th.Tensor:
    """The derivative of :func:`_mean` of something whose derivative is ``slope (n_critics, batch, 1)``."""
    return (slope if weights is None else slope * weights) / slope.shape[1]


def _mse_slope(error: th.Tensor, weights: th.Tensor | None) -> th.Tensor:
    return _share(2 * error, weights)


def _huber_slope(error: th.Tensor, weights: th.Tensor | None) -> th.Tensor:
    return _share(error.clamp(-1, 1), weights)


def _rehe_slope(error: th.Tensor, weights: th.Tensor | None) -> th.Tensor:
    m = _mean(error.abs(), weights)[:, None, None]
    tanh = m.tanh()
    return _share(error.sign() * (tanh + m * (1 - tanh.square())), weights)


def _rehe_elementwise_slope(error: th.Tensor, weights: th.Tensor | None) -> th.Tensor:
    half = error / 2
    tanh = half.tanh()
    return _share(tanh + half * (1 - tanh.square()), weights)


def rehae(q_values: th.Tensor, baseline: th.Tensor) -> th.Tensor:
    """
    Rectified Huber *asymmetric* error (Read 2024), to be maximised: ``|d| * tanh(d)``, ``d = mean(q_values) - baseline``.

    Its gradient is that of ``mean(q_values)`` times one factor in ``[0, 1.2]``, which vanishes for ``d = 0``.

    :param q_values: ``(batch, 1)``
    :param baseline: Mean value at the previous update, a scalar tensor without gradient
    :return: A scalar
    """
    advantage = q_values.mean() - baseline
    return advantage.abs() * advantage.tanh()


def rehae_elementwise(q_values: th.Tensor, baseline: th.Tensor) -> th.Tensor:
    """``mean(|d| * tanh(d / 2))`` with one ``d`` per sample. Parameters and return value as in :func:`rehae`."""
    advantage = q_values - baseline
    return (advantage.abs() * (advantage / 2).tanh()).mean()


def mean_value(q_values: th.Tensor, baseline: th.Tensor) -> th.Tensor:
    """``mean(q_values)``, the objective of TD3. Parameters and return value as in :func:`rehae`."""
    return q_values.mean()


class ValueBins(nn.Module):
    """
    Values as probabilities of bins, fitted by classification: HL-Gauss.

    A value stands for a normal distribution around it, cut into the bins. Regression to targets that move and are noisy is
    easier in this form. An objective of critics like :class:`~sb3_symphony.common.regression.Error`, whose outputs are logits.
    Sources: Imani and White (2018), "Improving Regression Performance with Distributional Losses";
    Farebrother et al. (2024), "Stop Regressing: Training Value Functions via Classification for Scalable Deep RL", who take
    0.75 bins for its standard deviation.

    :param value_range: Lowest and highest value that bins cover; what lies beyond is taken for the end
    :param n_bins: Number of bins, all of the same width
    :raises ValueError: if the range is empty, or there are less than two bins
    """

    SIGMA = 0.75  # in bins
    edges: th.Tensor  # (n_bins + 1,)
    centers: th.Tensor  # (n_bins, 1)

    def __init__(self, value_range: tuple[float, float], n_bins: int = 51) -> None:
        super().__init__()
        check_pair("value_range", value_range, "lowest, highest")
        low, high = value_range
        if not low < high:
            raise ValueError(f"value_range={value_range!r}: expected the smaller number first")
        check_number("n_bins", n_bins, 2, integer=True)
        edges = th.linspace(low, high, n_bins + 1, dtype=th.float64).to(th.get_default_dtype())
        if not (edges.isfinite().all() and (edges.diff() > 0).all()):
            raise ValueError(f"value_range={value_range!r}: expected bins that {edges.dtype} can tell apart")
        self.value_range, self.n_bins = (low, high), n_bins
        self.register_buffer("edges", edges, persistent=False)
        self.register_buffer("centers", ((edges[1:] + edges[:-1]) / 2)[:, None], persistent=False)
        self.scale = n_bins / (math.sqrt(2) * self.SIGMA * (high - low))

    def values(self, logits: th.Tensor) -> th.Tensor:
        """
        :param logits: ``(n_critics, batch, n_bins)``
        :return: The values expected ``(n_critics, batch, 1)``
        """
        return logits.softmax(dim=-1) @ self.centers

    def values_slope(self, logits: th.Tensor, grad: th.Tensor) -> th.Tensor:
        """
        The gradient with respect to ``logits`` of what has the gradient ``grad (n_critics, batch, 1)`` with respect to the
        values expected.
        """
        probabilities = logits.softmax(dim=-1)
        return probabilities * (self.centers[:, 0] - probabilities @ self.centers) * grad

    def probabilities(self, values: th.Tensor) -> th.Tensor:
        """
        :param values: ``(batch, 1)``
        :return: ``(batch, n_bins)``, of which each row has the sum 1
        """
        cdf = th.erf((self.edges - values.clamp(*self.value_range)) * self.scale)
        mass = cdf[:, 1:] - cdf[:, :-1]
        return mass / mass.sum(dim=1, keepdim=True)

    def loss(self, logits: th.Tensor, target: th.Tensor, weights: th.Tensor | None = None) -> th.Tensor:
        """
        Cross-entropy.

        :param logits: ``(n_critics, batch, n_bins)``
        :param target: Values ``(batch, 1)``
        :param weights: Importance weights ``(batch, 1)`` of a prioritised replay
        :return: The loss of each critic ``(n_critics,)``
        """
        return self._loss(logits.log_softmax(dim=-1), self.probabilities(target), weights)

    def loss_slope_and_values(
        self, logits: th.Tensor, target: th.Tensor, weights: th.Tensor | None = None
    ) -> tuple[th.Tensor, th.Tensor, th.Tensor]:
        """The loss, its derivative with respect to ``logits``, and the values expected."""
        wanted = self.probabilities(target)
        log_probabilities = logits.log_softmax(dim=-1)
        probabilities = log_probabilities.exp()
        loss = self._loss(log_probabilities, wanted, weights)
        return loss, _share(probabilities - wanted, weights), probabilities @ self.centers

    def _loss(self, log_probabilities: th.Tensor, wanted: th.Tensor, weights: th.Tensor | None) -> th.Tensor:
        return _mean(-(wanted * log_probabilities).sum(dim=-1, keepdim=True), weights)


CRITIC_LOSSES: dict[str, CriticLoss] = {"mse": mse, "huber": huber, "rehe": rehe, "rehe_elementwise": rehe_elementwise}
# Their derivatives with respect to each error, (n_critics, batch, 1), which autograd would find at several times the cost
CRITIC_LOSS_SLOPES: dict[str, CriticLoss] = {
    "mse": _mse_slope,
    "huber": _huber_slope,
    "rehe": _rehe_slope,
    "rehe_elementwise": _rehe_elementwise_slope,
}
CLASSIFICATION = "hl_gauss"  # the critics' loss that goes with ValueBins, and with nothing else
ACTOR_LOSSES: dict[str, ActorLoss] = {"rehae": rehae, "rehae_elementwise": rehae_elementwise, "mean": mean_value}
