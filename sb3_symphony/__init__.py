"""Stable-Baselines3 plugin: Symphony, REDQ and DroQ."""

from sb3_symphony.redq import REDQ, DroQ
from sb3_symphony.symphony import Symphony

__version__ = "0.1.0"
__all__ = ["REDQ", "DroQ", "Symphony"]
