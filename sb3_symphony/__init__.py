"""Symphony, REDQ and DroQ for Stable-Baselines3."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sb3_symphony.common.buffers import FadingDictReplayBuffer, FadingReplayBuffer, PrioritizedReplayBuffer
    from sb3_symphony.common.noise import (
        DecayingNormalActionNoise,
        DisturbanceActionNoise,
        PinkActionNoise,
        StickyActionNoise,
    )
    from sb3_symphony.redq import REDQ, DroQ
    from sb3_symphony.symphony import Symphony

__version__ = "0.1.0"
__all__ = [
    "REDQ",
    "DecayingNormalActionNoise",
    "DisturbanceActionNoise",
    "DroQ",
    "FadingDictReplayBuffer",
    "FadingReplayBuffer",
    "PinkActionNoise",
    "PrioritizedReplayBuffer",
    "StickyActionNoise",
    "Symphony",
]


def __getattr__(name: str) -> Any:
    # Loaded on first use, so that the command line answers --help without waiting for torch
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    if name.endswith("ReplayBuffer"):
        home = "common.buffers"
    elif name.endswith("Noise"):
        home = "common.noise"
    else:
        home = "symphony" if name == "Symphony" else "redq"
    return getattr(import_module(f"{__name__}.{home}"), name)
