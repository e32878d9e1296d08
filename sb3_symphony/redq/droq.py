from typing import Any, TypeVar

import torch as th
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, Schedule

from sb3_symphony.redq.policies import REDQPolicy
from sb3_symphony.redq.redq import REDQ

SelfDroQ = TypeVar("SelfDroQ", bound="DroQ")


class DroQ(REDQ):
    """
    Dropout Q-Functions (DroQ): REDQ with two critics that have dropout and LayerNorm instead of an ensemble of ten.

    Paper: https://arxiv.org/abs/2110.02034
    ``policy_kwargs`` default to ``dropout_rate=0.01, layer_norm=True``; dropout is active in the targets too. All
    arguments are those of :class:`~sb3_symphony.redq.redq.REDQ`.

    :param n_critics: Number of critics
    :param subset_size: Size of the random subset in the target
    """

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
        n_critics: int = 2,
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
            replay_buffer_class,
            replay_buffer_kwargs,
            optimize_memory_usage,
            n_steps,
            n_critics,
            subset_size,
            policy_delay,
            target_mode,
            critic_loss,
            critic_reduction,
            ent_coef,
            target_entropy,
            use_sde,
            sde_sample_freq,
            use_sde_at_warmup,
            stats_window_size,
            tensorboard_log,
            policy_kwargs,
            verbose,
            seed,
            device,
            _init_setup_model,
        )

    def _setup_model(self) -> None:
        # Here, as load() may have been given policy_kwargs of one's own
        self.policy_kwargs = {"dropout_rate": 0.01, "layer_norm": True, **self.policy_kwargs}
        super()._setup_model()

    def learn(
        self: SelfDroQ,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int = 4,
        tb_log_name: str = "DroQ",
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> SelfDroQ:
        return super().learn(total_timesteps, callback, log_interval, tb_log_name, reset_num_timesteps, progress_bar)
