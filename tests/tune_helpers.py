"""A sweep small enough for tests, and environments that go wrong."""

import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import yaml

SPACE = {
    "learning_rate": {"float": [1e-4, 1e-2], "log": True},
    "gamma": [0.9, 0.98],
    "n_epochs": {"int": [1, 4]},
    "policy_kwargs.net_arch": [[8], {"pi": [16], "vf": [8]}],
}
#: of PPO on the environment below
CONFIGURATION = {"n_timesteps": 96, "n_steps": 16, "batch_size": 16}
FLAGS = ["--algo", "ppo", "--env", "tune_helpers:Line-v0", "--n-evaluations", "3", "--eval-episodes", "2"]


class Line(gym.Env):
    """
    A point that is to be kept at 0, for 8 steps.

    :param fails: in training, what happens when the point is about to move for the 20th time: ``nan`` observations, an
        ``error``, an ``exit`` of the process, or a ``wait`` of a tenth of a second in each step
    """

    observation_space = gym.spaces.Box(-np.inf, np.inf, (1,), np.float64)
    action_space = gym.spaces.Box(-1.0, 1.0, (1,), np.float64)

    def __init__(self, fails: str = "") -> None:
        self.fails = fails
        self.moves = 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        """A random point."""
        super().reset(seed=seed)
        self.point = self.np_random.uniform(-1, 1, 1)
        self.steps = 0
        return self.point, {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Move it."""
        self.moves += 1
        self.steps += 1
        self.point = self.point + 0.3 * action
        if self.moves >= 20 and self.fails == "nan":
            self.point = self.point * np.nan
        if self.moves == 20 and self.fails == "error":
            raise ConnectionError("the simulator has gone")
        if self.moves == 20 and self.fails == "exit":
            os._exit(3)
        if self.fails == "wait":
            import time

            time.sleep(0.1)
        return self.point, -float(abs(self.point[0])), False, self.steps == 8, {}


gym.register("Line-v0", entry_point=Line)
gym.register("Fast_Line-v0", entry_point=Line)


def files(folder: Path, space: dict[str, Any] = SPACE, **configuration: Any) -> list[str]:
    """
    Write the files of a small sweep.

    :param folder: where
    :param space: search space
    :param configuration: items that differ from those above
    :return: all flags of the sweep
    """
    (folder / "space.yml").write_text(yaml.safe_dump(space))
    (folder / "conf.yml").write_text(yaml.safe_dump({**CONFIGURATION, **configuration}))
    return [*FLAGS, "--space", str(folder / "space.yml"), "-conf", str(folder / "conf.yml"), "-f", str(folder / "logs")]


def start(folder: Path, *flags: str) -> subprocess.Popen[str]:
    """
    :param folder: working folder
    :param flags: flags of ``tune``
    :return: its process, standard error included in its output
    """
    paths = os.pathsep.join([str(Path(__file__).parent), *filter(None, [os.environ.get("PYTHONPATH")])])
    return subprocess.Popen(
        [sys.executable, "-m", "sb3_symphony", "tune", *flags],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": paths, "PYTHONUNBUFFERED": "1"},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


def descendants(pid: int) -> list[int]:
    """
    :param pid: a process
    :return: its children, and theirs
    """
    try:
        children = [int(child) for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]
        children = [child for child in children if ") Z" not in Path(f"/proc/{child}/stat").read_text()]
    except OSError:
        return []
    return [*children, *(below for child in children for below in descendants(child))]


def kill(pid: int) -> None:
    """
    :param pid: a process that is ended without notice, if it still is there
    """
    try:
        os.kill(pid, signal.SIGKILL)
    except ProcessLookupError:
        pass
