"""Bias of the critics: how far they are from the returns that the policy really gets."""

import copy
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.utils import check_for_correct_spaces, set_random_seed
from stable_baselines3.common.vec_env import VecEnv, unwrap_vec_normalize

from sb3_symphony.common.checks import check_number
from sb3_symphony.common.ensembles import EnsembleCritic
from sb3_symphony.common.generators import generator_states, restore_generators


class QBias(NamedTuple):
    """
    Bias of the critics over state-action pairs, in units of the rewards that are learned from.

    :param normalized_mean: mean bias / abs(mean return); 0 is perfect, > 0 overestimates
    :param normalized_std: standard deviation of the bias / abs(mean return)
    :param mean: mean of Q - return
    :param std: standard deviation of Q - return over the pairs
    :param mean_return: mean Monte-Carlo return of the pairs, with the entropy term if the algorithm has one
    :param n_pairs: number of pairs
    """

    normalized_mean: float
    normalized_std: float
    mean: float
    std: float
    mean_return: float
    n_pairs: int


def monte_carlo_returns(rewards: np.ndarray, bonuses: np.ndarray, gamma: float, last_value: float = 0.0) -> np.ndarray:
    """
    Discounted returns E(t) = r(t) + gamma·(b(t+1) + E(t+1)): a bonus counts from the *next* action on, as in a soft Q.

    :param rewards: shape ``(steps,)``
    :param bonuses: entropy bonus -alpha·log pi(a(t)|s(t)) of each action, shape ``(steps,)``; zeros without entropy term
    :param gamma: discount factor
    :param last_value: b + E after the last step: 0 if the episode terminated there
    :return: shape ``(steps,)``
    """
    returns = np.empty(len(rewards))
    for step in reversed(range(len(rewards))):
        returns[step] = rewards[step] + gamma * last_value
        last_value = bonuses[step] + returns[step]
    return returns


@contextmanager
def _without_a_trace(model: OffPolicyAlgorithm, seed: int) -> Iterator[None]:
    """Inside the block global generators are seeded and networks in evaluation mode; after it all is as before."""
    policy: Any = model.policy
    generators = generator_states()
    modes = {module: module.training for module in policy.modules()}
    distribution = getattr(policy.actor, "action_dist", None)
    if distribution is not None:
        policy.actor.action_dist = copy.copy(distribution)  # it keeps what was drawn last, for gSDE the noise matrix
    set_random_seed(seed)
    policy.set_training_mode(False)
    try:
        yield
    finally:
        for module, mode in modes.items():
            module.training = mode
        if distribution is not None:
            policy.actor.action_dist = distribution
        restore_generators(generators)


def _mean_q(critic: Any, observations: Any, actions: th.Tensor) -> th.Tensor:
    """Mean over all critics, and over all quantiles of TQC, ``(batch,)``."""
    q_values = critic(observations, actions)
    if isinstance(critic, EnsembleCritic):  # (n_critics, batch, 1)
        return q_values.mean(dim=(0, 2))
    if isinstance(q_values, tuple):  # SB3: one (batch, 1) each
        return th.cat(q_values, dim=1).mean(dim=1)
    return q_values.flatten(start_dim=1).mean(dim=1)  # TQC: (batch, n_critics, n_quantiles)


class _Step(NamedTuple):
    action: np.ndarray  # in the environment's units, (1, *action_space.shape)
    q_value: float
    bonus: float


@th.no_grad()
def _act(model: OffPolicyAlgorithm, observation: Any, ent_coef: float) -> _Step:
    """Draw an action as the critics' target does, and value it."""
    policy: Any = model.policy
    actor = policy.actor
    tensor, _ = policy.obs_to_tensor(observation)
    bonus = 0.0
    if hasattr(actor, "action_log_prob"):
        if model.use_sde:
            actor.reset_noise()
        action, log_prob = actor.action_log_prob(tensor)
        bonus = -ent_coef * float(log_prob)
    else:
        action = actor(tensor)
    q_value = float(_mean_q(policy.critic, tensor, action))
    scaled = action.cpu().numpy().reshape(-1, *policy.action_space.shape)
    return _Step(policy.unscale_action(scaled), q_value, bonus)


def _ent_coef(model: Any) -> float:
    if getattr(model, "log_ent_coef", None) is not None:
        return float(model.log_ent_coef.detach().exp())
    return float(getattr(model, "ent_coef_tensor", 0.0))


def _check_model(model: BaseAlgorithm) -> OffPolicyAlgorithm:
    if not (isinstance(model, OffPolicyAlgorithm) and hasattr(model.policy, "actor") and hasattr(model.policy, "critic")):
        raise TypeError(f"model: expected an off-policy actor-critic such as SAC or TD3, got {type(model).__name__}")
    return model


def _prepared(env: gym.Env | VecEnv, model: OffPolicyAlgorithm) -> VecEnv:
    """The environment as the critics know it: vectorised, checked, with the normalisation of training."""
    vec_env: VecEnv = model._wrap_env(env, monitor_wrapper=False)
    check_for_correct_spaces(vec_env, model.observation_space, model.action_space)
    if vec_env.num_envs != 1:
        raise ValueError(f"env: expected one environment, got {vec_env.num_envs}")
    learned, own = model.get_vec_normalize_env(), unwrap_vec_normalize(vec_env)
    if model.env is None and own is not None:  # a loaded model does not tell what it was trained in
        own.training = False
        return vec_env
    if (learned is None) != (own is None):
        need = "VecNormalize around it, as around the training environment" if own is None else "none of VecNormalize"
        raise ValueError(f"env: expected {need}")
    if learned is not None and own is not None:
        for name in ("obs_rms", "ret_rms"):
            if hasattr(learned, name):  # not without normalisation
                setattr(own, name, copy.deepcopy(getattr(learned, name)))
        own.training, own.norm_obs, own.norm_reward = False, learned.norm_obs, learned.norm_reward
    return vec_env


def q_bias(
    model: BaseAlgorithm, env: gym.Env | VecEnv, n_pairs: int = 1000, max_episode_steps: int = 350, seed: int = 0
) -> QBias:
    """
    Measure the bias of a model's critics, as defined for REDQ (Chen et al. 2021, https://arxiv.org/abs/2101.05982).

    Whole episodes are run until ``n_pairs`` state-action pairs are collected, of each episode the first
    ``max_episode_steps``. The bias of a pair is Q - E, with Q the mean over all online critics (for TQC over all quantiles
    of all critics) and E the discounted Monte-Carlo return from that pair on. Both mean and standard deviation of the bias
    are divided by one number, the absolute value of the mean of E over all pairs.

    Actions are those for which the critics are trained: drawn from the policy if it is stochastic (SAC, TQC, CrossQ, REDQ,
    DroQ), without noise if it is deterministic (TD3, DDPG, Symphony); exploration noise never takes part. For stochastic
    policies E contains the entropy bonus of all later actions, E(t) = r(t) + gamma·(E(t+1) - alpha·log pi(a(t+1)|s(t+1))),
    with the current entropy coefficient alpha. Networks are in evaluation mode (no dropout).

    An episode cut by a time limit would have gone on, so its returns end with gamma times the critics' own value of the
    last observation; the original lets them end in zero. With episodes of 1000 steps, 350 of them kept and
    gamma = 0.99, this changes a return by less than 0.2 % of a value.

    Neither the model nor any global random generator is changed.

    :param model: SAC, TD3, DDPG, TQC, CrossQ, Symphony, REDQ, DroQ or a class derived from them
    :param env: environment of its own, with the rewards that are learned from (so with wrappers that transform them) and,
        if the model has it, ``VecNormalize``, whose ``training`` is set to False and whose statistics are copied from training
        (if the model was loaded without its environment they have to be those of training already)
    :param n_pairs: number of pairs after which no further episode is begun
    :param max_episode_steps: number of pairs kept of each episode
    :param seed: seed of environment and actions, so that a model is always measured on the same draws
    :return: the bias
    :raises TypeError: if the model has no actor and critics
    :raises ValueError: if the environment does not fit the model, or a number is out of range
    """
    check_number("n_pairs", n_pairs, 1, integer=True)
    check_number("max_episode_steps", max_episode_steps, 1, integer=True)
    check_number("seed", seed, 0, integer=True)
    model = _check_model(model)
    q_values: list[float] = []
    returns: list[float] = []
    with _without_a_trace(model, seed):
        vec_env = _prepared(env, model)
        ent_coef = _ent_coef(model)
        vec_env.seed(seed)
        observation = vec_env.reset()
        while len(q_values) < n_pairs:
            steps: list[_Step] = []
            rewards: list[float] = []
            done = False
            while not done:
                steps.append(_act(model, observation, ent_coef))
                observation, reward, dones, infos = vec_env.step(steps[-1].action)
                rewards.append(float(reward[0]))
                done = bool(dones[0])
            last_value = 0.0
            if infos[0].get("TimeLimit.truncated", False):
                last = _act(model, infos[0]["terminal_observation"], ent_coef)
                last_value = last.q_value + last.bonus
            bonuses = np.array([step.bonus for step in steps])
            episode_returns = monte_carlo_returns(np.array(rewards), bonuses, model.gamma, last_value)
            q_values += [step.q_value for step in steps[:max_episode_steps]]
            returns += episode_returns[:max_episode_steps].tolist()
    bias = np.array(q_values) - np.array(returns)
    mean, std, mean_return = float(bias.mean()), float(bias.std()), float(np.mean(returns))
    scale = abs(mean_return) or float("nan")
    return QBias(mean / scale, std / scale, mean, std, mean_return, len(bias))


class QBiasCallback(BaseCallback):
    """
    Logs the bias of the critics during training: ``q_bias/normalized_mean``, ``q_bias/normalized_std``, ``q_bias/mean``,
    ``q_bias/std``, ``q_bias/mean_return``. What they mean is defined by :func:`q_bias`.

    Training goes on bit for bit as it would have without it.

    :param eval_env: environment of its own, see :func:`q_bias`
    :param eval_freq: measure every ``eval_freq`` calls of the callback; with several training environments one call is
        ``n_envs`` steps, as in SB3's ``EvalCallback``
    :param n_pairs: number of state-action pairs after which no further episode is begun
    :param max_episode_steps: number of pairs kept of each episode
    :param seed: seed of environment and actions
    :param verbose: 1 prints each measurement
    :raises TypeError: at the start of training, if the algorithm has no actor and critics
    :raises ValueError: if a number is out of range; at the start of training, if the environment does not fit
    """

    def __init__(
        self,
        eval_env: gym.Env | VecEnv,
        eval_freq: int = 10_000,
        n_pairs: int = 1000,
        max_episode_steps: int = 350,
        seed: int = 0,
        verbose: int = 0,
    ) -> None:
        super().__init__(verbose)
        check_number("eval_freq", eval_freq, 1, integer=True)
        check_number("n_pairs", n_pairs, 1, integer=True)
        check_number("max_episode_steps", max_episode_steps, 1, integer=True)
        check_number("seed", seed, 0, integer=True)
        self.eval_env = eval_env
        self.eval_freq = eval_freq
        self.n_pairs = n_pairs
        self.max_episode_steps = max_episode_steps
        self.seed = seed

    def _init_callback(self) -> None:
        model = _check_model(self.model)
        self.eval_env = _prepared(self.eval_env, model)

    def _on_step(self) -> bool:
        if self.n_calls % self.eval_freq == 0:
            bias = q_bias(self.model, self.eval_env, self.n_pairs, self.max_episode_steps, self.seed)
            for key in ("normalized_mean", "normalized_std", "mean", "std", "mean_return"):
                self.logger.record(f"q_bias/{key}", getattr(bias, key))
            self.logger.record("time/total_timesteps", self.num_timesteps, exclude="tensorboard")
            self.logger.dump(self.num_timesteps)  # at the step that was measured, as evaluations are
            if self.verbose >= 1:
                print(
                    f"{self.num_timesteps} steps: normalised Q bias {bias.normalized_mean:+.3f} ± {bias.normalized_std:.3f} "
                    f"({bias.n_pairs} pairs, mean return {bias.mean_return:.4g})"
                )
        return True
