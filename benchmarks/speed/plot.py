"""
A figure of the speed benchmarks: each contestant's time per update, and where the time of a training step goes.

    python benchmarks/speed/plot.py benchmarks/results/speed docs/images/speed.png
"""

import json
import sys
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt

TITLES = {
    "redq": "REDQ's size: 10 critics, 2×256, batch 256",
    "walker": "BipedalWalker settings: 2 critics, 2×128, LayerNorm, batch 128",
    "symphony": "Symphony's defaults: 2 critics, 2×256, batch 128",
}
OURS, PEERS, FLOOR = "#0072b2", "#999999", "#d55e00"
PARTS = {
    "critics": "#0072b2",
    "target": "#56b4e9",
    "actor": "#009e73",
    "sampling": "#f0e442",
    "rest of train()": "#e69f00",
    "acting": "#cc79a7",
    "environment": "#d55e00",
    "others": "#999999",
}


def draw_updates(axes: plt.Axes, rows: list[dict], title: str) -> None:
    """Horizontal bars of one setting's ``train`` column, the fastest on top; those over 6 times ours are cut."""
    rows = sorted((row for row in rows if row["column"] == "train"), key=lambda row: -row["ms"])
    ours = next(row["ms"] for row in rows if row["contestant"] == "ours, fused")
    limit = min(rows[0]["ms"], 6 * ours)
    for i, row in enumerate(rows):
        name = row["contestant"]
        color = OURS if name.startswith("ours") else FLOOR if name == "bare products" else PEERS
        axes.barh(i, min(row["ms"], limit), color=color)
        axes.text(min(row["ms"], limit), i, f" {row['ms']:.3g} ms, ×{row['times_ours']:.2f}", va="center", fontsize=8)
    axes.set_yticks(range(len(rows)), [row["contestant"] for row in rows], fontsize=8)
    axes.set_xlim(0, 1.35 * limit)
    axes.set_xlabel("milliseconds per update; × relative to ours, fused")
    axes.set_title(title, fontsize=10, loc="left")


def draw_steps(axes: plt.Axes, rows: list[dict]) -> None:
    """One stacked bar per algorithm and ratio."""
    labels = [f"{row['algorithm']}, {row['ratio']} per step\n{row['steps_per_second']:.0f} steps/s" for row in rows]
    left = [0.0] * len(rows)
    for part, color in PARTS.items():
        widths = []
        for row in rows:
            times = row["microseconds_per_step"]
            value = times.get(part, sum(time for name, time in times.items() if name not in PARTS))
            widths.append(100 * value / sum(times.values()))
        axes.barh(range(len(rows)), widths, left=left, color=color, label=part)
        left = [a + b for a, b in zip(left, widths, strict=True)]
    axes.set_yticks(range(len(rows)), labels, fontsize=8)
    axes.invert_yaxis()
    axes.set_xlim(0, 100)
    axes.set_xlabel("share of a training step on BipedalWalker-v3, %")
    axes.set_title("Where the time goes", fontsize=10, loc="left")
    axes.legend(ncols=4, fontsize=8, loc="upper center", bbox_to_anchor=(0.5, -0.15), frameon=False)


def main(folder: Path, output: Path) -> None:
    updates = json.loads((folder / "updates_quick.json").read_text())["rows"]
    figure, axes = plt.subplots(2, 2, figsize=(13, 9), layout="constrained")
    for place, (name, title) in zip(axes.flat, TITLES.items(), strict=False):
        draw_updates(place, [row for row in updates if row["name"] == name], title)
    draw_steps(axes[1, 1], json.loads((folder / "steps.json").read_text())["rows"])
    for place in axes.flat:
        place.spines[["top", "right"]].set_visible(False)
    output.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(output, dpi=120)


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:]))
