"""Draws ``architecture.png``: the data flow of one update, and what the three algorithms put into each stage."""

from itertools import pairwise
from pathlib import Path

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import FancyArrowPatch, FancyBboxPatch, Rectangle

INK, GREY, LINE = "#1d2733", "#5b6673", "#9aa5b1"
PLAIN, LOOP, FRAME = "#eef1f4", "#dbe7f3", "#f7fafd"
ROWS = {"Symphony": "#1f4e8c", "REDQ": "#b4530a", "DroQ": "#2f6f4f"}

# centre, title, text: one column each
STAGES = (
    (2.05, "Environment", "act, clip to [−1, 1],\nscale to the Box"),
    (4.85, "Replay", "one draw of\nG · batch transitions"),
    (7.85, "Target", "y from target critics\nand next action"),
    (10.70, "Critics", "N stacked critics step\ntoward y, then Polyak"),
    (13.55, "Actor", "every policy_delay-th\nupdate, after the critics"),
)
WIDTH, HEIGHT, FLOW_Y = 2.4, 1.1, 5.6

CELLS = {
    "Symphony": (
        "actor plus clipped\nnoise, σ from 0.3 to 0",
        "fading: recent\ntransitions more often",
        "minimum of 2;\nonline actor, no noise",
        "2, sine blocks; ReHE\nof the batch mean",
        "ReHAE of the batch\nmean of the minimum",
    ),
    "REDQ": (
        "sample of the\nsquashed Gaussian",
        "uniform",
        "minimum of 2 drawn\nfrom 10, minus α log π",
        "10, ReLU;\nsquared error",
        "mean of all 10 minus\nα log π; then α",
    ),
    "DroQ": (
        "sample of the\nsquashed Gaussian",
        "uniform",
        "minimum of 2 with\ndropout, minus α log π",
        "2, ReLU, LayerNorm,\ndropout; squared error",
        "mean of both minus\nα log π; then α",
    ),
}
COUNTS = {
    "Symphony": "G = 3, + 40 per\nepisode; delay 1",
    "REDQ": "G = 20; delay 20",
    "DroQ": "G = 20; delay 20",
}


def draw(path: Path) -> None:
    """
    :param path: image file to write
    """
    figure = Figure(figsize=(10.4, 4.1))
    FigureCanvasAgg(figure)
    axes = figure.add_axes((0, 0, 1, 1))
    axes.set(xlim=(-1.45, 15.15), ylim=(0.75, 7.1))
    axes.axis("off")

    # The loop of G updates
    left, right = STAGES[2][0] - WIDTH / 2 - 0.16, STAGES[4][0] + WIDTH / 2 + 0.16
    axes.add_patch(
        Rectangle((left, FLOW_Y - 0.75), right - left, 1.83, facecolor=FRAME, edgecolor=LINE, linestyle=(0, (4, 3)))
    )
    axes.text(left + 0.15, FLOW_Y + 0.81, "G times per environment step", color=GREY, fontsize=8.5, va="center")

    for i, (x, title, text) in enumerate(STAGES):
        box = FancyBboxPatch(
            (x - WIDTH / 2, FLOW_Y - HEIGHT / 2),
            WIDTH,
            HEIGHT,
            boxstyle="round,pad=0,rounding_size=0.09",
            facecolor=LOOP if i > 1 else PLAIN,
            edgecolor=LINE,
        )
        axes.add_patch(box)
        axes.text(x, FLOW_Y + 0.29, title, color=INK, fontsize=11, weight="bold", ha="center", va="center")
        axes.text(x, FLOW_Y - 0.18, text, color=INK, fontsize=8.2, ha="center", va="center", linespacing=1.15)

    def arrow(start: tuple[float, float], end: tuple[float, float]) -> None:
        style = {"arrowstyle": "-|>", "mutation_scale": 12, "color": INK, "linewidth": 1.2, "shrinkA": 0, "shrinkB": 0}
        axes.add_patch(FancyArrowPatch(start, end, **style))

    for (x, *_), (following, *_) in pairwise(STAGES):
        arrow((x + WIDTH / 2 + 0.03, FLOW_Y), (following - WIDTH / 2 - 0.03, FLOW_Y))
    # The new actor acts next
    top = 6.88
    axes.plot([STAGES[4][0], STAGES[4][0], STAGES[0][0]], [FLOW_Y + HEIGHT / 2, top, top], color=INK, linewidth=1.2)
    arrow((STAGES[0][0], top), (STAGES[0][0], FLOW_Y + HEIGHT / 2 + 0.03))
    axes.text(4.85, top - 0.2, "updated actor", color=GREY, fontsize=8.5, ha="center", va="center")

    # What each algorithm puts into each stage
    for row, (name, colour) in enumerate(ROWS.items()):
        y = 4.0 - 1.3 * row
        axes.plot([-1.25, 14.95], [y + 0.62, y + 0.62], color=LINE, linewidth=0.7)
        axes.text(-1.2, y + 0.25, name, color=colour, fontsize=11, weight="bold", va="center")
        axes.text(-1.2, y - 0.05, COUNTS[name], color=GREY, fontsize=7.8, va="top", linespacing=1.15)
        for (x, *_), text in zip(STAGES, CELLS[name], strict=True):
            axes.text(x, y, text, color=INK, fontsize=8.5, ha="center", va="center", linespacing=1.2)
    figure.savefig(path, dpi=200, facecolor="white")


if __name__ == "__main__":
    draw(Path(__file__).with_name("architecture.png"))
