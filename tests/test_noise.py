import copy
import pickle
import re

import numpy as np
import pytest
from stable_baselines3 import DDPG, SAC, TD3
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.noise import ActionNoise, VectorizedActionNoise

from sb3_symphony.common.noise import (
    DecayingNormalActionNoise,
    DisturbanceActionNoise,
    PinkActionNoise,
    StickyActionNoise,
)

ALL = [DecayingNormalActionNoise, StickyActionNoise, PinkActionNoise, DisturbanceActionNoise]


def series(noise, n_steps):
    return np.array([noise() for _ in range(n_steps)])


# Decay ----------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("sigma", "expected"),
    [(0.3, [0.30, 0.256066, 0.150000, 0.043933, 0]), (2.0, [2, 1.707107, 1.0, 0.292893, 0])],
)
def test_cosine_decay_of_the_reference(sigma, expected):
    noise = DecayingNormalActionNoise(4, sigma=sigma)
    for t, value in zip((0, 26_180, 52_360, 78_540, 104_720), expected, strict=True):
        noise.t = t
        assert noise.sigma_t == pytest.approx(value, abs=1e-6)
    noise.t = 1_000_000
    assert noise.sigma_t == 0 and not np.any(noise())


@pytest.mark.parametrize(
    ("decay", "expected"),
    [
        ("cosine", [0.5, 0.1 + 0.2 * (1 + np.sqrt(0.5)), 0.3, 0.1, 0.1]),
        ("linear", [0.5, 0.4, 0.3, 0.1, 0.1]),
        ("tanh", [0.5] + [0.1 + 0.4 * (1 - np.tanh(x)) for x in (0.25, 0.5, 1, 3)]),
        ("constant", [0.5] * 5),
    ],
)
def test_decay_to_a_final_value(decay, expected):
    noise = StickyActionNoise(1, sigma=0.5, sigma_final=0.1, decay_steps=200, decay=decay)
    for t, value in zip((0, 50, 100, 200, 600), expected, strict=True):
        noise.t = t
        assert noise.sigma_t == pytest.approx(value)


@pytest.mark.parametrize(
    "noise",
    [
        DecayingNormalActionNoise(4, sigma=0.3, decay="constant", clip=None),
        PinkActionNoise(4, sigma=0.3, decay="constant", block_steps=20),
        StickyActionNoise(4, sigma=0.3, decay="constant", hold=3),
        StickyActionNoise(4, sigma=0.3, decay="constant", episode_scale=(0, 1.5), independent=0.2),
        StickyActionNoise(4, sigma=0.3, sigma_final=0.03, decay_steps=1, episode_scale=(0.5, 1), independent=(0.1, 0.4, 0, 1)),
    ],
    ids=str,
)
def test_standard_deviation_that_is_told(noise):
    np.random.seed(0)
    drawn = []
    for _ in range(1500):  # episodes
        noise.reset()
        drawn += [noise() for _ in range(20)]
    assert np.std(drawn[20:]) == pytest.approx(noise.std, rel=0.03)


def test_standard_deviation_that_is_not_known():
    assert np.isnan(DisturbanceActionNoise(2).std)


@pytest.mark.parametrize("noise_class", ALL)
def test_calls_count_and_reset_does_not(noise_class):
    np.random.seed(0)
    noise = noise_class(3, decay_steps=100)
    assert isinstance(noise, ActionNoise)
    draws = series(noise, 10)
    assert draws.shape == (10, 3) and draws.dtype == np.float32
    assert noise.t == 10
    size = noise.sigma_t
    noise.reset()
    assert noise.t == 10 and noise.sigma_t == size < noise_class(3).sigma
    noise.n_envs = 4
    noise()
    assert noise.t == 14


@pytest.mark.parametrize("noise_class", ALL)
def test_parallel_environments(noise_class):
    np.random.seed(0)
    vectorised = VectorizedActionNoise(noise_class(2, n_envs=3), 3)
    draws = np.array([vectorised() for _ in range(5)])
    assert draws.shape == (5, 3, 2)
    assert [noise.t for noise in vectorised.noises] == [15, 15, 15]
    assert not np.any(draws[1, 0] == draws[1, 1])  # independent copies
    vectorised.reset([1])
    assert vectorised.noises[1].t == 15


@pytest.mark.parametrize("noise_class", ALL)
def test_seed_and_pickle(noise_class):
    np.random.seed(3)
    noise = noise_class(2)
    series(noise, 7)
    copies = [pickle.loads(pickle.dumps(noise)), copy.deepcopy(noise), noise]
    draws = []
    for one in copies:
        np.random.seed(9)
        draws.append(series(one, 20))
    np.testing.assert_array_equal(draws[0], draws[1])
    np.testing.assert_array_equal(draws[0], draws[2])
    assert all(one.t == 27 for one in copies)
    assert noise_class.__name__ in repr(noise) and "t=27" in repr(noise)


# Gaussian -------------------------------------------------------------------------------------------------------------


def test_normal_clip_and_standard_deviation():
    np.random.seed(0)
    draws = series(DecayingNormalActionNoise(2, sigma=0.3, decay="constant"), 50_000)
    assert np.abs(draws).max() == pytest.approx(0.75)
    assert draws.std() == pytest.approx(0.3 * np.sqrt(0.9555), rel=0.01)  # variance of a normal clipped at 2.5
    assert abs(np.corrcoef(draws[1:, 0], draws[:-1, 0])[0, 1]) < 0.02
    assert abs(np.corrcoef(draws.T)[0, 1]) < 0.02
    np.random.seed(0)
    free = series(DecayingNormalActionNoise(2, sigma=0.3, decay="constant", clip=None), 50_000)
    assert free.std() == pytest.approx(0.3, rel=0.01) and np.abs(free).max() > 0.75
    np.testing.assert_array_equal(np.clip(free, -np.float32(0.75), np.float32(0.75)), draws)


def test_normal_scales_with_sigma_t():
    np.random.seed(1)
    unit = series(DecayingNormalActionNoise(2, sigma=1.0, decay="constant"), 100)
    np.random.seed(1)
    noise = DecayingNormalActionNoise(2, sigma=0.3, decay_steps=100, n_envs=1)
    sigma = 0.15 * (1 + np.cos(np.pi * np.arange(100) / 100))
    np.testing.assert_allclose(series(noise, 100), unit * sigma[:, None], rtol=1e-5, atol=1e-8)


# Sticky ---------------------------------------------------------------------------------------------------------------


def test_sticky_is_a_stationary_first_order_process():
    np.random.seed(2)
    noise = StickyActionNoise(4, sigma=0.5, decay="constant", correlation=0.8)
    draws = series(noise, 40_000)
    assert draws.std() == pytest.approx(0.5, rel=0.03)
    for lag in (1, 2, 5):
        correlation = np.mean([np.corrcoef(draws[lag:, j], draws[:-lag, j])[0, 1] for j in range(4)])
        assert correlation == pytest.approx(0.8**lag, abs=0.02)
    firsts = []
    for _ in range(3000):  # the first draw of an episode has the same spread, and forgets the last episode
        noise.reset()
        firsts.append(noise())
    assert np.std(firsts) == pytest.approx(0.5, rel=0.03)
    assert abs(np.corrcoef(np.array(firsts)[1:, 0], np.array(firsts)[:-1, 0])[0, 1]) < 0.06


def test_sticky_equals_the_recursion():
    np.random.seed(4)
    draws = series(StickyActionNoise(2, sigma=0.3, decay="linear", decay_steps=50, correlation=0.6), 20)
    np.random.seed(4)
    x = np.random.standard_normal(2)
    for t in range(20):
        np.testing.assert_allclose(draws[t], 0.3 * (1 - t / 50) * x, rtol=1e-6)
        x = 0.6 * x + 0.8 * np.random.standard_normal(2)


def test_sticky_holds():
    np.random.seed(0)
    noise = StickyActionNoise(2, decay="constant", correlation=0.5, hold=4)
    draws = series(noise, 12).reshape(3, 4, 2)
    assert np.all(draws == draws[:, :1]) and len(np.unique(draws[:, 0, 0])) == 3
    noise()
    noise.reset()
    draws = series(noise, 5)
    assert np.all(draws[:4] == draws[0]) and np.all(draws[4] != draws[0])


def test_independent_noise_on_top():
    """It is there in quiet episodes too, and two steps of the same draw differ by it alone."""
    np.random.seed(0)
    noise = StickyActionNoise(2, sigma=0.5, decay="constant", hold=2, episode_scale=(0.0, 0.0), independent=0.3)
    quiet = series(noise, 4000)
    assert quiet.std() == pytest.approx(0.3, rel=0.05)
    assert abs(np.corrcoef(quiet[:-1, 0], quiet[1:, 0])[0, 1]) < 0.05
    both = series(StickyActionNoise(2, sigma=0.5, decay="constant", hold=2, independent=0.3), 4000)
    assert both.std() == pytest.approx(np.hypot(0.5, 0.3), rel=0.1)
    assert (both[1::2] - both[::2]).std() == pytest.approx(0.3 * np.sqrt(2), rel=0.05)


def test_independent_noise_moves():
    np.random.seed(0)
    noise = StickyActionNoise(50, sigma=0.5, episode_scale=(0.0, 0.0), independent=(0.4, 0.1, 1000, 2000))
    draws = series(noise, 3000)
    assert draws[:1000].std() == pytest.approx(0.4, rel=0.02)
    for t in (1000, 1500, 1900):
        sigma = 0.4 - 0.3 * (t + 50 - 1000) / 1000
        assert draws[t : t + 100].std() == pytest.approx(sigma, rel=0.05)
    assert draws[2000:].std() == pytest.approx(0.1, rel=0.02)


def test_sticky_scale_of_each_episode():
    np.random.seed(6)
    noise = StickyActionNoise(2, sigma=0.4, decay="constant", episode_scale=(0.5, 1.5))
    factors = []
    for _ in range(4000):
        noise.reset()
        noise()
        factor = noise.factor
        np.testing.assert_allclose(noise(), 0.4 * factor * noise.x, rtol=1e-6)
        assert noise.factor == factor  # for the whole episode
        factors.append(factor)
    assert 0.5 <= min(factors) < 0.51 and 1.49 < max(factors) <= 1.5
    assert np.mean(factors) == pytest.approx(1, abs=0.02) and np.std(factors) == pytest.approx(1 / np.sqrt(12), rel=0.05)


# Pink -----------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("beta", [0.0, 1.0, 2.0])
@pytest.mark.parametrize("steps", [256, 255])
def test_pink_spectrum_and_standard_deviation(beta, steps):
    np.random.seed(5)
    noise = PinkActionNoise(20, sigma=0.4, decay="constant", beta=beta, block_steps=steps)
    blocks = []
    for _ in range(40):
        noise.reset()
        blocks.append(series(noise, steps))
    draws = np.array(blocks)  # (block, step, dimension)
    # Every step has the same standard deviation over blocks and dimensions
    assert np.sqrt(np.mean(draws.astype(float) ** 2)) == pytest.approx(0.4, rel=0.08)
    power = np.mean(np.abs(np.fft.rfft(draws, axis=1)) ** 2, axis=(0, 2))
    frequency = np.arange(1, steps // 2)
    slope = np.polyfit(np.log(frequency), np.log(power[1 : steps // 2]), 1)[0]
    assert slope == pytest.approx(-beta, abs=0.05)
    assert power[0] == pytest.approx(power[1], rel=0.25)  # the mean has the power of the slowest wave
    if steps % 2 == 0:  # and the fastest wave of an even length its own, not half or twice of it
        assert power[-1] == pytest.approx(power[-2], rel=0.25)


def test_pink_blocks_follow_each_other():
    np.random.seed(0)
    noise = PinkActionNoise(2, decay="constant", block_steps=8)
    draws = series(noise, 20)
    assert noise.used == 4 and len(np.unique(draws[:, 0])) == 20
    noise.reset()
    assert not np.any(series(noise, 8) == draws[:8])


# Disturbance ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("residual", [0.0, 0.07])
def test_disturbance_equals_the_formula(residual):
    np.random.seed(6)
    n_actions, clock, t = 4, 0.0, 0
    noise = DisturbanceActionNoise(n_actions, sigma=1 + residual, sigma_final=residual)
    for episode_steps in (120, 300):
        noise.reset()
        phases = noise.phases.copy()
        assert phases.shape == (3, n_actions) and phases.min() >= 0 and phases.max() <= n_actions
        d = np.zeros(n_actions)
        for _ in range(episode_steps):
            size = 1 - np.tanh(3.07e-5 * t) + residual
            for j in range(n_actions):
                omega = 2 + np.sin(clock + phases[1, j])
                height = 2 + np.sin(clock + phases[2, j])
                drive = size * np.sin(omega * clock + phases[0, j]) / height
                leak = size * d[j]
                bound = 2.5 * size
                d[j] = d[j] + min(max(drive, -bound), bound) - min(max(leak, -bound), bound)
            np.testing.assert_allclose(noise(), d, rtol=1e-5, atol=1e-6)
            clock += 0.1
            t += 1
    assert noise.t == 420 and noise.clock == pytest.approx(42.0)


def test_disturbance_is_smooth_at_first_only():
    """The documented figures: the author's wave speeds up with its clock, which no episode restarts."""

    def step_correlation(draws):
        return np.mean([np.corrcoef(draws[1:, j], draws[:-1, j])[0, 1] for j in range(draws.shape[1])])

    np.random.seed(7)
    noise = DisturbanceActionNoise(8, sigma=1.0, decay="constant")
    assert step_correlation(series(noise, 100)) > 0.7
    draws = series(noise, 20_000)[1000:]
    assert abs(step_correlation(draws)) < 0.05
    assert draws.std() == pytest.approx(0.44, abs=0.02)
    noise = DisturbanceActionNoise(8, sigma=0.3, decay="constant")
    draws = series(noise, 20_000)
    assert step_correlation(draws[1000:]) == pytest.approx(0.68, abs=0.05)
    noise.reset()
    assert np.abs(series(noise, 50) - draws[:50]).max() > 0.05  # another episode, another wave


# Validation and use ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("noise_class", ALL)
@pytest.mark.parametrize(
    "wrong",
    [
        dict(n_actions=0),
        dict(n_actions=1.5),
        dict(sigma=-0.1),
        dict(sigma=float("nan")),
        dict(sigma_final=float("inf")),
        dict(decay_steps=0),
        dict(decay_steps=float("inf")),
        dict(decay="exponential"),
        dict(n_envs=0),
    ],
)
def test_wrong_values(noise_class, wrong):
    ((name, value),) = wrong.items()
    with pytest.raises(TypeError if value == 1.5 else ValueError, match=f"{name}={value!r}: expected"):
        noise_class(**{"n_actions": 2, **wrong})


@pytest.mark.parametrize(
    ("noise_class", "name", "value"),
    [
        (DecayingNormalActionNoise, "clip", 0),
        (DecayingNormalActionNoise, "clip", float("nan")),
        (StickyActionNoise, "correlation", 1.0),
        (StickyActionNoise, "correlation", -0.5),
        (StickyActionNoise, "hold", 0),
        (StickyActionNoise, "independent", -0.1),
        (StickyActionNoise, "independent", (0.2, 0.1, 100)),
        (StickyActionNoise, "episode_scale", 1.5),
        (StickyActionNoise, "episode_scale", (1.5, 0.5)),
        (PinkActionNoise, "beta", -1.0),
        (PinkActionNoise, "block_steps", 1),
        (DisturbanceActionNoise, "sigma", 2.5),
    ],
)
def test_wrong_own_values(noise_class, name, value):
    with pytest.raises(ValueError, match=re.escape(f"{name}={value!r}: expected")):
        noise_class(2, **{name: value})


@pytest.mark.parametrize("noise_class", ALL)
@pytest.mark.parametrize(("algorithm", "n_envs"), [(TD3, 2), (DDPG, 1), (SAC, 1)])
def test_under_sb3(noise_class, algorithm, n_envs, tmp_path):
    noise = noise_class(1, decay_steps=100, n_envs=n_envs)
    env = make_vec_env("Pendulum-v1", n_envs=n_envs)
    model = algorithm(
        "MlpPolicy",
        env,
        action_noise=noise,
        learning_starts=20,
        batch_size=4,
        policy_kwargs=dict(net_arch=[4]),
        seed=0,
        device="cpu",
    )
    model.learn(40)

    def counts(trained):
        return [one.t for one in getattr(trained.action_noise, "noises", [trained.action_noise])]

    assert counts(model) == [40] * n_envs  # environment steps, warm-up included
    before = counts(model)
    model.predict(env.reset(), deterministic=True)
    assert counts(model) == before
    model.save(tmp_path / "model")
    loaded = algorithm.load(tmp_path / "model", env=env, device="cpu")
    assert counts(loaded) == before
    loaded.learn(10, reset_num_timesteps=False)
    assert counts(loaded) == [50] * n_envs
