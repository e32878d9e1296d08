"""Callbacks that follow what training episodes return."""

from collections import deque
from typing import Any

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.noise import VectorizedActionNoise
from stable_baselines3.common.type_aliases import Schedule
from stable_baselines3.common.utils import FloatSchedule
from stable_baselines3.common.vec_env import VecMonitor, is_vecenv_wrapped

from sb3_symphony.common.checks import check_number, check_pair
from sb3_symphony.common.noise import StickyActionNoise
from sb3_symphony.common.off_policy import ActsGreedily


class _OnReturn(BaseCallback):
    """
    Something that depends on the mean return of recent training episodes. These are kept in the model and saved with it: a
    resumed training goes on alike.

    :param returns: two mean returns at which it changes, or between them, in the environment's units
    :param n_episodes: how many episodes are recent
    :param verbose: see SB3
    :raises ValueError: if a number is out of range or returns do not rise; at the start of training, if the model keeps fewer
        episodes (``stats_window_size``), or nothing tells what they return (no ``Monitor``, no ``VecMonitor``)
    """

    def __init__(self, returns: tuple[float, float], n_episodes: int, verbose: int) -> None:
        super().__init__(verbose)
        check_pair("returns", returns, "where the change begins, where it ends")
        if not returns[0] < returns[1]:
            raise ValueError(f"returns={returns!r}: expected the smaller number first")
        check_number("n_episodes", n_episodes, 1, integer=True)
        self.returns = returns
        self.n_episodes = n_episodes

    def _init_callback(self) -> None:
        kept = self.model._stats_window_size
        if self.n_episodes > kept:
            raise ValueError(f"n_episodes={self.n_episodes!r}: expected at most the model's stats_window_size, {kept}")
        env = self.training_env
        if not is_vecenv_wrapped(env, VecMonitor) and not all(env.env_is_wrapped(Monitor)):
            raise ValueError(f"{type(self).__name__}: expected an environment with a Monitor, which tells returns")

    def _on_step(self) -> bool:
        if (recent := self._recent()) is not None:
            self._follow(recent)
        return True

    def _follow(self, recent: float) -> None:
        """Set what depends on the mean return of recent episodes."""

    def _recent(self, *latest: float) -> float | None:
        """The mean return, ``None`` before there are as many; ``latest`` is one that the model has not noted yet."""
        noted = self.model.ep_info_buffer or ()
        n_noted = self.n_episodes - len(latest)
        if len(noted) < n_noted:
            return None
        return float(np.mean([*latest, *(noted[-k]["r"] for k in range(1, n_noted + 1))]))


class QuietOnReturn(_OnReturn):
    """
    Sets the independent part of :class:`~sb3_symphony.common.noise.StickyActionNoise` by what training episodes return:
    who does not walk yet needs more of it than who does, whenever that is.

    Between the two returns it is interpolated. What it is set to is kept in the noise and in the model's list of recent
    episodes, both saved with the model: a resumed training goes on alike.

    :param returns: mean return of recent training episodes at which noise begins to fall, and at which it has fallen, in
        the environment's units
    :param independent: standard deviations there, in scaled action units, >= 0
    :param n_episodes: how many episodes are recent; before there are as many, noise is left as it is
    :param verbose: see SB3
    :raises TypeError: at the start of training, if the model's action noise is no ``StickyActionNoise``
    :raises ValueError: if a number is out of range or returns do not rise; at the start of training, if the model keeps fewer
        episodes (``stats_window_size``)
    """

    def __init__(
        self,
        returns: tuple[float, float],
        independent: tuple[float, float] = (0.2, 0.05),
        n_episodes: int = 5,
        verbose: int = 0,
    ) -> None:
        super().__init__(returns, n_episodes, verbose)
        check_pair("independent", independent, "before, after", 0)
        self.independent = independent

    def _noises(self) -> list[StickyActionNoise]:
        noise: Any = getattr(self.model, "action_noise", None)
        noises: list[Any] = noise.noises if isinstance(noise, VectorizedActionNoise) else [noise]
        for each in noises:
            if not isinstance(each, StickyActionNoise):
                raise TypeError(f"action_noise={each}: expected a StickyActionNoise, or no QuietOnReturn among the callbacks")
        return noises

    def _init_callback(self) -> None:
        super()._init_callback()
        self._noises()

    def _follow(self, recent: float) -> None:
        for noise in self._noises():
            noise.independent = float(np.interp(recent, self.returns, self.independent))


class _ScaledSchedule:
    """A learning rate's schedule times a factor."""

    def __init__(self, schedule: Schedule, factor: float) -> None:
        self.schedule = schedule
        self.factor = factor

    def __call__(self, progress_remaining: float) -> float:
        return self.factor * self.schedule(progress_remaining)


class SlowOnReturn(_OnReturn):
    """
    Scales an algorithm's learning rates by what training episodes return: large ones find a gait soon, small ones keep who
    has one on its feet, whenever that is.

    All rates are scaled alike, each from what the model was given (a number or a schedule); between the two returns the
    factor is interpolated geometrically. Any algorithm of SB3, SB3-Contrib and this package can be slowed.

    :param returns: mean return of recent training episodes at which rates begin to fall, and at which they have fallen, in
        the environment's units
    :param factors: what rates are multiplied with there, > 0
    :param n_episodes: how many episodes are recent; before there are as many, rates are left as they are
    :param verbose: see SB3
    :raises ValueError: if a number is out of range or returns do not rise; at the start of training, if the model keeps fewer
        episodes (``stats_window_size``)
    """

    def __init__(
        self,
        returns: tuple[float, float],
        factors: tuple[float, float] = (1.0, 0.2),
        n_episodes: int = 5,
        verbose: int = 0,
    ) -> None:
        super().__init__(returns, n_episodes, verbose)
        check_pair("factors", factors, "before, after", 0, exclusive=True)
        self.factors = factors

    def _on_training_start(self) -> None:
        self.model._setup_lr_schedule()  # not as an earlier training has left them

    def _on_training_end(self) -> None:
        self.model._setup_lr_schedule()

    def _follow(self, recent: float) -> None:
        factor = float(np.exp(np.interp(recent, self.returns, np.log(self.factors))))
        self.model._setup_lr_schedule()  # as they were given
        for name in ("lr_schedule", "critic_lr_schedule"):  # Symphony's critics have their own
            if hasattr(self.model, name):
                setattr(self.model, name, FloatSchedule(_ScaledSchedule(getattr(self.model, name), factor)))


class EntropyOnReturn(_OnReturn):
    """
    Sets the target entropy of algorithms that learn their entropy coefficient (SAC, TQC, CrossQ, REDQ, DroQ) by what training
    episodes return. Who acts at random has to walk in a way that bears it, which is a slow one; who walks already may be
    precise, and gets faster.

    Between the two returns it is interpolated. It is kept in the model: a resumed training goes on alike.

    :param returns: mean return of recent training episodes at which the target begins to change, and at which it has changed,
        in the environment's units
    :param target_entropies: target entropies there, in nats (SAC's own: minus the number of actions)
    :param n_episodes: how many episodes are recent; before there are as many, the target is left as it is
    :param verbose: see SB3
    :raises TypeError: at the start of training, if the model does not learn an entropy coefficient
    :raises ValueError: if a number is out of range or returns do not rise; at the start of training, if the model keeps fewer
        episodes (``stats_window_size``)
    """

    def __init__(
        self,
        returns: tuple[float, float],
        target_entropies: tuple[float, float],
        n_episodes: int = 5,
        verbose: int = 0,
    ) -> None:
        super().__init__(returns, n_episodes, verbose)
        check_pair("target_entropies", target_entropies, "before, after")
        self.target_entropies = target_entropies

    def _init_callback(self) -> None:
        super()._init_callback()
        if getattr(self.model, "ent_coef_optimizer", None) is None:
            kind = type(self.model).__name__
            raise TypeError(f"model: expected one that learns its ent_coef, such as SAC with ent_coef='auto', got {kind}")

    def _follow(self, recent: float) -> None:
        model: Any = self.model
        model.target_entropy = float(np.interp(recent, self.returns, self.target_entropies))


class GreedyEpisodes(_OnReturn):
    """
    Lets training episodes act as evaluations do: with the deterministic action, of the averaged actor if there is one, and
    without noise. So the agent meets its own mistakes, and episodes get long as soon as it can walk.

    Who only falls so far learns more from noise, and has no greedy episodes: how many of them follow each noisy one depends
    on what recent episodes return. One that cannot walk may also stand still for a whole episode, which teaches nothing. With
    ``stall_reward`` noise comes back for the rest of an episode once its latest ``stall_steps`` rewards average less.

    :param returns: mean return of recent training episodes from which on there are greedy ones, and from which on there are
        more, in the environment's units
    :param in_row: how many greedy ones follow each noisy one there
    :param stall_reward: mean reward below which an episode is not greedy any more, in the environment's units; ``None``: it
        is to its end
    :param stall_steps: number of rewards it is the mean of
    :param n_episodes: how many episodes are recent; before there are as many, none is greedy
    :param verbose: see SB3
    :raises TypeError: if a number is none; at the start of training, if the model has no greedy episodes (those of this
        package have, others with :class:`~sb3_symphony.common.off_policy.ActsGreedily`)
    :raises ValueError: if a number is out of range or returns do not rise; at the start of training, if the model keeps fewer
        episodes (``stats_window_size``)
    """

    def __init__(
        self,
        returns: tuple[float, float],
        in_row: tuple[int, int] = (1, 3),
        stall_reward: float | None = None,
        stall_steps: int = 100,
        n_episodes: int = 5,
        verbose: int = 0,
    ) -> None:
        super().__init__(returns, n_episodes, verbose)
        check_pair("in_row", in_row, "from the first return, from the second", 0, integer=True)
        if stall_reward is not None:
            check_number("stall_reward", stall_reward)
        check_number("stall_steps", stall_steps, 1, integer=True)
        self.in_row = in_row
        self.stall_reward = stall_reward
        self.stall_steps = int(stall_steps)  # deques take no number of NumPy
        # Of each environment the latest rewards of its episode, how many greedy episodes there were in a row, and whether
        # it acts greedily now
        self.rewards: list[deque[float]] = []
        self.row: list[int] = []
        self.greedy = np.zeros(0, dtype=bool)  # (n_envs,)

    def _init_callback(self) -> None:
        super()._init_callback()
        if not isinstance(self.model, ActsGreedily):
            raise TypeError(f"model: expected one with greedy episodes, such as Symphony, got {type(self.model).__name__}")

    def _on_training_start(self) -> None:
        model: Any = self.model
        unknown = self.num_timesteps == 0 or len(self.row) != self.training_env.num_envs
        if unknown:
            self.row = [0] * self.training_env.num_envs
        if unknown or model.resets_envs:
            self.start_anew()
        model.greedy_envs = self.greedy

    def start_anew(self) -> None:
        """Episodes begin that none has ended before: they are of the kind that those given up were meant to be."""
        model: Any = self.model
        self.rewards = [deque(maxlen=self.stall_steps) for _ in self.row]
        self.greedy = np.array(self.row) > 0
        model.greedy_envs = self.greedy

    def _on_step(self) -> bool:
        model: Any = self.model
        normalized = model.get_vec_normalize_env()
        rewards = self.locals["rewards"] if normalized is None else normalized.get_original_reward()
        steps = zip(rewards, self.locals["dones"], self.locals["infos"], strict=True)
        for i, (reward, done, info) in enumerate(steps):
            self.rewards[i].append(float(info.get("raw_reward", reward)))
            if done:
                self.rewards[i].clear()
                wanted = self._wanted(info) if model.num_timesteps >= model.learning_starts else 0
                self.row[i] = self.row[i] + 1 if self.row[i] < wanted else 0
                self.greedy[i] = self.row[i] > 0
            elif self.stall_reward is not None and len(self.rewards[i]) == self.stall_steps:
                self.greedy[i] &= np.mean(self.rewards[i]) >= self.stall_reward
        model.greedy_envs = self.greedy
        return True

    def _wanted(self, info: dict[str, Any]) -> int:
        """How many greedy episodes there may be in a row, once one has ended with ``info``."""
        ended = [info["episode"]["r"]] if "episode" in info else []
        recent = self._recent(*ended)
        if recent is None or recent < self.returns[0]:
            return 0
        return self.in_row[recent >= self.returns[1]]
