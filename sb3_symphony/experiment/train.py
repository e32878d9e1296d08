"""One training run, from options to files on disk."""

import glob
import shlex
import sys
import time
from collections.abc import Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.her.her_replay_buffer import HerReplayBuffer

from sb3_symphony.common.buffers import check_mirror
from sb3_symphony.common.checkpoint import Checkpoint, DoesNotFit, ExactCheckpoints, check_fit, platform_of
from sb3_symphony.experiment.agent import DIVERGED, check_device, finite_weights
from sb3_symphony.experiment.callbacks import (
    NoteLogFolder,
    ReturnProgressBar,
    SaveBestModel,
    SavedModels,
    SeededEvaluation,
    StopOnSignal,
    configured_callbacks,
    save_model,
)
from sb3_symphony.experiment.config import ConfigError, RunConfig, TrainOptions, check_algorithm, load_config, reason
from sb3_symphony.experiment.decode import algorithm_arguments
from sb3_symphony.experiment.environment import (
    attach_monitor_files,
    check_same_spaces,
    check_spaces,
    import_packages,
    make_evaluation_env,
    make_training_env,
)
from sb3_symphony.experiment.output import alone, check_folder, full_disk_told
from sb3_symphony.experiment.protocol import keep_protocol, solved_stride
from sb3_symphony.experiment.registry import load_algorithm
from sb3_symphony.experiment.resume import continue_logs, open_run, restore_files
from sb3_symphony.experiment.run_folder import RunFolder
from sb3_symphony.experiment.transfer import find_trained, inherited, start_from

#: options that say what is done with results, or belong to one command among several
_NOT_OF_THE_RUN = {"resume", "n_seeds", "quiet", "json_file"}


@dataclass(frozen=True)
class TrainResult:
    """
    What a run left behind.

    :param run: its folder
    :param steps: environment steps taken
    :param evaluation: returns of the last evaluation's episodes, empty if there was none
    :param seconds: wall-clock time of learning, that before a resume included
    :param interrupted: whether it was stopped by a signal
    :param signalled: whether one came, maybe too late to stop it
    :param diverged: whether weights are not finite
    :param untouched: whether there was nothing left to do in a run that was to be resumed
    :param solved: whether that is because its ``stop_reward`` was reached
    """

    run: RunFolder
    steps: int
    evaluation: list[float]
    seconds: float
    interrupted: bool = False
    signalled: bool = False
    diverged: bool = False
    untouched: bool = False
    solved: bool = False

    def plain(self) -> dict[str, Any]:
        """:return: the result as plain values, for JSON"""
        return {
            "run": str(self.run.path),
            "model": str(self.run.model),
            "steps": self.steps,
            "evaluation": self.evaluation,
            "mean_reward": float(np.mean(self.evaluation)) if self.evaluation else None,
            "seconds": round(self.seconds, 3),
            "interrupted": self.interrupted,
            "diverged": self.diverged,
        }

    def summary(self) -> str:
        """:return: one line for the end of a run, and a second one if it has diverged"""
        if self.untouched:
            onward = " (a larger -n goes on)" if not self.solved and any(self.run.checkpoints.glob("*.ckpt")) else ""
            reached = ", its stop_reward reached" if self.solved else ""
            return f"{self.run.path} is finished: {self.steps} steps{reached} — nothing changed{onward}"
        evaluated = "not evaluated"
        if self.evaluation:
            mean, spread, n = np.mean(self.evaluation), np.std(self.evaluation), len(self.evaluation)
            evaluated = f"last evaluation {mean:.1f} ± {spread:.1f} ({n} episode{'s' * (n > 1)})"
        minutes, seconds = divmod(round(self.seconds), 60)
        hours, minutes = divmod(minutes, 60)
        state = "interrupted, saved" if self.interrupted else "saved"
        line = f"{state} {self.run.model} | {self.steps} steps | {evaluated} | {hours}:{minutes:02}:{seconds:02} h"
        return f"{line}\n{DIVERGED}" if self.diverged else line


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
    try:
        algorithm = load_algorithm(options.algo)
    except ValueError as error:  # of a user's own file
        raise ConfigError(f"--algo: {error}") from None
    check_device(options.device)
    import_packages(options.gym_packages)
    gamma = config.arguments.get("gamma")
    env = make_training_env(
        options.env,
        config.settings,
        gamma if isinstance(gamma, int | float) else None,
        seed,
        options.vec_env == "subproc",
        options.gym_packages,
        recorded=options.save_freq > 0,
    )
    try:
        check_spaces(env, options.env, options.algo, algorithm, config.settings.policy)
        arguments = algorithm_arguments(options.algo, algorithm, config, env.action_space)
        _check_goals(env, options.env, arguments.get("replay_buffer_class"))
        if options.tensorboard_log:
            arguments["tensorboard_log"] = str(Path(options.tensorboard_log) / RunFolder.file_name(options.env))
        model = algorithm(env=env, seed=seed, device=options.device, verbose=verbose, **arguments)
        check_mirror(getattr(model, "replay_buffer", None), model.get_vec_normalize_env())  # else seen after the warm-up
        return model
    except Exception as error:  # SB3, or a class that the configuration names, can refuse a value in any way
        env.close()
        if isinstance(error, ConfigError):
            raise
        raise ConfigError(f"{options.algo} on {options.env}: {reason(error)}") from error


def _check_goals(env: VecEnv, env_id: str, replay_buffer_class: type | None) -> None:
    if replay_buffer_class is None or not issubclass(replay_buffer_class, HerReplayBuffer):
        return
    space = env.observation_space
    if not (isinstance(space, spaces.Dict) and {"achieved_goal", "desired_goal"} <= space.keys()):
        raise ConfigError(f"replay_buffer_class: 'HerReplayBuffer' — needs observations with goals, {env_id} has {space}")


def _alone(run: RunFolder) -> AbstractContextManager[None]:
    return alone(run.checkpoints, f"--resume: '{run.path}' is being trained by another process")


def _resuming(checkpoint: Checkpoint | None, model: BaseAlgorithm) -> str:
    """What a resumed run begins with, in words."""
    if checkpoint is None:
        return "stopped before its first checkpoint, begins again"
    before, now = checkpoint.state["platform"], platform_of(model)
    changes = [f"{name} {before.get(name)} before, {value} now" for name, value in now.items() if before.get(name) != value]
    notes = [f"damaged: {line}" for line in checkpoint.damaged]
    notes += [f"not bit for bit: {', '.join(changes)}"] if changes else []
    return "; ".join([f"resumed at {checkpoint.steps}", *notes])


def _callbacks(
    options: TrainOptions, config: RunConfig, run: RunFolder, evaluation_env: VecEnv | None, verbose: int
) -> tuple[StopOnSignal, SeededEvaluation | None, list[BaseCallback]]:
    """One that stops, one that evaluates if there is an environment for it, and all whose counts belong to the run."""
    stop = StopOnSignal(at_rollouts=options.save_freq > 0)
    n_envs, evaluation = config.settings.n_envs, None
    if evaluation_env is not None:
        evaluation = SeededEvaluation(
            evaluation_env,
            stop,
            options.threshold,
            solved_stride(options),
            stop_reward=config.settings.stop_reward,
            callback_on_new_best=SaveBestModel(run.best_model, run.best_normalization),
            n_eval_episodes=options.eval_episodes,
            eval_freq=max(options.eval_freq // n_envs, 1),
            log_path=run.path,
            verbose=verbose,
        )
    counting: list[BaseCallback] = [evaluation] if evaluation else []
    if options.save_freq > 0:
        counting.append(SavedModels(max(options.save_freq // n_envs, 1), str(run.path)))
    return stop, evaluation, counting


def build_callbacks(options: TrainOptions, config: RunConfig, model: BaseAlgorithm, cleanup: ExitStack) -> list[BaseCallback]:
    """
    :param options: options of the command line
    :param config: its configuration
    :param model: model that is about to learn
    :param cleanup: closes the environments of the callbacks
    :return: the callbacks that the configuration names
    :raises ConfigError: if one does not fit
    """

    def own_env() -> VecEnv:
        settings = config.settings.model_copy(update={"n_envs": 1})
        env = make_training_env(options.env, settings, getattr(model, "gamma", None), seed=0)
        cleanup.callback(env.close)
        return env

    return configured_callbacks(config.settings.callback, model, own_env)


def _save_model(model: BaseAlgorithm, run: RunFolder) -> None:
    """The model comes last and at once: a run whose model has all steps has everything."""
    try:
        from sb3_symphony.analysis.plots import plot_training  # drawing takes a second to import

        plot_training(run.path)
    except Exception as error:  # whatever a drawing library stumbles over, a full disk too: the model matters
        print(f"note: training.png was not drawn — {reason(error)}", file=sys.stderr)
    save_model(model, run.model, run.normalization)


@contextmanager
def _nothing_lost(model: BaseAlgorithm, run: RunFolder) -> Iterator[None]:
    """Whatever an environment or a callback stumbles over: what was learned so far is kept."""
    try:
        yield
    except Exception:
        if model.num_timesteps > 0:
            _save_model(model, run)
            print(f"note: saved {run.model}, of {model.num_timesteps} steps", file=sys.stderr)
        raise


@contextmanager
def _hindsight_told(model: BaseAlgorithm) -> Iterator[None]:
    """Hindsight replay draws from episodes that have ended: whether one has, when learning starts, only shows there."""
    try:
        yield
    except RuntimeError as error:
        if "before the end of the first episode" not in str(error):
            raise
        starts = getattr(model, "learning_starts", 0)
        raise ConfigError(
            f"learning_starts: {starts} — no episode had ended after {model.num_timesteps} steps, and hindsight replay needs "
            "one; expected more steps than an episode has"
        ) from None


@contextmanager
def _divergence_told(model: BaseAlgorithm) -> Iterator[None]:
    """Networks' outputs that are no numbers stop distributions and environments in ways of their own."""
    try:
        yield
    except Exception as error:
        if finite_weights(model):
            raise
        kind, steps = type(error).__name__, model.num_timesteps
        raise ConfigError(f"{kind} after {steps} steps: {DIVERGED} — expected other hyper-parameters") from error


def effective_config(options: TrainOptions) -> RunConfig:
    """
    :param options: options of the command line
    :return: the merged configuration, with the networks of the agent to start from if there is one
    :raises ConfigError: if a file or a key of the run is wrong, or there is no such agent
    """
    if options.trained_agent is None:
        return load_config(options)
    check_algorithm(options.algo)
    return load_config(options, inherited(find_trained(options)))


def prepare(
    options: TrainOptions, config: RunConfig, seed: int, verbose: int, cleanup: ExitStack, fresh: bool = True
) -> tuple[BaseAlgorithm, TrainOptions, VecEnv | None, list[BaseCallback]]:
    """
    Make everything that a run consists of, and with that check all of its settings. Nothing is written.

    :param options: options of the command line
    :param config: merged configuration
    :param seed: seed of environment and model
    :param verbose: how much the model prints
    :param cleanup: closes what has to be closed
    :param fresh: whether the run begins, from a trained agent if the options name one
    :return: the model, its environment set; the options, completed by the protocol if they name one; an environment for
        evaluations if there are any; the callbacks of the configuration
    :raises ConfigError: if something is wrong
    """
    if options.with_replay_buffer and options.trained_agent is None:
        raise ConfigError("--with-replay-buffer: belongs to -i, expected both or neither")
    model = build_model(options, config, seed, verbose)
    env = model.get_env()
    assert env is not None
    cleanup.callback(env.close)
    options = keep_protocol(options, config)
    if config.settings.stop_reward is not None and options.eval_freq <= 0:
        raise ConfigError(f"stop_reward: {config.settings.stop_reward:g} — needs evaluations, expected --eval-freq > 0")
    if options.eval_env_kwargs and options.eval_freq <= 0:
        raise ConfigError(f"--eval-env-kwargs: {options.eval_env_kwargs} — needs evaluations, expected --eval-freq > 0")
    if "keep" in options.model_fields_set and options.save_freq <= 0:
        raise ConfigError(f"--keep: {options.keep} — needs checkpoints, expected --save-freq > 0")
    evaluation_env = None
    if options.eval_freq > 0:
        evaluation_env = make_evaluation_env(options.env, config.settings, options.eval_env_kwargs)
        cleanup.callback(evaluation_env.close)
        check_same_spaces(env, evaluation_env)
    callbacks = build_callbacks(options, config, model, cleanup)
    if fresh and options.trained_agent is not None:
        start_from(model, find_trained(options), options.with_replay_buffer)
    return model, options, evaluation_env, callbacks


def check_folders(options: TrainOptions, folder: Path | None = None, begins: bool = True) -> None:
    """
    Look whether all folders can be written into.

    :param options: options of the command line
    :param folder: run folder to make instead of the next free one
    :param begins: whether the run's folder is to be made; else it is there, perhaps somewhere else
    :raises ConfigError: if one cannot
    """
    if begins:
        check_folder(options.log_folder if folder is None else folder.parent, "--log-folder")
    if options.tensorboard_log:
        check_folder(options.tensorboard_log, "--tensorboard-log")
        # A given run folder holds its own log, which is the only one there
        if begins and folder is None and glob.escape(options.tensorboard_log) != options.tensorboard_log:
            raise ConfigError(
                f"--tensorboard-log: '{options.tensorboard_log}' — expected a path without *, ? and [, in which SB3 would not "
                "see earlier logs, and write into them"
            )


def train_seeds(options: TrainOptions, command: str | None = None) -> list[TrainResult]:
    """
    Train ``n_seeds`` agents one after the other, on the seeds from the given one on. A signal ends the series.

    :param options: options of the command line
    :param command: the command line, for ``command.txt``
    :return: what the runs left behind
    :raises ConfigError: if options or configuration are wrong
    """
    if options.n_seeds == 1 or options.resume is not None:
        return [train(options, command)]
    # so that the last one is a seed as well
    first = options.seed if options.seed >= 0 else int(np.random.default_rng().integers(2**31 - options.n_seeds))
    if first + options.n_seeds > 2**31:
        raise ConfigError(f"--n-seeds: {options.n_seeds} — seeds from {first} on end at {2**31 - 1}")
    results: list[TrainResult] = []
    for seed in range(first, first + options.n_seeds):
        one = options.model_copy(update={"seed": seed, "n_seeds": 1})
        results.append(train(one, command and f"{command} --seed {seed} --n-seeds 1"))
        if results[-1].signalled:
            break
        if not options.quiet and len(results) < options.n_seeds:
            print(results[-1].summary(), flush=True)
    return results


def train(options: TrainOptions, command: str | None = None, folder: Path | None = None) -> TrainResult:
    """
    Train one agent and write its run folder, or go on with a run that was stopped.

    The folder is made once everything has been validated and the model built, so a mistake leaves nothing behind.

    :param options: options of the command line; with ``resume`` set, only those that were given
    :param command: the command line, for ``command.txt``
    :param folder: run folder to make instead of the next free one
    :return: what the run left behind
    :raises ConfigError: if options or configuration are wrong
    """
    with ExitStack() as cleanup:
        if options.resume is None:
            return _train(options, effective_config(options), command, cleanup, folder=folder)
        stored = open_run(options)
        if stored.finished:
            last, seconds = stored.last_evaluation, stored.seconds
            return TrainResult(stored.run, stored.steps, last, seconds, untouched=True, solved=stored.solved)
        for written in (stored.run.path, stored.run.checkpoints):
            check_folder(written, "--resume")
        cleanup.enter_context(_alone(stored.run))
        try:
            return _train(stored.options, stored.config, command, cleanup, stored.run, stored.checkpoint())
        except DoesNotFit as error:
            raise ConfigError(f"--resume: {stored.run.details / 'config.yml'} was changed: {error}") from None


def _train(
    options: TrainOptions,
    config: RunConfig,
    command: str | None,
    cleanup: ExitStack,
    run: RunFolder | None = None,
    checkpoint: Checkpoint | None = None,
    folder: Path | None = None,
) -> TrainResult:
    seed = options.seed if options.seed >= 0 else int(np.random.default_rng().integers(2**31))
    verbose = options.verbose if options.verbose is not None else int(not options.progress)
    if options.num_threads > 0:
        th.set_num_threads(options.num_threads)

    check_folders(options, folder, begins=run is None)
    model, options, evaluation_env, own_callbacks = prepare(options, config, seed, verbose, cleanup, checkpoint is None)
    env = model.get_env()
    assert env is not None

    used = options.model_copy(update={"seed": seed, "n_timesteps": config.settings.n_timesteps, "verbose": verbose})
    command = command or f"sb3-symphony train --algo {options.algo} --env {shlex.quote(options.env)}"
    beginning = ""
    if run is None:
        run = RunFolder.create(options.log_folder, options.algo, options.env, folder)
        if options.save_freq > 0:
            run.checkpoints.mkdir()
            cleanup.enter_context(_alone(run))
        if options.seed < 0:
            command += f" --seed {seed}"  # so that the command repeats this run
    else:
        if checkpoint is not None:
            check_fit(model, checkpoint)  # before any file changes
        beginning = f" ({_resuming(checkpoint, model)})"
        command = f"{run.command}\n{command}".lstrip()
        restore_files(run, checkpoint)
    with full_disk_told([run.path]):
        run.write_configuration(used.model_dump(exclude=_NOT_OF_THE_RUN), config.plain, command)
        attach_monitor_files(env, run.path, append=checkpoint is not None)

    stop, evaluation, callbacks = _callbacks(options, config, run, evaluation_env, verbose)
    callbacks += own_callbacks
    checkpoints = None
    if options.save_freq > 0:
        checkpoints = ExactCheckpoints(
            run.checkpoints,
            options.save_freq,
            options.keep,
            callbacks=tuple(callbacks),
            files=run.changing_files,
            checkpoint=checkpoint,
            wanted=stop.here,
        )
        callbacks.append(checkpoints)
    callbacks += [stop, NoteLogFolder(run.log_folder)]  # the checkpoint is made before
    if options.progress:
        bar = ReturnProgressBar(evaluation)
        callbacks.append(bar)
        cleanup.callback(bar.close)
    intervals: dict[int, dict[str, Any]] = {-1: {}, -2: {"log_interval": None}}
    learn_arguments = intervals.get(options.log_interval, {"log_interval": options.log_interval})
    if checkpoint is not None:
        continue_logs(model, run, checkpoint, learn_arguments)

    total = config.settings.n_timesteps
    if not options.quiet:
        print(f"{options.algo} on {options.env}, seed {seed}: {total} steps into {run.path}{beginning}", flush=True)
    onward = "--resume goes on from the newest checkpoint, if there is one yet" if options.save_freq > 0 else ""
    written = [run.path, *([Path(options.tensorboard_log)] if options.tensorboard_log else [])]
    with stop.listening(), full_disk_told(written, onward):
        try:
            keeping = _nothing_lost(model, run) if checkpoints is None else nullcontext()
            with _divergence_told(model), _hindsight_told(model), keeping:
                model.learn(total, callback=callbacks, **learn_arguments)
        except KeyboardInterrupt:
            stop.requested = True
        ended = time.time_ns()
        seconds = (ended - (model.start_time or ended)) / 1e9
        if options.progress:
            bar.close()
        finished = checkpoints is not None and checkpoints.finished
        if checkpoints is None or checkpoints.restored:
            _save_model(model, run)
        if checkpoints is not None and finished:
            model.start_time += time.time_ns() - ended  # saving and drawing are no part of the training that may go on
            checkpoints.save(rollout_follows=False)
    results = evaluation.evaluations_results if evaluation is not None else []
    last = [float(value) for value in results[-1]] if results else []
    return TrainResult(
        run,
        model.num_timesteps,
        last,
        seconds,
        interrupted=stop.requested and not finished,
        signalled=stop.requested,
        diverged=not finite_weights(model),
    )
