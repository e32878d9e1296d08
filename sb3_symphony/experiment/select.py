"""
Which trained agent: the flags that `evaluate`, `enjoy`, `video`, `gait` and `export` share, and the files they mean.

Only paths and YAML are read here, nothing heavy is imported; :mod:`sb3_symphony.experiment.agent` loads what was found.
"""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import BaseModel, Field, FiniteFloat

from sb3_symphony.common.checks import suggestion
from sb3_symphony.experiment.config import (
    ConfigError,
    NamedList,
    RunSettings,
    Threads,
    TrainOptions,
    check_algorithm,
    is_zoo_run,
    read_yaml,
    run_settings,
    shipped_folder,
    with_env_kwargs,
)
from sb3_symphony.experiment.registry import LOADABLE, is_file, without_folder, without_module
from sb3_symphony.experiment.run_folder import RunFolder, steps_in_name

_DEFAULT_ALGO, _DEFAULT_ENV = TrainOptions().algo, TrainOptions().env


class SelectOptions(BaseModel, extra="forbid", frozen=True):
    """
    Flags that say which agent, in which environment.

    :param model: a model's zip file, or a run folder; else it is looked for under ``folder``
    :param algo: name of the algorithm; known if the model lies in a run folder
    :param env: id of the environment; known if the model lies in a run folder
    :param folder: where runs are kept
    :param exp_id: number of the run; 0: the latest; -1: ``<folder>/<algo>/<env>.zip``, outside a run folder
    :param load_best: the model with the best evaluation instead of the last one
    :param load_checkpoint: the model after that number of steps
    :param load_last_checkpoint: the latest saved model of a run that did not end
    :param vecnormalize: statistics of ``VecNormalize`` to use instead of the run's; ``none``: no normalisation
    :param env_kwargs: arguments of the environment, over those of the run
    :param env_wrapper: wrappers of the environment: instead of those of the same names in the run, else around them
    :param gym_packages: modules to import, which register environments
    :param device: where the networks run
    :param num_threads: threads of PyTorch, -1: its own choice
    """

    model: str | None = None
    algo: str | None = None
    env: str | None = None
    folder: str = "logs"
    exp_id: int = Field(default=0, ge=-1)
    load_best: bool = False
    load_checkpoint: int | None = Field(default=None, ge=0)
    load_last_checkpoint: bool = False
    vecnormalize: str | None = None
    env_kwargs: dict[str, Any] = {}
    env_wrapper: NamedList = []
    gym_packages: list[str] = []
    device: str = "auto"
    num_threads: Threads = -1


@dataclass(frozen=True)
class Selection:
    """
    An agent that was found.

    :param algo: name of its algorithm
    :param model: its zip file
    :param env_id: environment that it was trained on, or is to be used on
    :param settings: settings of that environment: ``env_kwargs``, ``env_wrapper``, ``normalize``, ``frame_stack``
    :param normalization: its statistics of ``VecNormalize``, None without normalisation
    :param run: the run folder that holds it, None for a file from elsewhere
    :param normalization_known: whether None as ``normalization`` means that there is none, not that nobody told
    """

    algo: str
    model: Path
    env_id: str
    settings: RunSettings
    normalization: Path | None
    run: Path | None
    normalization_known: bool = True

    @property
    def shipped(self) -> bool:
        """Whether it comes with the package, into which no command writes."""
        return self.model.resolve().is_relative_to(pretrained_folder().resolve())

    def beside(self, suffix: str) -> Path:
        """
        :param suffix: such as ``.onnx``
        :return: a file beside the model, or in the working folder if the model comes with the package
        """
        return Path(f"{self.algo}_{self.model.stem}{suffix}") if self.shipped else self.model.with_suffix(suffix)


def pretrained_folder() -> Path:
    """
    :return: folder of the agents that come with the package, laid out like ``logs``
    """
    return shipped_folder("pretrained")


def select_model(options: SelectOptions) -> Selection:
    """
    Find a trained agent, and the environment that it belongs to.

    Without ``model``, it is looked for as RL Zoo does, in ``<folder>/<algo>/<env>_<exp-id>/``, and if the default folder
    has no such run and no certain model of it is wanted, among the agents that come with the package. What flags say about
    the environment goes before what the run says.

    :param options: flags
    :return: the agent's files and environment
    :raises ConfigError: if there is no such agent, or its environment is not known
    """
    try:
        return _select(options)
    except OSError as error:  # no permission to look, or a name that is no name
        raise ConfigError(f"{error.filename}: cannot be read — {error.strerror}") from None


def _select(options: SelectOptions) -> Selection:
    given = _which_of_run(options)
    if len(given) > 1:
        raise ConfigError(f"{' and '.join(given)}: expected only one of them")
    if options.algo is not None:
        check_algorithm(options.algo, LOADABLE)
    if options.model is not None and options.exp_id != 0:
        raise ConfigError(f"--exp-id: {options.exp_id} — expected --model or --exp-id, not both")

    if options.model is not None and options.folder != SelectOptions.model_fields["folder"].default:
        raise ConfigError(f"-f: '{options.folder}' — expected --model or -f to look for runs, not both")

    run: RunFolder | None = None
    if options.model is not None:
        path = Path(options.model)
        if path.is_dir():
            run = _run_at(path)
            if run is None:
                raise ConfigError(f"--model: '{path}' — expected a model's zip file, or a run folder with <env>/config.yml")
            path = _model_of(run, options)
        elif given:
            raise ConfigError(f"{given[0]}: chooses among the models of a run — --model names one already")
        else:
            if not path.exists() and path.suffix != ".zip":
                path = path.with_name(path.name + ".zip")
            run = _run_of(path)
    elif options.exp_id == -1:
        if given:
            raise ConfigError(f"{given[0]}: chooses among the models of a run — --exp-id -1 names one outside of runs")
        algo, env_id = options.algo or _DEFAULT_ALGO, options.env or _DEFAULT_ENV
        options = options.model_copy(update={"algo": algo, "env": env_id})
        path = Path(options.folder) / algo / f"{RunFolder.file_name(env_id)}.zip"
    else:
        run = _find_run(options)
        path = _model_of(run, options)
    if not path.is_file():
        raise ConfigError(f"{path}: no such file — expected a model saved by Stable-Baselines3")
    return _selection(options, path, run)


def _which_of_run(options: SelectOptions) -> list[str]:
    """The flags given that choose among the models of a run."""
    wanted = {
        "--load-best": options.load_best,
        "--load-checkpoint": options.load_checkpoint is not None,
        "--load-last-checkpoint": options.load_last_checkpoint,
    }
    return [flag for flag, value in wanted.items() if value]


def _selection(options: SelectOptions, model: Path, run: RunFolder | None) -> Selection:
    trained = read_yaml(run.details / "args.yml") if run and (run.details / "args.yml").is_file() else {}
    algo, env_id = options.algo or trained.get("algo"), options.env or trained.get("env")
    if run is not None and options.model is None:  # named by the flags' defaults
        algo, env_id = algo or run.path.parent.name, env_id or run.env_name
    if algo is None:
        raise ConfigError(f"--algo: missing — expected the algorithm that trained {model}")
    if options.algo is None and is_file(str(algo)):
        raise ConfigError(f"--algo: missing — {model} was trained with {algo}, expected that, which runs the file's code")
    check_algorithm(str(algo), LOADABLE)
    if run is not None and without_folder(str(algo)) != without_folder(str(trained.get("algo", algo))):
        raise ConfigError(f"--algo: {algo} — {model} was trained with {trained['algo']}")
    if env_id is None:
        raise ConfigError(f"--env: missing — expected the environment that {model} is to act in")

    config = with_env_kwargs(read_yaml(run.details / "config.yml") if run else {}, trained)
    if without_module(env_id) != without_module(trained.get("env", env_id)):
        config["env_kwargs"] = {}  # of another environment
    settings = run_settings({"n_timesteps": 1, **config}).varied(options.env_kwargs, options.env_wrapper)
    normalization = _normalization(options, model, run, settings, all_in_one=is_zoo_run(trained))
    known = run is not None or options.vecnormalize is not None
    return Selection(str(algo), model, str(env_id), settings, normalization, run.path if run else None, known)


def _normalization(
    options: SelectOptions, model: Path, run: RunFolder | None, settings: RunSettings, all_in_one: bool
) -> Path | None:
    """Statistics that belong to the model; RL Zoo has one file for all models of a run, this package one for each."""
    if options.vecnormalize == "none":
        return None
    if options.vecnormalize is not None:
        path = Path(options.vecnormalize)
        if not path.is_file():
            raise ConfigError(f"--vecnormalize: '{path}' — no such file")
        return path
    if run is None or settings.normalize is False:
        return None
    steps = steps_in_name(model)
    if steps is not None:
        own = run.normalization_at(steps)
    else:
        own = run.best_normalization if model.stem == "best_model" else run.normalization
    for path in (own, run.normalization) if all_in_one else (own,):
        if path.is_file():
            return path
    raise ConfigError(f"{model}: was trained with VecNormalize, but its statistics {own} are missing — see --vecnormalize")


def _run_at(path: Path) -> RunFolder | None:
    """The run folder at ``path``, recognised by ``<env>/config.yml``."""
    for config in sorted(path.glob("*/config.yml")):
        return RunFolder(path, config.parent.name)
    return None


def _run_of(model: Path) -> RunFolder | None:
    """The run folder that a model lies in, beyond doubt: any project may have a ``conf/config.yml`` beside its models."""
    run = _run_at(model.absolute().parent)
    if run is None or run.model.is_file():
        return run
    args = run.details / "args.yml"
    return run if args.is_file() and RunFolder.file_name(str(read_yaml(args).get("env"))) == run.env_name else None


def _find_run(options: SelectOptions) -> RunFolder:
    """The run that algorithm, environment, folder and number name."""
    algo, env_id = options.algo or _DEFAULT_ALGO, options.env or _DEFAULT_ENV
    env_name = RunFolder.file_name(env_id)
    folder, algo = Path(options.folder), without_folder(algo)
    numbers = RunFolder.numbers(folder / algo, env_name)
    by_default = options.folder == SelectOptions.model_fields["folder"].default and options.exp_id == 0
    if not numbers and by_default and not _which_of_run(options):
        shipped = pretrained_folder()
        numbers = RunFolder.numbers(shipped / algo, env_name)
        if numbers:
            print(f"note: no such run in '{folder}', this is the agent that comes with the package", file=sys.stderr)
            folder = shipped
    if not numbers:
        trained = sorted({path.name.rpartition("_")[0] for path in (folder / algo).glob("*_*") if path.is_dir()})
        near = suggestion(env_name, trained) or (f" — there are runs of {', '.join(trained)}" if trained else "")
        near = near or " — expected a run folder there, or --model; `sb3-symphony train` makes one"
        raise ConfigError(f"{folder / algo}: no run of {algo} on {env_id}{near}")
    number = options.exp_id or max(numbers)
    if number not in numbers:
        raise ConfigError(f"--exp-id: {number} — {folder / algo} has {env_name} number {', '.join(map(str, sorted(numbers)))}")
    run = _run_at(folder / algo / f"{env_name}_{number}")
    if run is None:
        raise ConfigError(f"{folder / algo / env_name}_{number}: not a run folder — {env_name}/config.yml is missing")
    return run


def _model_of(run: RunFolder, options: SelectOptions) -> Path:
    if options.load_best:
        if not run.best_model.is_file():
            raise ConfigError(f"--load-best: {run.best_model} is missing — the run had no evaluation")
        return run.best_model
    if options.load_last_checkpoint or options.load_checkpoint is not None:
        saved = run.saved_models()
        flag = "--load-last-checkpoint" if options.load_last_checkpoint else "--load-checkpoint"
        if not saved:
            raise ConfigError(f"{flag}: {run.path} has no checkpoint — `train --save-freq` makes them")
        steps = max(saved) if options.load_checkpoint is None else options.load_checkpoint
        if steps not in saved:
            raise ConfigError(f"{flag}: {steps} — {run.path} has checkpoints at {', '.join(map(str, saved))} steps")
        return saved[steps]
    if not run.model.is_file():
        raise ConfigError(f"{run.model}: missing, the run has not ended — see --load-best and --load-last-checkpoint")
    return run.model


# ----------------------------------------------------------------------------------------------------------------------
# Options of the commands
# ----------------------------------------------------------------------------------------------------------------------


class EvaluateOptions(SelectOptions, frozen=True):
    """Options of ``sb3-symphony evaluate``; their meaning is in its ``--help``."""

    n_episodes: int = Field(default=100, ge=1, lt=2**31)
    seed: int = Field(default=20_000, ge=0, lt=2**31)
    deterministic: bool = True
    n_envs: int = Field(default=1, ge=1)
    obs_noise: FiniteFloat = Field(default=0.0, ge=0)
    action_delay: int = Field(default=0, ge=0)
    json_file: str | None = None
    progress: bool = False
    num_threads: Threads = 1  # one observation at a time is fastest so, and results do not depend on the machine's cores


class EnjoyOptions(SelectOptions, frozen=True):
    """Options of ``sb3-symphony enjoy``; their meaning is in its ``--help``."""

    n_timesteps: int = Field(default=1000, ge=1)
    n_envs: int = Field(default=1, ge=1)
    seed: int = Field(default=0, ge=0, lt=2**31)
    deterministic: bool = True
    render: bool = True
    norm_reward: bool = False
    reward_log: str | None = None
    progress: bool = False


class ExportOptions(SelectOptions, frozen=True):
    """Options of ``sb3-symphony export``; their meaning is in its ``--help``."""

    output: str | None = Field(default=None, min_length=1)


class AgentsOptions(SelectOptions, frozen=True):
    """
    Flags of commands that show one agent or several.

    :param agents: models' zip files or run folders; none: the one that the other flags name
    :param labels: what to call them; none: algorithm, and which of its models
    :param seed: seed of the (first) episode
    :param deterministic: whether the policy is asked for its mode instead of a sample
    :param n_timesteps: an episode is left after that many steps; None: at its end
    :param output: file to write
    :param progress: whether to show a progress bar
    """

    agents: list[str] = []
    labels: list[str] = []
    seed: int = Field(default=0, ge=0, lt=2**31)
    deterministic: bool = True
    n_timesteps: int | None = Field(default=None, ge=1)
    output: str | None = Field(default=None, min_length=1)
    progress: bool = False
    num_threads: Threads = 1


class VideoOptions(AgentsOptions, frozen=True):
    """Options of ``sb3-symphony video``; their meaning is in its ``--help``."""

    grid: bool = False
    n_episodes: int = Field(default=1, ge=1)
    fps: int | None = Field(default=None, ge=1, le=120)
    width: int | None = Field(default=None, ge=64, le=3840)


class GaitOptions(AgentsOptions, frozen=True):
    """Options of ``sb3-symphony gait``; their meaning is in its ``--help``."""

    skip: FiniteFloat = Field(default=2.0, ge=0, le=1e6)
    window: FiniteFloat = Field(default=2.0, ge=0.2, le=1e6)
    n_frames: int = Field(default=8, ge=0, le=40)
    json_file: str | None = None
