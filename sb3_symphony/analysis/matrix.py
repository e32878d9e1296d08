"""Final models of a study under several conditions: a table, a heat map and lines."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from sb3_symphony.analysis.statistics import summarise
from sb3_symphony.analysis.style import house_style, line_style, name_lines, new_figure, note, save
from sb3_symphony.analysis.tables import Result, Row, aligned, by_algorithm


def _conditions(result: Result) -> dict[str, list[float]]:
    """Returns under each condition that it was evaluated under."""
    evaluated = (result.summary or {}).get("conditions", {})
    return {name: each["returns"] for name, each in evaluated.items()}


def matrix_rows(results: Sequence[Result]) -> list[Row]:
    """
    :param results: runs
    :return: a row for each of them and each condition it was evaluated under
    """
    rows: list[Row] = []
    for each in results:
        for name, returns in _conditions(each).items():
            summary = summarise(returns)
            rows.append(
                {
                    **{"algorithm": each.algorithm, "environment": each.environment, "seed": each.seed, "condition": name},
                    **{"episodes": summary.n, "mean": summary.mean, "std": summary.std, "iqm": summary.iqm},
                }
            )
    return rows


def _entries(results: Sequence[Result], name: str) -> np.ndarray | None:
    """Returns under a condition of all seeds, shape ``(seeds · episodes,)``."""
    returns = [own[name] for each in results if name in (own := _conditions(each))]
    return np.concatenate(returns, dtype=np.float64) if returns else None


def matrix_table(results: Sequence[Result], names: Sequence[str], label: str) -> str:
    """
    :param results: runs on one environment, in the order of its rows
    :param names: names of the conditions
    :param label: what they are
    :return: heading and table of mean ± standard deviation over all episodes of all seeds
    """
    rows = [[f"{label}:", *names]]
    for algorithm, own in by_algorithm(results).items():
        entries = [_entries(own, name) for name in names]
        rows.append([algorithm, *("–" if each is None else f"{each.mean():.0f} ± {each.std():.0f}" for each in entries)])
    lines = [
        "- return, mean ± standard deviation of all episodes of all seeds that are done, deterministic, the same episodes"
    ]
    return "\n".join([f"### {results[0].environment}: {label}", "", *aligned(rows), "", *lines, ""])


def positions(names: Sequence[str]) -> np.ndarray:
    """
    :param names: names of conditions
    :return: where they are on an axis: at their values if all are numbers, else evenly, shape ``(n,)``
    """
    try:
        return np.array([float(name) for name in names])
    except ValueError:
        return np.arange(len(names), dtype=float)


def plot_matrix(results: Sequence[Result], names: Sequence[str], label: str, output: Path) -> Path | None:
    """
    Draw a heat map of mean returns, and beside it the same as lines, with the standard deviation over episodes.

    :param results: runs
    :param names: names of the conditions
    :param label: what they are
    :param output: image file; removed if there is nothing to draw
    :return: the image file, None if there is nothing to draw
    """
    several = len({each.environment for each in results}) > 1
    rows: dict[str, list[np.ndarray | None]] = {}
    for environment in dict.fromkeys(each.environment for each in results):
        for algorithm, own in by_algorithm([each for each in results if each.environment == environment]).items():
            entries = [_entries(own, name) for name in names]
            if any(each is not None for each in entries):
                rows[f"{algorithm} on {environment}" if several else algorithm] = entries
    if not rows:
        output.unlink(missing_ok=True)
        return None
    with house_style():
        figure = new_figure(10.4, max(3.4, 0.42 * len(rows) + 2))
        ends = _draw(figure, rows, names, label)
        note(figure, "mean return of the final models' episodes, deterministic; bars: standard deviation over episodes")
        name_lines(figure, figure.axes[1], ends)
        return save(figure, output)


def _draw(
    figure: Figure, rows: dict[str, list[np.ndarray | None]], names: Sequence[str], label: str
) -> list[tuple[str, float, dict[str, Any]]]:
    """:return: name, right-most value and style of each line"""
    heat, lines = figure.subplots(1, 2, width_ratios=(1.25, 1))
    means = np.array([[np.nan if each is None else each.mean() for each in entries] for entries in rows.values()])
    heat.imshow(means, aspect="auto", cmap="cividis")
    low, high = np.nanmin(means), np.nanmax(means)
    for (row, column), value in np.ndenumerate(means):
        if np.isfinite(value):
            dark = value < (low + high) / 2
            heat.text(column, row, f"{value:.0f}", ha="center", va="center", fontsize=8, color="white" if dark else "black")
    heat.set_xticks(range(len(names)), names)
    heat.set_yticks(range(len(rows)), list(rows))
    heat.set_xlabel(label)
    heat.set_title("mean return")
    heat.grid(visible=False)

    at = positions(names)
    to_the_right = np.argsort(at, kind="stable")
    ends = []
    for index, (name, entries) in enumerate(rows.items()):
        known = [i for i in to_the_right if entries[i] is not None]
        spread = [each.std() for i in known if (each := entries[i]) is not None]
        style = line_style(index)
        lines.errorbar(at[known], means[index, known], spread, **style, marker="o", markersize=3, elinewidth=0.6, capsize=2)
        ends.append((name, float(means[index, known[-1]]), style))
    lines.set_xticks(at, names)
    lines.set_xlabel(label)
    lines.set_ylabel("return per episode")
    lines.set_title("the same as lines")
    return ends
