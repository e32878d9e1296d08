"""
Checkpoints from which training goes on as if it had never stopped: bit for bit, on the same machine and versions.

A checkpoint is made at the start of a rollout, where networks, replay and latest observation belong together (SB3's
``on_step`` comes before the transition is stored). It is one file, beside the segments of the replay buffer: each segment
holds the transitions that were new at one checkpoint and is never changed, so a checkpoint costs what is new. Every file
is written under another name, synchronised and renamed, and starts with the checksum of its content; a checkpoint also
names the checksums of its segments. Whatever is cut or missing is recognised, and the checkpoint before is used.

The state of an environment cannot be saved in general. It is made again: the environment's generator is set to where it
was at the episode's start, and the episode's actions are replayed (:class:`RecordedEpisode`).

A checkpoint holds pickled objects: resume only runs of people you trust.
"""

import hashlib
import inspect
import io
import os
import pickle
import platform
import random
import re
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from copy import deepcopy
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.buffers import NStepReplayBuffer, ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.distributions import StateDependentNoiseDistribution
from stable_baselines3.common.env_util import unwrap_wrapper
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.save_util import recursive_getattr
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecEnvWrapper
from stable_baselines3.her.her_replay_buffer import HerReplayBuffer

from sb3_symphony import __version__
from sb3_symphony.common.checks import check_number

# ----------------------------------------------------------------------------------------------------------------------
# Files
# ----------------------------------------------------------------------------------------------------------------------


class DamagedCheckpoint(Exception):
    """A file of a checkpoint is missing, cut or changed."""


def _synchronise_folder(folder: Path) -> None:
    if os.name == "posix":  # elsewhere a folder cannot be opened
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def write_atomically(path: Path, content: bytes) -> None:
    """
    Write a file that is there completely or not at all, whenever the process or the machine stops.

    :param path: the file
    :param content: its content
    :raises OSError: if it cannot be written; a file that was there before stays as it was
    """
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        with open(temporary, "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
    _synchronise_folder(path.parent)


def _seal(path: Path, content: Any) -> str:
    """Write ``content`` after its checksum, which is returned."""
    buffer = io.BytesIO()
    th.save(content, buffer, pickle_protocol=pickle.HIGHEST_PROTOCOL)
    digest = hashlib.sha256(buffer.getbuffer())
    write_atomically(path, digest.digest() + buffer.getvalue())
    return digest.hexdigest()


def _checked_content(path: Path, expected: str | None = None) -> memoryview:
    """The sealed bytes of a file, if they have their checksum (and that is the expected one)."""
    try:
        content = path.read_bytes()
    except OSError as error:
        raise DamagedCheckpoint(f"{path.name}: {error.strerror}") from None
    sealed, digest = memoryview(content)[32:], content[:32]
    if hashlib.sha256(sealed).digest() != digest or expected not in (None, digest.hex()):
        raise DamagedCheckpoint(f"{path.name}: cut or changed")
    return sealed


def _unseal(path: Path, expected: str | None = None) -> Any:
    sealed = _checked_content(path, expected)
    try:
        return th.load(io.BytesIO(sealed), map_location="cpu", weights_only=False)
    except Exception as error:  # whole, but written by other versions: whatever unpickling raises
        raise DamagedCheckpoint(f"{path.name}: cannot be read here — {error}") from error


# ----------------------------------------------------------------------------------------------------------------------
# Replay buffer
# ----------------------------------------------------------------------------------------------------------------------

_STORAGE = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")


class Segment(NamedTuple):
    """Transitions ``start`` to ``stop`` (rows, counted from the run's first one) in a file of known checksum."""

    start: int
    stop: int
    file: str
    checksum: str


def _storage(buffer: ReplayBuffer) -> Iterator[tuple[str, np.ndarray]]:
    """Arrays ``(rows, n_envs, ...)`` in which a row is written once, until the ring comes round."""
    for name in _STORAGE:
        value = getattr(buffer, name, None)
        if isinstance(value, dict):
            yield from ((f"{name}.{key}", array) for key, array in value.items())
        elif value is not None:
            yield name, value


class ReplaySegments:
    """
    A replay buffer on disk, to which each call of :meth:`save` adds what is new.

    So that frequent checkpoints do not leave thousands of files, a new segment repeats what is in the one before as long as
    it is still small.

    :param folder: where the segments are kept
    :param segments: those that are there already
    """

    small = 2**20  # bytes

    def __init__(self, folder: Path, segments: Sequence[Segment] = ()) -> None:
        self.folder = folder
        self.segments = list(segments)
        self.saved = segments[-1].stop if segments else 0  # rows

    def save(self, buffer: ReplayBuffer, rows: int) -> list[Segment]:
        """
        Write the rows that are not on disk yet.

        :param buffer: replay buffer
        :param rows: rows added to it since the run began
        :return: segments that together hold the whole buffer
        :raises ValueError: if it held others already when the run began
        """
        if (buffer.pos, buffer.full) != (rows % buffer.buffer_size, rows >= buffer.buffer_size):
            raise ValueError(f"replay buffer: holds {buffer.size()} rows after {rows} — expected one that was empty at step 0")
        first = max(rows - buffer.buffer_size, 0)  # the oldest row still there
        start = max(self.saved, first)
        if start < rows:
            row_bytes = sum(array[0].nbytes for _, array in _storage(buffer))
            before = self.segments
            while before and (rows - before[-1].start) * row_bytes <= self.small:
                start, before = max(before[-1].start, first), before[:-1]
            places = np.arange(start, rows) % buffer.buffer_size
            path = self.folder / f"replay_{start:09d}_{rows:09d}.segment"
            checksum = _seal(path, {name: array[places] for name, array in _storage(buffer)})
            self.segments = [*before, Segment(start, rows, path.name, checksum)]
            self.saved = rows
        self.segments = [segment for segment in self.segments if segment.stop > first]
        return list(self.segments)

    def load(self, buffer: ReplayBuffer) -> None:
        """
        Fill the arrays of an empty buffer.

        :param buffer: replay buffer of the same sizes
        :raises DamagedCheckpoint: if a segment is damaged
        """
        for segment in self.segments:  # in the order of time: later rows overwrite those that they replaced
            content = _unseal(self.folder / segment.file, segment.checksum)
            places = np.arange(segment.start, segment.stop) % buffer.buffer_size
            for name, array in _storage(buffer):
                array[places] = content[name]

    def transitions(self) -> Iterator[dict[str, np.ndarray]]:
        """
        Read all transitions in the order of time, whatever buffer they are for.

        :return: arrays ``(rows, n_envs, ...)`` by name, segment by segment
        :raises DamagedCheckpoint: if a segment is damaged
        """
        for segment, following in zip(self.segments, [*self.segments[1:], None], strict=True):
            stop = segment.stop if following is None else min(segment.stop, following.start)
            content = _unseal(self.folder / segment.file, segment.checksum)
            yield {name: array[: stop - segment.start] for name, array in content.items()}

    @staticmethod
    def of(buffer: ReplayBuffer) -> dict[str, np.ndarray]:
        """
        :param buffer: replay buffer
        :return: its transitions in the order of time, as :meth:`transitions` gives them
        """
        order = (np.arange(buffer.size()) + (buffer.pos if buffer.full else 0)) % buffer.buffer_size
        return {name: array[order] for name, array in _storage(buffer)}


def add_transitions(buffer: ReplayBuffer, parts: Iterable[dict[str, np.ndarray]]) -> int:
    """
    Fill an empty replay buffer with transitions of another one, of any size; the latest ones if it is smaller.

    :param buffer: the empty buffer
    :param parts: transitions in the order of time, from :meth:`ReplaySegments.transitions`
    :return: number of rows added
    :raises ValueError: if they do not fit the buffer
    :raises DamagedCheckpoint: if they cannot be read
    """
    if isinstance(buffer, HerReplayBuffer) or buffer.optimize_memory_usage:
        raise ValueError("a buffer with HER or optimize_memory_usage cannot be filled with transitions of another one")
    wanted = {name: array.shape[1:] for name, array in _storage(buffer)}
    collected: dict[str, list[np.ndarray]] = {name: [] for name in wanted}
    for part in parts:
        found = {name: array.shape[1:] for name, array in part.items()}
        for name in wanted:
            if found.get(name) != wanted[name]:
                raise ValueError(f"{name} of shape {found.get(name)} (n_envs first), expected {wanted[name]}")
            collected[name].append(part[name])
    if not collected["rewards"]:
        return 0
    rows = {name: np.concatenate(arrays)[-buffer.buffer_size :] for name, arrays in collected.items()}

    def observation(name: str, row: int) -> Any:
        if name in rows:
            return rows[name][row]
        return {key.partition(".")[2]: array[row] for key, array in rows.items() if key.startswith(f"{name}.")}

    count = len(rows["rewards"])
    for row in range(count):
        buffer.add(
            observation("observations", row),
            observation("next_observations", row),
            rows["actions"][row],
            rows["rewards"][row],
            rows["dones"][row],
            [{"TimeLimit.truncated": bool(cut)} for cut in rows["timeouts"][row]],
        )
    _end_trajectory(buffer, ReplaySegments(Path()))
    return count


_NOT_BUFFER_STATE = {*_STORAGE, "env", "device", "observation_space", "action_space"}


def _buffer_state(buffer: ReplayBuffer) -> dict[str, Any]:
    """What a buffer knows beside its transitions: position, priorities, starts and ends of episodes."""
    state = {}
    for name, value in vars(buffer).items():
        if name in _NOT_BUFFER_STATE or (name == "infos" and not getattr(buffer, "copy_info_dict", True)):
            continue
        per_row = isinstance(value, np.ndarray) and value.shape[:1] == (buffer.buffer_size,)
        state[name] = value[: buffer.size()] if per_row else value
    # With optimize_memory_usage the latest next observation is already in the row that is written next
    return {"attributes": state, "next row": {name: array[buffer.pos] for name, array in _storage(buffer)}}


def _restore_buffer(buffer: ReplayBuffer, state: dict[str, Any], segments: ReplaySegments) -> None:
    segments.load(buffer)
    for name, value in state["attributes"].items():
        current = getattr(buffer, name, None)
        if isinstance(current, np.ndarray) and current.shape[:1] == (buffer.buffer_size,):
            current[: len(value)] = value
        else:
            setattr(buffer, name, value)
    for name, array in _storage(buffer):
        array[buffer.pos] = state["next row"][name]


def _end_trajectory(buffer: ReplayBuffer, segments: ReplaySegments) -> None:
    """Mark that the latest transition is not followed by the next one to come: the environments start anew."""
    last = (buffer.pos - 1) % buffer.buffer_size
    if isinstance(buffer, HerReplayBuffer):
        buffer.truncate_last_trajectory()
    elif isinstance(buffer, NStepReplayBuffer) or buffer.optimize_memory_usage:
        # Others need no mark: they bootstrap from the next observation that they stored
        buffer.dones[last] = True
        buffer.timeouts[last] = buffer.handle_timeout_termination
    segments.saved = max(segments.saved - 1, 0)  # that row is to be written again


# ----------------------------------------------------------------------------------------------------------------------
# Environments
# ----------------------------------------------------------------------------------------------------------------------

_NOT_WRAPPER_STATE = {"env", "_action_space", "_observation_space", "_metadata", "_cached_spec", "_saved_kwargs", "spec"}
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

    :param env: environment
    """

    def __init__(self, env: gym.Env) -> None:
        super().__init__(env)
        self.start: dict[str, Any] = {}
        self.actions: list[Any] = []
        self.observation: Any = None

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """
        :param seed: seed of the episode, or None to go on with the environment's generator
        :param options: handed to the environment
        :return: first observation and info
        """
        generators = self._generator_states()
        if seed is not None:
            generators.pop("env._np_random", None)  # which is about to be replaced
        self.start = {"generators": generators, "seed": seed, "options": options, "wrappers": self._wrappers()}
        self.actions = []
        self.observation, info = self.env.reset(seed=seed, options=options)
        self.start["observation"] = deepcopy(self.observation)  # some environments write the next one into it
        return self.observation, info

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """
        :param action: action of the environment
        :return: observation, reward, terminated, truncated, info
        """
        self.actions.append(np.array(action))
        result = self.env.step(action)
        self.observation = result[0]
        return result

    def recorded_state(self) -> dict[str, Any]:
        """:return: what :meth:`replay` and :meth:`start_anew` need"""
        return {
            "start": self.start,
            "actions": np.array(self.actions),
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
            self.reset(seed=start["seed"], options=start["options"])
            first = start.get("observation", self.observation)  # files of earlier versions have none
            if not _same_bits(self.observation, first):
                return False
            for action, reward in zip(state["actions"], rewards, strict=True):
                _, _, terminated, truncated, _ = self.step(action)
                if terminated or truncated or self.monitor.rewards[-1] != reward:
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

    @property
    def monitor(self) -> Monitor:
        """The ``Monitor`` inside."""
        monitor = unwrap_wrapper(self.env, Monitor)
        assert isinstance(monitor, Monitor)
        return monitor

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
            {name: pickled for name, value in vars(wrapper).items() if (pickled := _pickled(name, value)) is not None}
            for wrapper in self._inner_wrappers()
        ]

    def _set_wrappers(self, states: list[dict[str, bytes]]) -> None:
        for wrapper, state in zip(self._inner_wrappers(), states, strict=True):
            for name, value in state.items():
                setattr(wrapper, name, pickle.loads(value))


def _pickled(name: str, value: Any) -> bytes | None:
    if name in _NOT_WRAPPER_STATE or callable(value) or isinstance(value, gym.Env | gym.Space):
        return None
    try:
        return pickle.dumps(value)
    except (pickle.PicklingError, TypeError, AttributeError):
        return None  # windows, files and the like are no state


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


def _is_recorded(env: VecEnv) -> bool:
    return all(env.env_is_wrapped(RecordedEpisode))


def _each(env: VecEnv, method: str, states: Sequence[dict[str, Any]]) -> list[Any]:
    """Call a method of each :class:`RecordedEpisode`, which may be in another process, with its own state."""
    return [env.env_method(method, state, indices=[index])[0] for index, state in enumerate(states)]


# What wrappers of vectorised environments know: VecNormalize (its own pickle drops the returns) and VecFrameStack
_VEC_ENV_STATE = ("obs_rms", "ret_rms", "returns", "old_obs", "old_reward", "stacked_obs")


def _vec_wrappers(env: VecEnv) -> Iterator[VecEnvWrapper]:
    while isinstance(env, VecEnvWrapper):
        yield env
        env = env.venv


def _vec_env_state(env: VecEnv) -> list[dict[str, Any]]:
    return [{name: vars(w)[name] for name in _VEC_ENV_STATE if name in vars(w)} for w in _vec_wrappers(env)]


def _restore_vec_env(env: VecEnv, states: list[dict[str, Any]]) -> None:
    for wrapper, state in zip(_vec_wrappers(env), states, strict=True):
        vars(wrapper).update(state)


# ----------------------------------------------------------------------------------------------------------------------
# Everything else
# ----------------------------------------------------------------------------------------------------------------------

_PLAIN = (bool, int, float, str, np.generic, np.ndarray, type(None))
# Belongs to the process, or is derived from what the run is asked for
_NOT_STATE = {"start_time", "_total_timesteps", "_num_timesteps_at_start", "locals", "globals"}


def _is_plain(value: Any) -> bool:
    if isinstance(value, dict):
        return all(map(_is_plain, value)) and all(map(_is_plain, value.values()))
    if isinstance(value, list | tuple | deque):
        return all(map(_is_plain, value))
    return isinstance(value, _PLAIN)


def _attributes(instance: Any) -> dict[str, Any]:
    """
    What an algorithm or a callback counts and collects: attributes of plain values that are no arguments of its
    constructor, since these are settings. Networks, schedules and the like are none of them.
    """
    settings = {name for base in type(instance).__mro__ for name in inspect.signature(base).parameters if base is not object}
    return {k: v for k, v in vars(instance).items() if k not in settings and k not in _NOT_STATE and _is_plain(v)}


def _gsde_distributions(model: BaseAlgorithm) -> list[StateDependentNoiseDistribution]:
    owners = (model.policy, getattr(model.policy, "actor", None))
    distributions = [getattr(owner, "action_dist", None) for owner in owners]
    return [each for each in distributions if isinstance(each, StateDependentNoiseDistribution)]


def _generators(model: BaseAlgorithm) -> dict[str, Any]:
    return {
        "python": random.getstate(),
        "numpy": np.random.get_state(),
        "torch": th.get_rng_state(),
        "cuda": th.cuda.get_rng_state_all() if th.cuda.is_initialized() else [],
        "action space": model.action_space.np_random.bit_generator.state,
    }


def _restore_generators(model: BaseAlgorithm, states: dict[str, Any]) -> None:
    random.setstate(states["python"])
    np.random.set_state(states["numpy"])
    th.set_rng_state(states["torch"])
    if states["cuda"] and th.cuda.is_available():
        th.cuda.set_rng_state_all(states["cuda"])
    model.action_space.np_random.bit_generator.state = states["action space"]


def platform_of(model: BaseAlgorithm) -> dict[str, str]:
    """
    :param model: an algorithm
    :return: what has to be the same for results to be equal bit for bit
    """
    packages = ("torch", "numpy", "numba", "stable_baselines3", "sb3_contrib", "gymnasium")
    return {
        "sb3_symphony": __version__,
        **{package: version(package) for package in packages},
        "Python": platform.python_version(),
        "processor": f"{platform.machine()} {th.backends.cpu.get_cpu_capability()}",
        "threads": str(th.get_num_threads()),
        "device": model.device.type,
    }


def training_state(model: BaseAlgorithm) -> dict[str, Any]:
    """
    Everything but the replay buffer and the environments' episodes.

    :param model: an algorithm at the start of a rollout
    :return: its state, for :func:`restore_training_state`
    """
    assert model.env is not None
    state_dicts, tensors = model._get_torch_save_params()
    dropped = {*model._excluded_save_params(), *(name.split(".")[0] for name in (*state_dicts, *tensors))}
    logger = model.logger
    noise = getattr(model, "action_noise", None)
    return {
        "platform": platform_of(model),
        "attributes": {name: value for name, value in _attributes(model).items() if name not in dropped},
        "parameters": model.get_parameters(),
        "tensors": {name: recursive_getattr(model, name) for name in tensors},
        "gSDE": [(each.exploration_mat.detach(), each.exploration_matrices.detach()) for each in _gsde_distributions(model)],
        "noise": None if noise is None else vars(noise),
        # Values recorded but not written yet
        "log": {name: dict(vars(logger)[name]) for name in ("name_to_value", "name_to_count", "name_to_excluded")},
        "vec env": _vec_env_state(model.env),
        "generators": _generators(model),
        "elapsed": time.time_ns() - model.start_time,
    }


def restore_training_state(model: BaseAlgorithm, state: dict[str, Any]) -> None:
    """
    Give a model built with the same arguments the state of another one, in place.

    :param model: an algorithm inside ``learn()``
    :param state: from :func:`training_state`
    """
    assert model.env is not None
    vars(model).update(state["attributes"])
    model.set_parameters(state["parameters"], exact_match=True, device=model.device)
    for name, value in state["tensors"].items():
        recursive_getattr(model, name).data.copy_(value)
    for distribution, (matrix, matrices) in zip(_gsde_distributions(model), state["gSDE"], strict=True):
        distribution.exploration_mat = matrix.to(model.device)
        distribution.exploration_matrices = matrices.to(model.device)
    if state["noise"] is not None:
        vars(model.action_noise).update(state["noise"])  # type: ignore[attr-defined]  # in place: learn() holds it already
    for name, values in state["log"].items():
        vars(model.logger)[name].update(values)
    _restore_vec_env(model.env, state["vec env"])
    _restore_generators(model, state["generators"])
    model.start_time = time.time_ns() - state["elapsed"]


# ----------------------------------------------------------------------------------------------------------------------
# The folder and the callback
# ----------------------------------------------------------------------------------------------------------------------


@dataclass
class Checkpoint:
    """
    A checkpoint whose files are all whole.

    :param steps: environment steps taken
    :param state: its content
    :param damaged: what was wrong with newer ones, one line for each
    """

    steps: int
    state: dict[str, Any]
    damaged: list[str]


def checkpoint_files(folder: Path) -> dict[int, Path]:
    """
    :param folder: folder of checkpoints
    :return: environment steps and files of its checkpoints, damaged ones included
    """
    found = ((re.fullmatch(r"checkpoint_(\d+)\.ckpt", path.name), path) for path in folder.glob("checkpoint_*.ckpt"))
    return {int(match[1]): path for match, path in found if match}


def newest_checkpoint(folder: Path) -> Checkpoint | None:
    """
    Find the newest checkpoint whose files are whole. Nothing is changed.

    :param folder: folder of checkpoints
    :return: the checkpoint, or None if there was never one
    :raises DamagedCheckpoint: if there are checkpoints, but none is whole
    """
    damaged: list[str] = []
    for steps, path in sorted(checkpoint_files(folder).items(), reverse=True):
        try:
            state = _unseal(path)
            for segment in state["segments"]:
                _checked_content(folder / segment.file, segment.checksum)
            return Checkpoint(steps, state, damaged)
        except DamagedCheckpoint as error:
            damaged.append(str(error))
    if damaged:
        raise DamagedCheckpoint("; ".join(damaged))
    return None


class ExactCheckpoints(BaseCallback):
    """
    Saves checkpoints while training, and begins by restoring one.

    :param folder: where checkpoints are kept; made if need be
    :param save_freq: environment steps between checkpoints, >= 1. One is made at the first rollout that starts at or after
        each multiple
    :param keep: number of checkpoints to keep, >= 1; with 1 there is none to go back to if the newest is damaged
    :param callbacks: callbacks whose counts and collected values belong to the state
    :param files: gives the files (such as ``0.monitor.csv``) whose content belongs to the state
    :param beside: gives files that have to be on the disk before a checkpoint is, such as a best model that is not to be
        made again
    :param checkpoint: where to go on from; ``learn()`` is then called as for the whole run, with the total number of steps
    :param wanted: asked at the start of each rollout whether a checkpoint is wanted there, for example before stopping
    :param report: what to do with a message
    """

    def __init__(
        self,
        folder: Path,
        save_freq: int,
        keep: int = 2,
        callbacks: Sequence[BaseCallback] = (),
        files: Callable[[], Sequence[Path]] = tuple,
        beside: Callable[[], Sequence[Path]] = tuple,
        checkpoint: Checkpoint | None = None,
        wanted: Callable[[], bool] = bool,
        report: Callable[[str], None] = print,
    ) -> None:
        super().__init__()
        check_number("save_freq", save_freq, 1, integer=True)
        check_number("keep", keep, 1, integer=True)
        self.folder = folder
        self.save_freq = save_freq
        self.keep = keep
        self.callbacks = callbacks
        self.files = files
        self.beside = beside
        self.wanted = wanted
        self.report = report
        self.finished = False  # whether learn() came to its end, with everything learned that was experienced
        self._rollout_ended = False
        self._latest = 0 if checkpoint is None else checkpoint.steps
        # Of another agent, which the run began with
        self._rows_before = 0 if checkpoint is None else checkpoint.state.get("rows before", 0)
        self.segments = ReplaySegments(folder, [] if checkpoint is None else checkpoint.state["segments"])
        self._segments_of: dict[int, set[str]] = {}  # steps of a checkpoint -> files that it needs
        self._restoring = checkpoint

    @property
    def restored(self) -> bool:
        """Whether the model has the state it is to have: not before the first rollout of a resumed run."""
        return self._restoring is None

    def _init_callback(self) -> None:
        if self._restoring is None and self._buffer is not None:
            self._rows_before = self._buffer.size()

    def _on_rollout_start(self) -> None:
        if self._restoring is not None:
            self._restore(self._restoring)
            self._restoring = None
        elif self.wanted() or self.model.num_timesteps // self.save_freq > self._latest // self.save_freq:
            self.save()
        self._rollout_ended = False

    def _on_rollout_end(self) -> None:
        self._rollout_ended = True

    def _on_training_end(self) -> None:
        self.finished = self._rollout_ended

    def _on_step(self) -> bool:
        return True

    @property
    def _buffer(self) -> ReplayBuffer | None:
        return getattr(self.model, "replay_buffer", None)

    def save(self, rollout_follows: bool = True) -> bool:
        """
        Write a checkpoint. If that fails, for example because the disk is full, older ones are left as they are.

        :param rollout_follows: False after training, when the start of a next rollout is still to come
        :return: whether it was written
        """
        model, steps = self.model, self.model.num_timesteps
        self._latest = steps  # also if it fails: not to be tried again at once
        assert model.env is not None
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            state = training_state(model)
            state["rollout follows"] = rollout_follows
            log_folder = model.logger.get_dir()
            state["log folder"] = None if log_folder is None else os.path.abspath(log_folder)
            state["callbacks"] = {type(callback).__name__: _attributes(callback) for callback in self.callbacks}
            state["files"] = {path.name: path.read_bytes() for path in self.files()}
            state["episodes"] = model.env.env_method("recorded_state") if _is_recorded(model.env) else []
            state["segments"] = []
            if self._buffer is not None:
                state["buffer"] = _buffer_state(self._buffer)
                state["segments"] = self.segments.save(self._buffer, self._rows_before + steps // model.n_envs)
                state["rows before"] = self._rows_before
            for path in self.beside():
                with open(path, "r+b") as file:
                    os.fsync(file.fileno())
            _seal(self.folder / f"checkpoint_{steps:09d}.ckpt", state)
        except OSError as error:
            self.report(f"no checkpoint at {steps} steps: {error.strerror} — training goes on, older ones are unharmed")
            return False
        self._segments_of[steps] = {segment.file for segment in state["segments"]}
        self._tidy(steps)
        return True

    def _tidy(self, newest: int) -> None:
        """Delete checkpoints beyond ``keep``, those of a future that was given up, and what belongs to none."""
        files = checkpoint_files(self.folder)
        kept = sorted(steps for steps in files if steps <= newest)[-self.keep :]
        for steps in kept:
            if steps not in self._segments_of:  # from before a resume
                try:
                    self._segments_of[steps] = {segment.file for segment in _unseal(files[steps])["segments"]}
                except DamagedCheckpoint:
                    self._segments_of[steps] = set()
        needed = {file for steps in kept for file in self._segments_of[steps]}
        unneeded = [files[steps] for steps in files.keys() - set(kept)]
        unneeded += [path for path in self.folder.glob("replay_*.segment") if path.name not in needed]
        for path in [*unneeded, *self.folder.glob(".*.tmp")]:
            with suppress(OSError):  # to be tried again next time
                path.unlink()

    def _restore(self, checkpoint: Checkpoint) -> None:
        model, state = self.model, checkpoint.state
        assert model.env is not None
        episodes = state["episodes"] if _is_recorded(model.env) else []
        exact = len(episodes) == model.n_envs and all(_each(model.env, "replay", episodes))
        if self._buffer is not None:
            _restore_buffer(self._buffer, state["buffer"], self.segments)
        for callback in self.callbacks:
            vars(callback).update(state["callbacks"].get(type(callback).__name__, {}))
        restore_training_state(model, state)

        if not exact:
            _each(model.env, "start_anew", episodes)
            self._start_anew()
            why = "replaying the actions did not reproduce the episode" if episodes else "the episodes were not recorded"
            self.report(f"resumed at {checkpoint.steps} steps with fresh episodes, hence not bit for bit: {why}")
        if not state["rollout follows"] and getattr(model, "use_sde", False):
            owner: Any = getattr(model, "actor", model.policy)
            owner.reset_noise(model.n_envs)

    def _start_anew(self) -> None:
        model: Any = self.model
        model._last_obs = model.env.reset()
        model._last_episode_starts = np.ones((model.n_envs,), dtype=bool)
        if model.get_vec_normalize_env() is not None:
            model._last_original_obs = model.get_vec_normalize_env().get_original_obs()
        if getattr(model, "action_noise", None) is not None:
            model.action_noise.reset()
        if self._buffer is not None and self._buffer.size() > 0:
            _end_trajectory(self._buffer, self.segments)
