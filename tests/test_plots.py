"""Figures: what is drawn equals what the files say."""

import json
import shutil

import numpy as np
import pytest
import yaml
from matplotlib import image
from matplotlib.colors import to_hex
from matplotlib.text import Text
from torch.utils.tensorboard import SummaryWriter

from sb3_symphony.analysis import plots
from sb3_symphony.analysis.plots import (
    NotRecorded,
    block_mean,
    evaluation_curve,
    plot_scalars,
    plot_training,
    running_mean,
    scalar_curve,
    summarised,
)
from sb3_symphony.analysis.runs import open_run, read_scalars
from sb3_symphony.analysis.statistics import bootstrap_interval, iqm
from sb3_symphony.analysis.style import COLORS, line_style, save, spread
from sb3_symphony.cli import main


def make_run(folder, algo, env, number, returns, seconds_per_episode=60.0, length=100, log=False):
    """A run whose episodes have the given returns, with an evaluation every 200 steps."""
    path = folder / algo / f"{env}_{number}"
    (path / env).mkdir(parents=True)
    rows = [f"{value},{length},{seconds_per_episode * (k + 1)}" for k, value in enumerate(returns)]
    (path / "0.monitor.csv").write_text("\n".join(['#{"t_start": 5.0}', "r,l,t", *rows]) + "\n")
    steps = np.arange(200, len(returns) * length + 1, 200)
    results = np.asarray(returns)[steps // length - 1][:, None] + np.array([-1.0, 0.0, 4.0])
    np.savez(path / "evaluations.npz", timesteps=steps, results=results, ep_lengths=np.full(results.shape, 7))
    (path / env / "args.yml").write_text(yaml.safe_dump({"algo": algo, "env": env, "seed": number}))
    (path / env / "config.yml").write_text(yaml.safe_dump({"n_timesteps": 1000}))
    if log:
        with SummaryWriter(folder / "tb" / f"{algo}_{number}") as writer:
            for k, value in enumerate(returns):
                writer.add_scalar("train/critic_loss", value**2, 100 * k)
                writer.add_scalar("train/own", value, 100 * k)
        (path / env / "tensorboard.txt").write_text(str(folder / "tb" / f"{algo}_{number}"))
    return path


@pytest.fixture
def figures(monkeypatch):
    """Figures that were saved."""
    saved = []
    monkeypatch.setattr(plots, "save", lambda figure, output: saved.append(figure) or save(figure, output))
    return saved


@pytest.fixture
def logs(tmp_path, monkeypatch):
    """Three seeds of sac, one of td3 on X, one of sac on Y."""
    monkeypatch.chdir(tmp_path)
    folder = tmp_path / "logs"
    rng = np.random.default_rng(0)
    for number in (1, 2, 3):
        make_run(folder, "sac", "X-v0", number, rng.normal(size=20) + np.arange(20), log=True)
    make_run(folder, "td3", "X-v0", 1, np.arange(30.0))
    make_run(folder, "sac", "Y-v0", 1, np.arange(10.0))
    return folder


def lines(axes):
    """Bold and faint lines of a panel, as (x, y)."""
    bold = [line.get_xydata().T for line in axes.lines if line.get_linewidth() > 1]
    faint = [line.get_xydata().T for line in axes.lines if line.get_linewidth() <= 1]
    return bold, faint


def returns_of(folder, number, algo="sac"):
    return np.loadtxt(folder / algo / f"X-v0_{number}" / "0.monitor.csv", delimiter=",", skiprows=2)[:, 0]


def texts(axes):
    return [text.get_text() for text in axes.texts]


# ---------------------------------------------------------------- numbers


def test_running_mean():
    np.testing.assert_allclose(running_mean(np.array([1.0, 2.0, 3.0, 4.0]), 2), [1.0, 1.5, 2.5, 3.5])
    known = running_mean(np.array([1.0, 2.0, np.nan, 4.0, 5.0, 6.0]), 2)
    np.testing.assert_array_equal(known, [1.0, 1.5, np.nan, np.nan, 4.5, 5.5])
    np.testing.assert_array_equal(running_mean(np.array([np.inf, 1.0, 1.0, 3.0]), 2), [np.nan, np.nan, 1.0, 2.0])


def test_block_mean():
    np.testing.assert_allclose(block_mean(np.arange(8.0), 3), [1.0, 4.0])


def test_seeds_at_the_same_points():
    seeds = [(np.array([10, 20, 30]), np.array(y)) for y in ([1.0, 5, 9], [3.0, 5, 7], [2.0, 8, 0], [0.0, 0, 1])]
    seeds.append((np.array([10, 20]), np.array([7.0, 2.0])))  # a shorter run is not left out
    curve = summarised("a", seeds)
    values = np.array([y[:2] for _, y in seeds])
    np.testing.assert_array_equal(curve.x, [10, 20])
    np.testing.assert_allclose(curve.y, iqm(values, axis=0))
    np.testing.assert_allclose([curve.low, curve.high], bootstrap_interval([values], repetitions=2000))


def test_seeds_at_different_points_are_interpolated():
    curve = summarised(
        "a", [(np.array([0, 100]), np.array([0.0, 100.0])), (np.array([50, 80, 150]), np.array([50.0, 80.0, 150.0]))]
    )
    assert (curve.x[0], curve.x[-1]) == (50, 100)
    np.testing.assert_allclose(curve.y, curve.x)
    apart = summarised("a", [(np.array([0, 1]), np.zeros(2)), (np.array([5, 6]), np.zeros(2))])
    assert len(apart.x) == 0 and len(apart.seeds) == 2


def test_names_do_not_overlap():
    rng = np.random.default_rng(0)
    np.testing.assert_allclose(spread([0.9, 0.1, 0.5], [0.2] * 3), [0.9, 0.1, 0.5])  # nothing to do
    np.testing.assert_allclose(spread([0.5, 0.5], [0.2, 0.2]), [0.4, 0.6])
    np.testing.assert_allclose(spread([0.5, 0.4], [0.1, 0.3]), [0.55, 0.35])
    np.testing.assert_allclose(spread([0.5, 0.4, 3.0, -2.0], [0.1, 0.3, 0.1, 0.2]), [0.55, 0.35, 0.95, 0.1])
    np.testing.assert_allclose(spread([0.5, 3.0], [1.0, 2.0]), [-0.5, 1.0])  # no room: as much outside at both ends
    for _ in range(50):
        wished, sizes = rng.random(6), rng.uniform(0.02, 0.15, 6)
        placed, order = spread(wished, sizes), np.argsort(wished)
        assert (np.diff(placed[order]) > (sizes[order][1:] + sizes[order][:-1]) / 2 - 1e-9).all()
        assert (placed - sizes / 2).min() > -1e-9 and (placed + sizes / 2).max() < 1 + 1e-9
        # No smaller sum of squares by what keeps the order and the room: along each way to such a place it grows
        for _ in range(20):
            other = np.sort(rng.random(6))[np.argsort(order)] * (1 - sizes.sum())
            other[order] += np.cumsum(sizes[order]) - sizes[order] / 2
            assert (placed - wished) @ (other - placed) > -1e-9


def test_lines_differ():
    assert len({(style["color"], style["linestyle"]) for style in map(line_style, range(42))}) == 42
    dark, light = (line_style(COLORS.index(blue))["linestyle"] for blue in ("#0072B2", "#2E8BBF"))
    assert dark != light


# ---------------------------------------------------------------- figures


def test_names_given_twice(logs, figures):
    assert main(["plot", "-a", "sac", "sac", "-e", "X-v0", "X-v0"]) == 0
    (axes,) = figures[0].axes
    bold, faint = lines(axes)
    assert len(bold) == 1 and len(faint) == 3


@pytest.mark.parametrize("n_runs, opacity", [(4, 0.35), (60, 0.1)])
def test_many_runs_are_drawn_fainter(tmp_path, figures, n_runs, opacity):
    x, nothing = np.arange(3.0), np.zeros(0)
    curves = [plots.Curve(label, [(x, x)] * (n_runs // 2), x, x, nothing, nothing) for label in "ab"]
    plots.plot_curves({"X-v0": curves}, "steps", "reward", "", tmp_path / "curves.png")
    faint = [line for line in figures[0].axes[0].lines if line.get_linewidth() <= 1]
    assert [line.get_alpha() for line in faint] == pytest.approx([opacity] * n_runs)


def test_training_curves(logs, figures, capsys):
    assert main(["plot", "-a", "sac", "td3", "-e", "X-v0", "-w", "5"]) == 0
    assert capsys.readouterr().out.strip() == "logs/X-v0_episodes.png"
    (axes,) = figures[0].axes
    bold, faint = lines(axes)
    seeds = np.array([running_mean(returns_of(logs, number), 5) for number in (1, 2, 3)])
    np.testing.assert_array_equal(bold[0][0], np.arange(100, 2001, 100))
    np.testing.assert_allclose(bold[0][1], iqm(seeds, axis=0))
    np.testing.assert_allclose([y for _, y in faint], seeds)
    np.testing.assert_allclose(bold[1][1], running_mean(np.arange(30.0), 5))
    (band,) = axes.collections
    low, high = bootstrap_interval([seeds], repetitions=2000)
    vertices = band.get_paths()[0].vertices
    for x, bottom, top in zip(bold[0][0], low, high, strict=True):
        heights = vertices[vertices[:, 0] == x][:, 1]
        assert heights.min() == pytest.approx(bottom) and heights.max() == pytest.approx(top)
    assert texts(axes) == ["sac, 3 seeds", "td3"]
    assert [to_hex(text.get_color()).upper() for text in axes.texts] == list(COLORS[:2])
    drawn = [line for line in axes.lines if line.get_linewidth() > 1]
    for text, piece, line in zip(axes.texts, figures[0].artists, drawn, strict=True):  # a piece of its line before each name
        assert (piece.get_color(), piece.get_linestyle()) == (line.get_color(), line.get_linestyle())
        at, name = piece.get_window_extent(), text.get_window_extent()
        assert axes.bbox.x1 < at.x0 < at.x1 < name.x0 and abs((at.y0 + at.y1 - name.y0 - name.y1) / 2) < name.height / 4
    assert axes.get_xlabel() == "environment steps" and axes.get_ylabel() == "return per episode"
    assert "running mean of 5 episodes" in figures[0].get_supxlabel().replace("\n", " ")


def test_a_panel_for_each_environment(logs, figures):
    assert main(["plot", "-l", "SAC", "TD3", "-o", "all.svg"]) == 0
    assert [axes.get_title("left") for axes in figures[0].axes] == ["X-v0", "Y-v0"]
    assert texts(figures[0].axes[1]) == ["SAC"]  # in the colour it has in the other panel
    assert to_hex(figures[0].axes[1].texts[0].get_color()).upper() == COLORS[0]
    assert b"<svg" in (logs.parent / "all.svg").read_bytes()[:1000]


def test_mean_per_ten_episodes(logs, figures):
    assert main(["plot", "logs/td3/X-v0_1", "-x", "episodes", "--mean-per", "10"]) == 0
    (bold,), faint = lines(figures[0].axes[0])
    np.testing.assert_allclose(bold, [[10, 20, 30], [4.5, 14.5, 24.5]])
    assert not faint and figures[0].axes[0].get_xlabel() == "training episodes"
    assert (logs / "td3" / "X-v0_1" / "episodes.png").exists()
    for letter in "ABC":
        make_run(logs, "td3", f"{letter}-v0", 1, np.arange(10.0))
    assert main(["plot"]) == 0
    assert (logs / "5_environments_episodes.png").exists()  # not all of their names, which a file cannot have


@pytest.mark.parametrize("seconds, unit, last", [(0.1, "seconds", "3"), (20.0, "minutes", "10"), (3600.0, "hours", "30")])
def test_wall_clock(tmp_path, figures, seconds, unit, last):
    run = make_run(tmp_path, "sac", "X-v0", 1, np.arange(30.0), seconds_per_episode=seconds)
    assert main(["plot", str(run), "-x", "time"]) == 0
    (bold,), _ = lines(figures[0].axes[0])
    np.testing.assert_allclose(bold[0], seconds * np.arange(1, 31))
    axes = figures[0].axes[0]
    assert axes.get_xlabel() == f"wall-clock time ({unit})"
    assert axes.get_xticklabels()[-1].get_text() == last


def test_episode_lengths_and_cut(logs, figures):
    assert main(["plot", "logs/sac/Y-v0_1", "-y", "length", "-max", "500"]) == 0
    (bold,), _ = lines(figures[0].axes[0])
    np.testing.assert_allclose(bold, [[100, 200, 300, 400, 500], [100] * 5])
    assert figures[0].axes[0].get_ylabel() == "episode length (steps)"


@pytest.mark.parametrize("axis, scale", [("steps", 1.0), ("episodes", 0.01), ("time", 0.6)])
def test_evaluations(logs, figures, axis, scale):
    assert main(["plot", "-a", "sac", "-e", "X-v0", "--evaluations", "-x", axis]) == 0
    (bold,), faint = lines(figures[0].axes[0])
    seeds = np.array([returns_of(logs, number)[1::2] + 1.0 for number in (1, 2, 3)])
    np.testing.assert_allclose(bold[0], np.arange(200, 2001, 200) * scale)
    np.testing.assert_allclose(bold[1], iqm(seeds, axis=0))
    np.testing.assert_allclose([y for _, y in faint], seeds)


def test_time_after_the_last_training_episode(tmp_path):
    """It goes on at the mean speed until then; without an episode nothing is known of it."""
    run = make_run(tmp_path, "sac", "X-v0", 1, np.arange(4.0), seconds_per_episode=30.0)
    np.savez(run / "evaluations.npz", timesteps=[200, 400, 500, 800], results=np.ones((4, 1)), ep_lengths=np.ones((4, 1)))
    assert evaluation_curve(open_run(run), "time", "reward")[0] == pytest.approx([60, 120, 150, 240])
    assert evaluation_curve(open_run(run), "episodes", "reward")[0] == pytest.approx([2, 4, 4, 4])
    (run / "0.monitor.csv").write_text('#{"t_start": 5.0}\nr,l,t\n')
    with pytest.raises(NotRecorded, match="no training episode has ended"):
        evaluation_curve(open_run(run), "time", "reward")


def test_scalars(logs, figures, capsys):
    assert main(["plot", "-e", "X-v0", "--scalars", "-o", "s.png"]) == 0
    captured = capsys.readouterr()
    assert captured.err.count("\n") == 1 and "left out: logs/td3/X-v0_1: no TensorBoard log is known" in captured.err
    (axes,) = figures[0].axes
    (bold,), faint = lines(axes)
    seeds = np.array([returns_of(logs, number) ** 2 for number in (1, 2, 3)])
    np.testing.assert_allclose(bold[1], iqm(seeds, axis=0), rtol=1e-5)
    np.testing.assert_allclose([y for _, y in faint], seeds, rtol=1e-5)
    assert (axes.get_title("left"), axes.get_ylabel()) == ("critic loss", "loss")
    assert main(["plot", "logs/tb/sac_1", "--tags", "train/own", "train/critic_loss", "-o", "s.png"]) == 0
    assert [axes.get_title("left") for axes in figures[1].axes] == ["train/own", "critic loss"]
    np.testing.assert_allclose(lines(figures[1].axes[0])[0][0][1], returns_of(logs, 1), rtol=1e-6)


def test_panels_of_scalars_have_one_axis_of_time(figures, tmp_path):
    def curve(label, hours):
        return summarised(label, [(np.linspace(0, 3600 * hours, 60), np.sin(np.arange(60)))])

    panels = {"train/approx_kl": [curve("ppo", 1.7)], "rollout/ep_rew_mean": [curve("ppo", 1.7), curve("sac", 10)]}
    plot_scalars({**panels, **{f"train/{k}": [curve("sac", 10)] for k in range(2)}}, "time", tmp_path / "s.png", "X-v0")
    axes = figures[0].axes
    assert len({each.get_xlim() for each in axes}) == 1
    assert {tuple(text.get_text() for text in each.get_xticklabels()) for each in axes} == {("0", "2", "4", "6", "8", "10")}
    assert [each.get_xlabel() for each in axes] == ["", *["wall-clock time (hours)"] * 3]


@pytest.mark.parametrize("n_panels, names", [(1, 5), (2, 12), (3, 5), (1, 1)])
def test_names_of_scalars_are_all_to_be_seen(figures, tmp_path, n_panels, names):
    line = (np.arange(9), np.arange(9))
    labels = [f"algorithm learning_rate 0.0003, buffer_size {size}" for size in range(names)]
    curves = [summarised(label, [line, line]) for label in labels]
    plot_scalars({f"train/{k}": curves for k in range(n_panels)}, "steps", tmp_path / "s.png", "Pendulum-v1")
    figure = figures[0]
    figure.draw_without_rendering()
    told = figure.legends[0].get_texts() if names > 1 else [figure._suptitle]
    assert [" ".join(text.get_text().split()) for text in told] == (
        [f"{label}, 2 seeds" for label in labels] if names > 1 else [f"Pendulum-v1: {labels[0]}, 2 seeds"]
    )
    boxes = [text.get_window_extent() for text in told] + [axes.get_tightbbox() for axes in figure.axes]
    boxes += [each.get_title().get_window_extent() for each in figure.legends]
    width, height = figure.get_size_inches() * figure.dpi
    assert all(box.x0 >= 0 and box.x1 <= width and box.y0 >= 0 and box.y1 <= height for box in boxes)
    assert boxes[0].count_overlaps(boxes[1:]) == boxes[-1].count_overlaps(boxes[:-1]) == 0


def test_time_of_scalars_is_that_of_training(tmp_path, figures):
    path = make_run(tmp_path, "sac", "X-v0", 1, np.arange(10.0))  # 100 steps a minute
    with SummaryWriter(tmp_path / "tb") as writer:
        for k in range(5):
            writer.add_scalar("train/loss", k, 200 * k, walltime=1000.0 + 120 * k + 30_000 * (k > 2))  # a night between
    (path / "X-v0" / "tensorboard.txt").write_text(str(tmp_path / "tb"))
    x, _ = scalar_curve(open_run(path), "train/loss", "time")
    np.testing.assert_allclose(x, [0, 120, 240, 360, 480])
    x, _ = scalar_curve(open_run(tmp_path / "tb"), "train/loss", "time")  # the log alone does not know
    np.testing.assert_allclose(np.diff(x), [120, 120, 30_120, 120])


def test_numbers_as_json(logs, capsys):
    assert main(["plot", "-e", "X-v0", "-w", "1", "--json", "curves.json", "--quiet"]) == 0
    assert capsys.readouterr().out == ""
    content = json.loads((logs.parent / "curves.json").read_text())
    sac, td3 = content["panels"]["X-v0"]
    assert (content["x"], sac["label"], td3["y"]) == ("steps", "sac", list(range(30)))
    np.testing.assert_allclose(sac["seeds"][1]["y"], returns_of(logs, 2))


def test_images(logs):
    for name, start in (("a.png", b"\x89PNG"), ("b.pdf", b"%PDF"), ("c.svg", b"<?xml")):
        assert main(["plot", "-o", name]) == 0
        first = (logs.parent / name).read_bytes()
        assert first.startswith(start)
        assert main(["plot", "-o", name]) == 0
        assert (logs.parent / name).read_bytes() == first  # drawn again, the same file
    pixels = image.imread(logs.parent / "a.png")
    assert pixels.shape[1] >= 1400 and pixels[..., :3].std() > 0.05


def test_names_are_no_formulas(logs, figures):
    assert main(["plot", "-a", "sac", "-l", "cost $x_$ and ^$"]) == 0
    assert "cost $x_$ and ^$" in {text.get_text() for text in figures[0].findobj(Text)}


def test_nothing_is_cut_off(logs, figures):
    names = ["a rather long name of a curve", "another name that is longer still than the first"]
    assert main(["plot", "-l", *names, "-e", "X-v0"]) == 0
    figure = figures[0]
    figure.draw_without_rendering()
    width, height = figure.get_size_inches() * figure.dpi
    for axes in figure.axes:
        for text in axes.texts:
            box = text.get_window_extent()
            assert box.x0 >= 0 and box.x1 <= width and box.y0 >= 0 and box.y1 <= height
        assert axes.get_window_extent().width > width / 2
        first, *others = (text.get_window_extent() for text in axes.texts)
        assert first.count_overlaps(others) == 0


# ---------------------------------------------------------------- the figure of a run


def test_plot_training(tmp_path, figures):
    run = make_run(tmp_path, "sac", "X-v0", 3, np.arange(30.0))
    assert plot_training(run) == run / "training.png"
    (axes,) = figures[0].axes
    assert axes.get_title("left") == "sac on X-v0, seed 3"
    dots, mean, evaluation = (line.get_xydata().T for line in axes.lines[:3])
    np.testing.assert_allclose(dots, [np.arange(100, 3001, 100), np.arange(30)])
    np.testing.assert_allclose(mean[1], running_mean(np.arange(30.0), 20))
    np.testing.assert_allclose(evaluation, [np.arange(200, 3001, 200), np.arange(1.0, 30, 2) + 1])
    assert texts(axes) == ["training,\nmean of 20", "evaluation"]
    assert plot_training(run, tmp_path / "curve.pdf").read_bytes().startswith(b"%PDF")


def test_a_run_without_episodes_has_a_figure_too(tmp_path, figures):
    (tmp_path / "0.monitor.csv").write_text('#{"t_start": 5.0}\nr,l,t\n')
    assert plot_training(tmp_path).exists()
    assert texts(figures[0].axes[0]) == ["no finished episode"]


# ---------------------------------------------------------------- mistakes


@pytest.mark.parametrize(
    "arguments, message",
    [
        ("-a sca", "-a: 'sca' — no such run in logs: did you mean 'sac'?"),
        ("-e X-v1", "-e: 'X-v1' — no such run in logs: did you mean 'X-v0'?"),
        ("-f nowhere", "no runs in 'nowhere'"),
        ("-f nowhere -a sac", "-a: 'sac' — no such run in nowhere"),
        ("logs/sac", "logs/sac: no run folder and no TensorBoard log"),
        ("logs/sac/X-v0_9", "logs/sac/X-v0_9: no such folder"),
        ("logs/sac/X-v0_1 -a sac", "expected run folders, or -a and -e to look for runs, not both"),
        ("--scalars --evaluations", "expected only one of them"),
        ("logs/sac/X-v0_1 -f logs", "expected run folders, or -f to look for runs, not both"),
        ("-w 5 --mean-per 10", "-w: 5 — is for running means of training episodes, not for --mean-per"),
        ("-w 5 --evaluations", "-w: 5 — is for running means of training episodes, not for --evaluations"),
        ("--scalars -y length", "-y: length — is for episodes"),
        ("--evaluations --mean-per 10", "--mean-per: 10 — is for training episodes"),
        ("--scalars -a td3", "logs/td3/X-v0_1: no TensorBoard log is known"),
        ("--tags train/critic_los", "did you mean 'train/critic_loss'?"),
        ("-l a", "-l: 1 labels — expected 2, for sac, td3"),
        ("-max 1", "nothing to draw with -max 1"),
        ("--mean-per 100000", "nothing to draw with --mean-per 100000"),
        ("-y success", "does not tell whether an episode is a success"),
        ("-o picture.bmp", "--output: 'picture.bmp' — expected a file name that ends with .png or .svg or .pdf"),
        ("-o none/a.png", "there is no folder none"),
        ("-o /proc/a.png", "cannot be written"),
        ("-w 0", "episode_window: 0"),
        ("-x miles", "unknown x_axis 'miles'"),
        ("--tag x", "did you mean '--tags'?"),
    ],
)
def test_mistakes(logs, capsys, arguments, message):
    before = sorted(logs.parent.rglob("*"))
    try:
        status = main(["plot", *arguments.split()])
    except SystemExit as error:
        status = error.code
    captured = capsys.readouterr()
    assert status == 2 and captured.err.count("\n") == 1 and message in captured.err
    assert sorted(logs.parent.rglob("*")) == before


@pytest.mark.parametrize("content", [b"broken", b""])
@pytest.mark.parametrize("name, flags", [("0.monitor.csv", []), ("evaluations.npz", ["--evaluations"])])
def test_a_damaged_file(logs, capsys, figures, content, name, flags):
    (logs / "sac" / "X-v0_2" / name).write_bytes(content)
    assert main(["plot", "-a", "sac", "-e", "X-v0", *flags]) == 0
    told = capsys.readouterr().err
    assert told.startswith(f"left out: logs/sac/X-v0_2/{name}: not ") and told.count("\n") == 1
    assert main(["plot", "logs/sac/X-v0_2", *flags]) == 2
    assert f"{name}: not " in capsys.readouterr().err


def test_logs_that_are_empty_or_gone(logs, capsys):
    shutil.rmtree(logs / "tb" / "sac_1")
    shutil.rmtree(logs / "tb" / "sac_2")
    (logs / "tb" / "sac_2").mkdir()
    assert main(["plot", "-a", "sac", "-e", "X-v0", "--scalars", "-o", "s.png"]) == 0
    told = capsys.readouterr().err.splitlines()
    assert told[0] == f"left out: logs/sac/X-v0_1: its TensorBoard log '{logs}/tb/sac_1' is gone"
    assert told[1:] == ["left out: logs/sac/X-v0_2: nothing is logged yet"]
    assert main(["plot", "logs/sac/X-v0_2", "--scalars", "-o", "s.png"]) == 2
    assert "logs/sac/X-v0_2: nothing is logged yet" in capsys.readouterr().err


def test_a_run_without_evaluations_is_told(logs, capsys, figures):
    (logs / "sac" / "X-v0_2" / "evaluations.npz").unlink()
    assert main(["plot", "--evaluations", "-e", "X-v0", "-a", "sac"]) == 0
    assert "left out: logs/sac/X-v0_2: has no evaluations.npz" in capsys.readouterr().err
    assert texts(figures[0].axes[0]) == ["sac, 2 seeds"]


def test_the_log_of_a_run_is_found(tmp_path, monkeypatch, figures):
    monkeypatch.chdir(tmp_path)
    argv = "train --algo td3 --env Pendulum-v1 -n 450 --eval-freq 0 --no-progress --verbose 0 -tb tb --log-interval 1"
    small = ["learning_starts:100", "buffer_size:500", "policy_kwargs.net_arch:[16]"]
    for seed in ("0", "1"):
        assert main([*argv.split(), "--seed", seed, "-params", *small]) == 0
    logs = [open_run(tmp_path / f"logs/td3/Pendulum-v1_{k}").log for k in (1, 2)]
    assert logs == [tmp_path / f"tb/Pendulum-v1/TD3_{k}" for k in (1, 2)]
    monkeypatch.chdir(tmp_path / "logs")
    assert main(["plot", "-f", ".", "--tags", "train/actor_loss", "-o", "a.png"]) == 0
    (_,), faint = lines(figures[-1].axes[0])
    for (x, y), log in zip(faint, logs, strict=True):
        scalar = read_scalars(log)["train/actor_loss"]
        np.testing.assert_allclose([x, y], [scalar.steps, scalar.values])
