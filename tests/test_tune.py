"""Sweeps: which trials are run, what is told to Optuna, and what is found. Most trainings are played, some are real."""

import csv
import json
import os
import signal
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import optuna
import pytest
import yaml
from optuna.trial import FrozenTrial, TrialState
from tune_helpers import CONFIGURATION, SPACE

from sb3_symphony.cli import main
from sb3_symphony.experiment import tune as tune_module
from sb3_symphony.experiment.config import ConfigError, RunConfig
from sb3_symphony.experiment.space import TuneOptions
from sb3_symphony.experiment.sweep_report import PLAN, SweepReport, reason_of, trials_table
from sb3_symphony.experiment.sweep_storage import JournalSweep, open_storage
from sb3_symphony.experiment.trial import TrialFailed
from sb3_symphony.experiment.tune import RETRIES, ProgramError, tune

DRAW = SweepReport._draw
COMPLETE, PRUNED, FAIL = TrialState.COMPLETE, TrialState.PRUNED, TrialState.FAIL


class Played:
    """Stands for the trainings of a trial."""

    #: mean returns of each seed, or what is raised, for a trial's configuration
    script: Callable[[RunConfig], Any]
    started: list[RunConfig]

    def __init__(self, options: Any, config: RunConfig, seeds: list[int], n_evaluations: int) -> None:
        type(self).started.append(config)
        self.n_evaluations = n_evaluations
        self.reported = 0
        self.outcome = type(self).script(config)
        self.returns = [[] for _ in seeds]
        reader, writer = os.pipe()
        os.write(writer, b"ready")
        os.close(writer)
        self.ready = os.fdopen(reader)

    @property
    def connections(self) -> list[Any]:
        return [self.ready]

    def poll(self) -> list[float]:
        if isinstance(self.outcome, BaseException):
            raise self.outcome
        self.reported += 1
        self.returns = [list(returns[: self.reported]) for returns in self.outcome]
        return [float(np.mean([returns[-1] for returns in self.returns]))]

    @property
    def finished(self) -> bool:
        return self.reported == self.n_evaluations

    def stop(self) -> None:
        self.ready.close()


@pytest.fixture
def played(monkeypatch):
    """Trainings whose returns grow with the learning rate; ``played.script`` may be changed."""
    made = type("Made", (Played,), {"started": [], "script": staticmethod(lambda config: rising(config))})
    monkeypatch.setattr(tune_module, "TrialProcesses", made)
    monkeypatch.setattr(SweepReport, "_draw", lambda self: None)  # it takes longest
    return made


def rising(config: RunConfig) -> list[list[float]]:
    """Two seeds, three evaluations."""
    rate = config.arguments["learning_rate"]
    return [[1.0 + rate, 2.0 + rate, 3.0 + rate], [2.0 + rate, 3.0 + rate, 4.0 + rate]]


@pytest.fixture
def options(tmp_path, monkeypatch):
    """``options(**changes)``: of a sweep of 5 trials, two seeds, three evaluations."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "space.yml").write_text(yaml.safe_dump(SPACE))
    (tmp_path / "conf.yml").write_text(yaml.safe_dump(CONFIGURATION))
    defaults = {"algo": "ppo", "env": "tune_helpers:Line-v0", "space": "space.yml", "conf_file": "conf.yml", "n_trials": 5}
    defaults |= {"n_evaluations": 3, "eval_episodes": 2, "seeds_per_trial": 2, "n_startup_trials": 3, "pruner": "none"}
    return lambda **changes: TuneOptions(**{**defaults, **changes})


def trials_of(options: TuneOptions) -> list[FrozenTrial]:
    """Trials of the sweep's study."""
    storage = open_storage(options.where, lambda: None, 1)
    try:
        return optuna.load_study(study_name=options.name, storage=storage.optuna).trials
    finally:
        storage.close()


def states(options: TuneOptions) -> list[TrialState]:
    """State of each trial."""
    return [trial.state for trial in trials_of(options)]


# Which trials are run -------------------------------------------------------------------------------------------------


def test_a_study_gets_as_many_trials_as_are_wanted(played, options):
    tune(options())
    assert states(options()) == [COMPLETE] * 5
    tune(options())
    assert len(played.started) == 5  # nothing was left to do
    tune(options(n_trials=7, n_jobs=4))
    assert states(options()) == [COMPLETE] * 7 and len(played.started) == 7


def test_value_is_the_mean_over_seeds_of_the_last_evaluation(played, options):
    tune(options())
    for trial in trials_of(options()):
        rate = trial.params["learning_rate"]
        assert trial.intermediate_values == pytest.approx({1: 1.5 + rate, 2: 2.5 + rate, 3: 3.5 + rate})
        assert trial.value == pytest.approx(3.5 + rate)
        assert trial.user_attrs["returns"] == pytest.approx([3.0 + rate, 4.0 + rate])


def test_pruned_on_the_mean_over_seeds(played, options):
    outcomes = [
        [[0, 0, 0], [4, 4, 4]],
        [[1, 1, 1], [3, 3, 3]],
        [[9, 9, 9], [-9, -9, 9]],  # its first seed is the best of all
        [[-9, -9, 9], [99, 99, 9]],  # its first seed is the worst of all
        [[0, 0, 0], [0, 0, 0]],
    ]
    played.script = staticmethod(lambda config: outcomes[len(played.started) - 1])
    tune(options(pruner="median", n_startup_trials=2))
    trials = trials_of(options())
    assert [trial.state for trial in trials] == [COMPLETE, COMPLETE, PRUNED, COMPLETE, PRUNED]
    assert trials[2].intermediate_values == {1: 0.0} and trials[2].value == 0.0
    assert trials[2].user_attrs["returns"] == [9, -9]


def test_hyper_parameters_are_merged_into_the_configuration(played, options):
    tune(options(hyperparams={"policy_kwargs.ortho_init": False, "gamma": 0.5}, n_timesteps=120))
    for config, trial in zip(played.started, trials_of(options()), strict=True):
        assert set(trial.params) == {"learning_rate", "n_epochs", "policy_kwargs.net_arch"}
        net_arch = {"[8]": [8], '{"pi": [16], "vf": [8]}': {"pi": [16], "vf": [8]}}[trial.params["policy_kwargs.net_arch"]]
        assert config.arguments == {
            "n_steps": 16,
            "batch_size": 16,
            "gamma": 0.5,
            "learning_rate": trial.params["learning_rate"],
            "n_epochs": trial.params["n_epochs"],
            "policy_kwargs": {"ortho_init": False, "net_arch": net_arch},
        }
        assert config.settings.n_timesteps == 120


@pytest.mark.parametrize("sampler", ["tpe", "random", "gp", "cmaes"])
def test_samplers_depend_on_seed_and_number_only(played, options, tmp_path, sampler):
    for name, parts in {"once": [8], "twice": [4, 8]}.items():
        for n_trials in parts:
            tune(options(sampler=sampler, n_trials=n_trials, log_folder=name))
    once, twice = (trials_of(options(log_folder=name)) for name in ("once", "twice"))
    assert [trial.params for trial in once] == [trial.params for trial in twice]
    assert len({trial.params["learning_rate"] for trial in once}) >= 5
    tune(options(sampler=sampler, n_trials=1, log_folder="other", seed=7))
    assert trials_of(options(log_folder="other"))[0].params != once[0].params


@pytest.mark.parametrize("pruner", ["median", "halving", "hyperband", "none"])
def test_pruners(played, options, pruner):
    played.script = staticmethod(lambda config: [[1 / len(played.started)] * 3] * 2)  # worse from trial to trial
    tune(options(pruner=pruner, n_trials=20))
    found = states(options())
    assert (PRUNED in found) == (pruner != "none")
    assert COMPLETE in found and set(found) <= {COMPLETE, PRUNED}


def test_timeout_begins_no_more_trials(played, options, capsys):
    def slow(config: RunConfig) -> Any:
        time.sleep(0.4)
        return rising(config)

    played.script = staticmethod(slow)
    tune(options(timeout=1.0, n_trials=100))
    assert 1 <= len(trials_of(options())) <= 3
    assert states(options())[-1] == COMPLETE  # what has begun is finished


# What goes wrong ------------------------------------------------------------------------------------------------------


def test_failed_trials_keep_their_reason_and_are_not_repeated(played, options, capsys):
    def script(config: RunConfig) -> Any:
        return TrialFailed("seed 100: diverged: nan", "failed") if len(played.started) in (2, 3) else rising(config)

    played.script = staticmethod(script)
    result = tune(options())
    trials = trials_of(options())
    assert [trial.state for trial in trials] == [COMPLETE, FAIL, FAIL, COMPLETE, COMPLETE]
    assert [reason_of(trial) for trial in trials] == ["", "seed 100: diverged: nan", "seed 100: diverged: nan", "", ""]
    assert "failed 2 ×: seed 100: diverged: nan" in result.summary
    assert "trial 1 failed: seed 100: diverged: nan" in capsys.readouterr().out


def test_parameters_that_cannot_be_combined_are_a_reason_too(played, options, tmp_path):
    # Each value is fine beside the first of the others
    (tmp_path / "space.yml").write_text("noise_type: [null, normal]\nnoise_std: [null, 0.1]\nlearning_rate: [1e-3, 1e-4]\n")
    (tmp_path / "conf.yml").write_text(yaml.safe_dump({"n_timesteps": 30, "policy_kwargs": {"net_arch": [8]}}))
    with pytest.raises(ConfigError, match="noise_type and noise_std: expected both or neither"):
        tune(options(algo="td3"))
    (tmp_path / "space.yml").write_text("n_envs: [1, 8]\nn_timesteps: [100, 12]\nlearning_rate: [1e-3, 1e-4]\n")
    (tmp_path / "conf.yml").write_text("n_steps: 16\nbatch_size: 16\nn_timesteps: 100\n")
    tune(options(n_trials=12, sampler="random"))
    found = {}
    for trial in trials_of(options()):
        bad = (trial.params["n_envs"], trial.params["n_timesteps"]) == (8, 12)
        found[bad] = [*found.get(bad, []), (trial.state, reason_of(trial))]
    assert set(found[False]) == {(COMPLETE, "")}
    assert {state for state, _ in found[True]} == {FAIL} and "--n-evaluations: 3" in found[True][0][1]


def test_trials_whose_process_died_are_repeated(played, options):
    died = TrialFailed("seed 100: its process was ended by SIGKILL", "died")
    played.script = staticmethod(lambda config: died if len(played.started) == 2 else rising(config))
    tune(options())
    trials = trials_of(options())
    assert [trial.state for trial in trials] == [COMPLETE, FAIL, COMPLETE, COMPLETE, COMPLETE, COMPLETE]
    assert trials[2].params == trials[1].params
    assert trials[2].system_attrs["retry_history"] == [1] and "reason" not in trials[2].user_attrs
    row = list(csv.DictReader(open("logs/ppo/tune/ppo-Line-v0/trials.csv")))[2]
    assert row["retry_of"] == "1"


def test_repetition_has_an_end(played, options):
    played.script = staticmethod(lambda config: TrialFailed("seed 100: its process was ended by SIGSEGV", "died"))
    tune(options(n_trials=2))
    trials = trials_of(options())
    assert [trial.state for trial in trials] == [FAIL] * 2 * (1 + RETRIES)
    assert all(reason_of(trial) == "seed 100: its process was ended by SIGSEGV" for trial in trials)
    assert len({str(trial.params) for trial in trials}) == 2
    assert "no trial has completed" in tune(options(n_trials=2)).summary
    assert len(trials_of(options())) == 2 * (1 + RETRIES)


def test_mistakes_in_the_program_end_the_sweep(played, options):
    bug = TrialFailed("Traceback\n  here\nTypeError: no", "error")
    played.script = staticmethod(lambda config: bug if len(played.started) == 3 else rising(config))
    with pytest.raises(ProgramError, match="TypeError: no"):
        tune(options(n_jobs=2))
    trials = trials_of(options())
    assert [trial.state for trial in trials if "retry_history" not in trial.system_attrs].count(FAIL) >= 1
    assert "TypeError: no" in [reason_of(trial) for trial in trials]
    tune(options())  # once it has been mended, nothing is lost
    trials = trials_of(options())
    assert sum(trial.state == COMPLETE for trial in trials) == 5
    assert all(trial.state.is_finished() for trial in trials)


def test_interruption(played, options, capsys):
    def script(config: RunConfig) -> Any:
        if len(played.started) % 2 == 0:
            signal.raise_signal(signal.SIGINT)
        return rising(config)

    played.script = staticmethod(script)
    results = [tune(options()) for _ in range(RETRIES + 4)]
    assert results[0].summary.endswith("\ninterrupted — the same command goes on")
    assert "trial 1 failed: interrupted | 1 of 5, " in capsys.readouterr().out  # it will be repeated
    assert [result.interrupted for result in results[:5]] == [True] * 4 + [False]
    assert not results[-1].interrupted
    trials = trials_of(options())
    assert sum(trial.state == COMPLETE for trial in trials) == 5
    assert {reason_of(trial) for trial in trials if trial.state == FAIL} == {"interrupted"}


def test_a_trial_that_another_process_has_taken_over_is_dropped(played, options, capsys):
    def script(config: RunConfig) -> Any:
        if len(played.started) == 1:  # meanwhile another process takes it for dead
            storage = open_storage(options().where, lambda: None, 1)
            storage.optuna.set_trial_state_values(0, FAIL)
            storage.close()
        return rising(config)

    played.script = staticmethod(script)
    tune(options())
    trials = trials_of(options())
    assert [trial.state for trial in trials] == [FAIL, *[COMPLETE] * 5]
    assert trials[1].params == trials[0].params and trials[0].value is None
    assert "trial 0: no sign of life" in capsys.readouterr().out


def test_a_trial_that_is_taken_over_while_it_is_claimed(played, options, monkeypatch):
    """As if the process had been asleep: meanwhile another one got the lock, and found a trial that nobody runs."""
    beat, beats = JournalSweep.beat, []

    def late(self: JournalSweep, trial_ids: list[int]) -> None:
        beats.append(trial_ids)
        if len(beats) == 1:
            storage = open_storage(options().where, lambda: None, 1)
            storage.optuna.set_trial_state_values(0, FAIL)
            storage.close()
        beat(self, trial_ids)

    monkeypatch.setattr(JournalSweep, "beat", late)
    tune(options())
    trials = trials_of(options())
    assert [trial.state for trial in trials] == [FAIL, *[COMPLETE] * 5] and len(played.started) == 5


def test_nothing_is_written_for_a_mistake(played, options, tmp_path):
    before = set(tmp_path.rglob("*"))
    for changes, message in [
        ({"algo": "pppo"}, "did you mean 'ppo'"),
        ({"env": "tune_helpers:Lin-v0"}, "Lin"),
        ({"hyperparams": {"gama": 0.9}}, "unknown hyper-parameter 'gama' for ppo: did you mean 'gamma'?"),
        ({"n_evaluations": 97}, "--n-evaluations: 97 — expected at most 96"),
        ({"storage": "nonsense://x"}, "unknown kind of storage"),
        ({"conf_file": "nowhere.yml"}, "no such file"),
        ({"device": "cuda:x"}, "--device"),
        ({"hyperparams": {"stop_reward": -1}}, "stop_reward: -1 — expected none"),
        ({"show": True}, "there is no sweep at logs"),
    ]:
        with pytest.raises(ConfigError, match=message):
            tune(options(**changes))
    assert set(tmp_path.rglob("*")) == before


@pytest.mark.parametrize(
    "changes, message",
    [
        ({"algo": "trpo", "space": "other.yml"}, "has algo ppo, not trpo — expected the same .--algo"),
        ({"env": "Pendulum-v1"}, "has env tune_helpers:Line-v0, not Pendulum-v1 — expected the same .--env"),
        ({"hyperparams": {"gae_lambda": 0.5}}, "has no configuration: gae_lambda, here 0.5"),
        ({"n_timesteps": 192}, "has configuration: n_timesteps 96, not 192 — expected the same .-conf, -params, -n"),
        ({"seed": 5}, r"has seeds \[100, 101\], not \[5, 6\] — expected the same .--seed"),
        ({"space": "other.yml"}, "has space: learning_rate"),
        ({"n_evaluations": 2}, "has n_evaluations 3, not 2"),
        ({"eval_episodes": 3}, "has eval_episodes 2, not 3"),
    ],
)
def test_a_study_is_continued_with_the_same_plan_only(played, options, tmp_path, changes, message):
    (tmp_path / "other.yml").write_text("learning_rate: {float: [1e-4, 1e-3]}\ngamma: [0.9, 0.98]\n")
    place = {"storage": "journal.log", "study_name": "mine"}
    tune(options(**place))
    before = (tmp_path / "journal.log").read_bytes(), set(tmp_path.rglob("*"))
    with pytest.raises(ConfigError, match=f"--study-name: 'mine' in journal.log {message}"):
        tune(options(**place, **changes))
    after = (tmp_path / "journal.log").read_bytes(), set(tmp_path.rglob("*"))
    assert after == before
    tune(options(**place, sampler="random", pruner="halving", n_jobs=2, n_trials=6, timeout=60))  # these may differ


def test_a_study_of_somebody_else_is_left_alone(played, options, tmp_path):
    storage = open_storage("journal.log", lambda: None, 1)
    study = optuna.create_study(study_name="theirs", storage=storage.optuna)
    study.add_trial(optuna.create_trial(value=1.0))
    storage.close()
    for show in (False, True):
        with pytest.raises(ConfigError, match=r"'theirs' in journal\.log was not made by this command"):
            tune(options(storage="journal.log", study_name="theirs", show=show))
    with pytest.raises(ConfigError, match=r"no study 'their' in journal\.log: did you mean 'theirs'"):
        tune(options(storage="journal.log", study_name="their", show=True))


# What is found --------------------------------------------------------------------------------------------------------


def test_a_folder_that_cannot_be_written(played, options, tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(ConfigError, match=r"--log-folder: .* cannot be written"):
        tune(options(storage="journal.log", log_folder="file"))
    assert not list(tmp_path.glob("*journal*"))


def test_files(played, options, tmp_path, monkeypatch):
    monkeypatch.setattr(SweepReport, "_draw", DRAW)
    result = tune(options(n_trials=6))
    trials = trials_of(options())
    best = max(trials, key=lambda trial: trial.value)
    assert result.folder == Path("logs/ppo/tune/ppo-Line-v0")
    names = {path.name for path in result.folder.iterdir()}
    assert {"best.yml", "trials.csv", "journal.log", "optimization_history.png", "param_importances.png"} <= names
    assert {"slice.png", "parallel_coordinate.png", "intermediate_values.png", "timeline.png"} <= names
    assert all((result.folder / name).stat().st_size > 5000 for name in names if name.endswith(".png"))
    assert not [name for name in names if name.endswith(".alive")]

    with open(result.folder / "trials.csv") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 6
    for row, trial in zip(rows, trials, strict=True):
        assert (int(row["number"]), row["state"], float(row["value"])) == (trial.number, "complete", trial.value)
        assert [float(row["seed_100"]), float(row["seed_101"])] == trial.user_attrs["returns"]
        assert float(row["learning_rate"]) == trial.params["learning_rate"] and row["evaluations"] == "3"
    assert float(rows[best.number]["value"]) == max(float(row["value"]) for row in rows)

    text = (result.folder / "best.yml").read_text()
    content = yaml.safe_load(text)
    assert content["learning_rate"] == best.params["learning_rate"] and content["n_steps"] == 16
    assert f"Trial {best.number} " in text and "-conf logs/ppo/tune/ppo-Line-v0/best.yml" in text
    assert f"best: trial {best.number}, {best.value:.2f}" in result.summary
    plan = json.loads((result.folder / "plan.json").read_text())
    assert plan["seeds"] == [100, 101] and "learning_rate" in plan["space"]


def test_show(played, options, tmp_path, capsys):
    tune(options())
    (tmp_path / "logs/ppo/tune/ppo-Line-v0/trials.csv").unlink()
    argv = ["tune", "--show", "--algo", "ppo", "--env", "tune_helpers:Line-v0"]
    capsys.readouterr()
    assert main(argv) == 0
    out = capsys.readouterr().out
    assert "ppo-Line-v0: 5 trials (5 completed)" in out and "best: trial" in out
    assert (tmp_path / "logs/ppo/tune/ppo-Line-v0/trials.csv").exists()
    assert len(played.started) == 5


def test_results_of_a_study_in_another_storage_are_kept(played, options, tmp_path, capsys):
    folder = tune(options()).folder
    kept = {path.name: path.read_bytes() for path in folder.iterdir()}
    message = r"--study-name: 'ppo-Line-v0' — expected another one, or another --log-folder: '.*' holds the results"
    with pytest.raises(ConfigError, match=message):
        tune(options(storage="other.log"))  # before a study is made there
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == kept
    assert len(played.started) == 5 and not (tmp_path / "other.log").read_bytes()

    elsewhere = {"storage": "other.log", "log_folder": "elsewhere"}
    tune(options(**elsewhere))
    for change in ({"show": True}, {"n_trials": 9}):
        with pytest.raises(ConfigError, match=message):
            tune(options(storage="other.log", **change))
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == kept
    assert len(played.started) == 10

    assert "7 trials (7 completed)" in tune(options(n_trials=7)).summary  # each goes on where it was
    assert "6 trials (6 completed)" in tune(options(n_trials=6, **elsewhere)).summary
    (folder / "trials.csv").write_bytes(b"\xff")
    with pytest.raises(ConfigError, match=r"trials.csv': no table of trials — UnicodeDecodeError"):
        tune(options(n_trials=8))


def test_trials_that_run_are_shown(played, options):
    tune(options())
    storage = open_storage(options().where, lambda: None, 1)
    study = optuna.load_study(study_name="ppo-Line-v0", storage=storage.optuna)
    study.ask()  # has not been evaluated yet
    running = study.ask()
    running.report(-1.0, 1)
    running.report(1.25, 2)
    storage.close()
    lines = tune(options(show=True)).summary.splitlines()
    assert lines[:2] == ["ppo-Line-v0: 7 trials (5 completed, 2 running)", "  trial 6: 1.25 at evaluation 2 of 3"]
    assert lines[2].split()[:2] == ["trial", "value"] and len(lines) == 2 + 1 + 5 + 1


def test_a_line_tells_what_a_trial_begins_with(played, options, capsys):
    tune(options(n_trials=1))
    (trial,) = trials_of(options())
    gamma, rate, epochs = (trial.params[name] for name in ("gamma", "learning_rate", "n_epochs"))
    line = f"begins: trial 0 | gamma {gamma}, learning_rate {rate:.4g}, n_epochs {epochs}, policy_kwargs.net_arch"
    out = capsys.readouterr().out
    assert line in out and out.index(line) < out.index("trial 0 3.5")


def test_summary_before_anything_has_completed(played, options):
    played.script = staticmethod(lambda config: TrialFailed("seed 100: environment: gone", "failed"))
    result = tune(options(n_trials=2))
    assert result.summary.splitlines() == [
        "ppo-Line-v0: 2 trials (2 failed)",
        "  failed 2 ×: seed 100: environment: gone",
        "no trial has completed yet",
    ]
    assert {path.name for path in result.folder.glob("*.csv")} == {"trials.csv"} and not list(result.folder.glob("*.png"))


def test_plan_is_kept_in_the_study(played, options):
    tune(options())
    storage = open_storage(options().where, lambda: None, 1)
    plan = optuna.load_study(study_name="ppo-Line-v0", storage=storage.optuna).user_attrs[PLAN]
    storage.close()
    assert plan["algo"] == "ppo" and plan["configuration"] == CONFIGURATION and plan["seeds"] == [100, 101]


def test_flags_reach_the_options(monkeypatch):
    seen = []

    def record(options: TuneOptions) -> Any:
        seen.append(options)
        raise KeyboardInterrupt

    monkeypatch.setattr(tune_module, "tune", record)
    argv = "tune --algo td3 --env Pendulum-v1 -n 1e5 --n-trials 50 --n-startup-trials 7 --n-evaluations 4 --eval-episodes 6"
    argv += " --seed 9 --seeds-per-trial 2 --n-jobs -1 --timeout 3.5 --sampler gp --pruner hyperband --space s.yml"
    argv += " -params gamma:0.9 -conf c.yml --env-kwargs g:9.0 -f out --storage s.log --study-name n --heartbeat 3"
    argv += " --device cpu --num-threads 2 --show"
    assert main(argv.split()) == 130
    assert seen[0].model_dump() == {
        "algo": "td3",
        "env": "Pendulum-v1",
        "n_timesteps": 100_000,
        "n_trials": 50,
        "n_startup_trials": 7,
        "n_evaluations": 4,
        "eval_episodes": 6,
        "seed": 9,
        "seeds_per_trial": 2,
        "n_jobs": -1,
        "timeout": 3.5,
        "sampler": "gp",
        "pruner": "hyperband",
        "space": "s.yml",
        "hyperparams": {"gamma": 0.9},
        "conf_file": "c.yml",
        "env_kwargs": {"g": 9.0},
        "log_folder": "out",
        "storage": "s.log",
        "study_name": "n",
        "heartbeat": 3,
        "device": "cpu",
        "num_threads": 2,
        "show": True,
    }


@pytest.mark.parametrize(
    "flags, message",
    [
        ("--n-trials 0", "n_trials: 0 — expected a number >= 1"),
        ("--n-jobs 0", "n_jobs: 0 — expected a whole number greater than 0"),
        ("--n-jobs -2", "n_jobs: -2"),
        ("--timeout -1", "timeout: -1.0"),
        ("--sampler tpee", "unknown sampler 'tpee': did you mean 'tpe'?"),
        ("--pruner medain", "unknown pruner 'medain': did you mean 'median'?"),
        ("--seeds-per-trial 0", "seeds_per_trial: 0"),
        ("--heartbeat 0", "heartbeat: 0"),
        ("--algo symphny", "did you mean 'symphony'?"),
        ("--n-trails 5", "unknown argument '--n-trails': did you mean '--n-trials'?"),
    ],
)
def test_wrong_flags(capsys, flags, message):
    try:
        status = main(["tune", *flags.split()])
    except SystemExit as error:
        status = error.code
    err = capsys.readouterr().err
    assert status == 2 and err.count("\n") == 1 and message in err


TRIALS = """\
number,state,value,reason,retry_of,evaluations,started,seconds,worker,seed_100,normalize,learning_rate,noise_type
0,fail,,its process died,,1,2026-01-01,600,a,,False,0.00012345678,normal
1,complete,-3.5,,,4,2026-01-01,1800,a,-3.5,False,0.5,normal
2,complete,7.25,,0,4,2026-01-01,1200,a,7.25,False,0.00012345678,normal
3,pruned,1.0,,,2,2026-01-01,600,a,1.0,False,1e-05,pink
4,complete,7.25,,,4,2026-01-01,1800,a,7.25,False,2.0,pink
5,running,,,,1,2026-01-01,,a,,False,3.0,pink
"""


def test_a_table_of_trials_on_a_page(tmp_path, monkeypatch):
    """The trial that was tried again counts once; the earliest of equals first; what all have in common is no column."""
    (tmp_path / "trials.csv").write_text(TRIALS)
    monkeypatch.setattr("sb3_symphony.experiment.sweep_report._N_BEST", 2)
    assert trials_table("rates", tmp_path / "trials.csv", 10).splitlines() == [
        "### Search: rates",
        "",
        "4 of 10 trials (3 completed, 1 pruned, 1 running), 1.5 hours one after the other. The best:",
        "",
        "| trial | mean return | learning_rate | noise_type |",
        "|-------|------------:|--------------:|-----------:|",
        "| 2     |        7.25 |     0.0001235 |     normal |",
        "| 4     |        7.25 |             2 |       pink |",
    ]
    assert trials_table("rates", tmp_path / "none.csv", 10) == "### Search: rates\n\nNot run yet.\n"
    (tmp_path / "trials.csv").write_text("\n".join(TRIALS.splitlines()[:2]))
    assert trials_table("rates", tmp_path / "trials.csv", 10).endswith(
        "1 of 10 trials (1 failed), 0.2 hours one after the other.\n"
    )


@pytest.mark.parametrize(
    "damaged", ["number,state\n0,complete\n", TRIALS.replace("pruned", "cut"), TRIALS.replace("7.25", "x")]
)
def test_no_table_of_trials(damaged, tmp_path):
    (tmp_path / "trials.csv").write_text(damaged)
    with pytest.raises(ConfigError, match=r"trials.csv': no table of trials — \w+Error"):
        trials_table("rates", tmp_path / "trials.csv", 10)
