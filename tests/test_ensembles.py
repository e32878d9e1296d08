from functools import partial

import numpy as np
import pytest
import torch as th
from maths_helpers import assert_same_weights, batch_of, make_critic, perturb, separate_networks
from torch import nn

from sb3_symphony.common.ensembles import combine
from sb3_symphony.common.layers import LeakySine
from sb3_symphony.redq import REDQ

# Rows are samples, columns critics
Q = [[10.0, 12, 9, 11, 8], [-1.0, 0.5, -2, 1.5, 0], [5.0, 6, 7, 8, 9]]
ACTIVATIONS = [nn.ReLU, nn.ELU, nn.Tanh, nn.LeakyReLU, LeakySine, nn.Identity, nn.SiLU]


def ensemble(rows):
    return th.tensor(rows, dtype=th.float64).t()[..., None].clone().requires_grad_()  # (n_critics, batch, 1)


# Stacked networks = N separate ones -----------------------------------------------------------------------------------


@pytest.mark.parametrize("activation_fn", ACTIVATIONS)
@pytest.mark.parametrize("layer_norm", [False, True, [True, False]])
def test_forward_and_gradients_of_separate_networks(activation_fn, layer_norm):
    th.manual_seed(0)
    critic = make_critic([12, 7], n_critics=4, activation_fn=activation_fn, layer_norm=layer_norm)
    perturb(critic)
    networks = separate_networks(critic.q_networks)
    observations, actions, target = batch_of(9)
    actions.requires_grad_()
    q_values = critic(observations, actions)
    loss = (q_values - target).square().mean(dim=(1, 2)).sum()
    loss.backward()

    own_actions = actions.detach().clone().requires_grad_()
    x = th.cat([observations.double(), own_actions], dim=1)
    own_values = [network(x) for network in networks]
    sum((value - target).square().mean() for value in own_values).backward()

    assert q_values.shape == (4, 9, 1) and th.isfinite(q_values).all()
    th.testing.assert_close(q_values, th.stack(own_values), rtol=1e-12, atol=1e-12)
    th.testing.assert_close(actions.grad, own_actions.grad, rtol=1e-12, atol=1e-12)
    assert_same_weights(critic.q_networks, networks, 1e-12, "grad")


@pytest.mark.parametrize("net_arch", [[], [5], [5, 6, 7]])
@pytest.mark.parametrize("n_critics", [1, 5])
def test_any_depth_and_number(net_arch, n_critics):
    th.manual_seed(0)
    critic = make_critic(net_arch, n_critics=n_critics)
    perturb(critic)
    observations, actions, _ = batch_of(6)
    x = th.cat([observations.double(), actions], dim=1)
    expected = th.stack([network(x) for network in separate_networks(critic.q_networks)])
    th.testing.assert_close(critic(observations, actions), expected, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("layer_norm", [False, True])
@pytest.mark.parametrize("members", [[2], [3, 1], [0, 1, 2, 3]])
def test_members_are_rows_of_the_whole(layer_norm, members):
    th.manual_seed(0)
    critic = make_critic(n_critics=4, layer_norm=layer_norm)
    perturb(critic)
    observations, actions, _ = batch_of(6)
    whole = critic(observations, actions)
    th.testing.assert_close(critic(observations, actions, members), whole[members], rtol=1e-12, atol=1e-12)


def test_activations_that_critics_would_share():
    with pytest.raises(ValueError, match="activation_fn=PReLU: expected one without parameters"):
        make_critic([8], n_critics=2, activation_fn=th.nn.PReLU)


def test_no_two_critics_start_alike():
    th.manual_seed(0)
    observations, actions, _ = batch_of(4)
    for init in ("default", "xavier"):
        q_values = make_critic(n_critics=5, init=init)(observations, actions)[..., 0]
        assert len(set(q_values[:, 0].tolist())) == 5


def test_dropout_masks_are_independent_and_off_in_evaluation():
    th.manual_seed(0)
    critic = make_critic([64], n_critics=2, dropout_rate=0.5)
    layers = critic.q_networks.layers
    for layer in (layers[0], layers[-1]):  # make both critics alike
        for parameter in layer.parameters():
            parameter.data[1] = parameter.data[0]
    observations, actions, _ = batch_of(6)
    observations, actions = observations[:1].expand(6, -1), actions[:1].expand(6, -1)  # all samples alike
    critic.train()
    values = critic(observations, actions).flatten().tolist()
    assert len(set(values)) == 12  # one mask for each critic and sample
    assert values != critic(observations, actions).flatten().tolist()
    critic.eval()
    assert np.ptp(critic(observations, actions).tolist()) < 1e-12
    # Scaled by 1 / (1 - p), so that the mean stays
    critic.train()
    many = th.stack([critic(observations, actions) for _ in range(1000)])
    assert many.mean().item() == pytest.approx(critic.eval()(observations, actions)[0, 0].item(), abs=0.02)


# combine ----------------------------------------------------------------------------------------------------------------


def test_target_values_of_the_reference():
    # y = r + gamma (1 - d) [value - alpha log_prob]
    rewards = th.tensor([[1.0], [-0.5], [-100.0]], dtype=th.float64)
    dones = th.tensor([[0.0], [0.0], [1.0]], dtype=th.float64)
    log_probs = th.tensor([[-1.5], [0.25], [-3.0]], dtype=th.float64)

    def y(value):
        return (rewards + (1 - dones) * 0.99 * (value - 0.2 * log_probs)).flatten().tolist()

    q_values = ensemble(Q).detach()
    assert y(combine(q_values[[1, 3]], "min")) == pytest.approx([12.187, -0.0545, -100])
    assert y(combine(q_values, "min")) == pytest.approx([9.217, -2.5295, -100])
    assert y(combine(q_values, "mean")) == pytest.approx([11.197, -0.7475, -100])


def test_rem_with_given_weights(monkeypatch):
    raw = ensemble([[0.2, 0.4, 0.6, 0.8, 1.0], [1.0] * 5, [0.5, 0.1, 0.1, 0.1, 0.2]]).detach()
    monkeypatch.setattr(th, "rand_like", lambda x: raw)
    value = combine(ensemble(Q).detach(), "rem")
    assert value.shape == (3, 1)
    assert (1 + 0.99 * (value[0] + 0.3)).item() == pytest.approx(10.867)
    assert (-0.5 + 0.99 * (value[1] - 0.05)).item() == pytest.approx(-0.7475)
    assert value[2].item() == pytest.approx(5 * 0.5 + (6 + 7 + 8) * 0.1 + 9 * 0.2)


def test_rem_weights_are_drawn_per_sample():
    th.manual_seed(0)
    q_values = th.tensor([0.0, 1.0, 2.0], dtype=th.float64)[:, None, None].expand(3, 2000, 1)
    value = combine(q_values, "rem")
    assert 0 <= value.min() and value.max() <= 2 and len(set(value.flatten().tolist())) == 2000
    assert value.mean().item() == pytest.approx(1, abs=0.03)


def test_mixture_of_minimum_and_mean():
    q_values = ensemble([[5.0, 4.0]]).detach()
    assert 1 + 0.99 * combine(q_values, "min", 0.7).item() == pytest.approx(5.1085, abs=1e-9)
    assert combine(q_values, "min", 1.0).item() == 4
    assert combine(q_values, "min", 0.0).item() == 4.5
    assert combine(q_values, "mean", 0.7).item() == 4.5


def test_gradient_of_the_minimum_reaches_the_smallest_critic_only():
    q_values = ensemble(Q)
    combine(q_values, "min").sum().backward()
    expected = th.zeros(5, 3, 1, dtype=th.float64)
    for sample, critic in enumerate((4, 2, 0)):
        expected[critic, sample] = 1
    assert th.equal(q_values.grad, expected)
    q_values = ensemble(Q)
    combine(q_values, "min", 0.7).sum().backward()
    th.testing.assert_close(q_values.grad, 0.7 * expected + 0.3 / 5)
    q_values = ensemble(Q)
    combine(q_values, "mean").sum().backward()
    th.testing.assert_close(q_values.grad, th.full_like(expected, 0.2))


# The random subset ------------------------------------------------------------------------------------------------------


def drawer(n_critics, subset_size, target_mode="min"):
    """``REDQ._draw_subset`` of a model without networks."""
    model = REDQ.__new__(REDQ)
    model.n_critics, model.subset_size, model.target_mode = n_critics, subset_size, target_mode
    return partial(REDQ._draw_subset, model)


def draws(n_critics, subset_size, n_draws):
    np.random.seed(0)
    draw = drawer(n_critics, subset_size)
    return [draw() for _ in range(n_draws)]


def test_every_critic_and_pair_is_equally_likely():
    n_draws = 30_000
    subsets = draws(10, 2, n_draws)
    assert all(len(set(subset)) == 2 for subset in subsets)
    pairs = np.zeros((10, 10))
    for subset in subsets:
        pairs[min(subset), max(subset)] += 1
    observed = pairs[np.triu_indices(10, 1)]
    expected = n_draws / 45
    assert observed.sum() == n_draws
    assert ((observed - expected) ** 2 / expected).sum() < 78.7  # chi-square, 44 degrees of freedom, p = 0.001
    single = np.bincount(np.concatenate(subsets), minlength=10) / n_draws
    assert single == pytest.approx(np.full(10, 0.2), abs=4.5 * np.sqrt(0.16 / n_draws))


@pytest.mark.parametrize("size", [1.5, 2.5, 1.25])
def test_fractional_sizes(size):
    n_draws = 10_000
    sizes = np.array([len(subset) for subset in draws(10, size, n_draws)])
    low = int(size)
    assert set(sizes) == {low, low + 1}
    assert sizes.mean() == pytest.approx(size, abs=4.5 * 0.5 / np.sqrt(n_draws))


@pytest.mark.parametrize(
    ("size", "expected"),
    [(1, 5.5), (1.5, 4.583333), (2, 3.666667), (2.5, 3.208333), (3, 2.75), (5, 1.833333)],
)
def test_expected_minimum(size, expected):
    minima = np.array([min(subset) + 1 for subset in draws(10, size, 20_000)])
    assert minima.mean() == pytest.approx(expected, abs=4.5 * minima.std() / np.sqrt(20_000))


@pytest.mark.parametrize(("size", "expected"), [(1, 2.44), (2, 0.47), (3, -0.25)])
def test_expected_minimum_of_five(size, expected):
    values = np.array([3.2, -1, 0.5, 2, 7.5])
    minima = np.array([values[subset].min() for subset in draws(5, size, 20_000)])
    assert minima.mean() == pytest.approx(expected, abs=4.5 * minima.std() / np.sqrt(20_000))


def test_all_critics_without_a_draw():
    np.random.seed(0)
    state = np.random.get_state()[1].tolist()
    assert drawer(5, "all")() is None and drawer(5, 5)() is None and drawer(5, 5.0)() is None
    assert drawer(5, 2, "mean")() is None and drawer(5, 2, "rem")() is None
    assert np.random.get_state()[1].tolist() == state
