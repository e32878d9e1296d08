"""What a run must keep to for its numbers to stand beside those of others: ``train --protocol standard``."""

from importlib import import_module

import gymnasium as gym
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm

from sb3_symphony.experiment.config import ConfigError, RunConfig, TrainOptions
from sb3_symphony.experiment.environment import REWARD_WRAPPERS, find_wrapper
from sb3_symphony.experiment.registry import load_algorithm

#: environment steps between evaluations; once the environment is solved only every fourth of them takes place
EVAL_FREQ, SOLVED_STRIDE = 2_500, 4
#: the same for on-policy algorithms, which learn in longer strides, before and after
ON_POLICY_EVAL_FREQ = 25_000
#: episodes of an evaluation, on environment seeds 10 000 … 10 009
EVAL_EPISODES = 10


def reward_threshold(env_id: str) -> float | None:
    """
    :param env_id: registered id of an environment, with the module that registers it if need be: ``module:Env-v0``
    :return: the return from which on it counts as solved, as far as it is registered with one
    :raises ConfigError: if there is no such environment
    """
    module, _, name = env_id.rpartition(":")
    try:
        if module:
            import_module(module)
        threshold = gym.spec(name).reward_threshold
    except (gym.error.Error, ImportError) as error:
        raise ConfigError(f"environment '{env_id}' — {error}") from None
    return None if threshold is None else float(threshold)


def keep_protocol(options: TrainOptions, config: RunConfig) -> TrainOptions:
    """
    Fill in what the protocol of a run settles, and refuse what contradicts it.

    The environment has to be unmodified: only what is learned from may be transformed, by wrappers of the reward,
    ``VecNormalize`` or a stack of frames. Episodes are evaluated one after another on a single copy: with ten copies, an
    observation in a batch of ten is rounded differently, which a walker's later steps depend on, and all copies wait for the
    longest episode (BipedalWalker: 0.7 to 2.2 times the time).

    :param options: options of the command line, about an environment that exists
    :param config: merged configuration
    :return: the options, unchanged without a protocol
    :raises ConfigError: if one of them, or the configuration, contradicts the protocol
    """
    if options.protocol is None:
        if options.threshold is not None:
            raise ConfigError(f"--threshold: {options.threshold:g} — belongs to --protocol, expected both or neither")
        return options
    on_policy = issubclass(load_algorithm(options.algo), OnPolicyAlgorithm)
    settled = {"eval_freq": ON_POLICY_EVAL_FREQ if on_policy else EVAL_FREQ, "eval_episodes": EVAL_EPISODES}
    for name, value in settled.items():
        given = getattr(options, name)
        if name in options.model_fields_set and given != value:
            flag = "--" + name.replace("_", "-")
            raise ConfigError(f"{flag}: {given} — expected {value} or nothing, as --protocol {options.protocol} has it")
    if config.settings.env_kwargs or options.eval_env_kwargs:
        names = ", ".join([*config.settings.env_kwargs, *options.eval_env_kwargs])
        raise ConfigError(f"env_kwargs: '{names}' — --protocol {options.protocol} is for the environment as registered")
    for name, _ in config.settings.env_wrapper:
        if not issubclass(find_wrapper(name), REWARD_WRAPPERS):
            raise ConfigError(f"env_wrapper: '{name}' — changes the task, which --protocol {options.protocol} leaves as it is")
    for name, _ in config.settings.vec_env_wrapper:
        raise ConfigError(f"vec_env_wrapper: '{name}' — --protocol {options.protocol} is for the environment as registered")
    threshold = reward_threshold(options.env) if options.threshold is None else options.threshold
    return options.model_copy(update={**settled, "threshold": threshold})


def solved_stride(options: TrainOptions) -> int:
    """
    :param options: result of :func:`keep_protocol`
    :return: every which evaluation takes place once the environment is solved
    """
    return SOLVED_STRIDE if options.protocol is not None and options.eval_freq == EVAL_FREQ else 1
