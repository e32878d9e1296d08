import copy
import pickle

import cloudpickle
import numpy as np
import pytest
import torch as th
from maths_helpers import OBS_DIM, assert_same_weights, batch_of, box, make_critic, perturb, separate_networks
from stable_baselines3.common.envs import FakeImageEnv
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from torch import nn

from sb3_symphony import REDQ, Symphony
from sb3_symphony.common import products
from sb3_symphony.common.ensembles import EnsembleCritic
from sb3_symphony.common.layers import LeakySine, StackedLinear
from sb3_symphony.common.losses import CRITIC_LOSSES
from sb3_symphony.common.regression import CriticRegression, FusedRegression, has_bfloat16, make_regression, not_fusable
from sb3_symphony.redq.policies import REDQPolicy
from sb3_symphony.symphony.policies import SymphonyPolicy

TAU = 0.05
UPDATES = 50


class OwnReLU(nn.ReLU):
    pass


def regression(
    engine,
    loss="mse",
    reduction="independent",
    optimizer=th.optim.Adam,
    dtype=th.float64,
    learning_rate=3e-3,
    fused=True,
    seed=0,
    optimizer_kwargs=None,
    **kwargs,
):
    """A small regression; the same arguments give the same weights whatever the engine."""
    th.manual_seed(seed)
    critic, critic_target = make_critic(dtype=dtype, **kwargs), make_critic(dtype=dtype, **kwargs)
    perturb(critic)
    perturb(critic_target, seed=8)
    flags = dict(fused=fused) if optimizer in (th.optim.Adam, th.optim.AdamW) else {}
    critic.optimizer = optimizer(critic.parameters(), lr=learning_rate, **flags, **(optimizer_kwargs or {}))
    critic.train()
    return make_regression(critic, critic_target, loss, reduction, engine)


def pair(fused_reference=False, **kwargs):
    """Autograd with torch's textbook Adam, and the fused one."""
    return regression("autograd", fused=fused_reference, **kwargs), regression("fused", **kwargs)


def run(fitter, updates=UPDATES, sizes=(24,), dtype=th.float64, weighted=False, first=0, on_update=None):
    fits = []
    for i in range(first, first + updates):
        observations, actions, target = batch_of(sizes[i * len(sizes) // UPDATES % len(sizes)], seed=i, dtype=dtype)
        weights = th.rand(target.shape, generator=th.Generator().manual_seed(i), dtype=dtype) if weighted else None
        if on_update is not None:
            on_update(i, fitter)
        fits.append(fitter.fit(observations, actions, target, TAU, weights))
    return fits


def state_of(fitter):
    """All that an update changes, by name."""
    critic = fitter.critic
    state = {f"critic.{name}": value for name, value in critic.named_parameters()}
    state.update({f"target.{name}": value for name, value in fitter.critic_target.named_parameters()})
    for name, parameter in critic.named_parameters():
        own = critic.optimizer.state[parameter]
        assert set(own) == {"step", "exp_avg", "exp_avg_sq"}
        state.update({f"{name}.{key}": value.double() for key, value in own.items()})
    return {name: value.detach() for name, value in state.items()}


def assert_equal_states(first, second, tolerance=1e-9):
    first, second = state_of(first), state_of(second)
    assert first.keys() == second.keys()
    for name, value in first.items():
        th.testing.assert_close(second[name], value, rtol=tolerance, atol=tolerance, msg=lambda m, name=name: f"{name}: {m}")


def assert_equal_runs(reference, fused, tolerance=1e-9, **kwargs):
    assert type(reference) is CriticRegression and type(fused) is FusedRegression
    results = []
    for fitter in (reference, fused):
        before = [parameter.clone() for parameter in fitter.critic.parameters()]
        th.manual_seed(1)  # of the dropout masks
        results.append(run(fitter, **kwargs))
        assert all(not th.equal(a, b) for a, b in zip(before, fitter.critic.parameters(), strict=True))
    assert_equal_states(reference, fused, tolerance)
    for one, other in zip(*results, strict=True):
        assert one.loss.shape == other.loss.shape == () and one.q_values.shape == other.q_values.shape
        assert not one.loss.requires_grad and not other.q_values.requires_grad
        th.testing.assert_close(other.loss, one.loss, rtol=tolerance, atol=tolerance)
        th.testing.assert_close(other.q_values, one.q_values, rtol=tolerance, atol=tolerance)


# Fused = autograd, in double precision --------------------------------------------------------------------------------


@pytest.mark.parametrize("activation_fn", [nn.ReLU, nn.ELU, nn.Tanh, nn.LeakyReLU, LeakySine, nn.Identity])
@pytest.mark.parametrize("layer_norm", [False, True, [True, False]], ids=["plain", "norm", "first-norm"])
@pytest.mark.parametrize("dropout_rate", [0.0, 0.3])
def test_layers(activation_fn, layer_norm, dropout_rate):
    kwargs = dict(activation_fn=activation_fn, layer_norm=layer_norm, dropout_rate=dropout_rate)
    assert_equal_runs(*pair(**kwargs))


@pytest.mark.parametrize("loss", CRITIC_LOSSES)
@pytest.mark.parametrize("reduction", ["independent", "ensemble_mean"])
@pytest.mark.parametrize("weighted", [False, True], ids=["plain", "weights"])
def test_losses(loss, reduction, weighted):
    assert_equal_runs(*pair(loss=loss, reduction=reduction), weighted=weighted)


BINS = dict(value_range=(-2.0, 3.0), n_bins=9)


@pytest.mark.parametrize("weighted", [False, True], ids=["plain", "weights"])
@pytest.mark.parametrize("n_critics", [1, 3])
@pytest.mark.parametrize("kwargs", [{}, dict(layer_norm=True, dropout_rate=0.2), dict(net_arch=[])], ids=str)
def test_classification(weighted, n_critics, kwargs):
    assert_equal_runs(*pair(loss="hl_gauss", n_critics=n_critics, **BINS, **kwargs), weighted=weighted)


def test_classification_is_that_of_separate_networks():
    """Each of them with torch's own cross-entropy toward the probabilities of the bins."""
    fitter = regression("fused", loss="hl_gauss", dropout_rate=0.0, **BINS)
    networks = separate_networks(fitter.critic.q_networks)
    optimizer = th.optim.Adam([p for network in networks for p in network.parameters()], lr=3e-3)
    for i in range(5):
        observations, actions, target = batch_of(24, seed=i)
        fitter.fit(observations, actions, target, TAU)
        logits = [network(th.cat([observations, actions], dim=1)) for network in networks]
        loss = sum(nn.functional.cross_entropy(each, fitter.critic.bins.probabilities(target)) for each in logits)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    assert_same_weights(fitter.critic.q_networks, networks, 1e-9)


@pytest.mark.parametrize("optimizer", [th.optim.Adam, th.optim.AdamW])
@pytest.mark.parametrize(
    "optimizer_kwargs", [dict(weight_decay=0.05), dict(betas=(0.5, 0.9), eps=1e-3), dict(betas=(0.8, 0.99), weight_decay=0.1)]
)
def test_optimizers(optimizer, optimizer_kwargs):
    assert_equal_runs(*pair(optimizer=optimizer, optimizer_kwargs=optimizer_kwargs))


@pytest.mark.parametrize("beta2", [0.999, 0.99999])
def test_second_moments_in_single_precision(beta2):
    """As exact as torch's, however close to 1 their decay is."""
    sums = []
    for engine, dtype in (("fused", th.float32), ("autograd", th.float64)):
        fitter = regression(engine, dtype=dtype, optimizer_kwargs=dict(betas=(0.9, beta2)))
        run(fitter, updates=3, dtype=dtype)
        sums.append(sum(each["exp_avg_sq"].double().sum().item() for each in fitter.critic.optimizer.state.values()))
    assert sums[0] == pytest.approx(sums[1], rel=1e-5)


def test_decoupled_weight_decay_of_adam():
    assert_equal_runs(*pair(optimizer_kwargs=dict(weight_decay=0.5, decoupled_weight_decay=True)))


@pytest.mark.parametrize("net_arch", [[], [7], [16, 8, 12], [1, 1]], ids=str)
@pytest.mark.parametrize("n_critics", [1, 2, 5])
def test_shapes(net_arch, n_critics):
    assert_equal_runs(*pair(net_arch=net_arch, n_critics=n_critics))


def test_symphony_network():
    kwargs = dict(activation_fn=[nn.Identity, LeakySine], layer_norm=[True, False], leaky_slope=0.2, loss="rehe", n_critics=2)
    assert_equal_runs(*pair(**kwargs))


@pytest.mark.parametrize("kwargs", [{}, dict(layer_norm=True, dropout_rate=0.2, activation_fn=LeakySine)])
def test_batch_size_that_changes(kwargs):
    assert_equal_runs(*pair(**kwargs), sizes=(24, 40, 1, 24))


@pytest.mark.parametrize("activation_fn", [nn.ReLU, nn.Tanh, nn.ELU, LeakySine])
@pytest.mark.parametrize("net_arch", [[], [16, 8]], ids=str)
@pytest.mark.parametrize("layer_norm", [False, True])
@pytest.mark.parametrize("dropout_rate", [0.0, 0.3])
@pytest.mark.parametrize("bins", [{}, dict(loss="hl_gauss", **BINS)], ids=["values", "bins"])
def test_values_for_the_actor_and_the_target(activation_fn, net_arch, layer_norm, dropout_rate, bins):
    kwargs = dict(activation_fn=activation_fn, net_arch=net_arch, layer_norm=layer_norm, dropout_rate=dropout_rate, **bins)
    results = []
    for fitter in pair(n_critics=4, **kwargs):
        th.manual_seed(2)
        run(fitter, 3)
        observations, actions, weights = batch_of(24, seed=9)
        results.append([])
        for members in (None, [2, 0], [1], [3, 1, 0, 2]):
            q_values = fitter.target_q_values(observations, actions, members)
            assert q_values.shape == (4 if members is None else len(members), 24, 1) and not q_values.requires_grad
            results[-1].append(q_values.clone())
        actions.requires_grad_()
        q_values = fitter.q_values(observations, actions)
        (gradient,) = th.autograd.grad((q_values * weights).sin().sum(), actions)  # one that differs between critics
        results[-1] += [q_values.detach(), gradient]
        results[-1].append(fitter.fit(observations, actions.detach(), weights, TAU).q_values)  # nothing has been disturbed
    for one, other in zip(*results, strict=True):
        th.testing.assert_close(other, one, rtol=1e-9, atol=1e-9)
        assert one.abs().max() > 0


def test_learning_rate_that_changes():
    def change(i, fitter):
        for group in fitter.critic.optimizer.param_groups:
            group["lr"] = 3e-3 if i < 20 else 1e-4

    assert_equal_runs(*pair(), on_update=change)
    constant, changed = regression("fused"), regression("fused")
    run(constant)
    run(changed, on_update=change)
    assert not th.allclose(constant.critic.q_networks.layers[0].weight, changed.critic.q_networks.layers[0].weight)


def test_targets_that_share_memory_with_nothing():
    """What a fit returns, and its arguments, stay as they are when the next one runs."""
    for engine in ("autograd", "fused"):
        fitter = regression(engine)
        observations, actions, target = batch_of(24)
        copies = [x.clone() for x in (observations, actions, target)]
        first = fitter.fit(observations, actions, target, TAU)
        kept = first.loss.clone(), first.q_values.clone()
        fitter.fit(*batch_of(24, seed=1), TAU)
        assert th.equal(first.loss, kept[0]) and th.equal(first.q_values, kept[1])
        assert all(th.equal(x, y) for x, y in zip(copies, (observations, actions, target), strict=True))


def test_critics_and_targets_take_turns_in_one_memory():
    fitter = regression("fused", layer_norm=True, dropout_rate=0.1, activation_fn=LeakySine)
    observations, actions, target = batch_of(24)
    fitter.target_q_values(observations, actions)
    fitter.fit(observations, actions, target, TAU)
    (own,), (targets,) = fitter._networks.values()
    for one, other in zip(own.hidden, targets.hidden, strict=True):
        assert one.weight is not other.weight
        for name in ("out", "grad", "product", "rstd", "derivative"):
            assert getattr(one, name) is getattr(other, name)
    fitter.fit(*batch_of(12), TAU)  # another batch size, another memory
    assert fitter._networks[fitter.critic][0].hidden[0].out is not own.hidden[0].out


def test_polyak_coefficients():
    for tau in (0.0, 1.0):
        for engine in ("autograd", "fused"):
            fitter = regression(engine)
            before = copy.deepcopy(fitter.critic_target.state_dict())
            fitter.fit(*batch_of(24), tau)
            wanted = before if tau == 0 else fitter.critic.state_dict()
            for name, value in fitter.critic_target.state_dict().items():
                th.testing.assert_close(value, wanted[name], rtol=1e-14, atol=1e-14)


def test_polyak_of_the_reference():
    for engine in ("autograd", "fused"):
        fitter = regression(engine, net_arch=[], n_critics=1, learning_rate=0.0)
        weight, target = fitter.critic.q_networks.layers[0].weight, fitter.critic_target.q_networks.layers[0].weight
        weight.data[0, :3, 0] = th.tensor([2.0, -1.0, 0.5])
        target.data[0, :3, 0] = th.tensor([1.0, -2.0, 0.5])
        fitter.fit(*batch_of(8), 0.005)
        assert target[0, :3, 0].tolist() == pytest.approx([1.005, -1.995, 0.5])
        for _ in range(19):
            fitter.fit(*batch_of(8), 0.005)
        assert target[0, :3, 0].tolist() == pytest.approx([1.09538952, -1.90461048, 0.5])
        fitter = regression(engine, net_arch=[], n_critics=1, learning_rate=0.0)
        weight, target = fitter.critic.q_networks.layers[0].weight, fitter.critic_target.q_networks.layers[0].weight
        weight.data.fill_(2.0)
        target.data.fill_(1.0)
        fitter.fit(*batch_of(8), 0.003)
        assert target.flatten().tolist() == pytest.approx([1.003] * target.numel())


# Single precision -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kwargs", [{}, dict(layer_norm=True, dropout_rate=0.1), dict(activation_fn=LeakySine, loss="rehe")])
def test_single_precision(kwargs):
    fitters = pair(dtype=th.float32, **kwargs)
    for fitter in fitters:
        th.manual_seed(1)
        run(fitter, dtype=th.float32)
    first, second = map(state_of, fitters)
    for name, value in first.items():
        assert second[name].dtype == value.dtype
        assert th.norm(second[name] - value) <= 1e-3 * th.norm(value), name


# Half precision -------------------------------------------------------------------------------------------------------

native_bfloat16 = pytest.mark.skipif(not has_bfloat16(), reason="the processor has no bfloat16 arithmetic")


@native_bfloat16
@pytest.mark.parametrize("kwargs", [{}, dict(layer_norm=True, dropout_rate=0.1), dict(activation_fn=LeakySine)])
def test_bfloat16_is_close(kwargs):
    """Values and steps differ by rounding errors of 2⁻⁸ that do not add up."""
    kwargs = dict(dtype=th.float32, net_arch=[64, 80], n_critics=3, loss="huber", **kwargs)  # 64 x 80: large enough
    single, half = regression("fused", **kwargs), regression("bf16", **kwargs)
    assert single.bfloat16 is False and half.bfloat16 is True
    observations, actions, target = batch_of(64, dtype=th.float32)
    values = []
    for fitter in (single, half):
        th.manual_seed(1)
        first = fitter.target_q_values(observations, actions, [2, 0]).clone()
        actions = actions.detach().requires_grad_()
        (gradient,) = th.autograd.grad(fitter.q_values(observations, actions).sum(), actions)
        fits = [fitter.fit(observations, actions.detach(), target, TAU) for _ in range(100)]
        values.append([first, gradient, fits[0].q_values, fits[-1].q_values])
        assert fits[-1].loss < 0.8 * fits[0].loss
    for one, other in zip(*values, strict=True):
        assert other.dtype == th.float32 and not th.equal(one, other)
    for one, other in list(zip(*values, strict=True))[:3]:
        assert th.norm(other - one) <= 0.05 * th.norm(one)


def test_bfloat16_where_the_processor_lacks_it(small, algorithm, monkeypatch):
    monkeypatch.setattr("sb3_symphony.common.regression.has_bfloat16", lambda: False)
    with pytest.raises(ValueError, match=r"critic_engine='bf16' is not possible: the processor .*AVX512-BF16.*'auto'"):
        small(algorithm, policy_kwargs=dict(critic_engine="bf16"))


@pytest.mark.parametrize("engine", ["bf16", "fused"])
def test_loaded_where_the_engine_is_impossible(small, algorithm, engine, monkeypatch, tmp_path):
    """A model trained on a server acts, and goes on learning, on another machine."""
    monkeypatch.setattr("sb3_symphony.common.regression.has_bfloat16", lambda: True)
    model = small(algorithm, policy_kwargs=dict(critic_engine=engine))
    model.save(tmp_path / "model")
    monkeypatch.setattr("sb3_symphony.common.regression.has_bfloat16", lambda: False)
    monkeypatch.setattr("sb3_symphony.common.regression.not_fusable", lambda _: "reason" if engine == "fused" else None)
    with pytest.warns(UserWarning, match=f"critic_engine='{engine}' is not possible.*'auto'"):
        loaded = algorithm.load(tmp_path / "model", env=model.env)
    assert type(loaded._regression) is (CriticRegression if engine == "fused" else FusedRegression)
    loaded.learn(30)


# Frozen parameters ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("engine", ["autograd", "fused"])
def test_frozen_layers_stay_as_they_are(small, algorithm, engine):
    model = small(algorithm, policy_kwargs=dict(critic_engine=engine))
    networks = model.actor, model.critic
    frozen = [next(parameter for parameter in network.parameters() if parameter.ndim > 1) for network in networks]
    before = [parameter.detach().clone() for parameter in frozen]
    last = [list(network.parameters())[-1] for network in networks]
    start = [parameter.detach().clone() for parameter in last]
    for parameter in frozen:
        parameter.requires_grad = False
    model.learn(60)
    assert all(map(th.equal, frozen, before)) and not any(map(th.equal, last, start))


def test_a_frozen_actor_has_its_critics_fitted(make):
    model = make()
    model.actor.requires_grad_(False)
    before = copy.deepcopy([model.actor.state_dict(), model.critic.state_dict()])
    model.learn(19).learn(60)
    assert all(th.equal(value, before[0][name]) for name, value in model.actor.state_dict().items())
    assert not any(th.equal(value, before[1][name]) for name, value in model.critic.state_dict().items())


def test_frozen_for_a_while():
    def on_update(i, fitter):
        for parameter in list(fitter.critic.q_networks.parameters())[:2]:
            parameter.requires_grad = i % 20 >= 10

    fitters = pair()
    for fitter in fitters:
        run(fitter, on_update=on_update)
    assert_equal_states(*fitters)


# What others do with the critics --------------------------------------------------------------------------------------


@pytest.mark.parametrize("hooked", ["gradient", "accumulated", "step"])
def test_hooks_are_called(hooked):
    """To clip gradients, for example; for some of the updates."""

    def halve(parameter):
        parameter.grad.mul_(0.5)

    def hook(critic):
        if hooked == "gradient":
            return [parameter.register_hook(lambda grad: 0.5 * grad) for parameter in critic.q_networks.parameters()]
        if hooked == "accumulated":
            return [parameter.register_post_accumulate_grad_hook(halve) for parameter in critic.q_networks.parameters()]
        return [critic.optimizer.register_step_pre_hook(lambda *_: [*map(halve, critic.q_networks.parameters())] and None)]

    fitters, untouched = pair(optimizer_kwargs=dict(eps=0.1)), regression("autograd", optimizer_kwargs=dict(eps=0.1))
    for fitter in fitters:
        run(fitter, 5)
        hooks = hook(fitter.critic)
        run(fitter, 5, first=5)
        for each in hooks:
            each.remove()
        run(fitter, 5, first=10)
    assert_equal_states(*fitters)
    run(untouched, 15)
    assert any((state_of(untouched)[name] - value).abs().max() > 1e-6 for name, value in state_of(fitters[0]).items())


@pytest.mark.parametrize("optimizer, kwargs", [(th.optim.SGD, {}), (th.optim.Adam, {"amsgrad": True}), (th.optim.AdamW, {})])
def test_another_optimizer_is_used(optimizer, kwargs):
    fitters = pair()
    for fitter in fitters:
        run(fitter, 5)
        fitter.critic.optimizer = optimizer(fitter.critic.parameters(), lr=1e-2, **kwargs)
        run(fitter, 20, first=5)
    for a, b in zip(fitters[0].critic.parameters(), fitters[1].critic.parameters(), strict=True):
        th.testing.assert_close(a, b, rtol=1e-9, atol=1e-9)


def test_options_of_the_group_count_not_those_given_at_first():
    fitters = pair()
    for fitter in fitters:
        run(fitter, 5)
        fitter.critic.optimizer.param_groups[0]["maximize"] = True
        run(fitter, 5, first=5)
    assert_equal_states(*fitters)


@pytest.mark.parametrize("turned", ["critic", "critic_target"])
def test_weights_that_are_not_contiguous_are_learned(turned):
    """Those of separate networks, which are (out, in), come stacked like that."""
    fitters = pair()
    for fitter in fitters:
        for layer in getattr(fitter, turned).q_networks.layers:
            if isinstance(layer, StackedLinear):
                layer.weight.data = layer.weight.data.transpose(1, 2).contiguous().transpose(1, 2)
        learned = [*fitter.critic.parameters(), *fitter.critic_target.parameters()]
        before = [parameter.detach().clone() for parameter in learned]
        run(fitter, 10)
        assert not any(map(th.equal, learned, before))
    assert_equal_states(*fitters)


@pytest.mark.parametrize("n_groups", [1, 2])
def test_groups_of_parameters_keep_their_own_options(n_groups):
    """Biases alone are learned; or weights too, and those decay."""
    fitters = pair()
    for fitter in fitters:
        run(fitter, 5)
        biases = [parameter for parameter in fitter.critic.q_networks.parameters() if parameter.shape[1] == 1]
        weights = [parameter for parameter in fitter.critic.q_networks.parameters() if parameter.shape[1] > 1]
        groups = [{"params": biases}, {"params": weights, "weight_decay": 0.5}][:n_groups]
        fitter.critic.optimizer = th.optim.AdamW(groups, lr=1e-2, weight_decay=0.0, fused=True)
        run(fitter, 10, first=5)
    for a, b in zip(fitters[0].critic.parameters(), fitters[1].critic.parameters(), strict=True):
        th.testing.assert_close(a, b, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("whole", [True, False])
def test_replaced_layers_and_parameters_are_used(whole):
    """The last layer is reset now and then, against early overfitting."""
    fitters = pair()
    for fitter in fitters:
        for i in range(3):
            run(fitter, 4, first=4 * i)
            for critic in (fitter.critic, fitter.critic_target):
                layers = critic.q_networks.layers
                th.manual_seed(i)
                fresh = StackedLinear(*layers[-1].weight.shape).to(layers[-1].weight)
                if whole:
                    layers[-1] = fresh
                else:
                    layers[-1].weight, layers[-1].bias = fresh.weight, fresh.bias
            fitter.critic.optimizer = th.optim.Adam(fitter.critic.parameters(), lr=1e-2, fused=True)
        run(fitter, 4, first=12)
    assert_equal_states(*fitters)


def test_memory_is_lent_to_what_has_the_same_shapes_and_precision_only():
    fitter = regression("fused")
    observations, actions, target = batch_of(24)
    run(fitter, 2)
    fitter.target_q_values(observations, actions)
    for critic in (fitter.critic, fitter.critic_target):
        critic.double() if critic.q_networks.layers[0].weight.dtype == th.float32 else critic.float()
    fitter.critic.optimizer = th.optim.Adam(fitter.critic.parameters(), fused=True)
    other = fitter.critic.q_networks.layers[0].weight.dtype
    batch = [each.to(other) for each in (observations, actions, target)]
    assert fitter.target_q_values(*batch[:2]).dtype == fitter.fit(*batch, TAU).loss.dtype == other


class Sevens(EnsembleCritic):
    def outputs(self, obs, actions, members=None):
        return super().outputs(obs, actions, members) * 0 + 7


@pytest.mark.parametrize("cls", [REDQ, Symphony])
def test_critics_of_another_class_are_asked(small, cls):
    model = small(cls)
    for critic in (model.critic, model.critic_target):
        critic.__class__ = Sevens
    with pytest.raises(ValueError, match="the critic is Sevens, not EnsembleCritic"):
        make_regression(model.critic, model.critic_target, "mse", "independent", "fused")
    model._create_regression()
    assert type(model._regression) is CriticRegression
    fused = FusedRegression(model.critic, model.critic_target, "mse", "independent")
    for name in ("q_values", "target_q_values"):
        assert getattr(fused, name)(th.zeros(4, 3), th.zeros(4, 1)).unique().tolist() == [7.0]


def test_wrapped_step_and_module_hooks_are_called():
    observations, actions, target = batch_of(8)
    fitter, calls = regression("fused"), []
    optimizer, step = fitter.critic.optimizer, fitter.critic.optimizer.step
    optimizer.step = lambda *args: calls.append("step") or step(*args)
    fitter.fit(observations, actions, target, TAU)
    del optimizer.step
    hooks = [
        each.q_networks.register_forward_hook(lambda *_: calls.append("forward"))
        for each in (fitter.critic, fitter.critic_target)
    ]
    fitter.fit(observations, actions, target, TAU)
    fitter.q_values(observations, actions)
    fitter.target_q_values(observations, actions)
    for hook in hooks:
        hook.remove()
    fitter.fit(observations, actions, target, TAU)
    assert calls == ["step", "forward", "forward", "forward"]


def test_dropout_that_falls_to_nothing():
    fitters = pair(dropout_rate=0.1)

    def on_update(i, fitter):
        for critic in (fitter.critic, fitter.critic_target):
            for layer in critic.q_networks.layers:
                if isinstance(layer, nn.Dropout):
                    layer.p = max(0.0, 0.1 - 0.02 * i)

    for fitter in fitters:
        th.manual_seed(1)
        run(fitter, 10, on_update=on_update)
    assert_equal_states(*fitters)


def test_weights_from_a_vector():
    """SB3's load_from_vector gives parameters other memory."""
    fitters = pair()
    for fitter in fitters:
        run(fitter, 5)
        vector = nn.utils.parameters_to_vector(fitter.critic.parameters())
        nn.utils.vector_to_parameters(vector, fitter.critic_target.parameters())
        run(fitter, 5, first=5)
        nn.utils.vector_to_parameters(0.5 * vector, fitter.critic.parameters())
        run(fitter, 5, first=10)
    assert_equal_states(*fitters)


@pytest.mark.parametrize("engine", ["autograd", "fused"])
def test_another_policy_is_trained(small, algorithm, engine):
    """As SB3's own algorithms do once their aliases are made again."""
    model = small(algorithm, policy_kwargs=dict(critic_engine=engine)).learn(30)
    model.policy = model.policy_class(model.observation_space, model.action_space, model.lr_schedule, **model.policy_kwargs)
    model._create_aliases()
    before = copy.deepcopy(model.policy.state_dict())
    model.learn(40, reset_num_timesteps=False)
    assert not any(th.equal(value, before[name]) for name, value in model.policy.state_dict().items())


@pytest.mark.parametrize("activation_fn", [nn.ReLU, nn.Tanh, nn.ELU])
def test_a_trained_model_is_pickled(make, activation_fn):
    model = make(policy_kwargs=dict(activation_fn=activation_fn)).learn(40)
    pickled = pickle.dumps(model.policy), pickle.dumps(model)
    assert len(pickled[1]) < 400_000  # no workspaces, but a replay buffer
    cloudpickle.dumps(model)
    copies = [model, pickle.loads(pickled[1])]
    for each in copies:
        th.manual_seed(0)
        np.random.seed(0)
        each.train(3, 16)
    for a, b in zip(*(each.policy.parameters() for each in copies), strict=True):
        assert th.equal(a, b)


# State of the optimiser -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("before", "after"), [("autograd", "fused"), ("fused", "autograd")])
@pytest.mark.parametrize("fused_reference", [False, True])
def test_saved_by_one_engine_and_continued_by_the_other(before, after, fused_reference):
    options = {"autograd": fused_reference, "fused": True}
    straight = regression(before, fused=options[before])
    run(straight, 40)
    start = regression(before, fused=options[before])
    run(start, 20)
    continued = regression(after, fused=options[after], seed=5)  # other weights
    continued.critic.load_state_dict(copy.deepcopy(start.critic.state_dict()))
    continued.critic_target.load_state_dict(copy.deepcopy(start.critic_target.state_dict()))
    continued.critic.optimizer.load_state_dict(copy.deepcopy(start.critic.optimizer.state_dict()))
    run(continued, 20, first=20)
    assert_equal_states(straight, continued)
    assert {float(state["step"]) for state in continued.critic.optimizer.state.values()} == {40.0}


def test_weights_loaded_between_updates_are_used():
    """Loading writes into the parameters in place; the fused engine's workspaces must not hold copies of the old ones."""
    reference, fused = pair()
    for fitter in (reference, fused):
        run(fitter, 5)
        other = regression("autograd", seed=9)
        fitter.critic.load_state_dict(other.critic.state_dict())
        fitter.critic_target.load_state_dict(other.critic_target.state_dict())
        run(fitter, 5, first=5)
    assert_equal_states(reference, fused)


def test_state_reset_between_updates():
    """Of the last layer, as where networks are partly drawn anew: the moments of the others go on."""
    fitters = pair()
    for fitter in fitters:
        run(fitter, 5)
        for parameter in fitter.critic.q_networks.layers[-1].parameters():
            del fitter.critic.optimizer.state[parameter]
        run(fitter, 5, first=5)
        assert {float(state["step"]) for state in fitter.critic.optimizer.state.values()} == {5.0, 10.0}
    assert_equal_states(*fitters)


@pytest.mark.parametrize("policy_class", [REDQPolicy, SymphonyPolicy])
def test_optimizer_holds_the_parameters_in_their_order(policy_class):
    policy = policy_class(box(OBS_DIM), box(2), lambda _: 1e-3, net_arch=[8, 8], n_critics=3, layer_norm=True)
    (group,) = policy.critic.optimizer.param_groups
    expected = list(policy.critic.parameters())
    assert len(group["params"]) == len(expected) == 10
    assert all(a is b for a, b in zip(group["params"], expected, strict=True))
    assert group["lr"] == 1e-3


# N separate networks --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("engine", ["autograd", "fused"])
@pytest.mark.parametrize("layer_norm", [False, True])
@pytest.mark.parametrize("reduction", ["independent", "ensemble_mean"])
def test_separate_networks_with_separate_optimizers(engine, layer_norm, reduction):
    fitter = regression(engine, layer_norm=layer_norm, reduction=reduction, n_critics=4)
    networks, targets = (separate_networks(critic.q_networks) for critic in (fitter.critic, fitter.critic_target))
    optimizers = [th.optim.Adam(network.parameters(), lr=3e-3) for network in networks]
    for i in range(5):
        observations, actions, target = batch_of(24, seed=i)
        fit = fitter.fit(observations, actions, target, TAU)

        x = th.cat([observations.double(), actions], dim=1)
        q_values = [network(x) for network in networks]
        if reduction == "independent":
            loss = sum(((target - q_value) ** 2).mean() for q_value in q_values)
        else:
            loss = ((target - sum(q_values) / 4) ** 2).mean()
        for optimizer in optimizers:
            optimizer.zero_grad()
        loss.backward()
        for optimizer in optimizers:
            optimizer.step()
        with th.no_grad():
            for network, slow in zip(networks, targets, strict=True):
                for parameter, follower in zip(network.parameters(), slow.parameters(), strict=True):
                    follower.copy_((1 - TAU) * follower + TAU * parameter)

        assert fit.loss.item() == pytest.approx(loss.item(), rel=1e-10)
        th.testing.assert_close(fit.q_values, th.stack(q_values).detach(), rtol=1e-10, atol=1e-10)
    assert_same_weights(fitter.critic.q_networks, networks, 1e-10)
    assert_same_weights(fitter.critic_target.q_networks, targets, 1e-10)


@pytest.mark.parametrize(
    ("reduction", "loss", "gradient"),
    [("independent", 1.5, [[-1, 0], [-1, 1]]), ("ensemble_mean", 0.0625 * 2, [[-0.25, -0.25], [0, 0]])],
)
def test_critic_loss_of_the_reference(reduction, loss, gradient):
    """``ensemble_mean`` without the factor 1/2 of the reference."""
    fitter = regression("autograd", n_critics=2, reduction=reduction)
    q_values = th.tensor([[1.0, 2.0], [3.0, 5.0]], dtype=th.float64).t()[..., None].clone().requires_grad_()
    value = fitter.objective.loss(q_values, th.tensor([[2.0], [4.0]], dtype=th.float64), None).sum()
    value.backward()
    assert value.item() == pytest.approx(loss)
    assert q_values.grad[..., 0].t().tolist() == gradient


# Which engine ---------------------------------------------------------------------------------------------------------


class OwnExtractor(BaseFeaturesExtractor):
    def __init__(self, observation_space):
        super().__init__(observation_space, 3)
        self.linear = nn.Linear(3, 3)

    def forward(self, observations):
        return self.linear(observations)


NOT_FUSABLE = [
    (dict(optimizer_class=th.optim.SGD), "SGD"),
    (dict(optimizer_class=th.optim.RMSprop), "RMSprop"),
    (dict(activation_fn=OwnReLU), "OwnReLU"),
    (dict(activation_fn=nn.SiLU), "SiLU"),
    (dict(features_extractor_class=OwnExtractor), "OwnExtractor"),
    (dict(optimizer_kwargs=dict(amsgrad=True)), "amsgrad"),
    (dict(optimizer_kwargs=dict(maximize=True)), "maximize"),
    (dict(optimizer_kwargs=dict(fused=False)), "fused=False"),
]


@pytest.mark.parametrize("cls", [REDQ, Symphony])
@pytest.mark.parametrize(("policy_kwargs", "reason"), NOT_FUSABLE, ids=[reason for _, reason in NOT_FUSABLE])
def test_what_cannot_be_fused(small, cls, policy_kwargs, reason):
    with pytest.raises(ValueError, match=rf"critic_engine='fused'.*{reason}.*'auto' or 'autograd'"):
        small(cls, policy_kwargs=dict(policy_kwargs, critic_engine="fused"))
    for engine in ("auto", "autograd"):
        model = small(cls, policy_kwargs=dict(policy_kwargs, critic_engine=engine))
        assert type(model._regression) is CriticRegression
        assert reason in not_fusable(model.critic)


@pytest.mark.parametrize("cls", [REDQ, Symphony])
def test_images_are_not_fused(small, cls):
    env = FakeImageEnv(discrete=False, screen_height=36, screen_width=36)
    with pytest.raises(ValueError, match="NatureCNN"):
        small(cls, env, policy="CnnPolicy", policy_kwargs=dict(critic_engine="fused"))
    assert type(small(cls, env, policy="CnnPolicy")._regression) is CriticRegression


def test_choice_of_the_engine(small, algorithm):
    assert type(small(algorithm)._regression) is FusedRegression
    assert type(small(algorithm, policy_kwargs=dict(critic_engine="fused"))._regression) is FusedRegression
    assert type(small(algorithm, policy_kwargs=dict(critic_engine="autograd"))._regression) is CriticRegression
    adamw = small(algorithm, policy_kwargs=dict(optimizer_class=th.optim.AdamW, optimizer_kwargs=dict(weight_decay=0.01)))
    assert type(adamw._regression) is FusedRegression
    with pytest.raises(ValueError, match="critic_engine='fast'"):
        small(algorithm, policy_kwargs=dict(critic_engine="fast"))


@pytest.mark.parametrize("tiles", [False, True])
@pytest.mark.parametrize("policy_kwargs", [{}, dict(dropout_rate=0.1, layer_norm=True)])
def test_both_engines_learn_the_same(small, algorithm, policy_kwargs, tiles, monkeypatch):
    """A short run of each algorithm, in single precision, with products by torch and by compiled tiles."""
    monkeypatch.setattr(products, "tiles_are_faster", lambda: tiles)
    weights = []
    for engine in ("autograd", "fused"):
        model = small(algorithm, policy_kwargs=dict(policy_kwargs, critic_engine=engine)).learn(60)
        assert type(model._regression) is (FusedRegression if engine == "fused" else CriticRegression)
        weights.append({name: value.double() for name, value in model.policy.state_dict().items()})
    for name, value in weights[0].items():
        assert th.norm(weights[1][name] - value) <= 1e-3 * max(th.norm(value).item(), 1.0), name


def test_workspaces_are_kept(small, algorithm, monkeypatch):
    """One for the critics, one for their targets, one for another batch size; never a new one while sizes stay."""
    import sb3_symphony.common.regression as module

    made = []
    network = module.FusedNetwork
    monkeypatch.setattr(module, "FusedNetwork", lambda *args: made.append(args[1]) or network(*args))
    model = small(algorithm).learn(40)
    assert made == [16, 16]
    model.learn(40, reset_num_timesteps=False)
    assert made == [16, 16]
    for batch_size in (40, 16, 40):
        model.train(gradient_steps=3, batch_size=batch_size)
    assert made == [16, 16, 40, 40]


def test_a_new_workspace_is_stepped_with_its_own_gradients():
    """Also if it lies where an old one was, whose identity it then has."""
    sizes = (24, 10, 17)
    reference, fused = pair()
    for i in range(UPDATES):
        observations, actions, target = batch_of(sizes[i % 3], seed=i, dtype=th.float64)
        for fitter in (reference, fused):
            fitter.fit(observations, actions, target, TAU)
        if i % 2:
            fused._networks.clear()
    for a, b in zip(reference.critic.parameters(), fused.critic.parameters(), strict=True):
        th.testing.assert_close(a, b, rtol=1e-9, atol=1e-9)


def test_gradients_of_a_fused_step_stay_out_of_grad():
    fitter = regression("fused")
    run(fitter, 2)
    assert all(parameter.grad is None for parameter in fitter.critic.parameters())
