"""
Numbers of a comparison: interquartile mean, bootstrapped confidence intervals, and when a run reached what.

Interquartile mean and stratified bootstrap follow rliable (Agarwal et al., "Deep Reinforcement Learning at the Edge of the
Statistical Precipice", NeurIPS 2021, https://arxiv.org/abs/2108.13264).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from sb3_symphony.analysis.runs import Run

#: environment seed of the first evaluation episode in the course of a training
EVALUATION_SEED = 10_000
#: environment steps after the first stable evaluation in which failures are counted
STABLE_STEPS = 100_000
#: numbers drawn at once, 32 MB
_CHUNK = 4_000_000


def iqm(values: ArrayLike, axis: int | None = None) -> np.ndarray:
    """
    Interquartile mean: the mean of what is left without the ⌊n/4⌋ smallest and the ⌊n/4⌋ largest values.

    :param values: any shape, at least one value
    :param axis: axis to reduce; None: all values
    :return: ``values`` without that axis; NaN where one of them is
    """
    ordered = np.sort(np.asarray(values, dtype=np.float64), axis=axis)
    if axis is None:
        axis = 0  # np.sort has flattened
    n = ordered.shape[axis]
    middle = np.take(ordered, range(n // 4, n - n // 4), axis=axis).mean(axis=axis)
    return np.where(np.isnan(np.take(ordered, -1, axis=axis)), np.nan, middle)  # sorted to the end


def bootstrap_interval(
    strata: Sequence[ArrayLike],
    statistic: Callable[..., np.ndarray] = iqm,
    confidence: float = 0.95,
    repetitions: int = 10_000,
    seed: int = 0,
) -> tuple[np.ndarray, np.ndarray]:
    """
    Confidence interval by the stratified percentile bootstrap.

    Each repetition draws as many runs as there are, with replacement and within each stratum (one environment, say), and
    takes the statistic of all drawn runs together.

    :param strata: one array for each stratum, of shape ``(n_runs, *points)``; the number of runs may differ, the points
        (of a curve, say) must not
    :param statistic: function of an array and ``axis``, such as :func:`iqm`, ``np.mean`` or ``np.median``
    :param confidence: probability that the interval covers the true value
    :param repetitions: number of bootstrap samples
    :param seed: seed of the draws, which are the same for all points
    :return: lower and upper limits, each of shape ``points``
    :raises ValueError: for no runs, different points, or a confidence outside (0, 1)
    """
    arrays = [np.asarray(stratum, dtype=np.float64) for stratum in strata]
    if not arrays or any(array.ndim == 0 or len(array) == 0 for array in arrays):
        raise ValueError("strata: expected at least one array, each with at least one run")
    points = arrays[0].shape[1:]
    if any(array.shape[1:] != points for array in arrays):
        raise ValueError(f"strata: expected arrays of shape (n_runs, *points), got {[array.shape for array in arrays]}")
    if not 0 < confidence < 1 or repetitions < 1:
        raise ValueError(f"confidence={confidence!r}, repetitions={repetitions!r}: expected one in (0, 1) and one >= 1")

    rng = np.random.default_rng(seed)
    rows = [rng.integers(len(array), size=(repetitions, len(array))) for array in arrays]
    flat = [array.reshape(len(array), -1) for array in arrays]  # (n_runs, n_points)
    n_points = flat[0].shape[1]
    step = max(_CHUNK // (repetitions * sum(map(len, flat))), 1)
    limits = np.empty((2, n_points))
    for first in range(0, n_points, step):
        some = slice(first, first + step)
        drawn = np.concatenate([array[index, some] for array, index in zip(flat, rows, strict=True)], axis=1)
        tails = [(1 - confidence) / 2, (1 + confidence) / 2]
        limits[:, some] = np.quantile(statistic(drawn, axis=1), tails, axis=0)  # of (repetitions, points)
    return limits[0].reshape(points), limits[1].reshape(points)


@dataclass(frozen=True)
class Summary:
    """
    A sample in numbers.

    :param n: its size
    :param mean: mean
    :param std: standard deviation of the sample as it is (divided by n), as Stable-Baselines3 reports it
    :param iqm: interquartile mean
    """

    n: int
    mean: float
    std: float
    iqm: float


def summarise(values: ArrayLike) -> Summary:
    """
    :param values: sample, shape ``(n,)``
    :return: its statistics
    :raises ValueError: if it is empty, or no sample
    """
    sample = np.asarray(values, dtype=np.float64)
    if sample.ndim != 1 or not len(sample):
        raise ValueError(f"values: expected a sample of at least one, shape (n,), got {sample.shape}")
    return Summary(len(sample), float(sample.mean()), float(sample.std()), float(iqm(sample)))


# ----------------------------------------------------------------------------------------------------------------------
# Events of a run
# ----------------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Event:
    """
    When a run reached something. If it ended before, the event is censored: it would have come later than recorded.

    :param reached: whether it did
    :param step: environment step of the event, or the run's last one
    :param episode: training episode of the event, from 1 on, or the run's number of episodes; None for evaluations
    """

    reached: bool
    step: int
    episode: int | None = None

    def __str__(self) -> str:
        return f"{'' if self.reached else '> '}{self.step}"


def first_stable_evaluation(timesteps: ArrayLike, results: ArrayLike, threshold: float) -> Event:
    """
    The first of two consecutive evaluations whose mean return is at least the threshold ("S300").

    :param timesteps: environment steps of the evaluations, shape ``(n,)``
    :param results: their returns, shape ``(n, episodes)``
    :param threshold: mean return to reach
    :return: the event; censored at the last evaluation that cannot be the first of them
    """
    steps = np.asarray(timesteps, dtype=np.int64)
    if len(steps) == 0:
        return Event(False, 0)
    good = np.asarray(results, dtype=np.float64).mean(axis=1) >= threshold
    both = np.flatnonzero(good[:-1] & good[1:])
    if len(both):
        return Event(True, int(steps[both[0]]))
    bad = np.flatnonzero(~good)  # after the last of them, more good ones might have followed
    return Event(False, int(steps[bad[-1]]) if len(bad) else 0)


def first_episode(steps: ArrayLike, returns: ArrayLike, threshold: float, window: int = 1) -> Event:
    """
    The first training episode at which the mean return of the latest ``window`` episodes is at least the threshold: "E300"
    with a window of 1, and with one of 100 "T300", Gymnasium's definition of a solved BipedalWalker.

    :param steps: environment steps at the ends of the episodes, shape ``(n,)``
    :param returns: their returns, shape ``(n,)``
    :param threshold: return to reach
    :param window: number of episodes in the mean, all of which must have been played
    :return: the event; censored at the last episode
    """
    ends, values = np.asarray(steps, dtype=np.int64), np.asarray(returns, dtype=np.float64)
    if len(values) >= window:
        means = np.lib.stride_tricks.sliding_window_view(values, window).mean(axis=1)
        reached = np.flatnonzero(means >= threshold)
        if len(reached):
            episode = int(reached[0]) + window
            return Event(True, int(ends[episode - 1]), episode)
    return Event(False, int(ends[-1]) if len(ends) else 0, len(ends))


def unstable_episodes(timesteps: ArrayLike, results: ArrayLike, stable: Event, below: float) -> tuple[int, int]:
    """
    Evaluation episodes that failed within :data:`STABLE_STEPS` after the evaluations had become stable.

    :param timesteps: environment steps of the evaluations, shape ``(n,)``
    :param results: their returns, shape ``(n, episodes)``
    :param stable: result of :func:`first_stable_evaluation`
    :param below: return of a failure is less than that
    :return: number of failures, and of all episodes that count; (0, 0) if evaluations never became stable
    """
    if not stable.reached:
        return 0, 0
    steps = np.asarray(timesteps, dtype=np.int64)
    counted = np.asarray(results, dtype=np.float64)[(steps > stable.step) & (steps <= stable.step + STABLE_STEPS)]
    return int((~(counted >= below)).sum()), counted.size  # NaN is a failure


def median_event(steps: Sequence[int], reached: Sequence[bool]) -> tuple[float, bool]:
    """
    Median over runs of which some are censored.

    :param steps: when each run reached the event, or ended
    :param reached: whether it did
    :return: the median and True; or, if it depends on what censored runs would have done, the least it can be and False
    :raises ValueError: for no runs
    """
    if not len(steps):
        raise ValueError("steps: expected at least one run")
    at = np.asarray(steps, dtype=np.float64)
    earliest, latest = np.median(at), np.median(np.where(np.asarray(reached, dtype=bool), at, np.inf))
    return float(earliest), bool(earliest == latest)


def iqm_event(steps: Sequence[int], reached: Sequence[bool]) -> list[tuple[float, bool]]:
    """
    Interquartile mean over runs of which some are censored, and its 95 % confidence interval.

    :param steps: when each run reached the event, or ended
    :param reached: whether it did
    :return: mean, lower and upper limit, each with True; or, where it depends on what censored runs would have done, the
        least it can be and False
    :raises ValueError: for no runs
    """
    if not len(steps):
        raise ValueError("steps: expected at least one run")
    at = np.asarray(steps, dtype=np.float64)
    never = np.where(np.asarray(reached, dtype=bool), at, 1e30)  # finite, so that quantiles between two of them are too
    least, most = ([iqm(values), *bootstrap_interval([values])] for values in (at, never))
    return [(float(low), bool(low == high)) for low, high in zip(least, most, strict=True)]


@dataclass(frozen=True)
class RunEvents:
    """
    What a run reached.

    :param stable: first of two consecutive evaluations with mean return ≥ threshold ("S300")
    :param episode: first training episode with return ≥ threshold ("E300")
    :param trailing: first training episode at which the mean of the latest 100 is ≥ threshold ("T300")
    :param unstable: failed evaluation episodes within :data:`STABLE_STEPS` after ``stable``
    :param unstable_of: number of evaluation episodes in that time
    :param best_evaluation: largest mean return of an evaluation; nan without evaluations
    :param best_episode: largest return of a training episode; nan without episodes
    """

    stable: Event
    episode: Event
    trailing: Event
    unstable: int
    unstable_of: int
    best_evaluation: float
    best_episode: float


def run_events(run: Run, threshold: float, unstable_below: float) -> RunEvents:
    """
    :param run: a run; one without evaluations or episodes has reached nothing
    :param threshold: return that counts as success
    :param unstable_below: return below which a later evaluation episode counts as a failure
    :return: what the run reached; returns are those of the environment, warm-up episodes count
    """
    nothing = np.empty(0, dtype=np.int64)
    ends, returns = (run.episodes.steps, run.episodes.returns) if run.episodes else (nothing, np.empty(0))
    steps, results = (run.evaluations.steps, run.evaluations.returns) if run.evaluations else (nothing, np.empty((0, 1)))
    stable = first_stable_evaluation(steps, results, threshold)
    failed, counted = unstable_episodes(steps, results, stable, unstable_below)
    return RunEvents(
        stable=stable,
        episode=first_episode(ends, returns, threshold),
        trailing=first_episode(ends, returns, threshold, window=100),
        unstable=failed,
        unstable_of=counted,
        best_evaluation=float(results.mean(axis=1).max()) if len(results) else float("nan"),
        best_episode=float(returns.max()) if len(returns) else float("nan"),
    )
