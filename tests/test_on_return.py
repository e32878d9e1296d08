"""Noise, learning rates and target entropies that follow the returns of training episodes."""

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3 import PPO, SAC, TD3
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.vec_env import DummyVecEnv, VecMonitor

from sb3_symphony import REDQ, Symphony
from sb3_symphony.common.callbacks import EntropyOnReturn, GreedyEpisodes, QuietOnReturn, SlowOnReturn
from sb3_symphony.common.noise import StickyActionNoise
from sb3_symphony.common.wrappers import RewardScale

NEEDED = {EntropyOnReturn: dict(target_entropies=(-3, -7))}  # arguments without a default
RETURNS = [0, 20, 100, 150, 200, 300, 400, 60]


class Returns(gym.Env):
    """Episodes of two steps that return, one after the other, what they are told to."""

    observation_space = gym.spaces.Box(-1.0, 1.0, (2,))
    action_space = gym.spaces.Box(-1.0, 1.0, (1,))
    episode = -1

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.episode, self.steps = self.episode + 1, 0
        return np.zeros(2, dtype=np.float32), {}

    def step(self, action):
        self.steps += 1
        done = self.steps == 2
        return np.zeros(2, dtype=np.float32), RETURNS[self.episode % len(RETURNS)] if done else 0.0, done, False, {}


class Note(BaseCallback):
    """What the noise is at each step."""

    def _init_callback(self):
        self.seen = []

    def _on_step(self):
        noise = self.model.action_noise
        self.seen.append([each.independent for each in getattr(noise, "noises", [noise])])
        return True


class NoteRates(BaseCallback):
    """The learning rates of the optimizers after each step's update."""

    def _init_callback(self):
        self.seen = []

    def _on_rollout_start(self):
        optimizers = [self.model.actor.optimizer, self.model.critic.optimizer, getattr(self.model, "ent_coef_optimizer", None)]
        self.seen.append([each.param_groups[0]["lr"] for each in optimizers if each is not None])

    def _on_step(self):
        return True


def td3(env, **kwargs):
    noise = StickyActionNoise(1, independent=0.3)
    return TD3("MlpPolicy", env, action_noise=noise, learning_starts=100, buffer_size=100, seed=0, device="cpu", **kwargs)


def expected(n_recent, before=0.3):
    """Noise after 1, 2, … episodes."""
    means = [np.mean(RETURNS[max(n - n_recent, 0) : n]) for n in range(1, len(RETURNS) + 1)]
    values = np.interp(means, (50, 250), (0.2, 0.05))
    return [before] * (n_recent - 1) + list(values[n_recent - 1 :])


@pytest.mark.parametrize("n_recent", [1, 3])
@pytest.mark.parametrize("scaled", [False, True])
def test_noise_follows_the_reported_returns(n_recent, scaled):
    env = RewardScale(Returns(), scale=0.01) if scaled else Returns()
    note = Note()
    td3(env).learn(17, callback=[QuietOnReturn((50, 250), n_episodes=n_recent), note])
    after_episodes = [seen[0] for seen in note.seen[2::2]]  # SB3 notes an episode after the callback of its last step
    assert after_episodes == pytest.approx(expected(n_recent))
    assert note.seen[0] == note.seen[1] == [0.3]


def test_every_environment_gets_it():
    note = Note()
    model = td3(make_vec_env(Returns, n_envs=2))
    model.learn(2 * 17, callback=[QuietOnReturn((50, 250), n_episodes=2), note])
    # Both environments end alike episodes in the same step
    assert [seen[0] for seen in note.seen[2::2]] == pytest.approx(expected(1))
    assert all(first == second for first, second in note.seen)


def test_goes_on_alike_from_a_file(tmp_path):
    whole, rest = Note(), Note()
    td3(Returns()).learn(16, callback=[QuietOnReturn((50, 250), n_episodes=3), whole])
    env = Returns()
    half = td3(env).learn(8, callback=QuietOnReturn((50, 250), n_episodes=3))
    half.save(tmp_path / "half")
    loaded = TD3.load(tmp_path / "half", env=env, device="cpu")
    assert loaded.action_noise.independent == half.action_noise.independent
    env.episode -= 1  # learn() resets the environment once more
    loaded.learn(8, callback=[QuietOnReturn((50, 250), n_episodes=3), rest], reset_num_timesteps=False)
    assert rest.seen == whole.seen[8:]


SMALL = dict(learning_starts=1, batch_size=2, policy_kwargs=dict(net_arch=[4]), buffer_size=100, seed=0, device="cpu")
SYMPHONY = dict(SMALL, gradient_steps=1, initial_gradient_steps=(0, 0), episode_gradient_steps=0)


def factors(before=1.0, after=0.2):
    """What rates are multiplied with after 1, 2, … episodes: geometric between the two."""
    shares = np.clip((np.array(RETURNS) - 50) / 200, 0, 1)
    return before ** (1 - shares) * after**shares


@pytest.mark.parametrize(
    "make, rates",
    [
        (lambda: Symphony("MlpPolicy", Returns(), learning_rate=1e-3, critic_learning_rate=2e-3, **SYMPHONY), [1e-3, 2e-3]),
        (lambda: Symphony("MlpPolicy", Returns(), learning_rate=1e-3, critic_learning_rate=None, **SYMPHONY), [1e-3, 1e-3]),
        (lambda: REDQ("MlpPolicy", Returns(), learning_rate=1e-3, gradient_steps=1, **SMALL), [1e-3] * 3),
        (lambda: TD3("MlpPolicy", Returns(), learning_rate=1e-3, policy_delay=1, **SMALL), [1e-3] * 2),
    ],
    ids=["symphony", "symphony, one rate", "redq", "td3"],
)
@pytest.mark.parametrize("of_factors", [(1.0, 0.2), (2.0, 0.5)])
def test_rates_follow_the_reported_returns(make, rates, of_factors):
    note = NoteRates()
    make().learn(17, callback=[SlowOnReturn((50, 250), of_factors, n_episodes=1), note])
    # SB3 notes an episode after the callback of its last step: rates are those after the step behind it
    after_episodes = np.array(note.seen[3::2])
    assert after_episodes == pytest.approx(np.outer(factors(*of_factors), rates)[: len(after_episodes)])
    assert len(after_episodes) == 7 and note.seen[2] == pytest.approx(rates)


def test_a_schedule_goes_on_falling():
    note = NoteRates()
    td3_ = TD3("MlpPolicy", Returns(), learning_rate=lambda remaining: 1e-3 * remaining, policy_delay=1, **SMALL)
    td3_.learn(16, callback=[SlowOnReturn((50, 250), n_episodes=1), note])
    steps = np.arange(3, 16, 2)  # the second half of an episode is 2, 4, … steps after the start
    expected_rates = factors()[: len(steps)] * 1e-3 * (1 - steps / 16)
    assert [seen[0] for seen in note.seen[3::2]] == pytest.approx(expected_rates)


def test_a_second_training_starts_with_the_given_rates():
    note = NoteRates()
    model = TD3("MlpPolicy", Returns(), learning_rate=1e-3, policy_delay=1, **SMALL)
    model.learn(16, callback=SlowOnReturn((50, 250), n_episodes=1))
    model.learn(4, callback=note, reset_num_timesteps=False)
    assert note.seen[-1] == pytest.approx([1e-3] * 2)


def in_one_and_in_two(make, callback, note, tmp_path):
    """What is noted in eight episodes, and in the last four of them where the model comes from a file in between."""
    whole, rest = note(), note()
    make(Returns()).learn(16, callback=[callback(), whole])
    env = Returns()
    half = make(env).learn(8, callback=callback())
    half.save(tmp_path / "half")
    half.save_replay_buffer(tmp_path / "buffer")
    loaded = type(half).load(tmp_path / "half", env=env, device="cpu")
    loaded.load_replay_buffer(tmp_path / "buffer")
    env.episode -= 1  # learn() resets the environment once more
    loaded.learn(8, callback=[callback(), rest], reset_num_timesteps=False)
    return whole.seen, rest.seen


def test_rates_go_on_alike_from_a_file(tmp_path):
    def model(env):
        return Symphony("MlpPolicy", env, learning_rate=1e-3, critic_learning_rate=2e-3, **SYMPHONY)

    whole, rest = in_one_and_in_two(model, lambda: SlowOnReturn((50, 250), n_episodes=3), NoteRates, tmp_path)
    assert rest == whole[8:] and len(rest) == 8
    assert len({critic for _, critic in rest}) > 2


class NoteEntropy(BaseCallback):
    """The target entropy before each step, which is that of the updates before it."""

    def _init_callback(self):
        self.seen = []

    def _on_rollout_start(self):
        self.seen.append(self.model.target_entropy)

    def _on_step(self):
        return True


def entropic(algorithm, env, **kwargs):
    return algorithm("MlpPolicy", env, gradient_steps=1, target_entropy=-2, **kwargs, **SMALL)


@pytest.mark.parametrize("algorithm", [REDQ, SAC])
@pytest.mark.parametrize("targets", [(-3, -7), (-7, -3)])
def test_target_entropy_follows_the_reported_returns(algorithm, targets):
    note = NoteEntropy()
    entropic(algorithm, Returns()).learn(17, callback=[EntropyOnReturn((50, 250), targets, n_episodes=1), note])
    after_episodes = note.seen[3::2]
    assert after_episodes == pytest.approx(np.interp(RETURNS, (50, 250), targets)[: len(after_episodes)])
    assert len(after_episodes) == 7 and note.seen[:3] == [-2] * 3


def test_the_coefficient_follows_the_target_entropy():
    def coefficient(targets):
        model = entropic(REDQ, Returns(), learning_rate=1e-2, policy_delay=1)
        model.learn(60, callback=EntropyOnReturn((-2, -1), targets, n_episodes=1))  # reached by every episode
        return float(model.log_ent_coef.detach().exp())

    # One action that is uniform in [-1, 1] has an entropy of ln 2 nats: more is out of reach, -7 far below it
    assert coefficient((0, 2)) > 1.2 > 0.8 > coefficient((0, -7))


def test_target_entropy_goes_on_alike_from_a_file(tmp_path):
    def callback():
        return EntropyOnReturn((50, 250), (-3, -7), n_episodes=3)

    whole, rest = in_one_and_in_two(lambda env: entropic(REDQ, env), callback, NoteEntropy, tmp_path)
    assert rest == whole[8:] and len(rest) == 8
    assert len(set(rest)) > 2


def test_refuses_a_model_without_target_entropy():
    fixed = entropic(SAC, Returns(), ent_coef=0.1)
    for other in (td3(Returns()), fixed, PPO("MlpPolicy", Returns(), device="cpu")):
        with pytest.raises(TypeError, match=f"expected one that learns its ent_coef.* got {type(other).__name__}"):
            other.learn(3, callback=EntropyOnReturn((0, 1), (-3, -7)))


@pytest.mark.parametrize("callback", [QuietOnReturn, SlowOnReturn, EntropyOnReturn, GreedyEpisodes])
@pytest.mark.parametrize(
    "arguments, message",
    [
        (dict(returns=(100,)), r"returns=\(100,\): expected two numbers"),
        (dict(returns=(250, 100)), r"returns=\(250, 100\): expected the smaller number first"),
        (dict(returns=(0, float("nan"))), "returns=nan"),
        (dict(returns=(0, 1), n_episodes=0), "n_episodes=0: expected an integer >= 1"),
    ],
)
def test_wrong_values(callback, arguments, message):
    with pytest.raises(ValueError, match=message):
        callback(**arguments, **NEEDED.get(callback, {}))


def test_wrong_values_of_their_own():
    with pytest.raises(ValueError, match=r"independent=-0\.1: expected a number >= 0"):
        QuietOnReturn((0, 1), independent=(0.2, -0.1))
    with pytest.raises(ValueError, match="factors=0: expected a number > 0"):
        SlowOnReturn((0, 1), factors=(1, 0))
    with pytest.raises(ValueError, match=r"target_entropies=\(-3,\): expected two numbers"):
        EntropyOnReturn((0, 1), (-3,))


def test_refuses_other_noise():
    model = TD3("MlpPolicy", Returns(), action_noise=NormalActionNoise(np.zeros(1), np.ones(1)), device="cpu")
    for other in (model, TD3("MlpPolicy", Returns(), device="cpu"), PPO("MlpPolicy", Returns(), device="cpu")):
        with pytest.raises(TypeError, match="expected a StickyActionNoise"):
            other.learn(3, callback=QuietOnReturn((0, 1)))


@pytest.mark.parametrize("callback", [QuietOnReturn, SlowOnReturn, EntropyOnReturn, GreedyEpisodes])
def test_needs_returns(callback):
    """SB3 puts no monitor around what is a VecEnv already."""
    env, made = DummyVecEnv([Returns]), callback((50, 250), **NEEDED.get(callback, {}))
    with pytest.raises(ValueError, match=f"{callback.__name__}: expected an environment with a Monitor"):
        td3(env).learn(10, callback=made)
    if callback is SlowOnReturn:
        td3(VecMonitor(env)).learn(10, callback=made)


@pytest.mark.parametrize("callback", [QuietOnReturn, SlowOnReturn, EntropyOnReturn, GreedyEpisodes])
def test_more_episodes_than_are_kept(callback):
    with pytest.raises(ValueError, match="n_episodes=5: expected at most the model's stats_window_size, 3"):
        td3(Returns(), stats_window_size=3).learn(10, callback=callback((50, 250), **NEEDED.get(callback, {})))
