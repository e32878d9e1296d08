"""All options run, and do what they say as far as a short run can show it."""

import copy
import warnings
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3 import SAC, TD3
from stable_baselines3.common.buffers import DictReplayBuffer, NStepReplayBuffer, ReplayBuffer
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.noise import NormalActionNoise, OrnsteinUhlenbeckActionNoise, VectorizedActionNoise
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from stable_baselines3.common.vec_env import SubprocVecEnv
from torch import nn

from sb3_symphony import REDQ, DroQ, Symphony
from sb3_symphony.common.buffers import FadingReplayBuffer, PrioritizedReplayBuffer
from sb3_symphony.common.ensembles import TARGET_MODES, EnsembleCritic
from sb3_symphony.common.layers import LeakySine
from sb3_symphony.common.losses import ACTOR_LOSSES, CRITIC_LOSSES
from sb3_symphony.common.noise import (
    DecayingNormalActionNoise,
    DisturbanceActionNoise,
    PinkActionNoise,
    StickyActionNoise,
)


class AsymmetricBox(gym.Env):
    """Episodes of 10 steps whose actions have bounds that are not symmetric; remembers the actions it was given."""

    def __init__(self, low: Any = -3.0, high: Any = 1.0, dtype: Any = np.float32) -> None:
        shape = np.broadcast(low, high).shape or (2,)
        self.observation_space = spaces.Box(-1, 1, (3,), np.float32)
        self.action_space = spaces.Box(np.full(shape, low, dtype), np.full(shape, high, dtype), dtype=dtype)
        self.actions: list[np.ndarray] = []
        self.steps = 0

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[np.ndarray, dict]:
        super().reset(seed=seed)
        self.steps = 0
        return self.np_random.uniform(-1, 1, 3).astype(np.float32), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        self.actions.append(np.array(action))
        self.steps += 1
        obs = self.np_random.uniform(-1, 1, 3).astype(np.float32)
        return obs, -float(np.abs(action).sum()), False, self.steps >= 10, {}


def assert_finite(model: Any) -> None:
    for name, parameter in model.policy.named_parameters():
        assert th.isfinite(parameter).all(), name


def weights(module: nn.Module) -> th.Tensor:
    return nn.utils.parameters_to_vector(module.parameters()).detach().clone()


# ---------------------------------------------------------------- options of the algorithms


@pytest.mark.parametrize("target_mode", TARGET_MODES)
@pytest.mark.parametrize("critic_loss", CRITIC_LOSSES)
def test_targets_and_losses(make, target_mode, critic_loss):
    model = make(target_mode=target_mode, critic_loss=critic_loss)
    before = weights(model.critic)
    model.learn(60)
    assert_finite(model)
    assert not th.equal(weights(model.critic), before)


@pytest.mark.parametrize("critic_engine", ["fused", "autograd"])
def test_critics_that_classify(make, critic_engine):
    """Their values stay inside the bins."""
    model = make(critic_loss="hl_gauss", policy_kwargs=dict(value_range=(-1.0, 2.0), n_bins=7, critic_engine=critic_engine))
    before = weights(model.critic)
    model.learn(60)
    assert_finite(model)
    assert not th.equal(weights(model.critic), before)
    q_values = model.critic(th.randn(20, 3), th.rand(20, 1) * 2 - 1)
    assert q_values.shape == (model.n_critics, 20, 1) and ((q_values > -1) & (q_values < 2)).all()


@pytest.mark.parametrize("cls", [REDQ, DroQ])
@pytest.mark.parametrize("critic_engine", ["fused", "autograd"])
@pytest.mark.parametrize("critic_reduction", ["independent", "ensemble_mean"])
def test_reductions_and_engines(small, cls, critic_engine, critic_reduction):
    model = small(cls, critic_reduction=critic_reduction, policy_kwargs=dict(critic_engine=critic_engine))
    model.learn(60)
    assert_finite(model)


@pytest.mark.parametrize("actor_loss", ACTOR_LOSSES)
@pytest.mark.parametrize("min_mix", [0.0, 0.7, 1.0])
def test_symphony_actor_losses(small, actor_loss, min_mix):
    model = small(Symphony, actor_loss=actor_loss, min_mix=min_mix)
    before = weights(model.actor)
    model.learn(60)
    assert_finite(model)
    assert not th.equal(weights(model.actor), before)


@pytest.mark.parametrize("options", [dict(batch_size=None), dict(critic_learning_rate=None), dict(warmup_policy="uniform")])
def test_symphony_options(small, options):
    model = small(Symphony, **options)
    model.learn(60)
    assert_finite(model)


def test_symphony_batch_size_grows_with_the_buffer(small, monkeypatch):
    model = small(Symphony, batch_size=None, buffer_size=200_000, n_envs=2)
    model.learn(60)
    sizes = []
    monkeypatch.setattr(model, "_update", lambda gradient_steps, batch_size, logs: sizes.append(batch_size))
    monkeypatch.setattr(model, "_log_update", lambda *args: None)
    for rows in (10, 50_000, 90_000):
        model.replay_buffer.pos = rows
        model.train(1)
    assert sizes == [128, 200, 360]


def test_symphony_learning_rates_are_separate(small):
    model = small(Symphony, learning_rate=lambda left: 1e-3 * left, critic_learning_rate=lambda left: 2e-3 * left)
    model.learn(50)
    assert model.actor.optimizer.param_groups[0]["lr"] == pytest.approx(1e-3 * model._current_progress_remaining)
    assert model.critic.optimizer.param_groups[0]["lr"] == pytest.approx(2e-3 * model._current_progress_remaining)
    model = small(Symphony, learning_rate=1e-4, critic_learning_rate=None)
    model.learn(50)
    assert model.critic.optimizer.param_groups[0]["lr"] == 1e-4


@pytest.mark.parametrize(
    "subset_size, sizes", [(1, {1}), (1.5, {1, 2}), (2, {2}), (2.5, {2, None}), ("all", {None}), (3, {None})]
)
def test_subset_sizes(small, subset_size, sizes):
    model = small(REDQ, subset_size=subset_size)
    model.learn(60)
    assert_finite(model)
    drawn = [model._draw_subset() for _ in range(200)]
    assert {None if members is None else len(members) for members in drawn} == sizes
    assert all(members is None or len(set(members)) == len(members) for members in drawn)


@pytest.mark.parametrize("cls", [REDQ, DroQ])
@pytest.mark.parametrize("ent_coef, start", [(0.1, 0.1), (0.0, 0.0), ("0.1", 0.1), ("auto", 1.0), ("auto_0.1", 0.1)])
def test_entropy_coefficients(small, cls, ent_coef, start):
    model = small(cls, ent_coef=ent_coef)
    assert model._current_ent_coef().item() == pytest.approx(start)
    model.learn(60)
    learned = isinstance(ent_coef, str) and ent_coef.startswith("auto")
    assert (model._current_ent_coef().item() != pytest.approx(start, rel=1e-6)) == learned
    assert ("train/ent_coef_loss" in model.logger.name_to_value) == learned


def test_target_entropy(small):
    assert small(REDQ).target_entropy == -1.0
    assert small(REDQ, target_entropy="auto").target_entropy == -1.0
    assert small(REDQ, target_entropy="mbpo").target_entropy == -1.0  # not in the table
    assert small(REDQ, target_entropy=-0.3).target_entropy == -0.3


@pytest.mark.parametrize("cls", [REDQ, DroQ])
@pytest.mark.parametrize("sde_sample_freq", [-1, 4])
@pytest.mark.parametrize("use_sde_at_warmup", [False, True])
@pytest.mark.parametrize("n_envs", [1, 2])
def test_gsde(small, cls, sde_sample_freq, use_sde_at_warmup, n_envs):
    model = small(
        cls,
        n_envs=n_envs,
        use_sde=True,
        sde_sample_freq=sde_sample_freq,
        use_sde_at_warmup=use_sde_at_warmup,
        train_freq=8,
        policy_kwargs=dict(log_std_init=-2, use_expln=True),
    )
    before = model.actor.log_std.detach().clone()
    model.learn(80)
    assert_finite(model)
    assert not th.equal(model.actor.log_std, before)


def test_gsde_acts_in_warm_up(small):
    """Uniform actions fill [-1, 1]; a small state-dependent noise does not."""

    def spread(**kwargs):
        model = small(REDQ, learning_starts=100, use_sde=True, policy_kwargs=dict(log_std_init=-6), **kwargs)
        return model.learn(100).replay_buffer.actions[:100].std()

    assert spread(use_sde_at_warmup=False) > 0.4
    assert spread(use_sde_at_warmup=True) < 0.4


# ---------------------------------------------------------------- schedule of updates


@pytest.mark.parametrize(
    "train_freq, gradient_steps, updates",
    [
        (1, 1, 80),  # training begins with step 21
        (1, 3, 240),
        (4, 1, 20),  # at 24, 28, ..., 100
        (4, -1, 80),
        ((4, "step"), 2, 40),
        ((1, "episode"), 5, 20),  # episodes end at 25, 50, 75, 100
        ((2, "episode"), -1, 100),
        (1, 0, 0),
    ],
)
def test_number_of_updates(make, algorithm, train_freq, gradient_steps, updates):
    extra = dict(initial_gradient_steps=(0, 0), episode_gradient_steps=0) if algorithm is Symphony else {}
    model = make(train_freq=train_freq, gradient_steps=gradient_steps, **extra)
    model.learn(100)
    assert model.num_timesteps == 100
    assert model._n_updates == updates


@pytest.mark.parametrize("n_envs, gradient_steps, updates", [(3, 1, 25), (3, -1, 75), (3, 2, 50)])
def test_number_of_updates_with_several_envs(make, algorithm, n_envs, gradient_steps, updates):
    """The 25 vector steps that end at 21, 24, ..., 93 are followed by updates."""
    extra = dict(initial_gradient_steps=(0, 0), episode_gradient_steps=0) if algorithm is Symphony else {}
    model = make(n_envs=n_envs, gradient_steps=gradient_steps, **extra)
    model.learn(91)
    assert model.num_timesteps == 93
    assert model._n_updates == updates


def test_no_training_before_learning_starts(make):
    """The condition is strict: the first update follows the step after the last warm-up step."""
    model = make(learning_starts=50)
    before = weights(model.critic), weights(model.critic_target)
    model.learn(50)
    assert model._n_updates == 0
    assert th.equal(weights(model.critic), before[0]) and th.equal(weights(model.critic_target), before[1])
    model.learn(1, reset_num_timesteps=False)
    assert model._n_updates > 0


def test_learning_starts_zero(make):
    model = make(learning_starts=0)
    model.learn(30)
    assert_finite(model)


@pytest.mark.parametrize("gradient_steps", [1, 3, 7])
def test_policy_delay_counts_updates_over_the_models_life(make, algorithm, gradient_steps):
    extra = dict(initial_gradient_steps=(0, 0), episode_gradient_steps=0) if algorithm is Symphony else {}
    model = make(policy_delay=5, gradient_steps=gradient_steps, **extra)
    model.learn(22)
    seen = []
    original = model._update_actor
    model._update_actor = lambda *args: (seen.append(model._n_updates), original(*args))
    n_before = model._n_updates
    model.learn(30, reset_num_timesteps=False)
    assert seen == [n for n in range(n_before + 1, model._n_updates + 1) if n % 5 == 0]
    assert len(seen) >= 5


def test_target_networks_move_at_every_update(make):
    model = make(policy_delay=1000)
    model.learn(30)
    for _ in range(3):
        before, online = weights(model.critic_target), weights(model.critic)
        model.train(gradient_steps=1, batch_size=16)
        expected = before + model.tau * (weights(model.critic) - before)
        assert not th.equal(weights(model.critic), online)
        th.testing.assert_close(weights(model.critic_target), expected)


@pytest.mark.parametrize("train_freq", [(1, "episode"), (2, "episode")])
def test_episodic_training_needs_one_env(make, train_freq):
    with pytest.raises((AssertionError, ValueError), match="one env"):
        make(n_envs=2, train_freq=train_freq).learn(30)


def test_learn_twice(make):
    model = make()
    model.learn(60)
    n_updates = model._n_updates
    model.learn(60)
    assert model.num_timesteps == 60 and model._n_updates > n_updates
    model.learn(40, reset_num_timesteps=False)
    assert model.num_timesteps == 100
    assert model.replay_buffer.size() == 160
    assert_finite(model)


def test_second_learn_keeps_the_trained_actor(make):
    """``learn()`` restarts the count of steps by default, and with it the warm-up: what was learned must survive it."""
    model = make(learning_starts=30)
    model.learn(60)
    before = weights(model.actor)
    model.learn(30)
    assert th.equal(weights(model.actor), before)


@pytest.mark.parametrize("options", [{}, dict(action_noise=DecayingNormalActionNoise(1, decay_steps=100))])
def test_two_learns_equal_one(make, options):
    """No noise, decay or counter restarts with ``learn(reset_num_timesteps=False)``."""
    together = make(**copy.deepcopy(options)).learn(130)
    apart = make(**copy.deepcopy(options)).learn(70).learn(60, reset_num_timesteps=False)
    assert together._n_updates == apart._n_updates
    assert th.equal(weights(together.policy), weights(apart.policy))


# ---------------------------------------------------------------- n-step returns


@pytest.mark.parametrize("options", [{}, dict(replay_buffer_class=NStepReplayBuffer)])
@pytest.mark.parametrize("n_envs", [1, 2])
def test_n_steps(make, options, n_envs):
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # SB3 would warn that n_steps is ignored
        model = make(n_steps=3, gamma=0.9, n_envs=n_envs, **options)
    assert model.n_steps == 3
    assert model.replay_buffer.n_steps == 3 and model.replay_buffer.gamma == 0.9
    model.learn(80)
    assert_finite(model)
    discounts = model.replay_buffer.sample(500).discounts.unique()
    expected = th.tensor([0.9, 0.9**2, 0.9**3])
    assert all(th.isclose(expected, value).any() for value in discounts)
    assert th.isclose(discounts.max(), expected[0]) and th.isclose(discounts.min(), expected[2])


def test_n_steps_change_what_is_learned(make):
    assert not th.equal(weights(make(n_steps=1).learn(60).critic), weights(make(n_steps=3).learn(60).critic))


@pytest.mark.parametrize("replay_buffer_class", [FadingReplayBuffer, PrioritizedReplayBuffer])
def test_n_steps_reach_our_buffers(make, replay_buffer_class):
    model = make(n_steps=3, gamma=0.9, replay_buffer_class=replay_buffer_class)
    assert model.replay_buffer.n_steps == 3 and model.replay_buffer.gamma == 0.9
    model.learn(60)
    assert_finite(model)


def test_n_steps_are_refused_where_the_buffer_has_none(make):
    with pytest.raises(ValueError, match="n_steps=3"):
        make(n_steps=3, replay_buffer_class=ReplayBuffer)


def test_users_buffer_arguments_stay_as_they_are(make):
    arguments: dict[str, Any] = {}
    make(n_steps=3, replay_buffer_kwargs=arguments)
    assert arguments == {}


# ---------------------------------------------------------------- replay buffers


@pytest.mark.parametrize(
    "options",
    [
        dict(replay_buffer_class=FadingReplayBuffer),
        dict(replay_buffer_class=FadingReplayBuffer, replay_buffer_kwargs=dict(fade_factor=3.0, fade_power=1.0)),
        dict(replay_buffer_class=FadingReplayBuffer, replay_buffer_kwargs=dict(fade_factor=None)),
        dict(replay_buffer_class=PrioritizedReplayBuffer),
        dict(replay_buffer_class=PrioritizedReplayBuffer, replay_buffer_kwargs=dict(alpha=0.9, beta=1.0)),
        dict(replay_buffer_class=ReplayBuffer),
    ],
)
@pytest.mark.parametrize("n_envs", [1, 3])
@pytest.mark.parametrize("buffer_size", [1000, 45])
def test_replay_buffers(make, options, n_envs, buffer_size):
    """Also where the ring wraps, and with several updates per draw."""
    model = make(n_envs=n_envs, buffer_size=buffer_size, gradient_steps=2, **options)
    assert type(model.replay_buffer) is options["replay_buffer_class"]
    model.learn(90)
    assert model.replay_buffer.full == (buffer_size == 45)
    assert_finite(model)


def test_default_buffers(small):
    assert type(small(Symphony).replay_buffer) is FadingReplayBuffer
    assert type(small(Symphony, n_steps=3).replay_buffer) is FadingReplayBuffer
    for cls in (REDQ, DroQ):
        assert type(small(cls).replay_buffer) is ReplayBuffer
        assert type(small(cls, n_steps=3).replay_buffer) is NStepReplayBuffer


class HalfDemonstrations(ReplayBuffer):
    """Half of each minibatch comes from elsewhere, told by its rewards; knows no time limits."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        del self.timeouts
        self.handle_timeout_termination = False

    def _get_samples(self, batch_inds: np.ndarray, env: Any = None) -> ReplayBufferSamples:
        stored = (self.observations, self.actions, self.next_observations, self.dones[..., None], self.rewards[..., None])
        return ReplayBufferSamples(*(self.to_torch(each[batch_inds, 0]) for each in stored))

    def sample(self, batch_size: int, env: Any = None) -> ReplayBufferSamples:
        own, given = (super(HalfDemonstrations, self).sample(batch_size // 2, env) for _ in range(2))
        given = given._replace(rewards=th.full_like(given.rewards, 1000.0))
        return ReplayBufferSamples(*(None if a is None else th.cat([a, b]) for a, b in zip(own, given, strict=True)))


class Counted(FadingReplayBuffer):
    """With SB3's ``sample``, as users write it."""

    def sample(self, batch_size: int, env: Any = None) -> Any:
        return super().sample(batch_size, env)


def test_a_fading_buffer_of_ones_own(make):
    assert make(replay_buffer_class=Counted).learn(40)._n_updates > 0


def test_minibatches_are_as_a_users_buffer_draws_them(make, monkeypatch):
    model = make(replay_buffer_class=HalfDemonstrations, gradient_steps=4)
    shares, fit = [], model._fit_critics
    monkeypatch.setattr(
        model, "_fit_critics", lambda batch, *args: shares.append((batch.rewards == 1000).float().mean()) or fit(batch, *args)
    )
    model.learn(25)
    model.learn(25)
    assert len(shares) > 20 and set(map(float, shares)) == {0.5}


def test_critics_of_ones_own(make):
    """What a subclass computes is what is learned; critics that replace others are learned from then on."""

    class Zero(EnsembleCritic):
        def forward(self, *args: Any, **kwargs: Any) -> th.Tensor:
            return 0 * super().forward(*args, **kwargs)

    model = make().learn(25)
    for kind, learned in ((Zero, False), (EnsembleCritic, True)):
        model.policy.critic = model.critic = model.policy.make_critic()
        model.critic.__class__ = kind
        model.critic.optimizer = th.optim.Adam(model.critic.parameters(), 1e-3)
        before = weights(model.critic)
        model.learn(5, reset_num_timesteps=False)
        assert th.equal(before, weights(model.critic)) != learned


def test_priorities_follow_the_errors(make):
    """Every drawn transition has the priority of its last error, every other one the first it was given."""
    model = make(replay_buffer_class=PrioritizedReplayBuffer)
    model.learn(21)
    priorities = model.replay_buffer.tree.get(np.arange(21))
    assert len(np.unique(priorities)) > 3
    model.train(gradient_steps=20, batch_size=16)
    assert len(np.unique(model.replay_buffer.tree.get(np.arange(21)))) > 15


def test_priorities_guide_the_next_update(make, monkeypatch):
    """Not only the next call of ``train()``, which may be a whole episode later."""
    model = make(replay_buffer_class=PrioritizedReplayBuffer).learn(21)
    buffer, calls = model.replay_buffer, []
    sample, update_priorities = buffer.sample, buffer.update_priorities
    monkeypatch.setattr(buffer, "sample", lambda *args, **kwargs: calls.append("sample") or sample(*args, **kwargs))
    monkeypatch.setattr(buffer, "update_priorities", lambda *args: calls.append("update") or update_priorities(*args))
    model.train(gradient_steps=4, batch_size=16)
    assert calls == ["sample", "update"] * 4


@pytest.mark.parametrize("cls", [TD3, SAC])
def test_fading_buffer_under_sb3_algorithms(cls, pendulum):
    model = cls(
        "MlpPolicy",
        pendulum(2),
        learning_starts=20,
        policy_kwargs=dict(net_arch=[16]),
        replay_buffer_class=FadingReplayBuffer,
    )
    model.learn(60)


def test_memory_optimised_buffer(small):
    model = small(REDQ, optimize_memory_usage=True, replay_buffer_kwargs=dict(handle_timeout_termination=False))
    model.learn(60)
    assert model.replay_buffer.optimize_memory_usage


def test_an_overwritten_row_does_not_stay_the_end_of_a_trajectory(make):
    """SB3 itself writes no timeouts here."""
    model = make(buffer_size=20, replay_buffer_kwargs=dict(handle_timeout_termination=False)).learn(10)
    model.learn(15)
    assert model.replay_buffer.timeouts[9]
    model.learn(10, reset_num_timesteps=False)
    assert not model.replay_buffer.timeouts[9]


# ---------------------------------------------------------------- several environments and exploration noise


@pytest.mark.parametrize("n_envs", [2, 3])
@pytest.mark.parametrize("gradient_steps", [1, -1])
def test_several_envs(make, n_envs, gradient_steps):
    model = make(n_envs=n_envs, gradient_steps=gradient_steps)
    model.learn(90)
    assert model.replay_buffer.actions.shape[1] == n_envs
    assert model.replay_buffer.size() == -(-90 // n_envs)
    assert_finite(model)


@pytest.mark.parametrize("cls", [Symphony, REDQ])
def test_subprocesses(small, cls):
    env = make_vec_env("Pendulum-v1", n_envs=2, vec_env_cls=SubprocVecEnv, vec_env_kwargs=dict(start_method="fork"))
    try:
        model = small(cls, env)
        model.learn(60)
        assert_finite(model)
    finally:
        env.close()


NOISES = [
    NormalActionNoise(np.zeros(1), 0.1 * np.ones(1)),
    OrnsteinUhlenbeckActionNoise(np.zeros(1), 0.1 * np.ones(1)),
    DecayingNormalActionNoise(1),
    StickyActionNoise(1, hold=4),
    PinkActionNoise(1, block_steps=25),
    DisturbanceActionNoise(1),
]


@pytest.mark.parametrize("noise", NOISES, ids=lambda noise: type(noise).__name__)
@pytest.mark.parametrize("n_envs", [1, 2])
def test_action_noises(make, noise, n_envs):
    model = make(n_envs=n_envs, action_noise=copy.deepcopy(noise))
    model.learn(60)
    assert_finite(model)
    assert isinstance(model.action_noise, VectorizedActionNoise) == (n_envs > 1)
    # That of a disturbance is not known; REDQ logs its actor's
    unknown = isinstance(noise, DisturbanceActionNoise) and isinstance(model, Symphony)
    assert np.isnan(model.logger.name_to_value["train/noise_std"]) == unknown


def test_vectorised_noise_may_be_given(make):
    model = make(n_envs=3, action_noise=VectorizedActionNoise(NormalActionNoise(np.zeros(1), np.ones(1)), 3))
    model.learn(60)
    assert_finite(model)


@pytest.mark.parametrize("n_envs", [1, 3])
def test_noise_decays_with_environment_steps(make, n_envs):
    noise = DecayingNormalActionNoise(1, sigma=0.4, sigma_final=0.1, decay_steps=120, decay="linear")
    model = make(n_envs=n_envs, action_noise=noise)
    model.learn(60)
    noises = model.action_noise.noises if n_envs > 1 else [model.action_noise]
    for each in noises:
        assert each.t == 60
        assert each.sigma_t == pytest.approx(0.25)
    model.learn(30)  # a new count of steps, but the same decay
    noises = model.action_noise.noises if n_envs > 1 else [model.action_noise]
    assert all(each.t == 90 for each in noises)


def test_symphony_has_noise_by_default(small):
    model = small(Symphony)
    assert isinstance(model.action_noise, DecayingNormalActionNoise)
    assert small(Symphony, action_noise=None).action_noise is None
    assert small(REDQ).action_noise is None


# ---------------------------------------------------------------- Symphony's warm-up and episodes


def test_symphony_redraws_the_actor_at_every_warm_up_episode(small):
    model = small(Symphony, learning_starts=60, action_noise=None)
    seen = []

    def record(locals_: dict, globals_: dict) -> bool:
        seen.append(weights(model.actor))
        return True

    model.learn(60, callback=record)
    assert all(th.equal(seen[i], seen[i + 1]) for i in range(59) if i not in (24, 49))  # episodes have 25 steps
    assert not th.equal(seen[24], seen[25]) and not th.equal(seen[49], seen[50])


def test_symphony_uniform_warm_up_leaves_the_actor_alone(small):
    model = small(Symphony, learning_starts=60, warmup_policy="uniform")
    before = weights(model.actor)
    model.learn(60)
    assert th.equal(weights(model.actor), before)


def test_symphony_initial_and_episode_updates(small):
    """(4, 5) updates when training begins at step 31, one per step, 7 more at the start of the episodes 50 and 75."""
    model = small(Symphony, learning_starts=30, initial_gradient_steps=(4, 5), episode_gradient_steps=7)
    model.learn(31)
    assert model._n_updates == 4 + 5 + 1
    model.learn(18, reset_num_timesteps=False)
    assert model._n_updates == 9 + 19
    model.learn(1, reset_num_timesteps=False)
    assert model._n_updates == 9 + 20 + 7
    model.learn(30, reset_num_timesteps=False)
    assert model._n_updates == 9 + 50 + 2 * 7


def test_symphony_episode_updates_with_several_envs(small):
    """All three episodes end at the same vector step."""
    model = small(Symphony, n_envs=3, initial_gradient_steps=(0, 0), episode_gradient_steps=7)
    model.learn(90)
    assert model._n_updates == 30 - 6 + 3 * 7


def test_symphony_initial_updates_are_made_once(small):
    model = small(Symphony, initial_gradient_steps=(50, 50), episode_gradient_steps=0)
    model.learn(40)
    model.learn(40)
    assert model._n_updates == 100 + 2 * 20


# ---------------------------------------------------------------- actions


@pytest.mark.parametrize("low, high", [(-3.0, 1.0), (0.0, 10.0), ([-1.0, -5.0], [2.0, -4.0])])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_action_bounds(make, low, high, dtype):
    env = AsymmetricBox(low, high, dtype)
    model = make(env, action_noise=NormalActionNoise(np.zeros(2), np.ones(2)))
    model.learn(60)
    given = np.stack(env.actions)
    box = env.action_space
    assert (given >= box.low - 1e-6).all() and (given <= box.high + 1e-6).all()
    stored = model.replay_buffer.actions[:60, 0]
    assert stored.dtype == np.float32
    assert np.abs(stored).max() <= 1.0
    # What is stored are the same actions, scaled to [-1, 1]
    np.testing.assert_allclose(stored, 2 * (given - box.low) / (box.high - box.low) - 1, atol=1e-4)
    action, _ = model.predict(box.low.astype(np.float32)[:1].repeat(3) * 0, deterministic=True)
    assert box.contains(action.astype(dtype))
    assert_finite(model)


def test_predict_shapes(make):
    model = make()
    one, state = model.predict(np.zeros(3, dtype=np.float32))
    assert one.shape == (1,) and state is None
    many, _ = model.predict(np.zeros((4, 3), dtype=np.float32), deterministic=True)
    assert many.shape == (4, 1)
    assert (np.abs(many) <= 2).all()
    first, _ = model.predict(np.zeros(3, dtype=np.float32), deterministic=True)
    second, _ = model.predict(np.zeros(3, dtype=np.float32), deterministic=True)
    np.testing.assert_array_equal(first, second)


# ---------------------------------------------------------------- policy arguments


@pytest.mark.parametrize(
    "policy_kwargs",
    [
        dict(net_arch=[]),
        dict(net_arch=[16, 8]),
        dict(net_arch=dict(pi=[8], qf=[16, 16])),
        dict(net_arch=dict(pi=[], qf=[16])),
        dict(activation_fn=nn.Tanh),
        dict(activation_fn=nn.ELU),
        dict(activation_fn=nn.GELU),
        dict(layer_norm=True),
        dict(layer_norm=True, dropout_rate=0.1),
        dict(dropout_rate=0.0, layer_norm=False),
        dict(optimizer_class=th.optim.AdamW, optimizer_kwargs=dict(weight_decay=1e-3)),
        dict(optimizer_class=th.optim.SGD),
        dict(optimizer_class=th.optim.RMSprop),
        dict(optimizer_kwargs=dict(betas=(0.5, 0.9), eps=1e-5)),
        dict(optimizer_kwargs=dict(amsgrad=True)),
        dict(share_features_extractor=True),
    ],
    ids=str,
)
def test_policy_arguments(make, policy_kwargs):
    model = make(policy_kwargs=policy_kwargs)
    before = weights(model.actor), weights(model.critic)
    model.learn(50)
    assert_finite(model)
    assert not th.equal(weights(model.actor), before[0])
    assert not th.equal(weights(model.critic), before[1])
    if "optimizer_class" in policy_kwargs:
        assert type(model.critic.optimizer) is policy_kwargs["optimizer_class"]


@pytest.mark.parametrize(
    "policy_kwargs",
    [
        dict(net_arch=[16, 16, 16]),
        dict(net_arch=[16, 16], activation_fn=[nn.Identity, LeakySine], layer_norm=[True, False], leaky_slope=0.2),
        dict(
            net_arch=dict(pi=[8, 8], qf=[16]),
            activation_fn=dict(pi=nn.ReLU, qf=[LeakySine]),
            layer_norm=dict(pi=False, qf=True),
        ),
    ],
    ids=str,
)
def test_symphony_policy_arguments(small, policy_kwargs):
    model = small(Symphony, policy_kwargs=policy_kwargs)
    model.learn(50)
    assert_finite(model)


def test_policy_class_may_be_given(make, algorithm):
    assert isinstance(make(policy=algorithm.policy_aliases["MlpPolicy"]).policy, algorithm.policy_aliases["MlpPolicy"])


def test_policy_arguments_are_not_changed(make):
    """One dict may be given to several models."""
    policy_kwargs = dict(net_arch=dict(pi=[16], qf=[16]), optimizer_kwargs=dict(eps=1e-5))
    before = copy.deepcopy(policy_kwargs)
    for cls in (REDQ, Symphony, DroQ, REDQ, TD3):
        cls("MlpPolicy", "Pendulum-v1", policy_kwargs=policy_kwargs, buffer_size=10)
        assert policy_kwargs == before
    make(policy_kwargs=policy_kwargs).learn(30)
    assert policy_kwargs == before


def test_number_of_critics(algorithm, small):
    default = {Symphony: 2, REDQ: 10, DroQ: 2}[algorithm]
    model = algorithm("MlpPolicy", "Pendulum-v1", buffer_size=10)
    assert model.n_critics == model.critic.n_critics == default
    for kwargs in (
        dict(n_critics=4),
        dict(policy_kwargs=dict(n_critics=4)),
        dict(n_critics=4, policy_kwargs=dict(n_critics=4)),
    ):
        model = small(algorithm, **kwargs)
        assert model.n_critics == model.critic.n_critics == model.critic_target.n_critics == 4
        obs, actions = th.zeros(5, 3), th.zeros(5, 1)
        assert model.critic(obs, actions).shape == (4, 5, 1)
    with pytest.raises(ValueError, match=r"n_critics=3.*n_critics=4"):
        small(algorithm, n_critics=3, policy_kwargs=dict(n_critics=4))


def test_one_critic(make, algorithm):
    model = make(n_critics=1, **({} if algorithm is Symphony else dict(subset_size=1)))
    model.learn(50)
    assert_finite(model)
    assert model.logger.name_to_value["train/q_std"] == 0.0


def test_set_up_is_idempotent(make):
    model = make(n_steps=3, replay_buffer_kwargs=dict(), action_noise=DecayingNormalActionNoise(1))
    first, buffer, noise = weights(model.policy), model.replay_buffer, model.action_noise
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        model._setup_model()
        model._setup_model()
    assert th.equal(weights(model.policy), first)
    assert model.replay_buffer is buffer and model.action_noise is noise and model.n_steps == 3
    assert model.critic is model.policy.critic and model.actor is model.policy.actor
    assert model.critic_target is model.policy.critic_target
    before = weights(model.critic)
    model.learn(60)
    assert not th.equal(weights(model.policy.critic), before)


def test_deferred_set_up(make):
    model = make(_init_setup_model=False)
    assert not hasattr(model, "critic")
    model._setup_model()
    model.learn(40)


def test_subclass_that_passes_its_arguments_on(algorithm, small):
    """Variants of an algorithm need not repeat its signature."""

    class Variant(algorithm):
        def __init__(self, *args: Any, **kwargs: Any) -> None:
            super().__init__(*args, **kwargs)

    arguments = dict(policy="MlpPolicy", env="Pendulum-v1", learning_starts=20, policy_kwargs=dict(net_arch=[16]))
    assert Variant(**arguments, buffer_size=100).learn(30).num_timesteps == 30


def test_arguments_follow_sb3(algorithm):
    """The common prefix in SB3's order, at most twelve of the algorithm's own, then SB3's common end."""
    import inspect

    ours = list(inspect.signature(algorithm.__init__).parameters)
    sac = list(inspect.signature(SAC.__init__).parameters)
    prefix = sac[: sac.index("n_steps") + 1]
    assert ours[: len(prefix)] == prefix
    end = sac[sac.index("stats_window_size") :]
    assert ours[-len(end) :] == end
    own = [name for name in ours[len(prefix) : -len(end)] if "sde" not in name]
    assert len(own) <= 12
    if algorithm is not Symphony:
        assert ours[-len(end) - 3 : -len(end)] == ["use_sde", "sde_sample_freq", "use_sde_at_warmup"]
    learn = list(inspect.signature(algorithm.learn).parameters.values())
    assert [p.name for p in learn] == [p.name for p in inspect.signature(SAC.learn).parameters.values()]
    assert next(p.default for p in learn if p.name == "tb_log_name") == algorithm.__name__


def test_dict_buffer_for_dict_observations(small):
    from stable_baselines3.common.envs import SimpleMultiObsEnv

    env = SimpleMultiObsEnv(discrete_actions=False)
    assert type(small(REDQ, env, policy="MultiInputPolicy").replay_buffer) is DictReplayBuffer
