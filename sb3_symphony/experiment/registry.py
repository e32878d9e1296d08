"""All algorithms by name. Nothing heavy is imported before :func:`load_algorithm` asks for a class."""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from stable_baselines3.common.base_class import BaseAlgorithm

#: name on the command line → (module, class, one line for ``list``)
ALGORITHMS: dict[str, tuple[str, str, str]] = {
    "symphony": ("sb3_symphony.symphony", "Symphony", "deterministic actor, minimum over critics, fading replay"),
    "redq": ("sb3_symphony.redq", "REDQ", "randomised ensemble of critics, many updates per step"),
    "droq": ("sb3_symphony.redq", "DroQ", "two critics with dropout and layer normalisation, many updates per step"),
    "td3": ("stable_baselines3", "TD3", "twin delayed DDPG"),
    "ddpg": ("stable_baselines3", "DDPG", "deep deterministic policy gradient"),
    "sac": ("stable_baselines3", "SAC", "soft actor-critic"),
    "ppo": ("stable_baselines3", "PPO", "proximal policy optimisation (on-policy)"),
    "trpo": ("sb3_contrib", "TRPO", "trust region policy optimisation (on-policy)"),
    "tqc": ("sb3_contrib", "TQC", "truncated quantile critics"),
    "crossq": ("sb3_contrib", "CrossQ", "batch-normalised critics without target networks"),
}

#: also those that can be evaluated but not trained here
LOADABLE: dict[str, tuple[str, str, str]] = {
    **ALGORITHMS,
    "a2c": ("stable_baselines3", "A2C", "advantage actor-critic (on-policy)"),
    "dqn": ("stable_baselines3", "DQN", "deep Q network"),
    "ars": ("sb3_contrib", "ARS", "augmented random search"),
    "qrdqn": ("sb3_contrib", "QRDQN", "quantile regression DQN"),
    "ppo_lstm": ("sb3_contrib", "RecurrentPPO", "PPO with a recurrent policy"),
}


def load_algorithm(name: str) -> type["BaseAlgorithm"]:
    """
    Import an algorithm.

    :param name: a key of :data:`LOADABLE`
    :return: its class
    """
    module, class_name, _ = LOADABLE[name]
    return getattr(import_module(module), class_name)
