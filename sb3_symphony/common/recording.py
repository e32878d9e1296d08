"""
The state of environments, which cannot be saved in general.

It is made again: the environment's generator is set to where it was at the episode's start, and the episode's actions are
replayed.
"""

import pickle
import time
from collections.abc import Iterator, Sequence
from copy import deepcopy
from enum import Enum
from typing import Any

import gymnasium as gym
import numpy as np
from stable_baselines3.common.env_util import unwrap_wrapper
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecEnvWrapper

_NOT_WRAPPER_STATE = {"env", "_action_space", "_observation_space", "_metadata", "_cached_spec", "_saved_kwargs", "spec"}
_PLAIN = (type(None), bool, int, float, complex, str, bytes, tuple, frozenset, Enum)  # one object by chance
_MONITOR_STATE = (
    "rewards",
    "needs_reset",
    "episode_returns",
    "episode_lengths",
    "episode_times",
    "total_steps",
    "current_reset_info",
)


def _same_bits(a: Any, b: Any) -> bool:
    """Whether two observations are equal bit for bit."""
    if isinstance(a, dict) or isinstance(b, dict):
        return isinstance(a, dict) and isinstance(b, dict) and a.keys() == b.keys() and all(_same_bits(a[k], b[k]) for k in a)
    a, b = np.asarray(a), np.asarray(b)
    return a.dtype == b.dtype and a.shape == b.shape and a.tobytes() == b.tobytes()


def _generators_of(instance: gym.Env | gym.Space, name: str = "env") -> Iterator[tuple[str, np.random.Generator]]:
    """All generators in use that an environment may draw from: its own ones, and those of its spaces."""
    for key, value in vars(instance).items():
        if isinstance(value, np.random.Generator):
            yield f"{name}.{key}", value
        elif isinstance(value, gym.Space):
            yield from _generators_of(value, f"{name}.{key}")
    parts: Any = getattr(instance, "spaces", ())  # of Dict and Tuple
    items: Any = parts.items() if isinstance(parts, dict) else enumerate(parts)
    for key, part in items:
        yield from _generators_of(part, f"{name}.{key}")


class RecordedEpisode(gym.Wrapper):
    """
    Remembers how the current episode began and its actions, from which the environment's state can be made again.

    It has to be the outermost wrapper. What the wrappers inside know at the episode's start is remembered too, since some
    count or average over episodes.

    :param env: environment, with a ``Monitor`` around it or around what it wraps
    :raises TypeError: if there is none
    """

    def __init__(self, env: gym.Env) -> None:
        super().__init__(env)
        monitor = unwrap_wrapper(env, Monitor)
        if not isinstance(monitor, Monitor):
            raise TypeError(f"RecordedEpisode: {env} — expected a Monitor inside (make_vec_env: wrapper_class=…)")
        self.monitor = monitor
        self.start: dict[str, Any] = {}
        self.actions: list[Any] = []
        self.rewards: list[Any] = []
        self.observation: Any = None

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        generators = self._generator_states()
        if seed is not None:
            generators.pop("env._np_random", None)  # which is about to be replaced
        self.start = {"generators": generators, "seed": seed, "options": options, "wrappers": self._wrappers()}
        self.actions, self.rewards = [], []
        self.observation, info = self.env.reset(seed=seed, options=options)
        self.start["observation"] = deepcopy(self.observation)  # some environments write the next one into it
        return self.observation, info

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        self.actions.append(np.array(action))
        result = self.env.step(action)
        self.observation = result[0]
        self.rewards.append(result[1])
        return result

    def recorded_state(self) -> dict[str, Any]:
        """:return: what :meth:`replay` and :meth:`start_anew` need"""
        return {
            "start": self.start,
            "actions": np.array(self.actions),
            "rewards": np.array(self.rewards),
            "observation": self.observation,
            "generators": self._generator_states(),
            "wrappers": self._wrappers(),
            "monitor": {name: getattr(self.monitor, name) for name in _MONITOR_STATE},
            "elapsed": time.time() - self.monitor.t_start,
        }

    def replay(self, state: dict[str, Any]) -> bool:
        """
        Begin the recorded episode again and replay its actions, as long as they lead to what they led to: a robot does not
        repeat moves that were made for another situation.

        :param state: from :meth:`recorded_state`
        :return: whether that reproduced observation and rewards bit for bit
        """
        start, rewards, writer = state["start"], state["monitor"]["rewards"], self.monitor.results_writer
        self.monitor.results_writer = None  # an episode that ends here never happened
        try:
            self._set_wrappers(start["wrappers"])
            self._set_generators(start["generators"])
            self.monitor.needs_reset = True  # it may be told to refuse resets in the middle of an episode
            self.reset(seed=start["seed"], options=start["options"])
            if not _same_bits(self.observation, start["observation"]):
                return False
            for action in state["actions"]:
                _, _, terminated, truncated, _ = self.step(action)
                # One of each step, but for wrappers that take several steps at once, or a few at the start
                latest = len(self.monitor.rewards) - 1
                if terminated or truncated or self.monitor.rewards[latest:] != rewards[latest : latest + 1]:
                    return False
            if not (_same_bits(self.monitor.rewards, rewards) and _same_bits(self.rewards, state["rewards"])):
                return False
        finally:
            self.monitor.results_writer = writer
            self._set_monitor(state)
        return _same_bits(self.observation, state["observation"])

    def start_anew(self, state: dict[str, Any]) -> None:
        """
        Take up what outlives an episode (the generator, what wrappers and monitor count), before a reset.

        :param state: from :meth:`recorded_state`
        """
        self._set_wrappers(state["wrappers"])
        self._set_generators(state["generators"])
        self._set_monitor(state)
        self.monitor.needs_reset = True  # as in replay()

    def _set_monitor(self, state: dict[str, Any]) -> None:
        for name, value in state["monitor"].items():
            setattr(self.monitor, name, value)
        self.monitor.t_start = time.time() - state["elapsed"]

    def _generator_states(self) -> dict[str, Any]:
        return {name: generator.bit_generator.state for name, generator in _generators_of(self.unwrapped)}

    def _set_generators(self, states: dict[str, Any]) -> None:
        for name, generator in _generators_of(self.unwrapped):
            if name in states:
                generator.bit_generator.state = states[name]

    def _inner_wrappers(self) -> Iterator[gym.Wrapper]:
        env = self.env
        while isinstance(env, gym.Wrapper):
            if not isinstance(env, Monitor):
                yield env
            env = env.env

    def _wrappers(self) -> list[dict[str, bytes]]:
        return [
            {name: pickled for name, value in own.items() if (pickled := _pickled(value)) is not None}
            for _, own in self._own_attributes()
        ]

    def _set_wrappers(self, states: list[dict[str, bytes]]) -> None:
        for (wrapper, own), state in zip(self._own_attributes(), states, strict=True):
            for name, pickled in state.items():
                value = pickle.loads(pickled)
                if _same_form(own.get(name), value):
                    own[name][...] = value  # it may be a view of the simulator's memory
                else:
                    setattr(wrapper, name, value)

    def _own_attributes(self) -> Iterator[tuple[gym.Wrapper, dict[str, Any]]]:
        """Wrappers and what may be their state: no part of the environment inside, which has its own."""
        inside = {id(value) for value in vars(self.unwrapped).values() if not isinstance(value, _PLAIN)}
        for wrapper in self._inner_wrappers():
            yield wrapper, {name: value for name, value in vars(wrapper).items() if _is_own(name, value, inside)}


def _is_own(name: str, value: Any, inside: set[int]) -> bool:
    other = name in _NOT_WRAPPER_STATE or callable(value) or isinstance(value, gym.Env | gym.Space)
    return not other and id(value) not in inside


def _same_form(current: Any, value: Any) -> bool:
    arrays = isinstance(current, np.ndarray) and isinstance(value, np.ndarray) and current.flags.writeable
    return arrays and (current.shape, current.dtype) == (value.shape, value.dtype)


def _pickled(value: Any) -> bytes | None:
    try:
        return pickle.dumps(value)
    except Exception:  # ValueError, RuntimeError, …: each library has its own way to refuse
        return None  # windows, drivers, files and the like are no state


def record_episodes(env: VecEnv) -> None:
    """
    Put :class:`RecordedEpisode` around each copy of an environment, so that checkpoints can hold its state. Environments
    in processes of their own have to be made with that wrapper.

    :param env: environment whose copies are in this process and have a ``Monitor``, as those of ``make_vec_env``
    :raises TypeError: if it is another kind
    """
    copies = env.unwrapped
    if not isinstance(copies, DummyVecEnv) or not all(copies.env_is_wrapped(Monitor)):
        raise TypeError(f"record_episodes: {copies} — expected a DummyVecEnv of environments with a Monitor")
    copies.envs = [RecordedEpisode(copy) for copy in copies.envs]


def is_recorded(env: VecEnv) -> bool:
    """
    :param env: environment
    :return: whether the state of each copy can be saved
    """
    return all(env.env_is_wrapped(RecordedEpisode))


def each_copy(env: VecEnv, method: str, states: Sequence[dict[str, Any]]) -> list[Any]:
    """
    Call a method of each :class:`RecordedEpisode`, which may be in another process, with its own state.

    :param env: environment
    :param method: name of the method
    :param states: what to call it with, for each copy
    :return: its results
    """
    return [env.env_method(method, state, indices=[index])[0] for index, state in enumerate(states)]


# What wrappers of vectorised environments know: VecNormalize (its own pickle drops the returns), VecFrameStack, VecMonitor
_VEC_ENV_STATE = (
    *("obs_rms", "ret_rms", "returns", "old_obs", "old_reward"),
    "stacked_obs",
    *("episode_returns", "episode_lengths", "episode_count"),
)


def _vec_wrappers(env: VecEnv) -> Iterator[VecEnvWrapper]:
    while isinstance(env, VecEnvWrapper):
        yield env
        env = env.venv


def vec_env_state(env: VecEnv) -> list[dict[str, Any]]:
    """
    :param env: environment
    :return: state of the wrappers around all copies, for :func:`restore_vec_env`
    """
    return [{name: vars(w)[name] for name in _VEC_ENV_STATE if name in vars(w)} for w in _vec_wrappers(env)]


def restore_vec_env(env: VecEnv, states: list[dict[str, Any]]) -> None:
    """
    :param env: environment with the same wrappers
    :param states: from :func:`vec_env_state`
    """
    for wrapper, state in zip(_vec_wrappers(env), states, strict=True):
        vars(wrapper).update(state)
