"""
Learning curves and logged quantities of runs.

A curve is that of a group of runs which differ in their seed: the interquartile mean (IQM) over the seeds, with a 95 %
bootstrap interval, beside the single seeds. Where seeds were recorded at different steps they are interpolated linearly,
and the IQM ends where the shortest one ends.
"""

import math
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter, MaxNLocator, PercentFormatter

from sb3_symphony.analysis.runs import NotRecorded, Run, open_run
from sb3_symphony.analysis.statistics import bootstrap_interval, iqm
from sb3_symphony.analysis.style import COLORS, house_style, line_style, name_lines, new_figure, note, save
from sb3_symphony.common.checks import suggestion

XAxis = Literal["steps", "episodes", "time"]
YAxis = Literal["reward", "length", "success"]
Line = tuple[np.ndarray, np.ndarray]  # x and y, each (n,)

_X_LABELS = {"steps": "environment steps", "episodes": "training episodes"}
_Y_LABELS = {"reward": "return per episode", "length": "episode length (steps)", "success": "successful episodes"}

#: logged quantities worth a look, in the order of their panels: what they are and their unit
SCALARS: dict[str, tuple[str, str]] = {
    "rollout/ep_rew_mean": ("training return", "return, mean of 100"),
    "rollout/ep_len_mean": ("training episode length", "steps"),
    "rollout/success_rate": ("training successes", "share of episodes"),
    "eval/mean_reward": ("evaluation return", "return, mean"),
    "eval/mean_ep_length": ("evaluation episode length", "steps"),
    "time/fps": ("speed", "environment steps / s"),
    "train/approx_kl": ("approximate KL divergence", "nats"),
    "train/kl_divergence_loss": ("KL divergence", "nats"),
    "train/clip_fraction": ("clip fraction", "share of samples"),
    "train/entropy_loss": ("entropy loss (− entropy)", "nats"),
    "train/explained_variance": ("explained variance", "share of variance"),
    "train/policy_gradient_loss": ("policy gradient loss", "loss"),
    "train/policy_objective": ("policy objective", "objective"),
    "train/value_loss": ("value loss", "loss"),
    "train/loss": ("total loss", "loss"),
    "train/actor_loss": ("actor loss", "loss"),
    "train/critic_loss": ("critic loss", "loss"),
    "train/ent_coef": ("entropy coefficient", "reward / nat"),
    "train/ent_coef_loss": ("entropy coefficient loss", "loss"),
    "train/std": ("standard deviation of actions", "action units"),
    "train/noise_std": ("exploration noise", "std, scaled action units"),
    "train/q_mean": ("mean Q-value", "discounted return"),
    "train/q_std": ("spread of the critics", "std, discounted return"),
    "q_bias/normalized_mean": ("Q bias, mean", "share of mean return"),
    "q_bias/normalized_std": ("Q bias, standard deviation", "share of mean return"),
    "train/learning_rate": ("learning rate", "step size"),
    "train/update_ratio": ("update ratio", "updates / step"),
}


@dataclass(frozen=True)
class Curve:
    """
    What a figure shows of a group.

    :param label: name of the group
    :param seeds: of each run, x and y
    :param x: shape ``(n,)``; empty if the runs have no common range
    :param y: IQM over the seeds, shape ``(n,)``; with one seed its own values
    :param low: lower limit of the 95 % interval, shape ``(n,)``, or empty with one seed
    :param high: upper limit
    """

    label: str
    seeds: list[Line]
    x: np.ndarray
    y: np.ndarray
    low: np.ndarray
    high: np.ndarray

    def plain(self) -> dict[str, Any]:
        """:return: the numbers, as JSON takes them"""
        arrays = {name: getattr(self, name).tolist() for name in ("x", "y", "low", "high")}
        return {"label": self.label, **arrays, "seeds": [{"x": x.tolist(), "y": y.tolist()} for x, y in self.seeds]}


# ----------------------------------------------------------------------------------------------------------------------
# Numbers
# ----------------------------------------------------------------------------------------------------------------------


def running_mean(values: np.ndarray, window: int) -> np.ndarray:
    """
    :param values: shape ``(n,)``
    :param window: number of values in a mean, fewer at the start
    :return: trailing means, shape ``(n,)``; NaN where one of the values is not finite
    """
    unknown = ~np.isfinite(values)
    sums, unknowns = (np.concatenate([[0], np.cumsum(each)]) for each in (np.where(unknown, 0.0, values), unknown))
    last = np.arange(1, len(values) + 1)
    first = np.maximum(last - window, 0)
    return np.where(unknowns[last] > unknowns[first], np.nan, (sums[last] - sums[first]) / (last - first))


def block_mean(values: np.ndarray, size: int) -> np.ndarray:
    """
    :param values: shape ``(n,)``
    :param size: number of values in a block
    :return: mean of every ``size`` values, shape ``(n // size,)``; what is left at the end is no block
    """
    return values[: len(values) // size * size].reshape(-1, size).mean(axis=1)


def _common_grid(xs: Sequence[np.ndarray]) -> np.ndarray:
    """Where all seeds are known: the points of the shortest one if the others share them, else even steps."""
    shortest = min(xs, key=len)
    if all(np.array_equal(x[: len(shortest)], shortest) for x in xs):
        return shortest
    if min(map(len, xs)) == 0 or max(x[0] for x in xs) > min(x[-1] for x in xs):
        return np.empty(0)
    return np.linspace(max(x[0] for x in xs), min(x[-1] for x in xs), 300)


def summarised(label: str, seeds: Sequence[Line]) -> Curve:
    """
    :param label: name of the group
    :param seeds: of each run, x (ascending) and y; at least one
    :return: their curve
    """
    seeds = list(seeds)
    if len(seeds) == 1:
        return Curve(label, seeds, *seeds[0], np.empty(0), np.empty(0))
    grid = _common_grid([x for x, _ in seeds])
    if len(grid) == 0:
        return Curve(label, seeds, grid, grid, grid, grid)
    values = np.stack([np.interp(grid, x, y) for x, y in seeds])  # (seeds, points)
    return Curve(label, seeds, grid, iqm(values, axis=0), *bootstrap_interval([values], repetitions=2000))


def _episodes_of(run: Run, need: str) -> Line:
    if run.episodes is None:
        raise NotRecorded(f"{run.path}: has no *monitor.csv — expected one for {need}")
    return run.episodes.steps, run.episodes.seconds


def _located(run: Run, steps: np.ndarray, x: XAxis) -> np.ndarray:
    """Environment steps as positions on the x axis, by the training episodes that ended around them."""
    if x == "steps":
        return steps
    ends, seconds = _episodes_of(run, f"an axis of {x}")
    if x == "episodes":
        return np.interp(steps, np.concatenate([[0], ends]), np.arange(len(ends) + 1))
    if len(ends) == 0:
        raise NotRecorded(f"{run.path}: no training episode has ended — expected one for an axis of time")
    at = np.interp(steps, np.concatenate([[0], ends]), np.concatenate([[0], seconds]))
    return np.where(steps > ends[-1], seconds[-1] * steps / ends[-1], at)  # later: at the mean speed until then


def _not_told(run: Run) -> NotRecorded:
    return NotRecorded(f"{run.path}: its environment does not tell whether an episode is a success")


def episode_curve(run: Run, x: XAxis, y: YAxis, window: int, per: int | None = None, max_steps: int | None = None) -> Line:
    """
    Training episodes of a run as a line.

    :param run: the run
    :param x: axis to draw against
    :param y: what to draw
    :param window: number of episodes in the running mean
    :param per: instead of a running mean, one point for every ``per`` episodes: their mean, at the end of the last one
    :param max_steps: later environment steps are left out; None: nothing is
    :return: x and y
    :raises NotRecorded: if it is not in the files of the run
    """
    ends, seconds = _episodes_of(run, "a curve of training episodes")
    assert run.episodes is not None
    values = {"reward": run.episodes.returns, "length": run.episodes.lengths, "success": run.episodes.successes}[y]
    if values is None:
        raise _not_told(run)
    n = len(ends) if max_steps is None else int(np.searchsorted(ends, max_steps, side="right"))
    at, values = {"steps": ends, "episodes": np.arange(1, len(ends) + 1), "time": seconds}[x][:n], values[:n]
    if per is None:
        return at, running_mean(values, window)
    return at[per - 1 :: per], block_mean(values, per)


def evaluation_curve(run: Run, x: XAxis, y: YAxis, max_steps: int | None = None) -> Line:
    """
    Evaluations of a run as a line.

    :param run: the run
    :param x: axis to draw against; time and episodes are interpolated between the ends of training episodes,
        after the last one time goes on at the mean speed until then
    :param y: what to draw, the mean over the episodes of each evaluation
    :param max_steps: later environment steps are left out; None: nothing is
    :return: x and y
    :raises NotRecorded: if it is not in the files of the run
    """
    data = run.evaluations
    if data is None:
        raise NotRecorded(f"{run.path}: has no evaluations.npz — `train --eval-freq` writes it")
    values = {"reward": data.returns, "length": data.lengths, "success": data.successes}[y]
    if values is None:
        raise _not_told(run)
    kept = data.steps <= (math.inf if max_steps is None else max_steps)
    return _located(run, data.steps, x)[kept], values.mean(axis=1)[kept]


def scalar_curve(run: Run, tag: str, x: XAxis, max_steps: int | None = None) -> Line:
    """
    A logged quantity of a run as a line.

    :param run: the run
    :param tag: name of one of its scalars
    :param x: axis to draw against
    :param max_steps: later environment steps are left out; None: nothing is
    :return: x and y; values that are not finite are left out
    :raises NotRecorded: if it is not in the files of the run
    """
    if tag not in run.scalars:
        raise NotRecorded(f"{run.path}: has not logged {tag!r}{suggestion(tag, run.scalars)}")
    scalar = run.scalars[tag]
    # A log's own clock goes on while a run is stopped
    at = scalar.seconds if x == "time" and run.episodes is None else _located(run, scalar.steps, x)
    kept = np.isfinite(scalar.values) & (scalar.steps <= (math.inf if max_steps is None else max_steps))
    return at[kept], scalar.values[kept]


# ----------------------------------------------------------------------------------------------------------------------
# Figures
# ----------------------------------------------------------------------------------------------------------------------


def _draw(axes: Axes, curves: Sequence[Curve], labels: Sequence[str]) -> None:
    n_runs = sum(len(curve.seeds) for curve in curves)
    for curve in curves:
        style = line_style(labels.index(curve.label))
        if len(curve.seeds) > 1:
            for x, y in curve.seeds:  # of many runs none is to hide what is told of all
                axes.plot(x, y, color=style["color"], linewidth=0.7, alpha=min(0.35, 6 / n_runs))
            if len(curve.low):
                axes.fill_between(curve.x, curve.low, curve.high, color=style["color"], alpha=0.15, linewidth=0)
        marker = "o" if len(curve.x) <= 40 else None
        axes.plot(curve.x, curve.y, **style, marker=marker, markersize=3, label=curve.label)


def _name(curve: Curve) -> str:
    n = len(curve.seeds)
    return curve.label if n == 1 else f"{curve.label}, {n} seeds"


def _scale_x(axes: Axes, x: XAxis, right: float | None = None) -> None:
    """Label, unit and limits of the x axis, to its data or a given end. Curves hold seconds; ticks say hours, minutes or s."""
    axes.margins(x=0.02)  # room for half a marker
    axes.set_xlim(0, right)
    if x == "time":
        right = axes.get_xlim()[1]
        unit, size = next((u, s) for u, s in (("hours", 3600), ("minutes", 60), ("seconds", 1)) if right >= 2 * s or s == 1)
        ticks = np.asarray(MaxNLocator(8, steps=[1, 2, 5, 10]).tick_values(0, right / size))
        ticks = ticks[ticks <= right / size + 1e-9]
        axes.set_xticks(ticks * size, [f"{tick:g}" for tick in ticks])
        axes.set_xlabel(f"wall-clock time ({unit})")
    else:
        axes.xaxis.set_major_formatter(EngFormatter(sep=""))
        axes.set_xlabel(_X_LABELS[x])


def _explained(curves: Sequence[Curve], smoothed: str) -> str:
    parts = [smoothed] if smoothed else []
    if any(len(curve.seeds) > 1 for curve in curves):
        parts.append("bold: interquartile mean over seeds, while all run; band: its 95 % bootstrap interval; faint: each seed")
    return "; ".join(parts)


def plot_curves(panels: dict[str, list[Curve]], x: XAxis, y: YAxis, smoothed: str, output: Path) -> Path:
    """
    Draw curves, one panel for each environment.

    :param panels: title of each panel → its curves
    :param x: what their x is; seconds for ``"time"``
    :param y: what their y is
    :param smoothed: how the curves were smoothed, for the note under the figure
    :param output: image file, its kind told by its suffix
    :return: the image file
    :raises ValueError: for an unknown kind of image
    """
    with house_style():
        columns = min(len(panels), 2)
        rows = -(-len(panels) // columns)
        figure = new_figure(7.0 if columns == 1 else 5.2 * columns, 3.8 * rows if columns == 1 else 3.2 * rows)
        labels = list(dict.fromkeys(curve.label for curves in panels.values() for curve in curves))
        for number, (title, curves) in enumerate(panels.items(), 1):
            axes = figure.add_subplot(rows, columns, number)
            _draw(axes, curves, labels)
            axes.set_title(title)
            axes.set_ylabel(_Y_LABELS[y])
            if y == "success":
                axes.set_ylim(0, 1.02)
                axes.yaxis.set_major_formatter(PercentFormatter(1.0))
            _scale_x(axes, x)
        note(figure, _explained([curve for curves in panels.values() for curve in curves], smoothed))
        for axes, curves in zip(figure.axes, panels.values(), strict=True):
            ends = [(_name(c), _end_value(c), line_style(labels.index(c.label))) for c in curves]
            name_lines(figure, axes, ends)
        return save(figure, output)


def _end_value(curve: Curve) -> float:
    values = curve.y if len(curve.y) else max(curve.seeds, key=lambda seed: len(seed[0]))[1]
    return float(values[-1])


def plot_scalars(panels: dict[str, list[Curve]], x: XAxis, output: Path, title: str = "") -> Path:
    """
    Draw logged quantities as small multiples.

    :param panels: tag of each quantity, such as ``train/approx_kl`` → its curves
    :param x: what their x is; seconds for ``"time"``
    :param output: image file, its kind told by its suffix
    :param title: of the figure
    :return: the image file
    :raises ValueError: for an unknown kind of image
    """
    with house_style():
        columns = min(len(panels), 3)
        rows = -(-len(panels) // columns)
        figure = new_figure(3.4 * columns, 2.2 * rows + 0.2)
        every = [curve for curves in panels.values() for curve in curves]
        names = {curve.label: _name(curve) for curve in every}
        labels = list(names)
        for number, (tag, curves) in enumerate(panels.items(), 1):
            axes = figure.add_subplot(rows, columns, number)
            _draw(axes, curves, labels)
            name, unit = SCALARS.get(tag, (tag, ""))
            axes.set_title(name)
            axes.set_ylabel(unit)
            axes.margins(x=0.02)
        right = max(axes.get_xlim()[1] for axes in figure.axes)
        for number, axes in enumerate(figure.axes):
            _scale_x(axes, x, right)
            if number < len(panels) - columns:
                axes.set_xlabel("")  # said below, in the same column
        if len(labels) > 1:
            _legend(figure, names, title)
        else:
            heading = _folded(figure, f"{title}: {names[labels[0]]}")
            figure.suptitle(heading, fontsize=9, x=0.01, ha="left")
        note(figure, _explained(every, ""))
        return save(figure, output)


def _legend(figure: Figure, names: dict[str, str], title: str) -> None:
    """Heading and names of all lines above the panels, in as many columns as there is room for."""
    handles = {line.get_label(): line for axes in figure.axes for line in axes.lines}
    lines = [handles[label] for label in names]
    texts = [_folded(figure, name) for name in names.values()]
    for columns in range(len(names), 0, -1):
        legend = figure.legend(lines, texts, loc="outside upper left", ncols=columns, title=title, alignment="left")
        if columns == 1 or legend.get_window_extent().width < figure.bbox.width:
            break
        legend.remove()
    figure.set_figheight(figure.get_figheight() + legend.get_window_extent().height / figure.dpi)
    for number, text in enumerate(legend.get_texts()):
        text.set_color(line_style(number)["color"])


def _folded(figure: Figure, text: str) -> str:
    return textwrap.fill(text, int(figure.get_figwidth() * 14))  # letters of this size in a line


def _title(run: Run) -> str:
    return f"{run.algo} on {run.env}" + ("" if run.seed is None else f", seed {run.seed}")


def plot_training(folder: Path, output: Path | None = None) -> Path:
    """
    Draw one run: returns of its training episodes and evaluations against environment steps.

    :param folder: run folder
    :param output: image file, ``training.png`` in the run folder if not given
    :return: the image file
    :raises ValueError: if the folder is no run folder, or a file in it is damaged
    """
    run = open_run(folder)
    with house_style():
        figure = new_figure(7.0, 3.8)
        axes = figure.add_subplot()
        ends = []
        if run.episodes is not None and len(run.episodes.steps):
            steps, mean = episode_curve(run, "steps", "reward", window=20)
            axes.plot(run.episodes.steps, run.episodes.returns, ".", color=COLORS[0], alpha=0.3, markersize=4, linewidth=0)
            axes.plot(steps, mean, **line_style(0))
            ends.append(("training,\nmean of 20", float(mean[-1]), line_style(0)))
        if run.evaluations is not None and len(run.evaluations.steps):
            returns = run.evaluations.returns
            axes.errorbar(
                run.evaluations.steps,
                returns.mean(axis=1),
                returns.std(axis=1),
                color=COLORS[1],
                fmt="o-",
                markersize=3.5,
                linewidth=1.2,
                capsize=2,
                elinewidth=0.8,
            )
            ends.append(("evaluation", float(returns[-1].mean()), {"color": COLORS[1]}))
            note(
                figure,
                f"dots: training episodes; evaluation: mean ± standard deviation of {returns.shape[1]} episodes, "
                "deterministic policy",
            )
        if not ends:
            axes.text(0.5, 0.5, "no finished episode", ha="center", va="center", transform=axes.transAxes)
        axes.set_title(_title(run))
        axes.set_ylabel(_Y_LABELS["reward"])
        _scale_x(axes, "steps")
        name_lines(figure, axes, ends)
        return save(figure, output or folder / "training.png")
