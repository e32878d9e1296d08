"""Shared fixtures: small, fast models of all three algorithms."""

import os

os.environ.setdefault("CUDA_VISIBLE_DEVICES", "")  # before torch looks: results are compared with those of the CPU

import signal
import subprocess
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import pytest
import torch as th
from hypothesis import settings
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecEnv

from sb3_symphony import REDQ, DroQ, Symphony

th.set_num_threads(1)
settings.load_profile("ci")  # the same examples every time; others: pytest --hypothesis-profile=default
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:  # so inherited where a shell started the tests in the background
    signal.signal(signal.SIGINT, signal.default_int_handler)


def _pendulum(n_envs: int = 1, episode: int = 25, **kwargs: Any) -> VecEnv:
    return make_vec_env("Pendulum-v1", n_envs=n_envs, env_kwargs=dict(max_episode_steps=episode), **kwargs)


def _small(cls: type[BaseAlgorithm], env: VecEnv | gym.Env | str | None = None, n_envs: int = 1, **kwargs: Any) -> Any:
    """A model with one layer of 16 that learns from step 21 on, by default on a Pendulum whose episodes have 25 steps."""
    defaults: dict[str, Any] = dict(
        policy="MlpPolicy", learning_starts=20, batch_size=16, buffer_size=1000, gradient_steps=1, policy_delay=2, seed=0
    )
    if cls is Symphony:
        defaults.update(initial_gradient_steps=(2, 2), episode_gradient_steps=3)
    if cls is REDQ:
        defaults.update(n_critics=3)
        if "n_critics" in kwargs.get("policy_kwargs", {}):
            del defaults["n_critics"]
    kwargs["policy_kwargs"] = {"net_arch": [16], **kwargs.get("policy_kwargs", {})}
    return cls(env=_pendulum(n_envs) if env is None else env, device="cpu", **{**defaults, **kwargs})


@pytest.fixture(params=[Symphony, REDQ, DroQ])
def algorithm(request: pytest.FixtureRequest) -> type[BaseAlgorithm]:
    """Each of the three classes in turn."""
    return request.param


@pytest.fixture
def small() -> Callable[..., Any]:
    """``small(cls, env=None, n_envs=1, **arguments)``: a small model of the given class."""
    return _small


@pytest.fixture
def make(algorithm: type[BaseAlgorithm]) -> Callable[..., Any]:
    """``make(env=None, n_envs=1, **arguments)``: a small model of each class in turn."""
    return partial(_small, algorithm)


@pytest.fixture
def pendulum() -> Callable[..., VecEnv]:
    """``pendulum(n_envs=1, episode=25)``: a vectorised Pendulum with short episodes, which are truncated."""
    return _pendulum


@pytest.fixture
def no_figures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Runs in this process leave no ``training.png``: drawing takes longer than a short training."""
    monkeypatch.setattr("sb3_symphony.analysis.plots.plot_training", lambda folder: None)


@pytest.fixture
def heeded_hang_up() -> Iterator[None]:
    """Processes started in the test heed SIGHUP, also where ``nohup`` started the tests: what it starts ignores it."""
    before = signal.signal(signal.SIGHUP, signal.SIG_DFL)
    yield
    signal.signal(signal.SIGHUP, before)


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of 400 kB."""
    disk = tmp_path / "disk"
    disk.mkdir()
    if os.name != "posix" or os.geteuid() != 0:
        pytest.skip("only root can mount a file system")
    if subprocess.run(["mount", "-t", "tmpfs", "-o", "size=400k", "tmpfs", str(disk)], capture_output=True).returncode:
        pytest.skip("cannot mount a file system here")
    yield disk
    subprocess.run(["umount", str(disk)], check=True)
