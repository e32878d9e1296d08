import copy
import math
from itertools import pairwise

import numpy as np
import pytest
import torch as th
from gymnasium.envs.classic_control import PendulumEnv
from maths_helpers import assert_same_weights, double_precision, fill, separate_networks
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.noise import NormalActionNoise
from torch import nn

from sb3_symphony import Symphony
from sb3_symphony.common.off_policy import update_logs

GAMMA, TAU = 0.97, 0.01


def model_with_data(n_transitions=200, seed=0, env=None, **kwargs):
    policy_kwargs = {"net_arch": [12, 10], **kwargs.pop("policy_kwargs", {})}
    defaults = dict(gamma=GAMMA, tau=TAU, buffer_size=500, seed=seed)
    model = Symphony("MlpPolicy", env or PendulumEnv(), policy_kwargs=policy_kwargs, device="cpu", **{**defaults, **kwargs})
    model.num_timesteps = n_transitions
    model._setup_learn(1, None)
    return model, fill(model.replay_buffer, n_transitions)


def record_draws(model, monkeypatch):
    """What every call of ``replay_buffer.sample`` was asked for and returned."""
    draws, sample = [], model.replay_buffer.sample

    def spy(size, **kwargs):
        samples = sample(size, **kwargs)
        draws.append((size, kwargs.get("uniform", False), samples))
        return samples

    monkeypatch.setattr(model.replay_buffer, "sample", spy)
    return draws


def record_targets(model, monkeypatch):
    recorded, fit = [], model._regression.fit

    def spy(observations, actions, target, *args):
        recorded.append(target.clone())
        return fit(observations, actions, target, *args)

    monkeypatch.setattr(model._regression, "fit", spy)
    return recorded


def rectified_huber(errors, elementwise):
    if elementwise:
        return (errors * th.tanh(errors / 2)).mean()
    m = errors.abs().mean()
    return m * th.tanh(m)


def rectified_huber_asymmetric(advantages, elementwise):
    if elementwise:
        return (advantages.abs() * th.tanh(advantages / 2)).mean()
    m = advantages.mean()
    return m.abs() * th.tanh(m)


class SlowSymphony:
    """One update as the reference orders it: targets' average, target, critics, actor, baseline."""

    def __init__(self, model, critic_rate=7e-4, actor_rate=3e-4, min_mix=1.0, actor_mix=None, elementwise=False, delay=1):
        self.critics = separate_networks(model.critic.q_networks)
        self.targets = separate_networks(model.critic_target.q_networks)
        self.actor = copy.deepcopy(model.actor.mu)
        self.baseline = 0.0
        parameters = [parameter for critic in self.critics for parameter in critic.parameters()]
        self.critic_optimizer = th.optim.Adam(parameters, lr=critic_rate)
        self.actor_optimizer = th.optim.Adam(self.actor.parameters(), lr=actor_rate)
        self.min_mix, self.actor_mix = min_mix, min_mix if actor_mix is None else actor_mix
        self.elementwise, self.delay = elementwise, delay
        self.n_updates = 0

    def combined(self, networks, obs, actions, mix):
        values = th.stack([network(th.cat([obs, actions], dim=1)) for network in networks])
        return mix * values.amin(dim=0) + (1 - mix) * values.mean(dim=0)

    def move_targets(self):
        with th.no_grad():
            for critic, target in zip(self.critics, self.targets, strict=True):
                for parameter, slow in zip(critic.parameters(), target.parameters(), strict=True):
                    slow.copy_((1 - TAU) * slow + TAU * parameter)

    def update(self, obs, actions, next_obs, dones, rewards):
        self.move_targets()
        with th.no_grad():
            next_values = self.combined(self.targets, next_obs, self.actor(next_obs), self.min_mix)
            y = rewards + GAMMA * (1 - dones) * next_values
        x = th.cat([obs, actions], dim=1)
        self.critic_optimizer.zero_grad()
        sum(rectified_huber(y - critic(x), self.elementwise) for critic in self.critics).backward()
        self.critic_optimizer.step()

        self.n_updates += 1
        if self.n_updates % self.delay == 0:
            q_values = self.combined(self.critics, obs, self.actor(obs), self.actor_mix)
            self.actor_optimizer.zero_grad()
            (-rectified_huber_asymmetric(q_values - self.baseline, self.elementwise)).backward()
            self.actor_optimizer.step()
            self.baseline = q_values.mean().item()


# Whole calls of train() -----------------------------------------------------------------------------------------------

VARIANTS = {
    "default": ({}, {}),
    "min_mix": (dict(min_mix=0.7, n_critics=3), dict(min_mix=0.7)),
    "mean": (dict(target_mode="mean", n_critics=3), dict(min_mix=0.0)),
    "actor's mean": (dict(min_mix=(1, 0)), dict(actor_mix=0.0)),
    "actor's minimum": (dict(min_mix=[0.2, 1.0], n_critics=3), dict(min_mix=0.2, actor_mix=1.0)),
    "elementwise": (dict(critic_loss="rehe_elementwise", actor_loss="rehae_elementwise"), dict(elementwise=True)),
    "one critic": (dict(n_critics=1), {}),
    "delay": (dict(policy_delay=2), dict(delay=2)),
    "rates": (dict(learning_rate=2e-3, critic_learning_rate=None), dict(critic_rate=2e-3, actor_rate=2e-3)),
}


@pytest.mark.parametrize("engine", ["autograd", "fused"])
@pytest.mark.parametrize("variant", VARIANTS)
def test_two_calls_equal_the_slow_algorithm(monkeypatch, engine, variant):
    arguments, slow_arguments = VARIANTS[variant]
    model, columns = model_with_data(initial_gradient_steps=(2, 3), policy_kwargs=dict(critic_engine=engine), **arguments)
    double_precision(model, monkeypatch)
    draws = record_draws(model, monkeypatch)
    slow = SlowSymphony(model, **slow_arguments)
    start = copy.deepcopy(model.policy.state_dict())

    model.train(3)
    model.train(3)
    for size, _, samples in draws:
        for i in range(0, size, 128):
            rows = [field[i : i + 128] for field in samples[:5]]
            slow.update(*rows)

    assert model._n_updates == slow.n_updates == 2 + 3 + 3 + 3
    assert_same_weights(model.critic.q_networks, slow.critics, 1e-10)
    for own, parameter in zip(model.actor.mu.parameters(), slow.actor.parameters(), strict=True):
        th.testing.assert_close(own, parameter, rtol=1e-10, atol=1e-10)
    assert model.baseline.item() == pytest.approx(slow.baseline, rel=1e-10)
    slow.move_targets()  # which the reference does at the start of the next update
    assert_same_weights(model.critic_target.q_networks, slow.targets, 1e-10)
    assert all(not th.equal(value, start[name]) for name, value in model.policy.state_dict().items())
    # What was drawn is what was stored: a truncation is no end
    ends = {(round(o[0].item(), 9), d.item()) for _, _, s in draws for o, d in zip(s.observations, s.dones, strict=True)}
    stored = zip(columns["observations"][:, 0].tolist(), columns["terminated"][:, 0].tolist(), strict=True)
    assert ends <= {(round(obs, 9), terminated) for obs, terminated in stored}


@pytest.mark.parametrize("step, mixes", [(9, (0.2, 1)), (150, (0.4, 0.75)), (200, (0.6, 0.5)), (900, (0.6, 0))])
def test_moving_mixes(step, mixes):
    """At each step the same as with fixed weights of that size."""
    moving, fixed = ((0.2, 0.6, 100, 200), (1, 0, 100, 300)), mixes
    states = []
    for min_mix in (moving, fixed):
        model, _ = model_with_data(min_mix=min_mix, initial_gradient_steps=(0, 0))
        model.num_timesteps = step
        model.train(2)
        states.append(model.policy.state_dict())
    for name, value in states[0].items():
        th.testing.assert_close(value, states[1][name], rtol=1e-6, atol=1e-7, msg=name)


def test_initial_updates_sample_uniformly_first_and_happen_once(monkeypatch):
    model, _ = model_with_data(batch_size=10, initial_gradient_steps=(4, 6))
    draws = record_draws(model, monkeypatch)
    model.train(3, batch_size=10)
    model.train(3, batch_size=10)
    assert [(size, uniform) for size, uniform, _ in draws] == [(40, True), (60, False), (30, False), (30, False)]


@pytest.mark.parametrize(("critic_rate", "expected"), [(7e-4, 7e-4), (None, 3e-4), (lambda left: 1e-3 * left, 5e-4)])
def test_learning_rates(critic_rate, expected):
    model, _ = model_with_data(critic_learning_rate=critic_rate, initial_gradient_steps=(0, 0))
    model._current_progress_remaining = 0.5
    model.train(1)
    assert model.actor.optimizer.param_groups[0]["lr"] == pytest.approx(3e-4)
    assert model.critic.optimizer.param_groups[0]["lr"] == pytest.approx(expected)


# The target -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("terminated", "truncated", "min_mix", "expected"),
    [(False, False, 1.0, 4.96), (True, False, 1.0, 1.0), (False, True, 1.0, 4.96), (False, False, 0.7, 5.1085)],
)
def test_target_of_the_reference(monkeypatch, terminated, truncated, min_mix, expected):
    model, _ = model_with_data(gamma=0.99, min_mix=min_mix, initial_gradient_steps=(0, 0))
    model.replay_buffer.reset()
    zero = np.zeros((1, 3), np.float32)
    for _ in range(5):
        done, info = np.array([terminated or truncated]), {"TimeLimit.truncated": truncated}
        model.replay_buffer.add(zero, zero, np.zeros((1, 1), np.float32), np.array([1.0]), done, [info])
    for parameter in model.critic_target.parameters():
        parameter.data.zero_()
    model.critic_target.q_networks.layers[-1].bias.data[:, 0, 0] = th.tensor([5.0, 4.0])
    recorded = record_targets(model, monkeypatch)
    model.train(1)
    assert recorded[0].shape == (128, 1)
    assert recorded[0].flatten().tolist() == pytest.approx([expected] * 128, rel=1e-6)


def test_discounts_of_n_step_returns(monkeypatch):
    model, _ = model_with_data(n_steps=3, initial_gradient_steps=(0, 0))
    for parameter in model.critic_target.parameters():
        parameter.data.zero_()
    model.critic_target.q_networks.layers[-1].bias.data.fill_(7.0)
    draws, recorded = record_draws(model, monkeypatch), record_targets(model, monkeypatch)
    model.train(1)
    samples = draws[0][2]
    expected = samples.rewards + (1 - samples.dones) * samples.discounts * 7.0
    powers = samples.discounts.double().log() / math.log(GAMMA)
    assert set(powers.round().flatten().tolist()) == {1.0, 2.0, 3.0}
    th.testing.assert_close(recorded[0], expected)


# Baseline -------------------------------------------------------------------------------------------------------------


def test_baseline_is_the_last_mean_value():
    model, _ = model_with_data()
    assert model.baseline.item() == 0
    for _ in range(2):
        batch = model.replay_buffer.sample(32)
        before = model.baseline.item()
        with th.no_grad():
            value = model.critic(batch.observations, model.actor(batch.observations)).amin(dim=0).mean().item()
        logs = update_logs()
        model._update_actor(batch, logs)
        assert model.baseline.item() == pytest.approx(value, abs=1e-6)
        advantage = value - before
        assert logs["advantage"][0].item() == pytest.approx(advantage, abs=1e-6)
        assert logs["actor_loss"][0].item() == pytest.approx(-abs(advantage) * math.tanh(advantage), abs=1e-6)


def test_a_batch_seen_twice_has_no_gradient():
    model, _ = model_with_data()
    model.actor.optimizer.param_groups[0]["lr"] = 0.0
    batch = model.replay_buffer.sample(32)
    logs = update_logs()
    model._update_actor(batch, logs)
    assert any(parameter.grad.any() for parameter in model.actor.parameters())
    model._update_actor(batch, logs)
    assert logs["advantage"][1].item() == 0 and logs["actor_loss"][1].item() == 0
    assert all(not parameter.grad.any() for parameter in model.actor.parameters())
    assert all(parameter.grad is None for parameter in model.critic.parameters())


def test_the_actor_gradient_is_the_policy_gradient_times_one_factor(monkeypatch):
    model, _ = model_with_data()
    double_precision(model, monkeypatch)
    model.baseline = th.tensor(0.4, dtype=th.float64)
    batch = model.replay_buffer.sample(32)
    q_values = model.critic(batch.observations, model.actor(batch.observations)).amin(dim=0)
    plain = th.autograd.grad(q_values.mean(), list(model.actor.parameters()))
    distance = q_values.mean().item() - 0.4
    factor = math.tanh(abs(distance)) + abs(distance) / math.cosh(distance) ** 2
    model._update_actor(batch, update_logs())
    for parameter, gradient in zip(model.actor.parameters(), plain, strict=True):
        th.testing.assert_close(parameter.grad, -factor * gradient, rtol=1e-10, atol=1e-14)


# Schedule -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("n_envs", [1, 2])
@pytest.mark.parametrize(
    ("stored", "expected"),
    [(0, 128), (63_999, 128), (64_500, 129), (100_000, 200), (300_000, 600), (500_000, 1000), (512_000, 1024), (10**7, 1024)],
)
def test_batch_size_rule(monkeypatch, pendulum, n_envs, stored, expected):
    model, _ = model_with_data(0, env=pendulum(n_envs))
    sizes = []
    monkeypatch.setattr(model.replay_buffer, "size", lambda: stored // n_envs)  # rows, one transition of each environment
    monkeypatch.setattr(model, "_update", lambda steps, batch_size, logs, **_: sizes.append(batch_size))
    monkeypatch.setattr(model, "_log_update", lambda *args: None)
    model.train(3)
    model._n_updates = 1
    model.train(3, batch_size=77)
    assert sizes == [expected] * 3 + [77]


class Watch(BaseCallback):
    """Copies of the actor after every step."""

    def __init__(self):
        super().__init__()
        self.actors = []

    def _on_step(self):
        self.actors.append({name: value.clone() for name, value in self.model.actor.named_parameters()})
        return True


def short_model(env, **kwargs):
    defaults = dict(learning_starts=20, batch_size=16, buffer_size=1000, policy_kwargs=dict(net_arch=[8, 8]), seed=0)
    return Symphony("MlpPolicy", env, device="cpu", **{**defaults, **kwargs})


@pytest.mark.parametrize(("length", "n_steps"), [(10, 60), (20, 45), (21, 45), (7, 50), (100, 30), (7, 21), (10, 20)])
def test_number_of_updates(pendulum, length, n_steps):
    model = short_model(pendulum(1, length)).learn(n_steps)
    # Training begins after transition 21, so an episode that ends with transition 20 is followed by one begun before
    started = sum(end > 20 for end in range(length, n_steps + 1, length))
    expected = 128 + 3 * (n_steps - 20) + 40 * started if n_steps > 20 else 0
    assert model._n_updates == expected


def test_number_of_updates_with_two_environments(pendulum):
    model = short_model(pendulum(2, 10)).learn(60)
    # 20 rollouts after transition 20; both environments end episodes at transitions 40 and 60
    assert model._n_updates == 128 + 3 * 20 + 40 * 4


def test_number_of_updates_over_two_calls_of_learn(pendulum):
    model = short_model(pendulum(1, 10)).learn(35)
    assert model._n_updates == 128 + 3 * 15 + 40
    model.learn(15, reset_num_timesteps=False)  # goes on in the same episode
    assert model._n_updates == 128 + 3 * 30 + 40 * 3


def test_numbers_of_updates_that_are_switched_off(pendulum):
    model = short_model(pendulum(1, 10), gradient_steps=1, initial_gradient_steps=(0, 0), episode_gradient_steps=0).learn(40)
    assert model._n_updates == 20


@pytest.mark.parametrize("saved", [False, True])
def test_episodes_without_updates_are_not_made_up_for(pendulum, tmp_path, saved):
    model = short_model(pendulum(1, 10), gradient_steps=0).learn(55)
    if saved:
        model.save(tmp_path / "model")
        model = Symphony.load(tmp_path / "model", env=model.env, device="cpu", gradient_steps=3)
    else:
        model.gradient_steps = 3
    model.learn(1, reset_num_timesteps=False)
    assert model._n_updates == 128 + 3


def test_weights_are_redrawn_at_the_start_of_warm_up_episodes(pendulum):
    model = short_model(pendulum(1, 10), learning_starts=35)
    start = {name: value.clone() for name, value in model.actor.named_parameters()}
    watch = Watch()
    model.learn(35, callback=watch)
    assert model._n_updates == 0
    linears = {f"mu.{i}.weight": module for i, module in enumerate(model.actor.mu) if isinstance(module, nn.Linear)}
    states = [start, *watch.actors]
    for step, (before, after) in enumerate(pairwise(states), start=1):
        for name, value in after.items():
            redrawn = name in linears and step in (1, 11, 21, 31)
            assert th.equal(before[name], value) is not redrawn, (step, name)
            if redrawn:
                bound = math.sqrt(6 / sum(value.shape))
                assert 0.5 * bound < value.abs().max().item() <= bound + 1e-7


def test_no_redraw_after_warm_up(pendulum):
    # Nothing is learnt, so that a redraw is all that could change the actor
    model = short_model(pendulum(1, 10), gradient_steps=0, initial_gradient_steps=(0, 0), episode_gradient_steps=0)
    watch = Watch()
    model.train = lambda *args, **kwargs: None
    model.learn(60, callback=watch)
    for actor in watch.actors[20:]:
        assert all(th.equal(value, watch.actors[19][name]) for name, value in actor.items())
    assert not th.equal(watch.actors[0]["mu.0.weight"], watch.actors[10]["mu.0.weight"])


def test_no_redraw_of_an_actor_that_another_model_has_trained(pendulum):
    trained = short_model(pendulum(1, 10)).learn(30)
    model = short_model(pendulum(1, 10), learning_starts=35)
    model.set_parameters(trained.get_parameters())
    model.learn(35)
    assert model._n_updates == 0
    assert all(th.equal(value, trained.actor.state_dict()[name]) for name, value in model.actor.state_dict().items())


@pytest.mark.parametrize("by", ["imitation", "state"])
def test_no_redraw_of_weights_that_were_put_in(pendulum, by):
    """There is nothing of them in Symphony's optimizer."""
    model = short_model(pendulum(1, 10), learning_starts=35)
    if by == "imitation":
        optimizer = th.optim.SGD(model.actor.parameters(), lr=0.1)
        model.actor(th.ones(1, 3)).sum().backward()
        optimizer.step()
    else:
        model.policy.load_state_dict(short_model(pendulum(1, 10), seed=1).policy.state_dict())
    start = copy.deepcopy(model.actor.state_dict())
    model.learn(35)
    assert all(th.equal(value, start[name]) for name, value in model.actor.state_dict().items())


def test_an_actor_that_was_put_in_is_who_is_evaluated(pendulum):
    model = short_model(pendulum(1, 10), learning_starts=35, policy_kwargs={"net_arch": [8], "actor_averaging": 0.3})
    with th.no_grad():
        model.actor.mu[-2].bias += 0.5
    observations = np.random.default_rng(0).normal(size=(20, 3)).astype(np.float32)
    for steps in (0, 35):
        model.learn(steps)
        one, other = (model.predict(observations, deterministic=deterministic)[0] for deterministic in (True, False))
        assert np.array_equal(one, other)


def test_weights_are_drawn_for_episodes_that_begin_by_a_reset(pendulum):
    model = short_model(pendulum(1, 10), learning_starts=35)
    model.learn(100, callback=lambda locals_, globals_: model.num_timesteps < 5)
    drawn = [model.actor.mu[0].weight.clone()]
    for reset in (False, True):  # after a stop, and as a new learn()
        model.learn(2, reset_num_timesteps=reset)
        drawn.append(model.actor.mu[0].weight.clone())
    assert not th.equal(drawn[0], drawn[1]) and not th.equal(drawn[1], drawn[2])
    model.learn(2, reset_num_timesteps=False)  # the same episode
    assert th.equal(model.actor.mu[0].weight, drawn[2])


@pytest.mark.parametrize("steps", [0, 5, 10])
def test_a_saved_actor_that_was_drawn_is_drawn_again(pendulum, tmp_path, steps):
    model = short_model(pendulum(1, 10), learning_starts=35).learn(steps)
    model.save(tmp_path / "model")
    loaded = Symphony.load(tmp_path / "model", env=model.env, device="cpu")
    th.manual_seed(1)  # loading seeds like making a model: the next weights would be those drawn first
    loaded.learn(11, reset_num_timesteps=False)
    assert not th.equal(loaded.actor.mu[0].weight, model.actor.mu[0].weight)


def test_who_is_evaluated_during_the_warm_up_is_who_acts(pendulum):
    model = short_model(pendulum(1, 10), learning_starts=35, policy_kwargs={"net_arch": [8], "actor_averaging": 0.3}).learn(35)
    observations = np.random.default_rng(0).normal(size=(20, 3)).astype(np.float32)
    one, other = (model.predict(observations, deterministic=deterministic)[0] for deterministic in (True, False))
    assert np.array_equal(one, other)


def test_uniform_warm_up_does_not_redraw(pendulum):
    model = short_model(pendulum(1, 10), learning_starts=35, warmup_policy="uniform")
    start = {name: value.clone() for name, value in model.actor.named_parameters()}
    model.learn(35)
    assert all(th.equal(value, start[name]) for name, value in model.actor.named_parameters())
    actions = model.replay_buffer.actions[:35].flatten()
    assert np.abs(actions).max() > 0.8 and abs(actions.mean()) < 0.35 and actions.std() > 0.4
    assert model.action_noise.t == 35  # SB3 adds the noise to uniform actions, too


def test_warm_up_actions_are_the_actors_with_noise(monkeypatch, pendulum):
    silent = NormalActionNoise(np.zeros(1), np.zeros(1))
    model = short_model(pendulum(1, 10), learning_starts=10, action_noise=silent).learn(10)
    observations = model.replay_buffer.observations[:10, 0]
    with th.no_grad():
        expected = model.actor(th.as_tensor(observations)).numpy()
    assert model.replay_buffer.actions[:10, 0] == pytest.approx(expected, abs=1e-6)
    noisy = short_model(pendulum(1, 10), learning_starts=10).learn(10)
    with th.no_grad():
        mean = noisy.actor(th.as_tensor(noisy.replay_buffer.observations[:10, 0])).numpy()
    difference = noisy.replay_buffer.actions[:10, 0] - mean
    assert np.all(difference != 0) and np.abs(difference).max() <= 2.5 * 0.3 + 1e-6


def test_noise_counts_steps_from_the_first_one(pendulum):
    model = short_model(pendulum(1, 10)).learn(25)
    assert model.action_noise.t == 25
    assert model.action_noise.sigma_t == pytest.approx(0.15 * (1 + math.cos(math.pi * 25 / 104_720)))
    two = short_model(pendulum(2, 10), learning_starts=100).learn(30)
    assert [noise.t for noise in two.action_noise.noises] == [30, 30]


def test_prediction_changes_nothing(pendulum):
    model = short_model(pendulum(1, 10), learning_starts=100).learn(10)  # an episode has just ended: a redraw is due
    actor = copy.deepcopy(model.actor.state_dict())
    baseline, t, due = model.baseline.clone(), model.action_noise.t, model._redraw_actor
    torch_state, numpy_state = th.get_rng_state(), np.random.get_state()[1].tolist()
    actions = [model.predict(np.array([0.1, 0.2, 0.3], np.float32), deterministic=flag)[0] for flag in (True, False, True)]
    assert actions[0] == actions[1] == actions[2]
    assert due is True and model._redraw_actor is True and model.action_noise.t == t == 10
    assert th.equal(model.baseline, baseline)
    assert all(th.equal(value, actor[name]) for name, value in model.actor.state_dict().items())
    assert th.equal(th.get_rng_state(), torch_state) and np.random.get_state()[1].tolist() == numpy_state


# Smoothing of the target ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("noise", [0.0, 0.05, 10.0])
def test_smoothed_target_actions(monkeypatch, noise):
    model, _ = model_with_data(initial_gradient_steps=(0, 0), policy_delay=50, target_policy_noise=noise)
    calls, values = [], model._regression.target_q_values
    monkeypatch.setattr(model._regression, "target_q_values", lambda *args: calls.append(args) or values(*args))
    model.train(40, 128)
    with th.no_grad():
        own = th.cat([model.actor(observations) for observations, _ in calls])
    actions = th.cat([actions for _, actions in calls])
    differences = actions - own
    if noise == 0:
        assert differences.abs().max() < 1e-6
    elif noise == 10:  # nearly all of them are beyond the bounds of the action space
        assert (actions.abs() > 1 - 1e-6).float().mean() > 0.8
        assert actions.abs().max() <= 1
    else:  # a Gaussian clipped at 2.5 standard deviations has a standard deviation of 0.986
        assert differences.abs().max().item() == pytest.approx(2.5 * noise, rel=1e-4)
        assert differences.std().item() == pytest.approx(0.986 * noise, rel=0.02) and abs(differences.mean().item()) < 0.003


# Saturation of the actor ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("scale, shift, saturated", [(1.0, 0.0, (0, 0)), (4.0, 2.0, (0.2, 0.8)), (30.0, 29.0, (1, 1))])
def test_saturation_penalty(scale, shift, saturated):
    """Its part of the actor's gradient is that of the squared distance from [-1.5, 1.5], before the tanh."""
    gradients = []
    for penalty in (0.0, 0.3):
        model, _ = model_with_data(actor_loss="mean", saturation_penalty=penalty)
        with th.no_grad():
            model.actor.mu[-2].weight *= scale
            model.actor.mu[-2].bias += shift
        batch = model.replay_buffer.sample(32)
        actor = copy.deepcopy(model.actor)
        model._update_actor(batch, update_logs())
        gradients.append([parameter.grad.double() for parameter in model.actor.parameters()])
    u = actor.before_tanh(batch.observations).double()
    assert saturated[0] <= (u.abs() > 1.5).double().mean() <= saturated[1]
    assert scale < 30 or u.abs().min() > 10
    expected = ((u - u.clamp(-1.5, 1.5)) ** 2).sum(dim=1).mean()
    for without, with_it, part in zip(*gradients, th.autograd.grad(0.3 * expected, actor.parameters()), strict=True):
        th.testing.assert_close(with_it - without, part.double(), rtol=1e-3, atol=1e-5)
        assert (part.abs().max() > 1e-3) == (scale > 1)
