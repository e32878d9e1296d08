"""
One trial of a sweep: a training for each seed, all at the same time, each in a process of its own.

A crash, a lack of memory or a diverging network then ends one trial and nothing else.
"""

import multiprocessing
import signal
import sys
import textwrap
import traceback
import warnings
from collections.abc import Sequence
from contextlib import ExitStack, suppress
from multiprocessing.connection import Connection
from multiprocessing.context import BaseContext
from typing import Any, Literal, NamedTuple

import gymnasium as gym
import numpy as np
import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback

from sb3_symphony.experiment.agent import finite_weights
from sb3_symphony.experiment.callbacks import SeededEvaluation, StopOnSignal
from sb3_symphony.experiment.config import ConfigError, RunConfig, TrainOptions, told
from sb3_symphony.experiment.environment import make_evaluation_env
from sb3_symphony.experiment.signals import end_with_parent, ended_by
from sb3_symphony.experiment.train import build_callbacks, build_model


class TrialFailed(Exception):
    """
    A trial came to nothing.

    :param reason: why, in words
    :param kind: ``failed`` because of its parameters or its environment, ``died`` with one of its processes, or ended by
        an ``error`` of the program
    """

    def __init__(self, reason: str, kind: Literal["failed", "died", "error"]) -> None:
        super().__init__(reason)
        self.reason = reason
        self.kind = kind


class _Failure(NamedTuple):
    """What the process of a training sends instead of an evaluation."""

    reason: str
    kind: Literal["failed", "error"]


class _Diverged(Exception):
    pass


class _SendEvaluations(BaseCallback):
    """Called after each evaluation."""

    parent: SeededEvaluation

    def __init__(self, results: Connection, n_evaluations: int) -> None:
        super().__init__()
        self.results = results
        self.n_evaluations = n_evaluations

    def _on_step(self) -> bool:
        mean = float(self.parent.last_mean_reward)
        if not np.isfinite(mean):
            raise _Diverged(f"mean return {mean}")
        if not finite_weights(self.model):
            raise _Diverged("weights that are not finite")
        self.results.send(mean)
        return self.n_calls < self.n_evaluations


def _failure(error: Exception, model: BaseAlgorithm | None) -> _Failure:
    """Tell what hyper-parameters and environments can cause from mistakes in the program, which must not pass for it."""
    what = textwrap.shorten(told(error), 300, placeholder=" …")
    if isinstance(error, ConfigError):
        return _Failure(str(error), "failed")
    if isinstance(error, _Diverged):
        return _Failure(f"diverged: {error}", "failed")
    if isinstance(error, MemoryError | th.cuda.OutOfMemoryError) or "can't allocate memory" in str(error):
        return _Failure(f"out of memory: {what}", "failed")
    if model is not None and not finite_weights(model):
        return _Failure(f"diverged: weights that are not finite ({what})", "failed")
    frames = [frame for frame, _ in traceback.walk_tb(error.__traceback__)]
    if str(frames[-1].f_globals.get("__name__")).startswith("torch.distributions"):  # where it checks network outputs
        return _Failure(f"diverged: {what}", "failed")
    if any(isinstance(frame.f_locals.get("self"), gym.Env) for frame in frames):
        return _Failure(f"environment: {what}", "failed")
    return _Failure("".join(traceback.format_exception(error)), "error")


def _train_seed(options: TrainOptions, config: RunConfig, seed: int, n_evaluations: int, results: Connection) -> None:
    """What the process of a training does: the same as ``train``, but for files."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches all processes; the sweep decides
    end_with_parent()
    ignore_mini_batches()
    if options.num_threads > 0:
        th.set_num_threads(options.num_threads)
    model = None
    try:
        model = build_model(options, config, seed, verbose=0)
        evaluation = SeededEvaluation(
            make_evaluation_env(options.env, config.settings),
            StopOnSignal(),
            callback_after_eval=_SendEvaluations(results, n_evaluations),
            n_eval_episodes=options.eval_episodes,
            eval_freq=evaluation_frequency(config, n_evaluations),
            verbose=0,
        )
        with ExitStack() as cleanup:
            model.learn(config.settings.n_timesteps, [evaluation, *build_callbacks(options, config, model, cleanup)])
    except BrokenPipeError:
        sys.exit(1)  # nobody wants the results any more
    except Exception as error:
        results.send(_failure(error, model))


def ignore_mini_batches() -> None:
    """A search tries combinations of ``n_steps`` and ``batch_size`` that SB3 warns of; nobody chose them."""
    warnings.filterwarnings("ignore", message="You have specified a mini-batch size")


def evaluation_frequency(config: RunConfig, n_evaluations: int) -> int:
    """
    :param config: configuration of the training
    :param n_evaluations: number of evaluations, at equal distances
    :return: steps of each environment between them
    :raises ConfigError: if there are fewer steps than evaluations
    """
    frequency = config.settings.n_timesteps // (config.settings.n_envs * n_evaluations)
    if frequency < 1:
        raise ConfigError(
            f"--n-evaluations: {n_evaluations} — expected at most {config.settings.n_timesteps // config.settings.n_envs}, "
            f"as {config.settings.n_timesteps} steps in {config.settings.n_envs} environment(s) allow"
        )
    return frequency


def process_context() -> BaseContext:
    """
    :return: how processes are started: forked from one that has imported everything, where the system can fork
    """
    if "forkserver" not in multiprocessing.get_all_start_methods():
        return multiprocessing.get_context("spawn")
    context = multiprocessing.get_context("forkserver")
    # The first optimizer imports the second one, which takes seconds
    context.set_forkserver_preload([__name__, "torch._dynamo", "sb3_symphony.redq", "sb3_symphony.symphony"])
    return context


class TrialProcesses:
    """
    The trainings of one trial.

    :param options: options of a training
    :param config: its configuration
    :param seeds: one training for each
    :param n_evaluations: number of evaluations of each
    :raises TrialFailed: if the system starts no more processes
    """

    def __init__(self, options: TrainOptions, config: RunConfig, seeds: Sequence[int], n_evaluations: int) -> None:
        context: Any = process_context()
        self.seeds = list(seeds)
        self.n_evaluations = n_evaluations
        self.returns: list[list[float]] = [[] for _ in seeds]  # mean of each evaluation, for each seed
        self._results: list[Connection] = []
        self._processes: list[Any] = []
        self.reported = 0
        for seed in seeds:
            receiver, sender = context.Pipe(duplex=False)
            process = context.Process(target=_train_seed, args=(options, config, seed, n_evaluations, sender))
            try:
                process.start()
            except (OSError, EOFError) as error:  # EOFError: the process that all are forked from has just died
                self.stop()
                raise TrialFailed(f"seed {seed}: its process could not be started ({error})", "died") from None
            sender.close()  # the process has its own; when that one closes too, there is nothing more to come
            self._results.append(receiver)
            self._processes.append(process)

    @property
    def connections(self) -> list[Connection]:
        """What to wait for."""
        return [
            results for results, returns in zip(self._results, self.returns, strict=True) if len(returns) < self.n_evaluations
        ]

    def poll(self) -> list[float]:
        """
        :return: mean over all seeds of each evaluation that all have done since the last call
        :raises TrialFailed: if one of the trainings failed
        """
        for index, results in enumerate(self._results):
            while len(self.returns[index]) < self.n_evaluations and results.poll():
                self.returns[index].append(self._receive(index))
        done = min(map(len, self.returns))
        means = [float(np.mean([returns[i] for returns in self.returns])) for i in range(self.reported, done)]
        self.reported = done
        return means

    def _receive(self, index: int) -> float:
        try:
            result = self._results[index].recv()
        except (EOFError, OSError):
            self._processes[index].join()
            code = self._processes[index].exitcode
            assert code is not None
            raise TrialFailed(f"seed {self.seeds[index]}: {ended_by(code)}", "died") from None
        if isinstance(result, _Failure):
            raise TrialFailed(f"seed {self.seeds[index]}: {result.reason}", result.kind)
        return result

    @property
    def finished(self) -> bool:
        """Whether all trainings are done and polled."""
        return self.reported == self.n_evaluations

    def stop(self) -> None:
        """End all processes; they have nothing to save."""
        for process in self._processes:
            with suppress(OSError):
                process.kill()
        for process in self._processes:
            process.join()
        for results in self._results:
            results.close()
