"""Figures from the files of runs; no algorithm is imported."""

import csv
import json
from pathlib import Path

import numpy as np
import yaml
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter

# Dark blue and orange: apart for colour-blind eyes and in greyscale print
_TRAINING, _EVALUATION = "#1f4e8c", "#d95f02"


def read_monitors(run: Path) -> tuple[np.ndarray, np.ndarray]:
    """
    Read the training episodes of a run, those of parallel environments merged by the time of their ends.

    :param run: run folder
    :return: environment steps at the end of each episode, summed over all environments, and the episodes' returns
    """
    episodes = []
    for path in run.glob("*.monitor.csv"):
        with path.open(encoding="utf-8", newline="") as lines:
            start = json.loads(lines.readline().removeprefix("#"))["t_start"]
            for row in csv.DictReader(lines):
                try:
                    episodes.append((start + float(row["t"]), int(row["l"]), float(row["r"])))
                except (TypeError, ValueError):
                    continue  # a line cut short by a crash
    episodes.sort()
    return np.cumsum([length for _, length, _ in episodes], dtype=np.int64), np.array([ret for _, _, ret in episodes])


def running_mean(values: np.ndarray, window: int) -> np.ndarray:
    """
    :param values: shape ``(n,)``
    :param window: number of values in a mean, fewer at the start
    :return: trailing means, shape ``(n,)``
    """
    sums = np.concatenate([[0.0], np.cumsum(values)])
    last = np.arange(1, len(values) + 1)
    first = np.maximum(last - window, 0)
    return (sums[last] - sums[first]) / (last - first)


def _title(run: Path) -> str:
    """Algorithm, environment and seed, or the folder's name if they are not recorded."""
    for path in run.glob("*/args.yml"):
        options = yaml.safe_load(path.read_text(encoding="utf-8"))
        return f"{options['algo']} on {options['env']}, seed {options['seed']}"
    return run.name


def plot_training(run: Path, output: Path | None = None, window: int = 20) -> Path:
    """
    Draw the returns of training episodes and evaluations against environment steps.

    :param run: run folder
    :param output: image file, ``training.png`` in the run folder if not given
    :param window: number of episodes in the running mean
    :return: the image file
    """
    steps, returns = read_monitors(run)
    figure = Figure(figsize=(7, 4.2), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    if len(steps):
        axes.plot(steps, returns, ".", color=_TRAINING, alpha=0.3, markersize=4, label="training episode")
        if len(steps) > 1:
            label = f"mean of the last {window} episodes"
            axes.plot(steps, running_mean(returns, window), color=_TRAINING, linewidth=1.8, label=label)
    evaluations = run / "evaluations.npz"
    if evaluations.exists():
        with np.load(evaluations) as data:
            at, results = data["timesteps"], data["results"]
        mean, spread = results.mean(axis=1), results.std(axis=1)
        label = f"evaluation, mean ± std of {results.shape[1]} episodes"
        axes.errorbar(at, mean, spread, fmt="o-", color=_EVALUATION, markersize=4, linewidth=1.2, capsize=2.5, label=label)
    if axes.has_data():
        figure.legend(loc="outside lower center", ncols=3, frameon=False, fontsize="small")  # beside the data, never over it
    else:
        axes.text(0.5, 0.5, "no finished episode", ha="center", va="center", transform=axes.transAxes)
    axes.set_title(_title(run))
    axes.set_xlabel("environment steps")
    axes.set_ylabel("return per episode (sum of raw rewards)")
    axes.set_xlim(left=0)
    axes.xaxis.set_major_formatter(EngFormatter(sep=""))
    axes.grid(alpha=0.25)
    output = output or run / "training.png"
    figure.savefig(output, dpi=150)
    return output
