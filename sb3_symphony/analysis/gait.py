"""
Gait of a two-legged walker: numbers and a figure, from the course of ground contacts and joint angles.

Terms are those of gait analysis: a *strike* is the beginning of a ground contact, a *stride* lasts from one strike of a
foot to its next, its *stance* is the part of it with ground contact, the rest is the *swing*.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.offsetbox import AnnotationBbox, OffsetImage

from sb3_symphony.analysis.style import COLORS, house_style, new_figure, note, save

#: A foot that leaves the ground for less bounces, it does not swing (seconds)
SHORTEST_SWING = 0.1
#: A foot that touches the ground for less scuffs, it does not stand (seconds)
SHORTEST_STANCE = 0.06

LEGS = ("left", "right")
_LEG_COLORS = (COLORS[1], COLORS[0])
_LEG_DASHES = ((0, (3.5, 1)), "-")  # told apart in greyscale too


@dataclass(frozen=True)
class Recording:
    """
    Some time of an agent's walking, step by step. The walker is seen from its right; legs are (left, right).

    :param label: what the agent is called
    :param steps_per_second: of the simulated world
    :param start: time of the first step since the episode began, in seconds
    :param contact: whether each lower leg touches the ground, shape ``(n, 2)``
    :param hip: flexion of the hips in degrees, > 0 with the leg in front, shape ``(n, 2)``
    :param knee: flexion of the knees in degrees, 0 with the leg straight, shape ``(n, 2)``
    :param position: way walked by the hull, in metres of the simulated world, shape ``(n,)``
    :param pictures: step → picture, shape ``(height, width, 3)``
    """

    label: str
    steps_per_second: float
    start: float
    contact: np.ndarray
    hip: np.ndarray
    knee: np.ndarray
    position: np.ndarray
    pictures: dict[int, np.ndarray]

    @property
    def times(self) -> np.ndarray:
        """Time of each step since the episode began, in seconds, shape ``(n,)``."""
        return self.start + np.arange(len(self.contact)) / self.steps_per_second


@dataclass(frozen=True)
class LegNumbers:
    """
    One leg. What a leg without a whole stride does not have is nan.

    :param strides: number of whole strides
    :param stride_time: mean duration of a stride, in seconds
    :param stance_time: mean ground contact in a stride, in seconds
    :param duty_factor: share of the strides' time with ground contact
    :param hip_range: largest minus smallest hip flexion, in degrees
    :param knee_range: largest minus smallest knee flexion, in degrees
    """

    strides: int
    stride_time: float
    stance_time: float
    duty_factor: float
    hip_range: float
    knee_range: float


@dataclass(frozen=True)
class GaitNumbers:
    """
    A gait in numbers.

    :param seconds: time that was analysed
    :param cadence: steps (strikes of either foot) per minute
    :param speed: metres per second
    :param stride_length: metres per stride, speed times the mean stride time of both legs
    :param duty_factor: mean of both legs'; > 0.5 is walking, < 0.5 running
    :param double_support: share of the time with both feet on the ground
    :param flight: share of the time with no foot on the ground
    :param phase: when, as a share of the left foot's stride, the right one strikes; 0.5 is a perfect alternation
    :param symmetry: symmetry index of stance time, hip range and knee range, 2·|left - right| / (left + right) in percent; 0
        is perfect symmetry
    :param left: left leg
    :param right: right leg
    """

    seconds: float
    cadence: float
    speed: float
    stride_length: float
    duty_factor: float
    double_support: float
    flight: float
    phase: float
    symmetry: dict[str, float]
    left: LegNumbers
    right: LegNumbers


# ----------------------------------------------------------------------------------------------------------------------
# Numbers
# ----------------------------------------------------------------------------------------------------------------------


def _without_short(contact: np.ndarray, value: bool, shortest: int) -> np.ndarray:
    """Stretches of ``value`` between others of at least one step each, shorter than ``shortest``, are turned over."""
    edges = np.flatnonzero(np.diff(contact.astype(int))) + 1
    result = contact.copy()
    for first, last in pairwise(edges):  # first and last stretch are cut off, not short
        if contact[first] == value and last - first < shortest:
            result[first:last] = not value
    return result


def steady_contact(contact: np.ndarray, steps_per_second: float) -> np.ndarray:
    """
    Ground contact without bounces (swings shorter than :data:`SHORTEST_SWING`) and, after that, without scuffs (stances
    shorter than :data:`SHORTEST_STANCE`).

    :param contact: of one leg, shape ``(n,)``
    :param steps_per_second: of the simulated world
    :return: shape ``(n,)``
    """
    closed = _without_short(contact.astype(bool), False, round(SHORTEST_SWING * steps_per_second))
    return _without_short(closed, True, round(SHORTEST_STANCE * steps_per_second))


def strikes(contact: np.ndarray) -> np.ndarray:
    """
    :param contact: of one leg, shape ``(n,)``
    :return: steps at which it begins; a contact that was there from the start does not count
    """
    return np.flatnonzero(contact[1:] & ~contact[:-1]) + 1


def _leg(contact: np.ndarray, hip: np.ndarray, knee: np.ndarray, steps_per_second: float) -> LegNumbers:
    at = strikes(contact)
    n_strides = max(len(at) - 1, 0)
    stride = stance = duty = float("nan")
    if n_strides:
        whole = contact[at[0] : at[-1]]
        stride, stance = len(whole) / n_strides / steps_per_second, whole.sum() / n_strides / steps_per_second
        duty = float(whole.mean())
    return LegNumbers(n_strides, stride, float(stance), duty, float(np.ptp(hip)), float(np.ptp(knee)))


def _index(left: float, right: float) -> float:
    return float(200 * abs(left - right) / (left + right)) if left + right else float("nan")


def _phase(left: np.ndarray, right: np.ndarray) -> float:
    """Mean over the left foot's strides of when the right one strikes, averaged on the circle: 0.99 and 0.01 give 0."""
    phases = [(at - first) / (last - first) for first, last in pairwise(left) for at in right if first <= at < last]
    if not phases:
        return float("nan")
    angle = float(np.angle(np.exp(2j * np.pi * np.array(phases)).mean()) / (2 * np.pi))
    return angle % 1.0


def gait_numbers(recording: Recording) -> GaitNumbers:
    """
    :param recording: some time of walking, at least two steps
    :return: its numbers; nan where there was no whole stride
    """
    per_second = recording.steps_per_second
    contact = np.stack([steady_contact(recording.contact[:, leg], per_second) for leg in (0, 1)], axis=1)
    at = [strikes(contact[:, leg]) for leg in (0, 1)]
    left, right = (_leg(contact[:, leg], recording.hip[:, leg], recording.knee[:, leg], per_second) for leg in (0, 1))
    seconds = len(contact) / per_second
    speed = float(recording.position[-1] - recording.position[0]) / ((len(contact) - 1) / per_second)
    on_ground = contact.sum(axis=1)
    return GaitNumbers(
        seconds=seconds,
        cadence=60 * sum(map(len, at)) / seconds,
        speed=speed,
        stride_length=speed * (left.stride_time + right.stride_time) / 2,
        duty_factor=(left.duty_factor + right.duty_factor) / 2,
        double_support=float((on_ground == 2).mean()),
        flight=float((on_ground == 0).mean()),
        phase=_phase(*at),
        symmetry={
            name: _index(getattr(left, name), getattr(right, name)) for name in ("stance_time", "hip_range", "knee_range")
        },
        left=left,
        right=right,
    )


# ----------------------------------------------------------------------------------------------------------------------
# Figure
# ----------------------------------------------------------------------------------------------------------------------


def _draw_pictures(axes: Axes, recording: Recording, n_pictures: int) -> None:
    """In even distances, each above its time, as large as fits; the panel has its final size."""
    figure = axes.figure
    width = axes.get_window_extent().width * 72 / figure.dpi / n_pictures  # points for each
    for slot, (_, picture) in enumerate(sorted(recording.pictures.items())):
        image = OffsetImage(picture, zoom=0.95 * width / picture.shape[1])
        axes.add_artist(
            AnnotationBbox(image, ((slot + 0.5) / n_pictures, 0.5), xycoords="axes fraction", frameon=False, pad=0)
        )


def _draw_contact(axes: Axes, recording: Recording) -> None:
    """Bars as long as the foot is on the ground."""
    for row, leg in ((1, 0), (0, 1)):
        edges = np.flatnonzero(np.diff(np.concatenate([[0], recording.contact[:, leg].astype(int), [0]])))
        length = 1 / recording.steps_per_second
        bars = [(recording.start + a * length, (b - a) * length) for a, b in edges.reshape(-1, 2)]
        axes.broken_barh(bars, (row - 0.35, 0.7), facecolors=_LEG_COLORS[leg], linewidth=0)
    axes.set_yticks([1, 0], LEGS)
    for tick, color in zip(axes.get_yticklabels(), _LEG_COLORS, strict=False):  # the first column has them only
        tick.set_color(color)
    axes.set_ylim(-0.6, 1.6)
    axes.grid(axis="y", visible=False)


def plot_gait(recordings: Sequence[Recording], numbers: Sequence[GaitNumbers], output: Path) -> Path:
    """
    Draw gaits side by side: pictures, ground contact of both feet, and flexion of hips and knees over time.

    :param recordings: one for each agent, at least one; all of their steps are drawn
    :param numbers: what to say about each agent
    :param output: image file, its kind told by its suffix
    :return: the image file
    :raises ValueError: for an unknown kind of image
    """
    with house_style():
        columns = len(recordings)
        width = 7.0 if columns == 1 else 4.6 * columns
        n_pictures = max(len(recording.pictures) for recording in recordings)
        strip = [0.85 * width / columns / n_pictures] if n_pictures else []
        heights = [*strip, 0.55, 1.3, 1.3]  # inches
        figure = new_figure(width, sum(heights) + 1.4)
        grid = figure.subplots(len(heights), columns, squeeze=False, sharex="col", sharey="row", height_ratios=heights)
        for column, recording, own in zip(grid.T, recordings, numbers, strict=True):
            contact, hip, knee = column[-3:]
            column[0].set_title(f"{recording.label}\n{_in_short(own)}")
            _draw_contact(contact, recording)
            for axes, angles in ((hip, recording.hip), (knee, recording.knee)):
                for leg in (0, 1):
                    style = {"color": _LEG_COLORS[leg], "linestyle": _LEG_DASHES[leg]}
                    axes.plot(recording.times, angles[:, leg], linewidth=1.4, **style)
            knee.set_xlabel("time in the episode (s)")
            knee.set_xlim(recording.times[0], recording.times[-1] + 1 / recording.steps_per_second)
        for axes, label in zip(grid[-3:, 0], ("ground\ncontact", "hip flexion (°)", "knee flexion (°)"), strict=True):
            axes.set_ylabel(label)
        figure.align_ylabels(grid[-3:, 0])
        note(
            figure,
            "left: the far leg, right: the near one; contact as the lower legs sense it; flexion > 0: leg in front, knee bent",
        )
        if n_pictures:
            for axes in grid[0]:
                axes.axis("off")
            figure.draw_without_rendering()
            for axes, recording in zip(grid[0], recordings, strict=True):
                _draw_pictures(axes, recording, n_pictures)
        return save(figure, output)


def _in_short(numbers: GaitNumbers) -> str:
    parts = [f"{numbers.cadence:.0f} steps/min"]
    parts += [f"duty factor {numbers.duty_factor:.2f}"] if math.isfinite(numbers.duty_factor) else []
    parts += [f"phase {numbers.phase:.2f}"] if math.isfinite(numbers.phase) else []
    return ", ".join([*parts, f"{numbers.speed:.1f} m/s"])
