import copy
import pickle
from functools import partial

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from maths_helpers import fade_weights
from scipy.stats import chisquare
from stable_baselines3 import DDPG, SAC, TD3
from stable_baselines3.common.buffers import DictReplayBuffer, NStepReplayBuffer, ReplayBuffer
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.envs import SimpleMultiObsEnv
from stable_baselines3.common.vec_env import VecNormalize

from sb3_symphony.common.buffers import (
    FadingDictReplayBuffer,
    FadingReplayBuffer,
    PrioritizedReplayBuffer,
    SumTree,
    draw_faded_ages,
    end_trajectory,
)

OBS = spaces.Box(-1e6, 1e6, (2,), np.float32)
ACT = spaces.Box(-1, 1, (1,), np.float32)
DICT_OBS = spaces.Dict({"a": spaces.Box(-1e6, 1e6, (2,), np.float32), "b": spaces.Box(-1e6, 1e6, (1,), np.float32)})


STARTS = partial(FadingReplayBuffer, start_share=0.2, start_steps=3)


def fill(buffer, n_steps, dones=None, timeouts=None):
    """Store transitions whose observation is (step, environment) and whose reward tells both."""
    n_envs = buffer.n_envs
    for step in range(n_steps):
        obs = np.stack([np.full(n_envs, step), np.arange(n_envs)], axis=1).astype(np.float32)
        next_obs = obs + np.array([0.5, 0], dtype=np.float32)
        if isinstance(buffer, DictReplayBuffer):
            obs, next_obs = {"a": obs, "b": obs[:, :1]}, {"a": next_obs, "b": next_obs[:, :1]}
        done = np.zeros(n_envs) if dones is None else dones[step]
        infos = [{"TimeLimit.truncated": bool(timeouts[step, e]) if timeouts is not None else False} for e in range(n_envs)]
        buffer.add(obs, next_obs, np.full((n_envs, 1), 0.1), step + 100.0 * np.arange(n_envs), done, infos)


def chi_square(counts, probabilities):
    """p-value of the counts; impossible outcomes must not occur at all."""
    counts, probabilities = np.ravel(counts), np.ravel(probabilities)
    assert np.all(counts[probabilities == 0] == 0)
    possible = probabilities > 0
    expected = probabilities[possible] / probabilities.sum() * counts.sum()
    return chisquare(counts[possible], expected).pvalue


# Fading: weights ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("size", "factor", "expected"),
    [
        (5, 7.0, [0, 0.0889709, 0.2632788, 0.3218201, 0.3259303]),
        (5, 3.0, [0, 0.0515487, 0.1926131, 0.3423703, 0.4134680]),
        (2, 7.0, [0, 1]),
        (1, 7.0, [1]),
        (4, None, [0.25] * 4),
        (4, float("inf"), [0.25] * 4),
    ],
)
def test_fade_weights(size, factor, expected):
    np.testing.assert_allclose(fade_weights(size, factor), expected, atol=5e-8)


def test_fade_weights_large():
    cumulative = np.cumsum(fade_weights(1_000_000))
    marks = [0.1, 0.25, 0.5, 0.75, 0.9]
    expected = [0.00327, 0.04977, 0.30451, 0.64965, 0.85984]
    np.testing.assert_allclose([cumulative[int(1_000_000 * x)] for x in marks], expected, atol=1e-5)


@pytest.mark.parametrize(
    ("factor", "mean_weight", "newest", "newest_tenth"),
    [
        (1, 0.295102, 2.581, 0.2429),
        (7, 0.713455, 1.402, 0.1402),
        (14, 0.797382, 1.254, 0.1254),
        (100, 0.924187, 1.082, 0.1082),
    ],
)
def test_fade_weights_normaliser(factor, mean_weight, newest, newest_tenth):
    n = 1_000_000
    weights = fade_weights(n, factor)
    assert np.tanh(factor) / (n * weights[-1]) == pytest.approx(mean_weight, abs=3e-6)
    assert n * weights[-1] == pytest.approx(newest, abs=6e-4)
    assert weights[-n // 10 :].sum() == pytest.approx(newest_tenth, abs=6e-5)


def test_fade_weights_power():
    x = np.arange(50) / 50
    expected = np.tanh(4 * x**5.5)
    np.testing.assert_allclose(fade_weights(50, 4.0, 5.5), expected / expected.sum())


@pytest.mark.parametrize("factor", [0, -1.0, float("nan"), -float("inf"), 10**400])
def test_fade_factor_refused(factor):
    with pytest.raises(ValueError, match=rf"fade_factor={factor!r}: .* or None \(or inf\) for uniform"):
        FadingReplayBuffer(5, OBS, ACT, fade_factor=factor)


@pytest.mark.parametrize("factor", [True, "7", 1j])
def test_fade_factor_that_is_no_number(factor):
    with pytest.raises(TypeError, match=r"fade_factor=.*: expected a number > 0, or None"):
        FadingReplayBuffer(5, OBS, ACT, fade_factor=factor)


@pytest.mark.parametrize("power", [0, -2.0, 100.5, float("nan"), float("inf")])
def test_fade_power_refused(power):
    with pytest.raises(ValueError, match="fade_power="):
        FadingDictReplayBuffer(5, DICT_OBS, ACT, fade_power=power)


# Fading: draws --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("size", "factor", "power"),
    [(1, 7.0, 2.0), (2, 7.0, 2.0), (3, 0.01, 2.0), (5, 7.0, 2.0), (40, 3.0, 1.0), (40, 20.0, 12.0), (1000, 7.0, 2.0)],
)
def test_draws_follow_direct_formula(size, factor, power):
    np.random.seed(0)
    counts = np.bincount(draw_faded_ages(size, 200_000, factor, power), minlength=size)
    assert counts.sum() == 200_000
    if size == 2:
        assert counts.tolist() == [0, 200_000]
    elif size > 2:
        assert chi_square(counts, fade_weights(size, factor, power)) > 1e-3


def test_draws_need_few_trials(monkeypatch):
    """The cost of a draw does not depend on the buffer's size: 1 / 0.713455 trials each at f = 7."""
    tried = []
    random = np.random.random
    monkeypatch.setattr(np.random, "random", lambda n: tried.append(n) or random(n))
    for size in (1_000, 1_000_000_000):
        tried.clear()
        np.random.seed(1)
        draw_faded_ages(size, 100_000, 7.0)
        assert 100_000 / 0.713455 < sum(tried) < 1.06 * 100_000 / 0.713455 + 100


@pytest.mark.parametrize("dictionary", [False, True])
@pytest.mark.parametrize("n_envs", [1, 3])
@pytest.mark.parametrize("stored", [7, 20, 27, 53])
def test_fading_buffer_draws(dictionary, n_envs, stored):
    rows = 20
    if dictionary:
        buffer = FadingDictReplayBuffer(rows * n_envs, DICT_OBS, ACT, n_envs=n_envs)
    else:
        buffer = FadingReplayBuffer(rows * n_envs, OBS, ACT, n_envs=n_envs)
    fill(buffer, stored)
    np.random.seed(stored + n_envs)
    samples = buffer.sample(60_000)
    obs = (samples.observations["a"] if dictionary else samples.observations).numpy()
    n = min(stored, rows)
    oldest = stored - n
    counts = np.zeros((n, n_envs))
    np.add.at(counts, ((obs[:, 0] - oldest).astype(int), obs[:, 1].astype(int)), 1)
    expected = np.repeat(fade_weights(n)[:, None], n_envs, axis=1) / n_envs
    assert chi_square(counts, expected) > 1e-3
    np.testing.assert_array_equal(samples.rewards.numpy()[:, 0], obs[:, 0] + 100 * obs[:, 1])


def test_full_ring_of_five():
    buffer = FadingReplayBuffer(5, OBS, ACT)
    fill(buffer, 7)
    assert buffer.full and buffer.pos == 2
    np.random.seed(0)
    steps = buffer.sample(200_000).observations[:, 0].numpy().astype(int)
    slots = np.bincount(steps % 5, minlength=5)
    assert chi_square(slots, np.array([0.3218201, 0.3259303, 0, 0.0889709, 0.2632788])) > 1e-3


def test_uniform_equals_sb3_draw_for_draw():
    stock = ReplayBuffer(60, OBS, ACT, n_envs=3)
    ours = FadingReplayBuffer(60, OBS, ACT, n_envs=3, fade_factor=None)
    faded = FadingReplayBuffer(60, OBS, ACT, n_envs=3)
    stock_n = NStepReplayBuffer(60, OBS, ACT, n_envs=3, n_steps=3, gamma=0.9)
    faded_n = FadingReplayBuffer(60, OBS, ACT, n_envs=3, n_steps=3, gamma=0.9)
    batches = []
    for buffer, kwargs in ((stock, {}), (ours, {}), (faded, dict(uniform=True)), (stock_n, {}), (faded_n, dict(uniform=True))):
        fill(buffer, 33)
        np.random.seed(4)
        batches.append(buffer.sample(128, **kwargs))
    for first, second in ((0, 1), (0, 2), (3, 4)):
        for field, other in zip(batches[first], batches[second], strict=True):
            assert (field is None and other is None) or th.equal(field, other)
    assert batches[0].discounts is None and batches[4].discounts is not None


@pytest.mark.parametrize("fade_factor", [7.0, None])
@pytest.mark.parametrize("n_envs", [1, 3])
@pytest.mark.parametrize("stored", [3, 20, 29, 53])
def test_share_of_episodes_first_steps(stored, n_envs, fade_factor):
    """Each draw comes with probability ½ from the first two steps of episodes, which fade by their own order."""
    rows, share, start_steps = 20, 0.5, 2
    dones = np.random.default_rng(stored).random((stored, n_envs)) < 0.2
    buffer = FadingReplayBuffer(
        rows * n_envs, OBS, ACT, n_envs=n_envs, fade_factor=fade_factor, start_share=share, start_steps=start_steps
    )
    fill(buffer, stored, dones.astype(float))

    first = max(stored - rows, 0)  # the oldest step still there
    expected = np.repeat(fade_weights(stored - first, fade_factor)[:, None], n_envs, axis=1) / n_envs
    starts = []  # (step, environment), oldest first
    for step in range(first, stored):
        for env in range(n_envs):
            if any(done == -1 or dones[done, env] for done in range(step - start_steps, step) if done >= -1):
                starts.append((step, env))
    expected *= 1 - share
    for (step, env), weight in zip(starts, fade_weights(len(starts), fade_factor), strict=True):
        expected[step - first, env] += share * weight

    np.random.seed(stored + n_envs)
    obs = buffer.sample(60_000).observations.numpy()
    counts = np.zeros_like(expected)
    np.add.at(counts, ((obs[:, 0] - first).astype(int), obs[:, 1].astype(int)), 1)
    assert chi_square(counts, expected) > 1e-3

    steps = buffer.sample(60_000, uniform=True).observations[:, 0].numpy().astype(int) - first
    assert chi_square(np.bincount(steps), np.ones(stored - first)) > 1e-3


def test_first_steps_that_are_all_overwritten():
    buffer = FadingReplayBuffer(5, OBS, ACT, start_share=1.0, start_steps=3)
    fill(buffer, 5)
    assert set(buffer.sample(100).observations[:, 0].tolist()) == {1, 2}  # the oldest never
    fill(buffer, 4)  # overwritten in the same episode
    assert set(buffer.sample(200).observations[:, 0].tolist()) == {0, 1, 2, 3}


def test_an_ended_trajectory_is_followed_by_first_steps():
    buffer = FadingReplayBuffer(100, OBS, ACT, start_share=1.0, start_steps=2)
    fill(buffer, 10)
    end_trajectory(buffer)
    fill(buffer, 10)
    assert set(buffer.sample(200).observations[:, 0].tolist()) == {0, 1}  # 0 is of the second: the oldest is never drawn


@pytest.mark.parametrize("buffer_class", [ReplayBuffer, FadingReplayBuffer, PrioritizedReplayBuffer])
def test_an_ended_trajectory_of_single_steps_bootstraps(buffer_class):
    buffer = buffer_class(100, OBS, ACT, handle_timeout_termination=False)
    fill(buffer, 10)
    end_trajectory(buffer)
    assert not buffer._get_samples(np.arange(10)).dones.any()


def test_a_longer_horizon_later_knows_where_a_trajectory_ended():
    buffer = FadingReplayBuffer(100, OBS, ACT, n_steps=1, gamma=0.5)
    fill(buffer, 10)
    end_trajectory(buffer)
    fill(buffer, 3)
    buffer.n_steps = 3
    np.testing.assert_allclose(buffer._get_samples(np.arange(10)).discounts.flatten(), [0.125] * 8 + [0.25, 0.5])


@pytest.mark.parametrize("buffer_class", [FadingReplayBuffer, NStepReplayBuffer])
def test_an_ended_trajectory_bootstraps_whatever_timeouts_mean(buffer_class):
    buffer = buffer_class(100, OBS, ACT, n_steps=3, gamma=0.5, handle_timeout_termination=False)
    fill(buffer, 10)
    end_trajectory(buffer)
    fill(buffer, 3)
    samples = buffer._get_samples(np.arange(10))
    assert not samples.dones.any()
    np.testing.assert_allclose(samples.discounts.flatten(), [0.125] * 8 + [0.25, 0.5])


def test_an_overwritten_row_is_no_end_of_a_trajectory_any_more():
    """SB3's algorithms, and buffers used by hand, write no timeouts here."""
    buffer = FadingReplayBuffer(4, OBS, ACT, handle_timeout_termination=False)
    fill(buffer, 2)
    end_trajectory(buffer)
    fill(buffer, 4, np.array([[0.0]] * 3 + [[1.0]]))
    assert buffer._get_samples(np.arange(4)).dones.flatten().tolist() == [0, 1, 0, 0]


@pytest.mark.parametrize("done, timeout", [(0, 0), (1, 0), (1, 1)])
def test_an_ended_trajectory_stays_terminated_if_it_was(done, timeout):
    buffer = NStepReplayBuffer(20, OBS, ACT, n_steps=3, gamma=0.5)
    fill(buffer, 10, np.array([[0.0]] * 9 + [[done]]), np.array([[0.0]] * 9 + [[timeout]]))
    end_trajectory(buffer)
    fill(buffer, 3)
    samples = buffer._get_samples(np.array([8]))
    rewards = buffer.rewards[8:10, 0]
    assert samples.rewards.item() == rewards[0] + 0.5 * rewards[1] and samples.discounts.item() == 0.25
    assert samples.dones.item() == (done and not timeout)


def test_samples_are_copies():
    for buffer in (FadingReplayBuffer(10, OBS, ACT), FadingReplayBuffer(10, OBS, ACT, n_steps=2)):
        fill(buffer, 8)
        stored = copy.deepcopy(buffer)
        for field in buffer.sample(50):
            if field is not None:
                field.fill_(-7)
        for name in ("observations", "next_observations", "actions", "rewards", "dones"):
            np.testing.assert_array_equal(getattr(buffer, name), getattr(stored, name))


def n_step_by_hand(dones, timeouts, first, last, step, env, n_steps, gamma):
    """Walk forward one step at a time until an end, the horizon or the newest transition."""
    total, discount = 0.0, 1.0
    for current in range(step, min(step + n_steps - 1, last) + 1):
        total += discount * (current + 100.0 * env)
        discount *= gamma
        if dones[current, env]:
            break
    bootstraps = not (dones[current, env] and not timeouts[current, env])
    return total, discount, current + 0.5, 0.0 if bootstraps else 1.0


@pytest.mark.parametrize("buffer_class", [FadingReplayBuffer, STARTS, PrioritizedReplayBuffer])
@pytest.mark.parametrize("n_envs", [1, 2])
@pytest.mark.parametrize("stored", [13, 24, 41])
def test_n_step_returns(buffer_class, n_envs, stored):
    rows, n_steps, gamma = 24, 4, 0.9
    generator = np.random.default_rng(stored)
    dones = generator.random((stored, n_envs)) < 0.2
    timeouts = dones & (generator.random((stored, n_envs)) < 0.5)
    buffer = buffer_class(rows * n_envs, OBS, ACT, n_envs=n_envs, n_steps=n_steps, gamma=gamma)
    fill(buffer, stored, dones.astype(float), timeouts)
    np.random.seed(0)
    batch = buffer.sample(3000)
    obs = batch.observations.numpy()
    assert len(np.unique(obs, axis=0)) >= (min(stored, rows) - 2) * n_envs  # nearly everything was checked
    first = max(stored - rows, 0)
    for i in range(3000):
        step, env = int(obs[i, 0]), int(obs[i, 1])
        total, discount, next_step, done = n_step_by_hand(dones, timeouts, first, stored - 1, step, env, n_steps, gamma)
        assert batch.rewards[i, 0].item() == pytest.approx(total, rel=1e-5)
        assert batch.discounts[i, 0].item() == pytest.approx(discount, rel=1e-6)
        assert batch.next_observations[i].tolist() == [next_step, env]
        assert batch.dones[i, 0].item() == done


def test_dict_fields_and_refusals():
    buffer = FadingDictReplayBuffer(10, DICT_OBS, ACT)
    fill(buffer, 14)
    batch = buffer.sample(64)
    assert batch.observations["b"].shape == (64, 1) and batch.discounts is None
    th.testing.assert_close(batch.next_observations["a"][:, 0], batch.observations["b"][:, 0] + 0.5)
    with pytest.raises(ValueError, match="n_steps=3"):
        FadingDictReplayBuffer(10, DICT_OBS, ACT, n_steps=3)
    for buffer_class in (FadingReplayBuffer, PrioritizedReplayBuffer):
        with pytest.raises(ValueError, match="FadingDictReplayBuffer"):
            buffer_class(10, DICT_OBS, ACT)


@pytest.mark.parametrize("buffer_class", [FadingReplayBuffer, FadingDictReplayBuffer, PrioritizedReplayBuffer])
def test_common_refusals(buffer_class):
    space = DICT_OBS if buffer_class is FadingDictReplayBuffer else OBS
    with pytest.raises(ValueError, match=f"{buffer_class.__name__} does not support optimize_memory_usage=True"):
        buffer_class(10, space, ACT, optimize_memory_usage=True, handle_timeout_termination=False)
    with pytest.raises(ValueError, match="no transition is stored yet"):
        buffer_class(10, space, ACT).sample(4)
    if space is OBS:
        for n_steps in (0, 1.5, True):
            with pytest.raises(ValueError if n_steps == 0 else TypeError, match=f"n_steps={n_steps!r}"):
                buffer_class(10, space, ACT, n_steps=n_steps)
        with pytest.raises(ValueError, match=r"gamma=1\.5"):
            buffer_class(10, space, ACT, gamma=1.5)


@pytest.mark.parametrize("n_steps", [1, 3])
@pytest.mark.parametrize("buffer_class", [FadingReplayBuffer, PrioritizedReplayBuffer])
def test_vec_normalize(buffer_class, n_steps):
    env = VecNormalize(make_vec_env("Pendulum-v1", n_envs=1))
    env.reset()
    for _ in range(50):
        env.step(np.array([[1.0]]))
    buffer = buffer_class(20, env.observation_space, env.action_space, n_steps=n_steps)
    for _ in range(20):
        obs = np.random.randn(1, 3)
        buffer.add(obs, obs, np.zeros((1, 1)), np.array([-5.0]), np.array([1.0]), [{}])
    np.random.seed(0)
    raw = buffer.sample(16)
    np.random.seed(0)
    normalised = buffer.sample(16, env=env)
    np.testing.assert_allclose(normalised.observations, env.normalize_obs(raw.observations.numpy()), rtol=1e-5)
    np.testing.assert_allclose(normalised.rewards, env.normalize_reward(raw.rewards.numpy()), rtol=1e-5)


# Under SB3's algorithms -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("algorithm", "n_envs", "kwargs"), [(TD3, 1, {}), (SAC, 2, dict(n_steps=3, gamma=0.98)), (DDPG, 1, dict(fade_factor=3.0))]
)
def test_fading_under_sb3(algorithm, n_envs, kwargs):
    def learn():
        env = make_vec_env("Pendulum-v1", n_envs=n_envs, seed=3)
        model = algorithm(
            "MlpPolicy",
            env,
            replay_buffer_class=FadingReplayBuffer,
            replay_buffer_kwargs=kwargs,
            buffer_size=150,
            learning_starts=60,
            batch_size=32,
            policy_kwargs=dict(net_arch=[16]),
            seed=5,
            device="cpu",
        )
        before = copy.deepcopy(model.policy.state_dict())
        model.learn(240)
        return before, model

    before, model = learn()
    _, again = learn()
    after = model.policy.state_dict()
    assert model._n_updates > 0 and model.replay_buffer.full
    assert all(th.isfinite(value).all() for value in after.values())
    assert all(not th.equal(before[name], after[name]) for name in before if name.endswith("weight"))
    assert all(th.equal(after[name], value) for name, value in again.policy.state_dict().items())


def test_fading_dict_under_sb3():
    model = TD3(
        "MultiInputPolicy",
        SimpleMultiObsEnv(discrete_actions=False),
        replay_buffer_class=FadingDictReplayBuffer,
        buffer_size=100,
        learning_starts=30,
        batch_size=8,
        policy_kwargs=dict(net_arch=[8], features_extractor_kwargs=dict(cnn_output_dim=8)),
        seed=0,
        device="cpu",
    ).learn(40)
    assert model._n_updates > 0


def test_save_and_load_replay_buffer(tmp_path):
    model = TD3("MlpPolicy", "Pendulum-v1", replay_buffer_class=FadingReplayBuffer, buffer_size=100, seed=0, device="cpu")
    model.learn(90)
    model.save_replay_buffer(tmp_path / "buffer")
    np.random.seed(0)
    expected = model.replay_buffer.sample(16)
    model.save(tmp_path / "model")
    loaded = TD3.load(tmp_path / "model", env=model.get_env(), device="cpu")
    loaded.load_replay_buffer(tmp_path / "buffer")
    np.random.seed(0)
    for field, other in zip(expected, loaded.replay_buffer.sample(16), strict=True):
        assert (field is None and other is None) or th.equal(field, other)
    loaded.learn(50, reset_num_timesteps=False)


# Prioritised replay ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("n_leaves", [1, 2, 5, 64, 1000])
def test_sum_tree_equals_cumsum(n_leaves):
    generator = np.random.default_rng(n_leaves)
    tree, values = SumTree(n_leaves), np.zeros(n_leaves)
    for _ in range(30):
        leaves = generator.integers(0, n_leaves, size=generator.integers(1, 12))
        new = generator.integers(0, 8, size=len(leaves)).astype(float)  # integers: sums are exact; some are zero
        tree.set(leaves, new)
        for leaf, value in zip(leaves, new, strict=True):
            values[leaf] = value  # the last value of a repeated leaf counts
        assert tree.total == values.sum()
        np.testing.assert_array_equal(tree.get(np.arange(n_leaves)), values)
        if tree.total > 0:
            masses = generator.random(200) * tree.total
            found = tree.find(masses)
            np.testing.assert_array_equal(found, np.searchsorted(np.cumsum(values), masses, side="right"))
            assert np.all(values[found] > 0)
            assert values[tree.find(np.array([tree.total * (1 + 1e-12)]))[0]] > 0  # beyond the end by rounding


@pytest.mark.parametrize(("n_envs", "stored"), [(1, 9), (1, 50), (3, 9), (3, 31)])
def test_prioritised_draws(n_envs, stored):
    rows, alpha, beta = 20, 0.7, 0.5
    buffer = PrioritizedReplayBuffer(rows * n_envs, OBS, ACT, n_envs=n_envs, alpha=alpha, beta=beta)
    fill(buffer, stored)
    n = min(stored, rows) * n_envs
    generator = np.random.default_rng(0)
    errors = generator.normal(size=n) * 3
    buffer.update_priorities(np.arange(n), th.as_tensor(errors).reshape(-1, 1))
    exact = (np.abs(errors) + 1e-6) ** alpha
    exact /= exact.sum()
    np.random.seed(1)
    batch = buffer.sample(100_000)
    counts = np.bincount(batch.indices, minlength=n)
    assert chi_square(counts, exact) > 1e-3
    # The batch holds the transitions that the indices name, in the drawn order
    row, env = np.divmod(batch.indices, n_envs)
    np.testing.assert_array_equal(batch.observations.numpy(), buffer.observations[row, env])
    np.testing.assert_array_equal(batch.rewards.numpy()[:, 0], buffer.rewards[row, env])
    weights = (n * exact[batch.indices]) ** -beta
    np.testing.assert_allclose(batch.weights.numpy()[:, 0], weights / weights.max(), rtol=1e-5)
    assert batch.weights.shape == (100_000, 1) and batch.weights.dtype == th.float32 and batch.discounts is None
    assert batch._fields[:6] == ("observations", "actions", "next_observations", "dones", "rewards", "discounts")


def test_prioritised_new_transitions_get_the_maximum():
    buffer = PrioritizedReplayBuffer(4, OBS, ACT, alpha=0.5)
    fill(buffer, 3)
    np.testing.assert_allclose(buffer.tree.get(np.arange(4)), [1, 1, 1, 0])
    buffer.update_priorities([0, 1, 1], [-16.0, 5.0, 0.25])
    np.testing.assert_allclose(buffer.tree.get(np.arange(4)), [4, 0.5, 1, 0], rtol=1e-5)
    fill(buffer, 2)  # fills the ring and overwrites the oldest transition
    np.testing.assert_allclose(buffer.tree.get(np.arange(4)), [4, 0.5, 1, 4], rtol=1e-5)
    buffer.reset()
    assert buffer.tree.total == 0 and buffer.max_priority == 1


def test_prioritised_alpha_zero_is_uniform():
    buffer = PrioritizedReplayBuffer(10, OBS, ACT, alpha=0.0)
    fill(buffer, 10)
    buffer.update_priorities(np.arange(10), np.arange(10.0))
    np.random.seed(0)
    batch = buffer.sample(20_000)
    assert chi_square(np.bincount(batch.indices), np.full(10, 0.1)) > 1e-3
    assert th.all(batch.weights == 1)


@pytest.mark.parametrize("alpha, error", [(60, 0.0), (2, 1e200)])
def test_priorities_whose_powers_cannot_be_told(alpha, error):
    buffer = PrioritizedReplayBuffer(10, OBS, ACT, alpha=alpha)
    fill(buffer, 5)
    with pytest.raises(ValueError, match=f"alpha={alpha}: expected less"):
        buffer.update_priorities([0, 1], [1.0, error])
    assert buffer.tree.total == 5


def test_prioritised_refusals():
    buffer = PrioritizedReplayBuffer(10, OBS, ACT)
    fill(buffer, 5)
    for indices, errors, message in (
        ([0, 1], [1.0], "2 indices but 1 td_errors"),
        ([0], [float("nan")], "not finite"),
        ([5], [1.0], r"\[0, 5\)"),
        ([-1], [1.0], r"\[0, 5\)"),
    ):
        with pytest.raises(ValueError, match=message):
            buffer.update_priorities(indices, errors)
    for kwargs in (dict(alpha=-0.1), dict(beta=float("inf")), dict(eps=0.0)):
        with pytest.raises(ValueError, match=next(iter(kwargs)) + "="):
            PrioritizedReplayBuffer(10, OBS, ACT, **kwargs)
    for _ in range(30):  # updated after each draw: never refused
        batch = buffer.sample(4)
        buffer.update_priorities(batch.indices, np.ones(4))


def test_prioritised_refused_under_sb3():
    model = TD3("MlpPolicy", "Pendulum-v1", replay_buffer_class=PrioritizedReplayBuffer, learning_starts=5, device="cpu")
    with pytest.raises(RuntimeError, match="does not support prioritised replay"):
        model.learn(50)


@pytest.mark.parametrize("buffer_class", [FadingReplayBuffer, FadingDictReplayBuffer, PrioritizedReplayBuffer])
def test_pickle_and_seed(buffer_class):
    buffer = buffer_class(30, DICT_OBS if buffer_class is FadingDictReplayBuffer else OBS, ACT, n_envs=2)
    fill(buffer, 22)
    if buffer_class is PrioritizedReplayBuffer:
        buffer.update_priorities(np.arange(30), np.arange(30.0))
    batches = []
    for source in (buffer, buffer, pickle.loads(pickle.dumps(buffer))):
        np.random.seed(11)
        batches.append(source.sample(64).rewards)
    assert th.equal(batches[0], batches[1]) and th.equal(batches[0], batches[2])
    assert not th.equal(batches[0], buffer.sample(64).rewards)
