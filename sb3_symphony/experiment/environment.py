"""Environments of a run: what is learned from, and what is evaluated."""

import os
import signal
import time
import warnings
from collections.abc import Callable
from functools import partial
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path, PurePath
from typing import Any, SupportsFloat

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.monitor import Monitor, ResultsWriter
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.vec_env import (
    DummyVecEnv,
    SubprocVecEnv,
    VecEnv,
    VecEnvWrapper,
    VecFrameStack,
    VecNormalize,
    unwrap_vec_normalize,
)

from sb3_symphony.analysis.statistics import EVALUATION_SEED
from sb3_symphony.common.checks import suggestion
from sb3_symphony.common.recording import RecordedEpisode
from sb3_symphony.common.wrappers import EpisodeStepLimit, FreshBox2DWorld, LearningReward, needs_fresh_world
from sb3_symphony.experiment.config import ConfigError, RunSettings, reason, told
from sb3_symphony.experiment.decode import typed_arguments
from sb3_symphony.experiment.registry import without_module

_WRAPPER_PACKAGES = ("sb3_symphony.", "gymnasium.wrappers.", "stable_baselines3.", "sb3_contrib.")
#: a configuration must not choose what is written where
_WRITE_FILES = {"Monitor", "RecordVideo", "VecMonitor", "VecVideoRecorder"}
#: and has keys for what the run folder keeps the statistics of, or a loaded model needs
_OWN_KEYS = {
    "VecNormalize": "normalize",
    "VecFrameStack": "frame_stack",
    "NormalizeObservation": "normalize",
    "NormalizeReward": "normalize",
}
#: change the reward and nothing else: reported returns stay the environment's own
REWARD_WRAPPERS = (LearningReward, gym.RewardWrapper)
_TRAINING_ONLY = (*REWARD_WRAPPERS, EpisodeStepLimit)
_ON_POLICY_SPACES = (spaces.Box, spaces.Discrete, spaces.MultiDiscrete, spaces.MultiBinary)

Wrappers = list[Callable[[gym.Env], gym.Env]]


class EpisodeSeeds(gym.Wrapper):
    """
    Runs the i-th episode since :meth:`restart_seeds` on environment seed 10 000 + i.

    :param env: environment
    """

    def __init__(self, env: gym.Env) -> None:
        super().__init__(env)
        self.episode = 0

    def restart_seeds(self) -> None:
        """Let the next episode be the first again."""
        self.episode = 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """
        :param seed: ignored
        :param options: handed to the environment
        :return: first observation and info
        """
        seed = EVALUATION_SEED + self.episode
        self.episode += 1
        return self.env.reset(seed=seed, options=options)


def find_wrapper(name: str, key: str = "env_wrapper") -> type:
    """
    :param name: dotted name of a wrapper, in one of the packages that a configuration may name
    :param key: ``env_wrapper`` for one of ``gym.Wrapper``, ``vec_env_wrapper`` for one of ``VecEnvWrapper``
    :return: its class
    :raises ConfigError: if there is none
    """
    if not name.startswith(_WRAPPER_PACKAGES):
        raise ConfigError(f"{key}: '{name}' — expected a dotted name that starts with {', '.join(_WRAPPER_PACKAGES)}")
    module_name, _, class_name = name.rpartition(".")
    try:
        module = import_module(module_name)
    except ImportError:
        raise ConfigError(f"{key}: '{name}' — there is no module '{module_name}'") from None
    if class_name in _OWN_KEYS:
        raise ConfigError(f"{key}: '{name}' — expected as the key {_OWN_KEYS[class_name]}")
    kind = gym.Wrapper if key == "env_wrapper" else VecEnvWrapper
    wrappers = [
        each
        for each, value in vars(module).items()
        if isinstance(value, type) and issubclass(value, kind) and value is not kind and each not in _WRITE_FILES
    ]
    if class_name not in wrappers:
        raise ConfigError(f"{key}: '{name}' — no such wrapper in {module_name}{suggestion(class_name, wrappers)}")
    return getattr(module, class_name)


def for_training_only(name: str) -> bool:
    """
    :param name: dotted name of a wrapper, as a configuration may name it
    :return: whether it changes only what is learned from, and is left out where agents are evaluated or shown
    :raises ConfigError: if there is none
    """
    return issubclass(find_wrapper(name), _TRAINING_ONLY)


def split_wrappers(named: list[tuple[str, dict[str, Any]]]) -> tuple[Wrappers, Wrappers]:
    """
    Look up the wrappers of a configuration.

    :param named: dotted names and arguments
    :return: those that belong to the task, inside ``Monitor`` and in evaluation too; and those for training only,
        outside it, so that reported returns are the environment's own
    """
    task: Wrappers = []
    training: Wrappers = []
    for name, arguments in named:
        class_ = find_wrapper(name)
        wrapper = partial(class_, **typed_arguments(arguments, class_, ["env"]))
        (training if for_training_only(name) else task).append(wrapper)
    return task, training


def check_task_wrappers(named: list[tuple[str, dict[str, Any]]], where: str) -> None:
    """
    :param named: wrappers for an evaluation, as a configuration has them
    :param where: where they come from, for messages
    :raises ConfigError: if one of them is for training only, where it changes what is learned
    """
    for name, _ in named:
        if for_training_only(name):
            raise ConfigError(f"{where}: '{name}' — is for training only; evaluations have the environment's own rewards")


def _wrapped(env: gym.Env, wrappers: Wrappers) -> gym.Env:
    for wrapper in wrappers:
        try:
            env = wrapper(env)
        except Exception as error:  # such as AttributeError, of a wrapper for another kind of environment
            named = getattr(wrapper, "func", wrapper)  # a class with arguments, or any function
            raise ConfigError(f"env_wrapper: {named.__name__}: {reason(error)}") from error
    return env


def vec_wrapped(env: VecEnv, settings: RunSettings) -> VecEnv:
    """
    :param env: vectorised environment
    :param settings: settings of the run
    :return: the environment in the wrappers that ``vec_env_wrapper`` names
    :raises ConfigError: if one does not fit
    """
    for name, arguments in settings.vec_env_wrapper:
        class_ = find_wrapper(name, "vec_env_wrapper")
        try:
            env = class_(env, **typed_arguments(arguments, class_, ["venv", "env"]))
        except (ValueError, TypeError, AssertionError, KeyError, AttributeError) as error:
            if isinstance(error, ConfigError):
                raise
            raise ConfigError(f"vec_env_wrapper: {class_.__name__}: {error}") from None
    return env


def import_packages(names: list[str]) -> None:
    """
    Import modules that register environments.

    :param names: importable names
    :raises ConfigError: for the first one that cannot be imported
    """
    for name in names:
        file = PurePath(name)
        if file.suffix == ".py" or len(file.parts) > 1:
            near = ".".join(file.with_suffix("").parts).lstrip("/.")
            raise ConfigError(f"--gym-packages: '{name}' — expected the name of a module, no file: did you mean '{near}'?")
        try:
            import_module(name)
        except Exception as error:  # whatever the module does
            raise ConfigError(f"--gym-packages: '{name}' cannot be imported — {told(error)}") from error


def make_env(env_id: str, env_kwargs: dict[str, Any], wrappers: Wrappers) -> gym.Env:
    """
    Make one environment; a Box2D one with a fresh world in every episode.

    :param env_id: registered id
    :param env_kwargs: its arguments
    :param wrappers: wrappers that belong to the task
    :return: the environment, without ``Monitor``
    :raises ConfigError: if there is no such environment, or it cannot be made
    """
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message=".*is out of date")  # papers' figures are for the older versions
            warnings.filterwarnings("ignore", message=".*Using the latest versioned")  # an error, see below
            env = gym.make(env_id, **env_kwargs)
    except (gym.error.DependencyNotInstalled, ImportError) as error:
        message = str(error)
        if "mujoco" in message.lower() and find_spec("mujoco") is None:
            message = 'MuJoCo is not installed: pip install "sb3-symphony[mujoco]"'
        raise ConfigError(f"environment '{env_id}' cannot be made — {message}") from None
    except gym.error.UnregisteredEnv:
        near = suggestion(env_id, gym.registry) or " — expected a registered id such as BipedalWalker-v3"
        own = f"one's own: MODULE:{env_id}; most commands have --gym-packages"
        raise ConfigError(f"unknown environment '{env_id}'{near} ({own})") from None
    except gym.error.Error as error:
        raise ConfigError(f"environment '{env_id}' cannot be made — {error}") from None
    except (TypeError, ValueError, AssertionError, OSError) as error:
        raise ConfigError(f"environment '{env_id}' cannot be made with {env_kwargs} — {error}") from None
    except Exception as error:  # whatever a user's own module or environment does
        raise ConfigError(f"environment '{env_id}' cannot be made — {told(error)}") from error
    registered = env.spec.id if env.spec is not None else env_id
    if registered != without_module(env_id):  # Gymnasium takes the latest version; settings and folders go by the full id
        env.close()
        raise ConfigError(f"unknown environment '{env_id}': did you mean '{registered}'?")
    if needs_fresh_world(env):
        env = FreshBox2DWorld(env)
    return _wrapped(env, wrappers)


def check_spaces(env: VecEnv, env_id: str, algo: str, algorithm: type[BaseAlgorithm], policy: str) -> None:
    """
    :param env: the environment
    :param env_id: its id
    :param algo: name of the algorithm
    :param algorithm: its class
    :param policy: name of the policy
    :raises ConfigError: if algorithm or policy do not fit its spaces
    """
    space, on_policy = env.action_space, issubclass(algorithm, OnPolicyAlgorithm)
    allowed = _ON_POLICY_SPACES if on_policy else (spaces.Box,)
    if not isinstance(space, allowed):
        raise ConfigError(f"{env_id}: its action space is {space} — {algo} needs a continuous one (Box)")
    if isinstance(space, spaces.Box) and not np.all(np.isfinite([space.low, space.high])):
        raise ConfigError(f"{env_id}: its action space {space} is unbounded — {algo} needs finite limits")
    if isinstance(space, spaces.Box) and not on_policy:  # which scales actions to [-1, 1]
        if not np.issubdtype(space.dtype, np.floating):
            raise ConfigError(f"{env_id}: its action space is {space} — {algo} needs real numbers")
        if not np.all(space.low < space.high):
            index = np.argmin(space.low < space.high)
            raise ConfigError(f"{env_id}: its action {index} is always {space.low.flat[index]} — {algo} needs low < high")
    if not on_policy and isinstance(env, VecFrameStack) and unwrap_vec_normalize(env) is not None:
        # The replay keeps what VecNormalize was given, one observation at a time
        raise ConfigError(f"frame_stack: cannot be combined with normalize for {algo} — only for on-policy algorithms")
    if policy == "MultiInputPolicy" and not isinstance(env.observation_space, spaces.Dict):
        raise ConfigError(f"policy: 'MultiInputPolicy' — needs Dict observations, {env_id} has {env.observation_space}")


def same_space(ours: spaces.Space, theirs: spaces.Space, exact: bool) -> bool:
    """
    :param ours: a space
    :param theirs: another one
    :param exact: whether limits count
    :return: whether they are the same
    """
    if isinstance(ours, spaces.Dict) and isinstance(theirs, spaces.Dict):
        return ours.keys() == theirs.keys() and all(same_space(ours[key], theirs[key], exact) for key in ours)
    if isinstance(ours, spaces.Box) and isinstance(theirs, spaces.Box) and not exact:
        return ours.shape == theirs.shape and (ours.dtype == np.uint8) == (theirs.dtype == np.uint8)
    return ours == theirs


def check_same_spaces(training: VecEnv, evaluation: VecEnv) -> None:
    """
    :param training: environment that is learned from
    :param evaluation: environment for evaluations
    :raises ConfigError: if their spaces differ; limits of observations may, as nothing uses them
    """
    for what in ("observation_space", "action_space"):
        ours, theirs = getattr(training, what), getattr(evaluation, what)
        if not same_space(ours, theirs, exact=what == "action_space"):
            raise ConfigError(f"--eval-env-kwargs: {what} {theirs} — that of the training is {ours}")


def _normalized(env: VecEnv, settings: RunSettings, gamma: float | None, training: bool) -> VecEnv:
    if settings.normalize is False:
        return env
    arguments = {} if settings.normalize is True else dict(settings.normalize)
    arguments = typed_arguments(arguments, VecNormalize, ["venv", "training"], lowest=0)
    if gamma is not None:
        arguments.setdefault("gamma", gamma)
    if not training:
        arguments["norm_reward"] = False  # evaluations report the environment's own returns
    try:
        return VecNormalize(env, training=training, **arguments)
    except (ValueError, TypeError, AssertionError) as error:
        raise ConfigError(f"normalize: {error}") from None


def stacked(env: VecEnv, settings: RunSettings) -> VecEnv:
    """
    :param env: vectorised environment, already normalised (as in RL Zoo, so that statistics are those of one observation)
    :param settings: settings of the run
    :return: the environment, its latest observations stacked if the settings want that
    :raises ConfigError: if they cannot be
    """
    if settings.frame_stack is None:
        return env
    try:
        return VecFrameStack(env, settings.frame_stack)
    # Among what SB3 raises: AssertionError for Discrete, TypeError for one within a Dict, NotImplementedError for nested Dicts
    except (ValueError, TypeError, AssertionError, NotImplementedError) as error:
        raise ConfigError(f"frame_stack: observations of {env.observation_space} cannot be stacked — {error}") from None


class _EpisodeWriter(ResultsWriter):
    """
    The file of a :class:`RunMonitor`. A row that the ``Monitor`` writes is kept until :meth:`complete`.

    :param path: the file
    :param header: what its first line tells
    :param append: go on with it if it is there
    """

    def __init__(self, path: Path, header: dict[str, float | str], append: bool) -> None:
        lines = path.read_text().splitlines() if append and path.exists() else []
        self.path, self.header = path, header
        self.n_rows = max(0, len(lines) - 2)
        self.row: dict[str, Any] | None = None
        self._open(tuple(lines[1].split(",")[3:]) if len(lines) > 1 else (), append)

    def _open(self, columns: tuple[str, ...], append: bool) -> None:
        self.columns = columns  # beside return, length and time
        super().__init__(str(self.path), self.header, columns, override_existing=not append)

    def write_row(self, epinfo: dict[str, Any]) -> None:
        self.row = dict(epinfo)

    def complete(self, info: dict[str, Any]) -> None:
        """
        Write the row of the episode that has just ended, if one has.

        :param info: what the environment told at its end
        """
        if self.row is None:
            return
        if self.n_rows == 0 and "is_success" in info:
            self.close()
            self._open(("is_success",), append=False)
        told = {column: bool(info[column]) for column in self.columns if column in info}
        super().write_row({**self.row, **told})
        self.row = None
        self.n_rows += 1


class RunMonitor(Monitor):
    """
    A ``Monitor`` whose file may come later, in whichever process it is.

    If the environment tells at the end of the first episode whether it was a success, the file has a column for that.
    """

    def write_to(self, path: str, append: bool) -> None:
        """
        :param path: file to write, without ``.monitor.csv``
        :param append: go on with it if it is there
        """
        self.t_start = time.time()
        header: dict[str, float | str] = {"t_start": self.t_start, "env_id": str(self.spec.id if self.spec else None)}
        self.results_writer = _EpisodeWriter(Path(f"{path}.{self.EXT}"), header, append)

    def step(self, action: Any) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        observation, reward, terminated, truncated, info = super().step(action)
        if isinstance(self.results_writer, _EpisodeWriter):
            self.results_writer.complete(info)
        return observation, reward, terminated, truncated, info


def _in_own_process(make: Callable[[], gym.Env], packages: list[str]) -> gym.Env:
    # Ctrl-C and `timeout` reach all processes of a group; the run decides, which needs its environments until then
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if hasattr(os, "setpgrp"):
        os.setpgrp()
    import_packages(packages)  # what is registered is registered in one process
    return make()


def make_training_env(
    env_id: str,
    settings: RunSettings,
    gamma: float | None,
    seed: int,
    subprocesses: bool = False,
    packages: list[str] | None = None,
    recorded: bool = False,
) -> VecEnv:
    """
    :param env_id: registered id
    :param settings: settings of the run
    :param gamma: the algorithm's discount factor, for the normalisation of rewards
    :param seed: environment ``i`` gets ``seed + i``
    :param subprocesses: whether each copy gets a process of its own
    :param packages: modules that register environments, which such a process has to import
    :param recorded: whether episodes are recorded, for checkpoints
    :return: vectorised environment whose monitors do not write yet (see :func:`attach_monitor_files`)
    """
    task, training = split_wrappers(settings.env_wrapper)

    def one(index: int) -> gym.Env:
        env = _wrapped(RunMonitor(make_env(env_id, settings.env_kwargs, task)), training)
        env.action_space.seed(seed + index)
        return RecordedEpisode(env) if recorded else env

    makers: list[Callable[[], gym.Env]] = [partial(one, index) for index in range(settings.n_envs)]
    env: VecEnv
    if subprocesses:
        one(0).close()  # a mistake is told here
        env = SubprocVecEnv([partial(_in_own_process, make, packages or []) for make in makers])
    else:
        try:
            env = DummyVecEnv(makers)
        except NotImplementedError as error:  # what SB3 raises for Tuple and nested Dict observations
            raise ConfigError(f"{env_id}: {error}") from None
    env.seed(seed)
    try:
        return stacked(_normalized(vec_wrapped(env, settings), settings, gamma, training=True), settings)
    except BaseException:
        env.close()
        raise


def make_evaluation_env(env_id: str, settings: RunSettings, env_kwargs: dict[str, Any] | None = None) -> VecEnv:
    """
    :param env_id: registered id
    :param settings: settings of the run, of which wrappers for training only are left out
    :param env_kwargs: arguments of the environment that go before those of the run
    :return: vectorised environment with one copy, on the evaluation seeds
    """
    task, _ = split_wrappers(settings.env_wrapper)

    def evaluation_env() -> gym.Env:
        return Monitor(EpisodeSeeds(make_env(env_id, {**settings.env_kwargs, **(env_kwargs or {})}, task)))

    env = vec_wrapped(DummyVecEnv([evaluation_env]), settings)
    env = stacked(_normalized(env, settings, None, training=False), settings)
    return BaseAlgorithm._wrap_env(env, verbose=0, monitor_wrapper=False)  # images with their channels first, as in training


def attach_monitor_files(env: VecEnv, folder: Path, append: bool = False) -> None:
    """
    Let the monitors write ``<i>.monitor.csv``. Separate, since a run folder exists only once everything else is known good.

    :param env: training environment
    :param folder: run folder
    :param append: go on with files that are there
    """
    for index in range(env.num_envs):
        env.env_method("write_to", str(folder / str(index)), append, indices=[index])
