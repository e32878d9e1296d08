"""
Exploration noises whose size decays, for every off-policy algorithm of Stable-Baselines3 with ``action_noise=``.

Noise is added to the *scaled* action: SB3 maps every Box action space to [-1, 1], adds the noise there, clips to [-1, 1]
and scales back. A standard deviation of 0.3 is therefore 30 % of each dimension's half-range, whatever its units.
TD3 and DDPG add it to a deterministic action, SAC on top of its own sampling. Evaluation calls no noise, so the decay
counts environment steps acted with noise, warm-up included. Draws come from numpy's global generator.
"""

import math
from abc import abstractmethod

import numpy as np
from stable_baselines3.common.noise import ActionNoise

from sb3_symphony.common.checks import check_choice, check_number, check_pair
from sb3_symphony.common.moving import Moving, at_step, check_moving

DECAYS = ("cosine", "linear", "tanh", "constant")


class DecayingActionNoise(ActionNoise):
    """
    Base of the noises below: owns the decay of the standard deviation σ_t from ``sigma`` to ``sigma_final``.

    With s = (σ_t - sigma_final) / (sigma - sigma_final) and T = ``decay_steps``: cosine s = (1 + cos(πt/T))/2,
    linear s = 1 - t/T (both 0 from t = T on), tanh s = 1 - tanh(t/T) (never quite 0), constant s = 1.
    The end of an episode (``reset()``) restarts a subclass's correlation, not the decay.

    :param n_actions: number of action dimensions, or the action space's shape
    :param sigma: initial standard deviation, in scaled action units, >= 0
    :param sigma_final: last standard deviation, >= 0
    :param decay_steps: T, in environment steps, > 0
    :param decay: ``"cosine"``, ``"linear"``, ``"tanh"`` or ``"constant"``
    :param n_envs: environment steps that one call stands for. SB3 copies the noise for every parallel environment and
        calls each copy once per vector step, so set it to their number (attribute ``n_envs``; it may be changed later)
    :raises ValueError: for a value outside the ranges above
    """

    def __init__(
        self,
        n_actions: int | tuple[int, ...],
        sigma: float,
        sigma_final: float,
        decay_steps: float,
        decay: str,
        n_envs: int,
    ) -> None:
        super().__init__()
        self.shape = n_actions if isinstance(n_actions, tuple) else (n_actions,)
        for size in self.shape:
            check_number("n_actions", size, 1, integer=True)
        check_number("sigma", sigma, 0)
        check_number("sigma_final", sigma_final, 0)
        check_number("decay_steps", decay_steps, 0, exclusive=True)
        check_choice("decay", decay, DECAYS)
        check_number("n_envs", n_envs, 1, integer=True)
        self.n_actions = math.prod(self.shape)
        self.sigma = sigma
        self.sigma_final = sigma_final
        self.decay_steps = decay_steps
        self.decay = decay
        self.n_envs = n_envs
        self.t = 0  # environment steps acted with noise so far

    @property
    def sigma_t(self) -> float:
        """σ_t of the next draw, in scaled action units."""
        progress = self.t / self.decay_steps
        if self.decay == "constant":
            remaining = 1.0
        elif self.decay == "tanh":
            remaining = 1.0 - math.tanh(progress)
        elif progress >= 1:
            remaining = 0.0
        elif self.decay == "linear":
            remaining = 1.0 - progress
        else:
            remaining = 0.5 * (1.0 + math.cos(math.pi * progress))
        return self.sigma_final + (self.sigma - self.sigma_final) * remaining

    @property
    def std(self) -> float:
        """Standard deviation of the next draw, over all episodes and before clipping; NaN where it is not known."""
        return self.sigma_t

    def __call__(self) -> np.ndarray:
        """
        :return: noise of one environment step, float32 ``(n_actions,)`` or the given shape, in scaled action units
        """
        noise = self._draw(self.sigma_t)
        self.t += self.n_envs
        return noise.astype(np.float32).reshape(self.shape)

    @abstractmethod
    def _draw(self, sigma: float) -> np.ndarray:
        """
        :param sigma: σ_t
        :return: noise ``(n_actions,)``
        """

    def __repr__(self) -> str:
        return (
            f"{type(self).__name__}(n_actions={self.n_actions}, sigma={self.sigma}, sigma_final={self.sigma_final}, "
            f"decay_steps={self.decay_steps}, decay={self.decay!r}, t={self.t})"
        )


class DecayingNormalActionNoise(DecayingActionNoise):
    """
    Independent Gaussian noise, clipped at a multiple of σ_t, with decaying σ_t.

    The defaults are Symphony's: σ_t = 0.15·(1 + cos(πt/T)) until T = 104 720 steps, then 0, clipped at ±2.5σ_t
    (which lowers the standard deviation by 1 %). Source: Read, "Dancing like the Inbetweeners: learning to walk with
    Symphony" (2024), with the numbers of the original author's code.

    :param n_actions: number of action dimensions, or the action space's shape
    :param sigma: initial standard deviation, in scaled action units, >= 0
    :param sigma_final: last standard deviation, >= 0
    :param decay_steps: length of the decay, in environment steps, > 0
    :param decay: ``"cosine"``, ``"linear"``, ``"tanh"`` or ``"constant"``
    :param clip: largest size of the noise in multiples of σ_t, > 0; ``None`` = not clipped
    :param n_envs: environment steps that one call stands for (see :class:`DecayingActionNoise`)
    :raises ValueError: for a value outside the ranges above
    """

    def __init__(
        self,
        n_actions: int | tuple[int, ...],
        sigma: float = 0.3,
        sigma_final: float = 0.0,
        decay_steps: float = 104_720,
        decay: str = "cosine",
        clip: float | None = 2.5,
        n_envs: int = 1,
    ) -> None:
        super().__init__(n_actions, sigma, sigma_final, decay_steps, decay, n_envs)
        if clip is not None:
            check_number("clip", clip, 0, exclusive=True)
        self.clip = clip

    def _draw(self, sigma: float) -> np.ndarray:
        unit = np.random.standard_normal(self.n_actions)
        if self.clip is not None:
            unit = np.clip(unit, -self.clip, self.clip)
        return sigma * unit


class StickyActionNoise(DecayingActionNoise):
    """
    Gaussian noise that persists: σ_t·x with x ← ρx + sqrt(1 - ρ²)ε, each x held for ``hold`` steps.

    x starts from its stationary distribution N(0, 1) at every episode, so the standard deviation is σ_t at all times.
    Correlated noise moves a robot's limbs somewhere; independent noise averages out before they have moved.

    With ``episode_scale=(a, b)`` the noise of each episode is multiplied by a number drawn uniformly between them: quiet
    episodes show what the policy is worth, loud ones something else.

    :param n_actions: number of action dimensions, or the action space's shape
    :param sigma: initial standard deviation, in scaled action units, >= 0
    :param sigma_final: last standard deviation, >= 0
    :param decay_steps: length of the decay, in environment steps, > 0
    :param decay: ``"cosine"``, ``"linear"``, ``"tanh"`` or ``"constant"``
    :param correlation: ρ between one draw and the next, in [0, 1)
    :param hold: environment steps for which a draw is repeated, >= 1
    :param n_envs: environment steps that one call stands for (see :class:`DecayingActionNoise`)
    :param episode_scale: smallest and largest factor of an episode, 0 <= smallest <= largest
    :param independent: standard deviation of independent Gaussian noise on top, >= 0, the same in quiet and loud episodes.
        A deterministic actor's substitute for what a stochastic one tries by itself. It may move, from ``a`` at step ``s`` to
        ``b`` at step ``t``, if it is given as ``(a, b, s, t)``
    :raises ValueError: for a value outside the ranges above
    """

    def __init__(
        self,
        n_actions: int | tuple[int, ...],
        sigma: float = 0.3,
        sigma_final: float = 0.0,
        decay_steps: float = 104_720,
        decay: str = "cosine",
        correlation: float = 0.8,
        hold: int = 1,
        n_envs: int = 1,
        episode_scale: tuple[float, float] = (1.0, 1.0),
        independent: Moving = 0.0,
    ) -> None:
        super().__init__(n_actions, sigma, sigma_final, decay_steps, decay, n_envs)
        check_moving("independent", independent, 0)
        check_number("correlation", correlation, 0, below=1)
        check_number("hold", hold, 1, integer=True)
        check_pair("episode_scale", episode_scale, "smallest, largest", 0)
        if episode_scale[0] > episode_scale[1]:
            raise ValueError(f"episode_scale={episode_scale!r}: expected the smaller number first")
        self.correlation = correlation
        self.hold = hold
        self.episode_scale = episode_scale
        self.independent = independent
        self.reset()

    @property
    def std(self) -> float:
        smallest, largest = self.episode_scale
        square = (smallest**2 + smallest * largest + largest**2) / 3  # mean of the uniform factor's
        return math.hypot(self.sigma_t * math.sqrt(square), at_step(self.independent, self.t))

    def reset(self) -> None:
        """Start a new episode: forget the last draw (the decay goes on)."""
        self.x: np.ndarray | None = None
        self.factor = 1.0  # of the episode, drawn with its first x
        self.held = 0  # steps for which x has been used

    def _draw(self, sigma: float) -> np.ndarray:
        if self.x is None:
            smallest, largest = self.episode_scale
            self.factor = np.random.uniform(smallest, largest) if smallest < largest else largest
            self.x = np.random.standard_normal(self.n_actions)
        elif self.held >= self.hold:
            fresh = np.random.standard_normal(self.n_actions)
            self.x = self.correlation * self.x + math.sqrt(1.0 - self.correlation**2) * fresh
            self.held = 0
        self.held += 1
        noise = sigma * self.factor * self.x
        independent = at_step(self.independent, self.t)
        if independent > 0:
            noise = noise + independent * np.random.standard_normal(self.n_actions)
        return noise


class PinkActionNoise(DecayingActionNoise):
    """
    Coloured Gaussian noise, power spectrum ∝ 1/f^beta, of standard deviation σ_t; beta = 1 is pink noise.

    A block of ``block_steps`` steps is made at the start of each episode from a random spectrum; a longer episode
    continues with a new, independent block. Choose about the episode length.

    Source: Eberhard et al., "Pink Noise Is All You Need: Colored Noise Exploration in Deep Reinforcement Learning" (2023).

    :param n_actions: number of action dimensions, or the action space's shape
    :param sigma: initial standard deviation, in scaled action units, >= 0
    :param sigma_final: last standard deviation, >= 0
    :param decay_steps: length of the decay, in environment steps, > 0
    :param decay: ``"cosine"``, ``"linear"``, ``"tanh"`` or ``"constant"``
    :param beta: colour, >= 0: 0 white, 1 pink, 2 red
    :param block_steps: length of a block in environment steps, >= 2
    :param n_envs: environment steps that one call stands for (see :class:`DecayingActionNoise`)
    :raises ValueError: for a value outside the ranges above
    """

    def __init__(
        self,
        n_actions: int | tuple[int, ...],
        sigma: float = 0.3,
        sigma_final: float = 0.0,
        decay_steps: float = 104_720,
        decay: str = "cosine",
        beta: float = 1.0,
        block_steps: int = 1600,
        n_envs: int = 1,
    ) -> None:
        super().__init__(n_actions, sigma, sigma_final, decay_steps, decay, n_envs)
        check_number("beta", beta, 0)
        check_number("block_steps", block_steps, 2, integer=True)
        self.beta = beta
        self.block_steps = block_steps
        self.reset()

    def reset(self) -> None:
        """Start a new episode: the next call makes a new block (the decay goes on)."""
        self.block: np.ndarray | None = None
        self.used = 0  # steps of the block already returned

    def _draw(self, sigma: float) -> np.ndarray:
        if self.block is None or self.used == self.block_steps:
            self.block = self._new_block()
            self.used = 0
        self.used += 1
        return sigma * self.block[self.used - 1]

    def _new_block(self) -> np.ndarray:
        """
        :return: unit-variance noise ``(block_steps, n_actions)``
        """
        steps = self.block_steps
        frequency = np.arange(steps // 2 + 1, dtype=np.float64)
        frequency[0] = 1.0  # the mean of a block gets the power of the slowest wave: 1/0 has none
        amplitude = frequency ** (-0.5 * self.beta)
        # Mean and (even length) fastest wave are real; every other wave also stands for its conjugate
        real = np.zeros(len(frequency), dtype=bool)
        real[0] = True
        real[-1] = steps % 2 == 0
        parts = np.random.standard_normal((2, self.n_actions, len(frequency)))
        parts[0, :, real] *= math.sqrt(2.0)
        parts[1, :, real] = 0.0
        waves = np.fft.irfft(amplitude * (parts[0] + 1j * parts[1]), n=steps, axis=-1)  # (n_actions, steps)
        variance = 2.0 * np.sum(np.where(real, 1.0, 2.0) * amplitude**2) / steps**2
        return waves.T / math.sqrt(variance)


class DisturbanceActionNoise(DecayingActionNoise):
    """
    Disturbance, different in every episode: a leaky integral d of a wave with wandering frequency and height.

    Per dimension, with clock c (0.1 per step, never restarted) and phases φ redrawn from U(0, n_actions) in each episode:
    x = sin(ω·c + φ₀)/A, ω = 2 + sin(c + φ₁), A = 2 + sin(c + φ₂), d ← d + clip(σ_t·x) - clip(σ_t·d), clips at ±2.5σ_t.
    d starts each episode at 0. Here σ_t is the amplitude of the drive and the strength of the leak, *not* the standard
    deviation of d, which is 0.44 at σ_t = 1 and 0.18 at 0.3.

    The wave's frequency grows with the clock (d(ω·c)/dc contains c·cos(c + φ₁)), and the clock never restarts. So the
    drive is smooth in the first 100 steps only: the correlation of successive draws at σ_t = 1 is 0.7 in steps 0-200 and
    0 from step 1 000 on. Then only the leak correlates them, once σ_t has decayed (0.68 at 0.3). For noise that stays
    correlated use :class:`StickyActionNoise` or :class:`PinkActionNoise`.

    Source: the third version of Symphony by its original author (2024), which uses σ_t = 1 - tanh(3.07e-5·t), the
    default here; its residual disturbance tr is ``sigma=1 + tr, sigma_final=tr``.

    :param n_actions: number of action dimensions, or the action space's shape
    :param sigma: initial amplitude, in scaled action units, in [0, 2] (a stronger leak would make d diverge)
    :param sigma_final: last amplitude, in [0, 2]
    :param decay_steps: length of the decay, in environment steps, > 0
    :param decay: ``"cosine"``, ``"linear"``, ``"tanh"`` or ``"constant"``
    :param n_envs: environment steps that one call stands for (see :class:`DecayingActionNoise`)
    :raises ValueError: for a value outside the ranges above
    """

    clip = 2.5  # in multiples of σ_t
    clock_step = 0.1

    def __init__(
        self,
        n_actions: int | tuple[int, ...],
        sigma: float = 1.0,
        sigma_final: float = 0.0,
        decay_steps: float = 1 / 3.07e-5,
        decay: str = "tanh",
        n_envs: int = 1,
    ) -> None:
        super().__init__(n_actions, sigma, sigma_final, decay_steps, decay, n_envs)
        check_number("sigma", sigma, 0, 2)
        check_number("sigma_final", sigma_final, 0, 2)
        self.clock = 0.0
        self.reset()

    @property
    def std(self) -> float:
        return math.nan

    def reset(self) -> None:
        """Start a new episode: new phases, d = 0 (clock and decay go on)."""
        self.phases = np.random.uniform(0.0, self.n_actions, size=(3, self.n_actions))
        self.d = np.zeros(self.n_actions)

    def _draw(self, sigma: float) -> np.ndarray:
        c, (phase_0, phase_1, phase_2) = self.clock, self.phases
        omega = 2.0 + np.sin(c + phase_1)
        height = 2.0 + np.sin(c + phase_2)
        x = np.sin(omega * c + phase_0) / height
        limit = self.clip * sigma
        self.d = self.d + np.clip(sigma * x, -limit, limit) - np.clip(sigma * self.d, -limit, limit)
        self.clock += self.clock_step
        return self.d
