"""Random malformed command lines and configurations: one line, exit code 2, nothing on disk changes."""

import contextlib
import io
import json

import pytest
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from stable_baselines3 import PPO, SAC

from sb3_symphony.cli import main

#: what may be typed in place of a value: no null byte and no undecodable text reaches a program this way
TEXT = st.text(st.characters(codec="utf-8", exclude_characters="\0"), max_size=300)


def _no_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return True
    return False


NO_NUMBER = TEXT.filter(_no_number)
BAD_COUNT = NO_NUMBER | st.integers(max_value=0).map(str) | st.floats().filter(lambda x: x != x or x % 1 != 0).map(str)
NEGATIVE = NO_NUMBER | st.floats(max_value=-1e-9).map(str) | st.just("nan") | st.just("inf")
NO_FILE = TEXT.map(lambda text: f"missing/{text}")
NO_ENV = st.sampled_from(["Pendulum-v7", "pendulum", "", ":", "a:b", "CartPole-v1", "FrozenLake-v1"])

#: command → flag → values that are wrong
SELECTION = {
    "--model": NO_FILE,
    "--algo": TEXT.filter(lambda text: text != "sac") | st.sampled_from(["ppo", "symphony", "SAC"]),
    "--env": NO_ENV | st.just("BipedalWalker-v3"),  # not the model's
    "--exp-id": NO_NUMBER | st.integers(max_value=-2).map(str) | st.just("1"),
    "--load-checkpoint": NO_NUMBER | st.integers(max_value=-1).map(str) | st.integers(0, 99).map(str),
    "--vecnormalize": NO_FILE | st.just("sac.zip"),
    "--env-kwargs": TEXT.filter(lambda text: ":" not in text)
    | st.sampled_from(["nothing:1", "g:[", "g:!!python/name:os.system"]),
    "--env-wrapper": TEXT.filter(lambda text: ":" not in text)
    | st.sampled_from(["os.system:{}", "gymnasium.wrappers.RecordVideo:{}", "gymnasium.wrappers.TimeLimit:{max_steps: 5}"]),
    "--gym-packages": st.sampled_from(["", ".", "no_such_module", "os.", "a b", "sb3_symphony.nothing"]),
    "--device": TEXT.map(lambda text: f"no {text}"),
    "--num-threads": NO_NUMBER,
    "--load-best": st.none(),
    "--load-last-checkpoint": st.none(),
    "--no-such-flag": st.none() | TEXT,
}
COMMANDS = {
    "evaluate": SELECTION
    | {
        "--n-episodes": BAD_COUNT,
        "--seed": BAD_COUNT.filter(lambda text: text not in ("0", "-0")),
        "--n-envs": BAD_COUNT,
        "--obs-noise": NEGATIVE,
        "--action-delay": NEGATIVE | st.just("0.5"),
        "--json": NO_FILE | st.just("."),
    },
    "enjoy": SELECTION | {"--n-timesteps": BAD_COUNT, "--n-envs": BAD_COUNT, "--reward-log": st.just("sac.zip")},
    "video": SELECTION
    | {
        "--n-timesteps": BAD_COUNT,
        "--n-episodes": BAD_COUNT,
        "--seed": BAD_COUNT.filter(lambda text: text not in ("0", "-0")),
        "--fps": BAD_COUNT | st.just("1000"),
        "--width": BAD_COUNT | st.just("1") | st.just("1e6"),
        "--output": NO_FILE | st.sampled_from(["", "sac.zip", "film", ".mp4/", "."]),
    },
    "gait": SELECTION
    | {
        "--n-timesteps": BAD_COUNT,
        "--skip": NEGATIVE | st.just("1e300"),
        "--window": NEGATIVE | st.just("0"),
        "--n-frames": BAD_COUNT.filter(lambda text: text not in ("0", "-0")) | st.just("1000"),
        "--output": NO_FILE | st.sampled_from(["", "sac.zip", "figure", ".png/", "."]),
        "--json": NO_FILE | st.just("."),
    },
    "plot": {
        "--algo": TEXT.filter(lambda text: text != "sac"),
        "--env": TEXT.filter(lambda text: text != "Pendulum-v1"),
        "--folder": NO_FILE,
        "--tags": TEXT,
        "--x-axis": TEXT.filter(lambda text: text not in ("steps", "episodes", "time")),
        "--y-axis": TEXT.filter(lambda text: text not in ("reward", "length")),
        "--episode-window": BAD_COUNT,
        "--mean-per": BAD_COUNT | st.just("2"),
        "--max-timesteps": BAD_COUNT | st.just("9"),
        "--output": NO_FILE | st.sampled_from(["", "sac.zip", "figure", ".png/", "."]),
        "--json": NO_FILE | st.just("."),
        "--scalars": st.none(),
        "--no-such-flag": st.none() | TEXT,
    },
    "train": {
        "--algo": TEXT.filter(lambda text: text not in ("sac", "td3", "tqc", "ddpg", "symphony", "redq", "droq", "crossq")),
        "--env": NO_ENV,
        "--gym-packages": SELECTION["--gym-packages"],
        "--n-timesteps": BAD_COUNT.filter(lambda text: text != "-1"),
        "--seed": BAD_COUNT.filter(lambda text: text not in ("0", "-0", "-1")) | st.just("2147483648"),
        "--n-seeds": BAD_COUNT,
        "--trained-agent": NO_FILE | st.sampled_from(["garbage.zip", "logs", "logs/sac/Pendulum-v1_1", "ppo.zip", "sac.zip"]),
        "--with-replay-buffer": st.none(),
        "--log-folder": st.just("sac.zip") | st.just("sac.zip/logs") | st.just("x" * 300),
        "--tensorboard-log": st.just("sac.zip") | st.just("sac.zip/logs") | st.just("x" * 300),
        "--eval-freq": NO_NUMBER,
        "--eval-episodes": BAD_COUNT,
        "--protocol": TEXT.filter(lambda text: text != "standard"),
        "--threshold": NO_NUMBER | st.sampled_from(["nan", "inf", "1"]),
        "--hyperparams": SELECTION["--env-kwargs"],
        "--conf-file": NO_FILE | st.sampled_from(["sac.zip", ".", "", "logs"]),
        "--env-kwargs": SELECTION["--env-kwargs"],
        "--eval-env-kwargs": SELECTION["--env-kwargs"],
        "--vec-env": TEXT.filter(lambda text: text not in ("dummy", "subproc")),
        "--save-freq": NO_NUMBER | st.integers(max_value=-2).map(str),
        "--keep": BAD_COUNT,
        "--resume": NO_FILE | st.sampled_from([".", "logs", "sac.zip", "logs/sac/Pendulum-v1_1"]),
        "--device": SELECTION["--device"],
        "--num-threads": NO_NUMBER,
        "--log-interval": NO_NUMBER | st.integers(max_value=-3).map(str),
        "--verbose": NO_NUMBER | st.just("3"),
        "--json": NO_FILE | st.just("."),
        "--no-such-flag": st.none() | TEXT,
    },
    "tune": {
        "--algo": TEXT.filter(lambda text: text != "sac"),
        "--env": NO_ENV,
        "--n-timesteps": BAD_COUNT.filter(lambda text: text != "-1"),
        "--n-trials": BAD_COUNT,
        "--n-startup-trials": NO_NUMBER | st.integers(max_value=-1).map(str),
        "--n-evaluations": BAD_COUNT | st.just("1000"),
        "--eval-episodes": BAD_COUNT,
        "--seed": BAD_COUNT.filter(lambda text: text not in ("0", "-0")) | st.just("2147483648"),
        "--seeds-per-trial": BAD_COUNT,
        "--n-jobs": NO_NUMBER | st.just("0") | st.integers(max_value=-2).map(str),
        "--timeout": NO_NUMBER | st.floats(max_value=-1e-9).map(str),
        "--study-name": st.sampled_from(["", ".", "..", "a/b", "ä" * 101]) | st.text("a", min_size=201, max_size=201),
        "--sampler": TEXT.filter(lambda text: text not in ("tpe", "random", "gp", "cmaes")),
        "--pruner": TEXT.filter(lambda text: text not in ("median", "halving", "hyperband", "none")),
        "--space": NO_FILE | st.sampled_from(["sac.zip", ".", "", "logs"]),
        "--hyperparams": SELECTION["--env-kwargs"],
        "--conf-file": NO_FILE | st.sampled_from(["sac.zip", ".", "", "logs"]),
        "--env-kwargs": SELECTION["--env-kwargs"],
        "--log-folder": st.just("sac.zip") | st.just("sac.zip/logs") | st.just("x" * 300),
        "--storage": st.sampled_from(["", "sac.zip/journal.log", "nothing://here", "."]),
        "--heartbeat": BAD_COUNT,
        "--device": SELECTION["--device"],
        "--num-threads": NO_NUMBER,
        "--show": st.none(),
        "--no-such-flag": st.none() | TEXT,
    },
    "bench": {
        "--n-jobs": BAD_COUNT,
        "--backend": TEXT.filter(lambda text: text not in ("loky", "ray")),
        "--algo": TEXT.filter(lambda text: text != "sac"),
        "--no-such-flag": st.none() | TEXT,
    },
    "export": SELECTION | {"--output": NO_FILE | st.sampled_from(["", "sac.zip", "actor", ".onnx/", "."])},
}


STUDY = {"algorithms": ["sac"], "environments": ["Pendulum-v1"], "seeds": 1, "steps": 100}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("malformed")
    model = SAC("MlpPolicy", "Pendulum-v1", buffer_size=10, policy_kwargs={"net_arch": [8]}, device="cpu")
    model.save(folder / "sac.zip")
    PPO("MlpPolicy", "Pendulum-v1", policy_kwargs={"net_arch": [8]}, device="cpu").save(folder / "ppo.zip")
    (folder / "garbage.zip").write_bytes(b"PK garbage")
    (folder / "study.yml").write_text(yaml.safe_dump(STUDY))
    run = folder / "logs" / "sac" / "Pendulum-v1_1"
    (run / "Pendulum-v1").mkdir(parents=True)
    (run / "Pendulum-v1" / "config.yml").write_text("n_timesteps: 10\n")
    (run / "0.monitor.csv").write_text('#{"t_start": 0.0}\nr,l,t\n1.0,10,1.0\n')
    return folder


def files(folder):
    """Files with their content, and folders."""
    return {path: path.read_bytes() if path.is_file() else None for path in folder.rglob("*")}


def refused(folder, argv):
    """Run a command that has to end in one line and exit code 2, and to leave all files as they are."""
    before = files(folder)
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            status = main(argv)
        except SystemExit as error:
            status = error.code
    lines = [line for line in err.getvalue().split("\n")[:-1] if not line.startswith("note: ")]
    assert status == 2 and len(lines) == 1 and f"{argv[0]}: error: " in lines[0], (argv, status, err.getvalue())
    assert files(folder) == before


@settings(max_examples=120, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@pytest.mark.parametrize("command", COMMANDS)
@given(data=st.data())
def test_malformed_command_lines(folder, monkeypatch, command, data):
    monkeypatch.chdir(folder)
    wrong = COMMANDS[command]
    given_flags = {"--algo": "sac", "--env": "Pendulum-v1"}
    if command == "train":
        # A slip of this test would train, shortly
        given_flags |= {"--n-timesteps": "1", "--eval-freq": "0", "--no-progress": None}
    elif command == "tune":
        given_flags |= {"--n-timesteps": "150", "--n-trials": "1", "--n-evaluations": "1", "--seeds-per-trial": "1"}
    elif command == "bench":
        given_flags = {"--dry-run": None}
    elif command != "plot":
        given_flags["--model"] = "sac.zip"
    if command == "enjoy":
        given_flags["--no-render"] = None
    for flag in data.draw(st.lists(st.sampled_from(sorted(wrong)), min_size=1, max_size=3, unique=True)):
        given_flags[flag] = data.draw(wrong[flag])
    if "--eval-env-kwargs" in given_flags:
        given_flags["--eval-freq"] = "1" if given_flags["--eval-freq"] == "0" else given_flags["--eval-freq"]
    # As --flag=value, which also takes values that look like flags
    flags = [flag if value is None else f"{flag}={value}" for flag, value in given_flags.items()]
    refused(folder, [command, *flags, *["study.yml"] * (command == "bench")])


#: plain values that YAML can hold
PLAIN = st.recursive(
    st.none() | st.booleans() | st.integers(-(10**9), -1) | st.floats() | TEXT,
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(TEXT, inner, max_size=3),
    max_leaves=5,
)
NOT_A_COUNT = st.booleans() | TEXT.filter(_no_number) | st.integers(max_value=0) | st.lists(st.integers(), min_size=1)
NOT_A_NUMBER = (
    TEXT.filter(_no_number) | st.sampled_from([float("nan"), float("inf"), -1.0]) | st.lists(st.integers(), min_size=1)
)
NOT_A_MAPPING = TEXT.filter(lambda text: not text.startswith("dict(") and text.strip() not in ("{}", "")) | st.integers(2, 9)
NO_WRAPPER = st.sampled_from(
    [
        "os.system",
        "sb3_symphony.nothing",
        "gymnasium.wrappers.RecordVideo",
        "stable_baselines3.common.vec_env.VecVideoRecorder",
        "stable_baselines3.common.monitor.Monitor",
        {"gymnasium.wrappers.TimeLimit": {"max_steps": 5}},
        {"gymnasium.wrappers.TimeLimit": 5},
        [["gymnasium.wrappers.TimeLimit"]],
        7,
    ]
)
#: key → values that are wrong
KEYS = {
    "n_timesteps": NOT_A_COUNT,
    "policy": TEXT.filter(lambda text: text not in ("MlpPolicy",)) | st.sampled_from(["CnnPolicy", "MultiInputPolicy", 3]),
    "n_envs": NOT_A_COUNT,
    "normalize": st.sampled_from([3, "yes please", {"norm_ob": True}, {"clip_obs": -1}, [1]]),
    "env_wrapper": NO_WRAPPER,
    "vec_env_wrapper": NO_WRAPPER | st.sampled_from(["stable_baselines3.common.vec_env.VecNormalize"]),
    "callback": NO_WRAPPER | st.sampled_from(["EvalCallback", {"QBiasCallback": {"nothing": 1}}]),
    "env_kwargs": NOT_A_MAPPING | st.just({"nothing": 1}),
    "frame_stack": NOT_A_COUNT,
    "noise_type": st.sampled_from(["normal", "none", 1]),
    "noise_std": NOT_A_NUMBER | st.just(0.1),
    "stop_reward": TEXT.filter(_no_number) | st.sampled_from([float("nan"), float("inf"), [1], 0]),
    "learning_rate": NOT_A_NUMBER | st.just("lin_fast") | st.just("exp_1"),
    "buffer_size": NOT_A_COUNT,
    "batch_size": NOT_A_COUNT,
    "gamma": NOT_A_NUMBER | st.just(1.5),
    "tau": NOT_A_NUMBER | st.just(2),
    "train_freq": st.sampled_from([0, "often", [1, "epoch"], [1], {"a": 1}]),
    "policy_kwargs": NOT_A_MAPPING
    | st.sampled_from([{"net_arch": [-1]}, {"activation_fn": "os.system"}, {"n_critics": 0.5}, {"net": 1}]),
    "replay_buffer_class": st.sampled_from(["os.system", "Buffer", "PrioritizedReplayBuffer", 3]),
    "action_noise": st.sampled_from(["os.system", {"NormalActionNoise": {"nothing": 1}}, 5, {"a": 1, "b": 2}]),
    "seed": st.just(1),
    "device": st.just("cpu"),
    "gama": PLAIN,
    "learning_rates": PLAIN,
}


@settings(max_examples=400, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_malformed_configurations(folder, monkeypatch, data):
    """As a file for ``-conf``, or by ``-params``."""
    monkeypatch.chdir(folder)
    names = data.draw(st.lists(st.sampled_from(sorted(KEYS)), min_size=1, max_size=2, unique=True))
    values = {name: data.draw(KEYS[name]) for name in names}
    if {"noise_type", "noise_std"} <= values.keys():
        del values["noise_std"]  # both together may be right
    argv = ["train", "--algo=sac", "--env=Pendulum-v1", "--eval-freq=0", "--no-progress"]
    if data.draw(st.booleans()):
        text = yaml.safe_dump({"n_timesteps": 1, "learning_starts": 1, **values}, allow_unicode=True)
        (folder / "malformed.yml").write_text(text, encoding="utf-8")
        argv.append("--conf-file=malformed.yml")
    else:
        pairs = [f"{name}:{json.dumps(value)}" for name, value in values.items()]
        argv += ["-n=1"] * ("n_timesteps" not in values) + ["-params", *pairs]
    refused(folder, argv)


#: key of a study → values that are wrong
STUDY_KEYS = {
    "title": st.integers() | st.lists(TEXT),
    "algorithms": TEXT | st.sampled_from([[], ["sacc"], [3], [{"algo": "sac"}], [{"name": "a", "algo": "b"}], ["sac", "sac"]]),
    "environments": TEXT | st.sampled_from([[], ["Pendulum-v7"], [3], [{"threshold": 1}], [{"id": "CartPole-v1"}]]),
    "seeds": NOT_A_COUNT.filter(lambda value: not isinstance(value, list)) | st.sampled_from([[], [-1], [1, 1], ["a"]]),
    "steps": NOT_A_COUNT,
    "protocol": TEXT.filter(lambda text: text != "standard") | st.sampled_from([{"eval_freq": -1}, {"episodes": 3}, 5]),
    "final_episodes": NO_NUMBER | st.integers(max_value=-1),
    "save_freq": NOT_A_COUNT,
    "device": TEXT.map(lambda text: f"no {text}") | st.integers(),
    "step": PLAIN,
    "algorithm": PLAIN,
}


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_malformed_studies(folder, monkeypatch, data):
    monkeypatch.chdir(folder)
    names = data.draw(st.lists(st.sampled_from(sorted(STUDY_KEYS)), min_size=1, max_size=2, unique=True))
    study = STUDY | {name: data.draw(STUDY_KEYS[name]) for name in names}
    (folder / "malformed.yml").write_text(yaml.safe_dump(study, allow_unicode=True), encoding="utf-8")
    refused(folder, ["bench", "malformed.yml", "--dry-run"])


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    text=TEXT | st.binary(max_size=200) | st.sampled_from(["!!python/object/apply:os.system [ls]", "a: !!python/name:os.x"])
)
def test_files_that_are_no_configurations(folder, monkeypatch, text):
    monkeypatch.chdir(folder)
    (folder / "malformed.yml").write_bytes(text if isinstance(text, bytes) else text.encode())
    refused(folder, ["train", "--algo=sac", "--env=Pendulum-v1", "--eval-freq=0", "--conf-file=malformed.yml"])
