"""
A study: algorithms × environments × seeds, as a YAML file describes them. Each combination is a cell, one training run.

Only YAML is read here; nothing heavy is imported.
"""

import re
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any, TypeVar

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, FiniteFloat, field_validator

from sb3_symphony.common.checks import suggestion
from sb3_symphony.experiment.config import (
    ConfigError,
    RunConfig,
    TrainOptions,
    check_algorithm,
    load_config,
    read_yaml,
    shipped_folder,
    validated,
)
from sb3_symphony.experiment.run_folder import RunFolder


def _part(model: type[BaseModel], name: str | None, value: Any) -> Any:
    """An item of the file as an instance of ``model``; text alone gives the field ``name``."""
    if isinstance(value, str) and name is not None:
        value = {name: value}
    if not isinstance(value, dict):
        expected = "a mapping" if name is None else f"a name, or a mapping with '{name}'"
        raise ConfigError(f"{value!r} — expected {expected}")
    return validated(model, value)


def _seeds(value: Any) -> Any:
    """``10`` means 0 to 9."""
    return list(range(value)) if isinstance(value, int) and not isinstance(value, bool) else value


def _some(value: Any) -> Any:
    if value == []:
        raise ValueError("expected at least one")
    return value


class Algorithm(BaseModel):
    """
    A variant: an algorithm with its settings.

    :param name: what tables and folders call it
    :param algo: its algorithm, by default ``name``
    :param conf: YAML file (relative to the study's folder) or preset, by default the shipped file
    :param overrides: hyper-parameters that go before those of the file
    :param steps: environment steps, which go before those of the environment and the study
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    name: str
    algo: str = ""
    conf: str | None = None
    overrides: dict[str, Any] = {}
    steps: int | None = Field(default=None, ge=1)

    @field_validator("name")
    @classmethod
    def _folder_name(cls, value: str) -> str:
        if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9._+-]*", value):
            raise ValueError("expected letters, digits and . _ + - (it names a folder)")
        return value


class Environment(BaseModel):
    """
    An environment of a study.

    :param id: registered id
    :param env_kwargs: its arguments
    :param threshold: return that solves it, by default the one it is registered with
    :param unstable_below: return below which an episode counts as a failure once it is solved, by default two thirds of a
        positive threshold
    :param steps: environment steps, which go before those of the study
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    id: str
    env_kwargs: dict[str, Any] = {}
    threshold: FiniteFloat | None = None
    unstable_below: FiniteFloat | None = None
    steps: int | None = Field(default=None, ge=1)


class Protocol(BaseModel):
    """
    An evaluation protocol of a study's own.

    :param eval_freq: environment steps between evaluations, 0: none
    :param eval_episodes: episodes of each
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    eval_freq: int = Field(default=10_000, ge=0)
    eval_episodes: int = Field(default=10, ge=1)


def _protocol(value: Any) -> Any:
    if value == "standard":
        return value
    if isinstance(value, str) or not isinstance(value, dict):
        raise ConfigError(f"{value!r} — expected standard, or a mapping of eval_freq and eval_episodes")
    return validated(Protocol, value)


_Item = TypeVar("_Item")
_List = Annotated[list[_Item], BeforeValidator(_some)]
_Seeds = Annotated[_List[Annotated[int, Field(ge=0, lt=2**31)]], BeforeValidator(_seeds)]
_AnyProtocol = Annotated[Any, BeforeValidator(_protocol)]  # "standard" or Protocol


class Quick(BaseModel):
    """
    What differs in the version of a few minutes.

    :param algorithms: names of those to keep, by default all
    :param environments: ids of those to keep, by default all
    :param overrides: hyper-parameters for all algorithms, which go before their own
    :param seeds: see :class:`Study`, as all others; steps go before those of algorithms and environments too
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    algorithms: _List[str] | None = None
    environments: _List[str] | None = None
    seeds: _Seeds | None = None
    steps: int | None = Field(default=None, ge=1)
    protocol: _AnyProtocol | None = None
    final_episodes: int | None = Field(default=None, ge=0)
    save_freq: int | None = Field(default=None, ge=1)
    overrides: dict[str, Any] = {}


class Study(BaseModel):
    """
    A study.

    :param title: heading of its table
    :param algorithms: variants to compare
    :param environments: where
    :param seeds: seeds of the runs; a number ``n``: 0 to n - 1
    :param steps: environment steps, by default those of the algorithm's configuration
    :param protocol: ``standard``, or :class:`Protocol`
    :param final_episodes: episodes on seeds 20 000, 20 001, … that the model is evaluated on at the end, 0: none
    :param save_freq: environment steps between checkpoints
    :param device: where networks run
    :param quick: the version of a few minutes
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    title: str = ""
    algorithms: _List[Annotated[Algorithm, BeforeValidator(partial(_part, Algorithm, "name"))]]
    environments: _List[Annotated[Environment, BeforeValidator(partial(_part, Environment, "id"))]]
    seeds: _Seeds
    steps: int | None = Field(default=None, ge=1)
    protocol: _AnyProtocol = "standard"
    final_episodes: int = Field(default=100, ge=0)
    save_freq: int = Field(default=10_000, ge=1)
    device: str = "cpu"
    quick: Annotated[Quick | None, BeforeValidator(partial(_part, Quick, None))] = None


@dataclass(frozen=True)
class Cell:
    """
    One training run of a study.

    :param algorithm: name of the variant
    :param environment: its environment
    :param seed: its seed
    :param options: options of ``train``
    :param final_episodes: episodes to evaluate the model on at the end
    """

    algorithm: str
    environment: Environment
    seed: int
    options: TrainOptions
    final_episodes: int

    @property
    def name(self) -> str:
        """Its run folder, in the folder of the study's results: that of the algorithm's name, as RL Zoo would have it."""
        return f"{self.algorithm}/{RunFolder.file_name(self.environment.id)}_{self.seed}"


def read_study(path: Path, quick: bool = False) -> Study:
    """
    Read a study file.

    :param path: the file
    :param quick: the version of a few minutes
    :return: the study; the quick version without :attr:`Study.quick`
    :raises ConfigError: if it cannot be read, something is wrong in it, or a cell would be there twice
    """
    values = read_yaml(path, "a study")
    try:
        study: Study = validated(Study, values)
        if quick:
            study = _quick(study)
        for algorithm in study.algorithms:
            check_algorithm(algorithm.algo or algorithm.name)
        _check_twice("algorithms", [algorithm.name.lower() for algorithm in study.algorithms])  # folders, on any disk
        _check_twice("environments", [RunFolder.file_name(environment.id) for environment in study.environments])
        _check_twice("seeds", study.seeds)
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from None
    return study


def _check_twice(key: str, values: Sequence[Any]) -> None:
    value, count = Counter(values).most_common(1)[0]
    if count > 1:
        raise ConfigError(f"{key}: {value!r} is there {count} times — expected every cell once")


def _chosen(key: str, wanted: Iterable[str] | None, there: dict[str, Any]) -> list[Any]:
    """Those that the quick version names, in their order."""
    if wanted is None:
        return list(there.values())
    for name in wanted:
        if name not in there:
            near = suggestion(name, there) or f" — expected some of {', '.join(there)}"
            raise ConfigError(f"quick: {key}: unknown name '{name}'{near}")
    return [there[name] for name in wanted]


def _quick(study: Study) -> Study:
    if study.quick is None:
        raise ConfigError("quick: missing — expected what differs in the quick version, such as {seeds: 1, steps: 1500}")
    quick = study.quick
    algorithms = _chosen("algorithms", quick.algorithms, {each.name: each for each in study.algorithms})
    environments = _chosen("environments", quick.environments, {each.id: each for each in study.environments})
    without_steps = {"steps": None} if quick.steps else {}
    changes = {
        name: value
        for name in ("seeds", "steps", "protocol", "final_episodes", "save_freq")
        if (value := getattr(quick, name)) is not None
    }
    return study.model_copy(
        update={
            **changes,
            "algorithms": [
                each.model_copy(update={"overrides": {**each.overrides, **quick.overrides}, **without_steps})
                for each in algorithms
            ],
            "environments": [each.model_copy(update=without_steps) for each in environments],
            "quick": None,
        }
    )


def cells_of(study: Study, folder: Path) -> list[Cell]:
    """
    :param study: a study
    :param folder: folder of the study file
    :return: its cells, seed by seed, so that all algorithms progress alike
    """
    return [
        Cell(algorithm.name, environment, seed, _options(study, algorithm, environment, seed, folder), study.final_episodes)
        for seed in study.seeds
        for environment in study.environments
        for algorithm in study.algorithms
    ]


def _options(study: Study, algorithm: Algorithm, environment: Environment, seed: int, folder: Path) -> TrainOptions:
    conf = algorithm.conf
    if conf is not None and not (shipped_folder() / "presets" / f"{conf}.yml").is_file():
        conf = str(folder / conf)
    if study.protocol == "standard":
        evaluation: dict[str, Any] = {"protocol": "standard", "threshold": environment.threshold}
    else:
        evaluation = study.protocol.model_dump()
    return TrainOptions(
        algo=algorithm.algo or algorithm.name,
        env=environment.id,
        n_timesteps=algorithm.steps or environment.steps or study.steps or -1,
        seed=seed,
        conf_file=conf,
        hyperparams=algorithm.overrides,
        env_kwargs=environment.env_kwargs,
        save_freq=study.save_freq,
        device=study.device,
        num_threads=1,
        verbose=0,
        progress=False,
        **evaluation,
    )


def configuration(cell: Cell) -> RunConfig:
    """
    :param cell: a cell
    :return: its merged configuration
    :raises ConfigError: if a file or key is wrong, with the name of the variant
    """
    try:
        return load_config(cell.options)
    except ConfigError as error:
        raise ConfigError(f"{cell.algorithm} on {cell.environment.id}: {error}") from None
