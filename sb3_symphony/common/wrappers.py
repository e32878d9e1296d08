"""
Gymnasium wrappers, usable by dotted name as ``env_wrapper`` in a YAML configuration.

Three kinds: what makes Box2D episodes repeatable (:class:`FreshBox2DWorld`); what changes the rewards and ends that a learner
sees, while the reported return stays that of the environment (:class:`LearningReward` and its subclasses); and what changes
the task (:class:`EpisodeStepLimit`, :class:`TorsoMass`, :class:`LegMass`).
"""

import math
from abc import abstractmethod
from typing import Any, SupportsFloat

import gymnasium as gym
import numpy as np
from stable_baselines3.common.env_util import unwrap_wrapper
from stable_baselines3.common.monitor import Monitor

from sb3_symphony.common.checks import check_choice, check_number, check_pair

# ----------------------------------------------------------------------------------------------------------------------
# Repeatable Box2D episodes
# ----------------------------------------------------------------------------------------------------------------------


def _has_box2d_world(env: gym.Env) -> bool:
    world = getattr(env.unwrapped, "world", None)
    if world is None or not hasattr(env.unwrapped, "_destroy"):
        return False  # without importing Box2D, which need not be installed
    try:
        from Box2D import b2World
    except ImportError:
        return False
    return isinstance(world, b2World)


def needs_fresh_world(env: gym.Env) -> bool:
    """
    Whether :class:`FreshBox2DWorld` should be put around an environment.

    :param env: any environment
    :return: True for an environment with a Box2D world (BipedalWalker, LunarLander, CarRacing) not yet wrapped
    """
    return _has_box2d_world(env) and unwrap_wrapper(env, FreshBox2DWorld) is None


class FreshBox2DWorld(gym.Wrapper):
    """
    Gives a Box2D environment a new world before every reset, so that an episode depends on seed and actions alone.

    Gymnasium's BipedalWalker destroys its bodies at a reset but keeps the world, whose contact solver remembers earlier
    episodes: the same seed and the same actions then give other observations and rewards. LunarLander makes a new world
    itself in recent versions of Gymnasium, which this wrapper does not disturb.

    :param env: an environment with a Box2D world
    :raises TypeError: if the environment has none
    """

    def __init__(self, env: gym.Env) -> None:
        if not _has_box2d_world(env):
            raise TypeError(f"FreshBox2DWorld: {env} has no Box2D world (expected one such as BipedalWalker-v3)")
        super().__init__(env)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        from Box2D import b2World

        walker: Any = self.env.unwrapped
        # Bodies go while their world still exists; the environment's own clean-up then finds nothing left to do
        walker._destroy()
        walker.world = b2World(gravity=walker.world.gravity)
        return self.env.reset(seed=seed, options=options)


# ----------------------------------------------------------------------------------------------------------------------
# Rewards for learning only
# ----------------------------------------------------------------------------------------------------------------------


class LearningReward(gym.Wrapper):
    """
    Base of wrappers that change the reward a learner sees, never the one that is reported.

    Reported returns come from ``Monitor``, so it has to sit inside: if there is none, one is put there. An algorithm that is
    given such an environment adds no other; ``make_vec_env`` always puts one around what a function gives it, so there hand
    the wrapper over as ``wrapper_class``, which comes outside. ``info["raw_reward"]`` holds the environment's
    reward of the step, whatever number of these wrappers are stacked. Evaluate without them.

    :param env: environment, with or without a ``Monitor``
    """

    def __init__(self, env: gym.Env) -> None:
        if unwrap_wrapper(env, Monitor) is None:
            env = Monitor(env)
        self._innermost = unwrap_wrapper(env, LearningReward) is None
        super().__init__(env)

    def step(self, action: Any) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        """
        :param action: action of the environment
        :return: observation, reward for learning, terminated, truncated, info
        """
        observation, reward, terminated, truncated, info = self.env.step(action)
        if self._innermost:
            info["raw_reward"] = float(reward)
        return observation, self.learning_reward(observation, float(reward)), terminated, truncated, info

    @abstractmethod
    def learning_reward(self, observation: Any, reward: float) -> float:
        """
        :param observation: observation after the step
        :param reward: reward of the wrapped environment
        :return: reward for learning
        """


class RewardFloor(LearningReward):
    """
    max(reward, floor): softens a large penalty, such as BipedalWalker's -100 for a fall.

    :param env: environment
    :param floor: smallest reward, in the environment's units
    :raises ValueError: if it is not finite
    """

    def __init__(self, env: gym.Env, floor: float = -10.0) -> None:
        check_number("floor", floor)
        self.floor = float(floor)
        super().__init__(env)

    def learning_reward(self, observation: Any, reward: float) -> float:
        return max(reward, self.floor)


class RewardScale(LearningReward):
    """
    reward · scale.

    :param env: environment
    :param scale: factor > 0
    :raises ValueError: if it is not finite and > 0
    """

    def __init__(self, env: gym.Env, scale: float) -> None:
        check_number("scale", scale, 0, exclusive=True)
        self.scale = float(scale)
        super().__init__(env)

    def learning_reward(self, observation: Any, reward: float) -> float:
        return reward * self.scale


class RewardBonus(LearningReward):
    """
    reward + bonus in every step.

    :param env: environment
    :param bonus: added reward, in the environment's units
    :raises ValueError: if it is not finite
    """

    def __init__(self, env: gym.Env, bonus: float = 1.0) -> None:
        check_number("bonus", bonus)
        self.bonus = float(bonus)
        super().__init__(env)

    def learning_reward(self, observation: Any, reward: float) -> float:
        return reward + self.bonus


class StallPenalty(LearningReward):
    """
    Adds a term that rewards change of the observation and punishes standing still.

    With δ the mean absolute change of the observation in this step: kind A adds coef·(δ - ln(max(1/(δ + 1e-6), 1e-3))),
    kind B adds -coef·log10(1/clip(δ, 0.1, 10)), which lies in [-coef, coef].

    Source: Symphony's original author (2023-24): kind A with 0.03 in the first version, kind B with 0.07 in the next two.

    :param env: environment with an array observation
    :param coef: size of the term, >= 0
    :param kind: ``"A"`` or ``"B"``
    :raises ValueError: for a coefficient that is not finite and >= 0, or another kind
    :raises TypeError: if the observation space is not a Box
    """

    def __init__(self, env: gym.Env, coef: float = 0.07, kind: str = "B") -> None:
        check_number("coef", coef, 0)
        check_choice("kind", kind, ("A", "B"))
        if not isinstance(env.observation_space, gym.spaces.Box):
            raise TypeError(f"StallPenalty: expected a Box observation space, got {env.observation_space}")
        self.coef = float(coef)
        self.kind = kind
        super().__init__(env)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        observation, info = self.env.reset(seed=seed, options=options)
        self.previous = np.array(observation, dtype=np.float64)
        return observation, info

    def learning_reward(self, observation: Any, reward: float) -> float:
        current = np.array(observation, dtype=np.float64)
        delta = float(np.mean(np.abs(current - self.previous)))
        self.previous = current
        if self.kind == "A":
            return reward + self.coef * (delta - math.log(max(1.0 / (delta + 1e-6), 1e-3)))
        return reward - self.coef * math.log10(1.0 / min(max(delta, 0.1), 10.0))


class StrideBonus(LearningReward):
    """
    Adds a bonus whenever the leg that was behind comes to the front.

    A biped that keeps one leg in front has a safe gait that costs little and is slow: single steps lead from there to gaits
    in which the legs pass each other only by way of falls. This tells them apart from the beginning. Defaults are those of
    BipedalWalker, whose hips have their zeros 0.1 rad apart.

    :param env: environment with a vector as observation
    :param bonus: added reward, in the environment's units
    :param hips: indices of the two hip angles in the observation
    :param offset: first minus second angle with the legs side by side
    :param margin: what the difference must exceed ``offset`` by, in either direction, for a leg to be in front, >= 0:
        legs that tremble side by side earn nothing
    :param per_radian: pay the bonus for each radian by which the other leg has been in front: otherwise many short
        strides, a slow gait, earn more than few wide ones
    :raises ValueError: for a value outside the ranges above
    :raises TypeError: if the observation space is not a Box of one axis, or a value of the wrong type
    """

    def __init__(
        self,
        env: gym.Env,
        bonus: float = 0.5,
        hips: tuple[int, int] = (4, 9),
        offset: float = 0.1,
        margin: float = 0.25,
        per_radian: bool = False,
    ) -> None:
        check_number("bonus", bonus)
        space = env.observation_space
        if not isinstance(space, gym.spaces.Box) or len(space.shape) != 1:
            raise TypeError(f"StrideBonus: expected a Box observation space of one axis, got {space}")
        check_pair("hips", hips, "indices of the hip angles", 0, space.shape[0] - 1, integer=True)
        if hips[0] == hips[1]:
            raise ValueError(f"hips={hips!r}: expected two different indices")
        check_number("offset", offset)
        check_number("margin", margin, 0)
        check_choice("per_radian", per_radian, [False, True])
        self.bonus, self.hips, self.offset, self.margin = float(bonus), hips, float(offset), float(margin)
        self.per_radian = per_radian
        self.in_front: bool | None = None  # whether the first leg was the last one in front
        self.width = 0.0  # the most by which the leg in front has led since it came there, in radians
        super().__init__(env)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        self.in_front, self.width = None, 0.0
        return self.env.reset(seed=seed, options=options)

    def learning_reward(self, observation: Any, reward: float) -> float:
        first, second = self.hips
        lead = float(observation[first]) - float(observation[second]) - self.offset
        if abs(lead) <= self.margin:
            return reward
        before, self.in_front = self.in_front, lead > 0
        if before is (not self.in_front):
            reward += self.bonus * (self.width if self.per_radian else 1.0)
            self.width = 0.0
        self.width = max(self.width, abs(lead))
        return reward


class UnseenGoal(LearningReward):
    """
    An end without a penalty is a truncation to the learner, so that SB3 bootstraps through it; the reward stays.

    Whoever cannot observe how far the goal is sees a walk that ends at random: states of the best gait then seem to be worth
    anything between their value and 0, the more often the faster it is. BipedalWalker's goal lies on ground that looks like
    all other ground, in 10 lidar rays of 5 m. Falls, whose penalty tells them, stay terminations.

    :param env: environment
    :param penalty: ends with this reward or less are terminations, in the environment's units
    :raises ValueError: if it is not finite
    """

    def __init__(self, env: gym.Env, penalty: float = -100.0) -> None:
        check_number("penalty", penalty)
        self.penalty = float(penalty)
        super().__init__(env)

    def step(self, action: Any) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        """
        :param action: action of the environment
        :return: observation, reward, terminated (only with a penalty), truncated (also at the goal), info
        """
        observation, reward, terminated, truncated, info = super().step(action)
        goal = terminated and info["raw_reward"] > self.penalty
        return observation, reward, terminated and not goal, truncated or goal, info

    def learning_reward(self, observation: Any, reward: float) -> float:
        return reward


# ----------------------------------------------------------------------------------------------------------------------
# Changes of the task
# ----------------------------------------------------------------------------------------------------------------------


class EpisodeStepLimit(gym.Wrapper):
    """
    Cuts episodes at ``max_steps`` as long as fewer than ``until_total_steps`` steps were taken in all (a warm-up cut).

    A cut is a truncation, as by Gymnasium's ``TimeLimit``: SB3 bootstraps through it. For training only. With parallel
    environments each counts its own steps.

    If a ``Monitor`` is already there, the limit goes beneath it, so that cut episodes are reported like any other.

    :param env: environment
    :param max_steps: length of the cut episodes, >= 1
    :param until_total_steps: number of steps of this environment after which episodes are left alone, >= 0
    :raises ValueError: for a value outside the ranges above
    """

    def __init__(self, env: gym.Env, max_steps: int, until_total_steps: int) -> None:
        check_number("max_steps", max_steps, 1, integer=True)
        check_number("until_total_steps", until_total_steps, 0, integer=True)
        super().__init__(env)
        self.max_steps = max_steps
        self.until_total_steps = until_total_steps
        self._total_steps = 0
        self._episode_steps = 0
        self._inner: EpisodeStepLimit | None = None
        monitor = unwrap_wrapper(env, Monitor)
        if monitor is not None:
            self._inner = monitor.env = EpisodeStepLimit(monitor.env, max_steps, until_total_steps)

    @property
    def total_steps(self) -> int:
        """Steps taken in all, over all episodes."""
        return self._total_steps if self._inner is None else self._inner.total_steps

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        self._episode_steps = 0
        return self.env.reset(seed=seed, options=options)

    def step(self, action: Any) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        """
        :param action: action of the environment
        :return: observation, reward, terminated, truncated (also where the episode is cut), info
        """
        observation, reward, terminated, truncated, info = self.env.step(action)
        if self._inner is None:
            self._episode_steps += 1
            if self._total_steps < self.until_total_steps and self._episode_steps >= self.max_steps:
                truncated = True
            self._total_steps += 1
        return observation, reward, terminated, truncated, info


class TorsoMass(gym.Wrapper):
    """
    Changes the mass of the body ``torso`` of a MuJoCo environment (Hopper, Walker2d, HalfCheetah, Ant, …).

    A fixed mass holds from the first reset on, over all episodes; with two masses, each episode draws its own between
    them (domain randomisation), which depends on the seed of the reset if there is one. Only the mass changes, not the
    inertia; the constants that MuJoCo derives from masses when it compiles a model are computed anew.

    :param env: MuJoCo environment, such as Hopper-v4 or Hopper-v5
    :param mass: new mass in kg, > 0 (Hopper's own: 3.665); or the lowest and the highest one
    :raises TypeError: if the environment is not a MuJoCo one or has no body named ``torso``
    :raises ValueError: if a mass is not finite and > 0, or the lowest is not below the highest
    """

    def __init__(self, env: gym.Env, mass: float | tuple[float, float]) -> None:
        self.masses = tuple(mass) if isinstance(mass, list | tuple) else (mass,)
        for each in self.masses:
            check_number("mass", each, 0, exclusive=True)  # kg
        if len(self.masses) not in (1, 2) or (len(self.masses) == 2 and not self.masses[0] < self.masses[1]):
            raise ValueError(f"mass={mass!r}: expected a number, or the lowest and the highest mass")
        model: Any = getattr(env.unwrapped, "model", None)
        if not hasattr(model, "body_mass"):
            raise TypeError(f"TorsoMass: {env} is not a MuJoCo environment")
        import mujoco

        self.body = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, "torso")
        if self.body < 0:
            raise TypeError(f"TorsoMass: {env} has no body named 'torso'")
        super().__init__(env)
        self._set(self.masses[0])

    def _set(self, mass: float) -> None:
        import mujoco

        self.mass = float(mass)
        unwrapped: Any = self.env.unwrapped  # a MuJoCo environment
        model = unwrapped.model
        model.body_mass[self.body] = self.mass
        mujoco.mj_setConst(model, mujoco.MjData(model))  # on scratch data: it overwrites the state

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        if len(self.masses) == 2:
            # Before the reset, which computes with the mass; a stream of its own, or it would go with the first observation
            generator = self.np_random if seed is None else np.random.default_rng([seed, self.body])
            self._set(generator.uniform(*self.masses))
        return self.env.reset(seed=seed, options=options)


class LegMass(gym.Wrapper):
    """
    Makes all leg segments of a BipedalWalker heavier or lighter, from the end of each reset on. Shapes stay as they are.

    :param env: BipedalWalker-v3 or BipedalWalkerHardcore-v3
    :param factor: what the density of the legs is multiplied by, > 0
    :raises TypeError: if the environment is not a BipedalWalker
    :raises ValueError: if the factor is not finite and > 0
    """

    def __init__(self, env: gym.Env, factor: float) -> None:
        check_number("factor", factor, 0, exclusive=True)
        if not (_has_box2d_world(env) and type(env.unwrapped).__name__ == "BipedalWalker"):
            raise TypeError(f"LegMass: {env} is not a BipedalWalker")
        super().__init__(env)
        self.factor = float(factor)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        result = self.env.reset(seed=seed, options=options)
        walker: Any = self.env.unwrapped
        for leg in walker.legs:  # bodies that this reset has made
            for fixture in leg.fixtures:
                fixture.density *= self.factor
            leg.ResetMassData()
        return result
