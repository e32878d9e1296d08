"""All algorithms by name. Nothing heavy is imported before :func:`load_algorithm` asks for a class."""

import difflib
from collections.abc import Iterable
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


def suggestion(name: str, choices: Iterable[str]) -> str:
    """
    The end of an error message: the nearest valid spelling, if one is near.

    :param name: what was given
    :param choices: valid names
    :return: ``": did you mean 'x'?"`` or an empty string
    """
    by_lower = {choice.lower(): choice for choice in choices}
    near = difflib.get_close_matches(name.lower(), by_lower, n=1)
    return f": did you mean '{by_lower[near[0]]}'?" if near else ""


def load_algorithm(name: str) -> type["BaseAlgorithm"]:
    """
    Import an algorithm.

    :param name: a key of :data:`ALGORITHMS`
    :return: its class
    """
    module, class_name, _ = ALGORITHMS[name]
    return getattr(import_module(module), class_name)
