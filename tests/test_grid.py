"""``bench``: a real grid, on this machine and on a Ray cluster, interrupted, killed, spoiled and gone on with."""

import json
import os
import re
import shutil
import signal
import socketserver
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import pytest
import yaml
from filelock import FileLock
from resume_helpers import assert_same_results
from test_cli import fails

from sb3_symphony.cli import main
from sb3_symphony.experiment import cell as cell_module
from sb3_symphony.experiment.cell import Control, Job, Outcome, supervise
from sb3_symphony.experiment.grid import BenchOptions, bench

SMALL = {"policy_kwargs": {"net_arch": [8]}, "learning_starts": 50, "buffer_size": 1000, "batch_size": 16}
STUDY = {
    "title": "Swing-up",
    "algorithms": [
        {"name": "td3", "overrides": SMALL},
        {"name": "sac-2", "algo": "sac", "overrides": {**SMALL, "gradient_steps": 2}},
    ],
    "environments": [{"id": "Pendulum-v1", "threshold": -1200}],
    "seeds": 2,
    "steps": 450,
    "save_freq": 100,
    "final_episodes": 2,
    "protocol": {"eval_freq": 150, "eval_episodes": 1},
    "quick": {"algorithms": ["td3"], "seeds": 1, "steps": 220, "final_episodes": 0},
}
CELLS = sorted(f"{algorithm}/Pendulum-v1_{seed}" for algorithm in ("td3", "sac-2") for seed in range(2))

CRASH = """
import os, signal
import gymnasium as gym

class CrashEnv(gym.Env):
    observation_space = gym.spaces.Box(-1.0, 1.0, (2,))
    action_space = gym.spaces.Box(-1.0, 1.0, (1,))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return self.observation_space.sample(), {}

    def step(self, action):
        if self.spec.id == "Raise-v0":
            raise RuntimeError("the motor is hot\\nsecond line")
        if self.spec.id == "Quit-v0":
            os._exit(3)
        os.kill(os.getpid(), signal.SIGKILL)

for name in ("Raise-v0", "Die-v0", "Quit-v0"):
    if name not in gym.registry:
        gym.register(name, entry_point=CrashEnv)
"""


def write_study(folder, **changes):
    path = folder / "study.yml"
    path.write_text(yaml.safe_dump({**STUDY, **changes}))
    return path


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """Results of a grid that nothing has happened to. Not to be changed: processes of pytest-xdist share them."""
    base = tmp_path_factory.getbasetemp()
    folder = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / "whole"
    with FileLock(f"{folder}.lock"):
        if not folder.exists():
            folder.mkdir()
            assert main(["bench", str(write_study(folder)), "-j", "2", "-f", str(folder / "results")]) == 0
    return folder / "results"


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def done(results):
    return sorted(str(path.parent.relative_to(results)) for path in results.glob("*/*/result.json"))


def contents(*folders):
    """Every file with its content and time of change."""
    files = (path for folder in folders for path in sorted(Path(folder).rglob("*")) if path.is_file())
    return {path: (path.read_bytes(), path.stat().st_mtime_ns) for path in files}


def assert_same_grid(a, b, cells=CELLS):
    assert done(a) == cells and done(b) == CELLS
    for name in cells:
        assert_same_results(a / name, b / name)
        x, y = (json.loads((results / name / "result.json").read_text()) for results in (a, b))
        for changing in ("seconds", "machine"):
            del x[changing], y[changing]
        assert x == y


# ----------------------------------------------------------------------------------------------------------------------
# What comes out
# ----------------------------------------------------------------------------------------------------------------------


def test_results(whole):
    assert done(whole) == CELLS
    assert {path.name for path in whole.iterdir() if not path.name.startswith(".")} == {
        *("cells.csv", "episodes.csv", "table.md", "evaluations.png", "training.png", "study.yml", "settings", "td3", "sac-2"),
    }
    run = whole / "sac-2" / "Pendulum-v1_1"
    options = yaml.safe_load((run / "Pendulum-v1" / "args.yml").read_text())
    assert (options["algo"], options["seed"], options["num_threads"], options["eval_freq"]) == ("sac", 1, 1, 150)
    config = yaml.safe_load((run / "Pendulum-v1" / "config.yml").read_text())
    assert config["n_timesteps"] == 450 and config["gradient_steps"] == 2 and config["policy_kwargs"] == {"net_arch": [8]}
    result = json.loads((run / "result.json").read_text())
    assert (result["steps"], result["updates"]) == (450, 2 * 400)
    assert result["final"]["seed"] == 20_000 and len(result["final"]["returns"]) == 2
    command = (run / "Pendulum-v1" / "command.txt").read_text()
    assert "--algo sac --env Pendulum-v1 -n 450 --seed 1 -conf" in command and "--eval-freq 150" in command
    table = (whole / "table.md").read_text()
    assert table.startswith("## Swing-up\n\n### Pendulum-v1\n") and "| td3 (non-standard)" in table
    rows = (whole / "cells.csv").read_text().splitlines()
    assert len(rows) == 1 + len(CELLS)
    episodes = (whole / "episodes.csv").read_text().splitlines()
    assert len(episodes) == 1 + len(CELLS) * (2 + 3 + 2)  # training, evaluations, at the end


def test_a_cell_is_the_run_of_its_command(whole, folder):
    run = whole / "td3" / "Pendulum-v1_1"
    command = (run / "Pendulum-v1" / "command.txt").read_text().split()
    assert main([*command[1:], "-f", "alone"]) == 0
    assert_same_results(folder / "alone" / "td3" / "Pendulum-v1_1", run)


def test_done_cells_stay_as_they_are_and_reports_are_made_anew(whole, folder, capsys):
    study = str(whole.parent / "study.yml")
    results = folder / "results"
    shutil.copytree(whole, results)
    before = contents(*(results / name for name in CELLS))
    reports = {path: path.read_bytes() for path in results.iterdir() if path.is_file()}
    assert main(["bench", study, "-f", str(results)]) == 0
    out = capsys.readouterr().out
    assert "cells to do" not in out and "### Pendulum-v1" in out and f"results in {results}" in out
    for path in reports:
        if path.suffix in (".csv", ".md", ".png"):
            path.unlink()
    assert main(["bench", study, "-f", str(results), "--report"]) == 0
    assert {path: path.read_bytes() for path in reports} == reports
    assert contents(*(results / name for name in CELLS)) == before


def test_raw_results_suffice_for_the_report(whole, folder):
    for path in whole.rglob("*"):
        if path.name in ("args.yml", "config.yml", "result.json", "0.monitor.csv", "evaluations.npz"):
            copy = folder / "raw" / path.relative_to(whole)
            copy.parent.mkdir(parents=True, exist_ok=True)
            copy.write_bytes(path.read_bytes())
    assert main(["bench", str(whole.parent / "study.yml"), "-f", "raw", "--report"]) == 0
    for name in ("cells.csv", "episodes.csv", "table.md", "evaluations.png", "training.png"):
        assert (folder / "raw" / name).read_bytes() == (whole / name).read_bytes()


def test_curves_are_drawn_of_unfinished_runs_too(whole, folder):
    shutil.copytree(whole, folder / "results")
    for name in CELLS:
        (folder / "results" / name / "result.json").unlink()
    assert main(["bench", str(whole.parent / "study.yml"), "-f", "results", "--report"]) == 0
    for name in ("evaluations.png", "training.png"):
        assert (folder / "results" / name).read_bytes() == (whole / name).read_bytes()
    assert re.search(r"td3 \(non-standard\) +\| 0 of 2 ", (folder / "results" / "table.md").read_text())


def test_a_study_beside_is_left_alone(folder, capsys, monkeypatch):
    (folder / "mine" / "inside").mkdir(parents=True)
    write_study(folder / "mine").rename(folder / "mine" / "other.yml")
    kept = write_study(folder / "mine", seeds=1)
    monkeypatch.chdir(folder / "mine")
    for flags in ([], ["--dry-run"]):
        assert main(["bench", "other.yml", "-f", ".", *flags]) == 2
        (error,) = capsys.readouterr().err.splitlines()
        assert f"-f: '{folder / 'mine'}' has a study.yml of its own" in error
    assert yaml.safe_load(kept.read_text()) == {**STUDY, "seeds": 1}
    assert sorted(path.name for path in (folder / "mine").iterdir()) == ["inside", "other.yml", "study.yml"]


def test_results_are_named_after_the_folder_of_a_study(folder, monkeypatch):
    (folder / "mine" / "inside").mkdir(parents=True)
    write_study(folder / "mine")
    monkeypatch.chdir(folder / "mine" / "inside")
    assert bench(BenchOptions(study="../study.yml", dry_run=True)).folder == folder / "mine" / "inside" / "logs/bench/mine"


def test_dry_run(whole, folder, capsys):
    study = str(whole.parent / "study.yml")
    assert main(["bench", study, "--dry-run"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 2 + len(CELLS) and re.search(r"^td3/Pendulum-v1_0 +queued +0 / 450$", lines[1])
    assert lines[-1] == f"{len(CELLS)} queued" and list(folder.iterdir()) == []
    assert fails(capsys, "bench", study, "--dry-run", "-f", "x" * 300).endswith("cannot be read — File name too long\n")
    assert main(["bench", study, "--dry-run", "-f", str(whole)]) == 0
    assert capsys.readouterr().out.splitlines()[-1] == f"{len(CELLS)} done"


def test_quick_and_then_longer(folder, capsys):
    study = write_study(folder)
    assert main(["bench", str(study), "--quick"]) == 0
    results = folder / "logs" / "bench" / f"{folder.name}_quick"
    assert done(results) == ["td3/Pendulum-v1_0"]
    assert "final" not in json.loads((results / "td3" / "Pendulum-v1_0" / "result.json").read_text())
    quick = {**STUDY["quick"], "steps": 300, "final_episodes": 1}
    assert main(["bench", str(write_study(folder, quick=quick, device="auto")), "--quick"]) == 0  # may go on elsewhere
    assert "device: auto" in (results / "td3" / "Pendulum-v1_0" / "Pendulum-v1" / "args.yml").read_text()
    result = json.loads((results / "td3" / "Pendulum-v1_0" / "result.json").read_text())
    assert result["steps"] == 300 and len(result["final"]["returns"]) == 1
    assert "resumed at 220" in (results / "td3" / "Pendulum-v1_0.log").read_text()
    shutil.rmtree(results / "td3" / "Pendulum-v1_0" / "checkpoints")  # as one may, of cells that are done
    assert main(["bench", str(write_study(folder, quick={**quick, "final_episodes": 2})), "--quick"]) == 0
    again = json.loads((results / "td3" / "Pendulum-v1_0" / "result.json").read_text())
    assert len(again["final"]["returns"]) == 2 and again["seconds"] == result["seconds"]
    quick = {**quick, "final_episodes": 2}
    capsys.readouterr()
    before = contents(results)
    message = fails(capsys, "bench", str(write_study(folder, quick={**quick, "steps": 250})), "--quick")
    assert "td3/Pendulum-v1_0: has 300 steps, the study 250 — expected as many or more, or another -f" in message
    assert contents(results) == before


def test_a_changed_study_does_not_mix_with_old_results(whole, folder, capsys):
    before = contents(whole)
    changed = {**SMALL, "batch_size": 32}
    study = write_study(folder, algorithms=[{"name": "td3", "overrides": changed}])
    message = fails(capsys, "bench", str(study), "-f", str(whole))
    assert "td3/Pendulum-v1_0: was trained with batch_size 16, the study has 32 — expected the same, or another -f" in message
    study = write_study(folder, protocol={"eval_freq": 150, "eval_episodes": 3})
    assert "eval_episodes 1, the study has 3" in fails(capsys, "bench", str(study), "-f", str(whole), "--report")
    assert contents(whole) == before


def test_the_threshold_decides_which_evaluations_there_are(folder, capsys):
    """Under the standard protocol those after it are fewer; that of the environment counts if none is given."""
    parts = dict(algorithms=STUDY["algorithms"][:1], seeds=1, steps=120, final_episodes=0, protocol="standard")
    own = write_study(folder, **parts, environments=[{"id": "Pendulum-v1", "threshold": -2000}])
    assert main(["bench", str(own), "-f", "results"]) == 0
    capsys.readouterr()
    registered = write_study(folder, **parts, environments=["Pendulum-v1"])
    message = fails(capsys, "bench", str(registered), "-f", "results", "--report")
    assert "was trained with threshold -2000.0, the study has None" in message


# ----------------------------------------------------------------------------------------------------------------------
# What happens to it
# ----------------------------------------------------------------------------------------------------------------------


def start(study, results, *flags):
    """A grid in a process group of its own."""
    command = [sys.executable, "-m", "sb3_symphony", "bench", str(study), "-j", "2", "-f", str(results), *flags]
    return subprocess.Popen(command, start_new_session=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)


def wait_for(condition, process):
    while not condition():
        assert process.poll() is None, process.communicate()[0]
        time.sleep(0.05)


def half_done(results):
    """Whether a cell that is not done has made a checkpoint."""
    with_checkpoint = {str(path.parents[1].relative_to(results)) for path in results.glob("*/*/checkpoints/*.ckpt")}
    return with_checkpoint - set(done(results))


def test_interrupted_and_killed(whole, folder):
    """Ctrl-C, then ``kill -9`` of all its processes: what is done stays as it is, the rest goes on, bit for bit."""
    results = folder / "results"
    process = start(whole.parent / "study.yml", results)
    wait_for(lambda: half_done(results), process)
    os.killpg(process.pid, signal.SIGINT)
    out = process.communicate()[0]
    assert process.returncode == 130 and "the same command goes on" in out and "Traceback" not in out, out
    assert len(done(results)) < len(CELLS) and not (results / ".session").exists()

    first = done(results)
    process = start(whole.parent / "study.yml", results)
    wait_for(lambda: len(done(results)) > len(first) and half_done(results), process)
    os.killpg(process.pid, signal.SIGKILL)
    process.communicate()
    finished = done(results)
    assert len(finished) < len(CELLS)
    before = contents(*(results / name for name in finished))

    assert main(["bench", str(whole.parent / "study.yml"), "-j", "2", "-f", str(results)]) == 0
    assert contents(*(results / name for name in finished)) == before
    assert_same_grid(results, whole)


def test_killed_alone(whole, folder):
    """``kill -9`` of the command itself: its workers live on, and make way for those of the same command at once."""
    command = whole.parent / "study.yml", folder / "results", "-a", "td3"
    process = start(*command)
    wait_for(lambda: half_done(folder / "results"), process)
    process.kill()
    process.wait()
    process.stdout.close()
    again = start(*command)
    out = again.communicate()[0]
    assert again.returncode == 0 and "failed" not in out, out
    assert_same_grid(folder / "results", whole, [name for name in CELLS if name.startswith("td3/")])


def test_a_failed_cell_stops_nothing(folder, monkeypatch, capsys):
    (folder / "crash.py").write_text(CRASH)
    monkeypatch.setenv("PYTHONPATH", str(folder))
    monkeypatch.syspath_prepend(folder)
    environments = [{"id": f"crash:{name}-v0"} for name in ("Raise", "Die", "Quit")] + ["Pendulum-v1"]
    study = write_study(folder, environments=environments, algorithms=STUDY["algorithms"][:1], seeds=1, steps=210)
    assert main(["bench", str(study), "-j", "1", "-f", "results"]) == 1
    out, err = capsys.readouterr()
    assert "failed: td3/Raise-v0_0: RuntimeError: the motor is hot (see" in err
    assert "failed: td3/Die-v0_0: its process was ended by SIGKILL (out of memory?)" in err
    assert "failed: td3/Quit-v0_0: its process ended with code 3 (see" in err
    assert "- not done, and not in these numbers: td3 0" in out
    assert done(folder / "results") == ["td3/Pendulum-v1_0"]
    assert "Traceback" in (folder / "results" / "td3" / "Raise-v0_0.log").read_text()


def test_disk_that_fills_up(small_disk, whole, folder, capsys):
    """Before anything begins, and while a cell is trained; once there is room, the same command goes on, bit for bit."""
    study = write_study(folder, algorithms=STUDY["algorithms"][:1], seeds=1)
    results, filler = small_disk / "results", small_disk / "filler"
    command = ["bench", str(study), "-j", "1", "-f", str(results)]
    (results / "settings").mkdir(parents=True)  # which results have, unlike other folders with a study.yml
    (results / "study.yml").write_text("an earlier one")
    with filler.open("wb", buffering=0) as file, suppress(OSError):
        while file.write(bytes(1024)):
            pass
    assert "results' cannot be written: No space left on device — once there is room, the" in fails(capsys, *command)
    assert (results / "study.yml").read_text() == "an earlier one"

    os.truncate(filler, filler.stat().st_size - 40_000)
    assert main(command) in (1, 2)  # 2: the report has no room either
    lines = [line for line in capsys.readouterr().out.splitlines() if line.startswith("failed td3/Pendulum-v1_0 ")]
    assert len(lines) == 1 and "No space left on device" in lines[0]

    subprocess.run(["mount", "-o", "remount,size=16m", str(small_disk)], check=True)
    assert main(command) == 0
    assert_same_results(results / "td3" / "Pendulum-v1_0", whole / "td3" / "Pendulum-v1_0")


def test_two_at_once_are_refused(folder, capsys):
    (folder / "results").mkdir()
    with FileLock(folder / "results" / ".lock"):
        assert "is being worked on by another process" in fails(capsys, "bench", str(write_study(folder)), "-f", "results")


# ----------------------------------------------------------------------------------------------------------------------
# Workers
# ----------------------------------------------------------------------------------------------------------------------


@pytest.fixture
def job(folder):
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, [])  # a worker's is changed, and those here are in the tests' own process
    yield _job(folder)
    signal.pthread_sigmask(signal.SIG_SETMASK, mask)


def _job(folder):
    options = {"algo": "td3", "env": "Pendulum-v1", "n_timesteps": 10**6, "seed": 0, "save_freq": 100, "hyperparams": SMALL}
    options |= {"num_threads": 1, "eval_freq": 0, "verbose": 0, "progress": False}
    (folder / "session").mkdir()
    job = Job("td3/x", options, str(folder / "td3" / "x"), 0, {}, str(folder / "session"))
    job.control.say(0)
    return job


def test_nothing_begins_after_a_stop(job):
    job.control.say(1)
    assert supervise(job) == Outcome("queued")
    assert not job.started.exists() and not job.log.exists()


def test_a_cell_whose_worker_dies_does_not_go_on(job):
    """Else it would be in the way of the next worker that is to go on with it."""
    code = f"from sb3_symphony.experiment.cell import *; supervise(Job(**{vars(job)!r}))"
    worker = subprocess.Popen([sys.executable, "-c", code])
    wait_for(lambda: list(Path(job.run).glob("checkpoints/*.ckpt")), worker)
    children = Path(f"/proc/{worker.pid}/task/{worker.pid}/children").read_text().split()
    assert len(children) == 1
    worker.kill()
    worker.wait()
    deadline = time.monotonic() + 60
    while Path(f"/proc/{children[0]}").exists() and time.monotonic() < deadline:
        time.sleep(0.1)
    assert not Path(f"/proc/{children[0]}").exists()


def test_a_cell_saves_and_stops_when_nobody_is_left_to_tell(job):
    """As if the machine of the one who started the grid had gone: no sign of life any more."""
    code = "import sys; from sb3_symphony.experiment import cell; cell.PATIENCE = 3.0; sys.exit(cell.main())"
    process = subprocess.Popen([sys.executable, "-c", code], stdin=subprocess.PIPE, text=True)
    process.stdin.write(json.dumps(vars(job)))
    process.stdin.close()
    control, run = job.control, Path(job.run)

    def alive_until_checkpoint():
        control.say(0)
        return list(run.glob("checkpoints/*.ckpt"))

    wait_for(alive_until_checkpoint, process)
    assert process.wait() == cell_module._STOPPED
    assert (run / "Pendulum-v1.zip").is_file() and not (run / "result.json").exists()


def test_reading_while_it_is_written(folder):
    control = Control(folder / "control.json")
    assert control.heard() is None
    control.say(0)
    control.say(2)
    assert control.heard() == {"beat": 2, "stop": 2}
    control.path.write_text('{"beat')
    assert control.heard() is None


# ----------------------------------------------------------------------------------------------------------------------
# Ray
# ----------------------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def cluster():
    """A Ray cluster of two machines, with a core each, on this one."""
    pytest.importorskip("ray", reason="ray is not installed")
    from ray.cluster_utils import Cluster

    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    memory = {"object_store_memory": 80 * 2**20}
    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1, "include_dashboard": False, **memory})
    cluster.add_node(num_cpus=1, **memory)
    yield cluster
    cluster.shutdown()


def test_ray_gives_the_same_results(whole, cluster, folder):
    study = str(whole.parent / "study.yml")
    assert main(["bench", study, "--backend", "ray", "--address", cluster.address, "-f", str(folder / "results")]) == 0
    assert_same_grid(folder / "results", whole)
    results = [json.loads((folder / "results" / name / "result.json").read_text()) for name in CELLS]
    assert len(results) == 4


def test_a_folder_that_is_not_shared_is_refused(cluster, folder, capsys):
    # Each process has another one of that name
    study = write_study(folder)
    argv = ["bench", str(study), "--backend", "ray", "--address", cluster.address, "-f", "/proc/self/cwd/results"]
    assert "does not see '/proc/self/cwd/results/.session' — expected a folder that all machines share" in fails(capsys, *argv)
    assert [path.name for path in folder.iterdir()] == ["study.yml"]


@pytest.fixture
def die_once():
    """A function that ends its process the first time. Not importable, so that it travels to workers as it is."""

    def once(path):
        if Path(path).exists():
            return "second time"
        Path(path).touch()
        os.kill(os.getpid(), signal.SIGKILL)

    return once


def test_a_worker_of_ray_that_dies_is_replaced(cluster, folder, die_once):
    from sb3_symphony.experiment.backends import Ray

    backend = Ray(None, cluster.address, gpus=False)
    try:
        results = dict(backend.map(die_once, [str(folder / "a"), str(folder / "b")]))
    finally:
        backend.close()
    assert results == {str(folder / "a"): "second time", str(folder / "b"): "second time"}


def test_a_worker_of_loky_that_dies_is_replaced(folder, die_once):
    from sb3_symphony.experiment.backends import Loky

    backend = Loky(2)
    try:
        results = dict(backend.map(die_once, [str(folder / name) for name in "abc"]))
        assert results == {str(folder / name): "second time" for name in "abc"}
        ((_, error),) = backend.map(lambda _: os.kill(os.getpid(), signal.SIGKILL), [0])
        assert isinstance(error, Exception)
    finally:
        backend.close()


# ----------------------------------------------------------------------------------------------------------------------
# Mistakes
# ----------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "changes, message",
    [
        ({"environments": ["Pendulum-v2"]}, "td3 on Pendulum-v2: unknown environment 'Pendulum-v2'"),
        ({"environments": ["Pendulum-v1", "BipedlWalker-v3"]}, "did you mean 'BipedalWalker-v3'?"),
        ({"algorithms": [{"name": "td3", "overrides": {"gama": 1}}]}, "unknown hyper-parameter 'gama' for td3: did you mean"),
        ({"algorithms": [{"name": "td3", "conf": "nothing.yml"}]}, "nothing.yml: no such file"),
        ({"protocol": "standard", "environments": [{"id": "Pendulum-v1", "env_kwargs": {"g": 9.0}}]}, "env_kwargs: 'g'"),
        ({"device": "tpu"}, "'tpu'"),
        ({"matrix": {"label": "g", "conditions": {1: {"env_kwargs": {"gg": 1}}}}}, "condition '1': environment 'Pendulum-v1'"),
        ({"matrix": {"label": "w", "conditions": {"a": {"env_wrapper": "gymnasium.wrappers.TimeLimt"}}}}, "did you mean"),
        (
            {
                "matrix": {
                    "label": "n",
                    "conditions": {2: {"env_wrapper": {"gymnasium.wrappers.FrameStackObservation": {"stack_size": 2}}}},
                }
            },
            "td3 on Pendulum-v1: condition '2': the model does not fit Pendulum-v1: observation space of the model",
        ),
        (
            {
                "matrix": {
                    "label": "s",
                    "conditions": {2: {"env_wrapper": {"sb3_symphony.common.wrappers.RewardScale": {"scale": 2.0}}}},
                }
            },
            "condition '2': env_wrapper: 'sb3_symphony.common.wrappers.RewardScale' — is for training only",
        ),
        ({"sead": 3}, "unknown option 'sead': did you mean 'seeds'?"),
    ],
)
def test_mistakes_in_a_study_leave_nothing(folder, capsys, changes, message):
    study = write_study(folder, quick={"seeds": 1}, **changes)
    assert message in fails(capsys, "bench", str(study))
    assert [path.name for path in folder.iterdir()] == ["study.yml"]


def test_what_others_have_put_there_is_not_touched(folder, capsys):
    study = str(write_study(folder))
    mine = folder / "logs" / "td3" / "Pendulum-v1_1"
    (mine / "Pendulum-v1").mkdir(parents=True)
    (mine / "Pendulum-v1" / "config.yml").touch()  # so far it might be of a process that died as its run began
    (mine / "thesis.txt").write_text("all my work")
    message = fails(capsys, "bench", study, "-f", "logs")
    assert "Pendulum-v1_1' is there already, with thesis.txt — expected another -f" in message
    assert (mine / "thesis.txt").read_text() == "all my work"


def test_a_process_that_died_as_its_run_began(job):
    run = Path(job.run)
    (run / "Pendulum-v1").mkdir(parents=True)
    (run / "checkpoints").mkdir()
    for name in ("Pendulum-v1/config.yml", "Pendulum-v1/.command.txt.tmp", "checkpoints/.lock"):
        (run / name).touch()
    assert supervise(replace(job, options={**job.options, "n_timesteps": 210})) == Outcome("done")
    assert json.loads((run / "result.json").read_text())["steps"] == 210


def test_other_mistakes_leave_nothing(folder, capsys):
    study = str(write_study(folder))
    assert "nothing.yml: no such file — expected a YAML file of a study" in fails(capsys, "bench", "nothing.yml")
    assert "--report: no results in" in fails(capsys, "bench", study, "--report")
    assert "--address: 'auto' — is for --backend ray" in fails(capsys, "bench", study, "--address", "auto")
    assert "n_jobs: 0 — expected" in fails(capsys, "bench", study, "-j", "0")
    assert "unknown backend 'dask'" in fails(capsys, "bench", study, "--backend", "dask")
    assert "-f: 'study.yml/results' cannot be written" in fails(capsys, "bench", study, "-f", "study.yml/results").replace(
        f"{folder}/", ""
    )
    assert [path.name for path in folder.iterdir()] == ["study.yml"]


class Hello(socketserver.BaseRequestHandler):
    """Speaks as soon as somebody calls, and not HTTP/2."""

    def handle(self):
        self.request.sendall(b"SSH-2.0-none\r\n")


def test_an_address_where_nobody_answers(folder, capsys):
    pytest.importorskip("ray", reason="ray is not installed")
    study = str(write_study(folder, seeds=1))
    ray = ["bench", study, "--backend", "ray", "--address"]
    assert "nobody answers at '127.0.0.1:1' — Connection refused" in fails(capsys, *ray, "127.0.0.1:1")
    assert "'ray://127.0.0.1:1' — Connection refused" in fails(capsys, *ray, "ray://127.0.0.1:1")
    with socketserver.TCPServer(("127.0.0.1", 0), Hello) as other, ThreadPoolExecutor() as pool:
        pool.submit(other.serve_forever)
        address = f"127.0.0.1:{other.server_address[1]}"
        assert f"--address: what answers at '{address}' is no Ray cluster" in fails(capsys, *ray, address)
        other.shutdown()
    assert "'nonsense' — expected auto, HOST:PORT or ray://HOST:PORT" in fails(capsys, *ray, "nonsense")
    assert [path.name for path in folder.iterdir()] == ["study.yml"]


def test_results_are_not_collected_into_themselves(whole, folder, capsys):
    shutil.copytree(whole, folder / "copy")
    (folder / "link").symlink_to(folder / "copy")
    study, runs = str(whole.parent / "study.yml"), [folder / "copy" / name for name in CELLS]
    page = folder / "pages" / "page.md"
    page.parent.mkdir()
    page.write_text("<!-- results -->\nold\n<!-- /results -->\n")
    (folder / "copy" / "table.md").unlink()
    before = contents(*runs, page.parent)
    for name in ("copy", "link", "link/../copy"):
        message = fails(capsys, "bench", study, "-f", "copy", "--report", "--page", str(page), "--collect", name)
        assert "expected another folder than that of the results" in message
    message = fails(capsys, "bench", study, "-f", "copy", "--report", "--page", str(page), "--collect", str(page))
    assert "--collect: " in message and "it is no folder" in message
    assert contents(*runs, page.parent) == before and not (folder / "copy" / "table.md").exists()
    assert "collect: ''" in fails(capsys, "bench", study, "-f", "copy", "--report", "--collect", "")


def test_a_result_that_is_none(whole, folder, capsys):
    shutil.copytree(whole, folder / "copy")
    (folder / "copy" / "td3" / "Pendulum-v1_0" / "result.json").write_text("{}")
    assert main(["bench", str(whole.parent / "study.yml"), "-f", "copy", "--dry-run"]) == 0
    assert capsys.readouterr().out.splitlines()[-1] == f"1 queued, {len(CELLS) - 1} done"
