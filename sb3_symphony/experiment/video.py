"""Films of trained agents, drawn without a display."""

import errno
import math
import os
import shutil
import subprocess
import sys
import tempfile
import warnings
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass
from importlib.util import find_spec
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from matplotlib.font_manager import findfont
from matplotlib.ticker import EngFormatter
from PIL import Image, ImageDraw, ImageFont
from stable_baselines3.common.atari_wrappers import MaxAndSkipEnv
from stable_baselines3.common.env_util import unwrap_wrapper

from sb3_symphony.analysis.runs import named_apart
from sb3_symphony.common.files import completed
from sb3_symphony.common.generators import generator_states, restore_generators
from sb3_symphony.experiment.agent import Agent, open_agent
from sb3_symphony.experiment.config import ConfigError, told
from sb3_symphony.experiment.output import check_folder, output_file, progress_bar
from sb3_symphony.experiment.run_folder import RunFolder, steps_in_name
from sb3_symphony.experiment.select import AgentsOptions, Selection, SelectOptions, VideoOptions

SUFFIXES = (".mp4", ".gif")
_HOLD = 1.0  # seconds that the last picture stays
_GIF_FPS = 50  # delays are in hundredths of a second, and players take one of a single hundredth for ten
_GAP = 4  # pixels between the agents of a grid


class Camera(gym.Wrapper):
    """
    Takes a picture after every reset and step. What was seen after a step outlasts the automatic reset that may follow.

    :param env: environment made with ``render_mode="rgb_array"``
    """

    def __init__(self, env: gym.Env) -> None:
        super().__init__(env)
        self.before_first: np.ndarray = np.empty(0)
        self.after_step: np.ndarray = np.empty(0)

    def _picture(self) -> np.ndarray:
        name = self.env.spec.id if self.env.spec else str(self.env.unwrapped)
        if "rgb_array" not in self.env.metadata.get("render_modes", []):
            raise ConfigError(f"{name}: draws no pictures — expected an environment with the render mode rgb_array")
        try:
            picture = self.env.render()
        except Exception as error:  # of the graphics library
            raise ConfigError(f"{name}: cannot be drawn on this machine — {told(error)}") from error
        return np.asarray(picture)

    def reset(self, **kwargs: Any) -> tuple[Any, dict[str, Any]]:
        result = self.env.reset(**kwargs)
        self.before_first = self._picture()
        return result

    def step(self, action: Any) -> Any:
        result = self.env.step(action)
        self.after_step = self._picture()
        return result


@dataclass
class Shown:
    """
    An agent before the camera.

    :param agent: the agent
    :param label: what it is called
    :param camera: the camera
    """

    agent: Agent
    label: str
    camera: Camera

    @property
    def steps_per_second(self) -> float:
        """Of the simulated world, as many as the agent acts."""
        skips = unwrap_wrapper(self.camera, MaxAndSkipEnv)
        return float(self.camera.metadata.get("render_fps") or 30) / (skips._skip if isinstance(skips, MaxAndSkipEnv) else 1)

    def most_steps(self, wanted: int | None) -> int | None:
        """
        :param wanted: where an episode is left, None: at its end
        :return: the most steps that it can have, None if nobody knows
        """
        limit = self.camera.spec.max_episode_steps if self.camera.spec else None
        return min((steps for steps in (limit, wanted) if steps is not None), default=None)


def _labels(selections: Sequence[Selection]) -> list[str]:
    """Algorithm and which of a run's models, environment and folder only where they differ: ``redq``, ``redq 4k steps``."""
    labels = []
    for selection in selections:
        label, steps = selection.algo, steps_in_name(selection.model)
        if selection.model.stem == "best_model":
            label += " best"
        elif steps is not None:
            label += f" {EngFormatter(sep='')(steps)} steps"
        if len({other.env_id for other in selections}) > 1:
            label += f" on {selection.env_id}"
        labels.append(label)
    return named_apart(labels, [selection.run or selection.model.with_suffix("") for selection in selections])


@contextmanager
def _without_display() -> Iterator[None]:
    """Let graphics libraries draw in memory where there is no display to ask."""
    missing = {}
    if sys.platform.startswith("linux") and not {"DISPLAY", "WAYLAND_DISPLAY"} & os.environ.keys():
        drivers = {"MUJOCO_GL": "egl", "SDL_VIDEODRIVER": "dummy", "SDL_AUDIODRIVER": "dummy"}
        missing = {name: driver for name, driver in drivers.items() if name not in os.environ}
    os.environ.update(missing)
    try:
        yield
    finally:
        for name in missing:
            del os.environ[name]


def show_agents(options: AgentsOptions, cleanup: ExitStack, camera_class: type[Camera] = Camera) -> list[Shown]:
    """
    Open the agents that are to be seen, each with a camera.

    :param options: which agents
    :param cleanup: closes their environments
    :param camera_class: the camera's class
    :return: the agents, whose labels differ
    :raises ConfigError: if one of them cannot be opened
    """
    if options.agents and options.model is not None:
        raise ConfigError(f"--model: '{options.model}' — expected either --model or {options.agents[0]}, not both")
    cleanup.enter_context(_without_display())
    shown = []
    models: list[str | None] = [*options.agents] or [options.model]
    for model in models:
        cameras: list[Camera] = []

        def with_camera(env: gym.Env, cameras: list[Camera] = cameras) -> gym.Env:
            cameras.append(camera_class(env))
            return cameras[0]

        which = SelectOptions(**{**options.model_dump(include=set(SelectOptions.model_fields)), "model": model})
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message=".*render_mode")  # the camera tells it better
            agent = cleanup.enter_context(open_agent(which, render_mode="rgb_array", wrappers=[with_camera]))
        shown.append(Shown(agent, "", cameras[0]))
    if options.labels and len(options.labels) != len(shown):
        raise ConfigError(f"--labels: {len(options.labels)} given — expected {len(shown)}, one for each agent")
    for one, label in zip(shown, options.labels or _labels([one.agent.selection for one in shown]), strict=True):
        one.label = label
    return shown


# ----------------------------------------------------------------------------------------------------------------------
# Pictures
# ----------------------------------------------------------------------------------------------------------------------


def labelled(picture: np.ndarray, left: str, right: str, width: int) -> np.ndarray:
    """
    A picture under a line of text.

    :param picture: shape ``(height, width, 3)``
    :param left: what to write at the left
    :param right: what to write at the right
    :param width: pixels, to which the picture is scaled
    :return: shape ``(height, width, 3)``, 8 bits
    """
    image = Image.fromarray(np.asarray(picture, dtype=np.uint8))
    image = image.resize((width, round(image.height * width / image.width)), Image.Resampling.LANCZOS)
    size = min(max(width // 32, 11), 28)
    font = ImageFont.truetype(findfont("DejaVu Sans"), size)
    bar = 2 * size
    canvas = Image.new("RGB", (width, image.height + bar), "white")
    canvas.paste(image, (0, bar))
    draw = ImageDraw.Draw(canvas)
    draw.text((size // 2, bar // 2), left, font=font, fill="black", anchor="lm")
    draw.text((width - size // 2, bar // 2), right, font=font, fill="#444444", anchor="rm")
    return np.asarray(canvas)


def side_by_side(pictures: Sequence[np.ndarray]) -> np.ndarray:
    """
    :param pictures: of the same width
    :return: all of them on white, up to three in a row, more in as square a grid as can be
    """
    columns = len(pictures) if len(pictures) <= 3 else math.ceil(math.sqrt(len(pictures)))
    rows = [pictures[i : i + columns] for i in range(0, len(pictures), columns)]
    width = pictures[0].shape[1]
    heights = [max(picture.shape[0] for picture in row) for row in rows]
    shape = (sum(heights) + _GAP * (len(rows) - 1), width * columns + _GAP * (columns - 1), 3)
    grid = np.full(shape, 255, dtype=np.uint8)
    top = 0
    for row, height in zip(rows, heights, strict=True):
        for column, picture in enumerate(row):
            left = column * (width + _GAP)
            grid[top : top + picture.shape[0], left : left + width] = picture
        top += height + _GAP
    return grid


class _Moment(NamedTuple):
    """What is seen at one time of an episode."""

    picture: np.ndarray
    n_steps: int
    reward: float  # sum so far
    done: bool


def _episode(shown: Shown, seed: int, options: VideoOptions) -> Iterator[_Moment]:
    """An episode, from before its first step to its end."""
    reward = 0.0
    for n_steps, step in enumerate(shown.agent.episode(seed, options.deterministic), 1):
        if n_steps == 1:
            yield _Moment(shown.camera.before_first, 0, 0.0, False)
        reward += step.reward
        yield _Moment(shown.camera.after_step, n_steps, reward, step.done)
        if n_steps == options.n_timesteps:
            return


def sampled(moments: Iterable[_Moment], steps_per_second: float, fps: float) -> Iterator[_Moment]:
    """
    Choose moments so that time passes as in the simulated world: the k-th is the one after floor(k·steps_per_second/fps)
    steps, up to the first that shows the end.

    :param moments: an episode, step by step
    :param steps_per_second: of the simulated world
    :param fps: pictures per second
    :return: the moments to show; some are left out, or shown twice
    """
    before: _Moment | None = None
    n_shown = 0
    for moment in moments:
        while before is not None and math.floor(n_shown * steps_per_second / fps + 1e-9) < moment.n_steps:
            yield before
            n_shown += 1
        before = moment
    if before is not None:
        yield before


def _undisturbed(moments: Iterator[_Moment]) -> Iterator[_Moment]:
    """An episode from which the others of a film, played in turn, take no random numbers."""
    generators = generator_states()
    while True:
        restore_generators(generators)
        moment = next(moments, None)
        generators = generator_states()
        if moment is None:
            return
        yield moment


def _pictures(agents: Sequence[Shown], options: VideoOptions, fps: float, width: int | None) -> Iterator[np.ndarray]:
    """The film. Agents play the same seeds; who has finished waits for the others."""
    for seed in range(options.seed, options.seed + options.n_episodes):
        episodes = [_undisturbed(_episode(shown, seed, options)) for shown in agents]
        films = [sampled(each, shown.steps_per_second, fps) for each, shown in zip(episodes, agents, strict=True)]
        drawn: list[np.ndarray] = [np.empty(0)] * len(agents)
        while True:
            running = False
            for index, (shown, film) in enumerate(zip(agents, films, strict=True)):
                moment = next(film, None)
                if moment is None:
                    continue
                running = True
                right = f"return {moment.reward:.1f}   step {moment.n_steps}{'   end' if moment.done else ''}"
                drawn[index] = labelled(moment.picture, shown.label, right, width or moment.picture.shape[1])
            if not running:
                break
            yield side_by_side(drawn)
        for _ in range(round(_HOLD * fps)):
            yield side_by_side(drawn)


# ----------------------------------------------------------------------------------------------------------------------
# Files
# ----------------------------------------------------------------------------------------------------------------------


def write_film(pictures: Iterable[np.ndarray], fps: float, output: Path) -> int:
    """
    Write a film; a file of that name is replaced once the new one is complete.

    :param pictures: each of shape ``(height, width, 3)``, 8 bits, all of the same size
    :param fps: pictures per second
    :param output: file whose name ends in .mp4 (H.264) or .gif
    :return: number of pictures
    """
    with completed(output) as unfinished:
        return (_write_gif if output.suffix.lower() == ".gif" else _write_mp4)(pictures, fps, unfinished)


def _write_mp4(pictures: Iterable[np.ndarray], fps: float, output: Path) -> int:
    """Not by ``imageio_ffmpeg.write_frames``, which does not tell whether ffmpeg could write all of them."""
    from imageio_ffmpeg import get_ffmpeg_exe

    count = 0
    ffmpeg: subprocess.Popen[bytes] | None = None
    with tempfile.TemporaryFile() as messages:
        try:
            for picture in pictures:
                count += 1
                # H.264 wants even sizes
                even = np.pad(picture, [(0, picture.shape[0] % 2), (0, picture.shape[1] % 2), (0, 0)], constant_values=255)
                if ffmpeg is None:
                    size = f"{even.shape[1]}x{even.shape[0]}"
                    given = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-video_size", size, "-framerate", f"{fps}", "-i", "-"]
                    wanted = ["-c:v", "libx264", "-crf", "15", "-pix_fmt", "yuv420p", "-y", str(output)]
                    command = [get_ffmpeg_exe(), "-loglevel", "error", *given, *wanted]
                    ffmpeg = subprocess.Popen(command, stdin=subprocess.PIPE, stderr=messages)
                assert ffmpeg.stdin is not None
                ffmpeg.stdin.write(even.tobytes())
        except BrokenPipeError:
            pass  # it has ended, and said why
        finally:
            if ffmpeg is not None:
                ffmpeg.communicate()  # closes its input, and waits
        assert ffmpeg is not None
        if ffmpeg.returncode:
            messages.seek(0)
            told = messages.read().decode(errors="replace").strip()
            full = os.strerror(errno.ENOSPC)
            raise OSError(full if full in told else told.rpartition("\n")[2])
    return count


def _write_gif(pictures: Iterable[np.ndarray], fps: float, output: Path) -> int:
    count = 0

    def images() -> Iterator[Image.Image]:
        nonlocal count
        for picture in pictures:
            image = Image.fromarray(picture).quantize(dither=Image.Dither.NONE)
            # In hundredths of a second, of which some rates need 3, 3, 4, …
            image.info["duration"] = 10 * (round(100 * (count + 1) / fps) - round(100 * count / fps))
            count += 1
            yield image

    film = images()
    next(film).save(output, save_all=True, append_images=film, loop=0)
    return count


def _default_output(options: VideoOptions, agents: Sequence[Shown]) -> Path:
    """In the run's folder, as RL Zoo has it; that of a grid, or of an agent of the package, in the working folder."""
    selection = agents[0].agent.selection
    if options.grid and len(agents) > 1:
        return Path(f"{RunFolder.file_name(selection.env_id)}_grid.mp4")
    if selection.run is None or selection.shipped:
        return selection.beside(".mp4")
    return selection.run / "videos" / f"{selection.model.stem}.mp4"  # a folder that may have to be made


def video(options: VideoOptions) -> list[Path]:
    """
    Film agents: one film for each, or one of all of them side by side.

    :param options: which agents, and what of them
    :return: the files
    :raises ConfigError: if an agent cannot be opened or drawn, or a file not be written
    """
    with ExitStack() as cleanup:
        agents = show_agents(options, cleanup)
        films = [agents] if options.grid else [[agent] for agent in agents]
        if options.output is not None and len(films) > 1:
            raise ConfigError(f"--output: '{options.output}' — {len(films)} agents give {len(films)} files, see --grid")
        outputs: list[Path] = []
        for film in films:
            if options.output is not None:
                output = output_file(options.output, "--output", SUFFIXES)
            else:
                output = _default_output(options, film)
                check_folder(output.parent, "--output")
            if output.suffix.lower() == ".mp4":
                _check_ffmpeg(output)
            elif options.fps is not None and options.fps > _GIF_FPS:
                raise ConfigError(f"--fps: {options.fps} — expected at most {_GIF_FPS} for {output}, or an .mp4")
            if output in outputs:
                raise ConfigError(f"'{output}' would be the film of two agents — expected each agent once, or --grid")
            outputs.append(output)
        return [_film(film, options, output) for film, output in zip(films, outputs, strict=True)]


def _check_ffmpeg(output: Path) -> None:
    if find_spec("imageio_ffmpeg") is None:
        raise ConfigError(f'{output}: MP4 needs imageio-ffmpeg: pip install "sb3-symphony[video]" — or use .gif')
    from imageio_ffmpeg import get_ffmpeg_exe

    try:
        program = get_ffmpeg_exe()
    except RuntimeError:  # its package for this machine is without one, and none is installed
        program = "ffmpeg"
    if shutil.which(program) is None:
        raise ConfigError(f"{output}: MP4 needs ffmpeg, and there is no '{program}' — install it, or use .gif")


def _film(agents: Sequence[Shown], options: VideoOptions, output: Path) -> Path:
    highest = 25.0 if output.suffix.lower() == ".gif" else 50.0  # a GIF is large; what looks smooth
    fps = float(options.fps or min(highest, max(shown.steps_per_second for shown in agents)))
    width = options.width or (None if len(agents) == 1 else 400)
    seconds = [(shown.most_steps(options.n_timesteps) or math.inf) / shown.steps_per_second for shown in agents]
    total = options.n_episodes * (max(seconds) + _HOLD) * fps
    pictures = progress_bar(
        _pictures(agents, options, fps, width), "filming", options.progress, total if math.isfinite(total) else None
    )
    try:
        with closing(pictures):  # the bar goes before an error is told
            first = next(pictures)  # before anything is written
            output.parent.mkdir(exist_ok=True)
            write_film(chain([first], pictures), fps, output)
    except OSError as error:
        raise ConfigError(f"--output: '{output}' cannot be written — {error.strerror or error}") from None
    return output
