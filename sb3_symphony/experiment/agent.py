"""A trained agent in its environment: loaded, checked against each other, and played episode by episode."""

import json
import sys
import warnings
import zipfile
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.utils import set_random_seed
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecNormalize

from sb3_symphony.experiment.config import ConfigError, told
from sb3_symphony.experiment.environment import (
    RunMonitor,
    Wrappers,
    check_task_wrappers,
    import_packages,
    make_env,
    same_space,
    split_wrappers,
    stacked,
    vec_wrapped,
)
from sb3_symphony.experiment.registry import LOADABLE, load_algorithm
from sb3_symphony.experiment.select import Selection, SelectOptions, select_model

#: what is said of a model without :func:`finite_weights`
DIVERGED = "its training has diverged, weights are not finite"


class Step(NamedTuple):
    """
    One step of an episode.

    :param observation: what the agent saw, normalised and stacked if it is, shape ``(*observation_shape,)``
    :param action: what it did, in the environment's units, shape ``(*action_shape,)``
    :param reward: the environment's own reward for it
    :param done: whether the episode ended with it; the environment is then already reset
    :param info: the environment's info; after the last step ``info["episode"]`` holds return ``r`` and length ``l``
    """

    observation: Any
    action: np.ndarray
    reward: float
    done: bool
    info: dict[str, Any]


@dataclass
class Agent:
    """
    A model and the environment that it acts in. Used in a ``with`` statement, it closes the environment at the end.

    :param selection: where both come from
    :param model: any algorithm's model, for ``predict`` only
    :param env: vectorised environment with ``Monitor``, normalised with frozen statistics and stacked as in training
    """

    selection: Selection
    model: BaseAlgorithm
    env: VecEnv

    def __enter__(self) -> "Agent":
        return self

    def __exit__(self, *error: object) -> None:
        self.env.close()

    def episode(self, seed: int, deterministic: bool = True) -> Iterator[Step]:
        """
        Play one episode, in an environment with one copy. Environment, policy and Python's, NumPy's and torch's global
        generators are seeded, so the episode depends on nothing else.

        :param seed: seed of the episode
        :param deterministic: whether the policy is asked for its mode instead of a sample
        :return: its steps, one by one
        """
        assert self.env.num_envs == 1
        set_random_seed(seed)
        self.env.seed(seed)
        observation: Any = self.env.reset()
        state, start, done = None, np.ones(1, dtype=bool), False
        while not done:
            action, state = self.model.predict(observation, state, start, deterministic)
            seen = observation
            observation, rewards, start, infos = self.env.step(action)
            done = bool(start[0])
            seen = {key: value[0] for key, value in seen.items()} if isinstance(seen, dict) else seen[0]
            yield Step(seen, action[0], float(rewards[0]), done, infos[0])


def open_agent(
    options: SelectOptions,
    n_envs: int = 1,
    render_mode: str | None = None,
    wrappers: Wrappers | None = None,
    norm_reward: bool = False,
) -> Agent:
    """
    Find and load an agent, and make the environment that it acts in.

    :param options: flags that say which agent
    :param n_envs: copies of the environment, in this process
    :param render_mode: Gymnasium's: ``"human"`` for a window, ``"rgb_array"`` for frames
    :param wrappers: put around the environment, inside ``Monitor``
    :param norm_reward: whether rewards are normalised as in training; reported returns are the environment's own
    :return: the agent
    :raises ConfigError: if something is missing or damaged, or model and environment do not fit
    """
    import_packages(options.gym_packages)
    check_device(options.device)
    check_task_wrappers(options.env_wrapper, "--env-wrapper")
    selection = select_model(options)
    if options.num_threads > 0:
        th.set_num_threads(options.num_threads)
    env = _make_env(selection, n_envs, render_mode, wrappers or [], norm_reward)
    try:
        model = load_model(selection, options.device)
        env = BaseAlgorithm._wrap_env(env, verbose=0)  # images with their channels first, as in training
        check_match(model, env, str(selection.model), selection.env_id)
    except BaseException:
        env.close()
        raise
    if not finite_weights(model):
        print(f"note: {selection.model}: {DIVERGED}", file=sys.stderr)
    return Agent(selection, model, env)


def check_device(name: str) -> None:
    """
    :param name: name of a device
    :raises ConfigError: if torch cannot calculate on it here
    """
    try:
        th.zeros(1, device="cpu" if name == "auto" else name).item()
    # What torch raises for an unknown name or a device without numbers ("meta"); without CUDA; without that backend ("xla")
    except (RuntimeError, AssertionError):
        known = "auto, cpu" + ", cuda" * th.cuda.is_available()
        raise ConfigError(f"--device: '{name}' is not there — expected {known}") from None


# ----------------------------------------------------------------------------------------------------------------------
# Environment
# ----------------------------------------------------------------------------------------------------------------------


def _make_env(selection: Selection, n_envs: int, render_mode: str | None, wrappers: Wrappers, norm_reward: bool) -> VecEnv:
    task, _ = split_wrappers(selection.settings.env_wrapper)
    env_kwargs = dict(selection.settings.env_kwargs)
    if render_mode is not None:
        env_kwargs["render_mode"] = render_mode

    def one() -> gym.Env:
        return RunMonitor(make_env(selection.env_id, env_kwargs, [*task, *wrappers]))

    env = vec_wrapped(DummyVecEnv([one] * n_envs), selection.settings)
    if selection.normalization is not None:
        env = load_normalization(selection.normalization, env)
        env.training, env.norm_reward = False, norm_reward and env.norm_reward
    return stacked(env, selection.settings)


def load_normalization(path: Path, env: VecEnv) -> VecNormalize:
    """
    :param path: statistics saved by ``VecNormalize``
    :param env: environment to normalise; closed if that fails
    :return: the environment, normalised by them
    :raises ConfigError: if they are damaged, or do not fit
    """
    try:
        return VecNormalize.load(str(path), env)
    except Exception as error:  # a pickle can fail in any way
        env.close()
        if isinstance(error, AssertionError):  # shapes
            raise ConfigError(f"{path}: statistics do not fit the environment — {error}") from error
        raise ConfigError(f"{path}: not statistics of VecNormalize, or damaged — {told(error)}") from error


# ----------------------------------------------------------------------------------------------------------------------
# Model
# ----------------------------------------------------------------------------------------------------------------------


@cache
def _tell_of_pickles() -> None:
    """Once in a process."""
    print(
        "note: model files hold pickled objects, which can run any code when loaded: load them only from people you trust",
        file=sys.stderr,
    )


def _substitutes() -> dict[str, Any]:
    """
    What stands in for parts of a model that acting does not need. They hold pickles that often do not outlive a version of
    Python, NumPy or Stable-Baselines3, and make a replay buffer of full size. Made anew each time, as SB3 changes them.
    """
    substitutes: dict[str, Any] = {"learning_rate": 0.0, "replay_buffer_kwargs": {}, "verbose": 0}
    substitutes["optimize_memory_usage"] = False
    substitutes.update(dict.fromkeys(("lr_schedule", "clip_range", "exploration_schedule"), lambda _: 0.0))
    substitutes.update(dict.fromkeys(("ep_info_buffer", "ep_success_buffer", "_last_obs", "_last_original_obs")))
    substitutes.update(dict.fromkeys(("_last_episode_starts", "_last_lstm_states", "clip_range_vf", "tensorboard_log")))
    substitutes.update(dict.fromkeys(("action_noise", "replay_buffer_class")))
    return substitutes


def load_model(selection: Selection, device: str = "auto") -> BaseAlgorithm:
    """
    Load a model to act with; what only training needs is left out, so it cannot go on learning.

    :param selection: what to load
    :param device: where its networks run
    :return: the model, without environment
    :raises ConfigError: if the file is damaged or of another algorithm
    """
    try:
        algorithm = load_algorithm(selection.algo)
    except ValueError as error:  # of a user's own file
        raise ConfigError(f"--algo: {error}") from error
    _check_archive(selection, algorithm)
    if selection.run is None and not selection.shipped:
        _tell_of_pickles()
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message=".*n_steps.*")  # SB3's, about the replay that is left out
            warnings.simplefilter("ignore", DeprecationWarning)  # of old pickles
            return algorithm.load(selection.model, device=device, custom_objects=_substitutes(), buffer_size=1)
    except Exception as error:  # a pickle can fail in any way
        raise ConfigError(f"{selection.model}: cannot be loaded as a model of {selection.algo} — {told(error)}") from error


def finite_weights(model: BaseAlgorithm) -> bool:
    """
    :param model: a model
    :return: whether all of its networks' weights are finite; else its training has diverged
    """
    return all(bool(th.isfinite(value).all()) for value in model.policy.state_dict().values() if value.is_floating_point())


def check_finite(model: BaseAlgorithm, name: str) -> None:
    """
    :param model: a model
    :param name: what it is called in the message
    :raises ConfigError: if its training has diverged
    """
    if not finite_weights(model):
        raise ConfigError(f"{name}: {DIVERGED} — expected an agent that acts")


def _check_archive(selection: Selection, algorithm: type[BaseAlgorithm]) -> None:
    """Whether a file is a model of the algorithm at all, seen without unpickling anything."""
    path = selection.model
    try:
        with zipfile.ZipFile(path) as archive:
            broken = archive.testzip()
            if broken:
                raise zipfile.BadZipFile(f"{broken} is damaged")
            data = json.loads(archive.read("data"))
            policy = data["policy_class"]["__module__"]
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read — {error.strerror or error}") from None
    except Exception as error:
        raise ConfigError(f"{path}: not a model saved by Stable-Baselines3, or damaged — {told(error)}") from None

    def policies(of: type[BaseAlgorithm]) -> set[str]:
        return {class_.__module__ for class_ in of.policy_aliases.values()}

    if policy not in policies(algorithm):
        owners = [name for name in LOADABLE if policy in policies(load_algorithm(name))]
        if owners:  # else a policy of somebody's own
            raise ConfigError(f"{path}: not a model of {selection.algo} — its policy is that of {' or '.join(owners)}")
    if selection.normalization_known:
        return
    # On-policy, SB3 keeps this where observations or rewards were normalised; off-policy it always does
    if data.get("_last_original_obs") is not None and "replay_buffer_class" not in data:
        raise ConfigError(
            f"{path}: was trained with VecNormalize — expected its statistics as --vecnormalize FILE, or "
            "--vecnormalize none if only rewards were normalised"
        )
    for statistics in sorted(path.parent.glob("*vec*normalize*.pkl")):
        print(f"note: {statistics} lies beside the model, --vecnormalize would use it", file=sys.stderr)


def check_match(model: BaseAlgorithm, env: VecEnv, name: str, env_id: str) -> None:
    """
    Limits of observations are not compared: they differ between versions of an environment, and nothing uses them.

    :param model: a model
    :param env: environment that it is to act in
    :param name: what the model is called in the message
    :param env_id: the environment's id
    :raises ConfigError: if their spaces differ
    """
    for what, own, given, exact in (
        ("observation", model.observation_space, env.observation_space, False),
        ("action", model.action_space, env.action_space, True),
    ):
        if not same_space(own, given, exact):
            both = f"{what} space of the model {own}, of the environment {given}"
            raise ConfigError(f"{name} does not fit {env_id}: {both}")
