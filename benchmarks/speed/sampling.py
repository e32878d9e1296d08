"""
Cost of drawing a minibatch against the size of a full replay buffer.

    python benchmarks/speed/sampling.py --output benchmarks/results/speed/sampling.json

Contents are written straight into the buffers' arrays: a draw does not depend on them, but on memory that was touched.
"""

import argparse
import time
from pathlib import Path

import gymnasium as gym
import numpy as np
from measuring import pin, write
from stable_baselines3.common.buffers import ReplayBuffer

from sb3_symphony.common.buffers import FadingReplayBuffer, PrioritizedReplayBuffer

OBSERVATIONS, ACTIONS = gym.spaces.Box(-np.inf, np.inf, (24,), np.float32), gym.spaces.Box(-1, 1, (4,), np.float32)
CLASSES = {
    "SB3's uniform": (ReplayBuffer, {}),
    "fading": (FadingReplayBuffer, {}),
    "fading, 3-step returns": (FadingReplayBuffer, dict(n_steps=3, gamma=0.99)),
    "fading, a quarter of first steps": (FadingReplayBuffer, dict(start_share=0.25)),
    "prioritised": (PrioritizedReplayBuffer, {}),
}


def filled(cls: type[ReplayBuffer], size: int, kwargs: dict) -> ReplayBuffer:
    buffer = cls(size, OBSERVATIONS, ACTIONS, device="cpu", n_envs=1, **kwargs)
    for array in (buffer.observations, buffer.next_observations, buffer.actions, buffer.rewards):
        array[...] = 1.0
    buffer.full = True
    if isinstance(buffer, FadingReplayBuffer) and buffer.start_share > 0:  # episodes of 1 000 steps
        places = np.flatnonzero(np.arange(size) % 1000 < buffer.start_steps)
        buffer.starts[: len(places), 0], buffer.n_starts = places, len(places)
    if isinstance(buffer, PrioritizedReplayBuffer):
        for chunk in np.array_split(np.arange(size), max(1, size // 100_000)):
            buffer.update_priorities(chunk, np.random.rand(len(chunk)) + 0.1)
    return buffer


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sizes", type=float, nargs="+", default=[1e3, 1e4, 1e5, 1e6, 1e7])
    parser.add_argument("--batch", type=int, default=256)
    parser.add_argument("--output", type=Path, help="JSON file")
    arguments = parser.parse_args()
    pin(1)

    rows = []
    for name, (cls, kwargs) in CLASSES.items():
        for size in map(int, arguments.sizes):
            buffer = filled(cls, size, kwargs)
            samples = []
            for i in range(550):
                start = time.perf_counter()
                batch = buffer.sample(arguments.batch)
                if i >= 50:
                    samples.append(1e6 * (time.perf_counter() - start))
                if isinstance(buffer, PrioritizedReplayBuffer):
                    buffer.update_priorities(batch.indices, np.random.rand(arguments.batch))
            quartiles = [round(float(value), 1) for value in np.percentile(samples, [25, 50, 75])]
            rows.append(dict(buffer=name, size=size, batch=arguments.batch, microseconds_quartiles=quartiles))
            print(f"{name:32s} {size:10,d} transitions: {quartiles[1]:7.1f} microseconds for {arguments.batch}", flush=True)
            del buffer
    if arguments.output is not None:
        write(arguments.output, rows)


if __name__ == "__main__":
    main()
