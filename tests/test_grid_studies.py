"""``bench`` with what goes beyond a grid: conditions, searches, agents to start from, algorithms of one's own, figures."""

import copy
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import test_cli
import yaml
from stable_baselines3 import TD3
from test_grid import contents

from sb3_symphony.analysis.runs import open_run
from sb3_symphony.cli import main
from sb3_symphony.experiment import gait as gait_module
from sb3_symphony.experiment import grid_report
from sb3_symphony.experiment.grid_progress import standings
from sb3_symphony.experiment.study import Drawing, read_study

OWN = """
import torch as th
from stable_baselines3 import TD3
from stable_baselines3.td3.policies import TD3Policy


class OwnPolicy(TD3Policy):
    pass


class OwnTD3(TD3):
    policy_aliases = {"MlpPolicy": OwnPolicy}

    def train(self, gradient_steps, batch_size=100):
        super().train(2 * gradient_steps, batch_size)
"""
LIMIT = "gymnasium.wrappers.TimeLimit"
SMALL = {"policy_kwargs": {"net_arch": [8]}, "learning_starts": 50, "buffer_size": 1000, "batch_size": 16}
STUDY = {
    "algorithms": [
        {"name": "base", "algo": "td3", "overrides": {**SMALL, "env_wrapper": {LIMIT: {"max_episode_steps": 40}}}},
        {"name": "again", "algo": "td3", "overrides": {**SMALL, "env_wrapper": {LIMIT: {"max_episode_steps": 40}}}},
        {
            "name": "onward",
            "algo": "td3",
            "overrides": {**SMALL, "learning_rate": 0.0},
            "start_from": {"algorithm": "base", "environment": "Pendulum-v1", "replay_buffer": True},
            "reported": "as good",
        },
        {
            "name": "own",
            "algo": "own_td3.py:OwnTD3",
            "conf": "td3",
            "overrides": SMALL,
            "reported": {"Hopper-v4": "elsewhere"},
        },
        {"name": "found", "algo": "td3", "sweep": "rate", "overrides": {"gradient_steps": 1}},
    ],
    "environments": ["Pendulum-v1"],
    "seeds": [3],
    "steps": 200,
    "save_freq": 100,
    "final_episodes": 2,
    "protocol": {"eval_freq": 200, "eval_episodes": 1},
    "tensorboard": True,
    "matrix": {
        "label": "episode length",
        "conditions": {
            20: {"env_wrapper": {LIMIT: {"max_episode_steps": 20}}},
            30: {"env_wrapper": {LIMIT: {"max_episode_steps": 30}}},
        },
    },
    "sweeps": {
        "rate": {
            **{"algo": "td3", "env": "Pendulum-v1", "n_timesteps": 100, "hyperparams": SMALL, "space": "space.yml"},
            **{"n_trials": 2, "seeds_per_trial": 1, "n_evaluations": 2, "eval_episodes": 1},
        }
    },
    "figures": {
        "lengths": {"y_axis": "length", "algorithms": ["base", "own"]},
        "rates": {"tags": ["train/learning_rate"], "algorithms": ["base", "own"]},
        "speeds": {"tags": ["time/speed"]},
    },
}


@pytest.fixture
def fails(capsys):
    """Check that a command fails with these messages in its line."""

    def check(argv, *messages):
        line = test_cli.fails(capsys, *argv)
        assert all(message in line for message in messages), line

    return check


@pytest.fixture(scope="module")
def study(tmp_path_factory):
    """A study that has been run."""
    folder = tmp_path_factory.mktemp("study")
    (folder / "own_td3.py").write_text(OWN)
    (folder / "space.yml").write_text("learning_rate: [1e-3, 1e-4]\n")
    (folder / "study.yml").write_text(yaml.safe_dump(STUDY))
    assert main(["bench", str(folder / "study.yml"), "-j", "2", "-f", str(folder / "results")]) == 0
    return folder


def result_of(study, name):
    return json.loads((study / "results" / name / "Pendulum-v1_3" / "result.json").read_text())


def options_of(study, name):
    return yaml.safe_load((study / "results" / name / "Pendulum-v1_3" / "Pendulum-v1" / "args.yml").read_text())


def test_conditions(study):
    result = result_of(study, "base")
    assert result["final"]["lengths"] == [40, 40]  # as trained
    assert {name: each["lengths"] for name, each in result["conditions"].items()} == {"20": [20, 20], "30": [30, 30]}
    assert result_of(study, "own")["conditions"]["20"]["lengths"] == [20, 20]  # trained without such a wrapper
    table = (study / "results" / "table.md").read_text()
    assert "### Pendulum-v1: episode length" in table
    rows = (study / "results" / "matrix.csv").read_text().splitlines()
    assert len(rows) == 1 + 2 * len(STUDY["algorithms"])
    returns = result["conditions"]["30"]["returns"]
    assert f"base,Pendulum-v1,3,30,2,{np.mean(returns)},{np.std(returns)}" in "\n".join(rows)


def test_reported_and_repeated(study):
    table = (study / "results" / "table.md").read_text()
    assert "| reported |" in table and "as good |" in table and "elsewhere" not in table
    assert "base and again: same settings; returns and lengths of all episodes with seed 3 are bit for bit the same" in table
    assert "base and own" not in table


def test_agent_to_start_from(study):
    assert options_of(study, "onward")["trained_agent"] == str(study / "results" / "base" / "Pendulum-v1_3")
    weights = []
    for name in ("base", "onward"):
        model = TD3.load(study / "results" / name / "Pendulum-v1_3" / "Pendulum-v1.zip", buffer_size=1)
        weights.append(model.policy.actor.mu[0].weight.detach().numpy())
    np.testing.assert_array_equal(*weights)  # the learning rate is 0
    command = (study / "results" / "onward" / "Pendulum-v1_3" / "Pendulum-v1" / "command.txt").read_text()
    assert " -i " in command and "--with-replay-buffer" in command


def test_own_algorithm(study, capsys, fails):
    assert result_of(study, "own")["updates"] == 2 * 150
    run = study / "results" / "own" / "Pendulum-v1_3"
    copied = f"{study}/results/settings/own_td3.py:OwnTD3"  # other machines have no folder of the study
    assert options_of(study, "own")["algo"] == copied
    fails(["evaluate", "--model", str(run), "-n", "1"], "--algo: missing", "own_td3.py:OwnTD3", "runs the file's code")
    fails(["evaluate", "--model", str(run), "-n", "1", "--algo", "td3"], "--algo: td3")
    assert main(["evaluate", "--model", str(run), "-n", "1", "--algo", copied]) == 0
    assert "own_td3.py:OwnTD3 on Pendulum-v1" in capsys.readouterr().out


def test_search(study):
    found = yaml.safe_load((study / "results" / "sweeps" / "td3" / "tune" / "rate" / "best.yml").read_text())
    run = study / "results" / "found" / "Pendulum-v1_3"
    config = yaml.safe_load((run / "Pendulum-v1" / "config.yml").read_text())
    assert config["learning_rate"] == found["learning_rate"] in (1e-3, 1e-4)
    assert config["policy_kwargs"] == {"net_arch": [8]}
    table = (study / "results" / "table.md").read_text()
    assert "### Search: rate\n\n2 of 2 trials (2 completed), " in table and "| trial | mean return |" in table


def test_report_of_a_search_alone(study, tmp_path, capsys):
    """Before its best settings are trained."""
    shutil.copytree(study / "results" / "sweeps", tmp_path / "results" / "sweeps")
    assert main(["bench", str(study / "study.yml"), "--report", "-f", str(tmp_path / "results")]) == 0
    printed = capsys.readouterr().out
    assert "2 of 2 trials" in printed and "not run yet" in printed


def test_figures(study, capsys):
    results = study / "results"
    assert {path.stem for path in results.glob("*.png")} == {"evaluations", "training", "matrix", "lengths", "rates"}
    assert all("train/learning_rate" in open_run(results / name / "Pendulum-v1_3").scalars for name in ("base", "own"))
    (results / "lengths.png").unlink()
    assert main(["bench", str(study / "study.yml"), "--report", "-f", str(results)]) == 0
    assert (results / "lengths.png").exists()
    assert "speeds.png is not drawn: --tags: 'time/speed'" in capsys.readouterr().out


def test_again(study, capsys):
    before = contents(study / "results")
    assert main(["bench", str(study / "study.yml"), "-f", str(study / "results")]) == 0
    after = contents(study / "results")
    changed = {path.name for path in after if before.get(path) != after[path]}
    assert not any(
        "result.json" in name or name.endswith((".zip", ".csv", ".log"))
        for name in changed - {*("cells.csv", "episodes.csv", "matrix.csv")}
    )


@pytest.mark.parametrize(
    "change, message",
    [
        (
            {"start_from": {"algorithm": "again", "environment": "Pendulum-v1"}},
            "was trained with start_from 'base/Pendulum-v1_3'",
        ),
        ({"start_from": None}, "was trained with start_from 'base/Pendulum-v1_3'"),
        (
            {"start_from": {"algorithm": "base", "environment": "Pendulum-v1"}},
            "was trained with start_from.replay_buffer True, the study has False",
        ),
    ],
)
def test_other_agent_to_start_from(study, tmp_path, fails, change, message):
    algorithms = [{**each, **(change if each["name"] == "onward" else {})} for each in STUDY["algorithms"]]
    algorithms = [{key: value for key, value in each.items() if value is not None} for each in algorithms]
    for name in ("own_td3.py", "space.yml"):
        (tmp_path / name).write_text((study / name).read_text())
    (tmp_path / "study.yml").write_text(yaml.safe_dump({**STUDY, "algorithms": algorithms}))
    fails(["bench", str(tmp_path / "study.yml"), "--report", "-f", str(study / "results")], message)


def test_another_version_of_an_own_algorithm(study, tmp_path, fails):
    """Its name tells nothing: cells that are done would stand beside others of the new version."""
    (tmp_path / "own_td3.py").write_text(OWN + "# changed\n")
    (tmp_path / "space.yml").write_text((study / "space.yml").read_text())
    (tmp_path / "study.yml").write_text(yaml.safe_dump(STUDY))
    command = ["bench", str(tmp_path / "study.yml"), "-f", str(study / "results")]
    for flags in ([], ["--report"]):
        fails([*command, *flags], "own/Pendulum-v1_3: was trained with '", "own_td3.py' differs — expected the same")
    assert (study / "results" / "settings" / "own_td3.py").read_text() == OWN
    assert main([*command, "--dry-run", "-a", "base"]) == 0


def test_a_search_of_another_space(study, tmp_path, fails):
    (tmp_path / "own_td3.py").write_text(OWN)
    (tmp_path / "space.yml").write_text("learning_rate: [1e-3, 1e-5]\n")
    (tmp_path / "study.yml").write_text(yaml.safe_dump(STUDY))
    message = "has space: learning_rate [0.001, 0.0001], not [0.001, 1e-05]"
    for flags in ([], ["--report"]):
        fails(["bench", str(tmp_path / "study.yml"), "-f", str(study / "results"), *flags], "the search 'rate' in '", message)
    sweep = {**STUDY["sweeps"]["rate"], "n_trials": 3}  # goes on
    (tmp_path / "study.yml").write_text(yaml.safe_dump({**STUDY, "sweeps": {"rate": sweep}}))
    assert main(["bench", str(tmp_path / "study.yml"), "-f", str(study / "results"), "--dry-run", "-a", "base"]) == 0


@pytest.mark.parametrize("damaged", ["{", "[]"])
def test_a_damaged_plan_of_a_search(study, tmp_path, fails, damaged):
    for name in ("sweeps", "settings"):
        shutil.copytree(study / "results" / name, tmp_path / "results" / name)
    (plan,) = (tmp_path / "results" / "sweeps").glob("td3/tune/*/plan.json")
    plan.write_text(damaged)
    fails(["bench", str(study / "study.yml"), "--report", "-f", str(tmp_path / "results")], f"'{plan}' is damaged — ")


def test_a_folder_that_is_none(study, tmp_path, fails):
    (tmp_path / "file").touch()
    for flags in ([], ["--dry-run"]):
        fails(["bench", str(study / "study.yml"), "-f", str(tmp_path / "file"), *flags], "-f: '", "file' cannot be written")


def test_a_search_is_checked_before_anything_runs(tmp_path, fails):
    (tmp_path / "own_td3.py").write_text(OWN)
    (tmp_path / "space.yml").write_text("gamma: [0.9, 1.5]\n")
    (tmp_path / "study.yml").write_text(yaml.safe_dump(STUDY))
    for flags in ([], ["--dry-run"]):
        fails(["bench", str(tmp_path / "study.yml"), "-f", str(tmp_path / "results"), *flags], "sweeps: rate: ", "gamma: 1.5")
    assert not (tmp_path / "results").exists()


def test_each_variant_has_settings_of_its_own(tmp_path, monkeypatch):
    """Names of algorithms and environments may hold what joins others."""
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parent))
    study = {
        "algorithms": [
            {"name": "td3", "environments": ["tune_helpers:Fast_Line-v0"], "overrides": {"gamma": 0.9}},
            {"name": "td3_Fast", "algo": "td3", "environments": ["tune_helpers:Line-v0"], "overrides": {"gamma": 0.5}},
        ],
        "environments": ["tune_helpers:Fast_Line-v0", "tune_helpers:Line-v0"],
        "seeds": 1,
        "steps": 20,
        "final_episodes": 0,
        "protocol": {"eval_freq": 0},
    }
    (tmp_path / "study.yml").write_text(yaml.safe_dump(study))
    assert main(["bench", str(tmp_path / "study.yml"), "-j", "1", "-f", str(tmp_path / "results")]) == 0
    for name, gamma in (("td3/Fast_Line-v0_0", 0.9), ("td3_Fast/Line-v0_0", 0.5)):
        run = tmp_path / "results" / name
        assert yaml.safe_load((run / run.name.rpartition("_")[0] / "config.yml").read_text())["gamma"] == gamma


def test_more_steps_of_an_agent_that_another_began_with(study, tmp_path, fails):
    for name in ("own_td3.py", "space.yml"):
        (tmp_path / name).write_text((study / name).read_text())
    base, *others = STUDY["algorithms"]
    (tmp_path / "study.yml").write_text(yaml.safe_dump({**STUDY, "algorithms": [{**base, "steps": 300}, *others]}))
    message = "onward/Pendulum-v1_3: began with base/Pendulum-v1_3 after 200 steps, the study has 300 of them"
    for flags in ([], ["--report"], ["--dry-run"]):
        fails(["bench", str(tmp_path / "study.yml"), "-f", str(study / "results"), *flags], message)


@pytest.mark.parametrize(
    "source, onward, message",
    [
        ({"algo": "ppo", "overrides": {"n_steps": 50}}, {"replay_buffer": True}, "--with-replay-buffer: PPO has no"),
        ({"algo": "td3", "overrides": SMALL}, {"net_arch": [9]}, "networks of first/Pendulum-v1_3 (policy_kwargs"),
        ({"algo": "td3", "overrides": SMALL}, {"n_envs": 2, "replay_buffer": True}, "start_from: replay_buffer: first/"),
        ({"algo": "td3", "overrides": SMALL}, {"normalize": True}, "has no statistics of VecNormalize"),
        ({"algo": "td3", "overrides": SMALL}, {"frame_stack": 2}, "first/Pendulum-v1_3 does not fit the environment"),
    ],
)
def test_agents_that_nothing_can_start_from(tmp_path, fails, source, onward, message):
    """Which shows before anything is trained."""
    start = {"algorithm": "first", "environment": "Pendulum-v1", "replay_buffer": onward.pop("replay_buffer", False)}
    kwargs = {"policy_kwargs": {"net_arch": onward.pop("net_arch")}} if "net_arch" in onward else {}
    second = {"algo": source["algo"], "overrides": {**source["overrides"], **onward, **kwargs}, "start_from": start}
    algorithms = [{"name": "first", **source}, {"name": "second", **second}]
    study = {"algorithms": algorithms, "environments": ["Pendulum-v1"], "seeds": [3], "steps": 200}
    (tmp_path / "study.yml").write_text(yaml.safe_dump(study))
    for flags in (["--dry-run"], []):
        fails(["bench", str(tmp_path / "study.yml"), "-f", str(tmp_path / "results"), *flags], message)
    assert not (tmp_path / "results").exists()


def test_another_condition_of_the_same_name(study, tmp_path, fails):
    matrix = copy.deepcopy(STUDY["matrix"])
    matrix["conditions"][20]["obs_noise"] = 50
    for name in ("own_td3.py", "space.yml"):
        (tmp_path / name).write_text((study / name).read_text())
    (tmp_path / "study.yml").write_text(yaml.safe_dump({**STUDY, "matrix": matrix}))
    for flags in ([], ["--report"]):
        fails(["bench", str(tmp_path / "study.yml"), "-f", str(study / "results"), *flags], "evaluated under condition '20'")


def test_variants_are_what_plots_tell_apart(study, capsys, fails):
    results = str(study / "results")
    assert main(["plot", "-f", results, "-a", "onward", "own", "--json", "-", "-o", str(study / "own.png")]) == 0
    (panel,) = json.loads(capsys.readouterr().out)["panels"].values()
    assert [curve["label"] for curve in panel] == ["onward", "own"]
    fails(["plot", "-f", results, "-a", "onwards"], "did you mean 'onward'?")


def test_moved_results_of_an_own_algorithm_go_on(study, tmp_path):
    shutil.copytree(study / "results", tmp_path / "results")
    for name in ("own_td3.py", "space.yml"):
        (tmp_path / name).write_text((study / name).read_text())
    (tmp_path / "study.yml").write_text(yaml.safe_dump({**STUDY, "steps": 250}))
    hidden = study / "results" / "settings" / "own_td3.py"
    hidden.rename(study / "hidden")
    try:
        assert main(["bench", str(tmp_path / "study.yml"), "-a", "own", "-f", str(tmp_path / "results")]) == 0
    finally:
        (study / "hidden").rename(hidden)
    assert json.loads((tmp_path / "results" / "own" / "Pendulum-v1_3" / "result.json").read_text())["steps"] == 250


def test_raw_files_give_the_same_tables(study, tmp_path, fails):
    results, raw = study / "results", tmp_path / "raw"
    assert main(["bench", str(study / "study.yml"), "--report", "-f", str(results), "--collect", str(raw)]) == 0
    files = [path for path in raw.rglob("*") if path.is_file()]
    assert {path.suffix for path in files} == {".yml", ".csv", ".npz", ".json", ".png"}
    assert not any(str(results).encode() in path.read_bytes() for path in files)  # whose machine is nobody's business
    assert main(["bench", str(study / "study.yml"), "--report", "-f", str(raw)]) == 0
    for name in ("table.md", "cells.csv", "episodes.csv", "matrix.csv"):
        assert (raw / name).read_text() == (results / name).read_text()
    kept, logged = (open_run(folder / "base" / "Pendulum-v1_3").scalars for folder in (raw, results))
    assert set(kept) == {"train/learning_rate"} < set(logged)  # what a figure draws
    np.testing.assert_array_equal(kept["train/learning_rate"].steps, logged["train/learning_rate"].steps)
    assert (raw / "rates.png").exists() and not (raw / "onward" / "Pendulum-v1_3" / "scalars.csv").exists()
    fails(["bench", str(study / "study.yml"), "--dry-run", "--report"], "--dry-run and --report: expected only one of them")
    for flag in ("--collect", "--page"):
        (tmp_path / "page.md").write_text("<!-- results -->\n<!-- /results -->\n")
        fails(["bench", str(study / "study.yml"), flag, str(tmp_path / "page.md")], f"{flag}: ", "belongs to --report")


def test_raw_files_of_moved_results(study, tmp_path):
    moved, raw = tmp_path / "moved", tmp_path / "raw"
    shutil.copytree(study / "results", moved)
    with (moved / "base" / "Pendulum-v1_3" / "Pendulum-v1" / "config.yml").open("a") as config:
        config.write(f"# {moved}/a, {moved}\n# {tmp_path}/move/a, {tmp_path}/movedother/a\n")
    assert main(["bench", str(study / "study.yml"), "--report", "-f", str(moved), "--collect", str(raw)]) == 0
    config = raw / "base" / "Pendulum-v1_3" / "Pendulum-v1" / "config.yml"
    kept = f"# {tmp_path}/move/a, {tmp_path}/movedother/a\n"  # other folders, whose names begin alike
    assert config.read_text().endswith(f"# a, .\n{kept}")
    config.write_text(config.read_text().removesuffix(kept))
    files = [path for path in raw.rglob("*") if path.is_file()]
    assert not any(str(folder).encode() in path.read_bytes() for path in files for folder in (study, moved))


def test_only_some_algorithms(study, tmp_path, capsys, fails):
    arguments = ["bench", str(study / "study.yml"), "--dry-run", "-f", str(tmp_path / "new")]
    assert main([*arguments, "-a", "onward"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines[1:-1]] == ["base/Pendulum-v1_3", "onward/Pendulum-v1_3"]
    fails([*arguments, "-a", "onwards"], "-a: unknown name 'onwards': did you mean 'onward'?")


def test_a_class_that_is_not_there(study, tmp_path, fails):
    (tmp_path / "other_td3.py").write_text("OwnTD3 = 3\n")
    for name, message in (("other_td3.py:OwnTD3", "has no algorithm 'OwnTD3'"), ("nothing.py:X", "there is no file")):
        fails(["train", "--algo", f"{tmp_path}/{name}", "--env", "Pendulum-v1", "-conf", "td3", "--dry-run"], message)
    fails(["train", "--algo", f"{study}/own_td3.py:OwnTD3", "--env", "Pendulum-v1"], "--conf-file: missing")


def test_models_that_a_gait_is_drawn_of(study, tmp_path, monkeypatch):
    drawn = []
    monkeypatch.setattr(gait_module, "gait", drawn.append)
    path = study / "study.yml"
    results = [grid_report.result_of(each) for each in standings(read_study(path), path, study / "results")]
    grid_report._draw_gaits(Drawing(gait_at=3), results, tmp_path / "gait.png")  # 40 steps each: the third ends at 120
    (options,) = drawn
    assert options.labels == ["base", "again"]  # those with three episodes
    assert [name.rpartition("/")[2] for name in options.agents] == ["rl_model_100_steps.zip"] * 2
    assert (options.output, options.json_file) == (str(tmp_path / "gait.png"), str(tmp_path / "gait.json"))
