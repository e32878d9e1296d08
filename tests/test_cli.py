"""The command line: help, listing, and one clear line for every mistake."""

import os
import subprocess
import sys

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces

from sb3_symphony.cli import main, make_parser
from sb3_symphony.experiment.config import TrainOptions
from sb3_symphony.experiment.registry import ALGORITHMS


class ActionsEnv(gym.Env):
    observation_space = spaces.Box(-1.0, 1.0, (2,))

    def __init__(self, low, high, dtype=np.float32):
        self.action_space = spaces.Box(np.array(low, dtype), np.array(high, dtype), dtype=dtype)


if "Unbounded-v0" not in gym.registry:
    for name, arguments in {
        "Unbounded": {"low": [-np.inf], "high": [np.inf]},
        "Whole": {"low": [0], "high": [5], "dtype": np.int64},
        "Constant": {"low": [0, 1], "high": [1, 1]},
    }.items():
        gym.register(f"{name}-v0", entry_point=ActionsEnv, kwargs=arguments)


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    """An empty working folder."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


def fails(capsys, *argv: str) -> str:
    """Run a command that must fail with exit status 2 and one line on stderr; return that line."""
    try:
        status = main(argv)
    except SystemExit as error:  # from argparse
        status = error.code
    captured = capsys.readouterr()
    assert status == 2
    assert captured.err.count("\n") == 1 and captured.err.endswith("\n"), captured.err
    assert "Traceback" not in captured.err
    return captured.err


COMMANDS = ["train", "enjoy", "evaluate", "export", "tune", "plot", "video", "gait", "bench", "list"]


def test_quiet_in_any_locale():
    """What nobody sees is no reason to fail: some locales have no ±."""
    code = "from sb3_symphony import cli; cli._evaluate = lambda *args: print(chr(177)); cli.main(['evaluate', '--quiet'])"
    environment = {**os.environ, "LC_ALL": "C", "PYTHONCOERCECLOCALE": "0", "PYTHONUTF8": "0"}
    subprocess.run([sys.executable, "-c", code], env=environment, check=True)


@pytest.mark.parametrize("command", ["", *COMMANDS])
def test_help_fits_one_screen(capsys, command):
    with pytest.raises(SystemExit) as error:
        main([*command.split(), "--help"])
    out = capsys.readouterr().out
    assert error.value.code == 0
    assert len(out.splitlines()) <= 40 and max(map(len, out.splitlines())) <= 100
    assert "example" in out


def test_nothing_heavy_is_imported_before_a_command_runs():
    # The package's own __init__ is left out: what it imports is its business
    code = (
        "import sys, types, pathlib; package = types.ModuleType('sb3_symphony'); "
        f"package.__path__ = [{os.path.dirname(os.path.dirname(os.path.abspath(sys.modules['sb3_symphony.cli'].__file__)))!r}"
        " + '/sb3_symphony']; sys.modules['sb3_symphony'] = package\n"
        "from sb3_symphony.cli import main\nmain(['list'])\n"
        "heavy = {'torch', 'stable_baselines3', 'matplotlib', 'gymnasium'} & sys.modules.keys(); assert not heavy, heavy"
    )
    subprocess.run([sys.executable, "-c", code], check=True, stdout=subprocess.DEVNULL)


def test_list(capsys):
    assert main(["list"]) == 0
    out = capsys.readouterr().out
    assert all(name in out for name in ALGORITHMS) and "BipedalWalkerHardcore-v3" in out
    assert main(["list", "--algo", "sac"]) == 0
    assert "tqc" not in capsys.readouterr().out


def test_module_runs():
    done = subprocess.run([sys.executable, "-m", "sb3_symphony", "list"], capture_output=True, text=True)
    assert done.returncode == 0 and "symphony" in done.stdout


def test_bare_command_is_symphony_on_the_walker(monkeypatch):
    seen = []

    def record(options, command):
        seen.append((options, command))
        raise KeyboardInterrupt

    monkeypatch.setattr("sb3_symphony.experiment.train.train", record)
    monkeypatch.setattr("sys.stdout.isatty", lambda: True, raising=False)
    assert main(["train"]) == 130
    options, command = seen[0]
    assert (options.algo, options.env, options.progress) == ("symphony", "BipedalWalker-v3", True)
    assert command == "sb3-symphony train"
    assert main(["train", "--no-progress"]) == 130
    assert seen[1][0].progress is False


def test_flags_reach_the_options(monkeypatch):
    seen = []
    monkeypatch.setattr(
        "sb3_symphony.experiment.train.train", lambda options, command: (_ for _ in ()).throw(KeyboardInterrupt)
    )
    monkeypatch.setattr("sb3_symphony.cli.validated", lambda model, values: seen.append(values) or TrainOptions(algo="sac"))
    argv = "train --algo sac --env Pendulum-v1 -n 1e4 --seed 3 -f out --eval-freq 0 --eval-episodes 2 -conf c.yml"
    argv += " -tb tb --save-freq 5 --device cpu --num-threads 1 --log-interval 2 -P --verbose 0"
    argv += " -params gamma:0.9 tau:1e-2 --env-kwargs g:9.0"
    assert main(argv.split()) == 130
    assert seen[0] == {
        "algo": "sac",
        "env": "Pendulum-v1",
        "n_timesteps": 10_000,
        "seed": 3,
        "log_folder": "out",
        "eval_freq": 0,
        "eval_episodes": 2,
        "conf_file": "c.yml",
        "tensorboard_log": "tb",
        "save_freq": 5,
        "device": "cpu",
        "num_threads": 1,
        "log_interval": 2,
        "progress": True,
        "verbose": 0,
        "hyperparams": {"gamma": 0.9, "tau": 0.01},
        "env_kwargs": {"g": 9.0},
    }


@pytest.mark.parametrize(
    "arguments, message",
    [
        ("--env BipedalWaker-v3", "unknown environment 'BipedalWaker-v3': did you mean 'BipedalWalker-v3'?"),
        ("--env Pendulum-v77", "did you mean 'Pendulum-v1'?"),
        ("--env nowhere:Pendulum-v1", "nowhere"),
        ("--algo sac --env Pendulum", "unknown environment 'Pendulum': did you mean 'Pendulum-v1'?"),
        ("--log-interval 0", "log_interval: 0 — expected a whole number"),
        ("--eval-freq -5", "eval_freq: -5 — expected a number >= -1"),
        ("--num-threads 100000", "num_threads: 100000 — expected a number <= 1024"),
        ("--algo symphny", "unknown algorithm 'symphny': did you mean 'symphony'?"),
        ("--algo zzz", "expected one of symphony, redq, droq"),
        ("--algo sac --env CartPole-v1", "its action space is Discrete(2) — sac needs a continuous one (Box)"),
        ("--algo td3 --env Unbounded-v0", "is unbounded — td3 needs finite limits"),
        ("--algo ppo --env Unbounded-v0", "is unbounded"),
        ("--algo td3 --env Whole-v0", "its action space is Box(0, 5, (1,), int64) — td3 needs real numbers"),
        ("--algo td3 --env Constant-v0", "its action 1 is always 1.0 — td3 needs low < high"),
        ("--algo redq --env Constant-v0", "its action 1 is always 1.0 — redq needs low < high"),
        ("-params learning_ratee:1", "did you mean 'learning_rate'?"),
        ("-params learning_rate:fast", "learning_rate: 'fast' — expected a number or lin_<number>"),
        ("-params learning_rate:-1", "expected a number >= 0"),
        ("-params gamma:.inf", "expected a finite number"),
        ("-params learning_rate=1", "'learning_rate=1' — expected key:value"),
        ("-params gamma:[1", "not valid YAML"),
        ("--algo redq -params subset_size:20", "subset_size"),
        ("--algo sac -params ent_coef:some", "some"),
        ("--algo sac -params train_freq:[1,epoch]", "epoch"),
        ("--algo sac --env Pendulum-v1 -params buffer_size:1e13", "Unable to allocate"),
        ("--algo sac --env Pendulum-v1 -params policy:MultiInputPolicy", "policy: 'MultiInputPolicy' — needs"),
        ("--algo sac --env Pendulum-v1 --env-kwargs gravity:1", "gravity"),
        ("--algo sac --env Pendulum-v1 -params normalize:{norm_ob: true}", "did you mean 'norm_obs'"),
        ("-conf missing.yml", "missing.yml: no such file"),
        ("-conf .", "cannot be read"),
        ("-n 0", "n_timesteps: 0 — expected a whole number greater than 0"),
        ("-n many", "'many'"),
        ("-n 1.5", "'1.5'"),
        ("--seed -7", "seed: -7"),
        ("--eval-episodes 0", "eval_episodes: 0"),
        ("--device quantum", "--device: 'quantum' is not there"),
        ("--verbose 5", "expected one of 0, 1, 2"),
        ("--sed 1", "unknown argument '--sed': did you mean '--seed'?"),
        ("-optimize", "unknown argument '-optimize' — RL Zoo's, for which there is sb3-symphony tune"),
        ("--track", "RL Zoo's, for which there is python -m sb3_symphony.zoo train"),
        ("--save-replay-buffer", "RL Zoo's, for which there is --save-freq N, whose checkpoints hold it"),
    ],
)
def test_mistakes(capsys, folder, arguments, message):
    argv = arguments.replace(": ", ":~").split()
    line = fails(capsys, "train", *(argument.replace(":~", ": ") for argument in argv))
    assert message in line
    assert not list(folder.iterdir())  # nothing was made


def test_a_flag_given_twice_adds(capsys, folder):
    argv = "train --algo sac --env Pendulum-v1 --dry-run -params gamma:0.5 -params tau:0.25 batch_size:32".split()
    assert main(argv) == 0
    lines = [line.partition("#")[0].split() for line in capsys.readouterr().out.splitlines()]
    for pair in (["gamma:", "0.5"], ["tau:", "0.25"], ["batch_size:", "32"]):
        assert pair in lines


def test_an_environment_whose_module_fails(capsys, folder):
    (folder / "broken_robot.py").write_text("raise RuntimeError('no robot')")
    line = fails(capsys, "train", "--env", "broken_robot:X-v0")
    assert "environment 'broken_robot:X-v0' cannot be made — RuntimeError: no robot" in line


def test_nobody_reads_on():
    """``sb3-symphony list | head``"""
    process = subprocess.Popen([sys.executable, "-m", "sb3_symphony", "list"], stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    process.stdout.close()
    assert process.stderr.read() == b"" and process.wait() == 141


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="a device of Linux")
@pytest.mark.parametrize("unbuffered", ["", "1"])
def test_output_on_a_full_disk(unbuffered):
    command = [sys.executable, "-m", "sb3_symphony", "list"]
    with open("/dev/full", "w") as full:
        done = subprocess.run(command, env={**os.environ, "PYTHONUNBUFFERED": unbuffered}, stdout=full, stderr=subprocess.PIPE)
    assert done.returncode == 2 and done.stderr.count(b"\n") == 1
    assert b"error: output cannot be written" in done.stderr


@pytest.mark.parametrize("redirection", [">&-", ">&- 2>&-", "<&- >&- 2>&-"])
def test_closed_output(folder, redirection):
    command = f"{sys.executable} -m sb3_symphony train --algo sac --env Pendulum-v1 -n 20 --device cpu {redirection}"
    assert subprocess.run(["sh", "-c", command], cwd=folder).returncode == 0
    assert (folder / "logs" / "sac" / "Pendulum-v1_1" / "Pendulum-v1.zip").is_file()


def test_output_that_has_no_such_characters():
    environment = {**os.environ, "PYTHONIOENCODING": "ascii"}
    done = subprocess.run([sys.executable, "-m", "sb3_symphony", "train", "--help"], env=environment, capture_output=True)
    assert done.returncode == 0 and done.stderr == b"" and b"?" in done.stdout


def test_negative_numbers_may_have_exponents():
    arguments = make_parser().parse_args(["train", "--threshold", "-1.2e3"])
    assert arguments.threshold == -1200


def test_warnings_of_gymnasium_are_no_second_line(folder):
    command = [sys.executable, "-m", "sb3_symphony", "train", "--algo", "sac", "--env", "Pendulum", "-n", "10"]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 2 and done.stderr.count("\n") == 1 and "did you mean 'Pendulum-v1'?" in done.stderr


def test_settings_of_an_algorithm_in_a_file(folder, capsys):
    (folder / "own.py").touch()
    assert "--algo: 'own.py:X' — expected one of symphony" in fails(capsys, "list", "--algo", "own.py:X")


def test_unknown_command(capsys):
    assert "did you mean 'train'" in fails(capsys, "trian")
    assert "required" in fails(capsys)


@pytest.mark.parametrize(
    "content, message",
    [
        ("Pendulum-v1: {n_timesteps: 10, [", "line 1: not valid YAML"),
        (
            "a: 1\nn_timesteps: !!python/object/apply:os.system ['touch owned']\n",
            "line 2: tag '!!python/object/apply:os.system'",
        ),
        ("- 1\n", "expected a mapping"),
        ("", "expected a mapping"),
        ("Pendulum-v1: 5", "expected a mapping of hyper-parameters"),
        ("gamma: 0.9\nPendulum-v1: {gamma: 0.8}", "'gamma' stands beside the entry 'Pendulum-v1' — expected inside it"),
        ("Pendulum-v2: {n_timesteps: 5}", "did you mean 'Pendulum-v2'"),
        ("policy: MlpPolicy", "n_timesteps: missing"),
        ("{n_timesteps: 10, policy_kwargs: \"__import__('os').mkdir('owned')\"}", "policy_kwargs: '__import__"),
        ("{n_timesteps: 10, env_wrapper: os.mkdir}", "env_wrapper: 'os.mkdir'"),
    ],
)
def test_bad_files(capsys, folder, content, message):
    (folder / "bad.yml").write_text(content)
    assert message in fails(capsys, "train", "--algo", "sac", "--env", "Pendulum-v1", "-conf", "bad.yml")
    assert [path.name for path in folder.iterdir()] == ["bad.yml"]


def test_binary_file(capsys, folder):
    (folder / "bad.yml").write_bytes(b"\xff\xfe\x00\x9f")
    assert "not a text file" in fails(capsys, "train", "-conf", "bad.yml")


@pytest.mark.parametrize("flag", ["-f", "-tb"])
def test_a_folder_that_cannot_be_written(capsys, folder, flag):
    (folder / "occupied").write_text("mine")
    argv = ["train", "--algo", "td3", "--env", "Pendulum-v1", "-params", "buffer_size:100", flag, "occupied"]
    assert "'occupied' cannot be written" in fails(capsys, *argv)
    assert [path.name for path in folder.iterdir()] == ["occupied"]
    assert (folder / "occupied").read_text() == "mine"


def test_missing_mujoco(capsys, monkeypatch, folder):
    for name in [name for name in sys.modules if name.startswith("gymnasium.envs.mujoco")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "mujoco", None)
    assert 'pip install "sb3-symphony[mujoco]"' in fails(capsys, "train", "--algo", "sac", "--env", "Hopper-v4")
    assert not list(folder.iterdir())
