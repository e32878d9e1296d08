"""Training episodes that act as evaluations do."""

import copy
import itertools

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.wrappers import TransformReward
from resume_helpers import assert_same_results
from stable_baselines3 import DQN, SAC, TD3
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_symphony import REDQ, Symphony
from sb3_symphony.common.callbacks import GreedyEpisodes
from sb3_symphony.common.checkpoint import ExactCheckpoints, newest_checkpoint
from sb3_symphony.common.noise import StickyActionNoise
from sb3_symphony.common.off_policy import ActsGreedily
from sb3_symphony.common.wrappers import RewardScale
from sb3_symphony.experiment.config import TrainOptions
from sb3_symphony.experiment.train import train

LENGTH = 5


class Fixed(gym.Env):
    """
    Episodes of five steps, whose observations are drawn; the reward is 1 before ``falls`` and 0 from there on.

    :param falls: steps that are rewarded, a number or one for each episode
    """

    observation_space = gym.spaces.Box(-1.0, 1.0, (2,))
    action_space = gym.spaces.Box(np.array([-1.0, 0.0], dtype=np.float32), np.array([1.0, 3.0], dtype=np.float32))

    def __init__(self, falls=LENGTH):
        self.falls = itertools.cycle(falls if isinstance(falls, list) else [falls])

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps, self.rewarded = 0, next(self.falls)
        return self.np_random.uniform(-1, 1, 2).astype(np.float32), {}

    def step(self, action):
        self.steps += 1
        reward = float(self.steps <= self.rewarded)
        return self.np_random.uniform(-1, 1, 2).astype(np.float32), reward, self.steps == LENGTH, False, {}


class Note(BaseCallback):
    """Whether each action, and what is stored of it, is that of an evaluation, for every environment."""

    def _init_callback(self):
        self.seen = []

    def _on_step(self):
        model = self.model
        greedy, _ = model.predict(model._last_obs, deterministic=True)
        matches = np.isclose(self.locals["actions"], greedy, atol=1e-6).all(axis=1)
        stored = np.isclose(self.locals["buffer_actions"], model.policy.scale_action(greedy), atol=1e-6).all(axis=1)
        assert (matches == stored).all()
        self.seen.append(matches.tolist())
        return True


SMALL = dict(batch_size=4, buffer_size=100, seed=0, device="cpu")
OURS = dict(SMALL, gradient_steps=2, policy_delay=1)


def noise():
    return StickyActionNoise(2, sigma=0.2, independent=0.1)


class GreedyTD3(ActsGreedily, TD3):
    pass


class GreedySAC(ActsGreedily, SAC):
    pass


ALGORITHMS = {
    "symphony": (Symphony, dict(OURS, action_noise=noise()), dict(actor_averaging=0.5)),
    "redq": (REDQ, OURS, dict(actor_averaging=0.5)),
    "td3": (GreedyTD3, dict(SMALL, action_noise=noise()), {}),
    "sac": (GreedySAC, SMALL, {}),
}


def make(algo, env, **kwargs):
    class_, common, policy_kwargs = ALGORITHMS[algo]
    return class_("MlpPolicy", env, policy_kwargs=dict(net_arch=[8], **policy_kwargs), **copy.deepcopy(common), **kwargs)


def greedy_steps(algo, env, steps, *callbacks, **kwargs):
    note = Note()
    make(algo, env, **kwargs).learn(steps, callback=[*callbacks, note])
    return note.seen


ALWAYS = (-1, 100)  # one noisy episode, one greedy one, from the first that has ended


def of_episodes(seen):
    """Whether each episode was greedy, from its first action to its last."""
    episodes = [[each[0] for each in seen[k : k + LENGTH]] for k in range(0, len(seen), LENGTH)]
    assert all(len(set(each)) == 1 for each in episodes)
    return [each[0] for each in episodes]


@pytest.mark.parametrize("algo", ALGORITHMS)
@pytest.mark.parametrize("in_row", [0, 1, 2])
def test_some_follow_each_noisy_one(algo, in_row):
    callback = GreedyEpisodes(ALWAYS, in_row=(in_row, 9), n_episodes=1)
    seen = greedy_steps(algo, Fixed(), 9 * LENGTH, callback, learning_starts=LENGTH + 2)
    # The first one is the warm-up, in the second learning starts
    assert of_episodes(seen) == [False, *(k % (in_row + 1) > 0 for k in range(8))]


def test_how_many_depends_on_what_recent_ones_return():
    """Means of two returns; below 2 none is greedy, below 4 one after each noisy one, then two."""
    returns = [5, 0, 1, 3, 3, 3, 5, 5, 5, 5, 5, 5, 0, 0, 5, 5]
    expected = [0, 0, 1, 0, 1, 0, 1, 1, 0, 1, 1, 0, 1, 0, 0, 1]
    callback = GreedyEpisodes((2, 4), in_row=(1, 2), n_episodes=2)
    seen = greedy_steps("symphony", Fixed(returns), len(returns) * LENGTH, callback, learning_starts=1)
    assert of_episodes(seen) == expected


def test_a_training_in_pieces_goes_on_alike():
    """Pieces that end within episodes, which go on."""
    callback, note = GreedyEpisodes(ALWAYS, in_row=(2, 9), n_episodes=1), Note()
    model, seen = make("symphony", Fixed(), learning_starts=1), []
    for _ in range(10):
        model.learn(LENGTH - 1, callback=[callback, note], reset_num_timesteps=False)
        seen += note.seen
    assert of_episodes(seen) == [False, True, True, False, True, True, False, True]


def test_without_the_callback_no_action_is_greedy():
    assert not any(each[0] for each in greedy_steps("symphony", Fixed(), 30, learning_starts=5))


@pytest.mark.parametrize("scaled", [False, True])
@pytest.mark.parametrize("falls, greedy", [(5, 5), (3, 5), (2, 4), (1, 3), (0, 2)])
def test_noise_comes_back_when_it_stalls(scaled, falls, greedy):
    """The mean of two of the environment's rewards is below 0.4 once both are 0."""
    env = RewardScale(Fixed(falls), scale=100.0) if scaled else Fixed(falls)
    callback = GreedyEpisodes(ALWAYS, (3, 9), stall_reward=0.4, stall_steps=2, n_episodes=1)
    seen = greedy_steps("symphony", env, 4 * LENGTH, callback, learning_starts=1)
    for k in range(LENGTH, len(seen), LENGTH):
        assert [each[0] for each in seen[k : k + LENGTH]] == [True] * greedy + [False] * (LENGTH - greedy)


@pytest.mark.parametrize("falls, greedy", [(5, 5), (1, 3)])
def test_rewards_that_are_normalized_do_not_count(falls, greedy):
    env = VecNormalize(make_vec_env(lambda: TransformReward(Fixed(falls), lambda reward: 100 * reward)), norm_obs=False)
    callback = GreedyEpisodes(ALWAYS, (3, 9), stall_reward=40, stall_steps=2, n_episodes=1)
    seen = greedy_steps("symphony", env, 4 * LENGTH, callback, learning_starts=1)
    for k in range(LENGTH, len(seen), LENGTH):
        assert [each[0] for each in seen[k : k + LENGTH]] == [True] * greedy + [False] * (LENGTH - greedy)


class Uneven(Fixed):
    """Its first episode is over after one step."""

    def step(self, action):
        *rest, done, truncated, info = super().step(action)
        first, self.first = getattr(self, "first", True), False
        return *rest, done or first, truncated, info


def test_each_environment_has_its_own_episodes():
    envs = make_vec_env(lambda: Fixed(), n_envs=1).envs[0], make_vec_env(Uneven, n_envs=1).envs[0]
    env = DummyVecEnv([lambda: envs[0], lambda: envs[1]])
    seen = greedy_steps("td3", env, 2 * 6 * LENGTH, GreedyEpisodes(ALWAYS, n_episodes=1), learning_starts=1)
    first, second = ([each[k] for each in seen] for k in range(2))
    assert of_episodes([[each] for each in first]) == [False, True] * 3
    assert of_episodes([[each] for each in second[1 : 1 + 5 * LENGTH]]) == [True, False, True, False, True]


def test_the_noise_goes_on_falling():
    """Its clock counts greedy steps too."""
    model = make("symphony", Fixed(), learning_starts=1)
    model.learn(20, callback=GreedyEpisodes(ALWAYS, n_episodes=1))
    assert model.action_noise.t == 20


def test_a_loaded_model_is_not_greedy_by_itself(tmp_path):
    model = make("symphony", Fixed(), learning_starts=1).learn(LENGTH + 1, callback=GreedyEpisodes(ALWAYS, n_episodes=1))
    assert model.greedy_envs.all()
    model.save(tmp_path / "model")
    note = Note()
    Symphony.load(tmp_path / "model", env=Fixed(), device="cpu").learn(10, callback=note, reset_num_timesteps=False)
    assert not any(each[0] for each in note.seen)


@pytest.mark.usefixtures("no_figures")
@pytest.mark.parametrize("algo", ["symphony", pytest.param("redq", marks=pytest.mark.slow)])
def test_a_killed_run_goes_on_alike(algo, tmp_path):
    common = dict(
        algo=algo,
        env="Pendulum-v1",
        seed=1,
        eval_freq=0,
        verbose=0,
        progress=False,
        num_threads=1,
        save_freq=100,
        hyperparams={
            "learning_starts": 50,
            "batch_size": 16,
            "gradient_steps": 2,
            "policy_delay": 3,
            "policy_kwargs": {"net_arch": [8], "actor_averaging": 0.125},
            "callback": {
                "GreedyEpisodes": {"returns": [-1500, -1200], "stall_reward": -5.0, "stall_steps": 30, "n_episodes": 2}
            },
        },
    )
    whole = train(TrainOptions(**common, n_timesteps=900, log_folder=str(tmp_path / "whole"))).run.path
    half = train(TrainOptions(**common, n_timesteps=500, log_folder=str(tmp_path / "half"))).run.path
    train(TrainOptions(resume=str(half), n_timesteps=900))
    assert_same_results(whole, half)


@pytest.mark.parametrize("first", [LENGTH + 1, LENGTH + 3, 2 * LENGTH])
def test_learning_in_two_parts(first):
    """An episode that has its noise back keeps it."""
    seen = []
    for parts in ([3 * LENGTH], [first, 3 * LENGTH - first]):
        model, note = make("symphony", Fixed(falls=0), learning_starts=1), Note()
        greedy = GreedyEpisodes(ALWAYS, (3, 9), stall_reward=0.4, stall_steps=2, n_episodes=1)
        steps = []
        for part in parts:
            model.learn(part, callback=[greedy, note], reset_num_timesteps=model.num_timesteps == 0)
            steps += note.seen
        seen.append(steps)
    assert seen[0] == seen[1] and len(seen[0]) == 3 * LENGTH


def test_an_earlier_callback_does_not_count():
    model, note = make("symphony", Fixed(), learning_starts=1), Note()
    model.learn(LENGTH + 2, callback=GreedyEpisodes(ALWAYS, n_episodes=1))
    assert model.greedy_envs.all()
    model.learn(2, callback=note, reset_num_timesteps=False)
    assert not any(each[0] for each in note.seen)


def test_fresh_episodes_of_a_resumed_run(tmp_path):
    """The given-up episode was greedy until it stalled: its rewards do not count, and another one is greedy in its place."""

    def parts():
        greedy = GreedyEpisodes(ALWAYS, (3, 9), stall_reward=0.4, stall_steps=2, n_episodes=1)
        return make("symphony", Fixed(falls=0), learning_starts=1), greedy

    model, greedy = parts()
    exact = ExactCheckpoints(tmp_path, LENGTH + 3, callbacks=[greedy])
    model.learn(LENGTH + 4, callback=[greedy, exact])  # a checkpoint is made when a rollout starts
    assert not model.greedy_envs.any() and list(greedy.rewards[0]) == [0, 0] and greedy.row == [1]

    model, greedy = parts()
    note = Note()
    exact = ExactCheckpoints(tmp_path, 100, callbacks=[greedy], checkpoint=newest_checkpoint(tmp_path))
    model.learn(2 * LENGTH + 3, callback=[greedy, exact, note])
    assert [each[0] for each in note.seen] == [True] * 2 + [False] * (LENGTH - 2)


@pytest.mark.parametrize(
    "kwargs, error",
    [
        (dict(in_row=(1, -1)), ValueError),
        (dict(in_row=(1.5, 3)), TypeError),
        (dict(stall_reward="no"), TypeError),
        (dict(stall_steps=0), ValueError),
        (dict(stall_reward=float("nan")), ValueError),
    ],
)
def test_wrong_values(kwargs, error):
    with pytest.raises(error, match=next(iter(kwargs))):
        GreedyEpisodes(ALWAYS, **kwargs)


def test_actions_may_be_discrete():
    class GreedyDQN(ActsGreedily, DQN):
        pass

    env = make_vec_env("CartPole-v1", n_envs=2, seed=0)
    model = GreedyDQN("MlpPolicy", env, learning_starts=20, exploration_fraction=1.0, exploration_final_eps=1.0, **SMALL)
    model.learn(40, callback=GreedyEpisodes(ALWAYS))
    greedy = model.predict(model._last_obs, deterministic=True)[0]
    model.greedy_envs = np.array([True, True])
    for _ in range(10):  # actions of chance without
        actions, stored = model._sample_action(0, n_envs=2)
        assert actions.tolist() == stored.tolist() == greedy.tolist()


def test_needs_an_algorithm_that_can():
    with pytest.raises(TypeError, match="got TD3"):
        TD3("MlpPolicy", Fixed(), **SMALL).learn(5, callback=GreedyEpisodes(ALWAYS))
