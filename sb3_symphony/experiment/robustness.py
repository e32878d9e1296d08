"""Wrappers that make acting harder, as sensors and actuators of a real robot do: noise and delay."""

from collections import deque
from typing import Any, SupportsFloat

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from sb3_symphony.common.checks import check_number


class ObservationNoise(gym.Wrapper):
    """
    Adds independent Gaussian noise to every number of every observation. A reset with a seed seeds the noise as well, with the
    stream of numbers that an environment of that seed draws from its own generator.

    :param env: environment with observations of real numbers
    :param std: standard deviation in the observation's units, >= 0
    :raises TypeError: if observations are not a Box of real numbers
    :raises ValueError: if ``std`` is not finite and >= 0
    """

    def __init__(self, env: gym.Env, std: float) -> None:
        check_number("std", std, 0)
        space = env.observation_space
        if not (isinstance(space, spaces.Box) and np.issubdtype(space.dtype, np.floating)):
            raise TypeError(f"expected observations of real numbers (Box), got {space}")
        super().__init__(env)
        self.std = float(std)
        self.generator = np.random.default_rng()

    def _disturbed(self, observation: np.ndarray) -> np.ndarray:
        noise = self.std * self.generator.standard_normal(observation.shape)
        return (observation + noise).astype(observation.dtype)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """
        :param seed: seed of the episode
        :param options: handed to the environment
        :return: first observation, with noise, and info
        """
        if seed is not None:
            self.generator = np.random.default_rng(seed)
        observation, info = self.env.reset(seed=seed, options=options)
        return self._disturbed(observation), info

    def step(self, action: Any) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        """
        :param action: action of the environment
        :return: observation with noise, reward, terminated, truncated, info
        """
        observation, reward, terminated, truncated, info = self.env.step(action)
        return self._disturbed(observation), reward, terminated, truncated, info


class ActionDelay(gym.Wrapper):
    """
    Lets every action act some steps later. Until the first one does, the actuators get zero, or the nearest allowed value.

    :param env: environment with continuous actions
    :param steps: length of the delay, in environment steps, >= 0
    :raises TypeError: if actions are not continuous (Box), or ``steps`` is no whole number
    :raises ValueError: if ``steps`` is negative
    """

    def __init__(self, env: gym.Env, steps: int) -> None:
        check_number("steps", steps, 0, integer=True)
        if not isinstance(env.action_space, spaces.Box):
            raise TypeError(f"expected continuous actions (Box), got {env.action_space}")
        super().__init__(env)
        self.steps = steps
        space = env.action_space
        self.rest = np.clip(np.zeros(space.shape, space.dtype), space.low, space.high)
        self.waiting: deque[np.ndarray] = deque()

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        self.waiting.clear()
        return self.env.reset(seed=seed, options=options)

    def step(self, action: Any) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        """
        :param action: action to act ``steps`` steps later
        :return: observation, reward, terminated, truncated, info
        """
        self.waiting.append(action)
        return self.env.step(self.waiting.popleft() if len(self.waiting) > self.steps else self.rest)
