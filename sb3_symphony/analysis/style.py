"""House style of all figures: readable in print, in greyscale and for colour-blind readers; names stand at the lines."""

import textwrap
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.transforms import Affine2D, BboxTransformTo, ScaledTranslation
from scipy.optimize import isotonic_regression

from sb3_symphony.common.files import completed

#: Okabe and Ito's colours, the light ones darkened so that text in them is readable on white; the two blues differ in dashes
COLORS = ("#0072B2", "#D55E00", "#009E73", "#A8467F", "#2E8BBF", "#B27500", "#000000")
#: told apart in greyscale too
DASHES: tuple[Any, ...] = ("-", (0, (5, 1.5)), (0, (1, 1)), (0, (5, 1, 1, 1)), (0, (8, 2)), (0, (3, 1, 1, 1, 1, 1)))
GREY = "#555555"
SUFFIXES = (".png", ".svg", ".pdf")

_STYLE: dict[Any, Any] = {
    "font.size": 9,
    "axes.titlesize": 9,
    "axes.titlelocation": "left",
    "axes.labelsize": 9,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.linewidth": 0.6,
    "axes.grid": True,
    "grid.color": "#dddddd",
    "grid.linewidth": 0.5,
    "axes.axisbelow": True,
    "xtick.labelsize": 8,
    "ytick.labelsize": 8,
    "xtick.major.width": 0.6,
    "ytick.major.width": 0.6,
    "legend.frameon": False,
    "legend.fontsize": 8,
    "lines.linewidth": 1.8,
    "lines.solid_capstyle": "round",
    "text.parse_math": False,  # names of files and variants may have a $
    "svg.hashsalt": "sb3-symphony",  # the same figure gives the same file
}


@contextmanager
def house_style() -> Iterator[None]:
    """Draw in the house style inside the block; settings of the caller's own figures stay as they are."""
    with rc_context(_STYLE):
        yield


def new_figure(width: float, height: float) -> Figure:
    """
    :param width: inches
    :param height: inches
    :return: an empty figure that no display is needed for
    """
    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def save(figure: Figure, output: Path) -> Path:
    """
    :param figure: what to save
    :param output: image file, its kind told by its suffix; a file of that name is replaced once the new one is complete
    :return: the file
    :raises ValueError: if its name does not end in one of :data:`SUFFIXES`
    """
    if output.suffix.lower() not in SUFFIXES:
        raise ValueError(f"{output}: expected a name that ends in {', '.join(SUFFIXES)}")
    undated = {".png": {}, ".svg": {"Date": None}, ".pdf": {"CreationDate": None}}[output.suffix.lower()]
    with completed(output) as unfinished:
        figure.savefig(unfinished, dpi=200, metadata=undated)
    return output


def line_style(index: int) -> dict[str, Any]:
    """
    :param index: of a group of runs, from 0 on
    :return: colour and dashes, of which there are 42 pairs
    """
    return {"color": COLORS[index % len(COLORS)], "linestyle": DASHES[index % len(DASHES)]}


def note(figure: Figure, text: str) -> None:
    """
    Say under a figure what its lines are.

    :param figure: the figure
    :param text: what to say
    """
    width = int(figure.get_figwidth() * 17)  # letters of this size in a line
    figure.supxlabel(textwrap.fill(text, width), x=0.01, ha="left", fontsize=7.5, color=GREY)


def spread(positions: Sequence[float], sizes: Sequence[float]) -> np.ndarray:
    """
    Move things between 0 and 1 apart as little as needed (least squares), keeping their order. If there is not room for all,
    those at both ends stand outside.

    :param positions: their middles, shape ``(n,)``
    :param sizes: their extents, shape ``(n,)``
    :return: new positions, shape ``(n,)``
    """
    order = np.argsort(positions, kind="stable")
    extents = np.array(sizes, dtype=float)[order]
    offsets = np.cumsum(extents) - extents / 2
    if not len(order):
        return offsets
    # What is left of a position without all that comes before may not fall
    rising = isotonic_regression(np.array(positions, dtype=float)[order] - offsets).x
    free = 1 - extents.sum()
    lowest, highest = min(0.0, free / 2), max(free, free / 2)
    result = np.empty_like(offsets)
    result[order] = offsets + np.clip(rising, lowest, highest)
    return result


def name_lines(figure: Figure, axes: Axes, ends: Sequence[tuple[str, float, dict[str, Any]]]) -> None:
    """
    Write names at the right of a panel, behind a piece of each line and at the height where it ends; long ones in several
    lines.

    :param figure: the figure
    :param axes: the panel, everything drawn
    :param ends: name, last value and style of each line
    """
    if not ends:
        return
    figure.draw_without_rendering()  # settles limits and sizes
    to_axes = axes.transData + axes.transAxes.inverted()
    size = 8.5
    height = axes.get_window_extent().height * 72 / figure.dpi
    wished = [float(to_axes.transform((0.0, value))[1]) for _, value, _ in ends]
    names = [text if "\n" in text else textwrap.fill(text, 32) for text, _, _ in ends]
    sizes = [(1 + text.count("\n")) * size * 1.25 / height for text in names]
    placed = spread(wished, sizes)
    for text, (_, _, style), at in zip(names, ends, placed, strict=True):
        end = ScaledTranslation(1.0, at, BboxTransformTo(axes.bbox))  # a fraction of the panel, wherever its layout ends
        points = Affine2D().scale(1 / 72) + figure.dpi_scale_trans + end
        figure.add_artist(Line2D([5, 25], [0, 0], transform=points, **style))
        axes.annotate(
            text,
            (1.0, at),
            (30, 0),
            xycoords="axes fraction",
            textcoords="offset points",
            color=style["color"],
            fontsize=size,
            va="center",
            annotation_clip=False,
        )
