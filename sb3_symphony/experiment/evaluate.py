"""How good a trained agent is: returns of many episodes on fixed seeds."""

import contextlib
import io
import multiprocessing
import signal
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from sb3_symphony.analysis.statistics import bootstrap_interval, summarise
from sb3_symphony.experiment.agent import Agent, open_agent
from sb3_symphony.experiment.environment import Wrappers
from sb3_symphony.experiment.output import json_report, progress_bar
from sb3_symphony.experiment.robustness import ActionDelay, ObservationNoise
from sb3_symphony.experiment.select import EvaluateOptions, Selection
from sb3_symphony.experiment.signals import end_with_parent


class Episode(NamedTuple):
    """
    An episode's result.

    :param reward: return, the sum of the environment's own rewards
    :param length: number of steps
    :param success: ``info["is_success"]`` at its end, None if the environment does not tell
    """

    reward: float
    length: int
    success: bool | None


@dataclass(frozen=True)
class Evaluation:
    """
    Results of an evaluation.

    :param selection: what was evaluated
    :param options: how
    :param episodes: its episodes; number ``i`` ran on environment seed ``options.seed + i``
    """

    selection: Selection
    options: EvaluateOptions
    episodes: list[Episode]

    def as_dict(self) -> dict[str, Any]:
        """:return: statistics, returns, lengths and circumstances, as plain values"""
        returns = [episode.reward for episode in self.episodes]
        summary = summarise(returns)
        successes = [episode.success for episode in self.episodes if episode.success is not None]
        return {
            "mean_reward": summary.mean,
            "std_reward": summary.std,
            "iqm": summary.iqm,
            "iqm_ci95": [float(limit) for limit in bootstrap_interval([returns])],
            "mean_length": float(np.mean([episode.length for episode in self.episodes])),
            "episodes": len(self.episodes),
            **({"success_rate": float(np.mean(successes))} if successes else {}),
            "algo": self.selection.algo,
            "env": self.selection.env_id,
            "model": str(self.selection.model),
            "seed": self.options.seed,
            "deterministic": self.options.deterministic,
            "obs_noise": self.options.obs_noise,
            "action_delay": self.options.action_delay,
            "returns": returns,
            "lengths": [episode.length for episode in self.episodes],
        }

    def __str__(self) -> str:
        result, options = self.as_dict(), self.options
        n = len(self.episodes)
        played = (
            f"{n} episodes on seeds {options.seed}…{options.seed + n - 1}" if n > 1 else f"1 episode on seed {options.seed}"
        )
        conditions = ["deterministic" if options.deterministic else "stochastic"]
        conditions += [f"observation noise {options.obs_noise:g}"] * (options.obs_noise > 0)
        conditions += [f"action delay {options.action_delay}"] * (options.action_delay > 0)
        low, high = result["iqm_ci95"]
        lines = [
            f"{result['algo']} on {result['env']}: {result['model']}",
            f"{played}, {', '.join(conditions)}",
            f"  return  {result['mean_reward']:.2f} ± {result['std_reward']:.2f} (mean ± std)",
            f"  IQM     {result['iqm']:.2f} (95 % CI {low:.2f} … {high:.2f})",
            f"  length  {result['mean_length']:.1f} steps",
        ]
        if "success_rate" in result:
            lines.append(f"  success {100 * result['success_rate']:.1f} %")
        return "\n".join(lines)


def evaluate(options: EvaluateOptions) -> Evaluation:
    """
    Play episodes with a trained agent. Each depends on its seed alone, not on ``n_envs`` or the episodes before it.

    :param options: which agent, how many episodes, under which conditions
    :return: the episodes and their statistics; also written or printed as JSON, if the options say so
    :raises ConfigError: if something is missing or damaged, does not fit, or cannot be written
    """
    # Opened here too with several processes: mistakes are found before they start
    tell = json_report(options.json_file)
    with _open(options) as agent:
        seeds = range(options.seed, options.seed + options.n_episodes)
        played = _in_processes(options, seeds) if min(options.n_envs, len(seeds)) > 1 else _in_turn(agent, options, seeds)
        episodes = list(progress_bar(played, "episodes", options.progress, len(seeds)))
        result = Evaluation(agent.selection, options, episodes)
        tell(result.as_dict())
    return result


def _open(options: EvaluateOptions) -> Agent:
    wrappers: Wrappers = []
    if options.obs_noise > 0:
        wrappers.append(partial(ObservationNoise, std=options.obs_noise))
    if options.action_delay > 0:
        wrappers.append(partial(ActionDelay, steps=options.action_delay))
    return open_agent(options, wrappers=wrappers)


def _play(agent: Agent, seed: int, deterministic: bool) -> Episode:
    info: dict[str, Any] = {}
    for step in agent.episode(seed, deterministic):
        info = step.info
    success = info.get("is_success")
    return Episode(float(info["episode"]["r"]), int(info["episode"]["l"]), None if success is None else bool(success))


def _in_turn(agent: Agent, options: EvaluateOptions, seeds: range) -> Iterator[Episode]:
    return (_play(agent, seed, options.deterministic) for seed in seeds)


# Whole episodes in processes of their own: one observation at a time, since rounding in a matrix product depends on the
# number of its rows, and a walker's later steps on rounding

_agent: Agent


def _start(options: EvaluateOptions) -> None:
    global _agent
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent answers
    end_with_parent()
    with contextlib.redirect_stderr(io.StringIO()):  # the parent has told
        _agent = _open(options)


def _play_here(seed: int, deterministic: bool) -> Episode:
    return _play(_agent, seed, deterministic)


def _in_processes(options: EvaluateOptions, seeds: range) -> Iterator[Episode]:
    context = multiprocessing.get_context("spawn")
    workers = min(options.n_envs, len(seeds))
    before = set(multiprocessing.active_children())
    with ProcessPoolExecutor(workers, context, _start, (options,)) as pool:
        try:
            yield from pool.map(partial(_play_here, deterministic=options.deterministic), seeds)
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            for process in set(multiprocessing.active_children()) - before:
                process.terminate()  # not after whole episodes
            raise
