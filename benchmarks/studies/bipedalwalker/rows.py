"""
Runs compared by their ranks, as tables in Markdown: do three runs, or ten, tell anything?

    python benchmarks/studies/bipedalwalker/rows.py ablation    # each row against all runs of the shipped settings
    python benchmarks/studies/bipedalwalker/rows.py study       # each algorithm against Symphony, seed by seed

"By chance" is how often as many of all these runs, drawn at random, would be as late (or as early) together, by the sum of
their ranks: exact, one-sided, ties at half ranks. What is not reached within the steps compared is the latest there is.
"""

import argparse
import csv
import math
from collections.abc import Iterator
from itertools import combinations
from pathlib import Path

import numpy as np

from sb3_symphony.analysis.runs import read_evaluations

RESULTS = Path(__file__).parents[2] / "results"
SHIPPED = [("bipedalwalker", "symphony"), ("bipedalwalker_fresh", "symphony"), ("bipedalwalker_ablation", "shipped")]
ABLATION_STEPS, STUDY_STEPS = 40_000, 60_000


class Row:
    """
    Runs of one row.

    :param study: folder of its results
    :param name: its name there
    :param steps: environment steps that are looked at
    """

    def __init__(self, study: str, name: str, steps: int) -> None:
        cells = [cell for cell in _cells(study) if cell["algorithm"] == name]
        self.seeds = [int(cell["seed"]) for cell in cells]
        self.solved = [_reached(cell, "stable", "stable_step", steps) for cell in cells]  # S300, in steps
        self.first = [_reached(cell, "first", "first_episode", steps) for cell in cells]  # E300
        self._runs = [RESULTS / study / name / f"{cell['environment']}_{cell['seed']}" for cell in cells]
        self._steps = steps

    def falls(self) -> np.ndarray:
        """:return: evaluation episodes below 200 from the first evaluation of 200 on, and all of them"""
        return np.sum([_falls(run, self._steps) for run in self._runs], axis=0)


def _cells(study: str) -> Iterator[dict[str, str]]:
    """Those that are done."""
    with (RESULTS / study / "cells.csv").open(newline="") as file:
        yield from (cell for cell in csv.DictReader(file) if cell["done"] == "1")


def _names(study: str) -> list[str]:
    return list(dict.fromkeys(cell["algorithm"] for cell in _cells(study)))


def _reached(cell: dict[str, str], what: str, value: str, steps: int) -> float:
    there = cell[f"{what}_reached"] == "1" and float(cell[f"{what}_step"]) <= steps
    return float(cell[value]) if there else math.inf


def _falls(run: Path, steps: int) -> tuple[int, int]:
    evaluations = read_evaluations(run)
    assert evaluations is not None  # the run is done
    returns = evaluations.returns[evaluations.steps <= steps]
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
    share = min(late, early)
    return f"{'late' if late < early else 'early'}, {f'{share:.0%}' if share >= 0.005 else '< 1%'}"


def _told(values: list[float], scale: float) -> list[str]:
    """What is not reached is a dash."""
    return ["–" if math.isinf(value) else f"{value / scale:g}" for value in values]


def told(values: list[float], scale: float = 1) -> str:
    """In ascending order."""
    return ", ".join(_told(sorted(values), scale))


def _share(low: int, every: int) -> str:
    return f"{low} of {every}, {low / every:.0%}"


def ablation() -> str:
    """:return: a table in Markdown"""
    shipped = [Row(study, name, ABLATION_STEPS) for study, name in SHIPPED]
    solved, first = ([value for row in shipped for value in getattr(row, name)] for name in ("solved", "first"))
    falls = _share(*np.sum([row.falls() for row in shipped], axis=0))
    lines = [
        "| row | S300, thousands | by chance | first return of 300 in episode | by chance | evaluation episodes below 200 |",
        "|---|---|---|---|---|---|",
        f"| shipped, {len(solved)} runs | {told(solved, 1000)} | | {told(first)} | | {falls} |",
    ]
    for name in _names("bipedalwalker_ablation"):
        row = Row("bipedalwalker_ablation", name, ABLATION_STEPS)
        if name != "shipped" and len(row.solved) == 3:
            both = chance(row.solved, solved), chance(row.first, first)
            falls = _share(*row.falls())
            lines.append(f"| {name} | {told(row.solved, 1000)} | {both[0]} | {told(row.first)} | {both[1]} | {falls} |")
    return "\n".join(lines)


def study() -> str:
    """:return: two tables in Markdown"""
    names = [name for name in _names("bipedalwalker") if name != "droq-greedy"]  # which ran for half as many steps
    rows = {name: Row("bipedalwalker", name, STUDY_STEPS) for name in names}
    ours = rows["symphony"]
    tables = []
    for title, what, scale in (("S300, thousands", "solved", 1000), ("first return of 300 in episode", "first", 1)):
        lines = [f"| {title}, seed | {' | '.join(map(str, ours.seeds))} | by chance |", "|---" * (len(ours.seeds) + 2) + "|"]
        for name, row in rows.items():
            values = dict(zip(row.seeds, _told(getattr(row, what), scale), strict=True))
            against = chance(getattr(row, what), getattr(ours, what)) if row is not ours else ""
            lines.append(f"| {name} | {' | '.join(values.get(seed, '') for seed in ours.seeds)} | {against} |")
        tables.append("\n".join(lines))
    return "\n\n".join(tables)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Compare runs by their ranks.")
    parser.add_argument("which", choices=("ablation", "study"))
    print({"ablation": ablation, "study": study}[parser.parse_args().which]())
