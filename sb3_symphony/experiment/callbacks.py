"""What happens beside learning: evaluation, stopping on a signal, progress bar."""

import io
import os
import pickle
import warnings
from collections.abc import Callable, Iterable
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import Any

import numpy as np
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TaskProgressColumn,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback, CheckpointCallback, EvalCallback
from stable_baselines3.common.vec_env import VecEnv

from sb3_symphony.analysis.statistics import first_stable_evaluation
from sb3_symphony.common.files import completed, write_atomically, write_together
from sb3_symphony.experiment.config import ConfigError
from sb3_symphony.experiment.decode import argument_types, class_by_name, typed_arguments
from sb3_symphony.experiment.signals import handled_by


class StopOnSignal(BaseCallback):
    """
    Ends training when Ctrl-C is pressed or the process is asked to terminate.

    Stopping between two steps leaves model, replay and files whole. A second signal does not wait.

    :param at_rollouts: stop at the start of the next rollout, not already after the current step: a checkpoint can be
        made there. It is made by a callback that comes before this one and asks :meth:`here`
    """

    def __init__(self, at_rollouts: bool = False) -> None:
        super().__init__()
        self.at_rollouts = at_rollouts
        self.requested = False
        self.now = False

    def _handle(self, signum: int, frame: Any) -> None:
        if self.requested:
            raise KeyboardInterrupt
        self.requested = True
        self.now = not self.at_rollouts
        # Not print(): a signal may arrive inside one
        os.write(2, b"\nstopping as soon as all can be saved (once more: at once)\n")

    def listening(self) -> AbstractContextManager[None]:
        """Handle signals inside the block, where Python allows it (the main thread)."""
        return handled_by(self._handle)

    def here(self) -> bool:
        """:return: at the start of a rollout, whether training is going to stop there"""
        self.now = self.requested
        return self.now

    def _on_rollout_start(self) -> None:
        if self.now:
            raise KeyboardInterrupt

    def _on_step(self) -> bool:
        return not self.now


class _EvaluationAborted(Exception):
    pass


def save_model(model: BaseAlgorithm, path: Path, normalization_path: Path) -> None:
    """
    Save a model together with the statistics of ``VecNormalize`` that belong to it. If that fails, files that were there
    before stay as they were.

    :param model: the model
    :param path: its file
    :param normalization_path: file of the statistics, if there are any
    :raises OSError: if one of them cannot be written
    """
    content = io.BytesIO()
    model.save(content)
    normalization = model.get_vec_normalize_env()
    statistics = {} if normalization is None else {normalization_path: pickle.dumps(normalization)}
    write_together({**statistics, path: content.getvalue()})


class SavedModels(CheckpointCallback):
    """
    SB3's ``CheckpointCallback`` with statistics of ``VecNormalize``, whose files are whole on a full disk too, or not there.

    :param save_freq: calls between two models
    :param save_path: their folder
    """

    def _on_step(self) -> bool:
        if self.n_calls % self.save_freq == 0:
            statistics = self._checkpoint_path("vecnormalize_", extension="pkl")
            save_model(self.model, Path(self._checkpoint_path(extension="zip")), Path(statistics))
        return True


class SaveBestModel(BaseCallback):
    """
    Saves a new best model.

    :param path: its file
    :param normalization_path: file of its statistics
    """

    def __init__(self, path: Path, normalization_path: Path) -> None:
        super().__init__()
        self.path = path
        self.normalization_path = normalization_path

    def _on_step(self) -> bool:
        save_model(self.model, self.path, self.normalization_path)
        return True


class SeededEvaluation(EvalCallback):
    """
    SB3's evaluation, on the same environment seeds every time, and abandoned when the run is to stop.

    :param eval_env: environment of :func:`sb3_symphony.experiment.environment.make_evaluation_env`
    :param stop: tells whether to stop
    :param threshold: mean return that two consecutive evaluations must reach for the environment to be solved
    :param solved_stride: from then on only every n-th evaluation takes place
    :param stop_reward: mean return of an evaluation that ends the training
    :param log_path: folder for ``evaluations.npz``, which is replaced as a whole at each evaluation
    :param kwargs: arguments of ``EvalCallback``
    """

    log_path: Any  # where SB3 writes them meanwhile

    def __init__(
        self,
        eval_env: VecEnv,
        stop: StopOnSignal,
        threshold: float | None = None,
        solved_stride: int = 1,
        stop_reward: float | None = None,
        log_path: Path | None = None,
        **kwargs: Any,
    ) -> None:
        super().__init__(eval_env, **kwargs)
        self.evaluations_file = None if log_path is None else log_path / "evaluations.npz"
        self.stop_reward = stop_reward
        self.stop = stop
        self.threshold = threshold
        self.solved_stride = solved_stride

    def _init_callback(self) -> None:
        with warnings.catch_warnings():  # training may be spread over processes
            warnings.filterwarnings("ignore", message="Training and eval env are not of the same type")
            super()._init_callback()

    def _solved(self) -> bool:
        steps, results = self.evaluations_timesteps, self.evaluations_results
        return self.threshold is not None and first_stable_evaluation(steps, results, self.threshold).reached

    def _log_success_callback(self, locals_: dict[str, Any], globals_: dict[str, Any]) -> None:
        if self.stop.now:
            raise _EvaluationAborted
        super()._log_success_callback(locals_, globals_)

    def _on_step(self) -> bool:
        n_due, between = divmod(self.n_calls, self.eval_freq)
        if between or (n_due % self.solved_stride and self._solved()):
            return True
        self.eval_env.env_method("restart_seeds")
        file = self.evaluations_file
        try:
            with nullcontext() if file is None else completed(file) as self.log_path:
                go_on = super()._on_step()
        except _EvaluationAborted:
            return False
        return go_on and not (self.stop_reward is not None and self.last_mean_reward >= self.stop_reward)


def configured_callbacks(
    named: Iterable[tuple[str, dict[str, Any]]], model: BaseAlgorithm, make_env: Callable[[], VecEnv]
) -> list[BaseCallback]:
    """
    Make the callbacks of a configuration.

    :param named: names from an allow-list, and arguments
    :param model: model that is about to learn
    :param make_env: makes an environment with the rewards that are learned from, for callbacks that want one
    :return: the callbacks
    :raises ConfigError: for an unknown name, a wrong argument, or one that does not fit the model
    """
    callbacks: list[BaseCallback] = []
    for name, plain in named:
        class_ = class_by_name("callback", name)
        arguments = typed_arguments(plain, class_, ["eval_env", "callback"])
        if "eval_env" in argument_types(class_):
            arguments["eval_env"] = make_env()
        try:
            callbacks.append(class_(**arguments))
            callbacks[-1].init_callback(model)
        except (ValueError, TypeError) as error:
            raise ConfigError(f"callback: {class_.__name__}: {error}") from None
    return callbacks


class NoteLogFolder(BaseCallback):
    """
    Writes down where the TensorBoard log of a run is, if it has one, so that figures of the run find it.

    :param path: file, which will hold the folder relative to its own
    """

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.path = path

    def _on_training_start(self) -> None:
        folder = self.logger.get_dir()
        if self.model.tensorboard_log and folder is not None:  # else SB3's logger has an empty one among the temporary ones
            write_atomically(self.path, f"{os.path.relpath(folder, self.path.parent)}\n".encode())

    def _on_step(self) -> bool:
        return True


class ReturnProgressBar(BaseCallback):
    """
    Live progress bar with the mean return of the latest ten training episodes and of the last evaluation.

    :param evaluation: evaluation of the run, if there is one
    """

    def __init__(self, evaluation: EvalCallback | None = None) -> None:
        super().__init__()
        self.evaluation = evaluation
        self.progress = Progress(
            TaskProgressColumn(),
            BarColumn(bar_width=None),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            "<",
            TimeRemainingColumn(),
            TextColumn("{task.description}"),
        )

    def _on_training_start(self) -> None:
        self.progress.start()
        self.task = self.progress.add_task("", total=self.locals["total_timesteps"])
        self.started = False

    def _on_rollout_start(self) -> None:
        if not self.started:  # a resumed run begins here, which is no progress of this process
            self.progress.reset(self.task, completed=self.model.num_timesteps)
            self.started = True

    def _on_step(self) -> bool:
        self.progress.update(self.task, completed=self.num_timesteps)
        if any("episode" in info for info in self.locals["infos"]) and self.model.ep_info_buffer:
            latest = [episode["r"] for episode in self.model.ep_info_buffer][-10:]
            description = f"return {np.mean(latest):.0f}"
            if self.evaluation is not None and self.evaluation.evaluations_results:
                description += f", eval {np.mean(self.evaluation.evaluations_results[-1]):.0f}"
            self.progress.update(self.task, description=description)
        return True

    def close(self) -> None:
        """Leave the terminal in order, also after an error."""
        self.progress.stop()
