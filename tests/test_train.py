"""Short real runs: what they leave on disk, what is learned from, what is reported."""

import fcntl
import json
import os
import pty
import re
import select
import signal
import subprocess
import sys
import termios
import time
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import yaml
from gymnasium.envs.classic_control import PendulumEnv
from stable_baselines3 import PPO, SAC, TD3
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_symphony.analysis.runs import find_runs, group_runs
from sb3_symphony.cli import main
from sb3_symphony.common.wrappers import FreshBox2DWorld
from sb3_symphony.experiment.config import ConfigError, RunSettings, TrainOptions, load_config, reason
from sb3_symphony.experiment.environment import EpisodeSeeds, make_evaluation_env, make_training_env
from sb3_symphony.experiment.export import export
from sb3_symphony.experiment.run_folder import RunFolder
from sb3_symphony.experiment.select import ExportOptions, SelectOptions, select_model
from sb3_symphony.experiment.signals import handled_by
from sb3_symphony.experiment.train import TrainResult, train

SMALL = {"policy_kwargs": {"net_arch": [8]}, "learning_starts": 50, "buffer_size": 1000, "batch_size": 16}
FLOOR = [{"sb3_symphony.common.wrappers.RewardFloor": {"floor": -10}}]


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def options(algo="td3", env="Pendulum-v1", n_timesteps=250, **changes):
    changes.setdefault("hyperparams", SMALL)
    quick = {"seed": 1, "eval_freq": 0, "eval_episodes": 2, "verbose": 0, "progress": False, "num_threads": 1}
    return TrainOptions(algo=algo, env=env, n_timesteps=n_timesteps, **{**quick, **changes})


def monitor_returns(run):
    return np.loadtxt(run.path / "0.monitor.csv", delimiter=",", skiprows=2, ndmin=2)[:, 0]


@pytest.mark.parametrize("error", [RuntimeError("no fonts"), OSError(28, "No space left on device")])
def test_a_picture_that_fails_costs_no_model(folder, capsys, monkeypatch, error):
    def broken(path):
        raise error

    monkeypatch.setattr("sb3_symphony.analysis.plots.plot_training", broken)
    run = train(options()).run
    assert TD3.load(run.model).num_timesteps == 250
    assert f"note: training.png was not drawn — {reason(error)}" in capsys.readouterr().err


def test_a_run_is_found_with_the_module_of_its_environment():
    train(options(env_kwargs={"g": 5.0}, n_timesteps=60))
    for env in ("Pendulum-v1", "gymnasium:Pendulum-v1"):
        assert select_model(SelectOptions(algo="td3", env=env)).settings.env_kwargs == {"g": 5.0}
    other = train(options(env="gymnasium:Pendulum-v1", env_kwargs={"g": 5.0}, n_timesteps=60, seed=2)).run
    (group,) = group_runs(find_runs(other.path.parents[1]))
    assert group.env == "Pendulum-v1" and len(group.runs) == 2


def test_run_folder(folder, capsys):
    argv = "train --algo td3 --env Pendulum-v1 -n 450 --seed 1 --eval-freq 200 --eval-episodes 2 --save-freq 300"
    small = ["--verbose", "0", "-tb", "tb", "-params", "learning_starts:50", "buffer_size:1000", "policy_kwargs.net_arch:[8]"]
    assert main([*argv.split(), *small]) == 0
    out = capsys.readouterr().out
    run = folder / "logs" / "td3" / "Pendulum-v1_1"
    assert {path.name for path in run.iterdir()} == {
        "0.monitor.csv",
        "Pendulum-v1",
        "Pendulum-v1.zip",
        "best_model.zip",
        "checkpoints",
        "evaluations.npz",
        "rl_model_300_steps.zip",
        "training.png",
    }
    details = run / "Pendulum-v1"
    assert {path.name for path in details.iterdir()} == {"args.yml", "config.yml", "command.txt", "tensorboard.txt"}
    assert (details / "command.txt").read_text().startswith("sb3-symphony train --algo td3 --env Pendulum-v1 -n 450")
    assert yaml.safe_load((details / "args.yml").read_text())["seed"] == 1
    stored = yaml.safe_load((details / "config.yml").read_text())
    assert stored["n_timesteps"] == 450 and stored["noise_type"] == "normal" and stored["policy_kwargs"] == {"net_arch": [8]}
    with np.load(run / "evaluations.npz") as data:
        assert data["timesteps"].tolist() == [200, 400] and data["results"].shape == (2, 2)
        last = data["results"][-1].mean()
    summary = out.splitlines()[-1]
    assert "Pendulum-v1.zip | 450 steps" in summary and f"{last:.1f}" in summary
    assert TD3.load(run / "Pendulum-v1.zip").num_timesteps == 450
    assert (folder / "tb" / "Pendulum-v1" / "TD3_1").is_dir()
    # Its configuration, which holds neither algorithm nor environment, is still that of its own
    assert main(["train", "-conf", str(details / "config.yml"), "--dry-run"]) == 0
    assert capsys.readouterr().out.startswith("# td3 on Pendulum-v1, ")
    assert main(["train", "-conf", str(details / "config.yml"), "--algo", "ddpg", "--dry-run"]) == 0
    assert capsys.readouterr().out.startswith("# ddpg on Pendulum-v1, ")


@pytest.mark.parametrize("save_freq", [0, 100])
def test_diverged(folder, capsys, save_freq):
    flags = f"--env Pendulum-v1 -n 120 --seed 1 --eval-freq 0 --verbose 0 --save-freq {save_freq} --json -".split()
    extreme = ["-params", "learning_rate:1e30", "learning_starts:20", "train_freq:1", "policy_kwargs.net_arch:[8]"]
    assert main(["train", "--algo", "td3", *flags, *extreme]) == 0
    (run,) = json.loads(capsys.readouterr().out)["runs"]
    assert run["diverged"] and run["steps"] == 120
    assert train(options(n_timesteps=60)).plain()["diverged"] is False
    result = TrainResult(RunFolder(Path(run["run"]), "Pendulum-v1"), 120, [], 1.0, diverged=True)
    assert result.summary().splitlines()[1] == "its training has diverged, weights are not finite"
    # Where a distribution refuses what the network gives, that is told in place of a traceback
    assert main(["train", "--algo", "sac", *flags, *extreme]) == 2
    told = "its training has diverged, weights are not finite"
    error = capsys.readouterr().err.splitlines()[-1]
    assert re.search(rf"error: ValueError after \d+ steps: {told} — expected other hyper-parameters$", error)

    told = f"Pendulum-v1.zip: {told}"
    with pytest.raises(ConfigError, match=f"{told} — expected an agent that acts"):
        export(ExportOptions(model=run["model"]))
    with pytest.raises(ConfigError, match=f"-i: .*{told} — expected an agent that acts"):
        train(options(trained_agent=run["run"], hyperparams={"policy_kwargs.net_arch": [8]}))
    main(["evaluate", "--model", run["model"], "--n-episodes", "1"])
    assert f"note: {run['model']}: its training" in capsys.readouterr().err


@pytest.mark.parametrize("algo", ["symphony", "redq", "droq"])
def test_our_algorithms_train(algo):
    result = train(options(algo, n_timesteps=220, hyperparams={**SMALL, "gradient_steps": 1, "policy_delay": 1}))
    assert result.run.model.exists() and result.steps == 220
    assert not result.run.log_folder.exists()  # there is no TensorBoard log


def test_walker_with_shipped_settings():
    hyperparams = {"learning_starts": 150, "buffer_size": 1000, "policy_kwargs.net_arch": [8], "gradient_steps": 1}
    result = train(options("symphony", "BipedalWalker-v3", 200, hyperparams=hyperparams))
    assert result.run.model.exists() and not result.interrupted


def test_config_round_trip(folder):
    wrappers = [{"gymnasium.wrappers.TimeAwareObservation": {"normalize_time": True}}, *FLOOR]
    hyperparams = {
        **SMALL,
        "learning_rate": "lin_1e-3",
        "train_freq": [2, "step"],
        "env_wrapper": wrappers,
        "noise_type": None,
        "noise_std": None,
        "action_noise": {"StickyActionNoise": {"sigma": 0.2}},
        "replay_buffer_class": "FadingReplayBuffer",
        "policy_kwargs": {"net_arch": {"pi": [8], "qf": [4]}, "activation_fn": "nn.ELU"},
    }
    first = train(options(hyperparams=hyperparams)).run
    config = first.details / "config.yml"
    second = train(options(hyperparams={}, conf_file=str(config), n_timesteps=-1)).run
    assert second.path.name == "Pendulum-v1_2"
    assert (second.details / "config.yml").read_text() == config.read_text()
    a, b = (TD3.load(run.model).policy.state_dict() for run in (first, second))
    assert all(np.array_equal(a[key], b[key]) for key in a)  # same seed, same run


def test_evaluation_does_not_change_training():
    for algo in ("td3", "sac"):
        runs = [train(options(algo, eval_freq=frequency)).run for frequency in (0, 60)]
        a, b = (SAC.load(run.model) if algo == "sac" else TD3.load(run.model) for run in runs)
        b_state = b.policy.state_dict()
        assert all(np.array_equal(value, b_state[key]) for key, value in a.policy.state_dict().items())


def test_every_evaluation_uses_the_same_seeds(monkeypatch):
    seen = []
    reset = EpisodeSeeds.reset

    def record(self, **kwargs):
        observation = reset(self, **kwargs)
        seen.append(self.unwrapped.np_random_seed)
        return observation

    monkeypatch.setattr(EpisodeSeeds, "reset", record)
    train(options(eval_freq=100, eval_episodes=3))
    assert seen == [10_000, 10_001, 10_002, 10_003] * 2  # the last one is reset after the last episode, and not played


def test_evaluation_repeats_on_a_box2d_world():
    env = make_evaluation_env("BipedalWalker-v3", RunSettings(n_timesteps=1))
    returns = []
    for _ in range(2):
        env.env_method("restart_seeds")
        env.reset()
        rng, total = np.random.default_rng(0), []
        while len(total) < 2:
            _, _, done, info = env.step([rng.uniform(-1, 1, 4)])
            if done[0]:
                total.append(info[0]["episode"]["r"])
        returns.append(total)
    assert returns[0] == returns[1]


def test_reported_returns_are_raw_while_the_learner_sees_the_floor():
    hyperparams = {**SMALL, "env_wrapper": [{"sb3_symphony.common.wrappers.RewardFloor": {"floor": -1}}]}
    floored = train(options(n_timesteps=200, hyperparams=hyperparams)).run
    returns = monitor_returns(floored)
    assert len(returns) == 1 and returns[0] < -200  # 200 steps floored at -1 cannot reach that
    env = make_training_env("BipedalWalker-v3", RunSettings(n_timesteps=1, env_wrapper=FLOOR), 0.99, seed=0)
    env.reset()
    rng, rewards, done = np.random.default_rng(0), [], [False]
    while not done[0]:
        _, reward, done, infos = env.step([rng.uniform(-1, 1, 4)])
        rewards.append(float(reward[0]))
    assert rewards[-1] == -10.0 and infos[0]["raw_reward"] == -100.0
    assert infos[0]["episode"]["r"] == pytest.approx(sum(rewards) - 90, abs=1e-3)


def test_wrappers_of_the_evaluation():
    settings = RunSettings(n_timesteps=1, env_wrapper=["gymnasium.wrappers.TimeAwareObservation", *FLOOR])
    evaluation, training = (
        make_evaluation_env("BipedalWalker-v3", settings),
        make_training_env("BipedalWalker-v3", settings, 0.99, 0),
    )
    assert isinstance(evaluation, DummyVecEnv) and isinstance(training, DummyVecEnv)
    assert "RewardFloor" in str(training.envs[0]) and "RewardFloor" not in str(evaluation.envs[0])
    for env in (evaluation, training):
        assert env.observation_space.shape == (25,)
        assert env.env_is_wrapped(FreshBox2DWorld) == [True]
    assert evaluation.env_is_wrapped(gym.wrappers.TimeAwareObservation) == [True]


def test_normalization_is_kept_with_each_model():
    hyperparams = {"n_steps": 64, "batch_size": 64, "normalize": True, "n_envs": 2, "policy_kwargs": {"net_arch": [8]}}
    run = train(options("ppo", n_timesteps=512, eval_freq=256, save_freq=256, hyperparams=hyperparams)).run
    assert {path.name for path in run.path.glob("*.monitor.csv")} == {"0.monitor.csv", "1.monitor.csv"}
    plain = make_training_env("Pendulum-v1", RunSettings(n_timesteps=1), None, 0)
    last, best = VecNormalize.load(str(run.normalization), plain), VecNormalize.load(str(run.best_normalization), plain)
    assert last.gamma == pytest.approx(0.9)  # the algorithm's
    assert last.obs_rms.count > 500 and best.obs_rms.count <= last.obs_rms.count
    assert (run.path / "rl_model_vecnormalize_256_steps.pkl").exists()
    assert PPO.load(run.model).num_timesteps == 512


def test_existing_folders_are_left_alone(folder):
    first = RunFolder.create("logs", "sac", "Pendulum-v1")
    (first.path.parent / "Pendulum-v1_7").mkdir()
    (first.path.parent / "Pendulum-v1_best").mkdir()
    assert RunFolder.create("logs", "sac", "Pendulum-v1").path.name == "Pendulum-v1_8"
    assert RunFolder.create("logs", "sac", "some.module:My/Env-v0").path.name == "My-Env-v0_1"


def test_two_starts_at_the_same_moment(folder, monkeypatch):
    from pathlib import Path

    mkdir, collisions = Path.mkdir, []

    def other_was_faster(path, *args, **kwargs):
        if path.name == "Pendulum-v1_1" and not collisions:
            collisions.append(path)
            mkdir(path)
        mkdir(path, *args, **kwargs)

    monkeypatch.setattr(Path, "mkdir", other_was_faster)
    assert RunFolder.create("logs", "sac", "Pendulum-v1").path.name == "Pendulum-v1_2"


def test_drawn_seed_is_recorded():
    run = train(options(seed=-1, n_timesteps=60)).run
    seed = yaml.safe_load((run.details / "args.yml").read_text())["seed"]
    assert seed >= 0 and f"--seed {seed}" in (run.details / "command.txt").read_text()


def test_environment_arguments():
    config = load_config(options(env_kwargs={"g": 1.0}, hyperparams={**SMALL, "env_kwargs": {"g": 5.0}}))
    assert config.settings.env_kwargs == {"g": 1.0}
    env = make_training_env("Pendulum-v1", config.settings, None, 0)
    assert env.get_attr("unwrapped")[0].g == 1.0


def test_progress_bar(capsys):
    train(options(progress=True, n_timesteps=450, eval_freq=200))
    out = capsys.readouterr().out
    assert "450/450" in out and "eval -" in out


def test_errors_while_learning_keep_their_traceback(monkeypatch):
    def broken(*args, **kwargs):
        raise ValueError("a defect")

    monkeypatch.setattr(TD3, "train", broken)
    with pytest.raises(ValueError, match="a defect"):
        main("train --algo td3 --env Pendulum-v1 -n 100 --eval-freq 0 -params learning_starts:10 buffer_size:100".split())


def test_errors_while_learning_cost_no_model(monkeypatch, capsys):
    """Of a robot that stumbles in the middle of a training."""
    step, steps = PendulumEnv.step, []

    def stumble(self, action):
        steps.append(action)
        return step(self, action) if len(steps) <= 70 else 1 / 0

    monkeypatch.setattr(PendulumEnv, "step", stumble)
    with pytest.raises(ZeroDivisionError):
        train(options())
    (run,) = find_runs(Path("logs"))
    assert TD3.load(run.path / "Pendulum-v1.zip").num_timesteps == 70
    assert capsys.readouterr().err == f"note: saved {run.path / 'Pendulum-v1.zip'}, of 70 steps\n"


def test_stopping_during_an_evaluation(monkeypatch):
    reset = EpisodeSeeds.reset

    def interrupted_reset(self, **kwargs):
        signal.raise_signal(signal.SIGINT)
        return reset(self, **kwargs)

    monkeypatch.setattr(EpisodeSeeds, "reset", interrupted_reset)
    before = signal.getsignal(signal.SIGINT)
    result = train(options(eval_freq=100))
    assert result.interrupted and result.evaluation == [] and result.steps == 100
    assert result.run.model.exists() and (result.run.path / "training.png").exists()
    assert not (result.run.path / "evaluations.npz").exists()
    assert signal.getsignal(signal.SIGINT) is before


@pytest.mark.usefixtures("heeded_hang_up")
@pytest.mark.parametrize("save_freq", [0, 50])
def test_a_closed_terminal_saves_the_model(folder, save_freq):
    """What is written then goes nowhere, and is no error."""
    own, terminal = pty.openpty()
    argv = f"train --algo td3 --env Pendulum-v1 -n 1000000 --eval-freq 0 --seed 0 --save-freq {save_freq}"
    command = [sys.executable, "-m", "sb3_symphony", *argv.split(), "-params", "policy_kwargs.net_arch:[8]"]

    def take_terminal():
        fcntl.ioctl(0, termios.TIOCSCTTY, 0)

    process = subprocess.Popen(
        command, stdin=terminal, stdout=terminal, stderr=terminal, start_new_session=True, preexec_fn=take_terminal
    )
    os.close(terminal)
    monitor = folder / "logs/td3/Pendulum-v1_1/0.monitor.csv"
    try:
        deadline = time.monotonic() + 60
        while not (monitor.exists() and monitor.read_text().count("\n") > 3):
            assert process.poll() is None and time.monotonic() < deadline
            if select.select([own], [], [], 0.1)[0]:
                os.read(own, 4096)
        os.close(own)
        assert process.wait(timeout=60) == 130
    finally:
        process.kill()  # if it has not ended
    assert TD3.load(monitor.parent / "Pendulum-v1.zip").num_timesteps >= 400


def test_a_hang_up_that_is_ignored_stays_so():
    """As under nohup."""
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with handled_by(pytest.fail):
            signal.raise_signal(signal.SIGHUP)
        assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGHUP, before)


def test_hindsight_replay_before_an_episode_has_ended(folder):
    where = "stable_baselines3.common.envs:BitFlippingEnv"
    gym.register("Flip-v0", where, kwargs={"n_bits": 12, "continuous": True, "max_steps": 30})
    settings = "n_timesteps: 100\npolicy: MultiInputPolicy\nreplay_buffer_class: HerReplayBuffer\nlearning_starts: 10\n"
    (folder / "her.yml").write_text(settings)
    with pytest.raises(ConfigError, match="learning_starts: 10 — no episode had ended after 11 steps"):
        train(options("sac", "Flip-v0", -1, hyperparams={}, conf_file="her.yml"))


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_interruption_saves_the_model(folder, number):
    argv = "train --algo td3 --env Pendulum-v1 -n 1000000 --eval-freq 0 --seed 0 --verbose 0 -params learning_starts:100000"
    command = [sys.executable, "-m", "sb3_symphony", *argv.split(), "buffer_size:1000", "policy_kwargs.net_arch:[8]"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    monitor = folder / "logs/td3/Pendulum-v1_1/0.monitor.csv"
    deadline = time.monotonic() + 60
    while not (monitor.exists() and monitor.read_text().count("\n") > 3):
        assert process.poll() is None and time.monotonic() < deadline
        time.sleep(0.1)
    process.send_signal(number)
    out, err = process.communicate(timeout=60)
    assert process.returncode == 130
    assert "Traceback" not in err and "interrupted, saved" in out.splitlines()[-1]
    assert TD3.load(monitor.parent / "Pendulum-v1.zip").num_timesteps >= 400
    assert (monitor.parent / "training.png").exists()
