"""Films: what is in them, and how long they are."""

import math
import subprocess
import sys
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from PIL import Image
from stable_baselines3 import SAC, TD3

from sb3_symphony.cli import main
from sb3_symphony.experiment.config import run_settings
from sb3_symphony.experiment.select import Selection
from sb3_symphony.experiment.video import _labels, _Moment, labelled, sampled, side_by_side, write_film

read_frames = pytest.importorskip("imageio_ffmpeg").read_frames


class Counter(gym.Env):
    """Its picture has the grey of the number of steps; episode of 20 steps, 10 a second, reward 1 each."""

    observation_space = gym.spaces.Box(-1.0, 1.0, (1,))
    action_space = gym.spaces.Box(-1.0, 1.0, (1,))
    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012

    def __init__(self, render_mode=None, length=20):
        self.render_mode, self.length = render_mode, length

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.n_steps = 0
        return np.zeros(1, dtype=np.float32), {}

    def step(self, action):
        self.n_steps += 1
        return np.zeros(1, dtype=np.float32), 1.0, self.n_steps == self.length, False, {}

    def render(self):
        return np.full((60, 100, 3), 10 * self.n_steps, dtype=np.uint8)


class Blind(Counter):
    metadata = {"render_modes": [], "render_fps": 10}  # noqa: RUF012


for name, class_ in (("Counter-v0", Counter), ("Blind-v0", Blind)):
    if name not in gym.registry:
        gym.register(name, entry_point=class_, max_episode_steps=50)


@pytest.fixture
def model(tmp_path, monkeypatch):
    """A model for both environments, in an empty working folder."""
    monkeypatch.chdir(tmp_path)
    TD3("MlpPolicy", "Counter-v0", buffer_size=10, policy_kwargs={"net_arch": [4]}).save("agent")
    return tmp_path / "agent.zip"


def film_of(path):
    """Pictures and pictures per second of an MP4."""
    reader = read_frames(str(path))
    facts = next(reader)
    width, height = facts["size"]
    return np.stack([np.frombuffer(frame, np.uint8).reshape(height, width, 3) for frame in reader]), facts["fps"]


def greys(film, left=0, width=100):
    """Mean grey of the lower half of an agent's pictures, in steps of the environment."""
    return film[:, film.shape[1] // 2 :, left : left + width].mean(axis=(1, 2, 3)) / 10


# ---------------------------------------------------------------- pieces


@pytest.mark.parametrize("steps_per_second, fps, length", [(50, 50, 7), (50, 25, 7), (10, 30, 4), (125, 50, 20), (30, 7, 31)])
def test_time_passes_as_in_the_simulated_world(steps_per_second, fps, length):
    moments = [_Moment(np.empty(0), n, float(n), n == length) for n in range(length + 1)]
    shown = [moment.n_steps for moment in sampled(moments, steps_per_second, fps)]
    n_pictures = math.ceil(length * fps / steps_per_second) + 1
    assert shown == [min(math.floor(k * steps_per_second / fps), length) for k in range(n_pictures)]


def test_a_line_of_text_above_the_picture():
    picture = np.full((40, 200, 3), 128, dtype=np.uint8)
    result = labelled(picture, "left", "right", 200)
    assert result.shape == (40 + 22, 200, 3) and (result[22:] == 128).all()  # nothing of the picture is hidden
    bar = result[:22].min(axis=(0, 2))
    assert bar[:40].min() < 100 and bar[-40:].min() < 140 and bar[60:140].min() == 255
    assert labelled(picture, "", "", 100).shape == (20 + 22, 100, 3)


def test_side_by_side():
    tiles = [np.full((10, 8, 3), k, dtype=np.uint8) for k in range(4)]
    three, four = side_by_side(tiles[:3]), side_by_side(tiles)
    assert three.shape == (10, 3 * 8 + 2 * 4, 3) and four.shape == (24, 20, 3)
    assert [four[0, 0, 0], four[0, -1, 0], four[-1, 0, 0], four[-1, -1, 0]] == [0, 1, 2, 3]
    assert side_by_side([tiles[0], tiles[1][:5]])[9, 15, 0] == 255


def test_a_film_that_fails_leaves_the_old_one(tmp_path):
    for name in ("a.mp4", "a.gif"):
        path = tmp_path / name
        path.write_text("old")

        def broken():
            yield np.zeros((16, 16, 3), dtype=np.uint8)
            raise RuntimeError("no more")

        with pytest.raises(RuntimeError):
            write_film(broken(), 10, path)
        assert path.read_text() == "old"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.gif", "a.mp4"]


# ---------------------------------------------------------------- films


def test_a_film_that_ffmpeg_cannot_finish(tmp_path, monkeypatch):
    """Neither does half a film replace the old one, nor goes it unnoticed."""
    (tmp_path / "film.mp4").write_bytes(b"old")
    picture = np.zeros((64, 64, 3), dtype=np.uint8)
    rng = np.random.default_rng(0)
    noise = [rng.integers(256, size=(256, 256, 3), dtype=np.uint8) for _ in range(10)]
    assert write_film([picture] * 3, 10, tmp_path / "other.mp4") == 3

    class Limited(subprocess.Popen):
        def __init__(self, command, **kwargs):
            full = "No space left on device"
            script = f"import sys; sys.stdin.buffer.read(100000); sys.exit('x: {full}\\nlast words')"
            super().__init__([sys.executable, "-c", script], **kwargs)

    monkeypatch.setattr(subprocess, "Popen", Limited)
    for pictures in (noise, [picture]):  # it ends while pictures come, and after the last one
        with pytest.raises(OSError, match=r"^No space left on device$"):
            write_film(pictures, 10, tmp_path / "film.mp4")
        assert (tmp_path / "film.mp4").read_bytes() == b"old"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["film.mp4", "other.mp4"]


def test_mp4(model, capsys):
    assert main(["video", "--model", "agent", "--algo", "td3", "--env", "Counter-v0", "--no-progress"]) == 0
    assert capsys.readouterr().out == "agent.mp4\n"
    film, fps = film_of("agent.mp4")
    assert fps == 10 and len(film) == 21 + 10  # before the first step, after each, and a second at the end
    assert film.shape[1:] == (82, 100, 3)
    np.testing.assert_allclose(greys(film), [*range(21), *[20] * 10], atol=0.2)


def test_episodes_steps_rate_and_size(model):
    argv = "video agent.zip --algo td3 --env Counter-v0 --n-episodes 2 -n 5 --fps 20 --width 201 -o a.mp4 --no-progress"
    assert main(argv.split()) == 0
    film, fps = film_of("a.mp4")
    assert fps == 20 and film.shape[2] == 202  # H.264 wants an even number
    once = [0, 0, 1, 1, 2, 2, 3, 3, 4, 4, 5] + [5] * 20
    np.testing.assert_allclose(greys(film, width=180), once * 2, atol=0.4)


def test_gif(model):
    assert main("video agent.zip --algo td3 --env Counter-v0 -n 4 -o a.gif --no-progress".split()) == 0
    with Image.open("a.gif") as film:
        total = 0
        for index in range(film.n_frames):
            film.seek(index)
            total += film.info["duration"]
            assert np.asarray(film.convert("RGB"))[60, 50, 0] == 10 * index
        assert film.n_frames == 5 and film.info["loop"] == 0  # equal pictures are one, shown longer
    assert total == 1500


@pytest.mark.parametrize("fps, durations", [(30, [30, 40, 30] * 2), (50, [20] * 6), (12.5, [80] * 6)])
def test_gifs_run_in_real_time(tmp_path, fps, durations):
    pictures = [np.full((20, 20, 3), 40 * k, dtype=np.uint8) for k in range(6)]
    assert write_film(pictures, fps, tmp_path / "a.gif") == 6
    with Image.open(tmp_path / "a.gif") as film:
        told = [(film.seek(index), film.info["duration"])[1] for index in range(film.n_frames)]
    assert told == durations


def test_grid(model):
    argv = [
        "video",
        "agent.zip",
        "agent.zip",
        "--algo",
        "td3",
        "--env",
        "Counter-v0",
        "--grid",
        "--no-progress",
        "--width",
        "100",
    ]
    assert main(argv) == 0
    film, _ = film_of("Counter-v0_grid.mp4")
    assert film.shape[2] == 204
    np.testing.assert_allclose(greys(film), greys(film, left=104), atol=0.2)


def test_names_of_agents():
    def names(*models, run=True):
        settings = run_settings({"n_timesteps": 1})
        paths = [Path(model) for model in models]
        selections = [Selection("redq", path, "A-v0", settings, None, path.parent if run else None) for path in paths]
        return _labels(selections)

    assert names("x/A-v0_1/best_model.zip") == ["redq best"]
    assert names("x/A-v0_1/best_model.zip", "x/A-v0_1/rl_model_4000_steps.zip") == ["redq best", "redq 4k steps"]
    assert names("x/A-v0_1/A-v0.zip", "x/A-v0_2/A-v0.zip") == ["redq (A-v0_1)", "redq (A-v0_2)"]
    assert names("x/redq/A-v0_1/A-v0.zip", "y/redq/A-v0_1/A-v0.zip") == ["redq (x/redq/A-v0_1)", "redq (y/redq/A-v0_1)"]
    assert names("a.zip", "b.zip", run=False) == ["redq (a)", "redq (b)"]
    assert names("a.zip", "a.zip", run=False) == ["redq", "redq"]


def test_who_has_finished_waits(model, monkeypatch):
    from sb3_symphony.experiment import video

    lengths = iter((3, 6))
    original = video.open_agent

    def of_different_length(options, **kwargs):
        return original(options.model_copy(update={"env_kwargs": {"length": next(lengths)}}), **kwargs)

    monkeypatch.setattr(video, "open_agent", of_different_length)
    argv = "video agent agent --algo td3 --env Counter-v0 --grid -o a.mp4 --no-progress --width 100 -l short long"
    assert main(argv.split()) == 0
    film, _ = film_of("a.mp4")
    np.testing.assert_allclose(greys(film), [0, 1, 2, 3, 3, 3, 3] + [3] * 10, atol=0.2)
    np.testing.assert_allclose(greys(film, left=104), [0, 1, 2, 3, 4, 5, 6] + [6] * 10, atol=0.2)


def test_a_run_keeps_its_films(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    argv = "train --algo td3 --env Pendulum-v1 -n 60 --eval-freq 0 --no-progress --verbose 0 --seed 0 --save-freq 50"
    assert main([*argv.split(), "-params", "buffer_size:100"]) == 0
    capsys.readouterr()
    run = "logs/td3/Pendulum-v1_1"
    assert main(["video", run, run, "-n", "10", "--no-progress"]) == 2  # two agents in one film
    assert not (tmp_path / run / "videos").exists() and "would be the film of two agents" in capsys.readouterr().err
    assert main("video --algo td3 --env Pendulum-v1 --load-checkpoint 50 -n 10 --no-progress".split()) == 0
    out = capsys.readouterr().out.strip()
    assert out == "logs/td3/Pendulum-v1_1/videos/rl_model_50_steps.mp4"
    assert len(film_of(out)[0]) == 11 + 30


def test_mujoco(tmp_path, monkeypatch):
    pytest.importorskip("mujoco")
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    TD3("MlpPolicy", "Hopper-v5", buffer_size=10, policy_kwargs={"net_arch": [4]}).save("agent")
    try:
        status = main("video agent --algo td3 --env Hopper-v5 -n 5 -o a.gif --no-progress".split())
    finally:
        import os

        assert "MUJOCO_GL" not in os.environ
    if status == 2:
        pytest.skip("no EGL on this machine")
    with Image.open("a.gif") as film:
        assert np.asarray(film.convert("RGB")).std() > 20


# ---------------------------------------------------------------- mistakes


@pytest.mark.parametrize(
    "arguments, message",
    [
        ("-o a.avi", "expected a file name that ends with .mp4 or .gif"),
        ("-o nowhere/a.mp4", "there is no folder nowhere"),
        ("--fps 0", "fps: 0"),
        ("--fps 60 -o a.gif", "--fps: 60 — expected at most 50 for a.gif, or an .mp4"),
        ("--width 10", "width: 10"),
        ("-n 0", "n_timesteps: 0"),
        ("--n-episodes 0", "n_episodes: 0"),
        ("--labels a b", "--labels: 2 given — expected 1"),
        ("agent.zip -o a.mp4", "2 agents give 2 files, see --grid"),
        ("./agent", "agent.mp4' would be the film of two agents"),
        ("nothing.zip", "nothing.zip: no such file"),
        ("--model agent.zip", "expected either --model or agent.zip, not both"),
        ("--env Blind-v0", "Blind-v0: draws no pictures"),
        ("--grd", "did you mean '--grid'?"),
    ],
)
def test_mistakes(model, capsys, arguments, message):
    before = sorted(model.parent.rglob("*"))
    env = [] if "--env" in arguments else ["--env", "Counter-v0"]
    try:
        status = main(["video", "agent.zip", *arguments.split(), "--algo", "td3", *env, "--no-progress"])
    except SystemExit as error:
        status = error.code
    errors = capsys.readouterr().err.splitlines()
    assert status == 2 and message in errors[-1]
    assert len([line for line in errors if not line.startswith("note:")]) == 1
    assert sorted(model.parent.rglob("*")) == before


@pytest.mark.parametrize("found", ["/nowhere/ffmpeg", RuntimeError("No ffmpeg exe could be found.")], ids=str)
def test_mp4_without_ffmpeg(model, capsys, monkeypatch, found):
    def get_ffmpeg_exe():
        if isinstance(found, str):
            return found
        raise found

    monkeypatch.setattr("imageio_ffmpeg.get_ffmpeg_exe", get_ffmpeg_exe)
    monkeypatch.setenv("PATH", "")
    before = sorted(model.parent.rglob("*"))
    assert main("video agent --algo td3 --env Counter-v0 -n 2 --no-progress -o a.mp4".split()) == 2
    assert "a.mp4: MP4 needs ffmpeg, and there is no '" in capsys.readouterr().err
    assert sorted(model.parent.rglob("*")) == before


def test_mp4_without_its_library(model, capsys, monkeypatch):
    monkeypatch.setattr("sb3_symphony.experiment.video.find_spec", lambda name: None)
    argv = "video agent --algo td3 --env Counter-v0 -n 2 --no-progress -o".split()
    assert main([*argv, "a.mp4"]) == 2
    assert 'pip install "sb3-symphony[video]"' in capsys.readouterr().err
    assert main([*argv, "a.gif"]) == 0


def test_agents_of_a_film_draw_no_random_numbers_from_each_other(tmp_path, monkeypatch):
    """Each episode is the one that its agent plays alone on that seed."""
    monkeypatch.chdir(tmp_path)
    for seed in (0, 1):
        SAC("MlpPolicy", "Counter-v0", buffer_size=10, policy_kwargs={"net_arch": [4]}, seed=seed).save(f"agent{seed}")
    moves = []
    step = Counter.step
    monkeypatch.setattr(Counter, "step", lambda self, action: moves.append(action.item()) or step(self, action))
    for agents in ("agent0", "agent1", "agent0 agent1 --grid"):
        argv = f"video {agents} --algo sac --env Counter-v0 --stochastic -o a.gif --no-progress --width 100"
        assert main(argv.split()) == 0
    assert len(moves) == 80 and moves[:40] == moves[40::2] + moves[41::2]
