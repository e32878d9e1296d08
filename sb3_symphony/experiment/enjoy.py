"""Watching a trained agent."""

import os
import sys
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from stable_baselines3.common.utils import set_random_seed
from stable_baselines3.common.vec_env import unwrap_vec_normalize

from sb3_symphony.experiment.agent import Agent, open_agent
from sb3_symphony.experiment.config import ConfigError
from sb3_symphony.experiment.environment import attach_monitor_files
from sb3_symphony.experiment.output import full_disk_told, output_folder, progress_bar
from sb3_symphony.experiment.select import EnjoyOptions


class EnjoyedEpisode(NamedTuple):
    """
    An episode that came to its end.

    :param reward: return, the sum of the environment's own rewards
    :param length: number of steps
    :param normalized: sum of the normalised rewards, None if they were not asked for
    """

    reward: float
    length: int
    normalized: float | None

    def __str__(self) -> str:
        normalized = "" if self.normalized is None else f" (normalised {self.normalized:.2f})"
        return f"return {self.reward:.2f}{normalized}, length {self.length}"


def enjoy(options: EnjoyOptions) -> list[EnjoyedEpisode]:
    """
    Let an agent act, in a window if that is wanted, and print the returns of its episodes as they end.

    The first episode is the one that :func:`~sb3_symphony.experiment.evaluate.evaluate` plays on the same seed.

    :param options: which agent, for how many steps, seen how
    :return: the episodes that came to their end
    :raises ConfigError: if something is missing or damaged, does not fit, or no window can be opened
    """
    if options.render and sys.platform.startswith("linux") and not _DISPLAYS & os.environ.keys():
        raise ConfigError("no display for a window here — expected --no-render; `video` makes films without a display")
    mode = "human" if options.render else None
    with open_agent(options, options.n_envs, mode, norm_reward=options.norm_reward) as agent:
        if options.norm_reward and unwrap_vec_normalize(agent.env) is None:
            raise ConfigError(f"--norm-reward: {agent.selection.model} has no VecNormalize statistics")
        written: list[Path] = []
        if options.reward_log is not None:
            written.append(_log_folder(options.reward_log, options.n_envs))
            attach_monitor_files(agent.env, written[0])
        print(f"{agent.selection.algo} on {agent.selection.env_id}: {agent.selection.model}", flush=True)
        episodes: list[EnjoyedEpisode] = []
        try:
            with full_disk_told(written):
                _act(agent, options, episodes)
        except KeyboardInterrupt:
            pass  # how one stops watching
    if episodes:
        returns, lengths = [episode.reward for episode in episodes], [episode.length for episode in episodes]
        of = f"{len(episodes)} episode{'s' * (len(episodes) > 1)}"
        print(f"{of}: return {np.mean(returns):.2f} ± {np.std(returns):.2f}, length {np.mean(lengths):.1f}")
    else:
        print(f"no episode ended within {options.n_timesteps} steps")
    return episodes


#: one of them is set where windows can be opened; the last one is also for runs without a screen
_DISPLAYS = {"DISPLAY", "WAYLAND_DISPLAY", "SDL_VIDEODRIVER"}


def _act(agent: Agent, options: EnjoyOptions, episodes: list[EnjoyedEpisode]) -> None:
    env = agent.env
    set_random_seed(options.seed)
    env.seed(options.seed)
    observation: Any = env.reset()
    state, starts, rewards = None, np.ones(env.num_envs, dtype=bool), np.zeros(env.num_envs)
    for _ in progress_bar(range(options.n_timesteps), "steps", options.progress):
        action, state = agent.model.predict(observation, state, starts, options.deterministic)
        observation, reward, starts, infos = env.step(action)
        rewards += reward
        for index in np.flatnonzero(starts):
            monitored = infos[index]["episode"]
            normalized = float(rewards[index]) if options.norm_reward else None
            episodes.append(EnjoyedEpisode(float(monitored["r"]), int(monitored["l"]), normalized))
            print(f"episode {len(episodes)}: {episodes[-1]}", flush=True)
            rewards[index] = 0.0


def _log_folder(name: str, n_envs: int) -> Path:
    folder = Path(name)
    for index in range(n_envs):
        if (folder / f"{index}.monitor.csv").exists():
            raise ConfigError(f"--reward-log: '{name}' has a {index}.monitor.csv already, which is left alone")
    return output_folder(name, "--reward-log")
