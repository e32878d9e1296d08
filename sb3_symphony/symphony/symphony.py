import inspect
import zlib
from typing import Any, ClassVar, TypeVar

import numpy as np
import torch as th
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, ReplayBufferSamples, Schedule
from stable_baselines3.common.utils import FloatSchedule, update_learning_rate
from torch import nn
from torch.nn import functional as F

from sb3_symphony.common.buffers import FadingDictReplayBuffer, FadingReplayBuffer
from sb3_symphony.common.checks import check_choice, check_number, check_pair
from sb3_symphony.common.ensembles import combine
from sb3_symphony.common.losses import ACTOR_LOSSES
from sb3_symphony.common.moving import Moving, at_step, check_moving, moves
from sb3_symphony.common.noise import DecayingNormalActionNoise
from sb3_symphony.common.off_policy import EnsembleOffPolicyAlgorithm, UpdateLogs, noise_std, update_logs
from sb3_symphony.symphony.policies import Actor, CnnPolicy, MlpPolicy, MultiInputPolicy, SymphonyPolicy

SelfSymphony = TypeVar("SelfSymphony", bound="Symphony")

SATURATED = 1.5  # before the tanh, whose slope there is 0.18


class Symphony(EnsembleOffPolicyAlgorithm):
    """
    Symphony: a deterministic actor without target, the minimum over several critics, Fourier blocks (sine and leaky
    ReLU), rectified Huber losses of batch means, and a replay that fades old transitions out.

    Sources: Read (2024), "Dancing like the Inbetweeners: learning to walk with Symphony"; the author's code (Ishuov),
    https://github.com/timurgepard/Simphony, for all numbers that the paper leaves open (version of February 2024).

    :param policy: The policy model to use (MlpPolicy, CnnPolicy, MultiInputPolicy)
    :param env: The environment to learn from (if registered in Gym, can be str)
    :param learning_rate: Learning rate of the actor's Adam optimizer,
        a value or a function of the current progress remaining (from 1 to 0)
    :param buffer_size: Size of the replay buffer, in transitions
    :param learning_starts: How many steps to collect before learning starts
    :param batch_size: Minibatch size of each gradient update. ``None`` lets it grow with the number ``N`` of stored
        transitions, ``N / 500`` but between 128 and 1024
    :param tau: The soft update coefficient ("Polyak update", between 0 and 1)
    :param gamma: The discount factor
    :param train_freq: Update the model every ``train_freq`` steps, or a tuple like ``(2, "episode")``
    :param gradient_steps: Updates after each rollout; -1: as many as steps were collected. 0 switches all updates off,
        those at an episode's start too.
        With several environments one vector step counts as one: multiply by ``n_envs`` for the same update ratio
    :param action_noise: Exploration noise. ``"default"``: Gaussian with a standard deviation that falls from 0.3 to 0
        along a cosine within 104,720 steps, clipped at 2.5 standard deviations
    :param replay_buffer_class: Replay buffer class; ``None``: one that fades old transitions out
    :param replay_buffer_kwargs: Keyword arguments of the replay buffer, such as ``fade_factor``
    :param optimize_memory_usage: Memory efficient variant of the replay buffer (not of the fading one), see SB3
    :param n_steps: Horizon of n-step returns
    :param critic_learning_rate: Learning rate of the critics' optimizer, likewise a value or a function;
        ``None``: that of the actor
    :param n_critics: Number of independent critics, each with its own target. Read's paper: one is the original
        algorithm, two the enhanced one; the author's code has three
    :param policy_delay: Critic updates per actor update
    :param target_mode: How the critics are combined, in the target and for the actor: ``"min"``, ``"mean"`` or ``"rem"``
    :param min_mix: In mode ``"min"``: weight of the minimum, the rest is on the mean. Two weights: that in the target and that
        for the actor, whose ``(1, 0)`` is REDQ's way. Each may move, from ``a`` at step ``s`` to ``b`` at step ``t``, if it is
        given as ``(a, b, s, t)``: ``((0.5, 1, 15_000, 30_000), 0)`` hopes first and is careful later
    :param target_policy_noise: Standard deviation of Gaussian noise added to the target's actions, to smooth it, clipped at
        2.5 standard deviations (as in TD3; not a part of Symphony, whose sources have none)
    :param saturation_penalty: Weight of Σ max(0, abs(u) - 1.5)² in the actor's loss, u being the action's components before
        the tanh: beyond (actions of 0.9) its gradient vanishes, and what drifted there stays. Smaller actions cost nothing:
        a pull toward zero teaches standing still (not a part of Symphony; Wang et al. 2020, "Striving for Simplicity and
        Performance in Off-Policy DRL", show that this is what SAC's entropy is for)
    :param critic_loss: Error function of the critics: ``"rehe"``, ``"rehe_elementwise"``, ``"huber"`` or ``"mse"``;
        ``"hl_gauss"`` for critics that classify, which need ``policy_kwargs`` with a ``value_range``
    :param actor_loss: Objective of the actor: ``"rehae"``, ``"rehae_elementwise"`` or ``"mean"`` (that of TD3)
    :param initial_gradient_steps: Updates made once when learning starts: with uniform sampling, then with faded
    :param episode_gradient_steps: Additional updates at the start of each episode
    :param warmup_policy: Who acts before learning starts: ``"actor"``, with weights drawn anew for each episode (of several
        environments: whenever one of them ends) as long as they are neither trained nor loaded, or ``"uniform"`` random
        actions
    :param stats_window_size: Number of episodes to average the reported success rate, length and reward over
    :param tensorboard_log: The log location for tensorboard (if None, no logging)
    :param policy_kwargs: Arguments of the policy, see :class:`~sb3_symphony.symphony.policies.SymphonyPolicy`
    :param verbose: 0 for no output, 1 for info messages, 2 for debug messages
    :param seed: Seed for the pseudo random generators
    :param device: Device (cpu, cuda, ...) on which the code should run
    :param _init_setup_model: Whether or not to build the network at the creation of the instance
    :raises ValueError: if an argument is out of range
    :raises TypeError: if an argument has the wrong type
    """

    base_policy = SymphonyPolicy
    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {
        "MlpPolicy": MlpPolicy,
        "CnnPolicy": CnnPolicy,
        "MultiInputPolicy": MultiInputPolicy,
    }
    policy: SymphonyPolicy
    actor: Actor
    default_buffers = (FadingDictReplayBuffer, FadingReplayBuffer, FadingReplayBuffer)
    recorded_attributes = (
        *("tau", "gamma", "target_mode", "target_mix", "actor_mix", "target_policy_noise"),
        *("saturation_penalty", "actor_loss", "baseline"),
    )

    def __init__(
        self,
        policy: str | type[SymphonyPolicy],
        env: GymEnv | str,
        learning_rate: float | Schedule = 3e-4,
        buffer_size: int = 500_000,
        learning_starts: int = 5000,
        batch_size: int | None = None,
        tau: float = 0.003,
        gamma: float = 0.99,
        train_freq: int | tuple[int, str] = 1,
        gradient_steps: int = 3,
        action_noise: ActionNoise | str | None = "default",
        replay_buffer_class: type[ReplayBuffer] | None = None,
        replay_buffer_kwargs: dict[str, Any] | None = None,
        optimize_memory_usage: bool = False,
        n_steps: int = 1,
        critic_learning_rate: float | Schedule | None = 7e-4,
        n_critics: int = 2,
        policy_delay: int = 1,
        target_mode: str = "min",
        min_mix: float | tuple[Moving, Moving] = 1.0,
        target_policy_noise: float = 0.0,
        saturation_penalty: float = 0.0,
        critic_loss: str = "rehe",
        actor_loss: str = "rehae",
        initial_gradient_steps: tuple[int, int] = (64, 64),
        episode_gradient_steps: int = 40,
        warmup_policy: str = "actor",
        stats_window_size: int = 100,
        tensorboard_log: str | None = None,
        policy_kwargs: dict[str, Any] | None = None,
        verbose: int = 0,
        seed: int | None = None,
        device: th.device | str = "auto",
        _init_setup_model: bool = True,
    ) -> None:
        super().__init__(
            policy,
            env,
            learning_rate,
            buffer_size,
            learning_starts,
            batch_size,
            tau,
            gamma,
            train_freq,
            gradient_steps,
            action_noise,
            replay_buffer_class=replay_buffer_class,
            replay_buffer_kwargs=replay_buffer_kwargs,
            optimize_memory_usage=optimize_memory_usage,
            n_steps=n_steps,
            n_critics=n_critics,
            policy_delay=policy_delay,
            target_mode=target_mode,
            critic_loss=critic_loss,
            policy_kwargs=policy_kwargs,
            stats_window_size=stats_window_size,
            tensorboard_log=tensorboard_log,
            verbose=verbose,
            device=device,
            seed=seed,
            sde_support=False,
        )
        self.critic_learning_rate = critic_learning_rate
        self.min_mix = min_mix
        self.target_policy_noise = target_policy_noise
        self.saturation_penalty = saturation_penalty
        self.actor_loss = actor_loss
        self.initial_gradient_steps = initial_gradient_steps
        self.episode_gradient_steps = episode_gradient_steps
        self.warmup_policy = warmup_policy
        self._redraw_actor = True  # an episode begins
        self._drawn_weights: int | None = None  # the actor's, as they were drawn last; in a saved model, too
        self._new_episodes = 0  # begun since the last update

        if _init_setup_model:
            self._setup_model()

    def _check_arguments(self) -> None:
        super()._check_arguments()
        if self.critic_learning_rate is not None and not callable(self.critic_learning_rate):
            check_number("critic_learning_rate", self.critic_learning_rate, 0)
        if len(_pair(self.min_mix)) != 2:
            raise ValueError(f"min_mix={self.min_mix!r}: expected a number, or two (target, actor)")
        for weight in _pair(self.min_mix):
            check_moving("min_mix", weight, 0, 1)
        check_number("target_policy_noise", self.target_policy_noise, 0)
        check_number("saturation_penalty", self.saturation_penalty, 0)
        check_choice("actor_loss", self.actor_loss, ACTOR_LOSSES)
        check_pair("initial_gradient_steps", self.initial_gradient_steps, "uniform, faded", 0, integer=True)
        check_number("episode_gradient_steps", self.episode_gradient_steps, 0, integer=True)
        check_choice("warmup_policy", self.warmup_policy, ("actor", "uniform"))

    def _setup_model(self) -> None:
        if isinstance(self.action_noise, str):
            check_choice("action_noise", self.action_noise, ("default",))
            self.action_noise = DecayingNormalActionNoise(self.action_space.shape)
        super()._setup_model()
        if self._drawn_weights is None:
            self._drawn_weights = self._actor_weights()
        self._mixes = th.zeros(2, device=self.device)
        self._set_mixes()
        # Mean value at the previous update, which the actor's loss compares with
        self.baseline = th.zeros((), device=self.device)

    def _setup_lr_schedule(self) -> None:
        super()._setup_lr_schedule()
        rate = self.learning_rate if self.critic_learning_rate is None else self.critic_learning_rate
        self.critic_lr_schedule = FloatSchedule(rate)

    def train(self, gradient_steps: int, batch_size: int | None = None) -> None:
        # Switch to train mode (this affects dropout)
        self.policy.set_training_mode(True)
        self._set_mixes()
        self._update_learning_rate(self.actor.optimizer)
        update_learning_rate(self.critic.optimizer, self.critic_lr_schedule(self._current_progress_remaining))

        assert self.replay_buffer is not None
        stored = self.replay_buffer.size() * self.n_envs
        batch_size = batch_size or min(max(stored // 500, 128), 1024)

        logs = update_logs()
        if self._n_updates == 0:
            uniform, faded = self.initial_gradient_steps
            # Buffers without fading are uniform, and one's own draw as they do
            fades = "uniform" in inspect.signature(type(self.replay_buffer).sample).parameters
            self._update(uniform, batch_size, logs, **({"uniform": True} if fades else {}))
            self._update(faded, batch_size, logs)
        self._update(gradient_steps + self._new_episodes * self.episode_gradient_steps, batch_size, logs)
        self._new_episodes = 0
        self.logger.record("train/batch_size", batch_size)
        self._log_update(logs, noise_std(self.action_noise))

    def _set_mixes(self) -> None:
        """Weights of the minimum, in the target and for the actor, at the present step: in one place if they move."""
        self.target_mix, self.actor_mix = (
            place.fill_(at_step(mix, self.num_timesteps)) if moves(mix) else mix
            for mix, place in zip(_pair(self.min_mix), self._mixes, strict=True)
        )

    def _learn_from(self, segment: ReplayBufferSamples, batches: list[ReplayBufferSamples], logs: UpdateLogs) -> None:
        # The actor is frozen inside a segment: one forward pass gives all its next actions
        with th.no_grad():
            next_actions = self.actor(segment.next_observations)
            if self.target_policy_noise > 0:
                noise = self.target_policy_noise * th.randn_like(next_actions).clamp(-2.5, 2.5)
                next_actions = (next_actions + noise).clamp(-1, 1)

        for batch, next_action in zip(batches, next_actions.chunk(len(batches)), strict=True):
            with th.no_grad():
                # The online actor; minimum over the critics: (n_critics, batch, 1) -> (batch, 1)
                next_q_values = self._regression.target_q_values(batch.next_observations, next_action)
                next_values = combine(next_q_values, self.target_mode, self.target_mix)
                target = batch.rewards + (1 - batch.dones) * self._discounts(batch) * next_values

            # The author moves the target critics before he computes the target; moving them right after the
            # critics' step, as here, gives the same numbers
            self._fit_critics(batch, target, logs)

        if self._n_updates % self.policy_delay == 0:
            self._update_actor(batches[-1], logs)
            self.policy.average_actor()

    def _update_actor(self, batch: ReplayBufferSamples, logs: UpdateLogs) -> None:
        """One step of the actor."""
        before_tanh = self.actor.before_tanh(batch.observations)  # (batch, n_actions)
        q_values = self._actor_values(self._regression.q_values(batch.observations, th.tanh(before_tanh)))
        actor_loss = -ACTOR_LOSSES[self.actor_loss](q_values, self.baseline)
        if self.saturation_penalty > 0:
            excess = F.relu(before_tanh.abs() - SATURATED)  # (batch, n_actions)
            actor_loss = actor_loss + self.saturation_penalty * excess.square().sum(dim=1).mean()
        self._step_actor(actor_loss)

        value = q_values.detach().mean()
        logs["actor_loss"].append(actor_loss.detach())
        logs["actor_value"].append(value)
        logs["advantage"].append(value - self.baseline)
        self.baseline.copy_(value)

    def _actor_values(self, q_values: th.Tensor) -> th.Tensor:
        """What the actor goes toward: the critics combined, ``(n_critics, batch, 1) -> (batch, 1)``."""
        return combine(q_values, self.target_mode, self.actor_mix)

    def _sample_action(
        self, learning_starts: int, action_noise: ActionNoise | None = None, n_envs: int = 1
    ) -> tuple[np.ndarray, np.ndarray]:
        if self.warmup_policy == "actor" and self.num_timesteps < learning_starts:
            if self._redraw_actor:
                self._redraw_actor = False
                # Never one that was trained, here or elsewhere: its weights are no longer those that were drawn
                if self._actor_weights() == self._drawn_weights:
                    self.actor.redraw()
                    self._drawn_weights = self._actor_weights()
                    self.policy.restart_average()
            learning_starts = 0  # the actor acts, with noise
        return super()._sample_action(learning_starts, action_noise, n_envs)

    def start_anew(self) -> None:
        super().start_anew()
        self._redraw_actor = True

    def _actor_weights(self) -> int:
        """Checksum, the same on every device."""
        return zlib.crc32(nn.utils.parameters_to_vector(self.actor.mu.parameters()).detach().cpu().numpy().tobytes())

    def _store_transition(self, replay_buffer: ReplayBuffer, buffer_action: np.ndarray, *args: Any) -> None:
        super()._store_transition(replay_buffer, buffer_action, *args)
        dones = args[2]
        if dones.any():
            self._redraw_actor = True
            if self.num_timesteps > self.learning_starts and self.gradient_steps != 0:
                self._new_episodes += int(dones.sum())

    def learn(
        self: SelfSymphony,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int = 4,
        tb_log_name: str = "Symphony",
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> SelfSymphony:
        return super().learn(total_timesteps, callback, log_interval, tb_log_name, reset_num_timesteps, progress_bar)

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "_mixes", "target_mix", "actor_mix"]  # made again from min_mix

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        state_dicts, tensors = super()._get_torch_save_params()
        return state_dicts, [*tensors, "baseline"]


def _pair(value: Any) -> Any:
    """``min_mix`` as two weights: in the target and for the actor."""
    return value if isinstance(value, (tuple, list)) else (value, value)
