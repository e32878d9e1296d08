import itertools
import math
import re
from statistics import NormalDist

import pytest
import torch as th
from torch.nn import functional as F

from sb3_symphony.common.layers import LeakySine
from sb3_symphony.common.losses import (
    ACTOR_LOSSES,
    CRITIC_LOSSES,
    ValueBins,
    huber,
    mean_value,
    mse,
    rehae,
    rehae_elementwise,
    rehe,
    rehe_elementwise,
)

E = (1.0, -2.0, 3.0)


def errors(*critics):
    return th.tensor(critics, dtype=th.float64)[..., None].requires_grad_()  # (n_critics, batch, 1)


def values(*samples):
    return th.tensor(samples, dtype=th.float64)[:, None].requires_grad_()  # (batch, 1)


def zero():
    return th.zeros((), dtype=th.float64)


def approx(expected):
    return pytest.approx(expected, abs=1e-6)


# Critic losses --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("loss", "expected"),
    [(rehe, 1.928055), (rehe_elementwise, 1.566917), (mse, 14 / 3), (huber, (0.5 + 1.5 + 2.5) / 3)],
)
def test_values_of_the_reference(loss, expected):
    assert loss(errors(E)).tolist() == approx([expected])


@pytest.mark.parametrize(
    ("loss", "expected"),
    [
        (rehe, [0.368443, -0.368443, 0.368443]),
        (mse, [2 / 3, -4 / 3, 2.0]),
        (huber, [1 / 3, -1 / 3, 1 / 3]),
        # d(x tanh(x/2))/dx = tanh(x/2) + x/2 sech^2(x/2), an odd function
        (rehe_elementwise, [math.copysign(math.tanh(abs(x) / 2) + abs(x) / 2 / math.cosh(x / 2) ** 2, x) / 3 for x in E]),
    ],
)
def test_gradients(loss, expected):
    error = errors(E)
    loss(error).sum().backward()
    assert error.grad.flatten().tolist() == approx(expected)


@pytest.mark.parametrize("loss", CRITIC_LOSSES.values(), ids=CRITIC_LOSSES)
def test_no_error_gives_zero_and_no_nan(loss):
    error = errors((0.0, 0.0, 0.0))
    value = loss(error)
    value.sum().backward()
    assert value.tolist() == [0] and error.grad.flatten().tolist() == [0, 0, 0]


@pytest.mark.parametrize("loss", CRITIC_LOSSES.values(), ids=CRITIC_LOSSES)
def test_each_critic_has_its_own_loss(loss):
    other = (-0.5, 0.2, 4.0)
    both = loss(errors(E, other))
    assert both.shape == (2,)
    assert both.tolist() == [loss(errors(E)).item(), loss(errors(other)).item()]


@pytest.mark.parametrize("loss", CRITIC_LOSSES.values(), ids=CRITIC_LOSSES)
def test_an_error_counts_as_its_negative(loss):
    assert loss(errors([-e for e in E])).item() == pytest.approx(loss(errors(E)).item(), abs=1e-15)


@pytest.mark.parametrize("loss", CRITIC_LOSSES.values(), ids=CRITIC_LOSSES)
def test_importance_weights(loss):
    ones = th.ones(3, 1, dtype=th.float64)
    assert loss(errors(E), ones).item() == loss(errors(E)).item()
    # A weight multiplies the sample's share in the batch mean: weight 3 on one of three samples leaves that one alone
    alone = th.tensor([[0.0], [3.0], [0.0]], dtype=th.float64)
    error = errors(E)
    value = loss(error, alone)
    assert value.item() == pytest.approx(loss(errors((-2.0,))).item(), abs=1e-15)
    value.sum().backward()
    assert error.grad[0, 0, 0] == 0 and error.grad[0, 1, 0] != 0 and error.grad[0, 2, 0] == 0


def test_weighted_values():
    weights = th.tensor([[0.5], [1.0], [0.25]], dtype=th.float64)
    assert mse(errors(E), weights).item() == approx((0.5 + 4 + 9 / 4) / 3)
    assert huber(errors(E), weights).item() == approx((0.25 + 1.5 + 2.5 / 4) / 3)
    mean = (0.5 + 2 + 0.75) / 3
    assert rehe(errors(E), weights).item() == approx(mean * math.tanh(mean))
    each = 0.5 * math.tanh(0.5) + 2 * math.tanh(1) + 0.75 * math.tanh(1.5)
    assert rehe_elementwise(errors(E), weights).item() == approx(each / 3)


@pytest.mark.parametrize(("x", "g"), [(0.1, 0.198675), (0.5, 0.855341), (1, 1.181568), (2, 1.105329), (5, 1.000817)])
def test_length_of_the_gradient(x, g):
    for loss, sign in ((rehe, 1), (rehe, -1)):
        error = errors((sign * float(x),))
        loss(error).sum().backward()
        assert error.grad.item() == approx(sign * g)
    for sign in (1, -1):
        q_values = values(sign * float(x))
        rehae(q_values, zero()).backward()
        assert q_values.grad.item() == approx(g)  # the sign of the advantage never turns the policy gradient round


def test_largest_gradient():
    x = th.linspace(0, 10, 100_001, dtype=th.float64)[None, :, None].requires_grad_()
    g = th.autograd.grad(rehe(x.transpose(0, 1)).sum(), x)[0].flatten()
    assert g.max().item() == approx(1.199678)
    assert x.flatten()[g.argmax()].item() == pytest.approx(1.199678, abs=1e-3)


# Actor losses ---------------------------------------------------------------------------------------------------------


def test_actor_values_of_the_reference():
    assert rehae(values(*E), zero()).item() == approx(0.388522)
    assert rehae(values(*(-e for e in E)), zero()).item() == approx(-0.388522)
    assert rehae_elementwise(values(*E), zero()).item() == approx(0.551458)
    assert mean_value(values(*E), zero()).item() == approx(2 / 3)


def test_actor_gradients():
    q_values = values(*E)
    rehae(q_values, zero()).backward()
    assert q_values.grad.flatten().tolist() == approx([0.341009] * 3)
    q_values = values(*E)
    rehae_elementwise(q_values, zero()).backward()
    expected = [math.tanh(abs(x) / 2) + abs(x) / 2 / math.cosh(x / 2) ** 2 for x in E]
    assert q_values.grad.flatten().tolist() == approx([x / 3 for x in expected])
    q_values = values(*E)
    mean_value(q_values, zero()).backward()
    assert q_values.grad.flatten().tolist() == approx([1 / 3] * 3)


@pytest.mark.parametrize("name", ["rehae", "rehae_elementwise"])
def test_only_the_distance_from_the_baseline_counts(name):
    loss = ACTOR_LOSSES[name]
    shifted = loss(values(*(e + 100 for e in E)), zero() + 100)
    assert shifted.item() == pytest.approx(loss(values(*E), zero()).item(), abs=1e-12)


@pytest.mark.parametrize("name", ["rehae", "rehae_elementwise"])
def test_no_advantage_gives_zero_and_no_nan(name):
    q_values = values(2.0, 2.0)
    value = ACTOR_LOSSES[name](q_values, zero() + 2)
    value.backward()
    assert value.item() == 0 and q_values.grad.flatten().tolist() == [0, 0]


# Activation -----------------------------------------------------------------------------------------------------------


def test_leaky_sine():
    x = th.tensor([0, 0.5, math.pi / 2, -math.pi / 2, 4, 10], dtype=th.float64, requires_grad=True)
    y = LeakySine()(x)
    assert y.tolist() == approx([0, 0.479426, 1, -0.1, -0.075680, -0.054402])
    y.sum().backward()
    slopes = [1.0 if math.sin(v) > 0 else 0.1 for v in x.tolist()]
    expected = [slope * math.cos(v) for slope, v in zip(slopes, x.tolist(), strict=True)]
    assert x.grad.tolist()[1:] == approx(expected[1:])


def test_range_and_slope_of_leaky_sine():
    x = th.linspace(-20, 20, 10_001, dtype=th.float64)
    for slope in (0.0, 0.1, 0.5):
        y = LeakySine(slope)(x)
        assert y.min().item() == pytest.approx(-slope, abs=1e-5) and y.max().item() == pytest.approx(1, abs=1e-5)


# Classification -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("value", [-100.0, -2.0, -0.3, 0.0, 1.7, 4.0, 9.0])
def test_a_value_is_a_normal_distribution_over_the_bins(value):
    bins = ValueBins((-2, 4), n_bins=8).double()
    normal = NormalDist(min(max(value, -2), 4), 0.75 * 6 / 8)
    edges = [-2 + 6 / 8 * k for k in range(9)]
    mass = [normal.cdf(high) - normal.cdf(low) for low, high in itertools.pairwise(edges)]
    expected = [each / sum(mass) for each in mass]
    assert bins.probabilities(th.tensor([[value]], dtype=th.float64))[0].tolist() == approx(expected)


def test_values_are_those_expected():
    bins = ValueBins((-3, 3), n_bins=3).double()
    probabilities = th.tensor([[[0.2, 0.3, 0.5], [1 / 3] * 3]], dtype=th.float64)
    assert bins.values(probabilities.log() + 7).flatten().tolist() == approx([0.6, 0.0])


def test_far_from_the_ends_a_value_comes_back():
    bins = ValueBins((-60, 60)).double()
    values = th.linspace(-50, 50, 37, dtype=th.float64)[:, None]
    th.testing.assert_close(bins.values(bins.probabilities(values).clamp_min(1e-300).log()), values, rtol=0, atol=1e-4)


@pytest.mark.parametrize("weighted", [False, True])
def test_cross_entropy_and_its_slope(weighted):
    th.manual_seed(0)
    bins = ValueBins((-3, 5), n_bins=7).double()
    logits = th.randn(2, 6, 7, dtype=th.float64, requires_grad=True)
    target = 4 * th.randn(6, 1, dtype=th.float64)
    weights = th.rand(6, 1, dtype=th.float64) if weighted else None
    loss = bins.loss(logits, target, weights)
    each = th.stack([F.cross_entropy(critic, bins.probabilities(target), reduction="none") for critic in logits])  # (2, 6)
    th.testing.assert_close(loss, (each * (1 if weights is None else weights[:, 0])).mean(dim=1))
    (slope,) = th.autograd.grad(loss.sum(), logits)
    same_loss, own_slope, values = bins.loss_slope_and_values(logits, target, weights)
    assert th.equal(same_loss, loss)
    th.testing.assert_close(values, bins.values(logits))
    th.testing.assert_close(own_slope, slope)


def test_slope_of_the_values_expected():
    th.manual_seed(0)
    bins = ValueBins((-3, 5), n_bins=7).double()
    logits = th.randn(2, 6, 7, dtype=th.float64, requires_grad=True)
    grad = th.randn(2, 6, 1, dtype=th.float64)
    (slope,) = th.autograd.grad((bins.values(logits) * grad).sum(), logits)
    th.testing.assert_close(bins.values_slope(logits, grad), slope)


@pytest.mark.parametrize(
    "arguments, message",
    [
        (((1,),), "value_range=(1,): expected two numbers (lowest, highest)"),
        (((2, -2),), "value_range=(2, -2): expected the smaller number first"),
        (((0, float("inf")),), "value_range=inf: expected a number"),
        (((0, 1), 1), "n_bins=1: expected an integer >= 2"),
        (((1e8, 1e8 + 1),), "value_range=(100000000.0, 100000001.0): expected bins that torch.float32 can tell apart"),
        (((0, 1e39),), "value_range=(0, 1e+39): expected bins that torch.float32 can tell apart"),
    ],
)
def test_wrong_bins(arguments, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        ValueBins(*arguments)
