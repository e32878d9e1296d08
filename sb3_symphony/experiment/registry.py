"""
All algorithms by name: ours, those of SB3 and SB3-Contrib, and ``FILE.py:Class`` for one of a user's own. Nothing heavy is
imported before :func:`load_algorithm` asks for a class.
"""

import sys
from importlib import import_module
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from types import ModuleType
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


def is_file(name: str) -> bool:
    """
    :param name: name of an algorithm
    :return: whether it is ``FILE.py:Class``
    """
    return ".py:" in name


def without_folder(name: str) -> str:
    """
    :param name: name of an algorithm
    :return: the same, of ``FILE.py:Class`` without the folder of the file, which may have moved
    """
    return Path(name).name if is_file(name) else name


def without_module(env_id: str) -> str:
    """
    :param env_id: id of an environment
    :return: the same, of ``module:Env-v0`` without the module that registers it
    """
    return env_id.rpartition(":")[2]


def load_algorithm(name: str) -> type["BaseAlgorithm"]:
    """
    Import an algorithm. That of a file runs the file.

    :param name: a key of :data:`LOADABLE`, or ``FILE.py:Class``
    :return: its class
    :raises ValueError: if the file cannot be imported or has no such class
    """
    if not is_file(name):
        module, class_name, _ = LOADABLE[name]
        return getattr(import_module(module), class_name)

    from stable_baselines3.common.base_class import BaseAlgorithm

    file, _, class_name = name.rpartition(":")
    found = getattr(_module_of(Path(file).resolve()), class_name, None)
    if not (isinstance(found, type) and issubclass(found, BaseAlgorithm)):
        raise ValueError(f"{file}: has no algorithm '{class_name}' — expected a subclass of one of Stable-Baselines3's")
    return found


def _module_of(path: Path) -> ModuleType:
    """The file as a module of its name, so that models which mention its classes can be loaded in any folder."""
    there = sys.modules.get(path.stem)
    if there is not None:
        file = Path(getattr(there, "__file__", None) or path.stem)
        if not (file.is_file() and file.read_bytes() == path.read_bytes()):  # a copy is as good
            raise ValueError(f"{path}: there is a module '{path.stem}' already — expected another name of the file")
        return there
    spec = spec_from_file_location(path.stem, path)
    assert spec is not None and spec.loader is not None
    sys.modules[path.stem] = module = module_from_spec(spec)
    try:
        spec.loader.exec_module(module)
    except BaseException as error:
        del sys.modules[path.stem]
        if isinstance(error, Exception):
            raise ValueError(f"{path}: cannot be imported — {type(error).__name__}: {error}") from error
        raise
    return module
