"""Algorithms that live beside a study: numbers worked out by hand, and a life through saving and loading."""

from collections import defaultdict
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch as th
import yaml
from maths_helpers import assert_same_weights, separate_networks
from stable_baselines3 import SAC, TD3
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from torch import nn

from sb3_symphony.common.ensembles import combine
from sb3_symphony.common.losses import rehae
from sb3_symphony.common.regression import CriticRegression
from sb3_symphony.experiment.registry import load_algorithm

STUDIES = Path(__file__).parents[1] / "benchmarks" / "studies"
SYMPHONY, REDQ = STUDIES / "symphony" / "symphony_variants.py", STUDIES / "redq" / "redq_variants.py"
ALGORITHMS = [
    *(f"{SYMPHONY}:{name}" for name in ("SymphonyV2", "SymphonyV21", "SymphonyV3")),
    *(f"{REDQ}:{name}" for name in ("SkipREDQ", "DuelingREDQ", "BatchNormREDQ", "REDQTD3")),
]


def make(name, **kwargs):
    small = dict(learning_starts=30, buffer_size=500, batch_size=16, gradient_steps=2, seed=0, device="cpu")
    small.update(policy_kwargs=dict(net_arch=[8, 8]), **kwargs)
    return load_algorithm(name)("MlpPolicy", "Pendulum-v1", **small)


def batch_of(model, n=12):
    th.manual_seed(1)
    observations, following = th.randn(n, 3), th.randn(n, 3)
    dones = (th.arange(n) % 3 == 0).float()[:, None]
    return ReplayBufferSamples(observations, th.rand(n, 1) * 2 - 1, following, dones, th.randn(n, 1) * 5)


@pytest.mark.parametrize("name", ALGORITHMS, ids=lambda name: name.rpartition(":")[2])
def test_learns_saves_and_loads(name, tmp_path):
    model = make(name)
    before = [parameter.detach().clone() for parameter in model.policy.parameters()]
    model.learn(60)
    assert model._n_updates >= 2 * 29
    changed = [not th.equal(old, new) for old, new in zip(before, model.policy.parameters(), strict=True)]
    assert all(changed)  # every network learns, or follows one that does
    model.save(tmp_path / "model")
    loaded = load_algorithm(name).load(tmp_path / "model", env=gym.make("Pendulum-v1"))
    observation = np.array([[0.1, 0.2, 0.3]], dtype=np.float32)
    np.testing.assert_array_equal(
        model.predict(observation, deterministic=True)[0], loaded.predict(observation, deterministic=True)[0]
    )
    for key, value in model.policy.state_dict().items():
        assert th.equal(value, loaded.policy.state_dict()[key]), key
    loaded.learn(40)


# ----------------------------------------------------------------------------------------------------------------------
# Symphony
# ----------------------------------------------------------------------------------------------------------------------


def test_what_the_variance_head_learns():
    model = make(ALGORITHMS[0])
    batch = batch_of(model)
    with th.no_grad():
        following = model.policy.variance_target(batch.next_observations, model.actor(batch.next_observations))[0]
    rewards = batch.rewards.numpy().ravel()
    for i, target in enumerate(model.variance_of_target(batch).numpy().ravel()):
        bootstrapped = 0.0 if i % 3 == 0 else 0.99 * following[i].item()
        assert target == pytest.approx(3e-3 * (3e-3 * np.var(rewards, ddof=1) + bootstrapped), rel=1e-5)


def test_the_actor_follows_critics_and_variance():
    model = make(ALGORITHMS[0])
    batch = batch_of(model)
    model.baseline.fill_(0.3)
    model.variance_baseline.fill_(-0.2)
    (q_values, q_baseline), (variance, variance_baseline) = model.actor_terms(batch)
    actions = model.actor(batch.observations)
    assert th.equal(q_values, combine(model.critic(batch.observations, actions), "min"))
    assert (q_baseline, variance_baseline) == (model.baseline, model.variance_baseline)
    model.policy.variance.optimizer.param_groups[0]["lr"] = 0.0  # so that its values are those above
    logs = {"actor_loss": [], "variance_loss": []}
    model._update_actor(batch, logs)
    expected = -rehae(q_values, th.tensor(0.3)) - rehae(variance, th.tensor(-0.2))
    th.testing.assert_close(logs["actor_loss"][0], expected.detach())
    assert float(model.baseline) == pytest.approx(float(q_values.detach().mean()), abs=1e-6)
    assert float(model.variance_baseline) == pytest.approx(float(variance.detach().mean()), abs=1e-6)


def test_next_states_are_compared_with_before_the_step():
    model = make(ALGORITHMS[1])
    model.learn(40)
    seen = []
    critics_step = model._regression.fit

    def fit(*args):
        seen.append([float(value) for value in model._before])
        return critics_step(*args)

    model._regression.fit = fit
    original = model.actor_terms

    def actor_terms(batch):
        terms = original(batch)
        assert len(terms) == 4
        assert [float(baseline) for _, baseline in terms[2:]] == seen[-1]
        values = [float(values.mean()) for values, _ in terms[2:]]
        assert values != seen[-1]  # critics and variance have moved meanwhile
        return terms

    model.actor_terms = actor_terms
    model.train(3)
    assert len(seen) == 3


def test_observations_are_scaled_once():
    model = make(ALGORITHMS[2], learning_starts=60)
    model.learn(62)
    extractor = model.actor.features_extractor
    stored = model.replay_buffer.observations[:61, 0]
    low, high = np.minimum(stored.min(axis=0), 0), np.maximum(stored.max(axis=0), 0)
    np.testing.assert_allclose(extractor.low, 2 * np.floor(10 * low) / 10, atol=1e-6)
    np.testing.assert_allclose(extractor.high, 2 * np.ceil(10 * high) / 10, atol=1e-6)
    limits = extractor.low.clone()
    for part in (model.critic, model.critic_target, model.policy.variance, model.policy.variance_target):
        assert th.equal(part.features_extractor.low, limits)
    model.learn(40, reset_num_timesteps=False)
    assert th.equal(extractor.low, limits)
    module = type(extractor)(gym.spaces.Box(-1, 1, (3,)))
    module.low.copy_(th.tensor([-2.0, 0.0, 1.0]))
    module.high.copy_(th.tensor([2.0, 4.0, 1.0]))
    assert module(th.tensor([[1.0, 4.0, 7.0]])).tolist() == [[1.0, 2.0, 0.0]]  # what never changed is 0


def test_saturated_stem():
    model = make(ALGORITHMS[2])
    stem = model.actor.mu[1]
    assert stem(th.tensor([0.0, 2.0, 100.0])).tolist() == pytest.approx([0.0, 2 * np.tanh(1), 2.0])


# ----------------------------------------------------------------------------------------------------------------------
# REDQ
# ----------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ALGORITHMS[3:6], ids=lambda name: name.rpartition(":")[2])
def test_other_networks_are_not_fused(name):
    assert type(make(name)._regression) is CriticRegression


def member(parameters, k):
    return [parameter[k] for parameter in parameters]


def test_skip_connections():
    networks = make(ALGORITHMS[3]).critic.q_networks
    x = th.randn(5, 4)
    out = networks(x)
    for k in range(10):
        (w1, b1), (w2, b2), (w3, b3) = (member([networks.layers[i].weight, networks.layers[i].bias], k) for i in (0, 2, 4))
        first = th.relu(x @ w1 + b1)  # 4 to 8: no identity
        second = th.relu(first @ w2 + b2) + first
        th.testing.assert_close(out[k], second @ w3 + b3)
    th.testing.assert_close(networks(x, [3, 7]), out[[3, 7]])


def test_dueling():
    networks = make(ALGORITHMS[4]).critic.q_networks
    x, other = th.randn(5, 4), th.randn(5, 1)
    changed = th.cat([x[:, :3], other], dim=1)
    difference = networks(x) - networks(changed)  # V(s) cancels out
    th.testing.assert_close(difference, networks.advantage(x) - networks.advantage(changed))
    th.testing.assert_close(networks(x) - networks.advantage(x), networks.value(x[:, :3]))


def test_batch_normalisation_is_that_of_torch():
    model = make(ALGORITHMS[5])
    stacked = model.critic.q_networks.layers[1]
    plain = [nn.BatchNorm1d(8) for _ in range(10)]
    for x in (th.randn(10, 6, 8), 3 + 2 * th.randn(10, 6, 8)):
        out = stacked.train()(x)
        for k, module in enumerate(plain):
            th.testing.assert_close(out[k], module(x[k]))
    stacked.eval()
    for k, module in enumerate(plain):
        th.testing.assert_close(stacked(x)[k], module.eval()(x[k]))
    th.testing.assert_close(stacked(x[[2, 5]], [2, 5]), stacked(x)[[2, 5]])


def test_running_statistics_reach_the_targets():
    model = make(ALGORITHMS[5])
    model.learn(40)
    ours, theirs = model.critic.q_networks.layers[1], model.critic_target.q_networks.layers[1]
    assert ours.running_mean.abs().sum() > 0 and not theirs.training
    th.testing.assert_close(theirs.running_var, ours.running_var, rtol=0.2, atol=0.2)  # the actor's step was after the copy


def test_targets_of_random_pairs():
    model = make(ALGORITHMS[6], n_critics=10)
    np.random.seed(0)
    observations, actions = th.randn(6, 3), th.rand(6, 1)
    with th.no_grad():
        every = model.critic_target(observations, actions)
    pairs = set()
    for _ in range(300):
        values = model._regression.target_q_values(observations, actions)
        assert values.shape == (2, 6, 1)
        found = [next(k for k in range(10) if th.allclose(each, every[k], atol=1e-5)) for each in values]
        pairs.add(tuple(sorted(found)))
    assert len(pairs) == 45 and all(a < b for a, b in pairs)


def test_the_actor_follows_the_mean_of_all():
    settings = yaml.safe_load((STUDIES / "redq" / "redq_td3.yml").read_text())
    model = make(ALGORITHMS[6], n_critics=3, min_mix=settings["min_mix"], actor_loss=settings["actor_loss"])
    batch = batch_of(model)
    with th.no_grad():
        expected = -model.critic(batch.observations, model.actor(batch.observations)).mean()
    logs = defaultdict(list)
    model._update_actor(batch, logs)
    th.testing.assert_close(logs["actor_loss"][0], expected)


# ----------------------------------------------------------------------------------------------------------------------
# Fair controls on BipedalWalker
# ----------------------------------------------------------------------------------------------------------------------

CONTROLS = STUDIES / "bipedalwalker" / "controls.py"


@pytest.mark.parametrize(
    ("control", "ours", "own"),
    [
        (
            "td3",
            "symphony",
            ["learning_rate", "critic_learning_rate", "policy_delay", "target_policy_noise", "saturation_penalty"],
        ),
        ("sac", "droq", ["learning_rate", "policy_delay", "ent_coef", "target_entropy", "replay_buffer_kwargs", "layer_norm"]),
    ],
)
def test_controls_are_given_what_ours_are_given(control, ours, own):
    theirs = yaml.safe_load((STUDIES / "bipedalwalker" / f"{control}.yml").read_text())
    ours = yaml.safe_load((STUDIES.parents[1] / "hyperparams" / f"{ours}.yml").read_text())["BipedalWalker-v3"]
    theirs.update(theirs["policy_kwargs"])
    ours.update(ours["policy_kwargs"])
    common = ["env_wrapper", "learning_starts", "batch_size", "n_steps", "gradient_steps", "net_arch", "actor_averaging"]
    common += ["action_noise", "callback", "n_timesteps", "learning_rate", "policy_delay"]
    for key in [*common, *own]:
        assert theirs.get(key) == ours.get(key), key
    assert theirs["replay_buffer_kwargs"]["mirror"] == ours["replay_buffer_kwargs"]["mirror"]


def theirs_with_weights_of(ours, theirs):
    """Stable-Baselines3's model with layer normalisation in the critics, and all weights of ours."""
    for own, critic in ((ours.critic, theirs.critic), (ours.critic_target, theirs.critic_target)):
        critic.q_networks = separate_networks(own.q_networks)
        for i, network in enumerate(critic.q_networks):
            setattr(critic, f"qf{i}", network)
    theirs.critic.optimizer = th.optim.Adam(theirs.critic.parameters(), lr=theirs.learning_rate)
    theirs.actor.load_state_dict(ours.actor.state_dict())
    return theirs


@pytest.mark.parametrize(("name", "cls"), [("TD3Control", TD3), ("SACControl", SAC)])
def test_controls_are_those_of_stable_baselines3(name, cls, monkeypatch):
    """Twelve updates, in two calls: the same weights."""
    common = dict(learning_rate=3e-2, tau=0.3, batch_size=12, seed=0, buffer_size=50)
    delay = {"policy_delay": 2} if cls is TD3 else {}
    theirs = cls("MlpPolicy", "Pendulum-v1", **common, **delay, policy_kwargs=dict(net_arch=[8, 8]))
    if cls is TD3:
        given = dict(critic_learning_rate=3e-2, critic_loss="mse", actor_loss="mean", target_policy_noise=0.2)
        given.update(policy_delay=2, initial_gradient_steps=(0, 0), episode_gradient_steps=0)
        policy_kwargs = dict(activation_fn=nn.ReLU, layer_norm={"pi": False, "qf": True})
    else:
        given, policy_kwargs = dict(policy_delay=1, n_critics=2, subset_size="all"), dict(layer_norm=True)
    ours = load_algorithm(f"{CONTROLS}:{name}")(
        "MlpPolicy", "Pendulum-v1", **common, **given, policy_kwargs=dict(net_arch=[8, 8], **policy_kwargs)
    )
    theirs_with_weights_of(ours, theirs)
    if cls is TD3:
        theirs.actor_target.load_state_dict(ours.policy.actor_target.state_dict())
    batch = batch_of(ours)

    def sample(n, env=None):
        rows = th.arange(n) % 12
        return ReplayBufferSamples(*(None if field is None else field[rows] for field in batch))

    def always(shape):
        return th.linspace(-2, 2, 12).reshape(-1, 1).repeat(shape[0] // 12, 1)

    # Draws come in another order, so all are alike
    monkeypatch.setattr(th, "randn_like", lambda x: always(x.shape))
    monkeypatch.setattr(th.Tensor, "normal_", lambda x, mean, std: x.copy_(std * always(x.shape)))
    monkeypatch.setattr("torch.distributions.normal._standard_normal", lambda shape, **kwargs: always(shape))
    for model in (ours, theirs):
        monkeypatch.setattr(model.replay_buffer, "sample", sample)
        model._setup_learn(1, None)
        model.train(3, 12)
        model.train(9, 12)
    for own, critic in ((ours.critic, theirs.critic), (ours.critic_target, theirs.critic_target)):
        assert_same_weights(own.q_networks, critic.q_networks, 1e-4)
    actors = [(ours.actor, theirs.actor)]
    actors += [(ours.policy.actor_target, theirs.actor_target)] if cls is TD3 else []
    for own, other in actors:
        for a, b in zip(own.parameters(), other.parameters(), strict=True):
            th.testing.assert_close(a, b, rtol=1e-4, atol=1e-5)
    if cls is SAC:
        th.testing.assert_close(ours.log_ent_coef, theirs.log_ent_coef)


@pytest.mark.parametrize("name", ["TD3Control", "SACControl"])
def test_controls_live(name, tmp_path):
    ours = load_algorithm(f"{CONTROLS}:{name}")
    model = ours(
        *("MlpPolicy", "Pendulum-v1"),
        learning_starts=30,
        policy_delay=1,
        seed=0,
        policy_kwargs=dict(net_arch=[8, 8], actor_averaging=0.5),
    )
    before = [parameter.detach().clone() for parameter in model.policy.parameters()]
    model.learn(60)
    assert model.policy.n_averaged == model._n_updates
    assert not any(th.equal(old, new) for old, new in zip(before, model.policy.parameters(), strict=True))
    model.save(tmp_path / "model")
    loaded = ours.load(tmp_path / "model")
    for key, value in model.policy.state_dict().items():
        assert th.equal(value, loaded.policy.state_dict()[key]), key


@pytest.mark.parametrize("name", ALGORITHMS, ids=lambda name: name.rpartition(":")[2])
def test_the_average_follows_actors_with_updates_of_their_own(name):
    small = dict(learning_starts=30, buffer_size=500, batch_size=16, seed=0, device="cpu")
    policy_kwargs = dict(net_arch=[8, 8], actor_averaging=0.5)
    model = load_algorithm(name)("MlpPolicy", "Pendulum-v1", policy_kwargs=policy_kwargs, policy_delay=1, **small).learn(60)
    assert model.policy.n_averaged == model._n_updates > 0
