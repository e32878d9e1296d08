"""The curve of a run."""

import numpy as np
import yaml
from matplotlib import image

from sb3_symphony.analysis.plots import plot_training, read_monitors, running_mean


def write_monitor(path, start, rows):
    lines = [f'#{{"t_start": {start}, "env_id": "X"}}', "r,l,t", *(f"{r},{n},{t}" for r, n, t in rows)]
    path.write_text("\n".join(lines) + "\n")


def test_parallel_environments_are_merged_by_time(tmp_path):
    write_monitor(tmp_path / "0.monitor.csv", 100.0, [(1.0, 10, 1.0), (3.0, 20, 5.0)])
    write_monitor(tmp_path / "1.monitor.csv", 101.0, [(2.0, 15, 1.5)])
    steps, returns = read_monitors(tmp_path)
    np.testing.assert_array_equal(steps, [10, 25, 45])
    np.testing.assert_array_equal(returns, [1.0, 2.0, 3.0])


def test_a_torn_last_line_is_left_out(tmp_path):
    write_monitor(tmp_path / "0.monitor.csv", 0.0, [(1.0, 10, 1.0)])
    with (tmp_path / "0.monitor.csv").open("a") as file:
        file.write("-12.3,")
    assert len(read_monitors(tmp_path)[0]) == 1


def test_running_mean():
    np.testing.assert_allclose(running_mean(np.array([1.0, 2.0, 3.0, 4.0]), 2), [1.0, 1.5, 2.5, 3.5])


def test_figure(tmp_path):
    write_monitor(tmp_path / "0.monitor.csv", 0.0, [(float(k), 100, float(k)) for k in range(30)])
    np.savez(tmp_path / "evaluations.npz", timesteps=[1000, 2000], results=[[1.0, 2.0], [3.0, 4.0]], ep_lengths=[[1, 1]] * 2)
    (tmp_path / "X").mkdir()
    (tmp_path / "X" / "args.yml").write_text(yaml.safe_dump({"algo": "sac", "env": "X", "seed": 3}))
    path = plot_training(tmp_path)
    assert path == tmp_path / "training.png"
    pixels = image.imread(path)
    assert pixels.shape[1] >= 1000  # sharp in print
    assert pixels[..., :3].std() > 0.05  # something is drawn
    assert plot_training(tmp_path, tmp_path / "curve.pdf").read_bytes().startswith(b"%PDF")


def test_a_run_without_episodes_has_a_figure_too(tmp_path):
    write_monitor(tmp_path / "0.monitor.csv", 0.0, [])
    assert plot_training(tmp_path).exists()
