"""What a run starts from and how it goes: trained agents, copies in processes, several seeds, an early end, a dry run."""

import json
import os
import re
import shutil
import subprocess
import sys

import gymnasium as gym
import numpy as np
import pytest
import torch as th
import yaml
from stable_baselines3 import PPO, TD3
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.save_util import save_to_pkl
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecNormalize

from sb3_symphony.cli import main
from sb3_symphony.common.buffers import FadingReplayBuffer
from sb3_symphony.common.checkpoint import newest_checkpoint
from sb3_symphony.common.replay_files import ReplaySegments, add_transitions
from sb3_symphony.experiment.config import ConfigError, RunSettings, TrainOptions, load_config
from sb3_symphony.experiment.decode import algorithm_arguments
from sb3_symphony.experiment.dry_run import as_yaml, dry_run
from sb3_symphony.experiment.environment import make_evaluation_env, make_training_env
from sb3_symphony.experiment.registry import ALGORITHMS, load_algorithm
from sb3_symphony.experiment.run_folder import RunFolder
from sb3_symphony.experiment.train import build_model, train, train_seeds
from sb3_symphony.experiment.transfer import find_trained, start_from

pytestmark = pytest.mark.usefixtures("no_figures")

SMALL = {"policy_kwargs": {"net_arch": [8]}, "learning_starts": 50, "buffer_size": 1000, "batch_size": 16}
MIRRORED = {
    "normalize": True,
    "replay_buffer_class": "FadingReplayBuffer",
    "replay_buffer_kwargs": {"mirror": {"observation": {"negate": [1, 2]}, "action": {"negate": [0]}}},
}
OWN_ENV = """
import gymnasium as gym
from gymnasium.envs.classic_control.pendulum import PendulumEnv


class Robot(PendulumEnv):
    def __init__(self, terminate=False):
        super().__init__()


if "Robot-v0" not in gym.registry:
    gym.register("Robot-v0", entry_point=Robot, max_episode_steps=50)
"""


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def options(algo="td3", env="Pendulum-v1", n_timesteps=120, **changes):
    changes.setdefault("hyperparams", SMALL)
    quick = {"seed": 1, "eval_freq": 0, "eval_episodes": 1, "verbose": 0, "progress": False, "num_threads": 1, "quiet": True}
    return TrainOptions(algo=algo, env=env, n_timesteps=n_timesteps, **{**quick, **changes})


def started(options):
    """A model at its first step, and the one it started from."""
    config = load_config(options)
    model = build_model(options, config, 5, verbose=0)
    selection = find_trained(options)
    start_from(model, selection, options.with_replay_buffer)
    return model, load_algorithm(options.algo).load(selection.model)


def same(a, b):
    return all(th.equal(a[key], b[key]) for key in a)


@pytest.mark.parametrize("algo", ["td3", "sac", "ppo", "symphony", "redq", "droq"])
def test_weights_and_optimisers_come_along_and_counters_start_anew(algo):
    small = SMALL if algo != "ppo" else {"policy_kwargs": {"net_arch": [8]}, "n_steps": 64, "batch_size": 16}
    first = train(options(algo, hyperparams={**small, "learning_rate": 1e-2})).run
    model, trained = started(options(algo, hyperparams={**small, "learning_rate": 3e-3}, trained_agent=str(first.path)))
    assert same(trained.policy.state_dict(), model.policy.state_dict())
    (optimizer, theirs) = ((m.policy.optimizer if algo == "ppo" else m.critic.optimizer) for m in (model, trained))
    state, expected = optimizer.state_dict()["state"], theirs.state_dict()["state"]
    assert state and all(th.equal(state[i]["exp_avg"], expected[i]["exp_avg"]) for i in expected)
    assert optimizer.param_groups[0]["lr"] == 3e-3  # the configuration's
    assert model.num_timesteps == 0 and model._n_updates == 0
    if algo in ("sac", "redq"):
        assert th.equal(model.log_ent_coef, trained.log_ent_coef) and model.log_ent_coef.item() != 0


@pytest.mark.parametrize("algo", ["sac", "redq"])
def test_what_the_agents_run_did_not_set_is_not_the_files(algo, folder):
    """The file's networks would take the weights, or not, and be another agent."""
    plain = {key: value for key, value in SMALL.items() if key != "policy_kwargs"}
    (folder / "plain.yml").write_text(yaml.safe_dump({"n_timesteps": 60, **plain}))
    own = {"policy_kwargs": {"activation_fn": "Tanh"}, "use_sde": True, "normalize": True}
    (folder / "own.yml").write_text(yaml.safe_dump({"n_timesteps": 60, **plain, **own}))
    first = train(options(algo, n_timesteps=60, hyperparams={}, conf_file="plain.yml")).run
    again = options(algo, n_timesteps=60, hyperparams={}, conf_file="own.yml", trained_agent=str(first.path))
    second = train(again).run
    assert not set(own) & set(yaml.safe_load((second.details / "config.yml").read_text()))
    model = load_algorithm(algo).load(second.model)
    assert "Tanh" not in str(model.policy) and not model.use_sde
    shown = dry_run(again)
    assert shown["policy_kwargs"][1].startswith("default of")
    given = again.model_copy(update={"hyperparams": {"policy_kwargs": {"activation_fn": "Tanh"}}})
    assert dry_run(given)["policy_kwargs.activation_fn"] == ("Tanh", "-params")


def test_items_of_a_mapping_that_is_not_set():
    """As a dry run shows policy_kwargs that nobody gave."""
    given = {"policy_kwargs": None, "policy_kwargs.net_arch": [8], "replay_buffer_kwargs.a.b": 1}
    plain = load_config(options(hyperparams=given)).plain
    assert (plain["policy_kwargs"], plain["replay_buffer_kwargs"]) == ({"net_arch": [8]}, {"a": {"b": 1}})
    with pytest.raises(ConfigError, match=r"'gamma\.x' — 'gamma' is not a mapping"):
        load_config(options(hyperparams={"gamma": 0.9, "gamma.x": 1}))


def test_run_from_a_trained_agent(folder):
    first = train(options(hyperparams={**SMALL, "policy_kwargs": {"net_arch": [9], "activation_fn": "Tanh"}})).run
    second = train(options(hyperparams={"learning_starts": 50}, trained_agent=str(first.model))).run
    stored = yaml.safe_load((second.details / "config.yml").read_text())
    assert stored["policy_kwargs"] == {"net_arch": [9], "activation_fn": "Tanh"}  # the trained agent's
    assert yaml.safe_load((second.details / "args.yml").read_text())["trained_agent"] == str(first.model)
    assert TD3.load(second.model).num_timesteps == 120
    with pytest.raises(ConfigError, match=r"-i: networks of .* do not fit the configuration's"):
        train(options(trained_agent=str(first.path), hyperparams={"policy_kwargs": {"net_arch": [8]}}))
    # A file from elsewhere: its networks have to be those of the configuration
    shutil.copy(first.model, folder / "elsewhere.zip")
    with pytest.raises(ConfigError, match="do not fit"):
        train(options(trained_agent="elsewhere.zip"))
    assert len(list((folder / "logs" / "td3").iterdir())) == 2


@pytest.mark.parametrize("algo", ["td3", "redq"])
def test_random_numbers_are_those_of_the_own_seed(algo):
    first = train(options(algo)).run
    draws = []
    for seed in (2, 3):
        chosen = options(algo, trained_agent=str(first.path))
        model = build_model(chosen, load_config(chosen), seed, verbose=0)
        start_from(model, find_trained(chosen), False)
        draws.append((th.rand(1).item(), np.random.rand()))
        th.manual_seed(seed)
        np.random.seed(seed)
        assert draws[-1] == (th.rand(1).item(), np.random.rand())
    assert draws[0] != draws[1]


@pytest.mark.parametrize("algo", ["symphony", "droq"])
def test_the_average_of_actors_starts_anew(algo):
    small = {**SMALL, "policy_kwargs": {"net_arch": [8], "actor_averaging": 0.1}}
    first = train(options(algo, hyperparams=small)).run
    model, trained = started(options(algo, hyperparams=small, trained_agent=str(first.path)))
    assert trained.policy.n_averaged > 10 and model.policy.n_averaged == 0
    assert same(model.policy.averaged_actor.state_dict(), trained.actor.state_dict())
    model.policy.average_actor()
    assert same(model.policy.averaged_actor.state_dict(), model.actor.state_dict())


def test_symphony_does_not_redraw_a_trained_actor():
    first = train(options("symphony")).run
    model, trained = started(options("symphony", trained_agent=str(first.path)))
    model.learn(model.learning_starts)
    assert model._n_updates == 0 and same(model.actor.state_dict(), trained.actor.state_dict())


def test_a_fixed_entropy_coefficient_stays_fixed():
    first = train(options("sac")).run
    model, _ = started(options("sac", trained_agent=str(first.path), hyperparams={**SMALL, "ent_coef": 0.005}))
    assert model.ent_coef_optimizer is None and float(model.ent_coef_tensor) == pytest.approx(0.005)
    fixed = train(options("sac", trained_agent=str(first.path), hyperparams={**SMALL, "ent_coef": 0.005})).run
    model, _ = started(options("sac", trained_agent=str(fixed.path)))
    assert float(model.log_ent_coef) == 0  # begins anew


@pytest.mark.parametrize(
    "arguments, message",
    [
        ({"trained_agent": "missing"}, "-i: missing"),
        ({"algo": "sac"}, "was trained with td3"),
        ({"env": "MountainCarContinuous-v0"}, "observation space of the model Box.*of the environment Box"),
        ({"trained_agent": None, "with_replay_buffer": True}, "belongs to -i"),
        ({"with_replay_buffer": True}, "neither checkpoints .* nor replay_buffer.pkl"),
    ],
)
def test_mistakes_with_trained_agents(folder, arguments, message):
    first = train(options()).run
    with pytest.raises(ConfigError, match=message):
        train(options(**{"trained_agent": str(first.path), **arguments}))
    assert [path.name for path in (folder / "logs").iterdir()] == ["td3"]
    assert len(list((folder / "logs" / "td3").iterdir())) == 1


def test_statistics_of_vec_normalize_come_along(folder):
    small = {"policy_kwargs": {"net_arch": [8]}, "n_steps": 64, "batch_size": 16, "normalize": True}
    first = train(options("ppo", hyperparams=small)).run
    plain = {"n_steps": 64, "batch_size": 16}
    second = options("ppo", hyperparams=plain, trained_agent=str(first.path))
    result = train(second).run
    assert yaml.safe_load((result.details / "config.yml").read_text())["normalize"] is True
    env = make_training_env("Pendulum-v1", RunSettings(n_timesteps=1), None, 0)
    before, after = (VecNormalize.load(str(run.normalization), env).obs_rms.count for run in (first, result))
    assert after == pytest.approx(2 * before, rel=0.05)  # went on counting
    shutil.copy(first.model, folder / "elsewhere.zip")
    with pytest.raises(ConfigError, match=r"-i: .*VecNormalize"):
        train(options("ppo", hyperparams=small, trained_agent="elsewhere.zip"))


def test_rewards_alone_were_normalised():
    small = {"policy_kwargs": {"net_arch": [8]}, "n_steps": 64, "batch_size": 16, "normalize": {"norm_obs": False}}
    first = train(options("ppo", hyperparams=small)).run
    result = train(options("ppo", hyperparams=small, trained_agent=str(first.path))).run
    env = make_training_env("Pendulum-v1", RunSettings(n_timesteps=1), None, 0)
    before, after = (VecNormalize.load(str(run.normalization), env).ret_rms.count for run in (first, result))
    assert after == pytest.approx(2 * before, rel=0.05)
    with pytest.raises(ConfigError, match=r"-i: .* was trained without norm_obs — expected normalize: {norm_obs: false}"):
        train(options("ppo", hyperparams={**small, "normalize": True}, trained_agent=str(first.path)))


@pytest.mark.parametrize("algo", ["td3", "symphony", "redq"])
@pytest.mark.parametrize("size", [1000, 60])
def test_experience_comes_along(algo, size):
    first = train(options(algo, save_freq=50)).run
    state = newest_checkpoint(first.checkpoints).state
    experience = list(ReplaySegments(first.checkpoints, state["segments"]).transitions())
    rewards = np.concatenate([part["rewards"] for part in experience])
    assert len(rewards) == 120
    again = options(
        algo, hyperparams={**SMALL, "buffer_size": size}, trained_agent=str(first.path), with_replay_buffer=True, save_freq=50
    )
    model, _ = started(again)
    expected = rewards[-size:]
    np.testing.assert_array_equal(ReplaySegments.of(model.replay_buffer)["rewards"], expected)
    # And is in the checkpoints of the new run, in the order of time
    second = train(again).run
    state = newest_checkpoint(second.checkpoints).state
    buffer = model.replay_buffer
    segments = ReplaySegments(second.checkpoints, state["segments"])
    segments.load(buffer)
    everything = np.concatenate([expected, rewards_of(second)])[-size:]
    assert state["buffer"]["attributes"]["pos"] == (len(expected) + 120) % size
    order = (np.arange(len(everything)) + (state["buffer"]["attributes"]["pos"] if size == 60 else 0)) % size
    np.testing.assert_array_equal(buffer.rewards[order][:, 0], everything[:, 0])


def rewards_of(run):
    """Learned rewards of all steps of a run, from its checkpoint."""
    state = newest_checkpoint(run.checkpoints).state
    parts = ReplaySegments(run.checkpoints, state["segments"]).transitions()
    return np.concatenate([part["rewards"] for part in parts])[-120:]


def test_experience_saved_by_sb3(folder):
    """It goes before that of checkpoints."""
    first = train(options(save_freq=60)).run
    model = TD3.load(first.model, env=gym.make("Pendulum-v1"), learning_starts=10)
    model.learn(40)
    model.save_replay_buffer(first.path / "replay_buffer.pkl")
    started_model, _ = started(options(trained_agent=str(first.path), with_replay_buffer=True))
    for name, array in ReplaySegments.of(model.replay_buffer).items():
        np.testing.assert_array_equal(ReplaySegments.of(started_model.replay_buffer)[name][:-1], array[:-1])
    (first.path / "replay_buffer.pkl").write_bytes(b"damaged")
    with pytest.raises(ConfigError, match="not a replay buffer of SB3, or damaged"):
        train(options(trained_agent=str(first.path), with_replay_buffer=True))
    other = ReplayBuffer(20, gym.spaces.Box(-1, 1, (2,)), gym.spaces.Box(-1, 1, (1,)), n_envs=1)
    other.add(np.zeros(2), np.zeros(2), np.zeros(1), np.zeros(1), np.zeros(1), [{}])
    save_to_pkl(first.path / "replay_buffer.pkl", other)
    with pytest.raises(ConfigError, match=r"observations of shape \(1, 2\) .* expected \(1, 3\)"):
        train(options(trained_agent=str(first.path), with_replay_buffer=True))


def test_transitions_in_the_order_of_time():
    """A ring that came round, into smaller and larger ones; what ends early stays marked so."""
    space = gym.spaces.Box(-100, 100, (1,))
    source = ReplayBuffer(14, space, space, n_envs=2)
    for i in range(11):
        row = np.full((2, 1), i, dtype=np.float32)
        source.add(row, row + 1, row, row[:, 0], np.array([i == 8, False]), [{"TimeLimit.truncated": i == 8}, {}])
    for size in (3, 7, 20):
        target = ReplayBuffer(2 * size, space, space, n_envs=2)
        assert add_transitions(target, [ReplaySegments.of(source)]) == min(size, 7)
        found = ReplaySegments.of(target)
        np.testing.assert_array_equal(found["rewards"][:, 0], np.arange(11 - min(size, 7), 11))
        np.testing.assert_array_equal(found["next_observations"][:, 1, 0], np.arange(12 - min(size, 7), 12))
        ends = np.isin(np.arange(11 - min(size, 7), 11), (8, 10))  # the new run's episode does not go on from the last
        np.testing.assert_array_equal(found["timeouts"][:, 0], ends)


def test_the_first_of_other_transitions_are_no_first_steps():
    """The source's oldest rows are from amid an episode."""
    space = gym.spaces.Box(-100, 100, (1,))
    source = ReplayBuffer(14, space, space)
    for i in range(20):
        row = np.full((1, 1), i % 12, dtype=np.float32)
        source.add(row, row + 1, row, row[:, 0], np.array([i % 12 == 11]), [{}])
    target = FadingReplayBuffer(13, space, space, start_share=1.0, start_steps=4, fade_factor=None)
    add_transitions(target, [ReplaySegments.of(source)])
    assert set(target.sample(200).observations.flatten().tolist()) == {0, 1, 2, 3}


def test_resumed_run_that_started_from_a_trained_agent(folder):
    """Bit for bit, and the file it started from is not needed any more."""
    first = train(options(save_freq=50)).run
    shutil.copytree(first.path, folder / "agent")
    begin = {"trained_agent": "agent", "with_replay_buffer": True, "save_freq": 40}
    whole = train(options(n_timesteps=160, **begin)).run
    train(options(n_timesteps=80, **begin))
    shutil.rmtree(folder / "agent")
    resumed = train(TrainOptions(resume="logs/td3/Pendulum-v1_3", n_timesteps=160, quiet=True)).run
    assert same(TD3.load(whole.model).policy.state_dict(), TD3.load(resumed.model).policy.state_dict())


def test_copies_in_processes(folder, monkeypatch):
    (folder / "my_robots.py").write_text(OWN_ENV.replace("Robot", "Robots"))
    monkeypatch.syspath_prepend(str(folder))
    small = {"policy_kwargs": {"net_arch": [8]}, "n_steps": 64, "batch_size": 16, "n_envs": 2}
    runs = []
    for kind in ("dummy", "subproc"):
        chosen = options("ppo", "Robots-v0", 256, hyperparams=small, vec_env=kind, gym_packages=["my_robots"], eval_freq=128)
        runs.append(train(chosen).run)
    a, b = (PPO.load(run.model).policy.state_dict() for run in runs)
    assert same(a, b)
    for name in ("0.monitor.csv", "1.monitor.csv"):
        first, second = (np.loadtxt(run.path / name, delimiter=",", skiprows=2, ndmin=2)[:, :2] for run in runs)
        assert len(first) == 2 and np.array_equal(first, second)


def test_kinds_of_environments():
    for subprocesses, kind in ((False, DummyVecEnv), (True, SubprocVecEnv)):
        env = make_training_env("Pendulum-v1", RunSettings(n_timesteps=1, n_envs=2), None, 0, subprocesses)
        assert type(env) is kind and env.num_envs == 2
        env.close()
    with pytest.raises(ConfigError, match="unknown environment"):
        make_training_env("Pendulum-v9", RunSettings(n_timesteps=1), None, 0, True)


def test_own_algorithm_of_another_folder(folder, capsys):
    (folder / "code").mkdir()
    (folder / "code" / "my_own_td3.py").write_text("from stable_baselines3 import TD3\nclass Own(TD3):\n    pass\n")
    run = train(options(f"{folder}/code/my_own_td3.py:Own", conf_file="td3", n_timesteps=60, save_freq=50)).run.path
    assert str(run) == "logs/my_own_td3.py:Own/Pendulum-v1_1"
    shutil.copytree(folder / "code", folder / "moved")
    own = f"{folder}/moved/my_own_td3.py:Own"
    assert main(["evaluate", "--algo", own, "--env", "Pendulum-v1", "-n", "1"]) == 0
    assert train(TrainOptions(resume=str(run), algo=own, n_timesteps=80)).steps == 80


def test_own_algorithm_that_cannot_be_imported(folder, capsys):
    (folder / "broken_one.py").write_text("import nowhere_to_be_found\n")
    (folder / "agent.zip").touch()
    for argv in ("train --conf-file td3", "evaluate --model agent.zip"):
        command = [*argv.split(), "--algo", "broken_one.py:Own", "--env", "Pendulum-v1"]
        assert main(command) == 2
        (error,) = capsys.readouterr().err.splitlines()
        assert "--algo: " in error and "broken_one.py: cannot be imported — ModuleNotFoundError: No module named" in error
    assert not (folder / "logs").exists()


def test_a_folder_that_is_not_in_utf8(folder, capsys):
    assert main(["train", "--algo", "td3", "--env", "Pendulum-v1", "-f", "bad\udcff"]) == 2
    assert "--log-folder: 'bad\\udcff' cannot be written — expected a name in UTF-8" in capsys.readouterr().err
    assert not list(folder.iterdir())


def test_own_on_policy_algorithm(folder):
    """It may have what off-policy ones may not: discrete actions, and stacked frames that are normalised."""
    (folder / "my_own_ppo.py").write_text("from stable_baselines3 import PPO\nclass Own(PPO):\n    pass\n")
    small = {"n_envs": 1, "n_steps": 32, "batch_size": 32, "normalize": True, "frame_stack": 2}
    own = options(f"{folder}/my_own_ppo.py:Own", env="CartPole-v1", conf_file="ppo", n_timesteps=32, hyperparams=small)
    assert train(own).steps == 32


def test_own_robot(folder, monkeypatch, capsys):
    """Trained, then used by another command."""
    (folder / "my_robot2.py").write_text(OWN_ENV.replace("Robot", "Robot2"))
    monkeypatch.syspath_prepend(str(folder))
    argv = "--env Robot2-v0 --gym-packages my_robot2"
    small = "-params policy_kwargs.net_arch:[8] learning_starts:50 buffer_size:100"
    assert main(f"train --algo sac {argv} -n 60 --eval-freq 0 --quiet --seed 1 {small}".split()) == 0
    assert main(f"evaluate --algo sac {argv} -n 2".split()) == 0
    assert main("train --algo sac --env Xyzzy-v0".split()) == 2
    assert "(one's own: MODULE:Xyzzy-v0; most commands have --gym-packages)" in capsys.readouterr().err


KINDS_ENV = """
import gymnasium as gym
import numpy as np
from gymnasium import spaces

OBSERVATIONS = {
    "vector": spaces.Box(-1, 1, (3,)),
    "image": spaces.Box(0, 255, (36, 36, 3), np.uint8),
    "dict": spaces.Dict({"a": spaces.Box(-1, 1, (2,)), "b": spaces.Box(-1, 1, (1,))}),
    "tuple": spaces.Tuple((spaces.Box(-1, 1, (2,)),)),
    "nested": spaces.Dict({"a": spaces.Dict({"b": spaces.Box(-1, 1, (2,))})}),
    "goal": spaces.Dict({name: spaces.Box(-1, 1, (2,)) for name in ("observation", "achieved_goal", "desired_goal")}),
}


class Kinds(gym.Env):
    def __init__(self, observations="vector", actions=(2,)):
        self.observation_space = OBSERVATIONS[observations]
        self.action_space = spaces.Box(-1, 1, tuple(actions))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.t = 0
        return self.observation_space.sample(), {}

    def step(self, action):
        self.t += 1
        done = self.t % 10 == 0
        return self.observation_space.sample(), 0.0, False, done, {"is_success": bool(action.sum() > 0)} if done else {}

    def compute_reward(self, achieved, desired, info):
        return np.zeros(len(achieved))


if "Kinds-v0" not in gym.registry:
    gym.register("Kinds-v0", entry_point=Kinds)
"""


@pytest.fixture
def kinds(folder, monkeypatch):
    """The start of a command line for environments of many kinds."""
    (folder / "kinds.py").write_text(KINDS_ENV)
    monkeypatch.syspath_prepend(str(folder))
    return (
        "train --env Kinds-v0 --gym-packages kinds -n 60 --quiet --seed 1 -params learning_starts:30 buffer_size:100".split()
    )


def test_images_with_evaluations(kinds):
    argv = [*kinds, "policy:CnnPolicy", "gradient_steps:1", "--env-kwargs", "observations:image"]
    argv += ["--eval-freq", "30", "--eval-episodes", "1"]
    assert main([*argv, "--algo", "redq"]) == 0
    found = "--algo redq --env Kinds-v0 --gym-packages kinds -n 1".split()
    assert main(["evaluate", *found]) == 0


@pytest.mark.parametrize("noise", ["noise_type:normal noise_std:0.1 action_noise:null", "action_noise:PinkActionNoise"])
@pytest.mark.parametrize("actions", ["[2,2]", "[2]", "[]"])
def test_actions_of_any_shape_with_noise(kinds, noise, actions):
    argv = [*kinds, *noise.split(), "--env-kwargs", f"actions:{actions}", "--eval-freq", "0"]
    assert main([*argv, "--algo", "symphony"]) == 0


@pytest.mark.parametrize("algo", ["sac", "redq"])
def test_agent_of_a_run_that_saved_memory(kinds, algo):
    memory = ["optimize_memory_usage:true", "replay_buffer_kwargs:{handle_timeout_termination: false}"]
    if algo == "redq":
        memory += ["replay_buffer_class:ReplayBuffer", "gradient_steps:1", "policy_kwargs.net_arch:[16]"]
    assert main([*kinds, *memory, "--algo", algo, "--eval-freq", "0"]) == 0
    assert main(f"evaluate --algo {algo} --env Kinds-v0 --gym-packages kinds -n 1".split()) == 0


def test_successes_in_the_monitor_files(kinds, folder, capsys):
    assert main([*kinds, "--algo", "sac", "--eval-freq", "0"]) == 0
    (path,) = (folder / "logs" / "sac").glob("*/0.monitor.csv")
    _, header, *rows = path.read_text().splitlines()
    assert header == "r,l,t,is_success" and len(rows) == 6
    assert {row.rpartition(",")[2] for row in rows} <= {"True", "False"}
    assert main("plot -y success --algo sac".split()) == 0


HER = ["policy:MultiInputPolicy", "replay_buffer_class:HerReplayBuffer"]


@pytest.mark.parametrize(
    ("observations", "arguments", "message"),
    [
        ("goal", [*HER, "replay_buffer_kwargs:{goal_selection_strategy: futur}"], "futur"),
        ("dict", HER, "HerReplayBuffer"),
        ("dict", ["policy:MultiInputPolicy", "replay_buffer_class:ReplayBuffer"], "ReplayBuffer"),
        ("tuple", [], "Tuple"),
        ("nested", ["policy:MultiInputPolicy"], "[Nn]ested"),
        ("vector", ["policy_kwargs.features_extractor_class:CombinedExtractor"], "spaces"),
        ("vector", ["env_wrapper:stable_baselines3.common.atari_wrappers.NoopResetEnv"], "NoopResetEnv"),
    ],
)
def test_what_does_not_fit_the_observations(kinds, folder, capsys, observations, arguments, message):
    argv = [*kinds, *arguments, "--env-kwargs", f"observations:{observations}", "--algo", "redq", "--eval-freq", "0"]
    assert main(argv) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert re.search(message, line) and not (folder / "logs").exists()


def test_arguments_of_the_evaluation():
    env = make_evaluation_env("Pendulum-v1", RunSettings(n_timesteps=1, env_kwargs={"g": 1.0}), {"g": 3.0})
    assert env.get_attr("unwrapped")[0].g == 3.0
    run = train(options(eval_freq=60, env_kwargs={"g": 1.0}, eval_env_kwargs={"g": 1e6})).run
    with np.load(run.path / "evaluations.npz") as data:
        assert data["results"].shape == (2, 1)
    walker = options("sac", "BipedalWalker-v3", protocol="standard", eval_env_kwargs={"hardcore": True})
    with pytest.raises(ConfigError, match="'hardcore' — --protocol standard"):
        train(TrainOptions(**walker.model_dump(exclude={"eval_freq", "eval_episodes"})))


def test_wrapper_of_the_vectorised_environment():
    wrapper = {"stable_baselines3.common.vec_env.VecCheckNan": {"raise_exception": True}}
    settings = RunSettings(n_timesteps=1, vec_env_wrapper=wrapper, normalize=True)
    for env in (make_training_env("Pendulum-v1", settings, None, 0), make_evaluation_env("Pendulum-v1", settings)):
        assert [type(env).__name__, type(env.venv).__name__] == ["VecNormalize", "VecCheckNan"]
    run = train(options(hyperparams={**SMALL, "vec_env_wrapper": wrapper}, save_freq=60)).run
    train(TrainOptions(resume=str(run.path), n_timesteps=150, quiet=True))
    for bad, message in (
        ("stable_baselines3.common.vec_env.VecNormalize", "expected as the key normalize"),
        ("stable_baselines3.common.vec_env.VecFrameStack", "expected as the key frame_stack"),
        ("stable_baselines3.common.vec_env.VecVideoRecorder", "no such wrapper"),
        ("stable_baselines3.common.vec_env.VecChekNan", "did you mean 'VecCheckNan'"),
        ("os.mkdir", "expected a dotted name"),
        ({"stable_baselines3.common.vec_env.VecCheckNan": {"nan": 1}}, "nan"),
        ({"stable_baselines3.common.vec_env.VecExtractDictObs": {"key": "x"}}, "vec_env_wrapper: VecExtractDictObs"),
    ):
        with pytest.raises(ConfigError, match=message):
            train(options(hyperparams={**SMALL, "vec_env_wrapper": bad}))


class Goal(gym.Env):
    def __init__(self, limit=1.0, key="place"):
        self.observation_space = gym.spaces.Dict({key: gym.spaces.Box(-1, 1, (2,))})
        self.action_space = gym.spaces.Box(-limit, limit, (1,))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return self.observation_space.sample(), {}


if "Goal-v0" not in gym.registry:
    gym.register("Goal-v0", entry_point=Goal)


@pytest.mark.parametrize("limit, key", [(1.0, "other"), (2.0, "place")])
def test_spaces_of_evaluations(limit, key):
    """Dict observations with another key, actions with another limit."""
    dicts = {"hyperparams": {**SMALL, "policy": "MultiInputPolicy"}, "env": "Goal-v0"}
    with pytest.raises(ConfigError, match=r"--eval-env-kwargs: (observation|action)_space .* — that of the training is"):
        train(options(eval_freq=60, eval_env_kwargs={"limit": limit, "key": key}, **dicts))


def test_evaluations_that_never_come():
    with pytest.raises(ConfigError, match=r"--eval-env-kwargs: {'limit': 2.0} — needs evaluations, expected --eval-freq > 0"):
        train(options(eval_freq=0, eval_env_kwargs={"limit": 2.0}, hyperparams=SMALL))


def test_checkpoints_that_never_come(folder):
    with pytest.raises(ConfigError, match="--keep: 5 — needs checkpoints, expected --save-freq > 0"):
        train(options(keep=5))
    assert not (folder / "logs").exists()


def test_stop_reward(capsys):
    small = {**SMALL, "stop_reward": -1900.0}  # any agent is better
    result = train(options(n_timesteps=5000, hyperparams=small, eval_freq=60, save_freq=50))
    assert result.steps == 60 and not result.interrupted and result.run.model.exists()
    again = train(TrainOptions(resume=str(result.run.path)))
    assert again.untouched  # it is done
    more = train(TrainOptions(resume=str(result.run.path), n_timesteps=6000)).summary()
    assert more.endswith("is finished: 60 steps, its stop_reward reached — nothing changed")
    never = train(options(hyperparams={**SMALL, "stop_reward": 0.0}, eval_freq=60))
    assert never.steps == 120
    with pytest.raises(ConfigError, match="stop_reward: 0 — needs evaluations"):
        train(options(hyperparams={**SMALL, "stop_reward": 0}))


def test_several_seeds(folder, capsys):
    argv = "train --algo td3 --env Pendulum-v1 -n 80 --eval-freq 60 --eval-episodes 1 --seed 7 --n-seeds 3 --json out.json"
    small = ["--quiet", "-params", "learning_starts:50", "buffer_size:1000", "policy_kwargs.net_arch:[8]"]
    assert main([*argv.split(), *small]) == 0
    captured = capsys.readouterr()
    assert captured.out == "" and captured.err == ""
    runs = json.loads((folder / "out.json").read_text())["runs"]
    assert len(runs) == 3 and all(run["steps"] == 80 and run["mean_reward"] < 0 for run in runs)
    for number, seed in ((1, 7), (2, 8), (3, 9)):
        details = folder / f"logs/td3/Pendulum-v1_{number}/Pendulum-v1"
        assert yaml.safe_load((details / "args.yml").read_text())["seed"] == seed
        assert (details / "command.txt").read_text().endswith(f"--seed {seed} --n-seeds 1\n")
    alone = train(options(n_timesteps=80, seed=8, eval_freq=60, hyperparams={k: SMALL[k] for k in SMALL if k != "batch_size"}))
    b = TD3.load(folder / "logs/td3/Pendulum-v1_2/Pendulum-v1.zip").policy.state_dict()
    assert same(TD3.load(alone.run.model).policy.state_dict(), b)
    with pytest.raises(ConfigError, match="--n-seeds: 2"):
        train_seeds(options(seed=2**31 - 1, n_seeds=2))
    assert main([*argv.split(), "--n-seeds", str(2**31)]) == 2 and "n_seeds: 2147483648 — expected" in capsys.readouterr().err
    assert main([*argv.split()[:-1], "-", *small]) == 0
    assert len(json.loads(capsys.readouterr().out)["runs"]) == 3


# ----------------------------------------------------------------------------------------------------------------------
# Dry run
# ----------------------------------------------------------------------------------------------------------------------


def test_sources(folder, capsys):
    argv = "train --algo sac --env BipedalWalker-v3 --dry-run -n 5000 --env-kwargs hardcore:true"
    assert main([*argv.split(), "-params", "policy_kwargs.net_arch:[8]", "gamma:0.9", "--json", "-"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert {key: found[key]["source"] for key in ("n_timesteps", "gamma", "tau", "target_entropy", "n_envs")} == {
        "n_timesteps": "-n",
        "gamma": "-params",
        "tau": "sac.yml, BipedalWalker-v3",
        "target_entropy": "default of SAC",
        "n_envs": "default of train",
    }
    assert found["policy_kwargs.net_arch"] == {"value": [8], "source": "-params"}
    assert found["policy_kwargs.log_std_init"] == {"value": -3, "source": "sac.yml, BipedalWalker-v3"}
    assert found["env_kwargs.hardcore"] == {"value": True, "source": "--env-kwargs"}
    assert not list(folder.iterdir())
    (folder / "own.yml").write_text("n_timesteps: 10\nbatch_size: 32\n")
    shown = dry_run(TrainOptions(algo="sac", env="Pendulum-v1", conf_file="own.yml"))
    assert shown["batch_size"] == (32, "-conf own.yml")
    assert main("train --algo sac --env Pendulum-v1 --dry-run -params gama:1".split()) == 2
    assert "did you mean 'gamma'" in capsys.readouterr().err
    assert [path.name for path in folder.iterdir()] == ["own.yml"]


@pytest.mark.parametrize("algo", ALGORITHMS)
def test_what_a_dry_run_prints_is_the_same_configuration(folder, algo):
    """Read back by ``-conf`` it makes the same arguments, except that defaults are spelled out."""
    wanted = TrainOptions(algo=algo, env="Pendulum-v1", hyperparams={"policy_kwargs.net_arch": [8]})
    values = dry_run(wanted)
    (folder / "shown.yml").write_text(as_yaml(wanted, values))
    again = TrainOptions(algo=algo, env="Pendulum-v1", conf_file="shown.yml")
    assert {key: value for key, (value, _) in dry_run(again).items()} == {key: value for key, (value, _) in values.items()}
    action_space = gym.make("Pendulum-v1").action_space
    before, after = (
        algorithm_arguments(algo, load_algorithm(algo), load_config(each), action_space) for each in (wanted, again)
    )
    assert {key: repr(after[key]) for key in before if "noise" not in key and "learning_rate" not in key} == {
        key: repr(value) for key, value in before.items() if "noise" not in key and "learning_rate" not in key
    }


@pytest.mark.parametrize(
    "changes, message",
    [
        ({"log_folder": "file"}, "--log-folder: 'file' cannot be written"),
        ({"tensorboard_log": "file/x"}, "--tensorboard-log: 'file/x' cannot be written"),
        ({"tensorboard_log": "logs [1]"}, "--tensorboard-log: 'logs [1]' — expected a path without *, ? and ["),
        ({"hyperparams": {**SMALL, **MIRRORED}}, "mirror: expected observations as they are, not normalised ones"),
    ],
)
@pytest.mark.parametrize("run", [dry_run, train])
def test_what_a_dry_run_finds(folder, changes, message, run):
    """All that would stop a run, which writes nothing then, either."""
    (folder / "file").touch()
    with pytest.raises(ConfigError, match=re.escape(message)):
        run(options(**changes))
    assert [path.name for path in folder.iterdir()] == ["file"]


def test_dry_run_of_a_trained_agent():
    first = train(options()).run
    shown = dry_run(options(hyperparams={}, trained_agent=str(first.path)))
    assert shown["policy_kwargs.net_arch"] == ([8], f"-i {first.path}")
    with pytest.raises(ConfigError, match="--dry-run: --resume"):
        dry_run(TrainOptions(resume=str(first.path)))


# ----------------------------------------------------------------------------------------------------------------------
# Disks
# ----------------------------------------------------------------------------------------------------------------------


def test_best_model_survives_a_full_disk(monkeypatch):
    """The evaluation finds a better model, which cannot be written: the one before stays as it was."""
    run = train(options(eval_freq=60, hyperparams={**SMALL, "normalize": True})).run
    files = [run.best_model, run.best_normalization, run.path / "evaluations.npz", run.model, run.normalization]
    from sb3_symphony.experiment.callbacks import save_model

    model = TD3.load(run.model, env=make_training_env("Pendulum-v1", RunSettings(n_timesteps=1, normalize=True), None, 0))
    contents = [path.read_bytes() for path in files]

    def full(descriptor):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    for path, statistics in ((run.best_model, run.best_normalization), (run.model, run.normalization)):
        with pytest.raises(OSError, match="No space left"):
            save_model(model, path, statistics)
    assert [path.read_bytes() for path in files] == contents
    assert not list(run.path.glob(".*")) and not list(run.details.glob(".*"))


def test_evaluations_survive_a_full_disk(monkeypatch):
    savez, calls = np.savez, []

    def fills_up(path, **arrays):
        calls.append(path)
        savez(path, **arrays)
        if len(calls) == 2:
            with open(path, "r+b") as file:
                file.truncate(10)
            raise OSError(28, "No space left on device")

    monkeypatch.setattr(np, "savez", fills_up)
    with pytest.raises(ConfigError, match="cannot be written: No space left on device"):
        train(options(eval_freq=60))
    (run,) = [path for path in (os.scandir("logs/td3"))]
    with np.load(os.path.join(run.path, "evaluations.npz")) as data:
        assert data["timesteps"].tolist() == [60]
    assert not [name for name in os.listdir(run.path) if name.startswith(".evaluations")]


def test_a_disk_that_is_full_from_the_beginning(monkeypatch):
    def full(*args):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(RunFolder, "write_configuration", full)
    with pytest.raises(ConfigError, match="Pendulum-v1_1' cannot be written: No space left on device"):
        train(options())


def as_an_ordinary_user(folder, *argv):
    """Root may write everywhere, so if the tests run as root, the command runs without that right; returns its error."""
    command = [sys.executable, "-W", "ignore", "-m", "sb3_symphony", *argv]
    if os.geteuid() == 0:
        rights = "-dac_override,-dac_read_search"
        command = ["setpriv", f"--bounding-set={rights}", f"--inh-caps={rights}", *command]
    done = subprocess.run(command, capture_output=True, text=True, cwd=folder)
    errors = [line for line in done.stderr.splitlines() if "error: " in line]
    assert done.returncode == 2 and len(errors) == 1 and "Traceback" not in done.stderr, done.stderr
    return errors[0]


needs_rights = pytest.mark.skipif(
    os.name != "posix" or (os.geteuid() == 0 and shutil.which("setpriv") is None), reason="needs POSIX rights, that hold"
)


@needs_rights
@pytest.mark.parametrize("flag", ["-f", "-tb"])
def test_unwritable_folder_as_an_ordinary_user(tmp_path_factory, flag):
    folder = tmp_path_factory.mktemp("shared")
    locked = folder / "locked"
    locked.mkdir(mode=0o555)
    (locked / "mine").write_text("mine")
    small = ["-n", "60", "-params", "buffer_size:100", "policy_kwargs.net_arch:[8]"]
    argv = ["train", "--algo", "td3", "--env", "Pendulum-v1", *small, "--device", "cpu", flag, str(locked / "logs")]
    assert "cannot be written — Permission denied" in as_an_ordinary_user(locked, *argv)
    assert [path.name for path in locked.iterdir()] == ["mine"]


@needs_rights
def test_a_run_that_may_only_be_read(tmp_path_factory):
    folder = tmp_path_factory.mktemp("shared")
    small = {"buffer_size": 100, "policy_kwargs": {"net_arch": [8]}}
    run = train(options(log_folder=str(folder), n_timesteps=60, save_freq=40, hyperparams=small)).run.path
    there = {path: path.read_bytes() for path in run.rglob("*") if path.is_file()}
    run.chmod(0o555)
    (run / "checkpoints").chmod(0o555)
    message = as_an_ordinary_user(folder, "train", "--resume", str(run), "-n", "100")
    assert f"--resume: '{run}' cannot be written — Permission denied" in message
    assert {path: path.read_bytes() for path in run.rglob("*") if path.is_file()} == there
