import math

import numpy as np
import pytest
import torch as th
from maths_helpers import box
from numba import njit
from numba.core.caching import CacheImpl
from torch import nn

from sb3_symphony.common.ensembles import hidden_layers, mlp
from sb3_symphony.common.kernels import LEAKY_RELU, layer_forward
from sb3_symphony.common.layers import Dropout, LeakySine, StackedLayerNorm, StackedLinear, draw_dropped
from sb3_symphony.redq.policies import REDQPolicy
from sb3_symphony.symphony.policies import SymphonyPolicy


def count(module):
    return sum(parameter.numel() for parameter in module.parameters())


def symphony_policy(**kwargs):
    return SymphonyPolicy(box(24), box(4), lambda _: 1e-3, **kwargs)


def redq_policy(**kwargs):
    return REDQPolicy(box(24), box(4), lambda _: 1e-3, **kwargs)


# Stacked layers -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("shared_input", [True, False])
def test_stacked_linear_is_one_linear_per_member(shared_input):
    th.manual_seed(0)
    layer = StackedLinear(3, 4, 6).double()
    x = th.randn(*(() if shared_input else (3,)), 5, 4, dtype=th.float64)
    out = layer(x)
    assert out.shape == (3, 5, 6)
    for k in range(3):
        single = (x if shared_input else x[k]) @ layer.weight[k] + layer.bias[k]
        th.testing.assert_close(out[k], single, rtol=0, atol=1e-14)


@pytest.mark.parametrize(
    ("fan_in", "fan_out", "bound"), [(28, 256, 0.145350), (256, 256, 0.108253), (256, 1, 0.152795), (24, 256, 0.146385)]
)
def test_xavier_bound_of_every_member(fan_in, fan_out, bound):
    th.manual_seed(0)
    layer = StackedLinear(10, fan_in, fan_out, "xavier")
    assert not layer.bias.any()
    for weight in layer.weight:
        largest = weight.abs().max().item()
        assert bound * (0.9 if fan_out == 1 else 0.995) < largest < bound + 1e-6
    # Uniform: variance bound^2 / 3, and no two members alike
    assert layer.weight.var().item() == pytest.approx(bound**2 / 3, rel=0.1)
    assert len({weight[0, 0].item() for weight in layer.weight}) == 10


def test_default_bound_is_that_of_torch():
    th.manual_seed(0)
    layer, torch_layer = StackedLinear(10, 28, 256), nn.Linear(28, 256)
    bound = 1 / math.sqrt(28)
    for parameter in (*layer.weight, *layer.bias, torch_layer.weight, torch_layer.bias):
        assert 0.97 * bound < parameter.abs().max().item() <= bound


def test_layer_norm_of_the_reference():
    x = th.tensor([1.0, 2, 3, 6], dtype=th.float64)
    layer = StackedLayerNorm(2, 4).double()
    out = layer(x.expand(2, 1, -1))
    expected = [-1.069043, -0.534522, 0, 1.603565]
    for k in range(2):
        assert out[k, 0].tolist() == pytest.approx(expected, abs=1e-5)
    # After dropout with p = 0.5 that keeps the units 0, 2 and 3
    dropped = x * th.tensor([1, 0, 1, 1]) / 0.5
    expected = [-0.654654, -1.091089, 0.218218, 1.527525]
    assert layer(dropped.expand(2, 1, -1))[1, 0].tolist() == pytest.approx(expected, abs=1e-5)


@pytest.mark.parametrize("rate", [0.001, 0.01, 0.1, 0.11, 0.5])
@pytest.mark.parametrize("shape", [(2, 64, 128), (7,), (1,)])
def test_dropout_drops_each_element_with_the_same_probability_independently(rate, shape):
    th.manual_seed(0)
    n_masks = 100 if len(shape) > 1 else 10_000
    layer, ones = Dropout(rate), th.ones(shape)
    masks = th.stack([layer(ones) for _ in range(n_masks)])
    assert masks.unique().tolist() == pytest.approx([0, 1 / (1 - rate)])
    dropped = (masks == 0).double().flatten(1)  # (n_masks, elements)

    def error(mean, of):  # of a frequency
        return 4.5 * math.sqrt(mean / of) + 1e-9

    assert dropped.mean().item() == pytest.approx(rate, abs=error(rate, dropped.numel()))
    for where in (dropped[:, 0], dropped[:, -1]):
        assert where.mean().item() == pytest.approx(rate, abs=error(rate, len(where)))
    for gap in (1, 2, 5):  # neighbours within a mask, and the same element of successive ones
        for first, second in ((dropped[:, :-gap], dropped[:, gap:]), (dropped[:-gap], dropped[gap:])):
            if first.numel() > 0:
                both = (first * second).mean().item()
                assert both == pytest.approx(rate**2, abs=error(rate**2, first.numel()))


def test_draws_go_on_where_the_gaps_drawn_at_once_end(monkeypatch):
    monkeypatch.setattr(th.Tensor, "geometric_", lambda self, rate: self.fill_(3))
    assert draw_dropped(100, 0.01).tolist() == list(range(2, 100, 3))
    monkeypatch.setattr(th.Tensor, "geometric_", lambda self, rate: self.fill_(len(self)))
    assert draw_dropped(9, 0.01).tolist() == [7]  # 8 gaps at once
    assert draw_dropped(7, 0.01).tolist() == []


def test_dropout_of_everything_and_of_nothing():
    x = th.ones(2, 3)
    assert Dropout(1.0)(x).tolist() == [[0] * 3] * 2
    assert th.equal(Dropout(0.0)(x), x)
    assert th.equal(Dropout(0.5).eval()(x), x)


def test_dropout_stands_before_the_normalisation():
    hidden = hidden_layers([4], nn.ReLU, layer_norm=True, dropout_rate=0.5)
    names = [type(module).__name__ for module in mlp(3, 1, hidden)]
    assert names == ["Linear", "Dropout", "LayerNorm", "ReLU", "Linear"]
    critic = redq_policy(net_arch=[4], layer_norm=True, dropout_rate=0.5).critic
    names = [type(module).__name__ for module in critic.q_networks.layers]
    assert names == ["StackedLinear", "Dropout", "StackedLayerNorm", "ReLU", "StackedLinear"]


def test_layer_norm_has_an_affine_part_per_member():
    th.manual_seed(0)
    layer = StackedLayerNorm(2, 4).double()
    layer.weight.data = th.randn(2, 1, 4, dtype=th.float64)
    layer.bias.data = th.randn(2, 1, 4, dtype=th.float64)
    x = th.randn(2, 5, 4, dtype=th.float64)
    for k in range(2):
        single = nn.functional.layer_norm(x[k], [4], layer.weight[k, 0], layer.bias[k, 0])
        th.testing.assert_close(layer(x)[k], single, rtol=0, atol=1e-14)
    th.testing.assert_close(layer(x[1:], [1])[0], layer(x)[1], rtol=0, atol=0)


# Shape of the networks ------------------------------------------------------------------------------------------------


def test_hidden_layers_of_lists():
    layers = hidden_layers([8, 9, 10], [nn.Identity, nn.ELU], [True, False], 0.1)
    assert [layer.width for layer in layers] == [8, 9, 10]
    assert [layer.activation_fn for layer in layers] == [nn.Identity, nn.ELU, nn.ELU]
    assert [layer.layer_norm for layer in layers] == [True, False, False]
    assert [layer.dropout_rate for layer in layers] == [0.1] * 3
    assert hidden_layers([], nn.ReLU) == []
    assert [layer.activation_fn for layer in hidden_layers([8, 8], (nn.Tanh,))] == [nn.Tanh] * 2


def test_slope_reaches_the_sine_layers_only():
    first, second = hidden_layers([4, 4], [LeakySine, nn.LeakyReLU], leaky_slope=0.3)
    assert first.activation_fn().slope == 0.3
    assert second.activation_fn().negative_slope == 0.01


@pytest.mark.parametrize(
    "arguments",
    [
        dict(dropout_rate=1.0),
        dict(dropout_rate=1.5),
        dict(dropout_rate=-0.1),
        dict(leaky_slope=-1.0),
        dict(net_arch=[0]),
    ],
)
def test_sizes_out_of_range(arguments):
    with pytest.raises(ValueError, match=next(iter(arguments))):
        hidden_layers(**{"net_arch": [4], "activation_fn": nn.ReLU, **arguments})


def test_number_of_parameters():
    policy = symphony_policy()
    assert count(policy.actor) == 73_732
    assert count(policy.critic) == count(policy.critic_target) == 2 * 73_985
    assert count(symphony_policy(n_critics=3).critic) == 3 * 73_985
    assert count(redq_policy().critic) == 10 * 73_473
    assert count(redq_policy(layer_norm=True, n_critics=2).critic) == 2 * (73_473 + 4 * 256)


def test_symphony_network_of_the_reference():
    policy = symphony_policy()
    names = ["Linear", "LayerNorm", "Identity", "Linear", "LeakySine", "Linear"]
    assert [type(module).__name__ for module in policy.actor.mu] == [*names, "Tanh"]
    stacked = [type(module).__name__.removeprefix("Stacked") for module in policy.critic.q_networks.layers]
    assert stacked == names
    # The same by hand
    th.manual_seed(0)
    obs = th.randn(7, 24)
    first, norm, _, second, _, last, _ = policy.actor.mu
    x = nn.functional.layer_norm(obs @ first.weight.t() + first.bias, [256], norm.weight, norm.bias, 1e-5)
    x = th.sin(x @ second.weight.t() + second.bias)
    x = th.where(x > 0, x, 0.1 * x)
    th.testing.assert_close(policy.actor(obs), th.tanh(x @ last.weight.t() + last.bias))


def test_symphony_initialisation_is_that_of_torch():
    th.manual_seed(0)
    policy = symphony_policy()
    bounds = [1 / math.sqrt(28), 1 / 16, 1 / 16]
    layers = [layer for layer in policy.critic.q_networks.layers if isinstance(layer, StackedLinear)]
    for layer, bound in zip(layers, bounds, strict=True):
        assert layer.weight.abs().max().item() <= bound
        assert layer.bias.abs().max().item() <= bound and layer.bias.any()
    for parameter, target in zip(policy.critic.parameters(), policy.critic_target.parameters(), strict=True):
        assert parameter is not target and th.equal(parameter, target)


def test_redq_initialisation_is_xavier_for_all_networks():
    th.manual_seed(0)
    policy = redq_policy()
    linears = [module for module in policy.actor.modules() if isinstance(module, nn.Linear)]
    assert len(linears) == 4  # two hidden ones, the means and the standard deviations
    for linear in linears:
        bound = math.sqrt(6 / sum(linear.weight.shape))
        assert 0.98 * bound < linear.weight.abs().max().item() <= bound + 1e-7
        assert not linear.bias.any()
    for layer in policy.critic.q_networks.layers:
        if isinstance(layer, StackedLinear):
            bound = math.sqrt(6 / sum(layer.weight.shape[1:]))
            assert all(0.9 * bound < weight.abs().max().item() <= bound + 1e-7 for weight in layer.weight)
            assert not layer.bias.any()
    for parameter, target in zip(policy.critic.parameters(), policy.critic_target.parameters(), strict=True):
        assert parameter is not target and th.equal(parameter, target)


def test_different_networks_for_actor_and_critics():
    policy = symphony_policy(
        net_arch=dict(pi=[8], qf=[9, 10, 11]),
        activation_fn=dict(pi=nn.ReLU, qf=[nn.Tanh, nn.ELU]),
        layer_norm=dict(pi=False, qf=[False, True, False]),
        leaky_slope=0.2,
    )
    assert [type(module).__name__ for module in policy.actor.mu] == ["Linear", "ReLU", "Linear", "Tanh"]
    names = [type(module).__name__.removeprefix("Stacked") for module in policy.critic.q_networks.layers]
    assert names == ["Linear", "Tanh", "Linear", "LayerNorm", "ELU", "Linear", "ELU", "Linear"]
    widths = [layer.weight.shape[1:] for layer in policy.critic.q_networks.layers if isinstance(layer, StackedLinear)]
    assert widths == [(28, 9), (9, 10), (10, 11), (11, 1)]
    # One of the two as a dict, the other as a plain value
    policy = symphony_policy(net_arch=[8], activation_fn=dict(pi=nn.ReLU, qf=nn.Tanh), layer_norm=True)
    assert [type(module).__name__ for module in policy.actor.mu] == ["Linear", "LayerNorm", "ReLU", "Linear", "Tanh"]
    names = [type(module).__name__ for module in policy.critic.q_networks.layers]
    assert names == ["StackedLinear", "StackedLayerNorm", "Tanh", "StackedLinear"]


def test_layer_norm_list_of_redq():
    critic = redq_policy(net_arch=[8, 8, 8], layer_norm=[True, False]).critic
    names = [type(module).__name__.removeprefix("Stacked") for module in critic.q_networks.layers]
    assert names == ["Linear", "LayerNorm", "ReLU", "Linear", "ReLU", "Linear", "ReLU", "Linear"]


def test_redraw_changes_the_weights_of_linear_layers_only():
    th.manual_seed(0)
    actor = symphony_policy().actor
    before = {name: parameter.clone() for name, parameter in actor.named_parameters()}
    actor.redraw()
    linears = {f"mu.{i}.weight": module for i, module in enumerate(actor.mu) if isinstance(module, nn.Linear)}
    assert len(linears) == 3
    for name, parameter in actor.named_parameters():
        assert th.equal(parameter, before[name]) == (name not in linears)
    for module in linears.values():
        bound = math.sqrt(6 / sum(module.weight.shape))
        assert 0.98 * bound < module.weight.abs().max().item() <= bound + 1e-7


def test_kernels_compile_where_nothing_can_be_cached(monkeypatch):
    """numba refuses where neither the package's folder nor the user's can be written to, as in many containers."""
    monkeypatch.setattr(CacheImpl, "_locator_classes", [])
    with pytest.raises(RuntimeError, match="cannot cache"):
        njit(cache=True)(lambda x: x)
    forward = layer_forward.__wrapped__(layer_norm=False, dropout=False, activation=LEAKY_RELU)
    product, bias, unused = np.array([[[1.0, -2.0]]]), np.array([[[0.5, 0.5]]]), np.zeros((1, 1, 2))
    members, dropped = np.array([0]), np.array([], dtype=np.int64)
    forward(product, bias, unused, unused, 0.0, 0.1, unused[0], unused, unused, members, 1.0, dropped)
    np.testing.assert_allclose(product, [[[1.5, -0.15]]])
