"""Models of every algorithm and of earlier versions, loaded and played in their environments."""

import json
import zipfile
from functools import partial
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from stable_baselines3 import PPO, SAC, TD3, HerReplayBuffer
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.envs import BitFlippingEnv
from stable_baselines3.common.vec_env import VecFrameStack, VecNormalize

from sb3_symphony.experiment import agent as agent_module
from sb3_symphony.experiment.agent import open_agent
from sb3_symphony.experiment.config import ConfigError, TrainOptions
from sb3_symphony.experiment.environment import FreshBox2DWorld
from sb3_symphony.experiment.registry import ALGORITHMS, LOADABLE, load_algorithm
from sb3_symphony.experiment.select import SelectOptions
from sb3_symphony.experiment.train import train

OLD = Path(__file__).parent / "data" / "sb3_2.3"
DISCRETE = ("dqn", "qrdqn")


class Images(gym.Env):
    """Random images of 36 × 40 pixels, channels last."""

    observation_space = gym.spaces.Box(0, 255, (36, 40, 3), np.uint8)
    action_space = gym.spaces.Box(-1, 1, (2,))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps = 0
        return self.np_random.integers(0, 256, (36, 40, 3), dtype=np.uint8), {}

    def step(self, action):
        self.steps += 1
        return self.np_random.integers(0, 256, (36, 40, 3), dtype=np.uint8), float(action.sum()), False, self.steps == 5, {}


class Points(gym.Env):
    """Dict observations."""

    observation_space = gym.spaces.Dict({"a": gym.spaces.Box(-1, 1, (2,)), "b": gym.spaces.Box(-1, 1, (3,))})
    action_space = gym.spaces.Box(-1, 1, (1,))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.observation_space.seed(seed)
        self.steps = 0
        return self.observation_space.sample(), {}

    def step(self, action):
        self.steps += 1
        return self.observation_space.sample(), 1.0, False, self.steps == 5, {}


Bits = partial(BitFlippingEnv, 3, continuous=True)
for name, env_class in (("AgentImages-v0", Images), ("AgentPoints-v0", Points), ("AgentBits-v0", Bits)):
    if name not in gym.registry:
        gym.register(name, entry_point=env_class)


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def saved(algo, env, policy="MlpPolicy", **arguments):
    model = load_algorithm(algo)(policy, env, seed=0, device="cpu", **arguments)
    model.save(f"{algo}.zip")
    return model


def options(algo, env="Pendulum-v1", **changes):
    return SelectOptions(**{"model": f"{algo}.zip", "algo": algo, "env": env, **changes})


@pytest.mark.parametrize("algo", LOADABLE)
def test_every_algorithm(algo):
    env = "CartPole-v1" if algo in DISCRETE else "Pendulum-v1"
    model = saved(algo, env, "MlpLstmPolicy" if algo == "ppo_lstm" else "MlpPolicy", policy_kwargs={"net_arch": [8]})
    with open_agent(options(algo, env)) as agent:
        steps = list(agent.episode(3))
        assert type(agent.model) is type(model)
    assert steps[-1].done and not any(step.done for step in steps[:-1])
    assert steps[-1].info["episode"]["l"] == len(steps)
    assert steps[-1].info["episode"]["r"] == pytest.approx(sum(step.reward for step in steps), abs=1e-3)

    # The same by hand, with the environment and the model as they were
    env = gym.make(env)
    observation, _ = env.reset(seed=3)
    state = None
    for step in steps:
        assert np.array_equal(step.observation, observation)
        action, state = model.predict(observation, state, np.array([step is steps[0]]), deterministic=True)
        assert np.array_equal(step.action, action)
        observation, reward, terminated, truncated, _ = env.step(action)
        assert step.reward == pytest.approx(reward, rel=1e-6) and step.done == (terminated or truncated)


@pytest.mark.parametrize("algo, normalized", [("ppo", True), ("sac", False)])
def test_models_of_an_earlier_version(algo, normalized):
    expected = json.loads((OLD / "predictions.json").read_text())
    observations = np.array(expected["observations"], dtype=np.float32)
    statistics = {"vecnormalize": str(OLD / "ppo_vecnormalize.pkl")} if normalized else {}
    with open_agent(options(algo, model=str(OLD / f"{algo}.zip"), **statistics)) as agent:
        seen = agent.env.normalize_obs(observations) if normalized else observations
        actions, _ = agent.model.predict(seen, deterministic=True)
        assert np.allclose(actions, expected[algo], atol=1e-6)
        assert len(list(agent.episode(0))) == 200


def test_an_episode_depends_on_its_seed_alone():
    saved("redq", "BipedalWalker-v3", policy_kwargs={"net_arch": [8]})
    with open_agent(options("redq", "BipedalWalker-v3", env_kwargs={"max_episode_steps": 120})) as agent:
        assert agent.env.env_is_wrapped(FreshBox2DWorld) == [True]
        episodes = {}
        for seed, deterministic in ((5, True), (5, False), (6, True), (5, False), (5, True)):
            steps = list(agent.episode(seed, deterministic))
            result = (len(steps), [step.reward for step in steps])
            assert episodes.setdefault((seed, deterministic), result) == result
    assert len({str(result) for result in episodes.values()}) == 3


def test_environment_of_a_run(folder):
    hyperparams = {
        "normalize": True,
        "frame_stack": 3,
        "n_steps": 64,
        "n_envs": 2,
        "policy_kwargs": {"net_arch": [8]},
        "env_wrapper": [
            "gymnasium.wrappers.TimeAwareObservation",
            {"sb3_symphony.common.wrappers.RewardFloor": {"floor": -1}},
        ],
    }
    flags = {"eval_freq": 100, "eval_episodes": 2, "save_freq": 100, "verbose": 0, "seed": 0, "env_kwargs": {"g": 9.0}}
    train(TrainOptions(algo="ppo", env="Pendulum-v1", n_timesteps=256, hyperparams=hyperparams, **flags))
    with np.load("logs/ppo/Pendulum-v1_1/evaluations.npz") as data:
        at, evaluated = data["timesteps"], data["results"]
    for flag, row in (({"load_checkpoint": int(at[0])}, 0), ({"load_checkpoint": int(at[-1])}, -1)):
        with open_agent(SelectOptions(algo="ppo", env="Pendulum-v1", **flag)) as agent:
            assert agent.env.observation_space.shape == (12,)
            assert agent.env.get_attr("unwrapped")[0].g == 9.0
            again = [list(agent.episode(10_000 + i))[-1].info["episode"]["r"] for i in range(2)]
        assert again == pytest.approx(evaluated[row], rel=1e-5)  # that of the training run, which stepped with 2 others


def test_frame_stack_needs_what_it_was_trained_with():
    env = VecFrameStack(make_vec_env("Pendulum-v1"), 2)
    PPO("MlpPolicy", env, n_steps=16, batch_size=16).save("ppo")
    with pytest.raises(ConfigError, match=r"observation space of the model Box\(.*\(6,\).* of the environment Box\(.*\(3,\)"):
        open_agent(options("ppo"))


def test_off_policy_cannot_stack_normalised_observations():
    hyperparams = {"normalize": True, "frame_stack": 2, "buffer_size": 100}
    with pytest.raises(ConfigError, match="frame_stack: cannot be combined with normalize for sac"):
        train(TrainOptions(algo="sac", env="Pendulum-v1", n_timesteps=10, hyperparams=hyperparams))
    train(TrainOptions(algo="sac", env="Pendulum-v1", n_timesteps=10, hyperparams={**hyperparams, "normalize": False}, seed=0))
    with open_agent(SelectOptions(algo="sac", env="Pendulum-v1")) as agent:
        assert agent.model.observation_space.shape == (6,)
    with pytest.raises(ConfigError, match="frame_stack"):
        hyperparams = {"frame_stack": 2, "n_steps": 8}
        train(TrainOptions(algo="ppo", env="FrozenLake-v1", n_timesteps=10, hyperparams=hyperparams))


@pytest.mark.parametrize("algo", ["ppo", "redq"])
def test_images(algo):
    small = {"features_extractor_class": None} if algo == "redq" else {}
    model = saved(algo, "AgentImages-v0", "CnnPolicy", policy_kwargs={"net_arch": [8], **small})
    with open_agent(options(algo, "AgentImages-v0")) as agent:
        (first, *rest) = agent.episode(1)
    assert first.observation.shape == (3, 36, 40) and len(rest) == 4
    assert np.array_equal(first.action, model.predict(first.observation, deterministic=True)[0])


def test_hindsight_replay():
    kwargs = {"replay_buffer_class": HerReplayBuffer, "learning_starts": 20, "policy_kwargs": {"net_arch": [8]}}
    model = TD3("MultiInputPolicy", BitFlippingEnv(3, continuous=True), buffer_size=100, device="cpu", **kwargs).learn(30)
    model.save("td3")
    with open_agent(options("td3", "AgentBits-v0")) as agent:
        steps = list(agent.episode(1))
    assert len(steps) <= 3 and set(steps[0].observation) == {"observation", "achieved_goal", "desired_goal"}
    assert np.array_equal(steps[0].action, model.predict(steps[0].observation, deterministic=True)[0])


def test_dict_observations():
    model = saved("td3", "AgentPoints-v0", "MultiInputPolicy", policy_kwargs={"net_arch": [8]}, buffer_size=10)
    with open_agent(options("td3", "AgentPoints-v0")) as agent:
        steps = list(agent.episode(1))
    assert len(steps) == 5 and set(steps[0].observation) == {"a", "b"}
    assert np.array_equal(steps[0].action, model.predict(steps[0].observation, deterministic=True)[0])


def test_replay_buffers_are_not_made(small):
    saved("sac", "Pendulum-v1", n_steps=3, replay_buffer_kwargs={"handle_timeout_termination": False}, buffer_size=1_000_000)
    saved("symphony", "Pendulum-v1", n_steps=5)
    for algo in ("sac", "symphony"):
        with open_agent(options(algo)) as agent:
            assert agent.model.replay_buffer.observations.shape[0] == 1


def test_rewards_are_the_environments_own():
    env = VecNormalize(make_vec_env("Pendulum-v1", seed=0))
    model = PPO("MlpPolicy", env, n_steps=32, batch_size=32, seed=0).learn(64)
    model.save("ppo")
    env.save("ppo.pkl")
    totals = {}
    for norm_reward in (False, True):
        with open_agent(options("ppo", vecnormalize="ppo.pkl"), norm_reward=norm_reward) as agent:
            count = agent.env.obs_rms.count
            steps = list(agent.episode(4))
            assert agent.env.obs_rms.count == count  # frozen
        totals[norm_reward] = sum(step.reward for step in steps)
        assert steps[-1].info["episode"]["r"] == pytest.approx(totals[False], abs=1e-3)
    assert abs(totals[True]) < abs(totals[False]) / 2


def test_missing_statistics_are_noticed():
    message = r"ppo.zip: was trained with VecNormalize — expected its statistics as --vecnormalize FILE"
    old = options("ppo", model=str(OLD / "ppo.zip"))
    with pytest.raises(ConfigError, match=message):
        open_agent(old)
    open_agent(old.model_copy(update={"vecnormalize": "none"})).env.close()


def test_statistics_beside_a_model_are_mentioned(capsys):
    open_agent(options("sac", model=str(OLD / "sac.zip"))).env.close()
    assert "ppo_vecnormalize.pkl lies beside the model, --vecnormalize would use it" in capsys.readouterr().err
    open_agent(options("sac", model=str(OLD / "sac.zip"), vecnormalize="none")).env.close()
    assert "vecnormalize" not in capsys.readouterr().err


def test_pickles_are_mentioned_once_and_only_from_elsewhere(capsys, folder):
    agent_module._tell_of_pickles.cache_clear()
    train(TrainOptions(algo="ppo", env="Pendulum-v1", n_timesteps=10, hyperparams={"n_steps": 8, "n_envs": 1}, verbose=0))
    capsys.readouterr()
    open_agent(SelectOptions(algo="ppo", env="Pendulum-v1")).env.close()
    assert capsys.readouterr().err == ""
    (folder / "logs" / "ppo" / "Pendulum-v1_1" / "Pendulum-v1.zip").rename("ppo.zip")
    for _ in range(2):
        open_agent(options("ppo")).env.close()
    assert capsys.readouterr().err.count("pickle") == 1


def test_nothing_is_unpickled_before_the_file_is_known_to_be_of_the_algorithm(monkeypatch):
    saved("sac", "Pendulum-v1", policy_kwargs={"net_arch": [8]})
    monkeypatch.setattr(load_algorithm("td3"), "load", lambda *args, **kwargs: pytest.fail("loaded"))
    with pytest.raises(ConfigError, match="not a model of td3 — its policy is that of sac"):
        open_agent(options("td3", model="sac.zip"))


def damaged(path, how):
    content = path.read_bytes()
    if how == "cut":
        path.write_bytes(content[: len(content) // 2])
    elif how == "empty":
        path.write_bytes(b"")
    elif how == "text":
        path.write_text("no model")
    elif how == "flipped":
        middle = content.index(b"policy.pth") + 500
        path.write_bytes(
            content[:middle] + bytes(255 - byte for byte in content[middle : middle + 50]) + content[middle + 50 :]
        )
    else:
        with zipfile.ZipFile(path) as archive:
            members = {name: archive.read(name) for name in archive.namelist()}
        if how == "no data":
            del members["data"]
        elif how == "other json":
            members["data"] = b"[1, 2]"
        elif how == "no policy":
            del members["policy.pth"]
        elif how == "other weights":
            th.save({"weights": th.zeros(3)}, "weights.pth")
            members["policy.pth"] = Path("weights.pth").read_bytes()
        elif how == "bad pickle":
            data = json.loads(members["data"])
            data["observation_space"][":serialized:"] = "Z2FyYmFnZQ=="
            members["data"] = json.dumps(data).encode()
        with zipfile.ZipFile(path, "w") as archive:
            for name, member in members.items():
                archive.writestr(name, member)


@pytest.mark.filterwarnings("ignore:Could not deserialize")
@pytest.mark.parametrize(
    "how",
    ["cut", "empty", "text", "flipped", "no data", "other json", "no policy", "other weights", "bad pickle"],
)
def test_damaged_models(folder, how):
    saved("sac", "Pendulum-v1", policy_kwargs={"net_arch": [8]})
    damaged(folder / "sac.zip", how)
    with pytest.raises(ConfigError) as error:
        open_agent(options("sac"))
    assert str(error.value).startswith("sac.zip: ") and "\n" not in str(error.value)


@pytest.mark.parametrize("content", [b"", b"garbage", b"\x80\x04N."])
def test_damaged_statistics(folder, content):
    (folder / "bad.pkl").write_bytes(content)
    saved("sac", "Pendulum-v1", policy_kwargs={"net_arch": [8]})
    with pytest.raises(ConfigError, match=r"bad\.pkl: not statistics of VecNormalize, or damaged — "):
        open_agent(options("sac", vecnormalize="bad.pkl"))


def test_statistics_of_another_environment(folder):
    VecNormalize(make_vec_env("MountainCarContinuous-v0")).save("other.pkl")
    saved("sac", "Pendulum-v1", policy_kwargs={"net_arch": [8]})
    with pytest.raises(ConfigError, match=r"other\.pkl: statistics do not fit the environment"):
        open_agent(options("sac", vecnormalize="other.pkl"))


@pytest.mark.parametrize("env, what", [("MountainCarContinuous-v0", "observation"), ("CartPole-v1", "observation")])
def test_spaces_that_do_not_match(env, what):
    model = saved("sac", "Pendulum-v1", policy_kwargs={"net_arch": [8]})
    with pytest.raises(ConfigError) as error:
        open_agent(options("sac", env))
    message = str(error.value)
    assert f"does not fit {env}: {what} space of the model" in message
    for space in (model.observation_space, gym.make(env).observation_space):
        assert " ".join(str(space).split()) in message


def test_action_spaces_that_do_not_match():
    class Halved(gym.ActionWrapper):
        def __init__(self, env):
            super().__init__(env)
            self.action_space = gym.spaces.Box(-1, 1, (1,))

        def action(self, action):
            return 2 * action

    SAC("MlpPolicy", Halved(gym.make("Pendulum-v1")), policy_kwargs={"net_arch": [8]}).save("sac")
    with pytest.raises(ConfigError, match=r"action space of the model Box\(-1.* of the environment Box\(-2"):
        open_agent(options("sac"))


def test_other_mistakes(folder):
    saved("sac", "Pendulum-v1", policy_kwargs={"net_arch": [8]})
    for changes, message in (
        ({"gym_packages": ["no_such_module"]}, "--gym-packages: 'no_such_module' cannot be imported"),
        ({"gym_packages": ["./robots/my_env.py"]}, "no file: did you mean 'robots.my_env'?"),
        ({"device": "quantum"}, "--device: 'quantum' is not there"),
        ({"device": "meta"}, "--device: 'meta' is not there"),
        ({"env": "Pendulum-v9"}, "did you mean 'Pendulum-v1'"),
        ({"env_kwargs": {"gravity": 1}}, "gravity"),
    ):
        with pytest.raises(ConfigError, match=message):
            open_agent(options("sac", **changes))


def test_packages_that_register_environments(folder, monkeypatch):
    register = "gymnasium.register('MyRobot-v0', 'gymnasium.envs.classic_control:PendulumEnv', max_episode_steps=7)"
    (folder / "agents_robot.py").write_text(f"import gymnasium\n\n{register}\n")
    monkeypatch.syspath_prepend(str(folder))
    saved("sac", "Pendulum-v1", policy_kwargs={"net_arch": [8]})
    with open_agent(options("sac", "MyRobot-v0", gym_packages=["agents_robot"])) as agent:
        assert len(list(agent.episode(0))) == 7
    gym.registry.pop("MyRobot-v0")


def test_all_trained_algorithms_can_be_loaded():
    assert ALGORITHMS.keys() < LOADABLE.keys()
