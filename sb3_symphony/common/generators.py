"""The global random generators, of which everything that draws without one of its own takes turns."""

import random
from typing import Any

import numpy as np
import torch as th


def generator_states() -> dict[str, Any]:
    """:return: states of Python's, NumPy's and torch's global generators, for :func:`restore_generators`"""
    return {
        "python": random.getstate(),
        "numpy": np.random.get_state(),
        "torch": th.get_rng_state(),
        "cuda": th.cuda.get_rng_state_all() if th.cuda.is_initialized() else [],
    }


def restore_generators(states: dict[str, Any]) -> None:
    """
    :param states: from :func:`generator_states`, perhaps of another machine
    """
    random.setstate(states["python"])
    np.random.set_state(states["numpy"])
    th.set_rng_state(states["torch"])
    if states["cuda"] and th.cuda.is_available():
        th.cuda.set_rng_state_all(states["cuda"][: th.cuda.device_count()])  # there may have been more
