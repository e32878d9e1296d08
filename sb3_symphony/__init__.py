"""Symphony, REDQ and DroQ for Stable-Baselines3."""

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
