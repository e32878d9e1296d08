"""
Each row of the ablation against all runs of the shipped settings, of whatever study: do three runs tell anything?

    python benchmarks/studies/bipedalwalker/rows.py

A column says how often three of all runs drawn by chance would be as late (or as early) together, by the sum of their ranks:
exact, one-sided, ties at half ranks. What is not reached within the ablation's steps is the latest there is.
"""

import csv
import math
from itertools import combinations
from pathlib import Path

import numpy as np

from sb3_symphony.analysis.runs import read_evaluations

RESULTS = Path(__file__).parents[2] / "results"
SHIPPED = [("bipedalwalker", "symphony"), ("bipedalwalker_fresh", "symphony"), ("bipedalwalker_ablation", "shipped")]
STEPS = 40_000


class Row:
    """
    Runs of one row.

    :param study: folder of its results
    :param name: its name there
    """

    def __init__(self, study: str, name: str) -> None:
        with (RESULTS / study / "cells.csv").open(newline="") as file:
            cells = [cell for cell in csv.DictReader(file) if cell["algorithm"] == name and cell["done"] == "1"]
        self.solved = [_reached(cell, "stable", "stable_step") for cell in cells]  # S300, in steps
        self.first = [_reached(cell, "first", "first_episode") for cell in cells]  # E300
        runs = [RESULTS / study / name / f"{cell['environment']}_{cell['seed']}" for cell in cells]
        self.low, self.every = np.sum([_falls(run) for run in runs], axis=0) if runs else (0, 0)


def _reached(cell: dict[str, str], what: str, value: str) -> float:
    there = cell[f"{what}_reached"] == "1" and float(cell[f"{what}_step"]) <= STEPS
    return float(cell[value]) if there else math.inf


def _falls(run: Path) -> tuple[int, int]:
    """Evaluation episodes below 200 from the first evaluation of 200 on, and all of them."""
    evaluations = read_evaluations(run)
    assert evaluations is not None  # the run is done
    returns = evaluations.returns[evaluations.steps <= STEPS]
    walking = returns[np.cumsum(returns.mean(axis=1) >= 200) > 0]
    return int((walking < 200).sum()), walking.size


def chance(runs: list[float], others: list[float]) -> str:
    """
    :param runs: values of a row's runs
    :param others: values of the runs that they are compared with
    :return: the rarer of "as late" and "as early" together
    """
    values = np.array(runs + others)
    ranks = [(values < value).sum() + (values == value).sum() / 2 for value in values]
    own = sum(ranks[: len(runs)])
    sums = np.array([sum(drawn) for drawn in combinations(ranks, len(runs))])
    late, early = (sums >= own).mean(), (sums <= own).mean()
    return f"{'late' if late < early else 'early'}, {min(late, early):.0%}"


def told(values: list[float], scale: float = 1) -> str:
    """In ascending order; what is not reached is a dash."""
    return ", ".join("–" if math.isinf(value) else f"{value / scale:g}" for value in sorted(values))


def table() -> str:
    """:return: a table in Markdown"""
    shipped = [Row(study, name) for study, name in SHIPPED]
    solved, first = ([value for row in shipped for value in getattr(row, name)] for name in ("solved", "first"))
    low, every = sum(row.low for row in shipped), sum(row.every for row in shipped)
    lines = [
        "| row | S300, thousands | by chance | first return of 300 in episode | by chance | evaluation episodes below 200 |",
        "|---|---|---|---|---|---|",
        f"| shipped, {len(solved)} runs | {told(solved, 1000)} | | {told(first)} | | {low} of {every}, {low / every:.0%} |",
    ]
    with (RESULTS / "bipedalwalker_ablation" / "cells.csv").open(newline="") as file:
        names = dict.fromkeys(cell["algorithm"] for cell in csv.DictReader(file))
    for name in names:
        row = Row("bipedalwalker_ablation", name)
        if name != "shipped" and len(row.solved) == 3:
            both = chance(row.solved, solved), chance(row.first, first)
            falls = f"{row.low} of {row.every}, {row.low / row.every:.0%}"
            lines.append(f"| {name} | {told(row.solved, 1000)} | {both[0]} | {told(row.first)} | {both[1]} | {falls} |")
    return "\n".join(lines)


if __name__ == "__main__":
    print(table())
