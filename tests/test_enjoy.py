"""Watching an agent, without a screen."""

import errno
import os
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.monitor import ResultsWriter
from stable_baselines3.common.vec_env import VecNormalize

from sb3_symphony.cli import main
from sb3_symphony.experiment.config import ConfigError
from sb3_symphony.experiment.enjoy import enjoy
from sb3_symphony.experiment.evaluate import evaluate
from sb3_symphony.experiment.select import EnjoyOptions, EvaluateOptions


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for variable in ("DISPLAY", "WAYLAND_DISPLAY", "SDL_VIDEODRIVER"):
        monkeypatch.delenv(variable, raising=False)
    return tmp_path


@pytest.fixture
def agent():
    SAC("MlpPolicy", "Pendulum-v1", buffer_size=10, policy_kwargs={"net_arch": [8]}, seed=0, device="cpu").save("sac")
    return {"model": "sac.zip", "algo": "sac", "env": "Pendulum-v1"}


def test_episodes(agent, capsys):
    episodes = enjoy(EnjoyOptions(**agent, render=False, n_timesteps=450, seed=4))
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "sac on Pendulum-v1: sac.zip"
    assert lines[1] == f"episode 1: return {episodes[0].reward:.2f}, length 200"
    mean, std = np.mean([e.reward for e in episodes]), np.std([e.reward for e in episodes])
    assert len(episodes) == 2 and lines[3] == f"2 episodes: return {mean:.2f} ± {std:.2f}, length 200.0"


def test_first_episode_is_that_of_evaluate(agent):
    for deterministic in (True, False):
        (first,) = enjoy(EnjoyOptions(**agent, render=False, n_timesteps=200, seed=4, deterministic=deterministic))
        (same,) = evaluate(EvaluateOptions(**agent, n_episodes=1, seed=4, deterministic=deterministic)).episodes
        assert first.reward == same.reward


def test_several_environments_and_normalised_rewards(folder, capsys):
    env = VecNormalize(make_vec_env("Pendulum-v1", seed=0))
    PPO("MlpPolicy", env, n_steps=32, batch_size=32, seed=0).learn(64).save("ppo")
    env.save("ppo.pkl")
    agent = {"model": "ppo", "algo": "ppo", "env": "Pendulum-v1", "vecnormalize": "ppo.pkl"}
    episodes = enjoy(EnjoyOptions(**agent, render=False, n_timesteps=400, n_envs=3, norm_reward=True, reward_log="rewards"))
    assert len(episodes) == 6
    scale = np.sqrt(env.ret_rms.var + env.epsilon)
    for episode in episodes:
        assert abs(episode.normalized) <= abs(episode.reward / scale) + 1e-3  # equal but for clipping
        assert abs(episode.normalized) == pytest.approx(abs(episode.reward / scale), rel=0.3)
    assert f"(normalised {episodes[0].normalized:.2f})" in capsys.readouterr().out
    logged = [np.loadtxt(path, delimiter=",", skiprows=2)[:, 0] for path in sorted((folder / "rewards").iterdir())]
    assert sorted(np.concatenate(logged)) == pytest.approx(sorted(episode.reward for episode in episodes))
    with pytest.raises(ConfigError, match=r"--reward-log: 'rewards' has a 0\.monitor\.csv already, which is left alone"):
        enjoy(EnjoyOptions(**agent, render=False, reward_log="rewards"))


def test_full_disk_names_the_reward_log(agent, monkeypatch):
    def write_row(self, values):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(ResultsWriter, "write_row", write_row)
    with pytest.raises(ConfigError, match="'rewards' cannot be written: No space left"):
        enjoy(EnjoyOptions(**agent, render=False, n_timesteps=200, reward_log="rewards"))


def test_window(agent, monkeypatch):
    monkeypatch.setattr("sb3_symphony.experiment.enjoy.sys.platform", "linux")
    with pytest.raises(ConfigError, match="no display for a window here — expected --no-render"):
        enjoy(EnjoyOptions(**agent))
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    seen = []
    render = gym.envs.classic_control.PendulumEnv.render
    monkeypatch.setattr(
        gym.envs.classic_control.PendulumEnv, "render", lambda self: seen.append(self.render_mode) or render(self)
    )
    monkeypatch.setitem(gym.envs.classic_control.PendulumEnv.metadata, "render_fps", 10_000)
    enjoy(EnjoyOptions(**agent, n_timesteps=5))
    assert seen and set(seen) == {"human"}


def test_ctrl_c_ends_watching(agent, monkeypatch, capsys):
    predict, calls = SAC.predict, []

    def interrupted(self, *args, **kwargs):
        calls.append(1)
        if len(calls) == 300:
            raise KeyboardInterrupt
        return predict(self, *args, **kwargs)

    monkeypatch.setattr(SAC, "predict", interrupted)
    assert main(["enjoy", "--model", "sac.zip", "--algo", "sac", "--env", "Pendulum-v1", "--no-render"]) == 0
    assert capsys.readouterr().out.splitlines()[-1].startswith("1 episode: return -")


def test_flags_of_rl_zoo(agent, capsys):
    flags = (
        "-f logs -n 20 --n-envs 2 --exp-id 0 --stochastic --no-render --reward-log out --seed 1 --num-threads 1 --device cpu"
    )
    argv = ["enjoy", "--model", "sac.zip", "--algo", "sac", "--env", "Pendulum-v1", *flags.split(), "--custom-objects", "-P"]
    assert main([*argv, "--env-kwargs", "g:5.0"]) == 0
    assert capsys.readouterr().out.splitlines()[-1] == "no episode ended within 20 steps"
    assert len(list(Path("out").glob("*.monitor.csv"))) == 2


@pytest.mark.parametrize(
    "flags, message",
    [
        (["-n", "0"], "n_timesteps: 0"),
        (["--n-envs", "0"], "n_envs: 0"),
        (["--norm-reward"], "--norm-reward: sac.zip has no VecNormalize statistics"),
        (["--reward-log", "sac.zip"], "--reward-log: 'sac.zip' cannot be written — it is no folder"),
        (["--env-kwargs", "gravity:1"], "gravity"),
    ],
)
def test_mistakes(agent, folder, capsys, flags, message):
    before = {path: path.read_bytes() for path in folder.iterdir()}
    assert main(["enjoy", "--model", "sac.zip", "--algo", "sac", "--env", "Pendulum-v1", "--no-render", *flags]) == 2
    assert message in capsys.readouterr().err.splitlines()[-1]
    assert {path: path.read_bytes() for path in folder.iterdir()} == before
