import copy
import math

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium.envs.classic_control import PendulumEnv
from maths_helpers import assert_same_weights, double_precision, fill, separate_networks
from stable_baselines3.common.distributions import SquashedDiagGaussianDistribution
from torch import nn

from sb3_symphony import REDQ, DroQ

GAMMA, TAU, LEARNING_RATE = 0.97, 0.01, 2e-3


class Loop(PendulumEnv):
    """An environment whose steps never matter: the buffer is filled by hand."""


def model_with_data(cls=REDQ, n_transitions=200, seed=0, **kwargs):
    policy_kwargs = {"net_arch": [12, 10], **kwargs.pop("policy_kwargs", {})}
    defaults = dict(batch_size=16, gamma=GAMMA, tau=TAU, learning_rate=LEARNING_RATE, buffer_size=500, seed=seed)
    model = cls("MlpPolicy", Loop(), policy_kwargs=policy_kwargs, device="cpu", **{**defaults, **kwargs})
    model.num_timesteps = n_transitions
    model._setup_learn(1, None)
    columns = fill(model.replay_buffer, n_transitions)
    return model, columns


def squashed_gaussian(actor, obs):
    """A reparametrised action and its log-probability, by hand."""
    latent = actor["latent_pi"](obs)
    mean, log_std = actor["mu"](latent), actor["log_std"](latent).clamp(-20, 2)
    noise = th.randn(mean.shape, dtype=th.float64)
    action = th.tanh(mean + log_std.exp() * noise)
    log_prob = -0.5 * noise**2 - log_std - 0.5 * math.log(2 * math.pi) - th.log(1 - action**2 + 1e-6)
    return action, log_prob.sum(dim=1, keepdim=True)


class SlowREDQ:
    """The algorithm of the paper, one network, one optimiser and one sample at a time."""

    def __init__(self, model, columns):
        self.columns, self.subset_size = columns, model.subset_size
        self.critics = separate_networks(model.critic.q_networks)
        self.targets = separate_networks(model.critic_target.q_networks)
        self.actor = nn.ModuleDict(
            {name: copy.deepcopy(getattr(model.actor, name)) for name in ("latent_pi", "mu", "log_std")}
        )
        self.log_ent_coef = model.log_ent_coef.detach().clone().requires_grad_()
        self.critic_optimizers = [th.optim.Adam(critic.parameters(), lr=LEARNING_RATE) for critic in self.critics]
        self.actor_optimizer = th.optim.Adam(self.actor.parameters(), lr=LEARNING_RATE)
        self.ent_coef_optimizer = th.optim.Adam([self.log_ent_coef], lr=LEARNING_RATE)
        self.target_entropy = -1.0
        self.n_updates = 0

    def train(self, n_updates, batch_size, policy_delay):
        n_stored = len(self.columns["rewards"])
        rows = np.random.randint(0, n_stored, n_updates * batch_size)
        np.random.randint(0, 1, n_updates * batch_size)  # the environments
        for i in range(n_updates):
            batch = {name: column[rows[i * batch_size : (i + 1) * batch_size]] for name, column in self.columns.items()}
            self.critic_update(batch)
            self.n_updates += 1
            if self.n_updates % policy_delay == 0:
                self.actor_update(batch)

    def critic_update(self, batch):
        if self.subset_size < len(self.critics):
            np.random.random()  # the coin of fractional sizes
        subset = np.random.permutation(len(self.critics))[: self.subset_size]
        with th.no_grad():
            action, log_prob = squashed_gaussian(self.actor, batch["next_observations"])
            x = th.cat([batch["next_observations"], action], dim=1)
            smallest = th.stack([self.targets[k](x) for k in subset]).amin(dim=0)
            value = smallest - self.log_ent_coef.exp() * log_prob
            y = batch["rewards"] + GAMMA * (1 - batch["terminated"]) * value
        x = th.cat([batch["observations"], batch["actions"]], dim=1)
        for critic, target, optimizer in zip(self.critics, self.targets, self.critic_optimizers, strict=True):
            optimizer.zero_grad()
            ((critic(x) - y) ** 2).mean().backward()
            optimizer.step()
            with th.no_grad():
                for parameter, slow in zip(critic.parameters(), target.parameters(), strict=True):
                    slow.copy_((1 - TAU) * slow + TAU * parameter)

    def actor_update(self, batch):
        action, log_prob = squashed_gaussian(self.actor, batch["observations"])
        x = th.cat([batch["observations"], action], dim=1)
        mean_q = sum(critic(x) for critic in self.critics) / len(self.critics)
        ent_coef = self.log_ent_coef.detach().exp()
        self.actor_optimizer.zero_grad()
        (ent_coef * log_prob - mean_q).mean().backward()
        self.actor_optimizer.step()

        self.ent_coef_optimizer.zero_grad()
        (-(self.log_ent_coef * (log_prob.detach() + self.target_entropy)).mean()).backward()
        self.ent_coef_optimizer.step()


# A whole call of train() ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("engine", ["autograd", "fused"])
@pytest.mark.parametrize("calls", [1, 3])
def test_train_equals_the_slow_algorithm(monkeypatch, engine, calls):
    policy_kwargs = dict(critic_engine=engine)
    model, columns = model_with_data(
        n_critics=3, subset_size=2, policy_delay=2, gradient_steps=4, policy_kwargs=policy_kwargs, ent_coef="auto_0.3"
    )
    double_precision(model, monkeypatch)
    slow = SlowREDQ(model, columns)
    start = copy.deepcopy(model.policy.state_dict())

    th.manual_seed(3)
    np.random.seed(3)
    for _ in range(calls):
        model.train(4, 16)
    th.manual_seed(3)
    np.random.seed(3)
    for _ in range(calls):
        slow.train(4, 16, policy_delay=2)

    assert model._n_updates == slow.n_updates == 4 * calls
    assert_same_weights(model.critic.q_networks, slow.critics, 1e-10)
    assert_same_weights(model.critic_target.q_networks, slow.targets, 1e-10)
    for name, module in slow.actor.items():
        for own, parameter in zip(getattr(model.actor, name).parameters(), module.parameters(), strict=True):
            th.testing.assert_close(own, parameter, rtol=1e-10, atol=1e-10)
    th.testing.assert_close(model.log_ent_coef, slow.log_ent_coef, rtol=1e-12, atol=1e-12)
    assert model.log_ent_coef.item() != pytest.approx(math.log(0.3), abs=1e-5)
    moved = [name for name, value in model.policy.state_dict().items() if not th.equal(value, start[name])]
    assert len(moved) == len(start)  # every tensor has been learnt


@pytest.mark.parametrize(("gradient_steps", "delay", "subset_size"), [(5, 3, 1), (1, 2, 3)])
def test_train_with_a_delay_across_calls(monkeypatch, gradient_steps, delay, subset_size):
    model, columns = model_with_data(n_critics=3, subset_size=subset_size, policy_delay=delay)
    double_precision(model, monkeypatch)
    slow = SlowREDQ(model, columns)
    if subset_size == 3:  # all critics: nothing is drawn
        monkeypatch.setattr("numpy.random.permutation", lambda n: np.arange(n))
    for trainer, arguments in ((model, (16,)), (slow, (16, delay))):
        th.manual_seed(3)
        np.random.seed(3)
        for _ in range(4):
            trainer.train(gradient_steps, *arguments)
    assert_same_weights(model.critic.q_networks, slow.critics, 1e-10)
    assert_same_weights(model.critic_target.q_networks, slow.targets, 1e-10)
    th.testing.assert_close(model.log_ent_coef, slow.log_ent_coef, rtol=1e-12, atol=1e-12)


# The target -----------------------------------------------------------------------------------------------------------


class Samples:
    """Stands for a batch of the replay buffer."""

    def __init__(self, rewards, dones, discounts=None):
        self.rewards, self.dones = (th.tensor(x, dtype=th.float64)[:, None] for x in (rewards, dones))
        self.observations = self.next_observations = th.zeros(len(rewards), 3)
        self.actions, self.discounts = th.zeros(len(rewards), 1), discounts


Q_ROWS = [[10.0, 12, 9, 11, 8], [-1.0, 0.5, -2, 1.5, 0], [5.0, 6, 7, 8, 9]]
RAW_WEIGHTS = [[0.2, 0.4, 0.6, 0.8, 1.0], [1.0] * 5, [0.5, 0.1, 0.1, 0.1, 0.2]]


def columns_of(rows):
    return th.tensor(rows, dtype=th.float64).t()[..., None]  # (n_critics, batch, 1)


def record_targets(model, monkeypatch):
    """The targets that the critics are fitted to, one per update."""
    recorded, fit = [], model._regression.fit

    def spy(observations, actions, target, *args):
        recorded.append(target.clone())
        return fit(observations, actions, target, *args)

    monkeypatch.setattr(model._regression, "fit", spy)
    return recorded


@pytest.mark.parametrize(
    ("target_mode", "subset", "expected"),
    [
        ("min", [1, 3], [12.187, -0.0545, -100]),
        ("min", None, [9.217, -2.5295, -100]),
        ("mean", None, [11.197, -0.7475, -100]),
        ("rem", None, [10.867, -0.7475, -100]),
    ],
)
def test_target_of_the_reference(monkeypatch, target_mode, subset, expected):
    model, _ = model_with_data(n_critics=5, gamma=0.99, ent_coef=0.2, target_mode=target_mode)
    model.actor.action_log_prob(th.zeros(1, 3))
    samples = Samples([1, -0.5, -100], [0, 0, 1])
    monkeypatch.setattr(model, "_segments", lambda *args: [(samples, [samples])])
    log_probs = th.tensor([-1.5, 0.25, -3], dtype=th.float64)
    monkeypatch.setattr(model.actor, "action_log_prob", lambda obs: (th.zeros(3, 1), log_probs))
    if subset is not None:
        monkeypatch.setattr(model, "_draw_subset", lambda: subset)
    else:
        model.subset_size = "all"
    q_values = columns_of(Q_ROWS)
    of = lambda obs, actions, members: q_values if members is None else q_values[members]  # noqa: E731
    monkeypatch.setattr(model._regression, "target_q_values", of)
    monkeypatch.setattr(th, "rand_like", lambda x: columns_of(RAW_WEIGHTS))
    recorded = []

    def fit(observations, actions, target, tau, weights):
        recorded.append(target)
        return th.zeros(()), q_values

    monkeypatch.setattr(model._regression, "fit", fit)
    model.train(1, 3)
    assert recorded[0].shape == (3, 1)
    assert recorded[0].flatten().tolist() == pytest.approx(expected)


def add_same(model, n, reward, terminated, truncated):
    """``n`` transitions with the same next observation."""
    model.replay_buffer.reset()
    rng = np.random.default_rng(0)
    next_obs = np.array([[0.3, -0.2, 0.5]], np.float32)
    for _ in range(n):
        obs, action = rng.normal(size=(1, 3)).astype(np.float32), rng.uniform(-1, 1, (1, 1)).astype(np.float32)
        info = {"TimeLimit.truncated": truncated}
        model.replay_buffer.add(obs, next_obs, action, np.array([reward]), np.array([terminated or truncated]), [info])


def bootstrap(model):
    """What the target adds to the rewards, without the entropy: a constant value of all critics."""
    for layer in model.critic_target.q_networks.layers:
        for parameter in layer.parameters():
            parameter.data.zero_()
    model.critic_target.q_networks.layers[-1].bias.data.fill_(7.0)


@pytest.mark.parametrize(
    ("terminated", "truncated", "expected"), [(False, False, 2 + 7 * GAMMA), (True, False, 2), (False, True, 2 + 7 * GAMMA)]
)
def test_termination_and_truncation(monkeypatch, terminated, truncated, expected):
    model, _ = model_with_data(ent_coef=0.0, n_critics=3)
    add_same(model, 10, 2.0, terminated, truncated)
    bootstrap(model)
    recorded = record_targets(model, monkeypatch)
    model.train(1, 8)
    assert recorded[0].flatten().tolist() == pytest.approx([expected] * 8, rel=1e-6)


def test_a_terminal_transition_ignores_the_target_critics_whatever_they_say(monkeypatch):
    model, _ = model_with_data(n_critics=3)
    add_same(model, 10, 2.0, True, False)
    bootstrap(model)
    model.critic_target.q_networks.layers[-1].bias.data.fill_(1e30)
    recorded = record_targets(model, monkeypatch)
    model.train(1, 8)
    assert recorded[0].flatten().tolist() == [2.0] * 8


def test_discounts_of_n_step_returns(monkeypatch):
    model, _ = model_with_data(ent_coef=0.0, n_critics=3, n_steps=3, n_transitions=30)
    add_same(model, 30, 2.0, False, False)
    bootstrap(model)
    recorded = record_targets(model, monkeypatch)
    model.train(1, 200)
    full = 2 * (1 + GAMMA + GAMMA**2) + GAMMA**3 * 7
    two, one = 2 * (1 + GAMMA) + GAMMA**2 * 7, 2 + GAMMA * 7  # at the end of what is stored
    values = recorded[0].flatten().tolist()
    assert set(np.round(values, 3)) == set(np.round([full, two, one], 3))
    assert np.mean(np.isclose(values, full)) > 0.8


def test_the_entropy_is_in_the_bootstrap_value(monkeypatch):
    model, _ = model_with_data(ent_coef=0.5, n_critics=3)
    add_same(model, 10, 2.0, False, False)
    bootstrap(model)
    recorded = record_targets(model, monkeypatch)
    th.manual_seed(0)
    _, log_prob = model.actor.action_log_prob(th.tensor([[0.3, -0.2, 0.5]]).expand(16, 3))
    th.manual_seed(0)
    model.train(1, 16)
    expected = 2 + GAMMA * (7 - 0.5 * log_prob.detach())
    assert recorded[0].flatten().tolist() == pytest.approx(expected.tolist(), rel=1e-5)


def test_one_subset_per_update(monkeypatch):
    model, _ = model_with_data(n_critics=5, subset_size=2)
    calls, values = [], model._regression.target_q_values
    monkeypatch.setattr(model._regression, "target_q_values", lambda *args: calls.append(args[2]) or values(*args))
    np.random.seed(0)
    model.train(12, 8)
    assert len(calls) == 12 and len({tuple(sorted(members)) for members in calls}) > 3
    assert all(len(set(members)) == 2 for members in calls)


# The actor ------------------------------------------------------------------------------------------------------------


def test_squashed_gaussian_of_the_reference(monkeypatch):
    mean = th.tensor([[0.5, -0.3, 0.0, 2.0]], dtype=th.float64)
    log_std = th.tensor([[-1.0, 0.0, -0.5, 0.5]], dtype=th.float64)
    noise = th.tensor([[0.3, -1.2, 0.0, 1.5]], dtype=th.float64)
    monkeypatch.setattr("torch.distributions.normal._standard_normal", lambda *args, **kwargs: noise)
    distribution = SquashedDiagGaussianDistribution(4).proba_distribution(mean, log_std)
    action, log_prob = distribution.log_prob_from_params(mean, log_std)
    assert action[0].tolist() == pytest.approx([0.54438316, -0.90514825, 0, 0.99973956], abs=1e-7)
    assert log_prob.item() == pytest.approx(5.05480841, abs=1e-6)
    # The slow algorithm above uses the same formula
    actor = {"latent_pi": nn.Identity(), "mu": lambda x: mean, "log_std": lambda x: log_std}
    monkeypatch.setattr(th, "randn", lambda *args, **kwargs: noise)
    action, log_prob = squashed_gaussian(actor, th.zeros(1, 3))
    assert action[0].tolist() == pytest.approx([0.54438316, -0.90514825, 0, 0.99973956], abs=1e-7)
    assert log_prob.item() == pytest.approx(5.05480841, abs=1e-6)


def test_actor_and_entropy_losses_of_the_reference(monkeypatch):
    model, _ = model_with_data(n_critics=5, ent_coef="auto_0.2", target_entropy=-4, learning_rate=3e-4)
    model._update_learning_rate([model.ent_coef_optimizer])
    model.log_ent_coef.data = model.log_ent_coef.data.double().fill_(math.log(0.2))
    log_probs = th.tensor([-1.5, 0.25], dtype=th.float64)
    attached = sum(parameter.sum() for parameter in model.actor.parameters()) * 0  # so that there is something to derive
    monkeypatch.setattr(model.actor, "action_log_prob", lambda obs: (th.zeros(2, 1), log_probs + attached))
    monkeypatch.setattr(model._regression, "q_values", lambda obs, actions: columns_of(Q_ROWS[:2]))
    logs = {key: [] for key in ("actor_loss", "ent_coef", "ent_coef_loss")}
    model._update_actor(Samples([0, 0], [0, 0]), th.tensor([0.2], dtype=th.float64), logs)
    assert logs["actor_loss"][0].item() == pytest.approx(-5.025)
    assert logs["ent_coef_loss"][0].item() == pytest.approx(-7.44365035)
    assert model.log_ent_coef.grad.item() == pytest.approx(4.625)
    assert model.log_ent_coef.exp().item() == pytest.approx(0.19994001, abs=1e-8)


def test_the_actor_loss_leaves_no_gradient_in_the_critics():
    model, _ = model_with_data(n_critics=3, policy_delay=1, policy_kwargs=dict(critic_engine="autograd"))
    batch = model.replay_buffer.sample(16)
    before = copy.deepcopy(model.critic.state_dict())
    logs = {key: [] for key in ("actor_loss", "ent_coef", "ent_coef_loss")}
    model._update_actor(batch, th.tensor([0.2]), logs)
    assert all(parameter.grad is None for parameter in model.critic.parameters())
    assert all(th.equal(value, before[name]) for name, value in model.critic.state_dict().items())
    assert all(parameter.grad is not None and parameter.grad.any() for parameter in model.actor.parameters())


@pytest.mark.parametrize(
    ("gradient_steps", "delay", "expected"),
    [
        (20, 20, [[19], [19], [19]]),
        (20, 8, [[7, 15], [3, 11, 19], [7, 15]]),
        (1, 20, [[], [], []]),
        (5, 20, [[], [], []]),
        (5, 1, [[0, 1, 2, 3, 4]] * 3),
    ],
)
def test_which_updates_are_followed_by_the_actor(monkeypatch, gradient_steps, delay, expected):
    model, _ = model_with_data(n_critics=2, policy_delay=delay)
    steps = []
    monkeypatch.setattr(model, "_update_actor", lambda *args: steps[-1].append((model._n_updates - 1) % gradient_steps))
    for _ in range(3):
        steps.append([])
        model.train(gradient_steps, 8)
    assert steps == expected
    if (gradient_steps, delay) == (5, 20):
        steps.append([])
        model.train(5, 8)
        assert steps[-1] == [4]


# Target entropy ---------------------------------------------------------------------------------------------------------


@pytest.fixture
def registered():
    ids = []

    def register(name):
        ids.append(name)
        gym.register(name, entry_point=Loop, max_episode_steps=10)
        return gym.make(name)

    yield register
    for name in ids:
        del gym.registry[name]


@pytest.mark.parametrize(
    ("name", "expected"),
    [("Hopper", -1), ("HalfCheetah", -3), ("Walker2d", -3), ("Ant", -4), ("Humanoid", -2), ("BipedalWalker", -1)],
)
def test_mbpo_target_entropy(registered, name, expected):
    env = registered(f"maths/{name}-v77")
    model = REDQ("MlpPolicy", env, target_entropy="mbpo", device="cpu", policy_kwargs=dict(net_arch=[4]), buffer_size=10)
    assert model.target_entropy == expected


@pytest.mark.parametrize(("target_entropy", "expected"), [("auto", -1.0), (-2.5, -2.5), (3, 3.0), ("-0.5", -0.5)])
def test_target_entropy(target_entropy, expected):
    model, _ = model_with_data(n_critics=2, target_entropy=target_entropy)
    assert model.target_entropy == expected


@pytest.mark.parametrize("arguments", [dict(target_entropy="high"), dict(ent_coef="auto_much"), dict(ent_coef="much")])
def test_target_entropy_that_is_no_number(arguments):
    with pytest.raises(ValueError, match=next(iter(arguments))):
        model_with_data(n_critics=2, **arguments)


@pytest.mark.parametrize(("ent_coef", "initial"), [("auto", 1.0), ("auto_0.1", 0.1), (0.3, 0.3)])
def test_initial_entropy_coefficient(ent_coef, initial):
    model, _ = model_with_data(n_critics=2, ent_coef=ent_coef)
    assert model._current_ent_coef().item() == pytest.approx(initial)


@pytest.mark.parametrize("subset_size", [0, 0.5, 11, -1])
def test_subset_size_out_of_range(subset_size):
    with pytest.raises(ValueError, match="subset_size"):
        model_with_data(subset_size=subset_size)


# DroQ -------------------------------------------------------------------------------------------------------------------


def test_droq_defaults():
    model, _ = model_with_data(DroQ)
    assert (model.n_critics, model.subset_size, model.policy_delay, model.gradient_steps) == (2, 2, 20, 20)
    names = [type(module).__name__ for module in model.critic.q_networks.layers]
    assert names == ["StackedLinear", "Dropout", "StackedLayerNorm", "ReLU"] * 2 + ["StackedLinear"]
    assert {module.p for module in model.critic.modules() if isinstance(module, nn.Dropout)} == {0.01}
    assert not any(isinstance(module, (nn.Dropout, nn.LayerNorm)) for module in model.actor.modules())
    # One of the two replaced, the other stays
    model, _ = model_with_data(DroQ, policy_kwargs=dict(dropout_rate=0.2))
    assert {module.p for module in model.critic.modules() if isinstance(module, nn.Dropout)} == {0.2}
    assert model.policy.layer_norm is True


@pytest.mark.parametrize(("cls", "active"), [(DroQ, True), (REDQ, False)])
def test_dropout_in_the_targets(monkeypatch, cls, active):
    model, _ = model_with_data(cls, ent_coef=0.0, n_critics=2, policy_kwargs=dict(dropout_rate=0.5) if active else {})
    add_same(model, 10, 2.0, False, False)
    # An actor that does not explore: all next actions are the same, so the targets differ by the masks alone
    model.actor.log_std.weight.data.zero_()
    model.actor.log_std.bias.data.fill_(-20)
    recorded = record_targets(model, monkeypatch)
    model.train(1, 16)
    assert model.critic_target.q_networks.training is active
    spread = recorded[0].std().item()
    assert (spread > 1e-3) is active
    model.predict(np.zeros(3, np.float32))
    assert not model.policy.training and not model.critic.training and not model.critic_target.training
    x = (th.zeros(1, 3), th.zeros(1, 1))
    assert th.equal(model.critic(*x), model.critic(*x)) and th.equal(model.critic_target(*x), model.critic_target(*x))


@pytest.mark.parametrize("engine", ["autograd", "fused"])
def test_dropout_is_active_in_the_actor_loss(engine):
    model, _ = model_with_data(DroQ, policy_kwargs=dict(dropout_rate=0.5, critic_engine=engine))
    x = th.ones(8, 3), th.ones(8, 1)
    model.policy.set_training_mode(True)
    assert not th.equal(model._regression.q_values(*x), model._regression.q_values(*x))
    model.policy.set_training_mode(False)
    assert th.equal(model._regression.q_values(*x), model._regression.q_values(*x))


def test_gsde_draws_noise_for_each_update():
    model, _ = model_with_data(use_sde=True, gradient_steps=20, policy_delay=20)
    calls, reset = [], model.actor.reset_noise
    model.actor.reset_noise = lambda *args: (calls.append(1), reset(*args))
    model.train(gradient_steps=20, batch_size=16)
    assert len(calls) == 20 + 1  # and one for the actor's
