"""
A study: algorithms × environments × seeds, as a YAML file describes them. Each combination is a cell, one training run.
Beside them it may name searches for hyper-parameters, whose best ones an algorithm is to use, and conditions under which
final models are evaluated.

Only YAML is read here; nothing heavy is imported.
"""

import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any, TypeVar

from pydantic import BaseModel, BeforeValidator, Field, FiniteFloat, field_validator, model_validator

from sb3_symphony.common.checks import suggestion
from sb3_symphony.experiment.config import (
    ConfigError,
    Count,
    NamedList,
    RunConfig,
    TrainOptions,
    Whole,
    check_algorithm,
    load_config,
    of_networks,
    read_yaml,
    shipped_file,
    validated,
)
from sb3_symphony.experiment.plot import PlotOptions, check_options
from sb3_symphony.experiment.registry import is_file
from sb3_symphony.experiment.run_folder import RunFolder
from sb3_symphony.experiment.space import TuneOptions, read_space


def _part(model: type[BaseModel], name: str | None, value: Any) -> Any:
    """An item of the file as an instance of ``model``; text alone gives the field ``name``."""
    if isinstance(value, str) and name is not None:
        value = {name: value}
    if not isinstance(value, dict):
        expected = "a mapping" if name is None else f"a name, or a mapping with '{name}'"
        raise ConfigError(f"{value!r} — expected {expected}")
    return validated(model, value)


#: a larger number is taken for a seed
_MOST_SEEDS = 10_000


def _seeds(value: Any) -> Any:
    """``10`` means 0 to 9."""
    if not isinstance(value, int) or isinstance(value, bool):
        return value
    if value < 1:
        raise ValueError("expected at least one")
    if value > _MOST_SEEDS:
        raise ValueError(f"expected how many seeds, or a list of them: [{value}] is one seed")
    return list(range(value))


def _some(value: Any) -> Any:
    if value == []:
        raise ValueError("expected at least one")
    return value


_Item = TypeVar("_Item")
_List = Annotated[list[_Item], BeforeValidator(_some)]
_Seeds = Annotated[_List[Annotated[Whole, Field(lt=2**31)]], BeforeValidator(_seeds)]


def _overrides(value: Any) -> Any:
    if isinstance(value, dict) and "n_timesteps" in value:
        raise ConfigError("'n_timesteps' — a study calls it steps, of an algorithm, an environment or all")
    return value


_Overrides = Annotated[dict[str, Any], BeforeValidator(_overrides)]


def _check_name(value: str) -> None:
    if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9._+-]*", value):
        raise ValueError("expected letters, digits and . _ + - (it names a folder)")


class Start(BaseModel, extra="forbid", frozen=True):
    """
    Where an algorithm takes its agents from: the networks at the end of another cell of the study, of the same seed.

    :param algorithm: name of the other cell's algorithm, which comes before this one
    :param environment: id of its environment
    :param replay_buffer: whether the experience is taken over too
    """

    algorithm: str
    environment: str
    replay_buffer: bool = False


class Algorithm(BaseModel, extra="forbid", frozen=True):
    """
    A variant: an algorithm with its settings.

    :param name: what tables and folders call it
    :param algo: its algorithm, by default ``name``
    :param conf: YAML file (relative to the study's folder), preset or name of a shipped file; by default that of ``algo``
    :param sweep: name of a search of the study, whose best settings it has instead
    :param overrides: hyper-parameters that go before those of the file
    :param steps: environment steps, which go before those of the environment and the study
    :param seeds: seeds, which go before those of the study
    :param environments: ids of the environments it runs on, by default all
    :param start_from: agents that it starts from, by default new ones
    :param reported: what others have reported of it, for a column of the table; a text, or a mapping of environments to texts
    """

    name: str
    algo: str = ""
    conf: str | None = None
    sweep: str | None = None
    overrides: _Overrides = {}
    steps: Count | None = None
    seeds: _Seeds | None = None
    environments: _List[str] | None = None
    start_from: Annotated[Start | None, BeforeValidator(partial(_part, Start, None))] = None
    reported: str | dict[str, str] = ""

    @field_validator("name")
    @classmethod
    def _folder_name(cls, value: str) -> str:
        _check_name(value)
        if value.lower() in ("settings", "sweeps") or Path(value).suffix in (".csv", ".md", ".png", ".yml"):
            raise ValueError("is a folder or file that all studies have, expected another name")
        return value

    @model_validator(mode="after")
    def _one_source(self) -> "Algorithm":
        if self.conf is not None and self.sweep is not None:
            raise ConfigError(f"{self.name}: conf and sweep: expected only one of them")
        return self


class Environment(BaseModel, extra="forbid", frozen=True):
    """
    An environment of a study.

    :param id: registered id
    :param env_kwargs: its arguments
    :param threshold: return that solves it, by default the one it is registered with
    :param unstable_below: return below which an episode counts as a failure once it is solved, by default two thirds of a
        positive threshold
    :param steps: environment steps, which go before those of the study
    :param overrides: hyper-parameters that go before those of a file, but not before an algorithm's own
    """

    id: str
    env_kwargs: dict[str, Any] = {}
    overrides: _Overrides = {}
    threshold: FiniteFloat | None = None
    unstable_below: FiniteFloat | None = None
    steps: Count | None = None

    @model_validator(mode="after")
    def _not_above_the_threshold(self) -> "Environment":
        if self.threshold is not None and self.unstable_below is not None and self.unstable_below > self.threshold:
            raise ConfigError(f"unstable_below: {self.unstable_below:g} — expected at most the threshold, {self.threshold:g}")
        return self


class Protocol(BaseModel, extra="forbid", frozen=True):
    """
    An evaluation protocol of a study's own.

    :param eval_freq: environment steps between evaluations, 0: none
    :param eval_episodes: episodes of each
    """

    eval_freq: Whole = 10_000
    eval_episodes: Count = 10


def _protocol(value: Any) -> Any:
    if value == "standard":
        return value
    if not isinstance(value, dict):
        raise ConfigError(f"{value!r} — expected standard, or a mapping of eval_freq and eval_episodes")
    return validated(Protocol, value)


_AnyProtocol = Annotated[Any, BeforeValidator(_protocol)]  # "standard" or Protocol


class Condition(BaseModel, extra="forbid", frozen=True):
    """
    What is different when final models are evaluated once more.

    :param env_kwargs: arguments of the environment
    :param env_wrapper: wrappers around it; one that the model was trained with has these arguments instead
    :param obs_noise: standard deviation of noise on observations
    :param action_delay: steps from an action to its effect
    """

    env_kwargs: dict[str, Any] = {}
    env_wrapper: NamedList = []
    obs_noise: FiniteFloat = Field(default=0.0, ge=0)
    action_delay: Whole = 0


def _conditions(value: Any) -> Any:
    if not isinstance(value, dict) or not value:
        raise ValueError("expected a mapping of names to what is different, such as {delayed: {action_delay: 2}}")
    _check_twice("names", list(map(str, value)))
    return {str(name): _part(Condition, None, condition) for name, condition in value.items()}


class Matrix(BaseModel, extra="forbid", frozen=True):
    """
    Evaluation of all final models under conditions of which each may have been trained under one.

    :param label: what the names of the conditions are, such as ``torso mass (kg)``
    :param conditions: name → what is different; names that are numbers are drawn as such
    """

    label: str
    conditions: Annotated[dict[str, Condition], BeforeValidator(_conditions)]


class Quick(BaseModel, extra="forbid", frozen=True):
    """
    What differs in the version of a few minutes.

    :param algorithms: names of those to keep, by default all
    :param environments: ids of those to keep, by default all
    :param overrides: hyper-parameters for all algorithms, which go before their own
    :param sweeps: options for all searches, which go before their own
    :param seeds: see :class:`Study`, as all others; steps and seeds go before those of algorithms and environments too
    """

    algorithms: _List[str] | None = None
    environments: _List[str] | None = None
    seeds: _Seeds | None = None
    steps: Count | None = None
    protocol: _AnyProtocol | None = None
    final_episodes: Whole | None = None
    save_freq: Count | None = None
    overrides: _Overrides = {}
    sweeps: dict[str, Any] = {}


def _settled(options: Any, names: Iterable[str], instead: str = "") -> None:
    """Refuse options of a command that a study settles itself."""
    for name in names:
        if isinstance(options, dict) and name in options:
            raise ConfigError(f"'{name}' — is for the command line{instead}")


#: options of ``tune`` that a study does not settle
_NOT_OF_SWEEPS = ("log_folder", "n_jobs", "num_threads", "storage", "study_name", "show", "heartbeat", "device", "timeout")


def _sweeps(value: Any) -> Any:
    if not isinstance(value, dict):
        raise ValueError("expected a mapping of names to options of tune, such as {tuned: {algo: td3, n_trials: 50}}")
    for name in map(str, value):
        try:
            _check_name(name)
        except ValueError as error:
            raise ConfigError(f"'{name}' — {error}") from None
    _check_twice("names", [str(name).lower() for name in value])  # folders, on any disk
    return {str(name): _sweep(options) for name, options in value.items()}


def _sweep(options: Any) -> TuneOptions:
    _settled(options, _NOT_OF_SWEEPS)
    return _part(TuneOptions, "algo", options)


#: options of ``plot`` that a study does not settle
_NOT_OF_FIGURES = ("runs", "algo", "env", "folder", "labels", "output", "json_file")


def _figures(value: Any) -> Any:
    if not isinstance(value, dict):
        raise ValueError("expected a mapping of file names to options of plot, such as {reward: {x_axis: episodes}}")
    for name in value:
        if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9_-]*", str(name)) or name in ("evaluations", "training", "matrix"):
            raise ConfigError(
                f"'{name}' — expected letters, digits and _ -, and not the name of a figure that all studies have"
            )
    return {str(name): _figure(figure) for name, figure in value.items()}


def _figure(options: Any) -> "Drawing":
    _settled(options, _NOT_OF_FIGURES, "; a figure has algorithms and environments of the study")
    drawing: Drawing = _part(Drawing, None, options)
    check_options(drawing)
    beside = sorted(drawing.model_fields_set - {"algorithms", "environments", "gait_at"})
    if drawing.gait_at is not None and beside:
        raise ConfigError(f"gait_at: {drawing.gait_at} — is a figure of its own, expected no {beside[0]}")
    return drawing


class Drawing(PlotOptions, frozen=True):
    """
    A figure of a study: options of ``plot``, and which of its runs.

    :param algorithms: names of algorithms, by default all
    :param environments: ids of environments, by default all
    :param gait_at: draw instead how agents of the first seed walk, as ``gait`` does, by the models saved nearest to the end
        of that training episode
    """

    algorithms: _List[str] | None = None
    environments: _List[str] | None = None
    gait_at: Count | None = None

    def shows(self, algorithm: str, environment: str) -> bool:
        """Whether it is about the runs of that algorithm on that environment."""
        return algorithm in (self.algorithms or [algorithm]) and environment in (self.environments or [environment])


class Study(BaseModel, extra="forbid", frozen=True):
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
    :param matrix: conditions under which the models at the end are evaluated, on as many episodes
    :param sweeps: name → options of ``tune``: searches whose best settings algorithms may have
    :param figures: file name → options of ``plot``: figures beside the learning curves
    :param tensorboard: whether runs log what figures of scalars draw
    :param quick: the version of a few minutes
    """

    title: str = ""
    algorithms: _List[Annotated[Algorithm, BeforeValidator(partial(_part, Algorithm, "name"))]]
    environments: _List[Annotated[Environment, BeforeValidator(partial(_part, Environment, "id"))]]
    seeds: _Seeds
    steps: Count | None = None
    protocol: _AnyProtocol = "standard"
    final_episodes: Whole = 100
    save_freq: Count = 10_000
    device: str = "cpu"
    matrix: Annotated[Matrix | None, BeforeValidator(partial(_part, Matrix, None))] = None
    sweeps: Annotated[dict[str, TuneOptions], BeforeValidator(_sweeps)] = {}
    figures: Annotated[dict[str, Drawing], BeforeValidator(_figures)] = {}
    tensorboard: bool = False
    quick: Annotated[Quick | None, BeforeValidator(partial(_part, Quick, None))] = None


@dataclass(frozen=True)
class Cell:
    """
    One training run of a study.

    :param algorithm: name of the variant
    :param environment: its environment
    :param seed: its seed
    :param options: options of ``train``
    :param final_episodes: episodes to evaluate the model on at the end, also under each condition
    :param conditions: name → options of ``evaluate`` that differ
    :param start_from: the cell whose agent it starts from, None: a new one
    :param sweep: name of the search that its settings come from, None if there is none
    :param found: file that this search leaves when it is done
    """

    algorithm: str
    environment: Environment
    seed: int
    options: TrainOptions
    final_episodes: int
    conditions: dict[str, dict[str, Any]] = field(default_factory=dict)
    start_from: "Cell | None" = None
    sweep: str | None = None
    found: Path | None = None

    @property
    def name(self) -> str:
        """Its run folder, in the folder of the study's results: that of the algorithm's name, as RL Zoo would have it."""
        return f"{self.algorithm}/{RunFolder.file_name(self.environment.id)}_{self.seed}"

    @property
    def waits(self) -> bool:
        """Whether its settings are not known yet."""
        return self.found is not None and not self.found.is_file()


def read_study(path: Path, quick: bool = False, only: Sequence[str] = ()) -> Study:
    """
    Read a study file.

    :param path: the file
    :param quick: the version of a few minutes
    :param only: names of the algorithms to keep, and those that they start from; none: all
    :return: the study; the quick version without :attr:`Study.quick`
    :raises ConfigError: if it cannot be read, something is wrong in it, or a cell would be there twice
    """
    values = read_yaml(path, "a study")
    try:
        study: Study = validated(Study, values)
        _check(study, path.absolute().parent)
        if quick or study.quick is not None:
            shorter = _quick(study)
            try:
                _check(shorter, path.absolute().parent)
            except ConfigError as error:
                raise ConfigError(f"quick: {error}") from None
            study = shorter if quick else study
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from None
    return _only(study, only) if only else study


def _check(study: Study, folder: Path) -> None:
    if study.matrix is not None and study.final_episodes == 0:
        raise ConfigError("final_episodes: 0 — expected 1 or more for the conditions of the matrix")
    for algorithm in study.algorithms:
        check_algorithm(_algo(algorithm, folder))
    for name in study.sweeps:
        try:
            sweep = sweep_options(study, name, folder, folder)
            load_config(sweep.training(sweep.hyperparams))
            read_space(sweep)
            if "env" not in study.sweeps[name].model_fields_set and len(study.environments) > 1:
                raise ConfigError(f"env: missing — expected one environment, such as {study.environments[0].id}")
        except ConfigError as error:
            raise ConfigError(f"sweeps: {name}: {error}") from None
    _check_twice("algorithms", [algorithm.name.lower() for algorithm in study.algorithms])  # folders, on any disk
    _check_twice("environments", [RunFolder.file_name(environment.id) for environment in study.environments])
    environments = {each.id: each for each in study.environments}
    algorithms: dict[str, Algorithm] = {}
    for each in study.algorithms:
        _check_twice(f"{each.name}: seeds" if each.seeds else "seeds", each.seeds or study.seeds)
        _chosen(f"algorithms: {each.name}: environments", each.environments, environments)
        if each.sweep is not None:
            (search,) = _chosen(f"algorithms: {each.name}: sweep", [each.sweep], study.sweeps)
            wanted = each.algo or each.name
            if search.algo != wanted:
                raise ConfigError(
                    f"algorithms: {each.name}: sweep: {each.sweep} is of algorithm '{search.algo}' — expected '{wanted}'"
                )
        if each.start_from is not None:
            where = f"algorithms: {each.name}: start_from"
            (source,) = _chosen(where, [each.start_from.algorithm], algorithms)
            if source.start_from is not None:
                raise ConfigError(f"{where}: {source.name} starts from another one itself — expected one that does not")
            _chosen(where, [each.start_from.environment], _environments(study, source))
            if _algo(source, folder) != _algo(each, folder):
                raise ConfigError(
                    f"{where}: {source.name} is of algorithm '{_algo(source, folder)}' — expected '{_algo(each, folder)}'"
                )
            missing = set(each.seeds or study.seeds) - set(source.seeds or study.seeds)
            if missing:
                raise ConfigError(f"{where}: {source.name} has no seed {min(missing)}")
        algorithms[each.name] = each
    _check_figures(study, algorithms, environments)


def _check_figures(study: Study, algorithms: Mapping[str, Algorithm], environments: Mapping[str, Environment]) -> None:
    for name, figure in study.figures.items():
        _chosen(f"figures: {name}: algorithms", figure.algorithms, algorithms)
        _chosen(f"figures: {name}: environments", figure.environments, environments)
        if figure.kind == "scalars" and not study.tensorboard:
            raise ConfigError(f"figures: {name}: scalars are those of TensorBoard logs — expected tensorboard: true")
        if figure.kind == "evaluations" and study.protocol != "standard" and study.protocol.eval_freq <= 0:
            raise ConfigError(f"figures: {name}: evaluations — expected a protocol with eval_freq > 0")


def _algo(algorithm: Algorithm, folder: Path) -> str:
    return _whole(algorithm.algo or algorithm.name, folder)


def _whole(algo: str, folder: Path) -> str:
    """The algorithm, where it is one of a file beside the study with the whole path."""
    return str(folder / algo) if is_file(algo) else algo


def _environments(study: Study, algorithm: Algorithm) -> dict[str, Environment]:
    wanted = algorithm.environments
    return {each.id: each for each in study.environments if wanted is None or each.id in wanted}


def _only(study: Study, names: Sequence[str]) -> Study:
    there = {each.name: each for each in study.algorithms}
    wanted = {each.name for each in _chosen("-a", names, there)}
    for each in reversed(study.algorithms):
        if each.name in wanted and each.start_from is not None:
            wanted.add(each.start_from.algorithm)
    return study.model_copy(update={"algorithms": [each for each in study.algorithms if each.name in wanted]})


def _check_twice(key: str, values: Sequence[Any]) -> None:
    for value, count in Counter(values).most_common(1):
        if count > 1:
            raise ConfigError(f"{key}: {value!r} is there {count} times — expected every cell once")


def _chosen(key: str, wanted: Iterable[str] | None, there: Mapping[str, Any]) -> list[Any]:
    """Those that are named, in their order."""
    if wanted is None:
        return list(there.values())
    for name in wanted:
        if name not in there:
            near = suggestion(name, there) or f" — expected some of {', '.join(there) or 'those before'}"
            raise ConfigError(f"{key}: unknown name '{name}'{near}")
    return [there[name] for name in wanted]


def _quick(study: Study) -> Study:
    if study.quick is None:
        raise ConfigError("quick: missing — expected what differs in the quick version, such as {seeds: 1, steps: 1500}")
    quick = study.quick
    algorithms = _chosen("quick: algorithms", quick.algorithms, {each.name: each for each in study.algorithms})
    environments = _chosen("quick: environments", quick.environments, {each.id: each for each in study.environments})
    there = {each.id for each in environments}
    without_steps = {"steps": None} if quick.steps else {}
    without_own = {**without_steps, **({"seeds": None} if quick.seeds else {})}
    changes = {
        name: value
        for name in ("seeds", "steps", "protocol", "final_episodes", "save_freq")
        if (value := getattr(quick, name)) is not None
    }
    kept = [each for each in algorithms if each.environments is None or there.intersection(each.environments)]
    if not kept:
        raise ConfigError(f"quick: environments: {', '.join(sorted(there))} — no algorithm of the quick version runs there")
    return study.model_copy(
        update={
            **changes,
            "algorithms": [
                each.model_copy(
                    update={
                        "overrides": {**each.overrides, **quick.overrides},
                        "environments": each.environments and [env for env in each.environments if env in there],
                        **without_own,
                    }
                )
                for each in kept
            ],
            "environments": [each.model_copy(update=without_steps) for each in environments],
            "sweeps": {
                name: _sweep({**sweep.model_dump(include=sweep.model_fields_set), **quick.sweeps})
                for name, sweep in study.sweeps.items()
            },
            "figures": {
                name: each.model_copy(update={"algorithms": some, "environments": None})
                for name, each in study.figures.items()
                if (some := [one.name for one in kept if each.algorithms is None or one.name in each.algorithms])
            },
            "quick": None,
        }
    )


def cells_of(study: Study, folder: Path, results: Path | None = None) -> list[Cell]:
    """
    :param study: a study
    :param folder: folder of the study file
    :param results: folder of its results, where settings that it searches for are kept; by default as ``folder``
    :return: its cells, the first seed of each algorithm first, so that all algorithms progress alike
    """
    known: dict[str, Cell] = {}
    seeds = {each.name: each.seeds or study.seeds for each in study.algorithms}
    for index in range(max(map(len, seeds.values()))):
        for environment in study.environments:
            for algorithm in study.algorithms:
                if index < len(seeds[algorithm.name]) and environment.id in _environments(study, algorithm):
                    seed = seeds[algorithm.name][index]
                    cell = _cell(study, algorithm, environment, seed, folder, results or folder)
                    known[cell.name] = cell
    sources = {each.name: each.start_from for each in study.algorithms}
    cells: dict[str, Cell] = {}
    for name, cell in sorted(known.items(), key=lambda item: sources[item[1].algorithm] is not None):
        source = sources[cell.algorithm]
        if source is not None:
            begun = cells[f"{source.algorithm}/{RunFolder.file_name(source.environment)}_{cell.seed}"]
            cell = replace(cell, start_from=begun)
        cells[name] = cell
    return list(cells.values())


def _cell(study: Study, algorithm: Algorithm, environment: Environment, seed: int, folder: Path, results: Path) -> Cell:
    matrix = study.matrix
    conditions = {} if matrix is None else {name: each.model_dump() for name, each in matrix.conditions.items()}
    found = None if algorithm.sweep is None else found_by(study, algorithm.sweep, results)
    options = _options(study, algorithm, environment, seed, folder, found)
    return Cell(
        algorithm.name, environment, seed, options, study.final_episodes, conditions, sweep=algorithm.sweep, found=found
    )


def found_by(study: Study, name: str, results: Path) -> Path:
    """
    :param study: a study
    :param name: name of one of its searches
    :param results: folder of its results
    :return: file of the best settings, which is there once all trials have ended
    """
    return results / "settings" / f"{name}_best_of_{study.sweeps[name].n_trials}.yml"


def sweep_options(study: Study, name: str, folder: Path, results: Path) -> TuneOptions:
    """
    :param study: a study
    :param name: name of one of its searches
    :param folder: folder of the study file, which the search's own files are relative to
    :param results: folder of its results
    :return: options of ``tune``
    """
    settled = {"log_folder": str(results / "sweeps"), "study_name": name, "device": study.device, "num_threads": 1}
    sweep = study.sweeps[name]
    space = None if sweep.space is None else str(folder / sweep.space)
    if "env" not in sweep.model_fields_set:
        settled["env"] = study.environments[0].id  # the only one
    own = {"algo": _whole(sweep.algo, folder), "conf_file": _conf(sweep.conf_file, folder), "space": space}
    return sweep.model_copy(update={**settled, **own})


def _conf(name: str | None, folder: Path) -> str | None:
    """A file beside the study with its whole path; names of shipped files stay as they are."""
    return name if name is None or shipped_file(name) is not None else str(folder / name)


def _options(
    study: Study, algorithm: Algorithm, environment: Environment, seed: int, folder: Path, found: Path | None
) -> TrainOptions:
    conf = _conf(algorithm.conf, folder)
    if found is not None and found.is_file():
        conf = str(found)
    if study.protocol == "standard":
        evaluation: dict[str, Any] = {"protocol": "standard", "threshold": environment.threshold}
    else:
        evaluation = study.protocol.model_dump()
    return TrainOptions(
        algo=_algo(algorithm, folder),
        env=environment.id,
        n_timesteps=algorithm.steps or environment.steps or study.steps or -1,
        seed=seed,
        conf_file=conf,
        hyperparams={**environment.overrides, **algorithm.overrides},
        env_kwargs=environment.env_kwargs,
        with_replay_buffer=algorithm.start_from is not None and algorithm.start_from.replay_buffer,
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
        inherited = {} if cell.start_from is None else of_networks(configuration(cell.start_from).plain)
        return load_config(cell.options, inherited)
    except ConfigError as error:
        raise ConfigError(f"{cell.algorithm} on {cell.environment.id}: {error}") from None
