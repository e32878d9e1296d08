"""
RL Zoo's own commands with our algorithms, and RL Zoo's figures of our run folders.

RL Zoo changes Gymnasium for the whole process, so it runs in processes of its own here.
"""

import ast
import json
import pickle
import re
import subprocess
import sys
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
import yaml
from torch import nn

import sb3_symphony
from sb3_symphony import REDQ, StickyActionNoise, Symphony
from sb3_symphony.experiment.config import TrainOptions
from sb3_symphony.experiment.evaluate import evaluate
from sb3_symphony.experiment.select import EvaluateOptions
from sb3_symphony.experiment.train import train

rl_zoo3 = pytest.mark.skipif(find_spec("rl_zoo3") is None, reason="rl_zoo3 is not installed (extra zoo)")

# As a stranger's file may be written: numbers without a dot, names of classes, noises, RL Zoo's dict(...) as text
CONFIG = """
Pendulum-v1:
  n_timesteps: 1e4
  learning_rate: 1e-3
  learning_starts: 100
  buffer_size: 1000
  batch_size: 16
  gradient_steps: 2
  policy_delay: 2
  n_critics: 3
  normalize: "dict(norm_obs=True, norm_reward=False)"
  env_wrapper:
    sb3_symphony.common.wrappers.RewardScale: {scale: 1e-2}
  action_noise:
    StickyActionNoise: {sigma: 0.3, decay_steps: 1000}
  policy_kwargs: "dict(net_arch=[8], activation_fn=nn.ELU)"
"""
QUICK = "learning_starts:150 buffer_size:1000 batch_size:16 gradient_steps:1 policy_kwargs.net_arch:[8]"


#: commands of RL Zoo that run one after another in one process
COMMANDS = {
    "train": "train --algo redq --env Pendulum-v1 -conf mine.yml -n 450 --seed 1 --eval-freq 200 --eval-episodes 2",
    "enjoy": "enjoy --algo redq --env Pendulum-v1 -f logs --no-render -n 200 --seed 7",
    "enjoy ours": "enjoy --algo symphony --env Pendulum-v1 -f ours --no-render -n 200 --seed 7",
    "walker": f"train --algo symphony --env BipedalWalker-v3 -n 160 --eval-freq 0 -params {QUICK}",
    "go on": "train --algo symphony --env BipedalWalker-v3 -n 160 --eval-freq 0 "
    f"-i logs/symphony/BipedalWalker-v3_1/BipedalWalker-v3.zip -params {QUICK}",
    "td3": "train --algo td3 --env Pendulum-v1 -n 120 --eval-freq 0",
    "all_plots": "all_plots -a td3 -e Pendulum-v1 -f ours --no-million -o table",
    "plot_train": "plot_train -a td3 -e Pendulum-v1 -f ours -w 2",
    "unknown key": "train --algo redq --env Pendulum-v1 -f wrong -params gradent_steps:3",
    "no file": "train --algo symphony --env Pendulum-v1 -f wrong -conf nowhere.yml",
    "wrong class": "train --algo droq --env Pendulum-v1 -f wrong -params policy_kwargs:dict(activation_fn=nn.Linear)",
    "key of ours": "train --algo droq --env Pendulum-v1 -f wrong -params stop_reward:100",
    "unknown command": "trian",
}
RUN_COMMANDS = f"""
import contextlib, io, matplotlib.pyplot as plt
from sb3_symphony.zoo import main

plt.show = lambda: None
told = {{}}
for name, command in {COMMANDS!r}.items():
    with contextlib.redirect_stdout(io.StringIO()) as out, contextlib.redirect_stderr(io.StringIO()) as err:
        status = main(command.split())
    told[name] = [status, out.getvalue(), err.getvalue()]
curves = [
    [(line.get_label(), line.get_xdata().tolist(), line.get_ydata().tolist()) for line in plt.figure(number).gca().lines]
    for number in plt.get_fignums()
]
result = dict(told=told, curves=curves)
"""


def python(folder, *arguments):
    environment = {"MPLBACKEND": "Agg", "OMP_NUM_THREADS": "1", "PYTHONPATH": str(Path(sb3_symphony.__file__).parents[1])}
    command = [sys.executable, *arguments]
    return subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, timeout=600)


def script(folder, code):
    """Run a script, and return what it leaves in ``result``."""
    done = python(folder, "-c", f"import json\n{code}\nprint('\\n' + json.dumps(result))")
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


@dataclass
class Session:
    """What the commands printed and drew, and the folder they ran in."""

    folder: Path
    told: dict
    curves: list


@pytest.fixture(scope="module")
def session(tmp_path_factory):
    """Our own runs in the folder ``ours``, then RL Zoo's commands."""
    folder = tmp_path_factory.mktemp("zoo")
    (folder / "mine.yml").write_text(CONFIG)
    small = {"learning_starts": 50, "buffer_size": 1000, "batch_size": 16, "policy_kwargs": {"net_arch": [8]}}
    common = dict(env="Pendulum-v1", log_folder=str(folder / "ours"), verbose=0, num_threads=1, eval_episodes=3)
    for seed in (1, 2):
        train(TrainOptions(algo="td3", n_timesteps=620, eval_freq=300, seed=seed, hyperparams=small, **common))
    small["normalize"] = True
    train(TrainOptions(algo="symphony", n_timesteps=100, eval_freq=0, seed=1, hyperparams=small, **common))
    return Session(folder, **script(folder, RUN_COMMANDS))


def first_return(run):
    """Return of a run's last model in the episode on seed 7."""
    return evaluate(EvaluateOptions(model=str(run), n_episodes=1, seed=7)).episodes[0].reward


def test_nothing_else_imports_the_zoo():
    for path in Path(sb3_symphony.__file__).parent.rglob("*.py"):
        if path.name == "zoo.py":
            continue
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import | ast.ImportFrom) else []
            names += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            assert not any(name.startswith("rl_zoo3") or name.endswith("zoo") for name in names), path


@pytest.mark.skipif(find_spec("rl_zoo3") is not None, reason="rl_zoo3 is installed")
def test_says_what_to_install(tmp_path):
    done = python(tmp_path, "-m", "sb3_symphony.zoo", "train")
    assert done.returncode == 2 and 'pip install "sb3-symphony[zoo]"' in done.stderr and done.stderr.count("\n") == 1


@rl_zoo3
def test_commands_succeed(session):
    failed = {name for name, (status, _, _) in session.told.items() if status != 0}
    assert failed == {"unknown key", "no file", "wrong class", "key of ours", "unknown command"}


@rl_zoo3
def test_train_reads_our_configuration(session):
    run = session.folder / "logs" / "redq" / "Pendulum-v1_1"
    model = REDQ.load(run / "Pendulum-v1.zip")
    assert model.num_timesteps == 450 and model.learning_rate == 1e-3 and model.n_critics == 3 and model.gradient_steps == 2
    assert model.policy.net_arch == [8] and model.policy.activation_fn is nn.ELU
    assert isinstance(model.action_noise, StickyActionNoise)
    stored = yaml.safe_load((run / "Pendulum-v1" / "config.yml").read_text())  # no tags, unlike RL Zoo's own
    assert stored["policy_kwargs"] == {"net_arch": [8], "activation_fn": "nn.ELU"} and stored["learning_rate"] == 0.001
    with np.load(run / "evaluations.npz") as data:
        assert data["timesteps"].tolist() == [200, 400]
        assert data["results"].mean() < -100  # raw: scaled ones would be at least -20


@rl_zoo3
@pytest.mark.parametrize("command,run", [("enjoy", "logs/redq/Pendulum-v1_1"), ("enjoy ours", "ours/symphony/Pendulum-v1_1")])
def test_enjoy_shows_raw_returns(session, command, run):
    (shown,) = re.findall(r"Episode Reward: (\S+)", session.told[command][1])
    assert float(shown) == pytest.approx(first_return(session.folder / run), abs=0.01)


@rl_zoo3
def test_shipped_settings_and_a_trained_agent_to_go_on_with(session):
    runs = session.folder / "logs" / "symphony"
    first, second = (Symphony.load(runs / f"BipedalWalker-v3_{number}" / "BipedalWalker-v3.zip") for number in (1, 2))
    assert first.n_steps == 3 and isinstance(first.action_noise, StickyActionNoise)  # of the shipped file
    stored = yaml.safe_load((runs / "BipedalWalker-v3_1" / "BipedalWalker-v3" / "config.yml").read_text())
    shipped = yaml.safe_load((Path(__file__).parents[1] / "hyperparams" / "symphony.yml").read_text())["BipedalWalker-v3"]
    # The same, each with its arguments and under its full name
    assert stored["env_wrapper"] == [each if isinstance(each, dict) else {each: {}} for each in shipped["env_wrapper"]]
    callbacks = [(name, arguments) for each in shipped["callback"] for name, arguments in each.items()]
    assert stored["callback"] == [{f"sb3_symphony.common.callbacks.{name}": arguments} for name, arguments in callbacks]
    assert second._n_updates > first._n_updates > 0


@rl_zoo3
@pytest.mark.parametrize(
    "command,message",
    [
        ("unknown key", "did you mean 'gradient_steps'"),
        ("no file", "nowhere.yml: no such file"),
        ("wrong class", "unknown class 'Linear'"),
        ("key of ours", "stop_reward"),
        ("unknown command", "did you mean 'train'"),
    ],
)
def test_mistakes_are_told_in_a_line(session, command, message):
    status, _, told = session.told[command]
    assert status == 2 and told.count("\n") == 1 and message in told
    assert not (session.folder / "wrong").exists()


@rl_zoo3
def test_other_algorithms_are_left_to_the_zoo(session):
    assert re.search(r"Loading hyperparameters from: .*rl_zoo3.hyperparams.td3.yml", session.told["td3"][1])
    assert (session.folder / "logs" / "td3" / "Pendulum-v1_1" / "Pendulum-v1.zip").exists()


@rl_zoo3
def test_figures_of_our_runs(session):
    runs = sorted((session.folder / "ours" / "td3").iterdir())
    results = []
    for run in runs:
        with np.load(run / "evaluations.npz") as data:
            results.append(data["results"])
    ((label, steps, means),), training = session.curves
    assert label == "TD3-ours" and steps == [300, 600]
    np.testing.assert_allclose(means, np.mean(results, axis=(0, 2)))
    with (session.folder / "table.pkl").open("rb") as file:
        assert f"{np.mean([result[-1] for result in results]):.0f} +/-" in str(pickle.load(file)["results_table"])

    assert {label for label, _, _ in training} == {run.name for run in runs}
    for label, steps, means in training:
        returns = np.loadtxt(runs[0].with_name(label) / "0.monitor.csv", delimiter=",", skiprows=2)[:, 0]
        assert steps == [400, 600]
        np.testing.assert_allclose(means, (returns[:-1] + returns[1:]) / 2)


@rl_zoo3
def test_own_scripts_optimise_and_load_a_trial(tmp_path):
    """Importing the bridge is enough. Samples are merged into the configuration, and each trial has a noise of its own."""
    study = "--storage studies/droq.log --study-name s"
    tune = f"--algo droq --env Pendulum-v1 -n 200 -optimize --n-trials 2 --n-startup-trials 1 --n-evaluations 1 {study}"
    tune += f" --eval-episodes 1 --no-optim-plots --seed 3 -params {QUICK}"
    tune += " action_noise:{'StickyActionNoise':{'sigma':0.3}}"
    # The command line goes before the trial, also before the very first one
    load = f"--algo droq --env Pendulum-v1 -n 160 --eval-freq 0 {study} --trial-id 0"
    load += " -params learning_starts:150 buffer_size:1000 batch_size:16 policy_kwargs.net_arch:[4]"
    seen = script(
        tmp_path,
        f"""
import sys
import optuna
import sb3_symphony.zoo
import rl_zoo3
from rl_zoo3.train import train

made = []
class Recorded(rl_zoo3.ALGOS["droq"]):
    def __init__(self, *args, **kwargs):
        super().__init__(*args, **kwargs)
        made.append(self)

rl_zoo3.ALGOS["droq"] = Recorded
for arguments in {[tune, load]!r}:
    sys.argv = ["train.py", *arguments.split()]
    train()
storage = optuna.storages.JournalStorage(optuna.storages.journal.JournalFileBackend("studies/droq.log"))
trials = optuna.load_study(storage=storage, study_name="s").trials
result = dict(
    params=[trial.params for trial in trials],
    states=[trial.state.name for trial in trials],
    arguments=[[model.policy_kwargs, model.gamma, model.gradient_steps] for model in made],
    noises=len({{id(model.action_noise) for model in made[:2]}}),
)
""",
    )
    assert seen["states"] == ["COMPLETE", "COMPLETE"] and seen["noises"] == 2
    *tuned, loaded = seen["arguments"]
    for params, (policy_kwargs, gamma, gradient_steps) in zip(seen["params"], tuned, strict=True):
        assert policy_kwargs["net_arch"] == [8] and policy_kwargs["dropout_rate"] == params["policy_kwargs.dropout_rate"]
        assert gamma == params["gamma"] and gradient_steps == 1
        assert not {"gradient_steps", "policy_kwargs.net_arch"} & params.keys()  # given, so not searched
    params = seen["params"][0]
    assert loaded[0]["net_arch"] == [4] and loaded[0]["dropout_rate"] == params["policy_kwargs.dropout_rate"]
    (path,) = tmp_path.glob("logs/droq/*/Pendulum-v1/config.yml")
    stored = yaml.safe_load(path.read_text())
    assert stored["policy_kwargs"] == {"net_arch": [4], "dropout_rate": params["policy_kwargs.dropout_rate"]}
    assert stored["tau"] == params["tau"] and stored["batch_size"] == 16
