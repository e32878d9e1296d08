"""``train --save-freq`` and ``--resume``: a run that was killed and resumed equals one that never stopped, bit for bit."""

import errno
import os
import pickle
import random
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import yaml
from filelock import FileLock
from resume_helpers import GlobalRandomEnv, assert_same_results, difference, monitor_rows
from stable_baselines3 import TD3
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from sb3_symphony.analysis.runs import open_run
from sb3_symphony.cli import main
from sb3_symphony.common.checkpoint import ExactCheckpoints, newest_checkpoint
from sb3_symphony.experiment.callbacks import save_model
from sb3_symphony.experiment.config import ConfigError, TrainOptions
from sb3_symphony.experiment.environment import EpisodeSeeds
from sb3_symphony.experiment.registry import ALGORITHMS, load_algorithm
from sb3_symphony.experiment.train import train, train_seeds

# Most runs below are killed after step 200 of 260 and resumed there: fifty updates come before
SMALL = {"policy_kwargs": {"net_arch": [8]}, "learning_starts": 150, "buffer_size": 1000, "batch_size": 16}
SMALL_ON_POLICY = {"policy_kwargs": {"net_arch": [8]}, "n_steps": 32, "batch_size": 32, "n_envs": 1, "use_sde": False}
# Actor steps fall between environment steps
SMALL_ENSEMBLE = {**SMALL, "gradient_steps": 2, "policy_delay": 3}
OURS, ON_POLICY = ("symphony", "redq", "droq"), ("ppo", "trpo")

pytestmark = pytest.mark.usefixtures("no_figures")


class Killed(BaseException):
    """What takes the place of ``kill -9`` inside a process: nothing handles it."""


if "GlobalRandom-v0" not in gym.registry:
    gym.register("GlobalRandom-v0", entry_point=GlobalRandomEnv, max_episode_steps=40)


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def kill(monkeypatch):
    """``kill(steps)``: the run dies in mid-step, when the environment has moved and nothing is stored yet."""
    on_step = ExactCheckpoints._on_step

    def at(steps):
        def die(self):
            if self.num_timesteps >= steps:
                monkeypatch.setattr(ExactCheckpoints, "_on_step", on_step)
                raise Killed
            return on_step(self)

        monkeypatch.setattr(ExactCheckpoints, "_on_step", die)

    return at


@pytest.fixture
def killed(kill):
    """``killed(steps, options)``: folder of a run that dies at a step."""

    def run(steps, options):
        kill(steps)
        with pytest.raises(Killed):
            train(options)
        return Path(options.resume or f"{options.log_folder}/{options.algo}/{options.env}_1")

    return run


@pytest.fixture
def logged(monkeypatch):
    """Everything that is logged, wall-clock times apart."""
    dump, lines = Logger.dump, []

    def record(self, step=0):
        lines.append((step, {k: v for k, v in self.name_to_value.items() if k not in ("time/fps", "time/time_elapsed")}))
        dump(self, step)

    monkeypatch.setattr(Logger, "dump", record)
    return lines


def small(algo):
    return SMALL_ON_POLICY if algo in ON_POLICY else SMALL_ENSEMBLE if algo in OURS else SMALL


def options(algo="td3", env="Pendulum-v1", n_timesteps=260, **changes):
    changes.setdefault("hyperparams", small(algo))
    quick = {"seed": 1, "eval_freq": 0, "eval_episodes": 1, "verbose": 0, "progress": False, "num_threads": 1}
    return TrainOptions(algo=algo, env=env, n_timesteps=n_timesteps, **{**quick, "save_freq": 100, **changes})


def resume(run, **changes):
    return train(TrainOptions(resume=str(run), **changes))


def contents(folder):
    """Every file but the lock, with its content and time of change."""
    files = (path for path in Path(folder).rglob("*") if path.is_file() and path.name != ".lock")
    return {path: (path.read_bytes(), path.stat().st_mtime_ns) for path in files}


# ----------------------------------------------------------------------------------------------------------------------
# Bit for bit
# ----------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("algo", "env"),
    [(algo, "Pendulum-v1") for algo in ALGORITHMS]
    + [(algo, "BipedalWalker-v3") for algo in ("symphony", "td3", "ppo")]
    + [pytest.param(algo, "BipedalWalker-v3", marks=pytest.mark.slow) for algo in ("redq", "droq")],
)
def test_killed_in_mid_episode(killed, logged, algo, env, capsys):
    chosen = {"save_freq": 70, "hyperparams": {**small(algo), "env_wrapper": [], "normalize": False}}
    whole = train(options(algo, env, log_folder="a", **chosen)).run.path
    expected = logged.copy()
    run = killed(230, options(algo, env, log_folder="b", **chosen))
    assert newest_checkpoint(run / "checkpoints").state["episodes"][0]["actions"].size > 0  # in mid-episode
    killed(250, TrainOptions(resume=str(run)))  # and once more, soon after
    logged.clear()
    result = resume(run)
    assert result.steps >= 260 and not result.interrupted
    assert "resumed at" in capsys.readouterr().out
    assert_same_results(whole, run)
    assert difference(logged, expected[len(expected) - len(logged) :]) is None
    a, b = (load_algorithm(algo).load(path / f"{env}.zip").get_parameters() for path in (whole, run))
    assert difference(a, b) is None


NO_ZOO_NOISE = {"noise_type": None, "noise_std": None}
WALKER_STICKY = {"StickyActionNoise": {"sigma": 0.3, "decay_steps": 200, "hold": 3}}
EPISODES_OF_60 = [{"sb3_symphony.common.wrappers.EpisodeStepLimit": {"max_steps": 60, "until_total_steps": 1000}}]
VARIANTS = {
    "normalized": ("sac", "Pendulum-v1", {**SMALL, "normalize": True}),
    "normalized on-policy": ("ppo", "Pendulum-v1", {**SMALL_ON_POLICY, "normalize": True, "frame_stack": 3}),
    "correlated noise": ("td3", "Pendulum-v1", {**SMALL, "noise_type": "ornstein-uhlenbeck", "noise_std": 0.3}),
    "pink noise": ("ddpg", "Pendulum-v1", {**SMALL, **NO_ZOO_NOISE, "action_noise": {"PinkActionNoise": {}}}),
    "sticky noise": ("redq", "BipedalWalker-v3", {**SMALL_ENSEMBLE, "action_noise": WALKER_STICKY, "n_steps": 3}),
    "disturbance": ("symphony", "Pendulum-v1", {**SMALL_ENSEMBLE, "action_noise": {"DisturbanceActionNoise": {}}}),
    "ring": ("symphony", "BipedalWalker-v3", {**SMALL_ENSEMBLE, "buffer_size": 90, "n_steps": 3}),
    "small ring": ("sac", "Pendulum-v1", {**SMALL, "buffer_size": 30}),
    "prioritised": ("redq", "Pendulum-v1", {**SMALL_ENSEMBLE, "replay_buffer_class": "PrioritizedReplayBuffer"}),
    "saving memory": (
        "sac",
        "Pendulum-v1",
        {
            **SMALL,
            "buffer_size": 120,
            "optimize_memory_usage": True,
            "replay_buffer_kwargs": {"handle_timeout_termination": False},
        },
    ),
    "gSDE": ("sac", "Pendulum-v1", {**SMALL, "use_sde": True, "train_freq": 8, "gradient_steps": 2}),
    "gSDE on-policy": ("ppo", "Pendulum-v1", {**SMALL_ON_POLICY, "use_sde": True, "sde_sample_freq": 4}),
    "whole episodes": (
        "td3",
        "BipedalWalker-v3",
        {**SMALL, "train_freq": [1, "episode"], "gradient_steps": -1, "env_wrapper": EPISODES_OF_60},
    ),
    "schedule": ("sac", "Pendulum-v1", {**SMALL, "learning_rate": "lin_1e-3"}),
    "several environments": ("sac", "Pendulum-v1", {**SMALL, "n_envs": 3, "normalize": True}),
    "several walkers": ("ppo", "BipedalWalker-v3", {**SMALL_ON_POLICY, "n_envs": 2}),
    "several noises": (
        "symphony",
        "Pendulum-v1",
        {**SMALL_ENSEMBLE, "n_envs": 2, "n_steps": 2, "action_noise": {"StickyActionNoise": {"decay_steps": 150}}},
    ),
    "wrappers": (
        "td3",
        "BipedalWalker-v3",
        {
            **SMALL,
            "env_wrapper": [
                {"gymnasium.wrappers.DelayObservation": {"delay": 2}},
                {"gymnasium.wrappers.TimeAwareObservation": {}},
                {"sb3_symphony.common.wrappers.StallPenalty": {"coef": 0.05}},
                {"sb3_symphony.common.wrappers.StrideBonus": {"per_radian": True}},
                {"sb3_symphony.common.wrappers.EpisodeStepLimit": {"max_steps": 30, "until_total_steps": 150}},
            ],
        },
    ),
}


@pytest.mark.parametrize("name", VARIANTS)
def test_variants(killed, capsys, name):
    algo, env, hyperparams = VARIANTS[name]
    whole = train(options(algo, env, log_folder="a", hyperparams=hyperparams)).run.path
    run = killed(235, options(algo, env, log_folder="b", hyperparams=hyperparams))
    resume(run)
    assert "fresh episodes" not in capsys.readouterr().out
    assert_same_results(whole, run)
    if "normalize" in hyperparams:
        a, b = (vars(pickle.loads((path / env / "vecnormalize.pkl").read_bytes())) for path in (whole, run))
        assert difference([a["obs_rms"], a["ret_rms"]], [b["obs_rms"], b["ret_rms"]]) is None


def test_environments_in_processes(killed, capsys):
    chosen = {"hyperparams": {**SMALL, "n_envs": 2, "normalize": True}, "vec_env": "subproc"}
    whole = train(options("sac", log_folder="a", n_timesteps=450, **chosen)).run.path
    run = killed(330, options("sac", log_folder="b", n_timesteps=450, **chosen))
    resume(run)
    assert "(resumed at 300)" in capsys.readouterr().out
    assert len(monitor_rows(run / "1.monitor.csv")) == 2
    assert_same_results(whole, run)


def test_evaluations_and_saved_models(killed, logged):
    chosen = {"eval_freq": 60, "eval_episodes": 2}
    whole = train(options("sac", log_folder="a", **chosen)).run.path
    expected = logged.copy()
    run = killed(245, options("sac", log_folder="b", **chosen))  # evaluated at 240, after the checkpoint at 200
    with np.load(run / "evaluations.npz") as data:
        assert data["timesteps"].tolist() == [60, 120, 180, 240]
    logged.clear()
    result = resume(run)
    assert_same_results(whole, run)
    assert difference(logged, expected[len(expected) - len(logged) :]) is None
    assert {path.name for path in run.iterdir()} == {path.name for path in whole.iterdir()}
    for name in ("best_model.zip", "rl_model_200_steps.zip"):
        a, b = (load_algorithm("sac").load(path / name).get_parameters() for path in (whole, run))
        assert difference(a, b) is None
    with np.load(run / "evaluations.npz") as data:
        assert result.evaluation == data["results"][-1].tolist()


def test_tensorboard_goes_on_in_its_folder(killed, folder):
    def scalars(log):
        events = EventAccumulator(str(folder / log / "Pendulum-v1" / "TD3_1"))
        events.Reload()
        return {tag: [(e.step, e.value) for e in events.Scalars(tag)] for tag in events.Tags()["scalars"] if "fps" not in tag}

    chosen = {"eval_freq": 60, "log_interval": 1}
    train(options(log_folder="a", tensorboard_log="tb_a", n_timesteps=450, **chosen))
    run = killed(415, options(log_folder="b", tensorboard_log="tb_b", n_timesteps=450, save_freq=150, **chosen))
    assert [step for step, _ in scalars("tb_b")["eval/mean_reward"]] == [60, 120, 180, 240, 300, 360]
    resume(run)
    assert [path.name for path in (folder / "tb_b" / "Pendulum-v1").iterdir()] == ["TD3_1"]
    assert scalars("tb_a") == scalars("tb_b")
    assert [step for step, _ in scalars("tb_b")["rollout/ep_len_mean"]] == [200, 400]


def test_tensorboard_goes_on_though_the_note_of_its_folder_was_emptied(killed):
    run = killed(230, options(tensorboard_log="tb"))
    note = run / "Pendulum-v1" / "tensorboard.txt"
    before = note.read_text()
    note.write_text("")
    resume(run)
    assert note.read_text() == before and not list(note.parent.glob("events*"))


def test_a_copy_has_a_log_of_its_own(folder):
    run = train(options(log_folder="b", tensorboard_log="tb", n_timesteps=450, save_freq=150, eval_freq=60, keep=5)).run.path
    copy = run.with_name("Pendulum-v1_2")
    shutil.copytree(run, copy)
    (copy / "Pendulum-v1.zip").unlink()
    for path in (copy / "checkpoints").glob("*450*"):
        path.unlink()
    log = folder / "tb" / "Pendulum-v1"
    before = contents(log / "TD3_1")
    resume(copy)
    assert contents(log / "TD3_1") == before and {path.name for path in log.iterdir()} == {"TD3_1", "TD3_2"}
    events = EventAccumulator(str(log / "TD3_2")).Reload()
    assert [event.step for event in events.Scalars("eval/mean_reward")] == [360, 420]
    assert open_run(copy).log.samefile(log / "TD3_2") and open_run(run).log.samefile(log / "TD3_1")


def test_tensorboard_goes_on_where_the_run_is_moved_to(killed, folder):
    log = "b/td3/Pendulum-v1_1/log"
    run = killed(415, options(log_folder="b", tensorboard_log=log, n_timesteps=450, save_freq=150, eval_freq=60))
    (folder / "b").rename("c")
    resume(folder / "c" / run.relative_to("b"))
    assert not (folder / "b").exists()
    events = EventAccumulator(str(folder / "c/td3/Pendulum-v1_1/log/Pendulum-v1/TD3_1")).Reload()
    assert [event.step for event in events.Scalars("eval/mean_reward")] == [60, 120, 180, 240, 300, 360, 420]


@pytest.mark.parametrize("log_interval", [1, 3])
def test_on_policy_iterations_go_on(killed, logged, log_interval):
    whole = train(options("ppo", log_folder="a", n_timesteps=300, log_interval=log_interval)).run.path
    expected = logged.copy()
    logged.clear()
    run = killed(260, options("ppo", log_folder="b", n_timesteps=300, log_interval=log_interval))
    resume(run)
    after = [line for line in expected if line[0] > 224]  # the rollout at which the last checkpoint was made
    assert difference(logged[-len(after) :], after) is None and after[-1][1]["time/iterations"] == 10 - 10 % log_interval
    assert_same_results(whole, run)


@pytest.mark.parametrize("algo", ["symphony", "td3", "ppo"])
def test_results_do_not_depend_on_checkpoints(algo):
    runs = [train(options(algo, log_folder=str(every), save_freq=every)).run for every in (-1, 1, 70)]
    plain, often, seldom = (load_algorithm(algo).load(run.model).get_parameters() for run in runs)
    assert difference(plain, often) is None and difference(plain, seldom) is None
    assert_same_results(runs[1].path, runs[2].path)
    assert monitor_rows(runs[0].path / "0.monitor.csv") == monitor_rows(runs[1].path / "0.monitor.csv")


def test_other_checkpoint_flags_may_differ(killed):
    whole = train(options(log_folder="a")).run.path
    run = killed(230, options(log_folder="b"))
    resume(run, save_freq=15, keep=5, verbose=0, progress=True)
    assert_same_results(whole, run)
    steps = sorted(int(path.stem.rpartition("_")[2]) for path in (run / "checkpoints").glob("*.ckpt"))
    assert steps == [210, 225, 240, 255, 260]


def test_forced_to_stop_before_the_first_checkpoint(monkeypatch, capsys):
    """By two Ctrl-C, say: what was learned by then is kept as a model of its steps."""
    whole = train(options(log_folder="a", eval_freq=60)).run.path
    with monkeypatch.context() as patch:

        def force(self):
            if self.num_timesteps == 90:
                raise KeyboardInterrupt
            return True

        patch.setattr(ExactCheckpoints, "_on_step", force)
        result = train(options(log_folder="b", eval_freq=60))
    assert result.interrupted and result.run.model.is_file()
    resume(result.run.path)
    assert "stopped before its first checkpoint, begins again" in capsys.readouterr().out
    assert_same_results(whole, result.run.path)
    assert TD3.load(result.run.path / "rl_model_90_steps.zip").num_timesteps == 90


def test_forced_to_stop_in_a_rollout_longer_than_the_steps_between_checkpoints(interrupt, capsys):
    whole = train(options("ppo", log_folder="a", save_freq=20)).run.path
    interrupt(25, times=2)
    run = train(options("ppo", log_folder="b", save_freq=20)).run.path
    resume(run)
    assert "stopped before its first checkpoint, begins again" in capsys.readouterr().out
    assert_same_results(whole, run)


def test_started_from_an_agent_that_has_moved_before_the_first_checkpoint(killed):
    train(options(log_folder="a"))
    begin = {"trained_agent": "a/td3/Pendulum-v1_1"}
    whole = train(options(log_folder="b", **begin)).run.path
    run = killed(90, options(log_folder="c", **begin))
    Path("a").rename("d")
    with pytest.raises(ConfigError, match=r"-i: a/td3/Pendulum-v1_1.*: no such file"):
        resume(run)
    with pytest.raises(ConfigError, match="--trained-agent: 'd/td3/Other_1' contradicts the run"):
        resume(run, trained_agent="d/td3/Other_1")
    resume(run, trained_agent="d/td3/Pendulum-v1_1")
    assert_same_results(whole, run)


def test_killed_before_the_first_checkpoint(killed, capsys):
    whole = train(options(log_folder="a", eval_freq=60)).run.path
    run = killed(90, options(log_folder="b", eval_freq=60))
    resume(run)
    assert "stopped before its first checkpoint, begins again" in capsys.readouterr().out
    assert_same_results(whole, run)


# ----------------------------------------------------------------------------------------------------------------------
# Finished runs and longer ones
# ----------------------------------------------------------------------------------------------------------------------


def test_time_after_training_is_not_training(monkeypatch):
    monkeypatch.setattr("sb3_symphony.experiment.train._save_model", lambda *args: time.sleep(1))
    result = train(options(log_folder="a"))
    elapsed = newest_checkpoint(result.run.checkpoints).state["elapsed"] / 1e9
    assert result.seconds <= elapsed < result.seconds + 0.5  # what a longer run goes on from


@pytest.mark.parametrize("save_freq", [-1, 100])
def test_finished_run_is_left_alone(capsys, save_freq):
    run = train(options(save_freq=save_freq)).run.path
    before, locks = contents(run), [path.stat().st_mtime_ns for path in run.rglob(".lock")]
    for extra in ([], ["-n", "260"], ["-n", "100"], ["--algo", "td3", "--seed", "1"]):
        assert main(["train", "--resume", str(run), *extra]) == 0
        assert "is finished: 260 steps" in capsys.readouterr().out.splitlines()[-1]
    assert contents(run) == before and [path.stat().st_mtime_ns for path in run.rglob(".lock")] == locks


@pytest.mark.parametrize("algo", ["symphony", "sac", "ppo"])
def test_finished_run_goes_on_to_more_steps(algo):
    sde = {"use_sde": True} if algo == "sac" else {}
    chosen = {"hyperparams": {**small(algo), **sde}, "eval_freq": 90}
    whole = train(options(algo, log_folder="a", n_timesteps=384, **chosen)).run.path
    run = train(options(algo, log_folder="b", n_timesteps=256, **chosen)).run
    result = resume(run.path, n_timesteps=384)
    assert result.steps == 384
    assert_same_results(whole, run.path)
    assert yaml.safe_load((run.details / "config.yml").read_text())["n_timesteps"] == 384
    again = resume(run.path)
    assert again.untouched  # the larger number is remembered
    assert again.evaluation == result.evaluation and 0 < again.seconds <= result.seconds + 60


def test_from_inside_the_folder(killed, monkeypatch):
    run = killed(230, options(eval_freq=100))
    monkeypatch.chdir(run)
    assert main(["train", "--resume", "."]) == 0
    with np.load("evaluations.npz") as data:
        assert data["timesteps"].tolist() == [100, 200]
    assert resume(".").untouched


def test_command_and_options_are_kept(killed):
    run = killed(230, options(seed=-1))
    args = yaml.safe_load((run / "Pendulum-v1" / "args.yml").read_text())
    first = (run / "Pendulum-v1" / "command.txt").read_text()
    assert args["device"] == "auto"
    assert main(["train", "--resume", str(run), "-n", "270", "--device", "cpu"]) == 0
    command = f"sb3-symphony train --resume {run} -n 270 --device cpu\n"
    assert (run / "Pendulum-v1" / "command.txt").read_text() == first + command
    assert yaml.safe_load((run / "Pendulum-v1" / "args.yml").read_text()) == {**args, "n_timesteps": 270, "device": "cpu"}


# ----------------------------------------------------------------------------------------------------------------------
# Mistakes
# ----------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "extra, message",
    [
        ("--algo sac", "--algo: 'sac' contradicts the run, which has 'td3'"),
        ("--env BipedalWalker-v3", "--env: 'BipedalWalker-v3' contradicts"),
        ("--seed 2", "--seed: 2 contradicts the run, which has 1 — with --resume only"),
        ("--eval-freq 50", "--eval-freq: 50 contradicts"),
        ("-params gamma:0.5", "-params: {'gamma': 0.5} contradicts"),
        ("-conf symphony-original", "-conf: 'symphony-original' contradicts"),
        ("--num-threads 2", "--num-threads: 2 contradicts"),
        ("-tb somewhere", "--tensorboard-log: 'somewhere' contradicts"),
        ("-n 150", "-n: 150 — the run has taken 200 steps already"),
        ("--save-freq -1", "--save-freq: -1 — expected a number > 0"),
        ("--keep 0", "keep: 0 — expected a number >= 1"),
    ],
)
def test_contradictions(killed, capsys, extra, message):
    run = killed(230, options())
    capsys.readouterr()
    before = contents(run)
    assert main(["train", "--resume", str(run), *extra.split()]) == 2
    error = capsys.readouterr().err
    assert message in error and error.count("\n") == 1
    assert contents(run) == before


def test_not_a_run(folder, capsys):
    (folder / "empty").mkdir()
    for name, message in (("nowhere", "no such folder"), ("empty", "no run folder")):
        assert main(["train", "--resume", name]) == 2
        assert message in capsys.readouterr().err
    assert main(["train", "--resume", "x" * 300]) == 2
    assert f"--resume: '{'x' * 300}'" in capsys.readouterr().err
    assert list(folder.iterdir()) == [folder / "empty"]
    (folder / "zoo" / "Pendulum-v1").mkdir(parents=True)
    arguments = "!!python/object/apply:collections.OrderedDict [[[algo, td3], [env, Pendulum-v1], [max_total_trials, null]]]"
    (folder / "zoo" / "Pendulum-v1" / "args.yml").write_text(arguments)
    assert main(["train", "--resume", "zoo"]) == 2
    assert "--resume: 'zoo' has no checkpoints — RL Zoo made it" in capsys.readouterr().err


def test_run_without_checkpoints(monkeypatch, capsys):
    monkeypatch.setattr(EpisodeSeeds, "reset", lambda *args, **kwargs: (_ for _ in ()).throw(KeyboardInterrupt))
    assert train(options(eval_freq=100, save_freq=-1)).interrupted
    assert main(["train", "--resume", "logs/td3/Pendulum-v1_1"]) == 2
    assert "has no checkpoints — it was started without --save-freq" in capsys.readouterr().err


def test_folder_of_checkpoints_that_was_deleted(folder, capsys):
    run = train(options()).run.path
    shutil.rmtree(run / "checkpoints")
    assert main(["train", "--resume", str(run), "-n", "300"]) == 2
    assert "has no checkpoints — they were deleted" in capsys.readouterr().err


def test_a_run_whose_command_was_deleted_goes_on(killed):
    run = killed(230, options())
    (run / "Pendulum-v1" / "command.txt").unlink()
    resume(run)
    assert (run / "Pendulum-v1" / "command.txt").read_text().startswith("sb3-symphony train")


def test_options_that_are_not_ours(killed, capsys):
    run = killed(230, options())
    file = run / "Pendulum-v1" / "args.yml"
    file.write_text(file.read_text().replace("seed: 1", f"seed: {2**32}"))
    capsys.readouterr()
    assert main(["train", "--resume", str(run)]) == 2
    assert f"error: {file}: seed: {2**32}" in capsys.readouterr().err


def test_checkpoints_that_were_deleted(folder, capsys):
    run = train(options()).run.path
    for path in (run / "checkpoints").glob("*0*"):
        path.unlink()
    before = contents(run)
    assert main(["train", "--resume", str(run), "-n", "300"]) == 2
    assert "has a model of 260 steps, but no checkpoint — start a new run" in capsys.readouterr().err
    assert contents(run) == before


def test_another_machine(killed, monkeypatch, capsys):
    run = killed(230, options())
    monkeypatch.setattr("torch.get_num_threads", lambda: 7)
    resume(run)
    assert "(resumed at 200; not bit for bit: threads 1 before, 7 now)" in capsys.readouterr().out


def test_run_whose_old_place_cannot_be_made(killed, folder):
    run = killed(230, options(log_folder="b"))
    (folder / "b").rename("c")
    (folder / "b").touch()
    resume(folder / "c" / run.relative_to("b"))


def test_one_process_at_a_time(killed, capsys):
    run = killed(230, options())
    capsys.readouterr()
    with FileLock(run / "checkpoints" / ".lock"):
        assert main(["train", "--resume", str(run)]) == 2
    assert "is being trained by another process" in capsys.readouterr().err
    assert main(["train", "--resume", str(run)]) == 0


# ----------------------------------------------------------------------------------------------------------------------
# Damage
# ----------------------------------------------------------------------------------------------------------------------


def needed_by(run, newest):
    """Files without which the newest checkpoint, and not the one before, is lost."""
    found = newest_checkpoint(run / "checkpoints")
    assert found.steps == newest
    return [f"checkpoint_{newest:09d}.ckpt", found.state["segments"][-1].file]


@pytest.mark.parametrize("algo", ["symphony", "ppo"])
def test_cut_files(killed, capsys, algo):
    whole = train(options(algo, log_folder="a")).run.path
    cut_run = killed(245, options(algo, log_folder="b", save_freq=64))
    newest, before = sorted(int(p.stem[-9:]) for p in (cut_run / "checkpoints").glob("*.ckpt"))[::-1]
    files = needed_by(cut_run, newest) if algo == "symphony" else [f"checkpoint_{newest:09d}.ckpt"]
    pristine = cut_run.with_name("pristine")
    shutil.copytree(cut_run, pristine)
    for name in files:
        size = (pristine / "checkpoints" / name).stat().st_size
        for length in (0, 1, 31, 32, 33, size // 2, size - 1, None, "changed"):
            shutil.rmtree(cut_run)
            shutil.copytree(pristine, cut_run)
            file = cut_run / "checkpoints" / name
            if length is None:
                file.unlink()
            elif length == "changed":
                content = bytearray(file.read_bytes())
                content[size // 2] ^= 1
                file.write_bytes(content)
            else:
                file.write_bytes(file.read_bytes()[:length])
            found = newest_checkpoint(cut_run / "checkpoints")
            assert found.steps == before and (length is None or name in found.damaged[0]), (name, length)
        capsys.readouterr()
        resume(cut_run)
        assert f"(resumed at {before}; damaged: {name}" in capsys.readouterr().out
        assert_same_results(whole, cut_run)


def test_no_checkpoint_is_whole(killed, capsys):
    run = killed(230, options())
    for path in (run / "checkpoints").glob("*.ckpt"):
        path.write_bytes(path.read_bytes()[:100])
    before = contents(run)
    assert main(["train", "--resume", str(run)]) == 2
    error = capsys.readouterr().err
    assert "no checkpoint of" in error and "checkpoint_000000100.ckpt: cut or changed" in error
    assert contents(run) == before


def test_monitor_and_evaluations_are_what_they_were(killed):
    whole = train(options(log_folder="a", n_timesteps=450, eval_freq=60)).run.path
    run = killed(410, options(log_folder="b", n_timesteps=450, eval_freq=60, save_freq=150))
    (run / "0.monitor.csv").write_bytes((run / "0.monitor.csv").read_bytes()[:-7])  # died while writing
    (run / "evaluations.npz").write_bytes(b"")
    resume(run)
    assert_same_results(whole, run)


def test_best_models_of_a_future_that_was_given_up(killed):
    run = killed(200, options(eval_freq=60, save_freq=110))
    (run / "best_model.zip").write_bytes(b"that of a step that is taken otherwise this time")
    resume(run, n_timesteps=115)
    assert TD3.load(run / "best_model.zip").num_timesteps == 60
    begins_again = killed(90, options(log_folder="b", eval_freq=60, save_freq=110))
    assert (begins_again / "best_model.zip").is_file()
    resume(begins_again, n_timesteps=50)
    assert not (begins_again / "best_model.zip").exists()


def fill_disk_at(monkeypatch, name):
    """From the first synchronisation of a file with ``name`` in its path on, the disk is full."""
    fsync, failed = os.fsync, []

    def full(descriptor):
        path = os.readlink(f"/proc/self/fd/{descriptor}")
        if failed or name in path:
            failed.append(path)
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        fsync(descriptor)

    monkeypatch.setattr(os, "fsync", full)


@pytest.mark.parametrize("name", ["000000200.segment", "checkpoint_000000200.ckpt"])
def test_no_room_for_a_checkpoint(monkeypatch, killed, capsys, name):
    whole = train(options(log_folder="a")).run.path
    with monkeypatch.context() as patched:
        fill_disk_at(patched, name)
        run = killed(230, options(log_folder="b"))
    out = capsys.readouterr().out
    assert "no checkpoint at 200 steps: No space left on device — training goes on, older ones are unharmed" in out
    assert out.count("no checkpoint") == 1
    assert newest_checkpoint(run / "checkpoints").steps == 100
    resume(run)
    assert_same_results(whole, run)
    assert not list((run / "checkpoints").glob(".*.tmp"))


def test_no_room_for_a_saved_model(monkeypatch):
    whole = train(options(log_folder="a")).run.path
    with monkeypatch.context() as patched, pytest.raises(ConfigError, match="No space left on device — once there is room"):
        fill_disk_at(patched, "rl_model_200_steps.zip")
        train(options(log_folder="b"))
    run = Path("b/td3/Pendulum-v1_1")
    assert [path.name for path in run.glob("*rl_model*")] == ["rl_model_100_steps.zip"]  # no part of the other
    resume(run)
    assert_same_results(whole, run)


def test_no_room_for_a_model_beside_its_statistics(monkeypatch, tmp_path):
    env = VecNormalize(DummyVecEnv([lambda: gym.make("Pendulum-v1")]))
    model, files = TD3("MlpPolicy", env, policy_kwargs={"net_arch": [8]}), (tmp_path / "model.zip", tmp_path / "model.pkl")
    save_model(model, *files)
    before = [file.read_bytes() for file in files]
    env.reset()
    with monkeypatch.context() as patched, pytest.raises(OSError, match="No space left"):
        fill_disk_at(patched, "model.zip")
        save_model(model, *files)
    assert [file.read_bytes() for file in files] == before and len(list(tmp_path.iterdir())) == 2
    save_model(model, *files)
    assert files[1].read_bytes() != before[1]


def test_no_room_at_the_end(monkeypatch, capsys):
    whole = train(options(log_folder="a")).run.path
    argv = "train --algo td3 --env Pendulum-v1 -n 260 --seed 1 --eval-freq 0 --verbose 0 --num-threads 1 --save-freq 100 -f b"
    small = ["-params", "learning_starts:150", "buffer_size:1000", "batch_size:16", "policy_kwargs.net_arch:[8]"]
    with monkeypatch.context() as patched:
        fill_disk_at(patched, "/.Pendulum-v1.zip.")
        assert main([*argv.split(), *small]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and "No space left on device — once there is room, --resume goes on" in error
    assert main(["train", "--resume", "b/td3/Pendulum-v1_1"]) == 0
    assert_same_results(whole, Path("b/td3/Pendulum-v1_1"))


def test_disk_that_fills_up(small_disk, folder):
    """Wherever the disk is full first: checkpoints that were written can be resumed elsewhere."""
    chosen = {"eval_freq": 150, "hyperparams": {**SMALL, "buffer_size": 5000}}
    with pytest.raises(ConfigError, match="No space left on device"):
        train(options("sac", log_folder=str(small_disk), n_timesteps=2000, **chosen))
    run = folder / "roomy"
    shutil.copytree(small_disk / "sac" / "Pendulum-v1_1", run)
    steps = newest_checkpoint(run / "checkpoints").steps
    assert 100 <= steps < 2000
    resume(run, n_timesteps=steps + 130)
    whole = train(options("sac", log_folder="a", n_timesteps=steps + 130, **chosen)).run.path
    assert_same_results(whole, run)


# ----------------------------------------------------------------------------------------------------------------------
# Signals
# ----------------------------------------------------------------------------------------------------------------------


@pytest.fixture
def interrupt(monkeypatch):
    """``interrupt(steps, times)``: Ctrl-C in mid-step, once or twice."""
    on_step = ExactCheckpoints._on_step

    def at(steps, times=1):
        def press(self):
            if self.num_timesteps == steps:
                monkeypatch.setattr(ExactCheckpoints, "_on_step", on_step)
                for _ in range(times):
                    signal.raise_signal(signal.SIGINT)
            return on_step(self)

        monkeypatch.setattr(ExactCheckpoints, "_on_step", press)

    return at


@pytest.mark.parametrize("algo, stops_at", [("symphony", 205), ("sac", 205), ("ppo", 224)])
def test_interrupted_run_goes_on_from_where_it_stopped(interrupt, algo, stops_at):
    whole = train(options(algo, log_folder="a", eval_freq=41)).run.path  # it is interrupted in the step of an evaluation
    interrupt(205)
    result = train(options(algo, log_folder="b", eval_freq=41))
    assert result.interrupted and result.steps == stops_at and "interrupted, saved" in result.summary()
    run = result.run
    assert newest_checkpoint(run.checkpoints).steps == stops_at
    a, b = load_algorithm(algo).load(run.model).get_parameters(), newest_checkpoint(run.checkpoints).state["parameters"]
    assert difference(a, b) is None
    resume(run.path)
    assert_same_results(whole, run.path)


def test_interrupted_twice(interrupt):
    """The second time the run stops at once, wherever it is: it goes on from the checkpoint before."""
    whole = train(options(log_folder="a")).run.path
    interrupt(223, times=2)
    result = train(options(log_folder="b"))
    assert result.interrupted and newest_checkpoint(result.run.checkpoints).steps == 200
    resume(result.run.path)
    assert_same_results(whole, result.run.path)


@pytest.mark.parametrize("times", [1, 2])
def test_interrupted_in_the_last_step(interrupt, times):
    """With one signal the run just ends; with two it is one update short, and not taken for finished."""
    whole = train(options(log_folder="a")).run.path
    interrupt(260, times)
    result = train(options(log_folder="b"))
    assert result.interrupted == (times == 2)
    assert resume(result.run.path).untouched == (times == 1)
    assert_same_results(whole, result.run.path)


def test_a_series_that_is_interrupted_in_the_last_step_of_a_run(interrupt, monkeypatch):
    interrupt(260)
    (result,) = train_seeds(options(n_seeds=2))
    assert result.signalled and not result.interrupted and resume(result.run.path).untouched
    monkeypatch.setattr("sb3_symphony.experiment.train.train_seeds", lambda *args, **kwargs: [result])
    assert main(["train", "--n-seeds", "2"]) == 130 and main(["train"]) == 0


def test_resume_that_is_interrupted_before_it_begins(killed, monkeypatch):
    """A model that has not got its state yet must not replace the saved one."""
    whole = train(options(log_folder="a")).run.path
    run = killed(230, options(log_folder="b"))
    (run / "Pendulum-v1.zip").write_bytes(b"an earlier model")
    with monkeypatch.context() as patched:
        patched.setattr(ExactCheckpoints, "_restore", lambda *args: (_ for _ in ()).throw(KeyboardInterrupt))
        assert resume(run).interrupted
    assert (run / "Pendulum-v1.zip").read_bytes() == b"an earlier model"
    resume(run)
    assert_same_results(whole, run)


CHANGED = {
    "policy_kwargs": ({"net_arch": [9]}, "size mismatch"),
    "buffer_size": (150, "buffer_size of its replay buffer is 1000, not 150"),
    "n_steps": (2, "its replay buffer is no NStepReplayBuffer"),
    "noise_type": ("ornstein-uhlenbeck", "action_noise: the checkpoint is of another one than OrnsteinUhlenbeckActionNoise"),
    "normalize": (True, r"wrappers around all copies of the environment \(normalize, frame_stack\): 0 there, 1 here"),
    "env_wrapper": (
        [{"sb3_symphony.common.wrappers.RewardFloor": {"floor": -30}}],
        "wrappers around each environment .*: 3 there, 4 here",
    ),
}


@pytest.mark.parametrize("key", CHANGED)
def test_a_configuration_that_was_changed(killed, key):
    value, message = CHANGED[key]
    noise = {"noise_type": "normal", "noise_std": 0.1}
    whole = train(options(log_folder="a", hyperparams={**small("td3"), **noise})).run.path
    run = killed(230, options(log_folder="b", hyperparams={**small("td3"), **noise}))
    config = run / "Pendulum-v1" / "config.yml"
    before = config.read_text()
    config.write_text(yaml.safe_dump({**yaml.safe_load(before), key: value}))
    files = {path: path.read_bytes() for path in run.rglob("*") if path.is_file()}
    with pytest.raises(
        ConfigError, match=r"config\.yml was changed: the checkpoint at 200 steps is of another model — .*" + message
    ):
        resume(run)
    assert {path: path.read_bytes() for path in run.rglob("*") if path.is_file()} == files
    config.write_text(before)
    resume(run)
    assert_same_results(whole, run)


def test_an_environment_that_fails_at_the_replay(killed, monkeypatch):
    """Its error is told as it is."""
    run = killed(230, options())

    def lost(self, action):
        raise RuntimeError("lost the connection to the robot")

    monkeypatch.setattr(gym.envs.classic_control.PendulumEnv, "step", lost)
    with pytest.raises(RuntimeError, match="lost the connection to the robot"):
        resume(run)


def test_a_command_in_another_encoding(killed):
    run = killed(230, options())
    (run / "Pendulum-v1" / "command.txt").write_bytes("träin\n".encode("latin-1"))
    assert resume(run).steps == 260
    assert (run / "Pendulum-v1" / "command.txt").read_text(encoding="utf-8").startswith("tr\ufffdin\n")


# ----------------------------------------------------------------------------------------------------------------------
# Environments whose state cannot be made again
# ----------------------------------------------------------------------------------------------------------------------


def test_environment_that_cannot_be_replayed(killed, capsys):
    run = killed(230, options("sac", "GlobalRandom-v0", hyperparams={**SMALL, "normalize": True}))
    before = monitor_rows(run / "0.monitor.csv")
    result = resume(run)
    assert "resumed at 200 steps with fresh episodes, hence not bit for bit: replaying" in capsys.readouterr().out
    assert result.steps == 260
    rows = monitor_rows(run / "0.monitor.csv")
    assert rows[: len(before)] == before and len(rows) == 1 + 260 // 40  # the header; the episode begun at 200 is whole
    assert sum(int(row.split(",")[1]) for row in rows[1:]) <= 260


@pytest.mark.usefixtures("heeded_hang_up")
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT, signal.SIGHUP])
def test_signals_to_the_group(folder, number):
    """As `timeout` and Ctrl-C send them: to the run and, unless it has none there, to its environments' processes."""
    arguments = "train --algo sac --env Pendulum-v1 -n 1000000 --vec-env subproc --save-freq 100000 --verbose 0".split()
    process, _ = start(*arguments, "--no-progress", "-params", "n_envs:2", "learning_starts:1000000", start_new_session=True)
    time.sleep(1)
    os.killpg(process.pid, number)
    try:
        output = process.communicate(timeout=60)[0]
    finally:
        process.kill()  # if it has not ended; its environments' processes end with it
    assert process.returncode == 130 and "Traceback" not in output, output
    run = folder / "logs" / "sac" / "Pendulum-v1_1"
    model = load_algorithm("sac").load(run / "Pendulum-v1.zip")
    assert newest_checkpoint(run / "checkpoints").steps == model.num_timesteps > 0


# ----------------------------------------------------------------------------------------------------------------------
# kill -9
# ----------------------------------------------------------------------------------------------------------------------

FLAGS = "--seed 1 --eval-freq 150 --eval-episodes 1 --verbose 0 --num-threads 1 --save-freq 50 --no-progress"
KILLED_RUNS = {
    "Pendulum-v1": f"train --algo redq --env Pendulum-v1 -n 700 {FLAGS}",
    "BipedalWalker-v3": f"train --algo symphony --env BipedalWalker-v3 -n 700 {FLAGS}",
}
KILLED_PARAMS = "learning_starts:60 buffer_size:400 batch_size:32 gradient_steps:3 policy_kwargs.net_arch:[16]".split()


def start(*arguments, **kwargs):
    """Start a process and wait until it begins to learn (or says that it need not); returns it and the time."""
    command = [sys.executable, "-m", "sb3_symphony", *arguments]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, **kwargs)
    line = process.stdout.readline()
    assert "steps into" in line or "is finished" in line, line + process.stdout.read()
    return process, time.monotonic()


def kill_at_random(env, moments, folder, seed):
    """Kill a run while it learns, resume it, kill it again, at random moments; compare it with one that was left alone."""
    arguments, params = KILLED_RUNS[env].split(), ["-params", *KILLED_PARAMS]
    rng = random.Random(seed)
    process, began = start(*arguments, "-f", "whole", *params)
    assert process.wait() == 0, process.stdout.read()
    duration = time.monotonic() - began
    algo = arguments[2]

    kills, compared = 0, 0
    while kills < moments:
        run = folder / f"killed_{compared}" / algo / f"{env}_1"
        process, _ = start(*arguments, "-f", f"killed_{compared}", *params)
        while True:
            try:
                process.wait(timeout=rng.uniform(0, duration) if kills < moments else None)
                break
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
                kills += 1
            process, _ = start("train", "--resume", str(run))
        assert process.returncode == 0, process.stdout.read()
        assert_same_results(folder / "whole" / algo / f"{env}_1", run)
        compared += 1
        shutil.rmtree(run)
    return compared


@pytest.mark.parametrize("env", ["Pendulum-v1", pytest.param("BipedalWalker-v3", marks=pytest.mark.slow)])
def test_kill_9(folder, env):
    kill_at_random(env, 1, folder, seed=None)


@pytest.mark.slow
@pytest.mark.parametrize("env", KILLED_RUNS)
def test_kill_9_at_fifty_moments(folder, env):
    print(f"{env}: killed 50 times, {kill_at_random(env, 50, folder, seed=None)} runs compared, all equal")
