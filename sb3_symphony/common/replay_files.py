"""A replay buffer on disk, to which each checkpoint adds what is new, and buffers that are filled from there."""

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.her.her_replay_buffer import HerReplayBuffer

from sb3_symphony.common.buffers import STORAGE, FadingReplayBuffer, end_trajectory
from sb3_symphony.common.checks import constructor_parameters
from sb3_symphony.common.files import seal, unseal


class Segment(NamedTuple):
    """Transitions ``start`` to ``stop`` (rows, counted from the run's first one) in a file of known checksum."""

    start: int
    stop: int
    file: str
    checksum: str


def _storage(buffer: ReplayBuffer) -> Iterator[tuple[str, np.ndarray]]:
    """Its arrays with one row per step, by name."""
    for name in STORAGE:
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
            checksum = seal(path, {name: array[places] for name, array in _storage(buffer)})
            self.segments = [*before, Segment(start, rows, path.name, checksum)]
            self.saved = rows
        self.segments = [segment for segment in self.segments if segment.stop > first]
        return list(self.segments)

    def forget(self) -> None:
        """All rows have changed: they are to be written again, whatever is on disk."""
        self.segments, self.saved = [], 0

    def forget_latest(self) -> None:
        """The latest row has changed: it is to be written again."""
        self.saved = max(self.saved - 1, 0)

    def load(self, buffer: ReplayBuffer) -> None:
        """
        Fill the arrays of an empty buffer.

        :param buffer: replay buffer of the same sizes
        :raises DamagedFile: if a segment is damaged
        """
        for segment in self.segments:  # in the order of time: later rows overwrite those that they replaced
            content = unseal(self.folder / segment.file, segment.checksum)
            places = np.arange(segment.start, segment.stop) % buffer.buffer_size
            for name, array in _storage(buffer):
                array[places] = content[name]

    def transitions(self) -> Iterator[dict[str, np.ndarray]]:
        """
        Read all transitions in the order of time, whatever buffer they are for.

        :return: arrays ``(rows, n_envs, ...)`` by name, segment by segment
        :raises DamagedFile: if a segment is damaged
        """
        for segment, following in zip(self.segments, [*self.segments[1:], None], strict=True):
            stop = segment.stop if following is None else min(segment.stop, following.start)
            content = unseal(self.folder / segment.file, segment.checksum)
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
    :raises DamagedFile: if they cannot be read
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

    if isinstance(buffer, FadingReplayBuffer):
        # The first row may be from amid an episode: until one ends, nothing tells which are its first steps
        buffer.episode_steps[:] = buffer.start_steps
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
    end_trajectory(buffer)
    return count


_MAY_CHANGE = {"beta"}  # of PrioritizedReplayBuffer: arguments that callbacks set while training
_NOT_BUFFER_STATE = {*STORAGE, "env", "device", "observation_space", "action_space"}


def buffer_state(buffer: ReplayBuffer) -> dict[str, Any]:
    """
    :param buffer: replay buffer
    :return: what it knows beside its transitions: position, priorities, starts and ends of episodes
    """
    state: dict[str, Any] = {}
    for name, value in vars(buffer).items():
        if name in _NOT_BUFFER_STATE or (name == "infos" and not getattr(buffer, "copy_info_dict", True)):
            continue
        per_row = isinstance(value, np.ndarray) and value.shape[:1] == (buffer.buffer_size,)
        state[name] = value[: buffer.size()] if per_row else value
    # With optimize_memory_usage the latest next observation is already in the row that is written next
    return {"attributes": state, "next row": {name: array[buffer.pos] for name, array in _storage(buffer)}}


def check_buffer(buffer: ReplayBuffer, state: dict[str, Any]) -> None:
    """
    :param buffer: a buffer
    :param state: from :func:`buffer_state`, perhaps of another one
    :raises ValueError: if class or settings differ
    """
    if state["attributes"].keys() != buffer_state(buffer)["attributes"].keys():
        raise ValueError(f"its replay buffer is no {type(buffer).__name__}")
    for name in sorted((constructor_parameters(type(buffer)).keys() & state["attributes"].keys()) - _MAY_CHANGE):
        stored, own = state["attributes"][name], vars(buffer)[name]
        if isinstance(stored, bool | int | float | str | None) and stored != own:
            raise ValueError(f"{name} of its replay buffer is {stored!r}, not {own!r}")


def restore_buffer(buffer: ReplayBuffer, state: dict[str, Any], segments: ReplaySegments) -> None:
    """
    :param buffer: empty buffer of the same class and settings
    :param state: from :func:`buffer_state`
    :param segments: its transitions
    :raises ValueError: if class or settings are others
    :raises DamagedFile: if they cannot be read
    """
    check_buffer(buffer, state)
    segments.load(buffer)
    for name, value in state["attributes"].items():
        current = getattr(buffer, name, None)
        if isinstance(current, np.ndarray) and current.shape[:1] == (buffer.buffer_size,):
            current[: len(value)] = value
        else:
            setattr(buffer, name, value)
    for name, array in _storage(buffer):
        array[buffer.pos] = state["next row"][name]
