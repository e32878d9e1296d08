"""
Losses by name.

``m`` is the mean absolute error of a batch and ``e`` one error. Sources: Read (2024) for ReHE and ReHAE, Ishuov's
repositories for the elementwise forms, whose shape is that of a Huber loss.
"""

from collections.abc import Callable

import torch as th
from torch.nn import functional as F

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


CRITIC_LOSSES: dict[str, CriticLoss] = {"mse": mse, "huber": huber, "rehe": rehe, "rehe_elementwise": rehe_elementwise}
# Their derivatives with respect to each error, (n_critics, batch, 1), which autograd would find at several times the cost
CRITIC_LOSS_SLOPES: dict[str, CriticLoss] = {
    "mse": _mse_slope,
    "huber": _huber_slope,
    "rehe": _rehe_slope,
    "rehe_elementwise": _rehe_elementwise_slope,
}
ACTOR_LOSSES: dict[str, ActorLoss] = {"rehae": rehae, "rehae_elementwise": rehae_elementwise, "mean": mean_value}
