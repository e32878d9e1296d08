"""
Where the time of ``learn()`` goes: steps per second on BipedalWalker-v3 and the share of each part, by updates per step.

    python benchmarks/speed/steps.py
    python benchmarks/speed/steps.py --ratios 1 5 10 20 --steps 2000 --output benchmarks/results/speed/steps.json

The settings are those of the shipped YAML. A part's time excludes that of the parts inside it.
"""

import argparse
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path

from measuring import pin, write
from stable_baselines3.common.callbacks import BaseCallback

from sb3_symphony.experiment.config import TrainOptions, load_config
from sb3_symphony.experiment.train import build_model

UPDATE = ("target", "critics", "actor")  # the arithmetic of an update


class Parts:
    """Time spent in methods, by name, each without what it calls of the others."""

    def __init__(self) -> None:
        self.seconds: Counter[str] = Counter()
        self.inner = [0.0]  # of the parts called by each one that runs now

    def watch(self, owner: object, method: str, name: str) -> None:
        function: Callable = getattr(owner, method)

        def timed(*args, **kwargs):
            self.inner.append(0.0)
            start = time.perf_counter()
            try:
                return function(*args, **kwargs)
            finally:
                elapsed = time.perf_counter() - start
                self.seconds[name] += elapsed - self.inner.pop()
                self.inner[-1] += elapsed

        setattr(owner, method, timed)


class Counting(BaseCallback):
    """Starts the clock when training has warmed up."""

    def __init__(self, parts: Parts, first: int) -> None:
        super().__init__()
        self.parts, self.first, self.start = parts, first, 0.0

    def _on_step(self) -> bool:
        if self.num_timesteps == self.first:
            self.parts.seconds.clear()
            self.start = time.perf_counter()
        return True


def measure(algorithm: str, ratio: int, steps: int, warm_up: int = 200) -> dict:
    """Steps per second, and seconds per step of each part."""
    starts = 1000
    arguments = {"gradient_steps": ratio, "policy_delay": max(ratio, 2), "learning_starts": starts}
    options = TrainOptions(algo=algorithm, env="BipedalWalker-v3", seed=0, hyperparams=arguments)
    model = build_model(options, load_config(options), seed=0, verbose=0)
    parts = Parts()
    parts.watch(model.env, "step", "environment")
    parts.watch(model, "_sample_action", "acting")
    parts.watch(model, "_store_transition", "storing")
    parts.watch(model.replay_buffer, "sample", "sampling")
    parts.watch(model._regression, "target_q_values", "target")
    parts.watch(model._regression, "fit", "critics")
    parts.watch(model, "_update_actor", "actor")
    parts.watch(model.actor, "action_log_prob" if hasattr(model.actor, "action_log_prob") else "forward", "actor")
    parts.watch(model, "_log_update", "logging")
    parts.watch(model, "dump_logs", "logging")
    parts.watch(model, "train", "rest of train()")
    clock = Counting(parts, starts + warm_up)
    model.learn(starts + warm_up + steps, callback=clock)
    elapsed = time.perf_counter() - clock.start
    per_step = {name: seconds / steps for name, seconds in parts.seconds.most_common()}
    per_step["rest of learn()"] = elapsed / steps - sum(per_step.values())
    return {
        "algorithm": algorithm,
        "ratio": ratio,
        "steps_per_second": steps / elapsed,
        "update_share": sum(per_step[name] for name in UPDATE) * steps / elapsed,
        "microseconds_per_step": {name: 1e6 * seconds for name, seconds in per_step.items()},
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--algorithms", nargs="+", default=["symphony", "redq"])
    parser.add_argument("--ratios", type=int, nargs="+", default=[1, 5, 10, 20])
    parser.add_argument("--steps", type=int, default=1000, help="environment steps that are timed")
    parser.add_argument("--output", type=Path, help="JSON file")
    arguments = parser.parse_args()
    pin(1)

    rows = []
    for algorithm in arguments.algorithms:
        for ratio in arguments.ratios:
            row = measure(algorithm, ratio, arguments.steps)
            rows.append(row)
            print(
                f"{algorithm} with {ratio} update(s) per step: {row['steps_per_second']:.0f} steps/s, "
                f"{row['update_share']:.0%} of the time is arithmetic of the update; microseconds per step:"
            )
            print("  " + ", ".join(f"{name} {value:.0f}" for name, value in row["microseconds_per_step"].items()), flush=True)
    if arguments.output is not None:
        write(arguments.output, rows)


if __name__ == "__main__":
    main()
