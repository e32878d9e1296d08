"""A run that was stopped, killed or finished, and how it goes on."""

import math
import sys
import zipfile
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.logger import HumanOutputFormat, KVWriter, Logger, TensorBoardOutputFormat
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.utils import get_latest_run_id
from torch.utils.tensorboard import SummaryWriter

from sb3_symphony.analysis.runs import Evaluations, noted_log, read_evaluations
from sb3_symphony.common.checkpoint import Checkpoint, checkpoint_files, newest_checkpoint
from sb3_symphony.common.checks import constructor_parameters
from sb3_symphony.common.files import DamagedFile, write_atomically
from sb3_symphony.experiment.config import (
    ConfigError,
    RunConfig,
    TrainOptions,
    is_zoo_run,
    load_config,
    read_yaml,
    validated,
)
from sb3_symphony.experiment.registry import load_algorithm, without_folder
from sb3_symphony.experiment.run_folder import RunFolder, last_parts, saved_count

#: options that may differ from those the run was started with. Schedules depend on the first of them, rounding on the
#: device, results on no other
_CHANGEABLE = {"n_timesteps", "save_freq", "keep", "device", "verbose", "progress", "quiet", "json_file"}


@dataclass
class StoredRun:
    """
    A run as its folder tells it.

    :param run: its folder
    :param options: options to go on with
    :param config: configuration to go on with
    :param steps: environment steps of its saved model, 0 if there is none
    :param save_freq: steps between checkpoints until now
    """

    run: RunFolder
    options: TrainOptions
    config: RunConfig
    steps: int
    save_freq: int

    @property
    def finished(self) -> bool:
        """Whether nothing is left to do: model and, if there are any, last checkpoint have all steps."""
        steps = self.steps
        if self.run.checkpoints.is_dir():  # a model may also be that of an interrupted run
            steps = min(steps, max(checkpoint_files(self.run.checkpoints), default=0))
        return steps >= self.config.settings.n_timesteps or self.solved

    @property
    def solved(self) -> bool:
        """Whether ``stop_reward`` ended it, and its model is saved."""
        stop_reward = self.config.settings.stop_reward
        if stop_reward is None:
            return False
        last = self.evaluations and (self.evaluations.steps[-1], self.evaluations.returns[-1].mean())
        return bool(last and last[0] == self.steps and last[1] >= stop_reward)

    @cached_property
    def evaluations(self) -> Evaluations | None:
        """Its evaluations, None if there are none or they are damaged."""
        try:
            return read_evaluations(self.run.path)
        except ValueError:
            return None

    @property
    def last_evaluation(self) -> list[float]:
        """Returns of its last evaluation, empty if there is none."""
        return [] if self.evaluations is None else [float(value) for value in self.evaluations.returns[-1]]

    @property
    def seconds(self) -> float:
        """Wall-clock time as its newest checkpoint has it, 0 if there is none."""
        try:
            checkpoint = newest_checkpoint(self.run.checkpoints)
        except DamagedFile:
            checkpoint = None
        return 0.0 if checkpoint is None else checkpoint.state["elapsed"] / 1e9

    def checkpoint(self) -> Checkpoint | None:
        """
        :return: where to go on from; None if the run was stopped before its first checkpoint, and begins again
        :raises ConfigError: if no checkpoint is whole, all are gone, or it is beyond the end that is asked for
        """
        try:
            checkpoint = newest_checkpoint(self.run.checkpoints)
        except DamagedFile as error:
            raise ConfigError(f"--resume: no checkpoint of '{self.run.path}' is whole — {error}") from None
        if checkpoint is None and self.steps >= self.save_freq + self._rollout:  # there was one, and much was learned since
            raise ConfigError(
                f"--resume: '{self.run.path}' has a model of {self.steps} steps, but no checkpoint — start a new run"
            )
        if checkpoint is not None and checkpoint.steps >= self.config.settings.n_timesteps:
            n_timesteps = self.config.settings.n_timesteps
            raise ConfigError(f"-n: {n_timesteps} — the run has taken {checkpoint.steps} steps already, expected more")
        return checkpoint

    @property
    def _rollout(self) -> float:
        """Environment steps of a rollout, at whose start alone a checkpoint is made; infinite if episodes decide."""
        algorithm = load_algorithm(self.options.algo)
        name = "n_steps" if issubclass(algorithm, OnPolicyAlgorithm) else "train_freq"
        parameters = constructor_parameters(algorithm)  # one's own class may have settled it
        length = self.config.plain.get(name, parameters[name].default if name in parameters else math.inf)
        length, unit = length if isinstance(length, list | tuple) else (length, "step")
        return length * self.config.settings.n_envs if unit == "step" else math.inf


def _spelling(name: str) -> str:
    short = {"n_timesteps": "-n", "hyperparams": "-params", "conf_file": "-conf", "json_file": "--json"}
    return short.get(name, "--" + name.replace("_", "-"))


def model_steps(path: Path) -> int:
    """
    :param path: model saved by SB3
    :return: environment steps it was trained for, 0 if there is no such file or it is damaged
    """
    try:
        return saved_count(path, "num_timesteps")
    except (OSError, zipfile.BadZipFile, ValueError, KeyError, TypeError):
        return 0


def open_run(options: TrainOptions) -> StoredRun:
    """
    Read the folder of a run that is to go on. Nothing is changed.

    :param options: ``resume``, and other options as far as they are given
    :return: the run
    :raises ConfigError: if it is no such folder, another option contradicts it, or it has no checkpoints
    """
    assert options.resume is not None
    folder = Path(options.resume)
    try:
        found = sorted(folder.glob("*/args.yml"))
        what = "no run folder (no <env>/args.yml in it)" if folder.is_dir() else "no such folder"
    except OSError as error:  # such as a name that is too long
        raise ConfigError(f"--resume: '{folder}' cannot be read — {error.strerror}") from None
    if len(found) != 1:
        raise ConfigError(f"--resume: '{folder}' — {what}; expected one such as logs/symphony/BipedalWalker-v3_1")
    run = RunFolder(folder, found[0].parent.name)
    content = read_yaml(found[0])
    if is_zoo_run(content):
        raise ConfigError(f"--resume: '{folder}' has no checkpoints — RL Zoo made it; -i starts a new run from its agent")
    try:
        stored: TrainOptions = validated(TrainOptions, content)
    except ConfigError as error:
        raise ConfigError(f"{found[0]}: {error}") from None

    given = {name: getattr(options, name) for name in options.model_fields_set - {"resume"}}
    for name, place in (("algo", without_folder), ("trained_agent", last_parts)):  # which may have been moved
        if name in given and place(given[name] or "") == place(getattr(stored, name) or ""):
            stored = stored.model_copy(update={name: given.pop(name)})
    for name, value in given.items():
        if name not in _CHANGEABLE and value != getattr(stored, name):
            allowed = ", ".join(map(_spelling, sorted(_CHANGEABLE)))
            raise ConfigError(
                f"{_spelling(name)}: {value!r} contradicts the run, which has {getattr(stored, name)!r} — "
                f"with --resume only {allowed} may differ"
            )
    changed = {name: value for name, value in given.items() if name in _CHANGEABLE}
    if changed.get("progress", stored.progress) != stored.progress:
        changed.setdefault("verbose", None)  # which depends on it
    resumed = stored.model_copy(update=changed)
    # The run's own file, not the shipped one, which may have changed since
    source = {"conf_file": str(run.details / "config.yml"), "hyperparams": {}, "env_kwargs": {}}
    source["n_timesteps"] = changed.get("n_timesteps", -1)
    config = load_config(stored.model_copy(update=source))

    result = StoredRun(run, resumed, config, model_steps(run.model), stored.save_freq)
    if not result.finished and not run.checkpoints.is_dir():
        why = "they were deleted" if stored.save_freq > 0 else "it was started without --save-freq"
        raise ConfigError(f"--resume: '{folder}' has no checkpoints — {why}")
    if not result.finished and resumed.save_freq <= 0:
        raise ConfigError(f"--save-freq: {resumed.save_freq} — expected a number > 0 for a run that is resumed")
    return result


def restore_files(run: RunFolder, checkpoint: Checkpoint | None) -> None:
    """
    Give the files that change in the course of a run the content they had at a checkpoint; without one, remove them, and keep
    the model of a run that was stopped so soon as that of its steps.

    :param run: folder of the run
    :param checkpoint: where to go on from
    """
    contents = checkpoint.state["files"] if checkpoint else {}
    if checkpoint is None and run.model.is_file():
        steps = model_steps(run.model)
        run.model.rename(run.model_at(steps))
        if run.normalization.is_file():
            run.normalization.rename(run.normalization_at(steps))
    for path in run.changing_files():
        if path.name not in contents:
            path.unlink()
    for name, content in contents.items():
        write_atomically(run.path / name, content)


class _TensorBoardOnward(TensorBoardOutputFormat):
    """Goes on in a folder; what a killed process logged after the checkpoint is marked as void."""

    def __init__(self, folder: str, steps: int) -> None:
        self.writer = SummaryWriter(log_dir=folder, purge_step=steps + 1)
        self._is_closed = False


def _is_copy(run: RunFolder, checkpoint: Checkpoint) -> bool:
    """Whether the folder that the checkpoint was made in is there too."""
    made_in = checkpoint.state.get("folder")
    return made_in is not None and Path(made_in).is_dir() and not Path(made_in).samefile(run.checkpoints)


def continue_logs(model: BaseAlgorithm, run: RunFolder, checkpoint: Checkpoint, learn_arguments: dict[str, Any]) -> None:
    """
    Let a resumed model log as if it had never stopped.

    :param model: model that is about to learn
    :param run: folder of the run, which may have been moved
    :param checkpoint: where it goes on from
    :param learn_arguments: arguments of its ``learn()``, of which ``log_interval`` may change
    """
    if model.tensorboard_log:
        noted = noted_log(run.log_folder)
        folder = str(noted.absolute()) if noted is not None and noted.is_dir() else checkpoint.state["log folder"]
        if _is_copy(run, checkpoint):  # the log is that of the run it was copied from, which may go on too
            name = Path(folder).name.rpartition("_")[0]
            latest = get_latest_run_id(model.tensorboard_log, name)
            folder = str(Path(model.tensorboard_log) / f"{name}_{latest + 1}")
        writers: list[KVWriter] = [HumanOutputFormat(sys.stdout)] if model.verbose >= 1 else []
        model.set_logger(Logger(folder, [*writers, _TensorBoardOnward(folder, checkpoint.steps)]))
    if isinstance(model, OnPolicyAlgorithm) and learn_arguments.get("log_interval", 1) is not None:
        # Its learn() counts iterations from 0, and logs the count: let it always ask, and answer by the right count
        algorithm, before = type(model), checkpoint.steps // (model.n_steps * model.n_envs)
        log_interval = learn_arguments.get("log_interval", 1)
        learn_arguments["log_interval"] = 1

        def dump_logs(self: OnPolicyAlgorithm, iteration: int = 0) -> None:
            if (before + iteration) % log_interval == 0:
                algorithm.dump_logs(self, before + iteration)

        model.__class__ = type(algorithm.__name__, (algorithm,), {"dump_logs": dump_logs})
