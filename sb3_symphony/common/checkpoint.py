"""
Checkpoints from which training goes on as if it had never stopped: bit for bit, on the same machine and versions.

A checkpoint is made at the start of a rollout, where networks, replay and latest observation belong together (SB3's
``on_step`` comes before the transition is stored). It is one file, beside the segments of the replay buffer
(``replay_files.py``): each segment holds the transitions that were new at one checkpoint and is never changed, so a
checkpoint costs what is new. Every file is written under another name, synchronised and renamed, and starts with the
checksum of its content; a checkpoint also names the checksums of its segments. Whatever is cut or missing is recognised,
and the checkpoint before is used. Environments are made again (``recording.py``).

A checkpoint holds pickled objects: resume only runs of people you trust.
"""

import inspect
import os
import pickle
import re
import time
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.distributions import StateDependentNoiseDistribution
from stable_baselines3.common.save_util import recursive_getattr

from sb3_symphony.common.buffers import end_trajectory
from sb3_symphony.common.checks import check_number, last_line
from sb3_symphony.common.files import DamagedFile, checked_content, seal, unseal
from sb3_symphony.common.generators import generator_states, restore_generators
from sb3_symphony.common.recording import each_copy, is_recorded, restore_vec_env, vec_env_state
from sb3_symphony.common.replay_files import ReplaySegments, Segment, buffer_state, check_buffer, restore_buffer
from sb3_symphony.common.versions import package_versions, processor

# ----------------------------------------------------------------------------------------------------------------------
# State
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


def _attributes(instance: Any, arguments: bool = False) -> dict[str, Any]:
    """
    What an algorithm or a callback counts and collects: attributes of plain values that are no arguments of its
    constructor, since these are settings. Networks, schedules and the like are none of them.

    :param arguments: the settings instead, as they are now
    """
    settings = {name for base in type(instance).__mro__ for name in inspect.signature(base).parameters if base is not object}
    found = {name: value for name, value in vars(instance).items() if (name in settings) == arguments and _is_plain(value)}
    return {name: value for name, value in found.items() if name not in _NOT_STATE}


def _gsde_distributions(model: BaseAlgorithm) -> list[StateDependentNoiseDistribution]:
    owners = (model.policy, getattr(model.policy, "actor", None))
    distributions = [getattr(owner, "action_dist", None) for owner in owners]
    return [each for each in distributions if isinstance(each, StateDependentNoiseDistribution)]


def _generators(model: BaseAlgorithm) -> dict[str, Any]:
    return {**generator_states(), "action space": model.action_space.np_random.bit_generator.state}


def _restore_generators(model: BaseAlgorithm, states: dict[str, Any]) -> None:
    restore_generators(states)
    model.action_space.np_random.bit_generator.state = states["action space"]


def platform_of(model: BaseAlgorithm) -> dict[str, str]:
    """
    :param model: an algorithm
    :return: what has to be the same for results to be equal bit for bit
    """
    return {
        **package_versions(),
        "processor": processor(),
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
        "vec env": vec_env_state(model.env),
        "generators": _generators(model),
        "elapsed": time.time_ns() - model.start_time,
    }


def _noise_attributes(attributes: dict[str, Any]) -> set[str]:
    """Names of the attributes of a noise, of those for several environments, which ``learn()`` makes of one, of that one."""
    return set(vars(attributes["_base_noise"]) if "_base_noise" in attributes else attributes)


def _check_surroundings(model: BaseAlgorithm, state: dict[str, Any]) -> None:
    """Look whether noise and wrappers are those of a state."""
    assert model.env is not None
    noise = getattr(model, "action_noise", None)
    if _noise_attributes(state["noise"] or {}) != _noise_attributes({} if noise is None else vars(noise)):
        raise ValueError(f"action_noise: the checkpoint is of another one than {noise}")
    there, own = len(state["vec env"]), len(vec_env_state(model.env))
    if there != own:
        raise ValueError(f"wrappers around all copies of the environment (normalize, frame_stack): {there} there, {own} here")
    episodes = model.env.env_method("recorded_state") if is_recorded(model.env) else []
    for kept, episode in zip(state.get("episodes", []), episodes, strict=False):
        there, own = len(kept["wrappers"]), len(episode["wrappers"])
        if there != own:
            raise ValueError(f"wrappers around each environment (env_wrapper): {there} there, {own} here")


def restore_training_state(model: BaseAlgorithm, state: dict[str, Any]) -> None:
    """
    Give a model built with the same arguments the state of another one, in place.

    :param model: an algorithm inside ``learn()``
    :param state: from :func:`training_state`
    :raises ValueError: if it is of another model, as far as that is seen; what is not may raise any error
    """
    assert model.env is not None
    vars(model).update(state["attributes"])
    model.set_parameters(state["parameters"], exact_match=True, device=model.device)
    for name, value in state["tensors"].items():
        recursive_getattr(model, name).data.copy_(value)
    for distribution, (matrix, matrices) in zip(_gsde_distributions(model), state["gSDE"], strict=True):
        distribution.exploration_mat = matrix.to(model.device)
        distribution.exploration_matrices = matrices.to(model.device)
    if (noise := getattr(model, "action_noise", None)) is not None:
        vars(noise).update(state["noise"])  # in place: learn() holds it already
    for name, values in state["log"].items():
        vars(model.logger)[name].update(values)
    restore_vec_env(model.env, state["vec env"])
    _restore_generators(model, state["generators"])
    model.start_time = time.time_ns() - state["elapsed"]


# ----------------------------------------------------------------------------------------------------------------------
# Files, and the callback that writes them
# ----------------------------------------------------------------------------------------------------------------------


class DoesNotFit(ValueError):
    """A checkpoint is of another model than the one that is to go on from it."""


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


def newest_checkpoint(folder: str | Path) -> Checkpoint | None:
    """
    Find the newest checkpoint whose files are whole. Nothing is changed.

    :param folder: folder of checkpoints
    :return: the checkpoint, or None if there was never one
    :raises DamagedFile: if there are checkpoints, but none is whole
    """
    folder, damaged = Path(folder), list[str]()
    for steps, path in sorted(checkpoint_files(folder).items(), reverse=True):
        try:
            state = unseal(path)
            segments: list[Segment] = state["segments"]
            for segment in segments:
                checked_content(folder / segment.file, segment.checksum)
            return Checkpoint(steps, state, damaged)
        except DamagedFile as error:
            damaged.append(str(error))
    if damaged:
        raise DamagedFile("; ".join(damaged))
    return None


@contextmanager
def _fitting(checkpoint: Checkpoint) -> Iterator[None]:
    """Inside the block a model takes up what a checkpoint holds."""
    try:
        yield
    except (RuntimeError, ValueError, TypeError, AttributeError, LookupError) as error:  # PyTorch's, NumPy's
        raise DoesNotFit(f"the checkpoint at {checkpoint.steps} steps is of another model — {last_line(error)}") from error


def check_fit(model: BaseAlgorithm, checkpoint: Checkpoint) -> None:
    """
    Look whether a model's networks, whose values they take, its replay buffer, noise and wrappers are those of a checkpoint.

    :param model: an algorithm that is to go on from it, before its ``learn()``
    :param checkpoint: the checkpoint
    :raises DoesNotFit: if they are not
    """
    with _fitting(checkpoint):
        model.set_parameters(checkpoint.state["parameters"], exact_match=True, device=model.device)
        if (buffer := getattr(model, "replay_buffer", None)) is not None:
            check_buffer(buffer, checkpoint.state["buffer"])
        _check_surroundings(model, checkpoint.state)


class ExactCheckpoints(BaseCallback):
    """
    Saves checkpoints while training, and begins by restoring one.

    :param folder: where checkpoints are kept; made if need be
    :param save_freq: environment steps between checkpoints, >= 1. One is made at the first rollout that starts at or after
        each multiple
    :param keep: number of checkpoints to keep, >= 1; with 1 there is none to go back to if the newest is damaged
    :param callbacks: callbacks whose counts and collected values belong to the state
    :param files: gives the files (such as ``0.monitor.csv``) whose content belongs to the state
    :param checkpoint: where to go on from; ``learn()`` is then called as for the whole run, with the total number of steps
    :param wanted: asked at the start of each rollout whether a checkpoint is wanted there, for example before stopping
    """

    def __init__(
        self,
        folder: str | Path,
        save_freq: int,
        keep: int = 2,
        callbacks: Sequence[BaseCallback] = (),
        files: Callable[[], Sequence[Path]] = tuple,
        checkpoint: Checkpoint | None = None,
        wanted: Callable[[], bool] = bool,
    ) -> None:
        super().__init__()
        check_number("save_freq", save_freq, 1, integer=True)
        check_number("keep", keep, 1, integer=True)
        self.folder = Path(folder)
        self.save_freq = save_freq
        self.keep = keep
        self.callbacks = callbacks
        self.files = files
        self.wanted = wanted
        self.finished = False  # whether learn() came to its end, with everything learned that was experienced
        self._rollout_ended = False
        self._latest = 0 if checkpoint is None else checkpoint.steps
        # Rows of the buffer beyond those of the counted steps: of another agent, or of an earlier training
        self._rows_before = 0 if checkpoint is None else checkpoint.state.get("rows before", 0)
        self.segments = ReplaySegments(self.folder, [] if checkpoint is None else checkpoint.state["segments"])
        self._segments_of: dict[int, set[str]] = {}  # steps of a checkpoint -> files that it needs
        self._restoring = checkpoint
        self._arguments: dict[str, bytes] = {}  # of the algorithm, as it was built

    @property
    def restored(self) -> bool:
        """Whether the model has the state it is to have: not before the first rollout of a resumed run."""
        return self._restoring is None

    def _init_callback(self) -> None:
        arguments = _attributes(self.model, arguments=True).items()
        self._arguments = self._arguments or {name: pickle.dumps(value) for name, value in arguments}
        if self._restoring is not None:
            return
        self._latest = min(self._latest, self.model.num_timesteps)  # whose count may have restarted
        if (buffer := self._buffer) is not None:  # that of an earlier training may have rows; others may have been loaded
            rows = buffer.pos + buffer.buffer_size * buffer.full
            self._rows_before = rows - self.model.num_timesteps // self.model.n_envs
            self.segments.forget()

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

        :param rollout_follows: False after training, when the start of a next rollout is still to come; then only if
            training has come to the end of one (``finished``), not if a callback has stopped it before
        :return: whether it was written
        """
        model, steps = self.model, self.model.num_timesteps
        self._latest = steps  # also if it fails: not to be tried again at once
        assert model.env is not None
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            state = training_state(model)
            # A resumed run is built with the same arguments, so only what a callback has made of them is to be kept
            arguments = _attributes(model, arguments=True).items()
            state["arguments"] = {k: value for k, value in arguments if pickle.dumps(value) != self._arguments.get(k)}
            state["rollout follows"] = rollout_follows
            state["folder"] = os.path.abspath(self.folder)
            log_folder = model.logger.get_dir()
            state["log folder"] = None if log_folder is None else os.path.abspath(log_folder)
            state["callbacks"] = {key: _attributes(callback) for key, callback in self._named_callbacks()}
            state["files"] = {path.name: path.read_bytes() for path in self.files()}
            state["episodes"] = model.env.env_method("recorded_state") if is_recorded(model.env) else []
            state["segments"] = []
            if self._buffer is not None:
                state["buffer"] = buffer_state(self._buffer)
                state["segments"] = self.segments.save(self._buffer, self._rows_before + steps // model.n_envs)
                state["rows before"] = self._rows_before
            seal(self.folder / f"checkpoint_{steps:09d}.ckpt", state)
        except OSError as error:
            print(f"no checkpoint at {steps} steps: {error.strerror} — training goes on, older ones are unharmed")
            return False
        self._segments_of[steps] = {segment.file for segment in state["segments"]}
        self._tidy(steps)
        return True

    def _named_callbacks(self) -> Iterator[tuple[str, BaseCallback]]:
        """Each callback with its class's name, numbered from the second one of a class on."""
        seen: Counter[str] = Counter()
        for callback in self.callbacks:
            name = type(callback).__name__
            seen[name] += 1
            yield name if seen[name] == 1 else f"{name} {seen[name]}", callback

    def _tidy(self, newest: int) -> None:
        """Delete checkpoints beyond ``keep``, those of a future that was given up, and what belongs to none."""
        files = checkpoint_files(self.folder)
        kept = sorted(steps for steps in files if steps <= newest)[-self.keep :]
        for steps in kept:
            if steps not in self._segments_of:  # from before a resume
                try:
                    self._segments_of[steps] = {segment.file for segment in unseal(files[steps])["segments"]}
                except DamagedFile:
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
        with _fitting(checkpoint):
            _check_surroundings(model, state)
        episodes = state["episodes"] if is_recorded(model.env) else []
        exact = len(episodes) == model.n_envs and all(each_copy(model.env, "replay", episodes))
        with _fitting(checkpoint):
            if self._buffer is not None:
                restore_buffer(self._buffer, state["buffer"], self.segments)
            restore_training_state(model, state)
        vars(model).update(state.get("arguments", {}))
        for key, callback in self._named_callbacks():
            vars(callback).update(state["callbacks"].get(key, {}))

        if not exact:
            each_copy(model.env, "start_anew", episodes)
            self._start_anew()
            why = "replaying the actions did not reproduce the episode" if episodes else "the episodes were not recorded"
            print(f"resumed at {checkpoint.steps} steps with fresh episodes, hence not bit for bit: {why}")
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
        if hasattr(model, "start_anew"):  # of this package; its algorithms are not imported for those of others
            model.start_anew()
        elif self._buffer is not None:
            end_trajectory(self._buffer)
        for callback in self.callbacks:
            if hasattr(callback, "start_anew"):
                callback.start_anew()
        self.segments.forget_latest()
