"""
What checkpoints cost: seconds of one every 10 000 steps, beside the seconds that these steps take, on BipedalWalker-v3.

    python benchmarks/speed/checkpoints.py --output benchmarks/results/speed/checkpoints.json

The settings are those of the shipped YAML, with one environment. Everything that ``--save-freq`` adds is counted: the
checkpoint, the model that is saved beside it, and the recording of episodes. Training is counted in processor time,
checkpoints in wall-clock time, so that a machine with other work makes checkpoints look dearer than they are. Replay buffers
are filled with random transitions up to a number of rows, of which the last 10 000 are new to each checkpoint. Files are
written below ``TMPDIR``, which should not be in memory.
"""

import argparse
import tempfile
import time
from pathlib import Path
from statistics import median
from typing import Any

import gymnasium as gym
import numpy as np
from measuring import pin, write
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.monitor import Monitor

from sb3_symphony.common.checkpoint import ExactCheckpoints
from sb3_symphony.common.recording import RecordedEpisode
from sb3_symphony.experiment.config import TrainOptions, load_config
from sb3_symphony.experiment.train import build_model

EVERY = 10_000  # steps between checkpoints


class Clock(BaseCallback):
    """Processor time of the steps after a number of steps, from the start of a rollout to the start of another one."""

    def __init__(self, first: int) -> None:
        super().__init__()
        self.first = first
        self.began: tuple[float, int] | None = None
        self.seconds_per_step = 0.0

    def _on_rollout_start(self) -> None:
        now, steps = time.process_time(), self.model.num_timesteps
        if self.began is not None and steps > self.began[1]:
            self.seconds_per_step = (now - self.began[0]) / (steps - self.began[1])
        elif steps >= self.first:
            self.began = (now, steps)

    def _on_step(self) -> bool:
        return True


class Still(gym.Env):
    """Does nothing, so that what is around it shows; episodes of 200 steps, as those of a walker that falls."""

    observation_space = gym.spaces.Box(-1.0, 1.0, (24,))
    action_space = gym.spaces.Box(-1.0, 1.0, (4,))

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        super().reset(seed=seed)
        self.steps, self.observation = 0, np.zeros(24, np.float32)
        return self.observation, {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        self.steps += 1
        return self.observation, 0.0, False, self.steps == 200, {}


def recording() -> float:
    """Processor time that the recording of 10 000 steps takes."""

    def run(env: gym.Env) -> float:
        action, start = np.zeros(4, np.float32), time.process_time()
        env.reset(seed=0)
        for _ in range(EVERY):
            if env.step(action)[3]:
                env.reset()
        return time.process_time() - start

    turns = [(run(Monitor(Still())), run(RecordedEpisode(Monitor(Still())))) for _ in range(11)]
    return median(recorded - plain for plain, recorded in turns)


def fill(model: Any, rows: int) -> None:
    """Add random transitions, in episodes of 1 000, until so many have been added in all."""
    rng = np.random.default_rng(0)
    shape = (1000, 1, *model.observation_space.shape)
    for _ in range(model.num_timesteps, rows, 1000):
        observations = rng.standard_normal(shape, dtype=np.float32)
        actions = rng.uniform(-1, 1, (1000, 1, *model.action_space.shape)).astype(np.float32)
        for i in range(min(1000, rows - model.num_timesteps)):
            end = np.array([i == 999])
            model.replay_buffer.add(observations[i], observations[i - 1], actions[i], np.ones(1), end, [{}])
            model.num_timesteps += 1


def saving(model: BaseAlgorithm, checkpoints: ExactCheckpoints, times: int) -> tuple[float, float, float]:
    """Median seconds of a checkpoint with 10 000 new rows, of saving the model, and bytes written per checkpoint."""
    seconds, models, sizes = [], [], []
    for _ in range(times):
        if hasattr(model, "replay_buffer"):
            fill(model, model.num_timesteps + EVERY)
        else:
            model.num_timesteps += EVERY
        before = {path.name for path in checkpoints.folder.iterdir()}
        start = time.perf_counter()
        assert checkpoints.save()
        seconds.append(time.perf_counter() - start)
        new = [path for path in checkpoints.folder.iterdir() if path.name not in before]
        sizes.append(sum(path.stat().st_size for path in new))
        start = time.perf_counter()
        model.save(checkpoints.folder.parent / f"rl_model_{model.num_timesteps}_steps")
        models.append(time.perf_counter() - start)
    return median(seconds), median(models), median(sizes)


def measure(algorithm: str, steps: int, rows: list[int], times: int, recorded: float) -> list[dict]:
    """One row for each number of transitions in the replay buffer."""
    options = TrainOptions(algo=algorithm, env="BipedalWalker-v3", seed=0, save_freq=EVERY, hyperparams={"n_envs": 1})
    model: Any = build_model(options, load_config(options), seed=0, verbose=0)
    first = getattr(model, "learning_starts", 0) + 200
    found = []
    with tempfile.TemporaryDirectory() as folder:
        clock = Clock(first)
        files = Path(folder) / "0.monitor.csv"
        files.write_text("-90.123456,1600,12345.678901\n" * 2000)  # as of two million steps
        checkpoints = ExactCheckpoints(Path(folder) / "checkpoints", 10**9, files=lambda: [files])
        model.learn(max(first + steps, 2 * getattr(model, "n_steps", 0) + 1), callback=[checkpoints, clock])
        for wanted in rows if hasattr(model, "replay_buffer") else [0]:
            if wanted:
                fill(model, wanted)
            checkpoints.save()
            seconds, saved, size = saving(model, checkpoints, times)
            training = EVERY * clock.seconds_per_step
            added = seconds + saved + recorded
            row = {
                "algorithm": algorithm,
                "rows_before": wanted,
                "checkpoint_seconds": round(seconds, 4),
                "checkpoint_bytes": size,
                "model_seconds": round(saved, 4),
                "recording_seconds": round(recorded, 4),
                "training_seconds": round(training, 2),
                "share": round(added / training, 5),
            }
            found.append(row)
            print(
                f"{algorithm:8s} {wanted:9,d} rows: checkpoint {1000 * seconds:.0f} ms ({size / 1e6:.1f} MB), model "
                f"{1000 * saved:.0f} ms, recording {1000 * recorded:.0f} ms; 10 000 steps {training:.0f} s: "
                f"{added / training:.2%}",
                flush=True,
            )
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--algorithms", nargs="+", default=["symphony", "redq", "droq", "sac", "td3", "ppo"])
    parser.add_argument("--steps", type=int, default=1000, help="environment steps of training that are timed")
    parser.add_argument("--rows", type=int, nargs="+", default=[20_000, 1_000_000], help="transitions in the replay buffer")
    parser.add_argument("--times", type=int, default=5, help="checkpoints that are timed")
    parser.add_argument("--output", type=Path, help="JSON file")
    arguments = parser.parse_args()
    pin(1)
    recorded = recording()
    rows = [
        row
        for algorithm in arguments.algorithms
        for row in measure(algorithm, arguments.steps, arguments.rows, arguments.times, recorded)
    ]
    if arguments.output is not None:
        write(arguments.output, rows)


if __name__ == "__main__":
    main()
