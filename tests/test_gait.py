"""Gaits: numbers of made-up contacts, what the sensors record, and the figure."""

import json
import math
from itertools import pairwise

import gymnasium as gym
import numpy as np
import pytest
from matplotlib.offsetbox import AnnotationBbox
from stable_baselines3 import TD3

from sb3_symphony.analysis import gait as analysis
from sb3_symphony.analysis.gait import Recording, gait_numbers, plot_gait, steady_contact, strikes
from sb3_symphony.analysis.style import save
from sb3_symphony.cli import main
from sb3_symphony.experiment.agent import open_agent
from sb3_symphony.experiment.select import SelectOptions

RATE = 50.0


def recording(left, right, hip=None, knee=None, speed=1.0, pictures=None):
    contact = np.stack([left, right], axis=1).astype(bool)
    n = len(contact)
    flat = np.zeros((n, 2))
    position = 5.0 + speed * np.arange(n) / RATE
    return Recording(
        "a", RATE, 2.0, contact, flat if hip is None else hip, flat if knee is None else knee, position, pictures or {}
    )


def rhythm(n, period, stance, first):
    """Contact of a foot that strikes at ``first`` and every ``period`` steps, for ``stance`` steps each."""
    return (np.arange(n) - first) % period < stance


# ---------------------------------------------------------------- numbers


def test_a_walk():
    """Strides of 1 s with 0.6 s stance, the right foot half a stride later."""
    numbers = gait_numbers(recording(rhythm(500, 50, 30, 10), rhythm(500, 50, 30, 35), speed=1.5))
    assert (numbers.left.strides, numbers.right.strides) == (9, 9)
    assert numbers.seconds == 10.0 and numbers.cadence == pytest.approx(120.0)
    assert numbers.left.stride_time == pytest.approx(1.0) and numbers.left.stance_time == pytest.approx(0.6)
    assert (numbers.left.duty_factor, numbers.right.duty_factor, numbers.duty_factor) == (0.6, 0.6, 0.6)
    assert numbers.double_support == pytest.approx(0.2) and numbers.flight == 0.0  # 2·0.6 - 1
    assert numbers.phase == pytest.approx(0.5)
    assert numbers.speed == pytest.approx(1.5) and numbers.stride_length == pytest.approx(1.5)
    assert numbers.symmetry["stance_time"] == 0.0


def test_a_limping_run():
    """Strides of 0.8 s, the left stance 0.28 s, the right 0.12 s and 0.2 s later."""
    left, right = rhythm(400, 40, 14, 0), rhythm(400, 40, 6, 10)
    hip = np.stack([30 * np.sin(np.arange(400)), 10 * np.sin(np.arange(400))], axis=1)
    numbers = gait_numbers(recording(left, right, hip=hip, knee=np.abs(hip)))
    assert numbers.left.duty_factor == pytest.approx(0.35) and numbers.right.duty_factor == pytest.approx(0.15)
    assert numbers.duty_factor == pytest.approx(0.25)
    assert numbers.phase == pytest.approx(0.25)
    assert numbers.symmetry["stance_time"] == pytest.approx(2 * (0.28 - 0.12) / 0.4 * 100)
    assert numbers.left.hip_range == pytest.approx(60, rel=1e-3) and numbers.right.hip_range == pytest.approx(20, rel=1e-3)
    assert numbers.symmetry["hip_range"] == pytest.approx(100.0) and numbers.symmetry["knee_range"] == pytest.approx(100.0)
    # Equal to counting step by step
    assert numbers.double_support == np.mean([a and b for a, b in zip(left, right, strict=True)])
    assert numbers.flight == np.mean([not a and not b for a, b in zip(left, right, strict=True)])


def test_feet_together_have_phase_zero():
    left = rhythm(400, 40, 20, 5)
    right = left.copy()
    right[5::40] = False  # strikes one step later in one stride, one earlier in the next: the mean is on the circle
    right[44::80] = True
    phase = gait_numbers(recording(left, right)).phase
    assert min(phase, 1 - phase) < 0.05


def test_bounces_and_scuffs():
    contact = rhythm(300, 60, 30, 0)
    bouncing = contact.copy()
    bouncing[70:74] = False  # 0.08 s
    bouncing[100:102] = True  # 0.04 s
    bouncing[[130, 132]] = False
    np.testing.assert_array_equal(steady_contact(bouncing, RATE), contact)
    np.testing.assert_array_equal(strikes(steady_contact(bouncing, RATE)), [60, 120, 180, 240])
    long_enough = contact.copy()
    long_enough[70:75] = False
    long_enough[100:103] = True
    np.testing.assert_array_equal(steady_contact(long_enough, RATE), long_enough)


def test_a_leg_that_never_strikes():
    numbers = gait_numbers(recording(np.ones(100), np.zeros(100)))
    assert numbers.cadence == 0.0 and numbers.left.strides == 0
    for value in (numbers.duty_factor, numbers.phase, numbers.stride_length, numbers.symmetry["stance_time"]):
        assert math.isnan(value)
    assert math.isnan(numbers.symmetry["hip_range"])  # legs that do not move at all


def test_numbers_of_random_contacts_by_hand():
    rng = np.random.default_rng(0)
    for _ in range(20):
        left, right = (np.repeat(rng.random(60) < 0.5, rng.integers(5, 9, 60)) for _ in range(2))
        n = min(len(left), len(right))
        left, right = left[:n], right[:n]
        numbers = gait_numbers(recording(left, right))
        at = [k for k in range(1, n) if left[k] and not left[k - 1]]
        stances = [sum(left[a:b]) / RATE for a, b in pairwise(at)]
        strides = [(b - a) / RATE for a, b in pairwise(at)]
        assert numbers.left.strides == len(strides)
        assert numbers.left.stance_time == pytest.approx(np.mean(stances))
        assert numbers.left.duty_factor == pytest.approx(sum(stances) / sum(strides))


# ---------------------------------------------------------------- figure


def test_figure(tmp_path, monkeypatch):
    figures = []
    monkeypatch.setattr(analysis, "save", lambda figure, output: figures.append(figure) or save(figure, output))
    left, right = rhythm(100, 50, 30, 10), rhythm(100, 50, 30, 35)
    rng = np.random.default_rng(0)
    hip, knee = rng.normal(size=(100, 2)), rng.normal(size=(100, 2))
    pictures = {k: np.full((20, 20, 3), 99, dtype=np.uint8) for k in (10, 30, 50)}
    one = recording(left, right, hip, knee, pictures=pictures)
    path = plot_gait([one, one], [gait_numbers(one)] * 2, tmp_path / "gait.svg")
    assert path.read_bytes().startswith(b"<?xml")
    axes = np.array(figures[0].axes).reshape(4, 2)
    for strip, contact, *angles in axes.T:
        assert len([artist for artist in strip.artists if isinstance(artist, AnnotationBbox)]) == 3
        for collection, foot in zip(contact.collections, (left, right), strict=True):
            bars = sorted((box.vertices[:, 0].min(), box.vertices[:, 0].max()) for box in collection.get_paths())
            edges = np.flatnonzero(np.diff(np.concatenate([[0], foot.astype(int), [0]]))).reshape(-1, 2)
            np.testing.assert_allclose(bars, 2.0 + edges / RATE)
        for panel, values in zip(angles, (hip, knee), strict=True):
            for line, leg in zip(panel.lines, (0, 1), strict=True):
                np.testing.assert_allclose(line.get_xydata().T, [2.0 + np.arange(100) / RATE, values[:, leg]])
    assert axes[0, 0].get_title("left").startswith("a\n120 steps/min, duty factor 0.60, phase 0.50, 1.0 m/s")
    assert [axis.get_ylabel() for axis in axes[1:, 0]] == ["ground\ncontact", "hip flexion (°)", "knee flexion (°)"]
    assert axes[3, 0].get_xlabel() == "time in the episode (s)"


# ---------------------------------------------------------------- agents


@pytest.fixture
def model(tmp_path, monkeypatch):
    """An untrained agent, which soon falls, in an empty working folder."""
    monkeypatch.chdir(tmp_path)
    TD3("MlpPolicy", "BipedalWalker-v3", buffer_size=10, seed=0, policy_kwargs={"net_arch": [4]}).save("agent")
    return tmp_path / "agent.zip"


WALK = "--algo td3 --env BipedalWalker-v3 --no-progress --skip 0 --window 0.5 --n-frames 3 -n 60".split()


def test_sensors_tell_what_the_observation_tells(model, monkeypatch):
    seen = []
    monkeypatch.setattr("sb3_symphony.experiment.gait.plot_gait", lambda recordings, numbers, output: seen.extend(recordings))
    recorded = []
    original = analysis.gait_numbers
    monkeypatch.setattr("sb3_symphony.experiment.gait.gait_numbers", lambda whole: recorded.append(whole) or original(whole))
    assert main(["gait", "agent", "--seed", "4", *WALK]) == 0
    options = SelectOptions(model="agent", algo="td3", env="BipedalWalker-v3")
    with open_agent(options) as agent:
        after = np.array([step.observation for step in agent.episode(4)])[1:]  # what each step led to
    whole = recorded[0]
    n = min(len(after), len(whole.contact))
    assert n >= 30
    np.testing.assert_array_equal(whole.contact[:n], after[:n, [8, 13]] > 0.5)
    np.testing.assert_allclose(whole.hip[:n], np.degrees(after[:n, [4, 9]]), atol=1e-4)
    np.testing.assert_allclose(whole.knee[:n], -np.degrees(after[:n, [6, 11]] - 1.0), atol=1e-4)
    assert whole.times[0] == pytest.approx(0.02)
    shown = seen[0]
    np.testing.assert_array_equal(shown.hip, whole.hip[:25])
    assert sorted(shown.pictures) == [4, 12, 21] and shown.pictures[4].shape == (150, 150, 3)
    hull = np.all(shown.pictures[4] == (127, 51, 229), axis=2)  # its colour
    assert hull[35:65, 40:110].sum() > 500 and hull[100:].sum() == 0  # cut out around it


def test_command(model, capsys):
    assert main(["gait", "agent", "agent", "-l", "one", "two", "--json", "out.json", *WALK]) == 0
    out = capsys.readouterr().out.splitlines()
    assert out[0].split() == ["one", "two"] and out[-1] == "gait.png"
    assert any(line.startswith("cadence (steps/min)") for line in out)
    assert (model.parent / "gait.png").read_bytes().startswith(b"\x89PNG")
    one, two = json.loads((model.parent / "out.json").read_text())
    assert one.pop("label") == "one" and two.pop("label") == "two" and one == two
    assert {"cadence", "duty_factor", "phase", "symmetry", "left", "right", "reward", "length", "seed"} <= one.keys()
    assert one["left"].keys() >= {"strides", "stance_time", "hip_range"}
    assert main(["gait", "agent", "--json", "-", "-o", "a.pdf", *WALK]) == 0
    assert json.loads(capsys.readouterr().out)[0]["reward"] == one["reward"]


@pytest.mark.parametrize(("arguments", "skipped"), [(":{skip: 2}", 2), ("", 4)])  # 4: the wrapper's default
def test_an_agent_that_acts_every_few_steps(model, monkeypatch, arguments, skipped):
    recorded = []
    monkeypatch.setattr("sb3_symphony.experiment.gait.plot_gait", lambda recordings, *args: recorded.extend(recordings))
    skip = f"stable_baselines3.common.atari_wrappers.MaxAndSkipEnv{arguments}"
    assert main(["gait", "agent", "--env-wrapper", skip, *WALK]) == 0
    assert recorded[0].steps_per_second == 50 / skipped and recorded[0].times[0] == pytest.approx(0.02 * skipped)


def test_no_pictures(model):
    assert main(["gait", "agent", *WALK, "--n-frames", "0"]) == 0


@pytest.mark.parametrize(
    "arguments, message",
    [
        ("--skip 30", "--skip: 30 s — td3 walked for 1.2 s only on seed 0, as -n 60 wants"),
        ("-o gait.mp4", "expected a file name that ends with .png or .svg or .pdf"),
        ("--json nowhere/x.json", "there is no folder nowhere"),
        ("--window 0", "window: 0.0"),
        ("--skip nan", "skip: nan"),
        ("--env Pendulum-v1", "Pendulum-v1"),
    ],
)
def test_mistakes(model, capsys, arguments, message):
    assert main(["gait", "agent", *WALK, *arguments.split()]) == 2
    errors = [line for line in capsys.readouterr().err.splitlines() if not line.startswith("note:")]
    assert len(errors) == 1 and message in errors[0]
    assert [path.name for path in model.parent.iterdir()] == ["agent.zip"]


def test_another_environment(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    TD3("MlpPolicy", gym.make("Pendulum-v1"), buffer_size=10, policy_kwargs={"net_arch": [4]}).save("agent")
    assert main("gait agent --algo td3 --env Pendulum-v1 --no-progress".split()) == 2
    assert "Pendulum-v1: has no legs with sensors — expected BipedalWalker-v3" in capsys.readouterr().err
