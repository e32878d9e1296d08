"""
Replay buffers that do not draw uniformly: fading (recent transitions more often) and prioritised (large errors more often).

All of them keep Stable-Baselines3's storage, whose arrays are ``(rows, n_envs, ...)`` with ``pos`` the next row to write,
and change only which transitions are drawn, or show their mirror images. All draws come from numpy's global generator, the
one SB3 seeds.
"""

import copy
import math
import warnings
from collections.abc import Mapping
from functools import lru_cache, partial
from typing import Any, NamedTuple

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import DictReplayBuffer, NStepReplayBuffer, ReplayBuffer
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from stable_baselines3.common.vec_env import VecNormalize
from stable_baselines3.her.her_replay_buffer import HerReplayBuffer

from sb3_symphony.common.checks import check_number
from sb3_symphony.common.mirror import Mirror

# ----------------------------------------------------------------------------------------------------------------------
# Fading: weights and exact draws
# ----------------------------------------------------------------------------------------------------------------------


def _check_fading(fade_factor: float | None, fade_power: float) -> None:
    if not _is_uniform(fade_factor):
        try:
            check_number("fade_factor", fade_factor, 0, exclusive=True)
        except (TypeError, ValueError) as error:
            raise type(error)(f"{error}, or None (or inf) for uniform sampling") from None
    check_number("fade_power", fade_power, 0, 100, exclusive=True)  # draws take as many trials


def _is_uniform(fade_factor: float | None) -> bool:
    return fade_factor is None or fade_factor == math.inf


@lru_cache(maxsize=64)
def _acceptance_rate(fade_factor: float, fade_power: float) -> float:
    """Share of draws accepted below for n → ∞: the mean of tanh(f·x^power) over [0, 1], relative to its maximum."""
    x = (np.arange(4096) + 0.5) / 4096
    return float(np.mean(np.tanh(fade_factor * x**fade_power)) / np.tanh(fade_factor))


def draw_faded_ages(size: int, n_draws: int, fade_factor: float | None, fade_power: float = 2.0) -> np.ndarray:
    """
    Draw age indices (0 = oldest) under fading replay, with replacement: exactly with p_i ∝ tanh(f·(i/n)^power), so the oldest
    transition (i = 0) never and the newest (i = n - 1) most often. If every weight vanishes (n = 1), uniformly.

    Source: Read, "Dancing like the Inbetweeners: learning to walk with Symphony" (2024), where the power is 2.

    Rejection: an index drawn uniformly is accepted with probability (its weight / the newest one's weight), so the
    cost of a draw does not depend on the number of stored transitions (1.4 trials per draw for f = 7).

    :param size: number n of stored transitions, at least 1
    :param n_draws: number of indices to draw
    :param fade_factor: steepness f > 0; ``None`` or ``inf`` means uniform
    :param fade_power: power of the normalised age index, in (0, 100]
    :return: int array ``(n_draws,)`` of values in [0, size)
    """
    if fade_factor is None or _is_uniform(fade_factor):
        return np.random.randint(0, size, size=n_draws)
    newest = np.tanh(fade_factor * ((size - 1) / size) ** fade_power)
    if newest == 0:  # all weights vanish
        return np.random.randint(0, size, size=n_draws)
    rate = _acceptance_rate(fade_factor, fade_power)
    ages = np.empty(n_draws, dtype=np.int64)
    filled = 0
    while filled < n_draws:
        # A few per cent more trials than needed on average, so that one pass mostly suffices
        trials = int(1.05 * (n_draws - filled) / rate) + 16
        candidates = np.random.randint(0, size, size=trials)
        weights = np.tanh(fade_factor * (candidates / size) ** fade_power)
        # Strictly less: weight 0 is never accepted
        accepted = candidates[np.random.random(trials) * newest < weights][: n_draws - filled]
        ages[filled : filled + len(accepted)] = accepted
        filled += len(accepted)
    return ages


# ----------------------------------------------------------------------------------------------------------------------
# Storage shared by the buffers below
# ----------------------------------------------------------------------------------------------------------------------


#: arrays ``(rows, n_envs, ...)``, or dicts of them, in which a row is written once, until the ring comes round
STORAGE = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")


def _refuse_memory_optimisation(name: str, optimize_memory_usage: bool) -> None:
    if optimize_memory_usage:
        raise ValueError(
            f"{name} does not support optimize_memory_usage=True: it stores next observations apart, because time limits "
            "must not end bootstrapping"
        )


class _StepsReplayBuffer(NStepReplayBuffer):
    """
    SB3's n-step buffer, except that one step gives exactly the samples of SB3's plain buffer (no discounts), and that samples
    may be mirrored.
    """

    def __init__(
        self, *args: Any, n_steps: int = 1, gamma: float = 0.99, mirror: Mapping[str, Any] | None = None, **kwargs: Any
    ) -> None:
        check_number("n_steps", n_steps, 1, integer=True)
        check_number("gamma", gamma, 0, 1)
        super().__init__(*args, n_steps=n_steps, gamma=float(gamma), **kwargs)  # NumPy's would be in double precision
        self.mirror = None if mirror is None else Mirror(mirror, self.observation_space, self.action_space)

    def add(
        self,
        obs: np.ndarray,
        next_obs: np.ndarray,
        action: np.ndarray,
        reward: np.ndarray,
        done: np.ndarray,
        infos: list[dict[str, Any]],
    ) -> None:
        """
        Store one transition per environment.

        :param obs: observations ``(n_envs, ...)``
        :param next_obs: next observations, the terminal ones where an episode ended
        :param action: scaled actions ``(n_envs, action_dim)``
        :param reward: rewards ``(n_envs,)``
        :param done: ends of episodes ``(n_envs,)``
        :param infos: one dictionary per environment
        """
        self._before_row(done)
        super().add(obs, next_obs, action, reward, done, infos)

    def _before_row(self, done: np.ndarray) -> None:
        """
        What a subclass notes of the row that is written next.

        :param done: ends of episodes ``(n_envs,)``
        """

    def _row_places(self) -> np.ndarray:
        """Places (row * n_envs + environment) of the row that is written next, ``(n_envs,)``."""
        return self.pos * self.n_envs + np.arange(self.n_envs)

    def _get_samples(self, batch_inds: np.ndarray, env: VecNormalize | None = None) -> ReplayBufferSamples:
        one_step = self.n_steps == 1
        get_samples = partial(ReplayBuffer._get_samples, self) if one_step else super()._get_samples
        samples = get_samples(batch_inds, env=env)
        check_mirror(self, env)
        return samples if self.mirror is None else self.mirror(samples)

    def _gather(self, rows: np.ndarray, env_indices: np.ndarray, env: VecNormalize | None) -> ReplayBufferSamples:
        """SB3 draws the environment of a row itself: show it one environment at a time, then restore the drawn order."""
        if self.n_envs == 1:
            return self._get_samples(rows, env=env)
        order = np.argsort(env_indices, kind="stable")
        parts = []
        for index in np.unique(env_indices):
            view = copy.copy(self)
            view.n_envs = 1
            for name in STORAGE:
                setattr(view, name, getattr(self, name)[:, index : index + 1])  # shares memory
            parts.append(view._get_samples(rows[env_indices == index], env=env))
        back = th.as_tensor(np.argsort(order), device=self.device)
        fields = (None if field[0] is None else th.cat(field)[back] for field in zip(*parts, strict=True))
        return ReplayBufferSamples(*fields)  # type: ignore[arg-type]  # only discounts may be None


class FadedSampling(ReplayBuffer):
    """The rows drawn by both fading buffers; what a row holds is the business of the other base class."""

    def __init__(self, *args: Any, fade_factor: float | None = 7.0, fade_power: float = 2.0, **kwargs: Any) -> None:
        _check_fading(fade_factor, fade_power)
        super().__init__(*args, **kwargs)
        self.fade_factor = fade_factor
        self.fade_power = fade_power

    def add(self, *args: Any, **kwargs: Any) -> None:
        # A mark of end_trajectory(), which SB3 overwrites only if it handles timeouts
        self.timeouts[self.pos] = 0
        super().add(*args, **kwargs)

    def sample(self, batch_size: int, env: VecNormalize | None = None, uniform: bool = False) -> Any:
        """
        Draw transitions with replacement; the environment of a row is drawn uniformly.

        :param batch_size: number of transitions to draw; may exceed the number stored
        :param env: ``VecNormalize`` whose current statistics normalise observations and rewards
        :param uniform: draw uniformly for this one call
        :return: SB3's samples, tensors of shape ``(batch_size, ...)``
        :raises ValueError: if the buffer is empty
        """
        return self._get_samples(self._draw_rows(batch_size, uniform), env=env)

    def _draw_rows(self, batch_size: int, uniform: bool) -> np.ndarray:
        if self.size() == 0:
            raise ValueError(f"{type(self).__name__}: cannot sample, no transition is stored yet")
        if uniform or _is_uniform(self.fade_factor):
            return draw_faded_ages(self.size(), batch_size, None)
        ages = draw_faded_ages(self.size(), batch_size, self.fade_factor, self.fade_power)
        # The oldest row is the next one to be overwritten
        return (ages + self.pos) % self.buffer_size if self.full else ages

    def to_torch(self, array: np.ndarray, copy: bool = False) -> th.Tensor:
        # Samples are fancy-indexed, hence fresh arrays already: a second copy would protect nothing
        return super().to_torch(array, copy=copy)


class FadingReplayBuffer(FadedSampling, _StepsReplayBuffer):
    """
    Replay buffer that draws recent transitions more often: weight ∝ tanh(f·x^power), x = i/n with i = 0 the oldest.

    At the defaults the newest transition is drawn 1.40 times as often as under uniform replay, the older half holds
    30 % of the mass, the oldest transition is never drawn. Draws are exact, cost the same for every buffer size, and
    follow age (not position) once the ring has wrapped. Works under SB3's own off-policy algorithms too::

        TD3("MlpPolicy", env, replay_buffer_class=FadingReplayBuffer, replay_buffer_kwargs=dict(fade_factor=7.0))

    Under SB3's algorithms, n-step returns need ``n_steps`` *and* ``gamma`` in ``replay_buffer_kwargs``.

    Source: Read, "Dancing like the Inbetweeners: learning to walk with Symphony" (2024).

    :param buffer_size: number of transitions to keep, over all environments
    :param observation_space: observation space (not Dict: see :class:`FadingDictReplayBuffer`)
    :param action_space: action space
    :param device: PyTorch device of the samples
    :param n_envs: number of parallel environments
    :param optimize_memory_usage: not supported, must be ``False``
    :param handle_timeout_termination: bootstrap through time limits
    :param n_steps: horizon of the returns; 1 gives SB3's plain samples, more adds ``discounts`` to them
    :param gamma: discount factor of the n-step returns (unused if ``n_steps`` is 1)
    :param fade_factor: steepness f > 0; ``None`` or ``inf`` means uniform
    :param fade_power: power of the normalised age index, in (0, 100]
    :param mirror: the robot's left-right symmetry, see :class:`~sb3_symphony.common.mirror.Mirror`; about every second
        transition is shown mirrored. Not with normalised observations. ``None``: transitions as they are
    :param start_share: about this part of the draws comes from the first steps of episodes alone, in [0, 1]. Who walks well
        starts once in a thousand steps, and forgets how
    :param start_steps: how many steps of an episode count as its first ones, at least 1
    :raises ValueError: for a value outside the ranges above, Dict observations, or ``optimize_memory_usage=True``
    """

    def __init__(
        self,
        buffer_size: int,
        observation_space: spaces.Space,
        action_space: spaces.Space,
        device: th.device | str = "auto",
        n_envs: int = 1,
        optimize_memory_usage: bool = False,
        handle_timeout_termination: bool = True,
        n_steps: int = 1,
        gamma: float = 0.99,
        fade_factor: float | None = 7.0,
        fade_power: float = 2.0,
        mirror: Mapping[str, Any] | None = None,
        start_share: float = 0.0,
        start_steps: int = 100,
    ) -> None:
        _refuse_memory_optimisation("FadingReplayBuffer", optimize_memory_usage)
        if isinstance(observation_space, spaces.Dict):
            raise ValueError("FadingReplayBuffer does not hold Dict observations: use FadingDictReplayBuffer")
        check_number("start_share", start_share, 0, 1)
        check_number("start_steps", start_steps, 1, integer=True)
        super().__init__(
            buffer_size,
            observation_space,
            action_space,
            device=device,
            n_envs=n_envs,
            handle_timeout_termination=handle_timeout_termination,
            n_steps=n_steps,
            gamma=gamma,
            fade_factor=fade_factor,
            fade_power=fade_power,
            mirror=mirror,
        )
        self.start_share, self.start_steps = start_share, start_steps
        self.reset()

    def reset(self) -> None:
        """Forget all transitions."""
        super().reset()
        # Ring of the places (row * n_envs + environment) of episodes' first steps, in the order of age
        self.starts = np.zeros((self.buffer_size if self.start_share > 0 else 0, self.n_envs), dtype=np.int64)
        self.oldest_start = self.n_starts = 0  # counted since the first one; those before the oldest are overwritten
        self.episode_steps = np.zeros(self.n_envs, dtype=np.int64)  # of the episodes under way

    def _before_row(self, done: np.ndarray) -> None:
        if self.start_share == 0:
            return
        starts, row_places = self.starts.reshape(-1), self._row_places()
        # The row is overwritten now
        while self.full and self.oldest_start < self.n_starts and starts[self.oldest_start % len(starts)] in row_places:
            self.oldest_start += 1
        for place in row_places[self.episode_steps < self.start_steps]:
            starts[self.n_starts % len(starts)] = place
            self.n_starts += 1
        self.episode_steps = np.where(done, 0, self.episode_steps + 1)

    def sample(self, batch_size: int, env: VecNormalize | None = None, uniform: bool = False) -> Any:
        stored = self.n_starts - self.oldest_start
        if uniform or stored == 0:
            return super().sample(batch_size, env, uniform)
        rows = self._draw_rows(batch_size, uniform=False)
        env_indices = np.random.randint(0, self.n_envs, size=batch_size)
        chosen = np.random.random(batch_size) < self.start_share
        ages = draw_faded_ages(stored, int(chosen.sum()), self.fade_factor, self.fade_power)
        places = self.starts.reshape(-1)[(self.oldest_start + ages) % self.starts.size]
        rows[chosen], env_indices[chosen] = np.divmod(places, self.n_envs)
        return self._gather(rows, env_indices, env)


class FadingDictReplayBuffer(FadedSampling, DictReplayBuffer):
    """
    :class:`FadingReplayBuffer` for Dict observations, without n-step returns (as in SB3).

    :param buffer_size: number of transitions to keep, over all environments
    :param observation_space: Dict observation space
    :param action_space: action space
    :param device: PyTorch device of the samples
    :param n_envs: number of parallel environments
    :param optimize_memory_usage: not supported, must be ``False``
    :param handle_timeout_termination: bootstrap through time limits
    :param n_steps: must be 1
    :param gamma: unused, accepted so that both fading buffers take the same arguments
    :param fade_factor: steepness f > 0; ``None`` or ``inf`` means uniform
    :param fade_power: power of the normalised age index, in (0, 100]
    :raises ValueError: for a value outside the ranges above, other observations, or ``optimize_memory_usage=True``
    """

    # SB3 declares one array on the parent and a dictionary on the Dict buffer
    observations: dict[str, np.ndarray]
    next_observations: dict[str, np.ndarray]

    def __init__(
        self,
        buffer_size: int,
        observation_space: spaces.Dict,
        action_space: spaces.Space,
        device: th.device | str = "auto",
        n_envs: int = 1,
        optimize_memory_usage: bool = False,
        handle_timeout_termination: bool = True,
        n_steps: int = 1,
        gamma: float = 0.99,
        fade_factor: float | None = 7.0,
        fade_power: float = 2.0,
    ) -> None:
        _refuse_memory_optimisation("FadingDictReplayBuffer", optimize_memory_usage)
        if not isinstance(observation_space, spaces.Dict):
            raise ValueError("FadingDictReplayBuffer holds Dict observations: use FadingReplayBuffer for others")
        if n_steps != 1:
            raise ValueError(f"n_steps={n_steps!r}: expected 1, n-step returns are not supported for Dict observations")
        super().__init__(
            buffer_size,
            observation_space,
            action_space,
            device=device,
            n_envs=n_envs,
            handle_timeout_termination=handle_timeout_termination,
            fade_factor=fade_factor,
            fade_power=fade_power,
        )


def check_mirror(buffer: ReplayBuffer | None, env: VecNormalize | None) -> None:
    """
    Mirrored transitions need observations whose left and right have one scale.

    :param buffer: replay buffer, of any kind
    :param env: what normalises its samples
    :raises ValueError: if it mirrors and observations are normalised
    """
    if getattr(buffer, "mirror", None) is not None and env is not None and env.norm_obs:
        raise ValueError("mirror: expected observations as they are, not normalised ones (norm_obs=False)")


def end_trajectory(buffer: ReplayBuffer) -> None:
    """
    Mark that the latest transition is not followed by the next one to come: the environments start anew. This package's
    algorithms do it where they reset environments; under SB3's own, call it before a ``learn()`` that does.

    :param buffer: replay buffer
    """
    if buffer.size() == 0:
        return
    if isinstance(buffer, HerReplayBuffer):
        with warnings.catch_warnings():  # SB3's advice is for a buffer that was loaded
            warnings.simplefilter("ignore", UserWarning)
            buffer.truncate_last_trajectory()
    elif hasattr(buffer, "timeouts"):  # one's own buffers may do without
        last = buffer.pos - 1
        if not buffer.optimize_memory_usage:  # else the next observation will be that of another episode
            buffer.timeouts[last] = np.logical_or(buffer.timeouts[last], buffer.dones[last] == 0)
        buffer.dones[last] = 1
    if isinstance(buffer, FadingReplayBuffer):
        buffer.episode_steps[:] = 0


# ----------------------------------------------------------------------------------------------------------------------
# Prioritised replay
# ----------------------------------------------------------------------------------------------------------------------


class SumTree:
    """
    Non-negative values with their sum and draws proportional to them, in O(log n), vectorised over a batch.

    One float64 array: node k has children 2k and 2k + 1, node 1 is the total, the leaves are the last half. Parents are
    recomputed from their children (never adjusted by a difference), so rounding errors do not build up.

    :param n_leaves: number of values, at least 1; all start at 0
    """

    def __init__(self, n_leaves: int) -> None:
        self._allocate(n_leaves)

    def _allocate(self, n_leaves: int) -> None:
        self.n_leaves = n_leaves
        self.first_leaf = 1 << max(n_leaves - 1, 0).bit_length()  # a power of two, so all leaves have the same depth
        self.nodes = np.zeros(2 * self.first_leaf)

    def __getstate__(self) -> dict[str, Any]:
        """Pickled without trailing zeros and sums, which make up most of a tree that is not full."""
        used = np.flatnonzero(self.nodes[self.first_leaf :])
        end = self.first_leaf + (int(used[-1]) + 1 if len(used) else 0)
        return {"n_leaves": self.n_leaves, "values": self.nodes[self.first_leaf : end]}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self._allocate(state["n_leaves"])
        self.nodes[self.first_leaf : self.first_leaf + len(state["values"])] = state["values"]
        level = self.first_leaf
        while level > 1:  # the same sums as in set(), hence the same bits
            children, level = self.nodes[level : 2 * level], level // 2
            self.nodes[level : 2 * level] = children[::2] + children[1::2]

    @property
    def total(self) -> float:
        """Sum of all values."""
        return float(self.nodes[1])

    def get(self, leaves: np.ndarray) -> np.ndarray:
        """
        :param leaves: int array of positions in [0, n_leaves)
        :return: their values
        """
        return self.nodes[self.first_leaf + leaves]

    def set(self, leaves: np.ndarray, values: np.ndarray | float) -> None:
        """
        :param leaves: int array of positions; of a position given twice, the last value counts
        :param values: non-negative values, of the same shape or one number
        """
        nodes = self.first_leaf + leaves
        self.nodes[nodes] = values
        while nodes[0] > 1:  # all nodes are on the same level
            nodes = nodes >> 1
            self.nodes[nodes] = self.nodes[2 * nodes] + self.nodes[2 * nodes + 1]

    def find(self, masses: np.ndarray) -> np.ndarray:
        """
        :param masses: numbers in [0, total), shape ``(batch,)``
        :return: for each, the position whose interval of the cumulative sum holds it; never one of value 0
        """
        masses = np.array(masses, dtype=np.float64)
        nodes = np.ones(len(masses), dtype=np.int64)
        for _ in range(self.first_leaf.bit_length() - 1):
            nodes *= 2
            left = self.nodes[nodes]
            # Rounding may leave a mass just beyond the last non-zero value: never step into an empty subtree
            go_right = (masses >= left) & (self.nodes[nodes + 1] > 0)
            masses -= np.where(go_right, left, 0.0)
            nodes += go_right
        return nodes - self.first_leaf


class PrioritizedReplayBufferSamples(NamedTuple):
    """
    SB3's six fields first, then what prioritised replay needs. Tensors, except ``indices``.

    ``weights`` has shape ``(batch, 1)``: multiply each transition's squared error by it. ``indices`` has shape
    ``(batch,)``: hand it back to :meth:`PrioritizedReplayBuffer.update_priorities`.
    """

    observations: th.Tensor
    actions: th.Tensor
    next_observations: th.Tensor
    dones: th.Tensor
    rewards: th.Tensor
    discounts: th.Tensor | None
    weights: th.Tensor
    indices: np.ndarray


class PrioritizedReplayBuffer(_StepsReplayBuffer):
    """
    Proportional prioritised replay: P(i) ∝ (|δ_i| + eps)^alpha, corrected by importance weights (n·P)^-beta / max.

    One priority per transition, that is per row and environment; a new transition gets the largest priority seen so far.
    Draws are independent (not stratified): only then are the counts in a batch multinomial with exactly P, which is
    what the tests check; stratifying would lower their variance but make the draws of a batch dependent.
    The maximum that normalises the weights is the one over the drawn batch.

    Whoever samples must apply ``weights`` and call :meth:`update_priorities`. SB3's own algorithms do neither, so they
    must not use this buffer: after ten calls of :meth:`sample` without any update, a ``RuntimeError`` says so.

    Source: Schaul et al., "Prioritized Experience Replay" (2016), https://arxiv.org/abs/1511.05952.

    :param buffer_size: number of transitions to keep, over all environments
    :param observation_space: observation space (not Dict)
    :param action_space: action space
    :param device: PyTorch device of the samples
    :param n_envs: number of parallel environments
    :param optimize_memory_usage: not supported, must be ``False``
    :param handle_timeout_termination: bootstrap through time limits
    :param n_steps: horizon of the returns; more than 1 adds ``discounts`` to the samples
    :param gamma: discount factor of the n-step returns (unused if ``n_steps`` is 1)
    :param alpha: exponent of the priorities, >= 0; 0 means uniform
    :param beta: exponent of the importance weights, >= 0; 1 corrects fully. An attribute: may be changed while training
    :param eps: added to each error's size, > 0, so that every transition can be drawn
    :param mirror: the robot's left-right symmetry, see :class:`~sb3_symphony.common.mirror.Mirror`; about every second
        transition is shown mirrored. Not with normalised observations. ``None``: transitions as they are
    :raises ValueError: for a value outside the ranges above, Dict observations, or ``optimize_memory_usage=True``
    """

    max_samples_without_update = 10

    def __init__(
        self,
        buffer_size: int,
        observation_space: spaces.Space,
        action_space: spaces.Space,
        device: th.device | str = "auto",
        n_envs: int = 1,
        optimize_memory_usage: bool = False,
        handle_timeout_termination: bool = True,
        n_steps: int = 1,
        gamma: float = 0.99,
        alpha: float = 0.6,
        beta: float = 0.4,
        eps: float = 1e-6,
        mirror: Mapping[str, Any] | None = None,
    ) -> None:
        _refuse_memory_optimisation("PrioritizedReplayBuffer", optimize_memory_usage)
        if isinstance(observation_space, spaces.Dict):
            raise ValueError("PrioritizedReplayBuffer does not hold Dict observations: use FadingDictReplayBuffer")
        check_number("alpha", alpha, 0)
        check_number("beta", beta, 0)
        check_number("eps", eps, 0, exclusive=True)
        super().__init__(
            buffer_size,
            observation_space,
            action_space,
            device=device,
            n_envs=n_envs,
            handle_timeout_termination=handle_timeout_termination,
            n_steps=n_steps,
            gamma=gamma,
            mirror=mirror,
        )
        self.alpha = alpha
        self.beta = beta
        self.eps = eps
        self.reset()

    def reset(self) -> None:
        """Forget all transitions and priorities."""
        super().reset()
        self.tree = SumTree(self.buffer_size * self.n_envs)  # leaf = row * n_envs + environment
        self.max_priority = 1.0  # before the exponent alpha
        self._samples_without_update = 0

    def _before_row(self, done: np.ndarray) -> None:
        self.tree.set(self._row_places(), self.max_priority**self.alpha)

    def sample(  # type: ignore[override]  # a tuple with two more fields than SB3's
        self, batch_size: int, env: VecNormalize | None = None
    ) -> PrioritizedReplayBufferSamples:
        """
        Draw transitions with replacement, in proportion to their priorities.

        :param batch_size: number of transitions to draw
        :param env: ``VecNormalize`` whose current statistics normalise observations and rewards
        :return: SB3's fields, importance weights ``(batch_size, 1)`` and the positions ``(batch_size,)`` of the priorities
        :raises ValueError: if the buffer is empty
        :raises RuntimeError: if priorities are never updated, as under SB3's own algorithms
        """
        if self.size() == 0:
            raise ValueError("PrioritizedReplayBuffer: cannot sample, no transition is stored yet")
        self._samples_without_update += 1
        if self._samples_without_update > self.max_samples_without_update:
            raise RuntimeError(
                f"PrioritizedReplayBuffer.sample was called {self.max_samples_without_update} times without any "
                "update_priorities: this algorithm does not support prioritised replay (SB3's own algorithms do not)"
            )
        total = self.tree.total
        leaves = self.tree.find(np.random.random(batch_size) * total)
        probabilities = self.tree.get(leaves) / total
        weights = (self.size() * self.n_envs * probabilities) ** -self.beta
        weights = (weights / weights.max()).astype(np.float32).reshape(-1, 1)
        samples = self._gather(leaves // self.n_envs, leaves % self.n_envs, env)
        return PrioritizedReplayBufferSamples(*samples, weights=self.to_torch(weights), indices=leaves)

    def update_priorities(self, indices: np.ndarray, td_errors: np.ndarray | th.Tensor) -> None:
        """
        Give drawn transitions the priority |td_error| + eps. Of a transition drawn twice, the last error counts.

        :param indices: ``indices`` of the samples, shape ``(batch,)``
        :param td_errors: temporal-difference errors, ``batch`` values in any shape; the sign does not matter
        :raises ValueError: if the numbers of indices and errors differ, an index is out of range, an error not finite, or a
            priority too large or small for its power
        """
        if isinstance(td_errors, th.Tensor):
            td_errors = td_errors.detach().cpu().numpy()
        indices = np.asarray(indices, dtype=np.int64).reshape(-1)
        priorities = np.abs(np.asarray(td_errors, dtype=np.float64)).reshape(-1) + self.eps
        if len(indices) != len(priorities):
            raise ValueError(f"update_priorities: {len(indices)} indices but {len(priorities)} td_errors")
        if len(indices) == 0:
            return
        if not np.all(np.isfinite(priorities)):
            raise ValueError("update_priorities: td_errors hold values that are not finite")
        stored = self.size() * self.n_envs
        if indices.min() < 0 or indices.max() >= stored:
            raise ValueError(f"update_priorities: indices must lie in [0, {stored}), the stored transitions")
        with np.errstate(over="ignore", under="ignore"):
            powers = priorities**self.alpha
        if not np.all(np.isfinite(powers) & (powers > 0)):
            raise ValueError(f"update_priorities: alpha={self.alpha!r}: expected less, powers of errors are 0 or infinite")
        self.tree.set(indices, powers)
        self.max_priority = max(self.max_priority, float(priorities.max()))
        self._samples_without_update = 0
