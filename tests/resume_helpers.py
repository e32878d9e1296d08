"""Comparing runs bit for bit: what their last checkpoints, replays, monitors and evaluations hold."""

from collections import deque
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th

from sb3_symphony.common.checkpoint import Checkpoint, newest_checkpoint
from sb3_symphony.common.files import unseal

# Times differ from run to run, segments with the checkpoints' frequency; files and replay are compared apart
NOT_COMPARED = {"elapsed", "episode_times", "t", "log folder", "segments", "files"}


class GlobalRandomEnv(gym.Env):
    """
    Draws from numpy's global generator, whose state at the episode's start nobody knows: replaying actions leads elsewhere.

    :param where: what is drawn, ``observation`` or ``reward``; with ``end`` nothing, and episodes have three steps
    """

    observation_space = action_space = gym.spaces.Box(-1.0, 1.0, (3,))

    def __init__(self, where="observation"):
        self.where = where

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.n = 0
        return self._draw("observation"), {}

    def _draw(self, what):
        return np.random.uniform(-1, 1, 3).astype(np.float32) if what == self.where else np.zeros(3, np.float32)

    def step(self, action):
        self.n += 1
        reward = float(self._draw("reward").sum())
        ends = self.where == "end" and self.n == 3
        return self._draw("observation"), reward, bool(ends), False, {}


def difference(a: Any, b: Any, name: str = "") -> str | None:
    """Where two nested structures differ, in a bit, a type or a length; None if nowhere."""
    if type(a) is not type(b):
        return f"{name}: {type(a)} and {type(b)}"
    if isinstance(a, th.Tensor):
        a, b = a.detach().numpy(), b.detach().numpy()
    if isinstance(a, np.ndarray) and a.dtype != object:
        return None if (a.dtype, a.shape, a.tobytes()) == (b.dtype, b.shape, b.tobytes()) else name
    if isinstance(a, dict):
        keys = [key for key in a.keys() | b.keys() if key not in NOT_COMPARED]
        if any(key not in a or key not in b for key in keys):
            return f"{name}: {a.keys()} and {b.keys()}"
        pairs = [(a[key], b[key], f"{name}/{key}") for key in keys]
    elif isinstance(a, list | tuple | deque | np.ndarray):
        if len(a) != len(b):
            return f"{name}: {len(a)} and {len(b)} items"
        pairs = [(x, y, f"{name}/{i}") for i, (x, y) in enumerate(zip(a, b, strict=True))]
    elif hasattr(a, "__dict__") and type(a).__module__ not in ("builtins", "numpy"):
        pairs = [(vars(a), vars(b), name)]
    else:
        return None if a == b or (a != a and b != b) else f"{name}: {a!r} and {b!r}"
    return next((found for found in (difference(*pair) for pair in pairs) if found), None)


def replay_rows(run: Path, checkpoint: Checkpoint) -> dict[str, np.ndarray]:
    """The transitions of a checkpoint, oldest first, put together from its segments."""
    if not checkpoint.state["segments"]:
        return {}
    rows: dict[str, dict[int, np.ndarray]] = {}
    for segment in checkpoint.state["segments"]:
        for name, array in unseal(run / "checkpoints" / segment.file, segment.checksum).items():
            rows.setdefault(name, {}).update(zip(range(segment.start, segment.stop), array, strict=True))
    size = checkpoint.state["buffer"]["attributes"]["buffer_size"]
    return {name: np.stack([array for _, array in sorted(by_row.items())][-size:]) for name, by_row in rows.items()}


def monitor_rows(path: Path) -> list[str]:
    """Returns and lengths of a monitor file, whose times are wall-clock."""
    return [line.rpartition(",")[0] for line in path.read_text().splitlines()[1:]]


def assert_same_results(a: Path, b: Path) -> None:
    """Two finished runs have the same training state, replay, episodes and evaluations."""
    x, y = newest_checkpoint(a / "checkpoints"), newest_checkpoint(b / "checkpoints")
    assert x is not None and y is not None
    assert x.steps == y.steps
    states = ({key: value for key, value in each.state.items() if key != "folder"} for each in (x, y))
    assert (found := difference(*states)) is None, found
    assert (found := difference(replay_rows(a, x), replay_rows(b, y))) is None, found
    assert sorted(path.name for path in a.glob("*.monitor.csv")) == sorted(path.name for path in b.glob("*.monitor.csv"))
    for path in a.glob("*.monitor.csv"):
        assert monitor_rows(path) == monitor_rows(b / path.name)
    assert (a / "evaluations.npz").exists() == (b / "evaluations.npz").exists()
    if (a / "evaluations.npz").exists():
        with np.load(a / "evaluations.npz") as p, np.load(b / "evaluations.npz") as q:
            assert difference(dict(p), dict(q)) is None
