"""Evaluation: what is played, what is reported, and that it does not depend on the number of processes."""

import json
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import DummyVecEnv
from tune_helpers import descendants

from sb3_symphony.cli import main
from sb3_symphony.experiment.config import ConfigError
from sb3_symphony.experiment.environment import make_env
from sb3_symphony.experiment.evaluate import evaluate
from sb3_symphony.experiment.robustness import ActionDelay, ObservationNoise
from sb3_symphony.experiment.select import EvaluateOptions

OLD = Path(__file__).parent / "data" / "sb3_2.3"
SHORT = {"max_episode_steps": 60}


class Echo(gym.Env):
    """Observes 0, is rewarded with the action, ends after 6 steps, succeeds if the seed was even."""

    observation_space = gym.spaces.Box(-1, 1, (4,), np.float64)
    action_space = gym.spaces.Box(np.array([-1.0, 0.5], np.float32), np.array([1.0, 2.0], np.float32))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.even, self.actions = seed is not None and seed % 2 == 0, []
        return np.zeros(4), {}

    def step(self, action):
        self.actions.append(np.array(action))
        done = len(self.actions) == 6
        return np.zeros(4), float(action[0]), done, False, {"is_success": self.even} if done else {}


if "Echo-v0" not in gym.registry:
    gym.register("Echo-v0", entry_point=Echo)


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def walker():
    model = SAC("MlpPolicy", "BipedalWalker-v3", buffer_size=10, policy_kwargs={"net_arch": [8]}, seed=0, device="cpu")
    model.save("walker")
    return {"model": "walker.zip", "algo": "sac", "env": "BipedalWalker-v3", "env_kwargs": SHORT}


def test_wrappers_for_training_only_are_refused(walker):
    scale = [("sb3_symphony.common.wrappers.RewardScale", {"scale": 0.1})]
    with pytest.raises(ConfigError, match=r"--env-wrapper: '.*RewardScale' — is for training only"):
        evaluate(EvaluateOptions(**walker, n_episodes=1, env_wrapper=scale))


@pytest.fixture
def pendulum():
    model = SAC("MlpPolicy", "Pendulum-v1", buffer_size=10, policy_kwargs={"net_arch": [8]}, seed=0, device="cpu")
    model.save("pendulum")
    return {"model": "pendulum.zip", "algo": "sac", "env": "Pendulum-v1"}


def test_episodes_are_those_of_sb3_on_these_seeds(pendulum):
    model = SAC.load("pendulum", device="cpu")
    result = evaluate(EvaluateOptions(**pendulum, n_episodes=3, seed=7))
    returns = []
    for seed in (7, 8, 9):
        env = DummyVecEnv([partial(gym.make, "Pendulum-v1")])
        env.seed(seed)
        with pytest.warns(UserWarning, match="Monitor"):
            returns += evaluate_policy(model, env, 1, return_episode_rewards=True)[0]
    assert [episode.reward for episode in result.episodes] == pytest.approx(returns, rel=1e-5)
    assert [episode.length for episode in result.episodes] == [200] * 3


def test_results_do_not_depend_on_the_number_of_processes(walker):
    conditions = dict(walker, n_episodes=5, seed=3, deterministic=False, obs_noise=0.01, action_delay=1)
    one, two = (evaluate(EvaluateOptions(**conditions, n_envs=n_envs)) for n_envs in (1, 2))
    assert one.episodes == two.episodes  # to the last bit
    later = evaluate(EvaluateOptions(**{**conditions, "seed": 5, "n_episodes": 3}))
    assert later.episodes == one.episodes[2:]  # nor on the episodes before


def test_processes_end_with_the_one_that_was_killed(pendulum):
    argv = [f"--{name}={value}" for name, value in pendulum.items()]
    command = [sys.executable, "-m", "sb3_symphony", "evaluate", *argv, "-n", "100000", "--n-envs", "2"]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    deadline = time.monotonic() + 90
    while len(workers := descendants(process.pid)) < 3:  # multiprocessing's tracker of resources is one of them
        assert process.poll() is None and time.monotonic() < deadline
        time.sleep(0.1)
    process.kill()
    process.wait()
    while any(Path(f"/proc/{worker}").exists() for worker in workers):
        assert time.monotonic() < deadline
        time.sleep(0.1)


def test_numbers(pendulum, folder):
    result = evaluate(EvaluateOptions(**pendulum, n_episodes=8, seed=0, json_file="out.json"))
    values = json.loads((folder / "out.json").read_text())
    assert values == result.as_dict()
    returns = [episode.reward for episode in result.episodes]
    assert values["returns"] == returns and values["lengths"] == [200] * 8
    assert values["mean_reward"] == pytest.approx(np.mean(returns))
    assert values["std_reward"] == pytest.approx(np.std(returns))
    assert values["iqm"] == pytest.approx(np.mean(sorted(returns)[2:6]))
    assert values["iqm_ci95"][0] <= values["iqm"] <= values["iqm_ci95"][1]
    assert (values["mean_length"], values["episodes"], values["seed"]) == (200.0, 8, 0)
    assert "success_rate" not in values
    assert f"{np.mean(returns):.2f} ± {np.std(returns):.2f}" in str(result)
    assert [path.name for path in folder.iterdir() if path.name.startswith((".", "out"))] == ["out.json"]


def test_success_rate():
    PPO("MlpPolicy", "Echo-v0", n_steps=8, batch_size=8).save("echo")
    result = evaluate(EvaluateOptions(model="echo", algo="ppo", env="Echo-v0", n_episodes=5, seed=0))
    assert result.as_dict()["success_rate"] == 0.6 and "success 60.0 %" in str(result)


def test_command(pendulum, folder, capsys):
    argv = "evaluate --model pendulum.zip --algo sac --env Pendulum-v1 --n-episodes 2 --seed 1 --json out.json".split()
    assert main(argv) == 0
    out = capsys.readouterr().out
    values = json.loads((folder / "out.json").read_text())
    assert f"{values['mean_reward']:.2f} ± {values['std_reward']:.2f}" in out and f"{values['iqm']:.2f}" in out
    assert "2 episodes on seeds 1…2, deterministic" in out and "length  200.0" in out
    assert main([*argv[:-1], "-", "--stochastic", "--obs-noise", "0.1", "--action-delay", "3"]) == 0
    other = json.loads(capsys.readouterr().out)
    assert (other["deterministic"], other["obs_noise"], other["action_delay"]) == (False, 0.1, 3)
    assert other["returns"] != values["returns"]
    assert main([*argv, "--quiet"]) == 0 and capsys.readouterr().out == ""
    assert json.loads((folder / "out.json").read_text()) == values
    assert main([*argv[:-1], "-", "--quiet"]) == 0 and json.loads(capsys.readouterr().out) == values


def test_old_model_from_the_command_line(capsys):
    flags = f"--algo ppo --model {OLD / 'ppo.zip'} --vecnormalize {OLD / 'ppo_vecnormalize.pkl'} --env Pendulum-v1"
    assert main(["evaluate", *flags.split(), "--n-episodes", "1", "--env-kwargs", "max_episode_steps:20"]) == 0
    assert "length  20.0" in capsys.readouterr().out


def test_default_conditions_are_those_of_published_tables():
    options = EvaluateOptions()
    assert (options.n_episodes, options.seed, options.deterministic) == (100, 20_000, True)
    assert (options.obs_noise, options.action_delay) == (0.0, 0)


def test_observation_noise():
    env = ObservationNoise(gym.make("Echo-v0"), std=0.5)
    first, _ = env.reset(seed=3)
    draws = [env.step(env.action_space.sample())[0] for _ in range(5)]
    again, _ = env.reset(seed=3)
    assert np.array_equal(first, again) and first.dtype == np.float64
    assert len({tuple(draw) for draw in (first, *draws)}) == 6
    third, _ = env.reset()
    assert not np.array_equal(third, first)
    sample = np.concatenate([env.reset()[0] for _ in range(3000)])
    assert np.mean(sample) == pytest.approx(0, abs=0.02) and np.std(sample) == pytest.approx(0.5, rel=0.03)


def test_observation_noise_keeps_the_dtype():
    env = ObservationNoise(gym.make("Pendulum-v1"), std=0.1)
    assert env.reset(seed=0)[0].dtype == np.float32
    assert env.step(np.zeros(1))[0].dtype == np.float32


def test_action_delay():
    env = ActionDelay(gym.make("Echo-v0", disable_env_checker=True), steps=2)
    for _ in range(2):  # nothing is left over from the episode before
        env.reset(seed=0)
        for value in range(1, 7):
            env.step(np.array([value / 10, 1.5], np.float32))
        actions = np.array(env.unwrapped.actions)
        assert actions[:, 0] == pytest.approx([0, 0, 0.1, 0.2, 0.3, 0.4])
        assert actions[:, 1] == pytest.approx([0.5, 0.5, 1.5, 1.5, 1.5, 1.5])  # zero is not allowed, 0.5 is nearest


def test_a_delay_that_nothing_outlasts_takes_no_memory():
    env = ActionDelay(gym.make("Echo-v0", disable_env_checker=True), steps=10**12)
    env.reset(seed=0)
    env.step(np.array([0.7, 1.0], np.float32))
    assert env.unwrapped.actions[0] == pytest.approx([0, 0.5])


def test_no_delay_changes_nothing():
    env = ActionDelay(gym.make("Echo-v0", disable_env_checker=True), steps=0)
    env.reset(seed=0)
    env.step(np.array([0.7, 1.0], np.float32))
    assert env.unwrapped.actions[0] == pytest.approx([0.7, 1.0])


@pytest.mark.parametrize("class_, arguments", [(ObservationNoise, {"std": 0.1}), (ActionDelay, {"steps": 1})])
def test_disturbances_need_real_numbers(class_, arguments):
    with pytest.raises(ConfigError, match=f"{class_.__name__}: expected"):
        make_env("FrozenLake-v1", {}, [partial(class_, **arguments)])


@pytest.mark.parametrize(
    "class_, arguments, error",
    [
        (ObservationNoise, {"std": -0.1}, ValueError),
        (ObservationNoise, {"std": np.nan}, ValueError),
        (ActionDelay, {"steps": -1}, ValueError),
        (ActionDelay, {"steps": 1.5}, TypeError),
    ],
)
def test_bad_disturbances(class_, arguments, error):
    with pytest.raises(error, match="expected"):
        class_(gym.make("Pendulum-v1"), **arguments)


def fails(capsys, *argv):
    try:
        status = main(argv)
    except SystemExit as error:  # from argparse
        status = error.code
    err = capsys.readouterr().err
    lines = [line for line in err.splitlines() if not line.startswith("note: ")]
    assert status == 2 and len(lines) == 1, err
    return lines[0]


@pytest.mark.parametrize(
    "flags, message",
    [
        ("--n-episodes 0", "n_episodes: 0 — expected a number >= 1"),
        ("--n-episodes few", "'few'"),
        ("--seed -1", "seed: -1"),
        ("--n-envs 0", "n_envs: 0"),
        ("--obs-noise -0.5", "obs_noise: -0.5"),
        ("--obs-noise nan", "obs_noise: nan"),
        ("--action-delay -2", "action_delay: -2"),
        ("--deterministic --stochastic", "not allowed with"),
        ("--exp-id -2", "exp_id: -2"),
        ("--exp-id 1", "--exp-id: 1 — expected --model or --exp-id, not both"),
        ("--env-kwargs g", "--env-kwargs: 'g' — expected key:value"),
        ("--vecnormalize missing.pkl", "--vecnormalize: 'missing.pkl' — no such file"),
        ("--vecnormalize pendulum.zip", "pendulum.zip: not statistics of VecNormalize, or damaged"),
        ("--env CartPole-v1", "does not fit CartPole-v1: observation space of the model Box([-1. -1. -8.]"),
        ("--env Pendulum-v9", "unknown environment 'Pendulum-v9'"),
        ("--algo td3", "not a model of td3"),
        ("--algo scc", "unknown algorithm 'scc'"),
        ("--model other.zip", "other.zip: no such file"),
        ("--device quantum", "--device: 'quantum' is not there"),
        ("--json no/folder.json", "--json: 'no/folder.json' cannot be written — there is no folder no"),
        ("--json .", "--json: '.' cannot be written — it is a folder"),
        ("--n-episode 3", "did you mean '--n-episodes'?"),
    ],
)
def test_mistakes(pendulum, folder, capsys, flags, message):
    before = {path: path.read_bytes() for path in folder.iterdir()}
    given = {flag: value for flag, value in (("--model", "pendulum.zip"), ("--algo", "sac"), ("--env", "Pendulum-v1"))}
    argv = [part for flag, value in given.items() if flag not in flags.split() for part in (flag, value)]
    assert message in fails(capsys, "evaluate", *argv, *flags.split())
    assert {path: path.read_bytes() for path in folder.iterdir()} == before


def test_a_disk_that_fills_up_leaves_the_old_file(pendulum, folder, monkeypatch):
    (folder / "out.json").write_text("mine")

    def full(path, content):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("sb3_symphony.experiment.output.write_atomically", full)
    with pytest.raises(ConfigError, match=r"--json: 'out\.json' cannot be written — No space left on device"):
        evaluate(EvaluateOptions(**pendulum, n_episodes=1, json_file="out.json"))
    assert (folder / "out.json").read_text() == "mine"
