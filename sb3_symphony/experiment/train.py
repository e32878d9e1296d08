"""One training run, from options to files on disk."""

import shlex
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback, CheckpointCallback
from stable_baselines3.common.vec_env import VecEnv

from sb3_symphony.analysis.plots import plot_training
from sb3_symphony.experiment.callbacks import ReturnProgressBar, SaveNormalization, SeededEvaluation, StopOnSignal
from sb3_symphony.experiment.config import ConfigError, RunConfig, TrainOptions, load_config
from sb3_symphony.experiment.decode import algorithm_arguments
from sb3_symphony.experiment.environment import (
    attach_monitor_files,
    check_spaces,
    make_evaluation_env,
    make_training_env,
)
from sb3_symphony.experiment.registry import load_algorithm
from sb3_symphony.experiment.run_folder import RunFolder


@dataclass(frozen=True)
class TrainResult:
    """
    What a run left behind.

    :param run: its folder
    :param steps: environment steps taken
    :param evaluation: returns of the last evaluation's episodes, empty if there was none
    :param seconds: wall-clock time of learning
    :param interrupted: whether it was stopped by a signal
    """

    run: RunFolder
    steps: int
    evaluation: list[float]
    seconds: float
    interrupted: bool

    def summary(self) -> str:
        """:return: one line for the end of a run"""
        evaluated = "not evaluated"
        if self.evaluation:
            mean, spread = np.mean(self.evaluation), np.std(self.evaluation)
            evaluated = f"last evaluation {mean:.1f} ± {spread:.1f} ({len(self.evaluation)} episodes)"
        minutes, seconds = divmod(round(self.seconds), 60)
        hours, minutes = divmod(minutes, 60)
        state = "interrupted, saved" if self.interrupted else "saved"
        return f"{state} {self.run.model} | {self.steps} steps | {evaluated} | {hours}:{minutes:02}:{seconds:02} h"


def build_model(options: TrainOptions, config: RunConfig, seed: int, verbose: int) -> BaseAlgorithm:
    """
    Make the training environment and the model on it. Nothing is written.

    :param options: options of the command line
    :param config: merged configuration
    :param seed: seed of environment and model
    :param verbose: how much the model prints
    :return: the model, its environment set
    :raises ConfigError: if something of the configuration does not fit
    """
    algorithm = load_algorithm(options.algo)
    gamma = config.arguments.get("gamma")
    env = make_training_env(options.env, config.settings, gamma if isinstance(gamma, int | float) else None, seed)
    try:
        check_spaces(env, options.env, options.algo, config.settings.policy)
        arguments = algorithm_arguments(options.algo, algorithm, config, env.action_space)
        if options.tensorboard_log:
            arguments["tensorboard_log"] = str(Path(options.tensorboard_log) / options.env.replace("/", "-"))
        return algorithm(env=env, seed=seed, device=_device(options.device), verbose=verbose, **arguments)
    except ConfigError:
        env.close()
        raise
    except (ValueError, TypeError, AssertionError, MemoryError) as error:
        env.close()
        raise ConfigError(f"{options.algo} on {options.env}: {error}") from error


def _device(name: str) -> str:
    try:
        device = "cpu" if name == "auto" else th.device(name).type
    except RuntimeError:
        device = ""
    if not device or (device == "cuda" and not th.cuda.is_available()):
        raise ConfigError(f"--device: '{name}' is not there — expected auto, cpu" + ", cuda" * th.cuda.is_available())
    return name


def _evaluation(
    options: TrainOptions, config: RunConfig, run: RunFolder, env: VecEnv, stop: StopOnSignal, verbose: int
) -> SeededEvaluation:
    return SeededEvaluation(
        env,
        stop,
        callback_on_new_best=SaveNormalization(run.best_normalization),
        n_eval_episodes=options.eval_episodes,
        eval_freq=max(options.eval_freq // config.settings.n_envs, 1),
        log_path=str(run.path),
        best_model_save_path=str(run.path),
        verbose=verbose,
    )


def _checkpoints(options: TrainOptions, config: RunConfig, run: RunFolder) -> CheckpointCallback:
    frequency = max(options.save_freq // config.settings.n_envs, 1)
    return CheckpointCallback(frequency, str(run.path), save_vecnormalize=True)


def _writable(folder: str, flag: str) -> None:
    try:
        Path(folder).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(f"{flag}: '{folder}' cannot be written — {error.strerror}") from None


def train(options: TrainOptions, command: str | None = None) -> TrainResult:
    """
    Train one agent and write its run folder.

    The folder is made once everything has been validated and the model built, so a mistake leaves nothing behind.

    :param options: options of the command line
    :param command: the command line, for ``command.txt``
    :return: what the run left behind
    :raises ConfigError: if options or configuration are wrong
    """
    config = load_config(options)
    seed = options.seed if options.seed >= 0 else int(np.random.default_rng().integers(2**31))
    verbose = options.verbose if options.verbose is not None else int(not options.progress)
    if options.num_threads > 0:
        th.set_num_threads(options.num_threads)

    model = build_model(options, config, seed, verbose)
    env = model.get_env()
    assert env is not None
    evaluation_env = make_evaluation_env(options.env, config.settings) if options.eval_freq > 0 else None
    bar: ReturnProgressBar | None = None
    try:
        if options.tensorboard_log:
            _writable(options.tensorboard_log, "--tensorboard-log")
        run = RunFolder.create(options.log_folder, options.algo, options.env)
        used = options.model_copy(update={"seed": seed, "n_timesteps": config.settings.n_timesteps, "verbose": verbose})
        command = command or f"sb3-symphony train --algo {options.algo} --env {shlex.quote(options.env)}"
        if options.seed < 0:
            command += f" --seed {seed}"  # so that the command repeats this run
        run.write_configuration(used.model_dump(), config.plain, command)
        attach_monitor_files(env, run.path)

        stop = StopOnSignal()
        callbacks: list[BaseCallback] = [stop]
        evaluation = None
        if evaluation_env is not None:
            evaluation = _evaluation(options, config, run, evaluation_env, stop, verbose)
            callbacks.append(evaluation)
        if options.save_freq > 0:
            callbacks.append(_checkpoints(options, config, run))
        if options.progress:
            bar = ReturnProgressBar(evaluation)
            callbacks.append(bar)

        print(f"{options.algo} on {options.env}, seed {seed}: {config.settings.n_timesteps} steps into {run.path}", flush=True)
        start = time.perf_counter()
        with stop.listening():
            learn_arguments: dict[str, Any] = {}
            if options.log_interval != -1:
                learn_arguments["log_interval"] = None if options.log_interval == -2 else options.log_interval
            try:
                model.learn(config.settings.n_timesteps, callback=callbacks, **learn_arguments)
            except KeyboardInterrupt:
                stop.requested = True
            seconds = time.perf_counter() - start
            if bar is not None:
                bar.close()
            model.save(run.model)
            normalization = model.get_vec_normalize_env()
            if normalization is not None:
                normalization.save(str(run.normalization))
            plot_training(run.path)
        results = evaluation.evaluations_results if evaluation is not None else []
        last = [float(value) for value in results[-1]] if results else []
        return TrainResult(run, model.num_timesteps, last, seconds, stop.requested)
    finally:
        if bar is not None:
            bar.close()
        env.close()
        if evaluation_env is not None:
            evaluation_env.close()
