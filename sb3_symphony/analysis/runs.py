"""What the files of runs say, as arrays; run folders of RL Zoo are read too. No algorithm is imported."""

import csv
import json
import logging
import os
import re
import zipfile
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from sb3_symphony.common.plain_yaml import PlainLoader


class Damaged(ValueError):
    """A file of a run cannot be read."""


class NotRecorded(ValueError):
    """Something that is asked for is not in the files of a run."""


@dataclass(frozen=True)
class Episodes:
    """
    Training episodes in the order of their ends, those of parallel environments merged. All arrays have shape ``(n,)``.

    :param steps: environment steps at the end of each, summed over all environments
    :param seconds: wall-clock time at the end of each, since the run began
    :param returns: sum of raw rewards
    :param lengths: number of steps
    :param successes: whether the task was solved; None if the environment does not tell
    """

    steps: np.ndarray
    seconds: np.ndarray
    returns: np.ndarray
    lengths: np.ndarray
    successes: np.ndarray | None


@dataclass(frozen=True)
class Evaluations:
    """
    Evaluations in the course of training.

    :param steps: environment steps before each, shape ``(n,)``
    :param returns: sum of raw rewards, shape ``(n, episodes)``
    :param lengths: number of steps, shape ``(n, episodes)``
    :param successes: whether the task was solved, shape ``(n, episodes)``; None if the environment does not tell
    """

    steps: np.ndarray
    returns: np.ndarray
    lengths: np.ndarray
    successes: np.ndarray | None


@dataclass(frozen=True)
class Scalar:
    """
    One quantity logged for TensorBoard. All arrays have shape ``(n,)``.

    :param steps: environment steps
    :param seconds: wall-clock time since the log began
    :param values: the quantity
    """

    steps: np.ndarray
    seconds: np.ndarray
    values: np.ndarray


def read_episodes(folder: Path) -> Episodes | None:
    """
    Read the ``*monitor.csv`` of a run. Lines cut short by a crash are left out.

    :param folder: run folder, or one that holds the files of SB3's ``Monitor``
    :return: its training episodes, None if there are no such files
    :raises ValueError: if a file is something else
    """
    paths = _monitor_files(folder)
    if not paths:
        return None
    starts: list[float] = []
    rows: list[tuple[int, float, float, int, float]] = []  # step and time of the end, return, length, success
    for path in paths:
        with _monitor_file(path) as (header, lines):
            starts.append(float(header["t_start"]))
            step = 0
            for row in _monitor_rows(csv.DictReader(lines), starts[-1]):
                step += row[2] * len(paths)  # all copies of the environment step together
                rows.append((step, *row))
    rows.sort(key=lambda row: row[:2])
    steps, ends, returns, lengths, successes = np.array(rows, dtype=float).reshape(-1, 5).T
    return Episodes(
        steps=steps.astype(np.int64),
        seconds=ends - min(starts),
        returns=returns,
        lengths=lengths.astype(np.int64),
        successes=None if np.isnan(successes).any() or not rows else successes,
    )


def _monitor_files(folder: Path) -> list[Path]:
    return sorted(folder.glob("*monitor.csv"))  # with names as SB3 finds them: Monitor(env, folder) leaves monitor.csv


@contextmanager
def _monitor_file(path: Path) -> Iterator[tuple[dict[str, Any], Iterator[str]]]:
    """The header of the file, and the lines below."""
    try:
        with path.open(encoding="utf-8", newline="") as lines:
            yield json.loads(lines.readline().removeprefix("#")), lines
    except (ValueError, KeyError, TypeError, OSError, csv.Error) as error:
        raise Damaged(f"{path}: not a monitor file of Stable-Baselines3, or damaged — {error}") from None


def _monitor_rows(rows: csv.DictReader, start: float) -> Iterator[tuple[float, float, int, float]]:
    before, pause, damaged = 0.0, 0.0, None
    for row in rows:
        if damaged is not None:  # steps are counted by all lengths, so only the last row may be cut
            raise ValueError(f"line {damaged}: expected numbers r,l,t")
        try:
            seconds, result = float(row["t"]), (float(row["r"]), int(row["l"]))
            told = row.get("is_success") or "nan"
            success = float({"True": 1, "False": 0}.get(told, told))
        except (TypeError, ValueError):
            damaged = rows.line_num + 1  # below the header
            continue
        if seconds < before:  # a resumed run counts from zero again
            pause += before
        before = seconds
        yield (start + pause + seconds, *result, success)


def read_evaluations(folder: Path) -> Evaluations | None:
    """
    Read the ``evaluations.npz`` of a run.

    :param folder: run folder
    :return: its evaluations, None if there is no such file
    :raises Damaged: if the file is something else
    """
    path = folder / "evaluations.npz"
    if not path.exists():
        return None
    try:
        with np.load(path) as data:
            successes = data["successes"].astype(float) if "successes" in data else None
            return Evaluations(data["timesteps"], data["results"], data["ep_lengths"], successes)
    except (OSError, EOFError, KeyError, ValueError, AttributeError, zipfile.BadZipFile) as error:
        raise Damaged(f"{path}: not evaluations of Stable-Baselines3, or damaged — {error}") from None


def read_scalars(folder: Path) -> dict[str, Scalar]:
    """
    Read the scalars of a TensorBoard log, without thinning them.

    :param folder: folder of event files
    :return: name of each quantity → its course
    """
    from tensorboard.backend.event_processing.event_accumulator import SCALARS, EventAccumulator

    logging.getLogger("tensorboard").setLevel(logging.ERROR)  # it warns of what a resumed run has marked as void
    events = EventAccumulator(str(folder), size_guidance={SCALARS: 0}).Reload()
    scalars = {}
    start = events.FirstEventTimestamp() if events.Tags()["scalars"] else 0.0
    for tag in events.Tags()["scalars"]:
        points = events.Scalars(tag)
        steps, times, values = (np.array([getattr(p, field) for p in points]) for field in ("step", "wall_time", "value"))
        scalars[tag] = Scalar(steps, times - start, values)
    return scalars


def read_scalar_table(path: Path) -> dict[str, Scalar]:
    """
    Read scalars that were copied out of a TensorBoard log, see :func:`~sb3_symphony.analysis.tables.scalar_table`.

    :param path: a ``scalars.csv``
    :return: name of each quantity → its course
    :raises Damaged: if the file is something else
    """
    try:
        with path.open(encoding="utf-8", newline="") as lines:
            table = csv.DictReader(lines)
            rows = list(table)
        scalars = {}
        for tag in [name for name in table.fieldnames or [] if name not in ("step", "seconds")]:
            points = np.array([[float(row[key]) for key in ("step", "seconds", tag)] for row in rows if row[tag] != ""])
            steps, seconds, values = points.reshape(-1, 3).T
            scalars[tag] = Scalar(steps.astype(np.int64), seconds, values)
        return scalars
    except (ValueError, KeyError, TypeError, OSError, csv.Error) as error:
        raise Damaged(f"{path}: no table of scalars, or damaged — {error}") from None


# ----------------------------------------------------------------------------------------------------------------------
# Runs
# ----------------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Run:
    """
    A run folder, or the folder of a TensorBoard log alone.

    :param path: the folder
    :param algo: name of the algorithm
    :param env: id of the environment
    :param seed: seed, None if it is not recorded
    :param config: hyper-parameters, empty if they are not recorded as plain YAML
    :param log: folder of its TensorBoard log, None if there is none
    :param options: options of ``train``, empty if they are not recorded as plain YAML
    """

    path: Path
    algo: str
    env: str
    seed: int | None
    config: dict[str, Any]
    log: Path | None
    options: dict[str, Any] = field(default_factory=dict)

    @cached_property
    def episodes(self) -> Episodes | None:
        """Training episodes, see :func:`read_episodes`."""
        return read_episodes(self.path)

    @cached_property
    def evaluations(self) -> Evaluations | None:
        """Evaluations, see :func:`read_evaluations`."""
        return read_evaluations(self.path)

    @cached_property
    def scalars(self) -> dict[str, Scalar]:
        """Scalars of the TensorBoard log, see :func:`read_scalars`, or copied out of it; empty if there are none (left)."""
        if self.log and self.log.is_dir():
            return read_scalars(self.log)
        return read_scalar_table(path) if (path := self.path / "scalars.csv").exists() else {}


def _plain_mapping(path: Path) -> dict[str, Any]:
    """A YAML mapping of plain values; empty if it is none."""
    try:
        content = yaml.load(path.read_text(encoding="utf-8"), Loader=PlainLoader)
    except (OSError, yaml.YAMLError, ValueError, RecursionError):
        return {}
    return content if isinstance(content, dict) else {}


def noted_log(note: Path) -> Path | None:
    """
    :param note: file of a run that tells where its TensorBoard log is, relative to the file
    :return: that folder, which may be gone; None if there is no such file, or nothing in it
    """
    told = note.read_text(encoding="utf-8").strip() if note.exists() else ""
    return Path(os.path.normpath(note.parent / told)) if told else None


def open_run(folder: Path) -> Run:
    """
    :param folder: run folder, folder of TensorBoard event files, or one that holds the files of SB3's ``Monitor``
    :return: the run
    :raises ValueError: if it is none of these
    """
    name, _, number = folder.absolute().name.rpartition("_")
    if any(folder.glob("events.out.tfevents.*")):  # SB3: <log>/<name>_<number>
        return Run(folder, (name or number).lower(), folder.absolute().parent.name, None, {}, folder)
    monitors, details = _monitor_files(folder), next((path.parent for path in sorted(folder.glob("*/config.yml"))), None)
    if not monitors and details is None:
        what = "no run folder and no TensorBoard log" if folder.is_dir() else "no such folder"
        many = " (a folder of such ones: -f)" if folder.is_dir() else ""
        raise ValueError(f"{folder}: {what} — expected one such as logs/symphony/BipedalWalker-v3_1{many}")
    if details is None and not (name and number.isdecimal()):  # Monitor(env, folder): only the file names the environment
        with _monitor_file(monitors[0]) as (header, _):
            own = folder.absolute().name
            return Run(folder, own, str(header["env_id"]) if "env_id" in header else own, None, {}, None)
    details = details or folder / name
    options, config = (_plain_mapping(details / file) for file in ("args.yml", "config.yml"))
    return Run(
        folder,
        algo=str(options.get("algo", folder.absolute().parent.name)),
        env=str(options.get("env", details.name)).rpartition(":")[2],  # with or without the module that registers it
        seed=options.get("seed"),
        config=config,
        log=noted_log(details / "tensorboard.txt"),
        options=options,
    )


def find_runs(folder: Path) -> list[Run]:
    """
    :param folder: where runs are kept, in ``<folder>/<algo>/<env>_<k>/``
    :return: the runs, by algorithm, environment and number; those of a study have its variants' names
    """
    found = []
    for path in folder.glob("*/*_*"):
        name, _, number = path.name.rpartition("_")
        if number.isdecimal() and (_monitor_files(path) or any(path.glob("*/config.yml"))):
            found.append((path.parent.name, name, int(number), path))
    return [replace(open_run(path), algo=algo) for algo, _, _, path in sorted(found)]


# ----------------------------------------------------------------------------------------------------------------------
# Runs that differ in their seed only
# ----------------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Group:
    """
    Runs of one algorithm with the same hyper-parameters on one environment.

    :param label: what to call them in a figure
    :param env: id of the environment
    :param runs: one for each seed
    """

    label: str
    env: str
    runs: list[Run]


def _flat(config: dict[str, Any], prefix: str = "") -> dict[str, str]:
    flat = {}
    for key, value in config.items():
        flat.update(_flat(value, f"{prefix}{key}.") if isinstance(value, dict) else {f"{prefix}{key}": str(value)})
    return flat


def told_apart(run: Run) -> dict[str, Any]:
    """
    :param run: a run
    :return: options that make it another experiment than one of the same configuration: what it starts from, without the
        number of that run, where it is evaluated, and arguments of the environment that RL Zoo keeps out of the configuration
    """
    options = {name: run.options.get(name) for name in ("with_replay_buffer", "eval_env_kwargs")}
    given, configured = run.options.get("env_kwargs"), run.config.get("env_kwargs")
    recorded = isinstance(given, dict) and isinstance(configured, dict) and given.items() <= configured.items()
    options["env_kwargs"] = None if recorded else given
    return {"trained_agent": re.sub(r"_\d+$", "", run.options.get("trained_agent") or ""), **options}


def group_runs(runs: Iterable[Run]) -> list[Group]:
    """
    Put runs together that differ in seed and length only; what has no settings on record may differ in anything.

    Groups of the same algorithm and environment are told apart by up to two hyper-parameters that differ, if their values
    are short, else by the numbers of their folders, and by their paths if these are the same.

    :param runs: any runs
    :return: groups in the order of their first runs
    """
    groups: list[Group] = []
    settings: list[dict[str, str]] = []
    for run in runs:
        own = {key: value for key, value in _flat(run.config).items() if key != "n_timesteps"}
        own |= {name: str(value) for name, value in told_apart(run).items() if value}
        for group, setting in zip(groups, settings, strict=True):
            if run.config and (group.label, group.env, setting) == (run.algo, run.env, own):
                group.runs.append(run)
                break
        else:
            groups.append(Group(run.algo, run.env, [run]))
            settings.append(own)

    labelled = []
    for group, setting in zip(groups, settings, strict=True):
        alike = [s for g, s in zip(groups, settings, strict=True) if (g.label, g.env) == (group.label, group.env)]
        keys = sorted({key for other in alike for key in {*setting, *other} if setting.get(key) != other.get(key)})
        label = group.label
        if 0 < len(keys) <= 2 and all(len(other.get(key, "")) <= 24 for other in alike for key in keys):
            label += " " + ", ".join(f"{key.rpartition('.')[2]} {setting.get(key, 'default')}" for key in keys)
        elif keys:
            label += f" {', '.join(run.path.absolute().name.rpartition('_')[2] for run in group.runs)}"
        labelled.append(replace(group, label=label))
    names = Counter((group.label, group.env) for group in labelled)
    twice = [group for group in labelled if names[group.label, group.env] > 1]
    labels = iter(named_apart([group.label for group in twice], [group.runs[0].path for group in twice]))
    return [replace(group, label=next(labels)) if names[group.label, group.env] > 1 else group for group in labelled]


def named_apart(names: Sequence[str], paths: Sequence[Path]) -> list[str]:
    """
    Tell apart what has the same name, by as little of the paths as is needed.

    :param names: names
    :param paths: where what they name lies
    :return: other names, if some are the same
    """
    parts = [path.absolute().parts for path in paths]
    for depth in range(max(map(len, parts), default=0)):
        told = [f"{name} ({'/'.join(path[-depth:])})" if depth else name for name, path in zip(names, parts, strict=True)]
        if len(set(told)) == len(told):
            return told
    return list(names)  # one of them several times
