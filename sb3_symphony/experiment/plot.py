"""What ``sb3-symphony plot`` draws: from options of the command line to runs, their curves, and an image."""

import sys
from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from pydantic import BaseModel, Field

from sb3_symphony.common.checks import suggestion
from sb3_symphony.experiment.config import ConfigError
from sb3_symphony.experiment.output import json_report, output_file
from sb3_symphony.experiment.registry import without_module
from sb3_symphony.experiment.run_folder import RunFolder

if TYPE_CHECKING:  # the command line imports this module before it knows what is to be done
    from sb3_symphony.analysis.plots import Curve, Line
    from sb3_symphony.analysis.runs import Group, Run


class NothingToDraw(ConfigError):
    """No run has recorded what is asked for."""


class PlotOptions(BaseModel, extra="forbid", frozen=True):
    """Options of ``sb3-symphony plot``; their meaning is in its ``--help``."""

    runs: list[str] = []
    algo: list[str] = []
    env: list[str] = []
    folder: str = "logs"
    evaluations: bool = False
    scalars: bool = False
    tags: list[str] = []
    x_axis: Literal["steps", "episodes", "time"] = "steps"
    y_axis: Literal["reward", "length", "success"] = "reward"
    episode_window: int = Field(default=100, ge=1)
    mean_per: int | None = Field(default=None, ge=1)
    max_timesteps: int | None = Field(default=None, ge=1)
    labels: list[str] = []
    output: str | None = Field(default=None, min_length=1)
    json_file: str | None = None

    @property
    def kind(self) -> str:
        """What is drawn."""
        return "scalars" if self.scalars or self.tags else "evaluations" if self.evaluations else "episodes"


def plot(options: PlotOptions, groups: "list[Group] | None" = None) -> Path:
    """
    Draw the curves of runs.

    :param options: options of the command line
    :param groups: the runs, if they are known; else the options say where to look for them
    :return: the image file
    :raises ConfigError: if there are no such runs, they did not record what is to be drawn, or a file cannot be written
    """
    from sb3_symphony.analysis import plots, style

    check_options(options)
    tell = json_report(options.json_file)
    try:
        groups = _groups(options) if groups is None else groups
        output = output_file(options.output or _default_output(options, groups), "--output", style.SUFFIXES)
        panels = _scalar_panels(options, groups) if options.kind == "scalars" else _curve_panels(options, groups)
    except ConfigError:
        raise
    except ValueError as error:
        raise ConfigError(str(error)) from None
    except OSError as error:
        raise ConfigError(f"'{error.filename}' cannot be read — {error.strerror}") from None
    try:
        if options.kind == "scalars":
            title = ", ".join(dict.fromkeys(group.env for group in groups))
            plots.plot_scalars(panels, options.x_axis, output, title)
        else:
            plots.plot_curves(panels, options.x_axis, options.y_axis, _smoothed(options), output)
    except OSError as error:
        raise ConfigError(f"--output: '{output}' cannot be written — {error.strerror}") from None
    tell({"x": options.x_axis, "panels": {title: [curve.plain() for curve in panel] for title, panel in panels.items()}})
    return output


def check_options(options: PlotOptions) -> None:
    """
    :param options: options of the command line, or of a figure of a study
    :raises ConfigError: if they contradict each other
    """
    if options.evaluations and options.kind == "scalars":
        raise ConfigError("--evaluations and --scalars: expected only one of them")
    if options.mean_per is not None and options.kind != "episodes":
        raise ConfigError(f"--mean-per: {options.mean_per} — is for training episodes, not for --{options.kind}")
    if "episode_window" in options.model_fields_set and (options.mean_per is not None or options.kind != "episodes"):
        other = "--mean-per" if options.mean_per is not None else f"--{options.kind}"
        raise ConfigError(f"-w: {options.episode_window} — is for running means of training episodes, not for {other}")
    if options.y_axis != "reward" and options.kind == "scalars":
        raise ConfigError(f"-y: {options.y_axis} — is for episodes, not for --scalars")
    if options.runs and (options.algo or options.env):
        raise ConfigError(f"{options.runs[0]}: expected run folders, or -a and -e to look for runs, not both")
    if options.runs and "folder" in options.model_fields_set:
        raise ConfigError(f"{options.runs[0]}: expected run folders, or -f to look for runs, not both")


def _groups(options: PlotOptions) -> "list[Group]":
    """The runs that are meant, those that differ in their seed together."""
    from sb3_symphony.analysis.runs import find_runs, group_runs, open_run

    if options.runs:
        folders = {Path(folder).resolve(): Path(folder) for folder in options.runs}  # each once
        runs = [open_run(folder) for folder in folders.values()]
    else:
        everything = find_runs(Path(options.folder))
        algos, envs = options.algo, [without_module(env) for env in options.env]
        runs = [run for name in dict.fromkeys(algos) for run in everything if run.algo == name] if algos else everything
        for flag, wanted, there in (("-a", algos, {run.algo for run in everything}), ("-e", envs, {run.env for run in runs})):
            for name in wanted:
                if name not in there:
                    known = suggestion(name, there) or (f" — there are runs of {', '.join(sorted(there))}" if there else "")
                    raise ConfigError(f"{flag}: '{name}' — no such run in {options.folder}{known}")
        runs = [run for run in runs if not envs or run.env in envs]
        if not runs:
            raise ConfigError(f"no runs in '{options.folder}' — expected <algo>/<env>_<k>/ there; `train` makes them")
    groups = [replace(group, runs=_each_seed_once(group.runs)) for group in group_runs(runs)]
    names = list(dict.fromkeys(group.label for group in groups))
    if options.labels:
        if len(options.labels) != len(names):
            raise ConfigError(f"-l: {len(options.labels)} labels — expected {len(names)}, for {', '.join(names)}")
        renamed = dict(zip(names, options.labels, strict=True))
        groups = [replace(group, label=renamed[group.label]) for group in groups]
    return groups


def _each_seed_once(runs: "list[Run]") -> "list[Run]":
    """Of runs with the same settings and seed the one that came farthest: twice, it would count as two seeds."""
    kept: dict[Any, Run] = {}
    for run in runs:
        seed = run.path if run.seed is None else run.seed
        other = kept.get(seed)
        if other is not None:
            farther = run if _steps_of(run) >= _steps_of(other) else other
            left_out = other if farther is run else run
            print(f"left out: {left_out.path}: has the seed and settings of {farther.path}", file=sys.stderr)
            run = farther
        kept[seed] = run
    return list(kept.values())


def _steps_of(run: "Run") -> int:
    """Of its training episodes; 0 if they cannot be read, which is told where they are wanted."""
    try:
        return int(run.episodes.steps[-1]) if run.episodes is not None and len(run.episodes.steps) else 0
    except ValueError:
        return 0


def _default_output(options: PlotOptions, groups: "list[Group]") -> Path:
    """One run's figure lies in its folder, those of several beside each other."""
    if len(groups) == 1 and len(groups[0].runs) == 1:
        return groups[0].runs[0].path / f"{options.kind}.png"
    environments = list(dict.fromkeys(RunFolder.file_name(group.env) for group in groups))
    names = "_".join(environments) if len(environments) <= 4 else f"{len(environments)}_environments"
    return Path("" if options.runs else options.folder) / f"{names}_{options.kind}.png"


def _lines(options: PlotOptions, runs: "Iterable[Run]", line: "Callable[[Run], Line]", left_out: list[str]) -> "list[Line]":
    """Lines of the runs that have recorded what is asked for; the others, and damaged ones, are told."""
    from sb3_symphony.analysis.runs import Damaged, NotRecorded

    flags = {"--mean-per": options.mean_per, "-max": options.max_timesteps}
    given = " and ".join(f"{flag} {value}" for flag, value in flags.items() if value is not None)
    lines = []
    for run in runs:
        try:
            x, y = line(run)
            if len(x) == 0:
                raise NotRecorded(f"{run.path}: nothing to draw {f'with {given}' if given else 'yet'}")
            lines.append((x, y))
        except (Damaged, NotRecorded) as error:
            left_out.append(str(error))
    return lines


def _told(panels: "dict[str, list[Curve]]", left_out: list[str]) -> "dict[str, list[Curve]]":
    if not panels:
        raise NothingToDraw(next(iter(left_out), "no run has come anywhere yet"))
    for message in dict.fromkeys(left_out):
        print(f"left out: {message}", file=sys.stderr)
    return panels


def _curve_panels(options: PlotOptions, groups: "list[Group]") -> "dict[str, list[Curve]]":
    """A panel for each environment, a curve for each group."""
    from sb3_symphony.analysis.plots import episode_curve, evaluation_curve, summarised

    def line(run: "Run") -> "Line":
        if options.evaluations:
            return evaluation_curve(run, options.x_axis, options.y_axis, options.max_timesteps)
        return episode_curve(
            run, options.x_axis, options.y_axis, options.episode_window, options.mean_per, options.max_timesteps
        )

    panels: dict[str, list[Curve]] = {}
    left_out: list[str] = []
    for group in groups:
        lines = _lines(options, group.runs, line, left_out)
        if lines:
            panels.setdefault(group.env, []).append(summarised(group.label, lines))
    return _told(panels, left_out)


def _why_no_scalars(run: "Run") -> str:
    if run.log is None:
        return "no TensorBoard log is known — `train -tb` writes one; a log's own folder can be given instead"
    return "nothing is logged yet" if run.log.is_dir() else f"its TensorBoard log '{run.log}' is gone"


def _scalar_panels(options: PlotOptions, groups: "list[Group]") -> "dict[str, list[Curve]]":
    """A panel for each quantity, a curve for each group that has logged it."""
    from sb3_symphony.analysis.plots import SCALARS, scalar_curve, summarised

    logged = {tag for group in groups for run in group.runs for tag in run.scalars}
    for tag in options.tags:
        if tag not in logged:
            known = suggestion(tag, logged) or f" — logged are {', '.join(sorted(logged)) or 'none'}"
            raise ConfigError(f"--tags: '{tag}' — no run has logged it{known}")
    several = len({group.env for group in groups}) > 1
    panels: dict[str, list[Curve]] = {}
    left_out = [f"{run.path}: {_why_no_scalars(run)}" for group in groups for run in group.runs if not run.scalars]
    for tag in options.tags or [tag for tag in SCALARS if tag in logged] or sorted(logged):
        for group in groups:
            lines = _lines(
                options,
                [run for run in group.runs if tag in run.scalars],
                partial(scalar_curve, tag=tag, x=options.x_axis, max_steps=options.max_timesteps),
                left_out,
            )
            if lines:
                label = f"{group.label} on {group.env}" if several else group.label
                panels.setdefault(tag, []).append(summarised(label, lines))
    return _told(panels, left_out)


def _smoothed(options: PlotOptions) -> str:
    if options.kind == "evaluations":
        return "mean of each evaluation's episodes"
    if options.mean_per is not None:
        return f"mean of every {options.mean_per} episodes"
    return f"running mean of {options.episode_window} episodes" if options.episode_window > 1 else ""
