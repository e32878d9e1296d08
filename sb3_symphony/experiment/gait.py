"""How trained agents walk: sensors on BipedalWalker, for the numbers and the figure of :mod:`sb3_symphony.analysis.gait`."""

import math
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sb3_symphony.analysis.gait import GaitNumbers, Recording, gait_numbers, plot_gait
from sb3_symphony.analysis.style import SUFFIXES
from sb3_symphony.experiment.config import ConfigError
from sb3_symphony.experiment.output import columns, json_report, output_file, progress_bar
from sb3_symphony.experiment.select import GaitOptions
from sb3_symphony.experiment.video import Camera, Shown, show_agents

_SCALE = 30.0  # pixels per metre of BipedalWalker's pictures
_HULL_X = 120  # pixels from their left edge: the camera follows the hull
_HALF_WIDTH, _ABOVE, _BELOW = 75, 50, 100  # pixels around the hull that are cut out


class WalkerSensors(Camera):
    """
    Writes down what the legs of a BipedalWalker do in every step; takes pictures only while ``taking_pictures``.

    :param env: BipedalWalker, wrapped or not
    """

    def __init__(self, env: Any) -> None:
        super().__init__(env)
        self.taking_pictures = False
        self.contact: list[tuple[bool, bool]] = []
        self.joints: list[tuple[float, ...]] = []  # hip, knee, hip, knee in radians
        self.hull: list[tuple[float, float]] = []  # metres

    def _picture(self) -> np.ndarray:
        return super()._picture() if self.taking_pictures else np.empty(0)

    def reset(self, **kwargs: Any) -> tuple[Any, dict[str, Any]]:
        """
        :param kwargs: seed and options
        :return: first observation and info
        :raises ConfigError: if the environment is another one
        """
        result = super().reset(**kwargs)
        if not all(hasattr(self.env.unwrapped, name) for name in ("hull", "legs", "joints")):
            name = self.env.spec.id if self.env.spec else str(self.env.unwrapped)
            raise ConfigError(f"{name}: has no legs with sensors — expected BipedalWalker-v3 or BipedalWalkerHardcore-v3")
        return result

    def step(self, action: Any) -> Any:
        result = super().step(action)
        walker: Any = self.env.unwrapped
        upper_and_lower = walker.legs  # left upper, left lower, right upper, right lower
        self.contact.append((bool(upper_and_lower[1].ground_contact), bool(upper_and_lower[3].ground_contact)))
        self.joints.append(tuple(joint.angle for joint in walker.joints))
        self.hull.append(tuple(walker.hull.position))
        return result

    def close_up(self) -> np.ndarray:
        """:return: the walker cut out of the picture after the latest step"""
        middle = round(self.after_step.shape[0] - self.hull[-1][1] * _SCALE)
        padded = np.pad(self.after_step, [(_BELOW, _BELOW), (0, 0), (0, 0)], mode="edge")
        rows = slice(middle - _ABOVE + _BELOW, middle + _BELOW + _BELOW)
        return padded[rows, _HULL_X - _HALF_WIDTH : _HULL_X + _HALF_WIDTH]


@dataclass(frozen=True)
class Gait:
    """
    How an agent walked in one episode.

    :param label: what it is called
    :param model: its zip file
    :param seed: seed of the episode
    :param reward: return of the episode
    :param length: number of steps of the episode
    :param shown: the part of it that the figure shows
    :param numbers: of the episode without its beginning
    """

    label: str
    model: str
    seed: int
    reward: float
    length: int
    shown: Recording
    numbers: GaitNumbers

    def plain(self) -> dict[str, Any]:
        """:return: everything but the recordings, plain values; what is not known is NaN"""
        facts = {name: getattr(self, name) for name in ("label", "model", "seed", "reward", "length")}
        return {**facts, **asdict(self.numbers)}


def record_gait(shown: Shown, options: GaitOptions) -> Gait:
    """
    Let an agent walk one episode.

    :param shown: the agent, before :class:`WalkerSensors`
    :param options: seed, and which part of the episode to look at
    :return: how it walked
    :raises ConfigError: if the episode is too short for that
    """
    sensors = shown.camera
    assert isinstance(sensors, WalkerSensors)
    per_second = shown.steps_per_second
    skip = round(options.skip * per_second)
    n_shown = round(options.window * per_second)
    wanted = {round((i + 0.5) * n_shown / options.n_frames) for i in range(options.n_frames)}
    pictures = {}
    reward, length = 0.0, 0
    steps = shown.agent.episode(options.seed, options.deterministic)
    for step in progress_bar(steps, f"{shown.label} walks", options.progress, shown.most_steps(options.n_timesteps)):
        reward += step.reward
        if sensors.taking_pictures:
            pictures[length - skip] = sensors.close_up()
        length += 1
        sensors.taking_pictures = length - skip in wanted
        if length == options.n_timesteps:
            break
    if length < skip + 2:
        walked = f"{shown.label} walked for {length / per_second:.1f} s only on seed {options.seed}"
        cut = f", as -n {length} wants" if length == options.n_timesteps else ""
        raise ConfigError(f"--skip: {options.skip:g} s — {walked}{cut}")
    joints = np.degrees(sensors.joints)  # Box2D turns legs forward, knees backward
    contact = np.array(sensors.contact)

    def part(first: int, last: int) -> Recording:
        return Recording(
            label=shown.label,
            steps_per_second=per_second,
            start=(first + 1) / per_second,
            contact=contact[first:last],
            hip=joints[first:last, [0, 2]],
            knee=-joints[first:last, [1, 3]],
            position=np.array(sensors.hull)[first:last, 0],
            pictures=pictures,
        )

    whole, seen = part(skip, length), part(skip, min(skip + n_shown, length))
    model = str(shown.agent.selection.model)
    return Gait(shown.label, model, options.seed, reward, length, seen, gait_numbers(whole))


def _table(gaits: Sequence[Gait]) -> str:
    """Numbers of all agents, one column each."""

    def told(value: float, digits: int) -> str:
        return "–" if math.isnan(value) else f"{value:.{digits}f}"

    rows = [("", *(gait.label for gait in gaits)), ("return", *(told(gait.reward, 1) for gait in gaits))]
    for name, field, digits in (
        ("cadence (steps/min)", "cadence", 0),
        ("speed (m/s)", "speed", 2),
        ("stride length (m)", "stride_length", 2),
        ("duty factor", "duty_factor", 2),
        ("double support (share of time)", "double_support", 2),
        ("flight (share of time)", "flight", 2),
        ("phase, left to right (0.5: alternating)", "phase", 2),
    ):
        rows.append((name, *(told(getattr(gait.numbers, field), digits) for gait in gaits)))
    for name, field, digits in (
        ("strides, left / right", "strides", 0),
        ("duty factor, left / right", "duty_factor", 2),
        ("hip range (°), left / right", "hip_range", 0),
        ("knee range (°), left / right", "knee_range", 0),
    ):
        legs = [(gait.numbers.left, gait.numbers.right) for gait in gaits]
        rows.append((name, *(" / ".join(told(getattr(leg, field), digits) for leg in pair) for pair in legs)))
    for name in gaits[0].numbers.symmetry:
        words = name.replace("_", " ")
        rows.append((f"symmetry index of {words} (%)", *(told(gait.numbers.symmetry[name], 0) for gait in gaits)))
    return "\n".join(columns(rows, left=1))


def gait(options: GaitOptions) -> list[Gait]:
    """
    Let agents walk, and draw how they do.

    :param options: which agents, and which part of an episode to look at
    :return: how each of them walked; numbers are printed, and the figure is written
    :raises ConfigError: if an agent cannot be opened, is no walker, falls at once, or a file cannot be written
    """
    tell = json_report(options.json_file)
    with ExitStack() as cleanup:
        agents = show_agents(options, cleanup, WalkerSensors)
        selection = agents[0].agent.selection
        run = None if selection.shipped else selection.run
        default = run / "gait.png" if run is not None and len(agents) == 1 else Path("gait.png")
        output = output_file(options.output or default, "--output", SUFFIXES)
        gaits = [record_gait(shown, options) for shown in agents]
        try:
            plot_gait([gait.shown for gait in gaits], [gait.numbers for gait in gaits], output)
        except OSError as error:
            raise ConfigError(f"--output: '{output}' cannot be written — {error.strerror or error}") from None
        tell([gait.plain() for gait in gaits])
    if options.json_file != "-":
        print(f"{_table(gaits)}\n{output}")
    return gaits
