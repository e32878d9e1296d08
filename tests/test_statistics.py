"""Statistics against hand-computed numbers, SciPy, and a slow bootstrap in plain Python."""

import math
import random

import numpy as np
import pytest
from scipy import stats

from sb3_symphony.analysis.runs import open_run
from sb3_symphony.analysis.statistics import (
    Event,
    Summary,
    bootstrap_interval,
    first_episode,
    first_stable_evaluation,
    iqm,
    iqm_event,
    median_event,
    run_events,
    summarise,
    unstable_episodes,
)


@pytest.mark.parametrize(
    "values, expected",
    [
        ([7], 7.0),
        ([1, 2, 9], 4.0),  # ⌊3/4⌋ = 0: nothing is cut
        ([100, 1, 3, -50], 2.0),
        ([0, 1, 2, 3, 4, 5, 6, 700], 3.5),
        ([10, 9, 8, 7, 6, 5, 4, 3, 2, 1000], 6.5),  # two of each end, the mean of 9…4
    ],
)
def test_iqm_by_hand(values, expected):
    assert iqm(values) == pytest.approx(expected)


@pytest.mark.parametrize("n", range(1, 14))
def test_iqm_is_rliables(n):
    values = np.random.default_rng(n).normal(size=(n, 3))
    assert iqm(values, axis=0) == pytest.approx(stats.trim_mean(values, 0.25, axis=0))
    assert iqm(values.T, axis=1) == pytest.approx(stats.trim_mean(values, 0.25, axis=0))
    assert iqm(values) == pytest.approx(stats.trim_mean(values, 0.25, axis=None))


def slow_interval(strata, repetitions, seed):
    """Stratified percentile bootstrap of the interquartile mean, written out with another generator."""
    rng = random.Random(seed)
    found = []
    for _ in range(repetitions):
        drawn = sorted(rng.choice(stratum) for stratum in strata for _ in stratum)
        cut = len(drawn) // 4
        middle = drawn[cut : len(drawn) - cut]
        found.append(sum(middle) / len(middle))
    found.sort()
    return found[round(0.025 * repetitions)], found[round(0.975 * repetitions) - 1]


@pytest.mark.parametrize("sizes", [(10,), (5, 8)])
def test_interval_equals_a_slow_bootstrap(sizes):
    rng = np.random.default_rng(0)
    strata = [rng.normal(loc=10 * i, size=n) for i, n in enumerate(sizes)]
    low, high = bootstrap_interval(strata, repetitions=20_000)
    assert (low, high) == pytest.approx(slow_interval([s.tolist() for s in strata], 20_000, seed=1), abs=0.06)
    assert low < iqm(np.concatenate(strata)) < high


def test_interval_of_all_possible_samples():
    # Two runs 0 and 1: the mean of a bootstrap sample is 0, ½, 1 with probabilities ¼, ½, ¼
    assert bootstrap_interval([[0.0, 1.0]], np.mean, confidence=0.6) == (0.0, 1.0)
    assert bootstrap_interval([[0.0, 1.0]], np.mean, confidence=0.4) == (0.5, 0.5)


def test_strata_are_drawn_from_apart():
    # Each stratum keeps its share, so nothing varies; one stratum of both would
    assert bootstrap_interval([[0.0] * 5, [1.0] * 5], np.mean) == (0.5, 0.5)
    low, high = bootstrap_interval([[0.0] * 5 + [1.0] * 5], np.mean)
    assert low < 0.3 and high > 0.7


def test_interval_covers_as_often_as_it_says():
    rng, covered = np.random.default_rng(0), 0
    for _ in range(300):
        low, high = bootstrap_interval([rng.normal(size=40)], np.mean, repetitions=500)
        covered += low <= 0 <= high
    assert 0.90 <= covered / 300 <= 0.98


def test_points_of_a_curve(monkeypatch):
    curves = np.random.default_rng(0).normal(size=(6, 4, 3))
    low, high = bootstrap_interval([curves], repetitions=500)
    assert low.shape == high.shape == (4, 3)
    assert (low[2, 1], high[2, 1]) == bootstrap_interval([curves[:, 2, 1]], repetitions=500)
    monkeypatch.setattr("sb3_symphony.analysis.statistics._CHUNK", 1)
    assert np.array_equal(bootstrap_interval([curves], repetitions=500), [low, high])


@pytest.mark.parametrize(
    "strata, arguments",
    [
        ([], {}),
        ([[]], {}),
        ([[1.0], [[1.0, 2.0]]], {}),
        ([3.0], {}),
        ([[1.0]], {"confidence": 95}),
        ([[1.0]], {"repetitions": 0}),
    ],
)
def test_bad_arguments(strata, arguments):
    with pytest.raises(ValueError, match="expected"):
        bootstrap_interval(strata, **arguments)


def test_nan_is_not_left_out():
    assert np.isnan(iqm([1.0, 2.0, 3.0, math.nan]))
    np.testing.assert_equal(iqm([[1.0, math.nan], [2.0, 2.0]], axis=1), [math.nan, 2.0])
    assert unstable_episodes([100, 200], [[300.0, 300.0], [math.nan, 300.0]], Event(True, 100), below=200) == (1, 2)


def test_summary():
    sample = [2, 4, 4, 4, 5, 5, 7, 9]
    assert summarise(sample) == Summary(n=8, mean=5.0, std=2.0, iqm=4.5)
    for wrong in ([], [[1, 2], [3, 4]], 3.0):
        with pytest.raises(ValueError, match="expected a sample of at least one"):
            summarise(wrong)
    low, high = bootstrap_interval([sample])
    assert 2 <= low < 4.5 < high <= 9


STEPS = [100, 200, 300, 400, 500]


@pytest.mark.parametrize(
    "means, event",
    [
        ([0, 310, 290, 300, 301], Event(True, 400)),  # a single good one does not count
        ([300, 300, 0, 0, 0], Event(True, 100)),
        ([0, 400, 0, 400, 0], Event(False, 500)),
        ([0, 0, 0, 0, 400], Event(False, 400)),  # it may have been at 500
    ],
)
def test_first_stable_evaluation(means, event):
    results = np.array(means)[:, None] + [-10, 0, 10]
    assert first_stable_evaluation(STEPS, results, 300) == event
    assert first_stable_evaluation([], np.empty((0, 3)), 300) == Event(False, 0)
    assert first_stable_evaluation([100], [[400.0]], 300) == Event(False, 0)
    assert first_stable_evaluation([100, 200], [[math.nan], [1.0]], 300) == Event(False, 200)


def test_first_episode():
    returns, ends = [-100, 299.9, 300, 0, 500], [50, 150, 1000, 1100, 2000]
    assert first_episode(ends, returns, 300) == Event(True, 1000, 3)
    assert first_episode(ends, returns, threshold=501) == Event(False, 2000, 5)
    assert first_episode(ends, returns, 300, window=3) == Event(False, 2000, 5)
    assert first_episode(ends, returns, threshold=199.9, window=3) == Event(True, 1100, 4)
    assert first_episode(ends, returns, threshold=-1000, window=6) == Event(False, 2000, 5)
    assert first_episode([], [], 300) == Event(False, 0, 0)


def test_first_episode_with_a_window_is_the_slow_one():
    rng = np.random.default_rng(0)
    returns, ends = rng.normal(size=400), np.cumsum(rng.integers(1, 9, size=400))
    slow = next(k for k in range(100, 401) if np.mean(returns[k - 100 : k]) >= 0.1)
    assert first_episode(ends, returns, threshold=0.1, window=100) == Event(True, ends[slow - 1], slow)


def test_unstable_episodes():
    steps = [100_000, 110_000, 120_000, 200_000, 210_000]
    results = [[300, 100], [400, 400], [199, 200], [-5, 300], [0, 0]]
    assert unstable_episodes(steps, results, Event(True, 100_000), 200) == (2, 6)  # neither its own evaluation nor later ones
    assert unstable_episodes(steps, results, Event(False, 210_000), 200) == (0, 0)


@pytest.mark.parametrize(
    "steps, reached, median",
    [
        ([1, 2, 9], [True, True, False], (2.0, True)),
        ([1, 2, 3, 9], [True, True, True, False], (2.5, True)),
        ([1, 2, 9, 9], [True, True, False, False], (5.5, False)),
        ([5, 2, 9], [True, False, True], (5.0, False)),  # the one that ended at 2 may be first or last
        ([5, 2, 3], [True, False, False], (3.0, False)),
    ],
)
def test_median_of_censored_runs(steps, reached, median):
    assert median_event(steps, reached) == median
    with pytest.raises(ValueError):
        median_event([], [])


def test_events_of_a_run_folder(tmp_path):
    returns = [-100.0] * 3 + [301.0] * 150
    lines = ['#{"t_start": 5.0, "env_id": "BipedalWalker-v3"}', "r,l,t"]
    lines += [f"{value},{10},{second}" for second, value in enumerate(returns)]
    (tmp_path / "0.monitor.csv").write_text("\n".join([*lines, "301.0,1"]))  # the last line is cut short
    events = run_events(open_run(tmp_path), 300, 200)
    assert str(events.stable) == "> 0" and np.isnan(events.best_evaluation)
    np.savez(
        tmp_path / "evaluations.npz",
        timesteps=[500, 1000, 1500],
        results=[[310, 300], [320, 300], [310, 190]],
        ep_lengths=[[9, 9]] * 3,
    )
    events = run_events(open_run(tmp_path), 300, 200)
    assert events.stable == Event(True, 500) and str(events.stable) == "500"
    assert events.episode == Event(True, 40, 4)
    assert events.trailing == Event(True, 1030, 103)
    assert (events.unstable, events.unstable_of) == (1, 4)
    assert (events.best_evaluation, events.best_episode) == (310.0, 301.0)


def test_iqm_of_events():
    # With 8 runs the two latest are cut: two censored ones do not matter for the mean, but for some bootstrap samples
    steps, reached = [10, 20, 30, 40, 50, 60, 100, 100], [True] * 6 + [False] * 2
    mean, low, high = iqm_event(steps, reached)
    assert mean == (45.0, True)
    assert low == (float(bootstrap_interval([steps])[0]), True)
    assert high == (float(bootstrap_interval([steps])[1]), False)
    assert iqm_event(steps, [True] * 8)[2] == (high[0], True)
    assert iqm_event(steps, [True] * 5 + [False] * 3)[0] == (45.0, False)
    assert iqm_event([7], [False]) == [(7.0, False)] * 3
    with pytest.raises(ValueError):
        iqm_event([], [])
