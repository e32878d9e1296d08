"""
Results of a grid as tables: one CSV row per episode, one per run, and a Markdown table for each environment.

What the columns of the Markdown table mean is said under it. A run that ended before an event is censored, and a number that
depends on what it would have done is written "> n". Numbers are those of the runs that are done; where none is, they tell how
far those have come that have begun.
"""

import csv
import io
import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from sb3_symphony.analysis.runs import Run, Scalar, told_apart
from sb3_symphony.analysis.statistics import (
    EVALUATION_SEED,
    STABLE_STEPS,
    Event,
    RunEvents,
    bootstrap_interval,
    iqm,
    iqm_event,
    median_event,
    run_events,
    summarise,
)


@dataclass(frozen=True)
class Thresholds:
    """
    What counts as success in an environment.

    :param solved: return that solves it; None: nothing does
    :param unstable_below: return below which an episode counts as a failure once it is solved; None: none does
    """

    solved: float | None
    unstable_below: float | None


@dataclass(frozen=True)
class Result:
    """
    One run of a grid.

    :param algorithm: name of the variant
    :param environment: id of the environment
    :param seed: seed
    :param thresholds: what counts as success
    :param run: its files; None if there are none yet
    :param summary: ``steps``, ``updates``, ``seconds`` and, if it was asked for, ``final`` and ``conditions``; None as long as
        it is not done
    :param reported: what others have reported of the variant
    """

    algorithm: str
    environment: str
    seed: int
    thresholds: Thresholds
    run: Run | None
    summary: dict[str, Any] | None
    reported: str = ""

    @cached_property
    def events(self) -> RunEvents:
        """What the run reached; without a threshold only its maxima mean something."""
        assert self.run is not None
        solved, below = self.thresholds.solved, self.thresholds.unstable_below
        return run_events(self.run, math.inf if solved is None else solved, -math.inf if below is None else below)

    @property
    def standard(self) -> bool:
        """Whether it was evaluated by the standard protocol."""
        return self.run is not None and self.run.options.get("protocol") == "standard"

    @property
    def final(self) -> np.ndarray:
        """Returns of the episodes that the model was evaluated on at the end, shape ``(n,)``."""
        return np.array((self.summary or {}).get("final", {}).get("returns", []), dtype=np.float64)

    @property
    def final_lengths(self) -> np.ndarray:
        """Their numbers of steps, shape ``(n,)``."""
        return np.array((self.summary or {}).get("final", {}).get("lengths", []), dtype=np.float64)


# ----------------------------------------------------------------------------------------------------------------------
# CSV
# ----------------------------------------------------------------------------------------------------------------------

Row = dict[str, Any]


#: of :func:`episode_rows`
EPISODE_COLUMNS = (
    *("algorithm", "environment", "seed"),
    *("kind", "step", "episode", "environment_seed", "return", "length", "success"),
)


def as_csv(columns: Iterable[str], rows: Iterable[Row]) -> str:
    """
    :param columns: names of the columns
    :param rows: column → value
    :return: the rows as text, under a line of names; None is empty
    """
    text = io.StringIO()
    writer = csv.DictWriter(text, list(columns), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()


def scalar_table(scalars: Mapping[str, Scalar]) -> str:
    """
    Scalars as text, for a ``scalars.csv``: one row for each time that some were logged, with six digits.

    :param scalars: name of each quantity → its course
    :return: columns ``step`` and ``seconds``, then one for each quantity, empty where it was not logged
    """
    rows: dict[tuple[int, int], Row] = {}
    for tag, scalar in scalars.items():
        seen: Counter[int] = Counter()  # several parallel episodes may end at the same step
        for step, seconds, value in zip(scalar.steps.tolist(), scalar.seconds.tolist(), scalar.values.tolist(), strict=True):
            row = rows.setdefault((step, seen[step]), {"step": step, "seconds": f"{seconds:.2f}"})
            row[tag] = f"{value:.6g}"
            seen[step] += 1
    return as_csv(["step", "seconds", *scalars], [rows[key] for key in sorted(rows)])


def _of(result: Result) -> Row:
    return {"algorithm": result.algorithm, "environment": result.environment, "seed": result.seed}


def _plain(values: np.ndarray | Sequence[Any] | None, n: int) -> list[Any]:
    if values is None:
        return [None] * n
    return [
        None if value is None else int(value) if isinstance(value, bool) else value for value in np.asarray(values).tolist()
    ]


def episode_rows(results: Iterable[Result]) -> Iterator[Row]:
    """
    :param results: runs
    :return: a row for each episode: of training (``step`` is that of its end), of an evaluation in its course (``step`` is
        that of the training), and of the evaluations at the end
    """

    def rows(result: Result, kind: str, steps: Any, seeds: Any, returns: Any, lengths: Any, successes: Any) -> Iterator[Row]:
        n = len(returns)
        columns = ([kind] * n, steps, range(1, n + 1), seeds, returns, lengths, successes)
        for values in zip(*(_plain(values, n) for values in columns), strict=True):
            yield dict(zip(EPISODE_COLUMNS, (*_of(result).values(), *values), strict=True))

    for result in results:
        if result.run is None:
            continue
        training, evaluations = result.run.episodes, result.run.evaluations
        if training is not None:
            yield from rows(result, "training", training.steps, None, training.returns, training.lengths, training.successes)
        if evaluations is not None:
            for i, step in enumerate(evaluations.steps):
                returns, lengths = evaluations.returns[i], evaluations.lengths[i]
                seeds = range(EVALUATION_SEED, EVALUATION_SEED + len(returns))
                successes = None if evaluations.successes is None else evaluations.successes[i]
                yield from rows(result, "evaluation", [step] * len(returns), seeds, returns, lengths, successes)
        summary = result.summary or {}
        at_the_end = {"final": summary.get("final")}
        at_the_end |= {f"condition {name}": each for name, each in summary.get("conditions", {}).items()}
        for kind, each in at_the_end.items():
            if each:
                n = len(each["returns"])
                seeds, steps = range(each["seed"], each["seed"] + n), [summary["steps"]] * n
                yield from rows(result, kind, steps, seeds, each["returns"], each["lengths"], each["successes"])


def _event(name: str, event: Event | None) -> Row:
    if event is None:
        return {f"{name}_{column}": None for column in ("reached", "step", "episode")}
    return {f"{name}_reached": int(event.reached), f"{name}_step": event.step, f"{name}_episode": event.episode}


def run_row(result: Result) -> Row:
    """
    :param result: a run
    :return: what it reached, as a row; where an event was not reached, its step is the last one
    """
    summary = result.summary or {}
    events = None if result.run is None else result.events
    solved = None if result.thresholds.solved is None else events
    unstable = None if result.thresholds.unstable_below is None else solved
    final = summarise(result.final) if len(result.final) else None
    return {
        **_of(result),
        "protocol": None if result.run is None else "standard" if result.standard else "non-standard",
        "done": int(result.summary is not None),
        "steps": summary.get("steps"),
        "updates": summary.get("updates"),
        "seconds": summary.get("seconds"),
        "threshold": result.thresholds.solved,
        **_event("stable", None if solved is None else solved.stable),
        **_event("first", None if solved is None else solved.episode),
        **_event("trailing", None if solved is None else solved.trailing),
        "unstable": None if unstable is None else unstable.unstable,
        "unstable_of": None if unstable is None else unstable.unstable_of,
        "best_evaluation": None if events is None else _finite(events.best_evaluation),
        "best_episode": None if events is None else _finite(events.best_episode),
        "final_episodes": None if final is None else final.n,
        "final_mean": None if final is None else final.mean,
        "final_std": None if final is None else final.std,
        "final_iqm": None if final is None else final.iqm,
        "final_length": None if final is None else float(result.final_lengths.mean()),
        "final_length_std": None if final is None else float(result.final_lengths.std()),
    }


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


# ----------------------------------------------------------------------------------------------------------------------
# Markdown
# ----------------------------------------------------------------------------------------------------------------------

_NOTHING = "–"


def _number(value: float) -> str:
    """Rounded, with a space between thousands."""
    return f"{value:,.0f}".replace(",", " ")


def _bound(bound: tuple[float, bool]) -> str:
    value, exact = bound
    half = value < 1000 and value % 1  # a median of episodes
    return f"{'' if exact else '> '}{f'{value:.1f}' if half else _number(value)}"


def _duration(seconds: float) -> str:
    minutes = round(seconds / 60)
    return f"{minutes // 60}:{minutes % 60:02} h" if seconds >= 60 else f"{seconds:.0f} s"


def _median_of(events: Sequence[Event]) -> str:
    """Median episode, and step in brackets."""
    reached = [event.reached for event in events]
    episode = median_event([event.episode or 0 for event in events], reached)
    return f"{_bound(episode)} ({_bound(median_event([event.step for event in events], reached))})"


def _stable_iqm(events: Sequence[Event]) -> str:
    mean, low, high = iqm_event([event.step for event in events], [event.reached for event in events])
    return f"{_bound(mean)} ({_bound(low)} … {_bound(high)})" if len(events) > 1 else _bound(mean)


def _unstable(runs: Sequence[Result]) -> str:
    failed, counted = (sum(getattr(each.events, name) for each in runs) for name in ("unstable", "unstable_of"))
    return f"{failed} / {counted}" if counted else _NOTHING


def _maximum(runs: Sequence[Result]) -> str:
    best = [each.events.best_evaluation for each in runs if math.isfinite(each.events.best_evaluation)]
    return f"{np.median(best):.1f} ({max(best):.1f})" if best else _NOTHING


def _final_iqm(runs: Sequence[Result]) -> str:
    means = [each.final.mean() for each in runs if len(each.final)]
    if not means:
        return _NOTHING
    if len(means) == 1:
        return f"{means[0]:.1f}"
    low, high = bootstrap_interval([means])
    return f"{iqm(means):.1f} ({low:.1f} … {high:.1f})"


def _final_episodes(runs: Sequence[Result]) -> str:
    returns = np.concatenate([each.final for each in runs])
    return f"{returns.mean():.1f} ± {returns.std():.1f}, {iqm(returns):.1f}" if len(returns) else _NOTHING


def _final_length(runs: Sequence[Result]) -> str:
    lengths = np.concatenate([each.final_lengths for each in runs])
    return f"{_number(lengths.mean())} ± {_number(lengths.std())}" if len(lengths) else _NOTHING


Column = tuple[str, Callable[[Sequence[Result]], str]]


def _columns(results: Sequence[Result]) -> list[Column]:
    """The columns that have something to say: events need a threshold, the final quality an evaluation at the end."""
    thresholds = results[0].thresholds
    columns: list[Column] = []
    if thresholds.solved is not None:
        name = f"{thresholds.solved:g}"
        columns += [
            (f"S{name} median", lambda runs: _bound(median_event(*_steps(runs)))),
            (f"S{name} IQM (95 % CI)", lambda runs: _stable_iqm([each.events.stable for each in runs])),
            (f"E{name}", lambda runs: _median_of([each.events.episode for each in runs])),
            (f"T{name}", lambda runs: _median_of([each.events.trailing for each in runs])),
        ]
        if thresholds.unstable_below is not None:
            columns.append(("unstable", _unstable))
    columns.append(("maximum", _maximum))
    if any(len(each.final) for each in results):
        columns += [
            ("final IQM (95 % CI)", _final_iqm),
            ("final episodes", _final_episodes),
            ("final length", _final_length),
        ]
    columns += [
        ("updates", lambda runs: _of_summaries(runs, "updates", _number)),
        ("wall-clock", lambda runs: _of_summaries(runs, "seconds", _duration)),
    ]
    return columns


def _of_summaries(runs: Sequence[Result], name: str, write: Callable[[float], str]) -> str:
    """Median of what is known of runs that are done."""
    values = [each.summary[name] for each in runs if each.summary is not None]
    return write(float(np.median(values))) if values else _NOTHING


def _so_far(result: Result) -> int:
    """Steps of a run whose episodes are over; 0 if there is none yet."""
    episodes = result.run.episodes if result.run else None
    return int(episodes.steps[-1]) if episodes is not None and len(episodes.steps) else 0


def _steps(runs: Sequence[Result]) -> tuple[list[int], list[bool]]:
    return [each.events.stable.step for each in runs], [each.events.stable.reached for each in runs]


def aligned(rows: Sequence[Sequence[str]]) -> list[str]:
    """
    :param rows: names of the columns, then the cells of each row
    :return: lines of a Markdown table that is readable as text too: names to the left, numbers to the right
    """
    rows = [[" ".join(cell.replace("|", r"\|").split("\n")) for cell in row] for row in rows]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = [
        f"| {row[0]:{widths[0]}} | "
        + " | ".join(f"{cell:>{width}}" for cell, width in zip(row[1:], widths[1:], strict=True))
        + " |"
        for row in rows
    ]
    rule = f"|{'-' * (widths[0] + 2)}|" + "|".join(f"{'-' * (width + 1)}:" for width in widths[1:]) + "|"
    return [lines[0], rule, *lines[1:]]


def by_algorithm(results: Iterable[Result]) -> dict[str, list[Result]]:
    """
    :param results: runs
    :return: name of each variant → its runs, in the order given
    """
    rows: dict[str, list[Result]] = {}
    for each in results:
        rows.setdefault(each.algorithm, []).append(each)
    return rows


def told_of(row: Sequence[Result]) -> list[Result]:
    """
    :param row: runs of one variant
    :return: those that tables and curves are made of: those that are done; if none is, those that have come somewhere
    """
    return [each for each in row if each.summary is not None] or [each for each in row if _so_far(each)]


def _unfinished(results: Sequence[Result]) -> dict[str, list[Result]]:
    """Runs that are not done, of all rows that have been begun."""
    begun = [row for row in by_algorithm(results).values() if any(each.run is not None for each in row)]
    told = [each for row in begun for each in told_of(row)]
    return {
        "not done, and not in these numbers": [each for row in begun for each in row if each not in told],
        "not done, and in these numbers as far as they have come": [each for each in told if each.summary is None],
    }


def markdown_table(results: Sequence[Result]) -> str:
    """
    :param results: runs on one environment, in the order of its rows
    :return: heading, table and what its columns mean
    """
    columns = _columns(results)
    reported = any(each.reported for each in results)
    rows = [["algorithm", "seeds", "steps", *(name for name, _ in columns), *["reported"] * reported]]
    for algorithm, own in by_algorithm(results).items():
        told = told_of(own)
        done = [each.summary for each in own if each.summary is not None]
        mark = "" if all(each.standard for each in own if each.run) else " (non-standard)"
        seeds = f"{len(done)}" if len(done) == len(own) else f"{len(done)} of {len(own)}"
        if all(each.run is None for each in own):
            seeds = "not run yet"
        steps = " or ".join(map(_number, sorted({summary["steps"] for summary in done})))
        if told and not done:
            steps = f"{_number(max(map(_so_far, told)))} so far"
        cells = [write(told) if told else _NOTHING for _, write in columns]
        rows.append([algorithm + mark, seeds, steps or _NOTHING, *cells, *[own[0].reported or _NOTHING] * reported])
    names = [name for name, _ in columns]
    return "\n".join([f"### {results[0].environment}", "", *aligned(rows), "", *_meaning(results, names), ""])


def _meaning(results: Sequence[Result], names: Sequence[str]) -> list[str]:
    """What the columns are."""
    thresholds = results[0].thresholds
    lines = []
    if any(name.startswith("S") for name in names):
        name = f"{thresholds.solved:g}"
        lines += [
            f"- S{name}: environment step of the first of two consecutive evaluations with mean return ≥ {name}",
            f"- E{name}: first training episode with return ≥ {name}; T{name}: first one at which the mean of the latest 100 "
            f"is ≥ {name}. Median over seeds, in brackets that of the environment steps",
            '- "> n": the number depends on runs that ended before',
        ]
    if "unstable" in names:
        below = f"{thresholds.unstable_below:g}"
        lines.append(
            f"- unstable: evaluation episodes with return < {below} within {_number(STABLE_STEPS)} steps after "
            f"S{thresholds.solved:g}, of all seeds"
        )
    lines.append("- maximum: largest mean return of an evaluation, median over seeds, in brackets that of the best seed")
    final = sorted({len(each.final) for each in results if len(each.final)})
    if final:
        episodes = " or ".join(map(str, final))
        lines.append(
            f"- final: the model at the end, deterministic, {episodes} episodes: IQM over the seeds' means; mean ± standard "
            "deviation and IQM of all episodes; mean ± standard deviation of their lengths"
        )
    lines.append(
        "- updates, wall-clock (with evaluations, several runs at a time): median over seeds. IQM: interquartile mean; CI: "
        "bootstrap interval over seeds"
    )
    other = sorted({_protocol(each.run) for each in results if each.run is not None and not each.standard})
    lines += [f"- non-standard: {protocol}" for protocol in other]
    lines += _repeated(results)
    for what, some in _unfinished(results).items():
        if some:
            lines.append(f"- {what}: {', '.join(f'{each.algorithm} {each.seed}' for each in some)}")
    return lines


def _repeated(results: Sequence[Result]) -> Iterator[str]:
    """Whether runs of the same settings and seed, under two names, are the same."""
    done = [each for each in results if each.summary is not None and each.run is not None and each.run.config]
    for i, first in enumerate(done):
        for second in done[i + 1 :]:
            a, b = first.run, second.run
            assert a is not None and b is not None
            if (a.algo, a.config, told_apart(a), first.seed) == (b.algo, b.config, told_apart(b), second.seed):
                same = "bit for bit the same" if _episodes_of(first) == _episodes_of(second) else "not the same"
                both = f"{first.algorithm} and {second.algorithm}"
                yield f"- {both}: same settings; returns and lengths of all episodes with seed {first.seed} are {same}"


def _episodes_of(result: Result) -> list[tuple[Any, ...]]:
    """Of training and of all evaluations."""
    return [tuple(row[name] for name in EPISODE_COLUMNS[3:]) for row in episode_rows([result])]


def _protocol(run: Run) -> str:
    frequency, episodes = run.options.get("eval_freq"), run.options.get("eval_episodes")
    if not frequency:
        return "no evaluation while training"
    return f"evaluated every {_number(frequency)} steps on {episodes} episode" + "s" * (episodes != 1)
