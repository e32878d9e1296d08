from typing import Any, ClassVar, TypeVar

import numpy as np
import torch as th
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.preprocessing import get_action_dim
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, ReplayBufferSamples, Schedule
from stable_baselines3.sac.policies import Actor

from sb3_symphony.common.checks import check_number
from sb3_symphony.common.ensembles import combine
from sb3_symphony.common.off_policy import EnsembleOffPolicyAlgorithm, UpdateLogs, update_logs
from sb3_symphony.redq.policies import CnnPolicy, MlpPolicy, MultiInputPolicy, REDQPolicy

SelfREDQ = TypeVar("SelfREDQ", bound="REDQ")

# Target entropies of the MBPO paper, which the authors of REDQ use by default; other environments: minus the dimension
MBPO_TARGET_ENTROPY = {"Hopper": -1.0, "HalfCheetah": -3.0, "Walker2d": -3.0, "Ant": -4.0, "Humanoid": -2.0}


class REDQ(EnsembleOffPolicyAlgorithm):
    """
    Randomized Ensembled Double Q-Learning (REDQ): SAC with many updates per step, an ensemble of critics, and targets
    that take the minimum over a random subset of them.

    Paper: https://arxiv.org/abs/2101.05982
    Original implementation: https://github.com/watchernyu/REDQ
    Differences from it, of one optimiser step each: the actor follows the critics *after* their step (as in SB3), and
    the temperature really starts at the value that is used (the original starts at 0.2 and jumps to 1).

    :param policy: The policy model to use (MlpPolicy, CnnPolicy, MultiInputPolicy)
    :param env: The environment to learn from (if registered in Gym, can be str)
    :param learning_rate: Learning rate of all Adam optimizers (critics, actor and entropy coefficient),
        a value or a function of the current progress remaining (from 1 to 0)
    :param buffer_size: Size of the replay buffer, in transitions
    :param learning_starts: How many steps of random actions to collect before learning starts
    :param batch_size: Minibatch size of each gradient update
    :param tau: The soft update coefficient ("Polyak update", between 0 and 1), applied after every critic update
    :param gamma: The discount factor
    :param train_freq: Update the model every ``train_freq`` steps, or a tuple like ``(2, "episode")``
    :param gradient_steps: Critic updates after each rollout (``G`` in the paper); -1: as many as steps were collected.
        With several environments one vector step counts as one: multiply by ``n_envs`` for the same update ratio
    :param action_noise: Noise added to the stochastic policy's actions (none by default)
    :param replay_buffer_class: Replay buffer class, selected automatically if ``None``
    :param replay_buffer_kwargs: Keyword arguments of the replay buffer
    :param optimize_memory_usage: Memory efficient variant of the replay buffer, see SB3
    :param n_steps: Horizon of n-step returns
    :param n_critics: Number of critics (``N`` in the paper)
    :param subset_size: Size of the random subset in the target (``M``). A fraction is a random size: 1.5 means 1 or 2
        with equal probability. ``"all"`` takes the minimum over all critics
    :param policy_delay: Critic updates per update of the actor and the entropy coefficient
    :param target_mode: How the target combines the critics: ``"min"`` over the subset, ``"mean"`` over all, or ``"rem"``,
        a random convex combination of all
    :param critic_loss: Error function of the critics: ``"mse"``, ``"huber"``, ``"rehe"`` or ``"rehe_elementwise"``;
        ``"hl_gauss"`` for critics that classify, which need ``policy_kwargs`` with a ``value_range``
    :param critic_reduction: ``"independent"``: every critic fits the target; ``"ensemble_mean"``: their mean does
    :param ent_coef: Entropy regularization coefficient. ``"auto"`` learns it (``"auto_0.1"``: starting from 0.1;
        a loaded model goes on from what it had learned)
    :param target_entropy: Target entropy when learning ``ent_coef``: a number, ``"auto"`` (minus the action dimension) or
        ``"mbpo"`` (the table the authors use for MuJoCo environments)
    :param use_sde: Whether to use generalized State Dependent Exploration (gSDE)
    :param sde_sample_freq: Sample a new noise matrix every n steps when using gSDE (-1: only at a rollout's start)
    :param use_sde_at_warmup: Whether to use gSDE instead of uniform sampling before learning starts
    :param stats_window_size: Number of episodes to average the reported success rate, length and reward over
    :param tensorboard_log: The log location for tensorboard (if None, no logging)
    :param policy_kwargs: Arguments of the policy, see :class:`~sb3_symphony.redq.policies.REDQPolicy`
    :param verbose: 0 for no output, 1 for info messages, 2 for debug messages
    :param seed: Seed for the pseudo random generators
    :param device: Device (cpu, cuda, ...) on which the code should run
    :param _init_setup_model: Whether or not to build the network at the creation of the instance
    :raises ValueError: if an argument is out of range
    :raises TypeError: if an argument has the wrong type
    """

    base_policy = REDQPolicy
    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {
        "MlpPolicy": MlpPolicy,
        "CnnPolicy": CnnPolicy,
        "MultiInputPolicy": MultiInputPolicy,
    }
    policy: REDQPolicy
    actor: Actor

    def __init__(
        self,
        policy: str | type[REDQPolicy],
        env: GymEnv | str,
        learning_rate: float | Schedule = 3e-4,
        buffer_size: int = 1_000_000,
        learning_starts: int = 5000,
        batch_size: int = 256,
        tau: float = 0.005,
        gamma: float = 0.99,
        train_freq: int | tuple[int, str] = 1,
        gradient_steps: int = 20,
        action_noise: ActionNoise | None = None,
        replay_buffer_class: type[ReplayBuffer] | None = None,
        replay_buffer_kwargs: dict[str, Any] | None = None,
        optimize_memory_usage: bool = False,
        n_steps: int = 1,
        n_critics: int = 10,
        subset_size: int | float | str = 2,
        policy_delay: int = 20,
        target_mode: str = "min",
        critic_loss: str = "mse",
        critic_reduction: str = "independent",
        ent_coef: str | float = "auto",
        target_entropy: str | float = "auto",
        use_sde: bool = False,
        sde_sample_freq: int = -1,
        use_sde_at_warmup: bool = False,
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
            critic_reduction=critic_reduction,
            policy_kwargs=policy_kwargs,
            stats_window_size=stats_window_size,
            tensorboard_log=tensorboard_log,
            verbose=verbose,
            device=device,
            seed=seed,
            use_sde=use_sde,
            sde_sample_freq=sde_sample_freq,
            use_sde_at_warmup=use_sde_at_warmup,
        )
        self.subset_size = subset_size
        self.ent_coef = ent_coef
        self.target_entropy = target_entropy
        self.log_ent_coef: th.Tensor | None = None
        self._learns_ent_coef: bool | None = None  # in a saved model
        self.ent_coef_optimizer: th.optim.Adam | None = None

        if _init_setup_model:
            self._setup_model()

    def _check_arguments(self) -> None:
        super()._check_arguments()
        check_number("batch_size", self.batch_size, 1, integer=True)
        if self.subset_size != "all":
            check_number("subset_size", self.subset_size, 1)
            if self.target_mode == "min" and float(self.subset_size) > self.n_critics:
                raise ValueError(f"subset_size={self.subset_size!r}: expected at most n_critics={self.n_critics}")

    def _setup_model(self) -> None:
        super()._setup_model()
        self.target_entropy = self._resolve_target_entropy()
        learned = False
        initial: float | None
        if isinstance(self.ent_coef, str):
            kind, _, start = self.ent_coef.partition("_")
            learned = kind == "auto"
            initial = _number((start or "1") if learned else self.ent_coef)
        else:
            initial = self.ent_coef
        if initial is None:
            raise ValueError(f"ent_coef={self.ent_coef!r}: expected a number, 'auto' or 'auto_<initial value>'")
        check_number("ent_coef", initial, 0, exclusive=learned)
        if self._learns_ent_coef not in (None, learned):
            saved = "a fixed one" if learned else "a learned one"
            raise ValueError(f"ent_coef={self.ent_coef!r}: the saved model has {saved}")
        self._learns_ent_coef = learned
        if learned:
            # The log is optimised, as in SB3
            self.log_ent_coef = th.full((1,), np.log(initial), device=self.device, dtype=th.float32).requires_grad_()
            self.ent_coef_optimizer = th.optim.Adam([self.log_ent_coef], lr=self.lr_schedule(1), fused=True)
        else:
            self.ent_coef_tensor = th.tensor(float(initial), device=self.device)

    def _resolve_target_entropy(self) -> float:
        if self.target_entropy == "mbpo":
            if self.env is None:
                raise ValueError("target_entropy='mbpo': expected an env, whose name it depends on")
            spec = self.env.get_attr("spec")[0]
            name = spec.id.rpartition("/")[2].partition("-")[0] if spec is not None else ""
            return MBPO_TARGET_ENTROPY.get(name, -float(get_action_dim(self.action_space)))
        if self.target_entropy == "auto":
            return -float(get_action_dim(self.action_space))
        value = _number(self.target_entropy) if isinstance(self.target_entropy, str) else self.target_entropy
        if value is None:
            raise ValueError(f"target_entropy={self.target_entropy!r}: expected a number, 'auto' or 'mbpo'")
        check_number("target_entropy", value)
        return float(value)

    def train(self, gradient_steps: int, batch_size: int = 256) -> None:
        # Switch to train mode (this affects dropout, in the targets too)
        self.policy.set_training_mode(True)
        optimizers = [self.actor.optimizer, self.critic.optimizer]
        if self.ent_coef_optimizer is not None:
            optimizers.append(self.ent_coef_optimizer)
        self._update_learning_rate(optimizers)

        if gradient_steps == 0:
            return
        logs = update_logs()
        self._update(gradient_steps, batch_size, logs)

        action_dist = self.actor.action_dist
        self._log_update(logs, noise_std=action_dist.distribution.stddev.detach().mean())
        for name in ("distribution", "gaussian_actions", "_latent_sde"):
            if hasattr(action_dist, name):
                setattr(action_dist, name, None)  # they hold the last graph, with which a policy cannot be copied

    def _learn_from(self, segment: ReplayBufferSamples, batches: list[ReplayBufferSamples], logs: UpdateLogs) -> None:
        # The actor and the temperature are frozen inside a segment: one forward pass gives all its next actions
        with th.no_grad():
            if self.use_sde:
                self.actor.reset_noise()
            ent_coef = self._current_ent_coef()
            next_actions, next_log_probs = self.actor.action_log_prob(segment.next_observations)
            entropies = -ent_coef * next_log_probs

        n = len(batches)
        for batch, next_action, entropy in zip(batches, next_actions.chunk(n), entropies.chunk(n), strict=True):
            with th.no_grad():
                # Minimum over the subset, one draw for the whole batch: (subset_size, batch, 1) -> (batch, 1)
                next_q_values = self._regression.target_q_values(batch.next_observations, next_action, self._draw_subset())
                next_values = combine(next_q_values, self.target_mode) + entropy.reshape(-1, 1)
                target = batch.rewards + (1 - batch.dones) * self._discounts(batch) * next_values
            self._fit_critics(batch, target, logs)

        if self._n_updates % self.policy_delay == 0:
            self._update_actor(batches[-1], ent_coef, logs)
            self.policy.average_actor()

    def _update_actor(self, batch: ReplayBufferSamples, ent_coef: th.Tensor, logs: UpdateLogs) -> None:
        """One step of the actor, then one of the entropy coefficient."""
        if self.use_sde:
            self.actor.reset_noise()
        actions, log_prob = self.actor.action_log_prob(batch.observations)
        log_prob = log_prob.reshape(-1, 1)
        q_values = self._actor_values(self._regression.q_values(batch.observations, actions))
        actor_loss = (ent_coef * log_prob - q_values).mean()
        self._step_actor(actor_loss)
        logs["actor_loss"].append(actor_loss.detach())
        logs["ent_coef"].append(ent_coef.mean())

        if self.ent_coef_optimizer is not None and self.log_ent_coef is not None:
            ent_coef_loss = -(self.log_ent_coef * (log_prob + float(self.target_entropy)).detach()).mean()
            self.ent_coef_optimizer.zero_grad()
            ent_coef_loss.backward()
            self.ent_coef_optimizer.step()
            logs["ent_coef_loss"].append(ent_coef_loss.detach())

    def _actor_values(self, q_values: th.Tensor) -> th.Tensor:
        """What the actor goes toward: the mean of all critics, ``(n_critics, batch, 1) -> (batch, 1)``."""
        return q_values.mean(dim=0)

    def _current_ent_coef(self) -> th.Tensor:
        return self.ent_coef_tensor if self.log_ent_coef is None else self.log_ent_coef.detach().exp()

    def _draw_subset(self) -> list[int] | None:
        """Indices of the critics in the target; ``None`` stands for all of them."""
        if self.target_mode != "min" or self.subset_size in ("all", self.n_critics):
            return None
        size = int(self.subset_size)
        size += int(np.random.random() < float(self.subset_size) - size)
        return None if size == self.n_critics else np.random.permutation(self.n_critics)[:size].tolist()

    def learn(
        self: SelfREDQ,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int = 4,
        tb_log_name: str = "REDQ",
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> SelfREDQ:
        return super().learn(total_timesteps, callback, log_interval, tb_log_name, reset_num_timesteps, progress_bar)

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "ent_coef_tensor"]  # which belongs to a device; made again from ent_coef

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        state_dicts, tensors = super()._get_torch_save_params()
        if self.ent_coef_optimizer is None:  # fixed: it is an argument, which may be replaced when loading
            return state_dicts, tensors
        return [*state_dicts, "ent_coef_optimizer"], [*tensors, "log_ent_coef"]


def _number(text: str) -> float | None:
    try:
        return float(text)
    except ValueError:
        return None
