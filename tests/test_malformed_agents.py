"""Random malformed command lines about trained agents and runs: one line, exit code 2, nothing on disk changes."""

import contextlib
import io

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from stable_baselines3 import SAC

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
NO_ENV = st.sampled_from(["Pendulum-v7", "pendulum", "", ":", "a:b", "CartPole-v1", "FrozenLake-v1", "BipedalWalker-v3"])

#: command → flag → values that are wrong
SELECTION = {
    "--model": NO_FILE,
    "--algo": TEXT.filter(lambda text: text != "sac") | st.sampled_from(["ppo", "symphony", "SAC"]),
    "--env": NO_ENV,
    "--exp-id": NO_NUMBER | st.integers(max_value=-2).map(str) | st.just("1"),
    "--load-checkpoint": NO_NUMBER | st.integers(max_value=-1).map(str) | st.integers(0, 99).map(str),
    "--vecnormalize": NO_FILE | st.just("sac.zip"),
    "--env-kwargs": TEXT.filter(lambda text: ":" not in text)
    | st.sampled_from(["nothing:1", "g:[", "g:!!python/name:os.system"]),
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
        "--output": NO_FILE | st.sampled_from(["sac.zip", "film", ".mp4/", "."]),
    },
    "gait": SELECTION
    | {
        "--n-timesteps": BAD_COUNT,
        "--skip": NEGATIVE | st.just("1e300"),
        "--window": NEGATIVE | st.just("0"),
        "--n-frames": BAD_COUNT.filter(lambda text: text not in ("0", "-0")) | st.just("1000"),
        "--output": NO_FILE | st.sampled_from(["sac.zip", "figure", ".png/", "."]),
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
        "--output": NO_FILE | st.sampled_from(["sac.zip", "figure", ".png/", "."]),
        "--json": NO_FILE | st.just("."),
        "--scalars": st.none(),
        "--no-such-flag": st.none() | TEXT,
    },
    "export": SELECTION | {"--output": NO_FILE | st.sampled_from(["sac.zip", "actor", ".onnx/", "."])},
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("malformed")
    model = SAC("MlpPolicy", "Pendulum-v1", buffer_size=10, policy_kwargs={"net_arch": [8]}, device="cpu")
    model.save(folder / "sac.zip")
    run = folder / "logs" / "sac" / "Pendulum-v1_1"
    (run / "Pendulum-v1").mkdir(parents=True)
    (run / "Pendulum-v1" / "config.yml").write_text("n_timesteps: 10\n")
    (run / "0.monitor.csv").write_text('#{"t_start": 0.0}\nr,l,t\n1.0,10,1.0\n')
    return folder


@settings(max_examples=120, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@pytest.mark.parametrize("command", COMMANDS)
@given(data=st.data())
def test_malformed_command_lines(folder, monkeypatch, command, data):
    monkeypatch.chdir(folder)
    before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    wrong = COMMANDS[command]
    given_flags = {"--algo": "sac", "--env": "Pendulum-v1"} | ({} if command == "plot" else {"--model": "sac.zip"})
    if command == "enjoy":
        given_flags["--no-render"] = None
    for flag in data.draw(st.lists(st.sampled_from(sorted(wrong)), min_size=1, max_size=3, unique=True)):
        given_flags[flag] = data.draw(wrong[flag])
    # As --flag=value, which also takes values that look like flags
    argv = [command, *(flag if value is None else f"{flag}={value}" for flag, value in given_flags.items())]
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            status = main(argv)
        except SystemExit as error:
            status = error.code
    lines = [line for line in err.getvalue().split("\n")[:-1] if not line.startswith("note: ")]
    assert status == 2 and len(lines) == 1 and f"{command}: error: " in lines[0], (argv, status, err.getvalue())
    assert {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()} == before
