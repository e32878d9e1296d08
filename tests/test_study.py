"""Study files: what their cells are, and one clear line for every mistake."""

import math
import re
import runpy
import shutil
from pathlib import Path

import pytest
import yaml

from sb3_symphony.cli import main
from sb3_symphony.experiment.config import ConfigError, shipped_folder
from sb3_symphony.experiment.grid_report import on_page
from sb3_symphony.experiment.select import EvaluateOptions
from sb3_symphony.experiment.study import cells_of, configuration, read_study, sweep_options

SMALL = {
    "algorithms": ["td3", {"name": "sac-small", "algo": "sac", "overrides": {"policy_kwargs.net_arch": [8]}, "steps": 70}],
    "environments": ["Pendulum-v1", {"id": "BipedalWalker-v3", "steps": 50}],
    "seeds": 2,
    "steps": 60,
}


@pytest.fixture
def write(tmp_path):
    def to_file(**changes):
        path = tmp_path / "study.yml"
        path.write_text(yaml.safe_dump({**SMALL, **changes}))
        return path

    return to_file


def test_every_combination_is_a_cell(write, tmp_path):
    cells = cells_of(read_study(write()), tmp_path)
    assert [cell.name for cell in cells] == [
        f"{algorithm}/{env}_{seed}"
        for seed in (0, 1)
        for env in ("Pendulum-v1", "BipedalWalker-v3")
        for algorithm in ("td3", "sac-small")
    ]
    assert [cell.options.n_timesteps for cell in cells[:4]] == [60, 70, 50, 70]  # the algorithm's, else the environment's
    options = cells[1].options
    assert (options.algo, options.env, options.seed) == ("sac", "Pendulum-v1", 0)
    assert (options.protocol, options.num_threads, options.device, options.save_freq) == ("standard", 1, "cpu", 10_000)
    assert configuration(cells[1]).plain["policy_kwargs"]["net_arch"] == [8]
    assert configuration(cells[1]).settings.n_timesteps == 70


def test_steps_of_the_configuration(write, tmp_path):
    (cell,) = cells_of(read_study(write(algorithms=["td3"], environments=["Pendulum-v1"], seeds=[7], steps=None)), tmp_path)
    assert cell.seed == 7 and configuration(cell).settings.n_timesteps == 20_000


def test_own_protocol_and_numbers(write, tmp_path):
    study = read_study(write(protocol={"eval_freq": 1e3, "eval_episodes": 3}, device="cpu", save_freq=20, final_episodes=0))
    cell = cells_of(study, tmp_path)[0]
    assert (cell.options.protocol, cell.options.eval_freq, cell.options.eval_episodes) == (None, 1000, 3)
    assert (cell.options.save_freq, cell.final_episodes) == (20, 0)


def test_settings_beside_the_study_and_presets(write, tmp_path, monkeypatch):
    monkeypatch.chdir("/")
    (tmp_path / "own.yml").write_text("n_timesteps: 123\nlearning_starts: 17\n")
    algorithms = [
        {"name": "own", "algo": "td3", "conf": "own.yml"},
        {"name": "original", "algo": "symphony", "conf": "symphony-original"},
    ]
    own, original = cells_of(read_study(write(algorithms=algorithms, seeds=[0], environments=["Pendulum-v1"])), tmp_path)
    assert configuration(own).arguments == {"learning_starts": 17}
    preset = yaml.safe_load((shipped_folder() / "presets" / "symphony-original.yml").read_text())
    assert preset and configuration(original).arguments


def test_quick(write, tmp_path):
    quick = {
        "algorithms": ["sac-small"],
        "environments": ["Pendulum-v1"],
        "seeds": [5],
        "steps": 30,
        "protocol": {"eval_freq": 10},
        "final_episodes": 2,
        "overrides": {"learning_starts": 5},
    }
    path = write(quick=quick)
    assert len(read_study(path).algorithms) == 2
    (cell,) = cells_of(read_study(path, quick=True), tmp_path)
    assert cell.name == "sac-small/Pendulum-v1_5" and cell.final_episodes == 2
    assert (cell.options.n_timesteps, cell.options.eval_freq, cell.options.protocol) == (30, 10, None)
    plain = configuration(cell).plain
    assert plain["learning_starts"] == 5 and plain["policy_kwargs"]["net_arch"] == [8]
    rest = cells_of(read_study(write(quick={"seeds": 1}), quick=True), tmp_path)
    assert [cell.options.n_timesteps for cell in rest] == [60, 70, 50, 70]


@pytest.mark.parametrize(
    "changes, message",
    [
        ({"seed": 3}, "unknown option 'seed': did you mean 'seeds'?"),
        ({"seeds": []}, "seeds: [] — expected at least one"),
        ({"seeds": 0}, "seeds: 0 — expected at least one"),
        ({"seeds": [True, 2]}, "seeds: [True, 2] — expected a whole number"),
        ({"seeds": -1}, "seeds: -1 — expected at least one"),
        ({"seeds": 20_240_101}, "seeds: 20240101 — expected how many seeds, or a list of them: [20240101] is one seed"),
        ({"seeds": [1, 2, 1]}, "seeds: 1 is there 2 times — expected every cell once"),
        ({"seeds": [-1]}, "seeds: [-1] — expected a number >= 0"),
        ({"seeds": "many"}, "seeds: 'many' — expected a list"),
        ({"steps": 0}, "steps: 0 — expected a number >= 1"),
        ({"algorithms": []}, "algorithms: [] — expected at least one"),
        ({"algorithms": ["td3", "td3"]}, "algorithms: 'td3' is there 2 times"),
        ({"algorithms": ["td3", {"name": "TD3", "algo": "td3"}]}, "algorithms: 'td3' is there 2 times"),
        ({"algorithms": ["tdd3"]}, "unknown algorithm 'tdd3': did you mean 'td3'?"),
        ({"algorithms": [{"name": "x", "algo": "sacc"}]}, "unknown algorithm 'sacc': did you mean 'sac'?"),
        ({"algorithms": [{"name": "x", "override": {}}]}, "algorithms: unknown option 'override': did you mean 'overrides'?"),
        ({"algorithms": [{"name": "a/b", "algo": "td3"}]}, "algorithms: name: 'a/b' — expected letters"),
        ({"algorithms": [{"name": "table.md", "algo": "td3"}]}, "algorithms: name: 'table.md' — is a folder or file that all"),
        ({"algorithms": [{"name": "Sweeps", "algo": "td3"}]}, "algorithms: name: 'Sweeps' — is a folder or file that all"),
        ({"algorithms": [{"algo": "td3"}]}, "algorithms: name: missing"),
        ({"algorithms": [3]}, "algorithms: 3 — expected a name, or a mapping with 'name'"),
        ({"environments": ["a:B/C-v1", "B-C-v1"]}, "environments: 'B-C-v1' is there 2 times"),
        (
            {"environments": [{"id": "X", "threshold": -200, "unstable_below": -100}]},
            "environments: unstable_below: -100 — expected at most the threshold, -200",
        ),
        ({"environments": [{"id": "X", "treshold": 1}]}, "environments: unknown option 'treshold': did you mean 'threshold'?"),
        ({"protocol": "standart"}, "protocol: 'standart' — expected standard, or a mapping"),
        ({"protocol": {"eval_freq": -1}}, "protocol: eval_freq: -1 — expected a number >= 0"),
        ({"quick": {"algoritms": []}}, "quick: unknown option 'algoritms': did you mean 'algorithms'?"),
        ({"quick": {"algorithms": ["td4"]}}, "quick: algorithms: unknown name 'td4': did you mean 'td3'?"),
    ],
)
def test_mistakes(write, changes, message):
    with pytest.raises(ConfigError) as error:
        read_study(write(**changes))
    assert message in str(error.value) and "\n" not in str(error.value) and "study.yml" in str(error.value)


@pytest.mark.parametrize(
    "quick, message",
    [
        (None, "quick: missing — expected what differs"),
        ({"algorithms": ["sac-smal"]}, "quick: algorithms: unknown name 'sac-smal': did you mean 'sac-small'?"),
        ({"environments": ["q"]}, "quick: environments: unknown name 'q' — expected some of Pendulum-v1, BipedalWalker-v3"),
        ({"algorithms": []}, "quick: algorithms: [] — expected at least one"),
    ],
)
def test_mistakes_of_the_quick_version(write, quick, message):
    path = write() if quick is None else write(quick=quick)
    with pytest.raises(ConfigError) as error:
        read_study(path, quick=True)
    assert message in str(error.value)


WALKER = "BipedalWalker-v3"


def test_seeds_and_environments_of_an_algorithm(write, tmp_path):
    algorithms = [{"name": "td3", "seeds": [7, 8, 9]}, {"name": "sac", "environments": [WALKER]}]
    environments = ["Pendulum-v1", {"id": WALKER, "overrides": {"gamma": 0.5, "tau": 0.1}}]
    algorithms[1]["overrides"] = {"gamma": 0.6}
    cells = cells_of(read_study(write(algorithms=algorithms, environments=environments)), tmp_path)
    assert [cell.name for cell in cells] == [
        *("td3/Pendulum-v1_7", "td3/BipedalWalker-v3_7", "sac/BipedalWalker-v3_0"),
        *("td3/Pendulum-v1_8", "td3/BipedalWalker-v3_8", "sac/BipedalWalker-v3_1"),
        *("td3/Pendulum-v1_9", "td3/BipedalWalker-v3_9"),
    ]
    td3, sac = configuration(cells[1]).arguments, configuration(cells[2]).arguments
    assert (td3["gamma"], td3["tau"], sac["gamma"], sac["tau"]) == (0.5, 0.1, 0.6, 0.1)
    assert "tau" not in configuration(cells[0]).arguments


def test_start_from_another_cell(write, tmp_path):
    algorithms = [
        {"name": "base", "algo": "td3", "environments": ["Pendulum-v1"], "overrides": {"policy_kwargs.net_arch": [8]}},
        {"name": "onward", "algo": "td3", "environments": [WALKER]},
    ]
    algorithms[1]["start_from"] = {"algorithm": "base", "environment": "Pendulum-v1", "replay_buffer": True}
    path = write(algorithms=algorithms)
    cells = cells_of(read_study(path), tmp_path)
    assert [cell.name for cell in cells] == [
        *("base/Pendulum-v1_0", "base/Pendulum-v1_1", "onward/BipedalWalker-v3_0", "onward/BipedalWalker-v3_1")
    ]
    assert [cell.start_from and cell.start_from.name for cell in cells] == [None, None, cells[0].name, cells[1].name]
    assert cells[2].options.with_replay_buffer
    assert configuration(cells[2]).plain["policy_kwargs"] == {"net_arch": [8]}  # networks are those it starts from
    kept = read_study(path, only=["onward"])
    assert [each.name for each in kept.algorithms] == ["base", "onward"]
    assert [each.name for each in read_study(path, only=["base"]).algorithms] == ["base"]


def test_quick_version_without_a_cell(write):
    algorithms = [{"name": "sac", "environments": ["Pendulum-v1"]}]
    path = write(algorithms=algorithms, quick={"environments": ["BipedalWalker-v3"]})
    with pytest.raises(ConfigError, match="quick: environments: BipedalWalker-v3 — no algorithm of the quick version runs"):
        read_study(path)


def test_sweeps_conditions_and_figures(write, tmp_path):
    (tmp_path / "fixed.yml").write_text("n_timesteps: 99\ngamma: 0.3\n")
    wrapper = "gymnasium.wrappers.TimeLimit"
    study = read_study(
        write(
            algorithms=[{"name": "found", "algo": "td3", "sweep": "s"}],
            sweeps={"s": {"algo": "td3", "env": "Pendulum-v1", "conf_file": "fixed.yml", "n_trials": 3}},
            matrix={"label": "delay", "conditions": {1: {"action_delay": 1}, "short": {"env_wrapper": {wrapper: {"a": 1}}}}},
            figures={"reward": {"x_axis": "episodes", "algorithms": ["found"]}},
            quick={"sweeps": {"n_trials": 1}, "seeds": 1},
        )
    )
    cell = cells_of(study, tmp_path, tmp_path / "results")[0]
    assert cell.waits and cell.sweep == "s" and cell.found == tmp_path / "results" / "settings" / "s_best_of_3.yml"
    assert configuration(cell).settings.n_timesteps == 60
    assert cell.conditions["1"]["action_delay"] == 1
    assert EvaluateOptions(**cell.conditions["short"]).env_wrapper == [(wrapper, {"a": 1})]
    options = sweep_options(study, "s", tmp_path, tmp_path / "results")
    assert (options.conf_file, options.n_trials, options.name) == (str(tmp_path / "fixed.yml"), 3, "s")
    assert read_study(tmp_path / "study.yml", quick=True).sweeps["s"].n_trials == 1
    cell.found.parent.mkdir(parents=True)
    cell.found.write_text("n_timesteps: 5\ngamma: 0.7\n")
    found = cells_of(study, tmp_path, tmp_path / "results")[0]
    assert not found.waits and configuration(found).arguments == {"gamma": 0.7}
    assert read_study(write(sweeps={})).sweeps == {}


def test_environment_of_a_sweep(write, tmp_path):
    sweep = {"algo": "td3", "n_trials": 3}
    study = read_study(write(sweeps={"s": sweep}, environments=["Pendulum-v1"]))
    assert sweep_options(study, "s", tmp_path, tmp_path / "results").env == "Pendulum-v1"
    both = ["Pendulum-v1", "BipedalWalker-v3"]
    study = read_study(write(sweeps={"s": {**sweep, "env": "BipedalWalker-v3"}}, environments=both))
    assert sweep_options(study, "s", tmp_path, tmp_path / "results").env == "BipedalWalker-v3"
    with pytest.raises(ConfigError, match="sweeps: s: env: missing — expected one environment, such as Pendulum-v1"):
        read_study(write(sweeps={"s": sweep}, environments=both))


def test_sweep_of_an_own_algorithm(write, tmp_path, monkeypatch):
    """In a file beside the study, wherever the command is typed."""
    (tmp_path / "own.py").write_text("from stable_baselines3 import TD3\n\n\nclass Own(TD3):\n    pass\n")
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "space.yml").write_text("gamma: [0.9, 0.99]\n")
    sweep = {"algo": "own.py:Own", "conf_file": "td3", "space": "space.yml", "env": "Pendulum-v1"}
    path = write(sweeps={"s": sweep})
    monkeypatch.chdir(tmp_path / "elsewhere")
    options = sweep_options(read_study(path), "s", tmp_path, tmp_path / "results")
    assert options.algo == f"{tmp_path}/own.py:Own"
    assert options.folder == tmp_path / "results" / "sweeps" / "own.py:Own" / "tune" / "s"


def test_algorithms_of_a_file(write, tmp_path):
    (tmp_path / "mine.py").write_text("raise RuntimeError('nobody reads it yet')")
    path = write(algorithms=[{"name": "own", "algo": "mine.py:Own", "conf": "td3"}])
    cell = cells_of(read_study(path), tmp_path)[0]
    assert cell.options.algo == f"{tmp_path}/mine.py:Own"
    assert configuration(cell).settings.n_timesteps == 60


@pytest.mark.parametrize(
    "changes, message",
    [
        ({"algorithms": [{"name": "own", "algo": "mine.py:Own"}]}, "unknown algorithm"),
        (
            {"algorithms": [{"name": "td3", "environments": ["Pendulm-v1"]}]},
            "environments: unknown name 'Pendulm-v1': did you",
        ),
        ({"algorithms": [{"name": "td3", "seeds": [1, 1]}]}, "td3: seeds: 1 is there 2 times"),
        ({"algorithms": [{"name": "td3", "sweep": "s"}]}, "sweep: unknown name 's' — expected some of those before"),
        ({"algorithms": [{"name": "td3", "sweep": "s", "conf": "x"}]}, "td3: conf and sweep: expected only one of them"),
        (
            {"algorithms": [{"name": "td3", "start_from": {"algorithm": "td3", "environment": WALKER}}]},
            "start_from: unknown name 'td3' — expected some of those before",
        ),
        (
            {"algorithms": ["td3", {"name": "b", "algo": "td3", "start_from": {"algorithm": "td3", "environment": "X"}}]},
            "start_from: unknown name 'X'",
        ),
        (
            {
                "algorithms": [
                    {"name": "td3", "seeds": [5]},
                    {"name": "b", "algo": "td3", "start_from": {"algorithm": "td3", "environment": WALKER}},
                ]
            },
            "start_from: td3 has no seed 0",
        ),
        (
            {"algorithms": [{"name": "td3", "overrides": {"n_timesteps": 100}}]},
            "overrides: 'n_timesteps' — a study calls it steps, of an algorithm, an environment or all",
        ),
        ({"environments": [{"id": WALKER, "overrides": {"n_timesteps": 100}}]}, "overrides: 'n_timesteps' — a study"),
        ({"quick": {"overrides": {"n_timesteps": 100}}}, "quick: overrides: 'n_timesteps' — a study"),
        ({"sweeps": {"s": {"algo": "tdd3"}}}, "sweeps: s: unknown algorithm 'tdd3'"),
        ({"sweeps": {"s": {"algo": "td3", "n_jobs": 2}}}, "sweeps: 'n_jobs' — is for the command line"),
        ({"sweeps": {"s": {"algo": "td3", "n_trails": 2}}}, "sweeps: unknown option 'n_trails': did you mean 'n_trials'?"),
        ({"sweeps": {"s": {"algo": "td3", "timeout": 60}}}, "sweeps: 'timeout' — is for the command line"),
        ({"sweeps": {"x/y": {"algo": "td3"}}}, "sweeps: 'x/y' — expected letters, digits and . _ + -"),
        ({"sweeps": {"S": {"algo": "td3"}, "s": {"algo": "td3"}}}, "sweeps: names: 's' is there 2 times"),
        (
            {"algorithms": [{"name": "a", "algo": "sac", "sweep": "s"}], "sweeps": {"s": {"algo": "td3", "env": WALKER}}},
            "algorithms: a: sweep: s is of algorithm 'td3' — expected 'sac'",
        ),
        ({"matrix": {"label": "x", "conditions": {1: {}, "1": {}}}}, "matrix: conditions: names: '1' is there 2 times"),
        ({"matrix": {"label": "x", "conditions": {}}}, "matrix: conditions: {} — expected a mapping"),
        ({"matrix": {"label": "x", "conditions": {"a": {"mass": 3}}}}, "unknown option 'mass'"),
        ({"figures": {"training": {}}}, "figures: 'training' — expected letters"),
        ({"figures": {"x": {"algorithms": ["td4"]}}}, "figures: x: algorithms: unknown name 'td4': did you mean 'td3'?"),
        ({"figures": {"x": {"x_axis": "days"}}}, "x_axis: 'days'"),
        ({"figures": {"x": {"json_file": "a.json"}}}, "figures: 'json_file' — is for the command line"),
        ({"figures": {"x": {"tags": ["train/loss"]}}}, "figures: x: scalars are those of TensorBoard logs"),
        ({"figures": {"x": {"gait_at": 3, "tags": ["a"]}}}, "figures: gait_at: 3 — is a figure of its own, expected no tags"),
        (
            {"figures": {"x": {"evaluations": True}}, "protocol": {"eval_freq": 0}},
            "figures: x: evaluations — expected a protocol with eval_freq > 0",
        ),
        ({"figures": {"x": {"mean_per": 10, "evaluations": True}}}, "figures: --mean-per: 10 — is for training episodes"),
        (
            {
                "algorithms": [
                    "td3",
                    {"name": "b", "algo": "ddpg", "start_from": {"algorithm": "td3", "environment": WALKER}},
                ]
            },
            "b: start_from: td3 is of algorithm 'td3' — expected 'ddpg'",
        ),
        (
            {"final_episodes": 0, "matrix": {"label": "x", "conditions": {"a": {}}}},
            "final_episodes: 0 — expected 1 or more for the conditions of the matrix",
        ),
        (
            {"quick": {"final_episodes": 0}, "matrix": {"label": "x", "conditions": {"a": {}}}},
            "quick: final_episodes: 0 — expected 1 or more for the conditions of the matrix",
        ),
        ({"final_episodes": True}, "final_episodes: True — expected a whole number"),
    ],
)
def test_mistakes_of_what_goes_beyond_a_grid(write, changes, message):
    with pytest.raises(ConfigError) as error:
        read_study(write(**changes))
    assert message in str(error.value) and "\n" not in str(error.value)


BENCHMARKS = Path(__file__).parents[1] / "benchmarks"
SETTINGS_AND_STUDIES = sorted((BENCHMARKS / "studies").glob("*/*.yml"))
STUDIES = [path for path in SETTINGS_AND_STUDIES if "algorithms" in yaml.safe_load(path.read_text(encoding="utf-8"))]


def _name(path):
    """Of a shipped study and of its folder in benchmarks/results."""
    return path.parent.name if path.stem == "study" else f"{path.parent.name}_{path.stem}"


@pytest.mark.parametrize("quick", [False, True], ids=["full", "quick"])
@pytest.mark.parametrize("path", STUDIES, ids=_name)
def test_shipped_studies(path, quick, tmp_path, capsys, monkeypatch):
    if "Hopper" in path.read_text():
        pytest.importorskip("mujoco")
    monkeypatch.setattr("sb3_symphony.common.regression.has_bfloat16", lambda: True)  # one study compares it; not run here
    assert main(["bench", str(path), "--dry-run", "-f", str(tmp_path / "results"), *["--quick"] * quick]) == 0
    assert " queued" in capsys.readouterr().out.splitlines()[-1]
    assert not (tmp_path / "results").exists()


def _page(study):
    return study.with_name("README.md" if study.stem == "study" else f"{study.stem}.md")


PAGES = [path for path in STUDIES if _page(path).is_file() and "<!-- results -->" in _page(path).read_text(encoding="utf-8")]


@pytest.mark.parametrize("path", PAGES, ids=_name)
def test_pages_are_made_from_the_raw_files(path, tmp_path):
    raw, results = BENCHMARKS / "results" / _name(path), tmp_path / "results"
    if raw.is_dir():
        shutil.copytree(raw, results)
    else:  # nothing has been run
        (results / cells_of(read_study(path), path.parent)[0].name).mkdir(parents=True)
    written = _page(path).read_text(encoding="utf-8")
    page = tmp_path / "page.md"
    page.write_text(written, encoding="utf-8")
    assert main(["bench", str(path), "--report", "-f", str(results), "--page", str(page)]) == 0
    assert page.read_text(encoding="utf-8") == written


@pytest.mark.parametrize("which, page", [("ablation", "ablation.md"), ("study", "README.md")])
def test_rows_of_the_walker_are_made_from_the_raw_files(which, page):
    folder = BENCHMARKS / "studies" / "bipedalwalker"
    table = runpy.run_path(str(folder / "rows.py"))[which]()
    written = (folder / page).read_text(encoding="utf-8")
    assert re.findall("<!-- rows -->\n\n(.*?)\n\n<!-- /rows -->", written, re.DOTALL) == [table]


@pytest.mark.parametrize(
    "runs, others, expected",
    [
        ([4, 5], [1, 2, 3], "late, 10%"),  # 1 of 10 draws
        ([1, 3], [2, 4, 5], "early, 20%"),
        ([math.inf], [1, math.inf, 2], "late, 50%"),  # the last two share a rank
        ([8, 9, 10, 11, 12], [1, 2, 3, 4, 5, 6, 7], "late, < 1%"),  # 1 of 792
    ],
)
def test_chance_of_ranks(runs, others, expected):
    chance = runpy.run_path(str(BENCHMARKS / "studies" / "bipedalwalker" / "rows.py"))["chance"]
    assert chance(runs, others) == expected


def test_a_page_needs_its_marks(write, tmp_path, capsys):
    path, page = write(), tmp_path / "page.md"
    start, end = "<!-- results -->\n", "<!-- /results -->\n"
    one = "expected one line '<!-- results -->'"
    texts = ("", end + start, f"{start}kept\n{start}{end}", start + end + "kept\n" + end, start.strip() + end)
    for content, message in (*((text, one) for text in texts), (None, "cannot be read")):
        if content is not None:
            page.write_text(content)
        else:
            page.unlink()
        assert main(["bench", str(path), "--report", "--page", str(page)]) == 2
        assert message in capsys.readouterr().err
        assert content is None or page.read_text() == content
    page.write_text(start + end)
    assert main(["bench", str(path), "--page", str(page)]) == 2
    assert "belongs to --report" in capsys.readouterr().err


def test_a_page_keeps_its_ends_of_lines(tmp_path):
    page = tmp_path / "page.md"
    page.write_bytes("Ü\r\n<!-- results -->\r\nold\r\n<!-- /results -->\r\nend\n".encode())
    assert on_page(str(page), "a\nb") == "Ü\r\n<!-- results -->\r\n\r\na\r\nb\r\n<!-- /results -->\r\nend\n"


def test_no_study_file(tmp_path):
    with pytest.raises(ConfigError, match=r"nothing.yml: no such file — expected a YAML file of a study"):
        read_study(tmp_path / "nothing.yml")


def test_objects_are_not_built(tmp_path):
    (tmp_path / "study.yml").write_text("algorithms: !!python/object/apply:os.system [echo]\n")
    with pytest.raises(ConfigError, match=r"tag '!!python/object/apply:os\.system' refused"):
        read_study(tmp_path / "study.yml")
