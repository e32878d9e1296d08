"""Tables of a grid: numbers worked out by hand, and rows that say what the files say."""

import csv
import io
import json
from dataclasses import replace

import numpy as np
import pytest
import yaml

from sb3_symphony.analysis import matrix as matrix_module
from sb3_symphony.analysis.matrix import matrix_rows, matrix_table, plot_matrix, positions
from sb3_symphony.analysis.runs import open_run
from sb3_symphony.analysis.tables import (
    EPISODE_COLUMNS,
    Result,
    Thresholds,
    aligned,
    as_csv,
    episode_rows,
    markdown_table,
    run_row,
)

WALKER = Thresholds(300.0, 200.0)


@pytest.fixture
def result(tmp_path):
    """``result(algorithm, seed, evaluations, training, …)``: a run with an evaluation of two episodes every 1000 steps."""

    def make(algorithm, seed, evaluations, training, final=None, done=True, thresholds=WALKER, **options):
        path = tmp_path / algorithm / f"X-v0_{seed}"
        (path / "X-v0").mkdir(parents=True)
        rows = [f"{value},500,{k}" for k, value in enumerate(training)]
        (path / "0.monitor.csv").write_text("\n".join(['#{"t_start": 5.0}', "r,l,t", *rows]) + "\n")
        results = np.array([[mean - 1, mean + 1] for mean in evaluations], dtype=float).reshape(-1, 2)
        steps = 1000 * np.arange(1, len(evaluations) + 1)
        np.savez(path / "evaluations.npz", timesteps=steps, results=results, ep_lengths=np.full(results.shape, 7))
        used = {"algo": "td3", "env": "X-v0", "seed": seed, "protocol": "standard", **options}
        (path / "X-v0" / "args.yml").write_text(yaml.safe_dump(used))
        (path / "X-v0" / "config.yml").write_text("n_timesteps: 5000\n")
        summary = {"steps": 500 * len(training), "updates": 100 + seed, "seconds": 3700.0 + seed}
        if final is not None:
            n = len(final)
            summary["final"] = {"seed": 20_000, "returns": final, "lengths": [9] * n, "successes": [None] * (n - 1) + [True]}
        return Result(algorithm, "X-v0", seed, thresholds, open_run(path), summary if done else None)

    return make


def table_of(results):
    """Column → the row's cell, for each row; and the lines under the table."""
    heading, _, names, rule, *rest = markdown_table(results).splitlines()
    assert heading == "### X-v0" and set(rule) <= set("|-:")
    end = rest.index("")
    columns = [cell.strip() for cell in names.strip("|").split("|")]
    rows = [[cell.strip() for cell in row.strip("|").split("|")] for row in rest[:end]]
    assert {len(row) for row in [names, rule, *rest[:end]]} == {len(names)}  # aligned
    return [dict(zip(columns, row, strict=True)) for row in rows], rest[end + 1 :]


def rows_of(text):
    return list(csv.DictReader(io.StringIO(text)))


def test_markdown_by_hand(result):
    results = [
        result("a", 0, [100, 310, 320, 150, 400], [0, 301, 50, 60], final=[1.0, 3.0]),
        result("a", 1, [310, 320, 330, 340, 350], [0, 0, 302, 0, 0, 0], final=[5.0, 7.0]),
        result("a", 2, [310, 100, 310, 100, 310], [0, 0, 0, 0, 0, 0], final=[9.0, 11.0]),
        result("b", 0, [0, 0], [0, 0], final=[0.0, 0.0]),
    ]
    (a, b), notes = table_of(results)
    assert list(a) == [
        "algorithm",
        "seeds",
        "steps",
        "S300 median",
        "S300 IQM (95 % CI)",
        "E300",
        "T300",
        "unstable",
        "maximum",
        "final IQM (95 % CI)",
        "final episodes",
        "final length",
        "updates",
        "wall-clock",
    ]
    assert (a["algorithm"], a["seeds"], a["steps"]) == ("a", "3", "2 000 or 3 000")
    assert a["final length"] == "9 ± 0"
    assert a["S300 median"] == "2 000"  # 2000, 1000, > 4000: the evaluation at 5000 may be the first of two
    assert a["S300 IQM (95 % CI)"].startswith("> 2 333 (1 000 … > 4 000")  # the mean: with three nothing is cut
    assert a["E300"] == "3 (1 500)"  # episodes 2, 3, > 6: steps 1000, 1500, > 3000
    assert a["T300"] == "> 6 (> 3 000)"  # fewer than 100 episodes
    # After 2000: 320, 150, 400; after 1000: 320 … 350. Each of two episodes, those around 150 fail
    assert a["unstable"] == "2 / 14"
    assert a["maximum"] == "350.0 (400.0)"
    assert a["final IQM (95 % CI)"] == "6.0 (2.0 … 10.0)"
    assert a["final episodes"] == "6.0 ± 3.4, 6.0"  # of 1, 3, 5, 7, 9, 11
    assert (a["updates"], a["wall-clock"]) == ("101", "1:02 h")
    assert (b["S300 median"], b["S300 IQM (95 % CI)"], b["E300"], b["unstable"]) == (
        "> 2 000",
        "> 2 000",
        "> 2 (> 1 000)",
        "–",
    )
    assert not any(line.startswith(("- non-standard", "- not done")) for line in notes)


def test_what_is_not_done_or_not_standard_is_told(result):
    results = [
        result("a", 0, [310, 310], [0]),
        result("a", 1, [310, 310], [0], done=False),
        Result("a", "X-v0", 2, WALKER, None, None),
        result("b", 0, [310, 310], [0], protocol=None, eval_freq=1000, eval_episodes=1),
        Result("c", "X-v0", 0, WALKER, None, None),
    ]
    (a, b, c), notes = table_of(results)
    assert (a["algorithm"], a["seeds"], a["S300 median"]) == ("a", "1 of 3", "1 000")
    assert b["algorithm"] == "b (non-standard)" and b["seeds"] == "1"
    assert c["seeds"] == "not run yet" and c["S300 median"] == c["updates"] == "–"
    assert "- non-standard: evaluated every 1 000 steps on 1 episode" in notes
    assert "- not done, and not in these numbers: a 1, a 2" in notes
    half_way = result("d", 0, [], [0, 0, 0], done=False)
    assert table_of([half_way])[0][0]["steps"] == "1 500 so far"


def test_rows_of_which_no_run_is_done_tell_how_far_they_have_come(result):
    results = [
        result("a", 0, [310, 310], [0, 301, 0], done=False),
        result("a", 1, [310], [0, 0], done=False),
        result("a", 2, [], [], done=False),
        result("b", 0, [310, 310], [301], final=[1.0]),
    ]
    (a, _), notes = table_of(results)
    assert (a["seeds"], a["steps"]) == ("0 of 3", "1 500 so far")
    assert a["S300 median"] == "> 500"  # 1000, > 0: the one evaluation of run 1 may be the first of two
    assert a["E300"] == "> 2 (> 1 000)"  # episodes 2, > 2
    assert a["T300"] == "> 2.5 (> 1 250)"  # > 3, > 2
    assert a["maximum"] == "310.0 (310.0)"
    assert {a[name] for name in ("final IQM (95 % CI)", "final episodes", "final length", "updates", "wall-clock")} == {"–"}
    assert "- not done, and in these numbers as far as they have come: a 0, a 1" in notes
    assert "- not done, and not in these numbers: a 2" in notes


def test_only_columns_that_say_something(result):
    nothing = Thresholds(None, None)
    (row,), notes = table_of([result("a", 0, [1, 2], [0], thresholds=nothing)])
    assert list(row) == ["algorithm", "seeds", "steps", "maximum", "updates", "wall-clock"]
    assert not any(line.startswith(("- S", "- unstable", "- final")) for line in notes)
    (row,), _ = table_of([result("b", 0, [-120, -110], [-500, -90], thresholds=Thresholds(-150.0, None))])
    assert row["S-150 median"] == "1 000" and row["E-150"] == "2 (1 000)" and "unstable" not in row


def test_divergence_is_no_success(result):
    (row,), _ = table_of([result("a", 0, [np.nan, np.nan], [0, np.nan])])
    assert (row["S300 median"], row["E300"], row["maximum"]) == ("> 2 000", "> 2 (> 1 000)", "–")
    assert run_row(result("b", 0, [np.nan], [np.nan]))["best_evaluation"] is None


def test_a_row_for_each_run(result):
    results = [
        result("a", 0, [100, 310, 320], [0, 301, 50], final=[1.0, 3.0]),
        result("b", 4, [0, 0], [0, 10], done=False, protocol=None),
        Result("c", "X-v0", 5, WALKER, None, None),
    ]
    a, b, c = rows_of(as_csv(run_row(results[0]), map(run_row, results)))
    assert (a["algorithm"], a["environment"], a["seed"], a["protocol"], a["done"]) == ("a", "X-v0", "0", "standard", "1")
    assert (a["stable_reached"], a["stable_step"], a["stable_episode"]) == ("1", "2000", "")
    assert (a["first_reached"], a["first_step"], a["first_episode"]) == ("1", "1000", "2")
    assert (a["trailing_reached"], a["trailing_step"], a["trailing_episode"]) == ("0", "1500", "3")
    assert (a["unstable"], a["unstable_of"], a["best_evaluation"], a["best_episode"]) == ("0", "2", "320.0", "301.0")
    assert (a["final_episodes"], a["final_mean"], a["final_std"], a["final_iqm"]) == ("2", "2.0", "1.0", "2.0")
    assert (a["steps"], a["updates"], a["seconds"], a["threshold"]) == ("1500", "100", "3700.0", "300.0")
    assert (b["protocol"], b["done"], b["stable_reached"], b["best_episode"]) == ("non-standard", "0", "0", "10.0")
    assert (c["protocol"], c["done"], c["stable_step"], c["best_episode"], c["final_mean"]) == ("", "0", "", "", "")


def test_a_row_for_each_episode(result):
    results = [result("a", 0, [100, 310], [0, 301, 50], final=[1.5, 3.0]), Result("c", "X-v0", 5, WALKER, None, None)]
    rows = rows_of(as_csv(EPISODE_COLUMNS, episode_rows(results)))
    assert {(row["algorithm"], row["environment"], row["seed"]) for row in rows} == {("a", "X-v0", "0")}
    kinds = {kind: [row for row in rows if row["kind"] == kind] for kind in ("training", "evaluation", "final")}
    assert sum(map(len, kinds.values())) == len(rows)

    def column(kind, name):
        return [json.loads(row[name] or "null") for row in kinds[kind]]

    assert column("training", "step") == [500, 1000, 1500] and column("training", "episode") == [1, 2, 3]
    assert column("training", "return") == [0, 301, 50] and column("training", "environment_seed") == [None] * 3
    assert column("evaluation", "step") == [1000, 1000, 2000, 2000] and column("evaluation", "episode") == [1, 2, 1, 2]
    assert column("evaluation", "return") == [99, 101, 309, 311] and column("evaluation", "length") == [7] * 4
    assert column("evaluation", "environment_seed") == [10_000, 10_001] * 2
    assert column("final", "return") == [1.5, 3.0] and column("final", "environment_seed") == [20_000, 20_001]
    assert column("final", "step") == [1500, 1500] and column("final", "success") == [None, 1]


def test_before_the_first_episode(result):
    """Of a grid that was interrupted soon: no monitored episode, no evaluation, nothing done."""
    results = [result("a", 0, [], [], done=False), Result("a", "X-v0", 1, WALKER, None, None)]
    assert as_csv(EPISODE_COLUMNS, episode_rows(results)) == ",".join(EPISODE_COLUMNS) + "\n"
    first, second = rows_of(as_csv(run_row(results[0]), map(run_row, results)))
    assert (first["done"], first["stable_reached"], first["stable_step"], first["best_evaluation"]) == ("0", "0", "0", "")
    assert second["stable_step"] == ""
    (row,), _ = table_of(results)
    assert row["seeds"] == "0 of 2"


def test_what_others_reported(result):
    ours, theirs = result("a", 0, [1], [1]), result("b", 0, [1], [1])
    (a, b), _ = table_of([ours, replace(theirs, reported="300 ± 5")])
    assert (a["reported"], b["reported"]) == ("–", "300 ± 5")
    assert "reported" not in table_of([ours, theirs])[0][0]


def under(returns):
    return {"seed": 20_000, "returns": returns, "lengths": [3] * len(returns), "successes": [None] * len(returns)}


@pytest.fixture
def matrix(result):
    """Two algorithms under three conditions, one of two seeds not done and one condition missing."""
    conditions = {"2": under([1.0, 3.0]), "4": under([10.0, 20.0]), "10": under([100.0, 100.0])}
    runs = [result("a", 0, [1], [1]), result("a", 1, [1], [1]), result("b", 0, [1], [1]), result("c", 0, [1], [1], done=False)]
    runs[0].summary["conditions"] = conditions
    runs[1].summary["conditions"] = {**conditions, "2": under([5.0, 7.0])}
    runs[2].summary["conditions"] = {"2": under([0.0, 0.0])}
    return runs


def test_matrix(matrix, tmp_path):
    names = ["2", "4", "10"]
    heading, _, columns, rule, a, b, c, *_ = matrix_table(matrix, names, "mass (kg)").splitlines()
    assert heading == "### X-v0: mass (kg)" and set(rule) <= set("|-:")
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in (columns, a, b, c)]
    assert cells == [
        ["mass (kg):", "2", "4", "10"],
        ["a", "4 ± 2", "15 ± 5", "100 ± 0"],  # 1, 3, 5, 7: variance 5
        ["b", "0 ± 0", "–", "–"],
        ["c", "–", "–", "–"],
    ]
    rows = matrix_rows(matrix)
    assert [(row["algorithm"], row["seed"], row["condition"]) for row in rows] == [
        *(("a", seed, name) for seed in (0, 1) for name in names),
        ("b", 0, "2"),
    ]
    assert (rows[1]["mean"], rows[1]["std"], rows[1]["iqm"], rows[1]["episodes"]) == (15, 5, 15, 2)
    episodes = [row for row in episode_rows(matrix) if row["kind"] == "condition 10"]
    assert [(row["algorithm"], row["seed"], row["environment_seed"], row["return"]) for row in episodes] == [
        ("a", seed, 20_000 + i, 100.0) for seed in (0, 1) for i in range(2)
    ]
    output = tmp_path / "matrix.png"
    assert plot_matrix(matrix, names, "mass (kg)", output) == output and output.stat().st_size > 10_000
    assert plot_matrix(matrix[3:], names, "mass (kg)", output) is None and not output.exists()  # nothing to draw any more


def test_lines_of_a_matrix_go_to_the_right(matrix, tmp_path, monkeypatch):
    """Also if the study's conditions do not rise; the name stands where the line ends."""
    drawn = []
    monkeypatch.setattr(matrix_module, "save", lambda figure, output: drawn.append(figure))
    plot_matrix(matrix[:2], ["4", "10", "2"], "mass (kg)", tmp_path / "matrix.png")
    _, lines = drawn[0].axes
    x, y = lines.lines[0].get_data()
    assert x.tolist() == [2, 4, 10] and y.tolist() == [4, 15, 100]
    (name,) = lines.texts
    _, end = (lines.transData + lines.transAxes.inverted()).transform((10, 100))
    assert name.get_text() == "a" and name.xy[1] == pytest.approx(end)


def test_places_of_conditions():
    assert positions(["2", "4", "10"]).tolist() == [2, 4, 10]
    assert positions(["as trained", "delayed"]).tolist() == [0, 1]


def test_cells_do_not_break_a_table():
    assert aligned([["a", "b"], ["x|y", "1\n2"]]) == ["| a    |   b |", "|------|----:|", r"| x\|y | 1 2 |"]
