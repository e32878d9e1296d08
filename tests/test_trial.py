"""The trainings of a trial: the same as those of ``train``, and what becomes of those that go wrong."""

import csv
import multiprocessing
import os
import time
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
import yaml
from stable_baselines3 import PPO
from tune_helpers import CONFIGURATION, SPACE, Line, descendants, files, kill, start

from sb3_symphony.experiment.config import ConfigError, RunConfig, TrainOptions, merge
from sb3_symphony.experiment.train import train
from sb3_symphony.experiment.trial import TrialFailed, TrialProcesses, _failure, evaluation_frequency
from sb3_symphony.experiment.tune import TuneOptions, tune

ENV = "tune_helpers:Line-v0"


def options(**changes: Any) -> TrainOptions:
    return TrainOptions(**{"algo": "ppo", "env": ENV, "eval_episodes": 2, "num_threads": 1, **changes})


def config(**changes: Any) -> RunConfig:
    return merge({**CONFIGURATION, "policy_kwargs": {"net_arch": [8]}, **changes}, options())


def followed(processes: TrialProcesses, seconds: float = 120.0) -> list[float]:
    """All means, or the exception that ended the trial."""
    means = []
    deadline = time.monotonic() + seconds
    try:
        while not processes.finished:
            assert time.monotonic() < deadline
            multiprocessing.connection.wait(processes.connections, timeout=1.0)
            means += processes.poll()
    finally:
        processes.stop()
    return means


def test_a_trial_trains_as_train_does(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "space.yml").write_text(yaml.safe_dump(SPACE))
    (tmp_path / "conf.yml").write_text(yaml.safe_dump({**CONFIGURATION, "n_envs": 2, "normalize": True}))
    sweep = TuneOptions(
        algo="ppo", env=ENV, space="space.yml", conf_file="conf.yml", n_trials=2, n_evaluations=3, eval_episodes=2
    )
    folder = tune(sweep.model_copy(update={"seeds_per_trial": 2, "seed": 7})).folder
    best = folder / "best.yml"
    with open(folder / "trials.csv") as file:
        row = max(csv.DictReader(file), key=lambda row: float(row["value"]))
    for seed in (7, 8):
        result = train(options(conf_file=str(best), seed=seed, eval_freq=32, progress=False, verbose=0))
        results = np.load(result.run.path / "evaluations.npz")["results"]
        assert results.shape == (3, 2)
        assert float(row[f"seed_{seed}"]) == results[-1].mean()


def test_mean_over_seeds_at_each_evaluation():
    processes = TrialProcesses(options(), config(), [0, 1, 2], 3)
    means = followed(processes)
    assert means == [np.mean(returns) for returns in zip(*processes.returns, strict=True)]
    assert len({returns[0] for returns in processes.returns}) == 3
    alone = TrialProcesses(options(), config(), [1], 3)
    assert followed(alone) == processes.returns[1]  # seeds do not influence each other


def test_a_trial_has_the_callbacks_of_its_configuration():
    processes = TrialProcesses(options(), config(callback={"QuietOnReturn": {"returns": [0, 1]}}), [3], 2)
    with pytest.raises(TrialFailed, match="QuietOnReturn: action_noise=None: expected a StickyActionNoise"):
        followed(processes)


@pytest.mark.parametrize(
    "fails, kind, reason",
    [
        ("nan", "failed", "seed 3: diverged: ValueError: Expected parameter loc .*nan"),
        ("error", "failed", "seed 3: environment: ConnectionError: the simulator has gone"),
        ("exit", "died", "seed 3: its process ended with code 3"),
    ],
)
def test_what_goes_wrong_in_one_training_fails_the_trial(fails, kind, reason):
    processes = TrialProcesses(options(), config(env_kwargs={"fails": fails}), [3], 3)
    with pytest.raises(TrialFailed, match=reason) as failure:
        followed(processes)
    assert failure.value.kind == kind


def test_killed_process():
    processes = TrialProcesses(options(), config(env_kwargs={"fails": "wait"}), [3, 4], 3)
    kill(processes._processes[1].pid)
    with pytest.raises(TrialFailed, match=r"seed 4: its process was ended by SIGKILL \(out of memory\?\)") as failure:
        followed(processes)
    assert failure.value.kind == "died"
    assert not any(process.is_alive() for process in processes._processes)


def test_settings_that_do_not_fit():
    processes = TrialProcesses(options(), config(gamma=3.0), [3], 3)
    with pytest.raises(TrialFailed, match=r"seed 3: gamma: 3.0 — expected a number in \[0, 1\]") as failure:
        followed(processes)
    assert failure.value.kind == "failed"


def test_mistake_in_the_program_is_told_with_its_traceback():
    broken: Any = config()
    broken.arguments = None
    with pytest.raises(TrialFailed, match=r"Traceback(.|\n)*AttributeError") as failure:
        followed(TrialProcesses(options(), broken, [3], 3))
    assert failure.value.kind == "error"


def raised(call: Any) -> Exception:
    try:
        call()
    except Exception as error:
        return error
    raise AssertionError("nothing was raised")


def test_failures_are_told_apart():
    model = PPO("MlpPolicy", Line(), n_steps=16, batch_size=16, policy_kwargs={"net_arch": [4]}, device="cpu")
    assert _failure(raised(lambda: th.zeros(2) @ th.zeros(3)), model).kind == "error"
    assert _failure(raised(lambda: [][0]), None).kind == "error"
    assert _failure(ConfigError("gamma: 3"), None) == ("gamma: 3", "failed")
    assert _failure(MemoryError("9 GiB"), model) == ("out of memory: MemoryError: 9 GiB", "failed")
    huge = raised(lambda: th.empty(2**60))
    assert _failure(huge, model).kind == "failed" and "out of memory" in _failure(huge, model).reason
    invalid = raised(lambda: th.distributions.Normal(th.tensor(float("nan")), 1.0))
    assert _failure(invalid, model).reason.startswith("diverged: ValueError: Expected parameter loc")
    gone = raised(lambda: gym.wrappers.TimeLimit(Line(), 3).step(np.zeros(1)))  # before reset
    assert _failure(gone, model).reason.startswith("environment: ") and _failure(gone, model).kind == "failed"
    with th.no_grad():
        model.policy.log_std[0] = float("nan")
    diverged = _failure(raised(lambda: [][0]), model)
    assert diverged.kind == "failed" and diverged.reason.startswith("diverged: weights that are not finite (IndexError")


@pytest.mark.parametrize("n_timesteps, n_envs, n_evaluations, expected", [(96, 1, 3, 32), (100, 2, 3, 16), (7, 1, 7, 1)])
def test_evaluations_are_at_equal_distances(n_timesteps, n_envs, n_evaluations, expected):
    found = evaluation_frequency(config(n_timesteps=n_timesteps, n_envs=n_envs), n_evaluations)
    assert found == expected and found * n_envs * n_evaluations <= n_timesteps


def test_more_evaluations_than_steps():
    with pytest.raises(ConfigError, match="--n-evaluations: 5 — expected at most 4, as 8 steps in 2"):
        evaluation_frequency(config(n_timesteps=8, n_envs=2), 5)


def test_trainings_end_with_their_sweep(tmp_path):
    flags = files(tmp_path, n_timesteps=10_000, env_kwargs={"fails": "wait"})
    process = start(tmp_path, *flags, "--n-trials", "1", "--seeds-per-trial", "2")
    deadline = time.monotonic() + 300
    while len(descendants(process.pid)) < 4:  # forks from a server, beside a tracker of resources
        assert time.monotonic() < deadline and process.poll() is None
        time.sleep(0.2)
    below = descendants(process.pid)
    kill(process.pid)
    process.wait()
    while [pid for pid in below if os.path.exists(f"/proc/{pid}")]:
        assert time.monotonic() < deadline
        time.sleep(0.2)
