"""
What a sweep searches: options of the command line, and spaces read from YAML.

A space maps hyper-parameters, dotted as in ``-params``, to lists of choices or to intervals::

    learning_rate: {float: [1e-5, 1e-2], log: true}
    policy_delay: {int: [1, 20]}
    gamma: [0.98, 0.99, 0.999]
    policy_kwargs.net_arch: [[64, 64], [256, 256]]

Neither torch nor Optuna is imported here.
"""

import json
import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import BaseModel, Field, field_validator

from sb3_symphony.common.checks import suggestion
from sb3_symphony.experiment.config import (
    ConfigError,
    NotZero,
    Threads,
    TrainOptions,
    entry_name,
    read_yaml,
    shipped_folder,
)
from sb3_symphony.experiment.registry import without_folder
from sb3_symphony.experiment.run_folder import RunFolder

if TYPE_CHECKING:
    from optuna import Trial


class TuneOptions(BaseModel, extra="forbid", frozen=True):
    """Options of ``sb3-symphony tune``; their meaning is in its ``--help``."""

    algo: str = "symphony"
    env: str = "BipedalWalker-v3"
    n_timesteps: Annotated[int, NotZero] = Field(default=-1, ge=-1)
    seed: int = Field(default=100, ge=0, lt=2**31 - 1000)
    seeds_per_trial: int = Field(default=3, ge=1, le=1000)
    log_folder: str = "logs"
    hyperparams: dict[str, Any] = {}
    conf_file: str | None = None
    env_kwargs: dict[str, Any] = {}
    space: str | None = None
    n_trials: int = Field(default=200, ge=1)
    n_startup_trials: int = Field(default=10, ge=0)
    n_evaluations: int = Field(default=20, ge=1)
    eval_episodes: int = Field(default=10, ge=1)
    timeout: float | None = Field(default=None, gt=0)
    n_jobs: Annotated[int, NotZero] = Field(default=1, ge=-1)
    sampler: Literal["tpe", "random", "gp", "cmaes"] = "tpe"
    pruner: Literal["median", "halving", "hyperband", "none"] = "median"
    storage: str | None = Field(default=None, min_length=1)
    study_name: str | None = Field(default=None, min_length=1)
    heartbeat: int = Field(default=30, ge=1)
    device: str = "auto"
    num_threads: Threads = -1
    show: bool = False

    @field_validator("study_name")
    @classmethod
    def _names_a_folder(cls, value: str | None) -> str | None:
        if value is not None and (value in (".", "..") or "/" in value):
            raise ValueError("expected a name, of a folder, too: without '/'")
        if value is not None and len(value.encode(errors="surrogateescape")) > 200:
            raise ValueError("expected at most 200 bytes: it is the name of a folder, too")
        return value

    @property
    def seeds(self) -> list[int]:
        """Seeds that every trial is trained with."""
        return [self.seed + index for index in range(self.seeds_per_trial)]

    @property
    def name(self) -> str:
        """Name of the study."""
        return self.study_name or f"{self.algo}-{RunFolder.file_name(self.env)}"

    @property
    def folder(self) -> Path:
        """Where results are written."""
        folder_name = self.name.replace("/", "-")  # the default one may hold the path of an algorithm's file
        return Path(self.log_folder) / without_folder(self.algo) / "tune" / folder_name

    @property
    def where(self) -> str:
        """Where trials are kept: URL of a database, or path of a journal file."""
        return self.storage or str(self.folder / "journal.log")

    def training(self, hyperparams: dict[str, Any]) -> TrainOptions:
        """
        :param hyperparams: hyper-parameters that override the configuration, dotted
        :return: options of one training
        """
        return TrainOptions(
            algo=self.algo,
            env=self.env,
            n_timesteps=self.n_timesteps,
            conf_file=self.conf_file,
            env_kwargs=self.env_kwargs,
            eval_episodes=self.eval_episodes,
            hyperparams=hyperparams,
            device=self.device,
            num_threads=self.num_threads,
        )


@dataclass(frozen=True)
class Interval:
    """
    Numbers from ``low`` to ``high``, both included; whole ones if both are ``int``.

    :param low: smallest value
    :param high: largest value
    :param log: draw the logarithm uniformly
    :param step: distance between possible values, counted from ``low``; None: any value
    """

    low: float
    high: float
    log: bool = False
    step: float | None = None

    def suggest(self, name: str, trial: "Trial") -> Any:
        """
        :param name: name of the parameter
        :param trial: trial that a value is wanted for
        :return: the value
        """
        if isinstance(self.low, int):
            return trial.suggest_int(name, self.low, int(self.high), step=int(self.step or 1), log=self.log)
        return trial.suggest_float(name, self.low, self.high, step=self.step, log=self.log)

    def value(self, stored: Any) -> Any:
        """
        :param stored: what the study knows the value as
        :return: the value
        """
        return stored

    def examples(self) -> list[Any]:
        """:return: values that show whether all are allowed"""
        whole = isinstance(self.low, float) and self.low.is_integer() and float(self.high).is_integer()
        between = self.low + (self.step or (self.high - self.low) / math.e)  # not whole either, unless the step is
        return [self.low, self.high, *[between] * whole]

    def plain(self) -> Any:
        """:return: how YAML has it"""
        kind = "int" if isinstance(self.low, int) else "float"
        return {kind: [self.low, self.high], "log": self.log, "step": self.step}


def scalar(value: Any) -> Any:
    """
    :param value: any plain value
    :return: what Optuna and tables, which want scalars, know it as: lists and mappings by their JSON text
    """
    return json.dumps(value) if isinstance(value, list | dict) else value


@dataclass(frozen=True)
class Choice:
    """
    One of several values.

    :param values: any plain values
    """

    values: tuple[Any, ...]

    def suggest(self, name: str, trial: "Trial") -> Any:
        """
        :param name: name of the parameter
        :param trial: trial that a value is wanted for
        :return: the value
        """
        return self.value(trial.suggest_categorical(name, [scalar(value) for value in self.values]))

    def value(self, stored: Any) -> Any:
        """
        :param stored: what the study knows the value as
        :return: the value
        """
        return next(value for value in self.values if scalar(value) == stored)

    def examples(self) -> list[Any]:
        """:return: values that show whether all are allowed"""
        return list(self.values)

    def plain(self) -> Any:
        """:return: how YAML has it"""
        return list(self.values)


@dataclass(frozen=True)
class SearchSpace:
    """
    :param origin: file it comes from, for messages
    :param parameters: what is searched, by dotted names
    :param fixed: hyper-parameters with a single choice
    """

    origin: str
    parameters: dict[str, Interval | Choice]
    fixed: dict[str, Any]

    def suggest(self, trial: "Trial") -> dict[str, Any]:
        """
        :param trial: trial that values are wanted for
        :return: values of all hyper-parameters of the space, by dotted names
        """
        return {**self.fixed, **{name: parameter.suggest(name, trial) for name, parameter in self.parameters.items()}}

    def values(self, stored: dict[str, Any]) -> dict[str, Any]:
        """
        :param stored: parameters of a trial as the study knows them
        :return: their values, those that are fixed included
        """
        return {**self.fixed, **{name: self.parameters[name].value(value) for name, value in stored.items()}}

    def examples(self) -> Iterator[tuple[str, dict[str, Any]]]:
        """
        :return: combinations in which each choice and each end of an interval occurs, and the name of the parameter that
            differs from the first of them
        """
        first = {**self.fixed, **{name: parameter.examples()[0] for name, parameter in self.parameters.items()}}
        yield "", first
        for name, parameter in self.parameters.items():
            for value in parameter.examples()[1:]:
                yield name, {**first, name: value}

    def plain(self) -> dict[str, Any]:
        """:return: plain values that tell whether two spaces are the same"""
        searched = {name: parameter.plain() for name, parameter in self.parameters.items()}
        return {**searched, **{name: [value] for name, value in self.fixed.items()}}


def _interval(where: str, spec: dict[str, Any]) -> Interval:
    kinds = [kind for kind in ("float", "int") if kind in spec]
    known = ("float", "int", "log", "step")
    for key in spec:
        if key not in known:
            near = suggestion(key, known) or f" — expected {', '.join(known)}"
            raise ConfigError(f"{where}: unknown key '{key}'{near}")
    if len(kinds) != 1:
        raise ConfigError(f"{where}: {spec} — expected {{float: [low, high]}} or {{int: [low, high]}}")
    kind, bounds = kinds[0], spec[kinds[0]]
    numbers = [*bounds, *([spec["step"]] if spec.get("step") is not None else [])] if isinstance(bounds, list) else []
    if not isinstance(bounds, list) or len(bounds) != 2 or not all(_is_number(number, kind) for number in numbers):
        raise ConfigError(f"{where}: {spec} — expected {'whole ' if kind == 'int' else ''}numbers, {{{kind}: [low, high]}}")
    low, high, *rest = (int(number) if kind == "int" else float(number) for number in numbers)
    if kind == "int" and max(abs(low), abs(high)) >= 2**63:
        raise ConfigError(f"{where}: {spec} — expected numbers of at most 63 bits")
    step, log = (rest[0] if rest else None), spec.get("log", False)
    if not isinstance(log, bool):
        raise ConfigError(f"{where}: log: {log!r} — expected true or false")
    if low >= high:
        raise ConfigError(f"{where}: [{bounds[0]}, {bounds[1]}] is empty — expected low < high")
    if log and low <= 0:
        raise ConfigError(f"{where}: [{bounds[0]}, {bounds[1]}] — expected low > 0 for log: true")
    if step is not None and (log or not 0 < step <= high - low):
        raise ConfigError(f"{where}: step: {spec['step']} — expected a number in (0, {high - low:g}], and no log: true")
    if step is not None:
        first, last, distance = (Fraction(str(number)) for number in (low, high, step))
        below = low + (last - first) // distance * step
        if (last - first) % distance:
            near = f"{below:g} or {below + step:g}"
            raise ConfigError(f"{where}: step: {spec['step']} — does not lead from {low:g} to {high:g}, but to {near}")
    return Interval(low, high, log, step)


def _is_number(value: Any, kind: str) -> bool:
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        return False
    return kind == "float" or value == int(value)


def _choice(where: str, values: list[Any]) -> Choice:
    if not values:
        raise ConfigError(f"{where}: [] is empty — expected at least one choice")
    seen = [json.dumps(value) for value in values]
    for label, value in zip(seen, values, strict=True):
        if seen.count(label) > 1:
            raise ConfigError(f"{where}: {value!r} is there twice — expected different choices")
    return Choice(tuple(values))


def read_space(options: TuneOptions) -> SearchSpace:
    """
    Read the search space: the environment's entry, else ``default``, of the given file or the one that is shipped for the
    algorithm; a file without such entries is one space. What ``-params`` and ``-n`` give is not searched.

    :param options: options of the command line
    :return: the space; its names and values are yet to be checked against the algorithm
    :raises ConfigError: if the file or one of its ranges is wrong
    """
    path = Path(shipped_folder() / "tuning" / f"{options.algo}.yml" if options.space is None else options.space)
    content = read_yaml(path, "a search space")
    where = str(path)
    name = entry_name(content, options.env, path)
    if name is not None:
        where, content = f"{path}: {name}", content[name]
    space = parse_space(content, where)
    given = [*options.hyperparams, *(["n_timesteps"] if options.n_timesteps > 0 else [])]
    parameters = {name: parameter for name, parameter in space.parameters.items() if not _covered(name, given)}
    if not parameters:
        raise ConfigError(
            f"{where}: nothing is left to search — expected a hyper-parameter with more than one choice that -params "
            "and -n do not give"
        )
    return SearchSpace(where, parameters, {name: value for name, value in space.fixed.items() if not _covered(name, given)})


def _covered(name: str, given: Iterable[str]) -> bool:
    """Whether something given is this hyper-parameter, the mapping that it is in, or an item of it."""
    return any(name == other or name.startswith(f"{other}.") or other.startswith(f"{name}.") for other in given)


def parse_space(content: Any, where: str) -> SearchSpace:
    """
    :param content: plain values
    :param where: where they come from, for messages
    :return: the space
    :raises ConfigError: if one of its ranges is wrong
    """
    if not isinstance(content, dict) or not content or not all(isinstance(name, str) for name in content):
        raise ConfigError(f"{where}: {content!r} — expected a mapping of hyper-parameters to choices or ranges")
    parameters: dict[str, Interval | Choice] = {}
    fixed: dict[str, Any] = {}
    for name, spec in content.items():
        if isinstance(spec, dict):
            parameters[name] = _interval(f"{where}: {name}", spec)
        elif isinstance(spec, list):
            choice = _choice(f"{where}: {name}", spec)
            if len(choice.values) > 1:
                parameters[name] = choice
            else:
                fixed[name] = choice.values[0]
        else:
            raise ConfigError(f"{where}: {name}: {spec!r} — expected [choice, …], {{float: [low, high]}} or {{int: …}}")
        if _covered(name, [other for other in content if other != name]):
            raise ConfigError(f"{where}: {name} — expected it or its items, not both")
    return SearchSpace(where, parameters, fixed)
