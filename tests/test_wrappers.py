import math

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.wrappers import TimeLimit
from stable_baselines3 import TD3
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_symphony.common.wrappers import (
    EpisodeStepLimit,
    FreshBox2DWorld,
    LearningReward,
    LegMass,
    RewardBonus,
    RewardFloor,
    RewardScale,
    StallPenalty,
    StrideBonus,
    TorsoMass,
    UnseenGoal,
    needs_fresh_world,
)


class Scripted(gym.Env):
    """Plays given rewards and observations; ends with the last one."""

    action_space = gym.spaces.Box(-1, 1, (1,))

    def __init__(self, rewards, observations=None):
        self.rewards = rewards
        self.observations = np.zeros((len(rewards) + 1, 2)) if observations is None else np.array(observations)
        self.observation_space = gym.spaces.Box(-np.inf, np.inf, self.observations.shape[1:], np.float64)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.step_count = 0
        return self.observations[0], {}

    def step(self, action):
        reward = self.rewards[self.step_count]
        self.step_count += 1
        return self.observations[self.step_count], reward, self.step_count == len(self.rewards), False, {}


class OneDictionary(Scripted):
    """Returns the same dictionary at every step."""

    def reset(self, *, seed=None, options=None):
        self.info = {}
        return super().reset(seed=seed, options=options)

    def step(self, action):
        return *super().step(action)[:4], self.info


def play(env, max_steps=1000):
    """Rewards, last flags and infos of one episode."""
    env.reset()
    rewards, infos = [], []
    for _ in range(max_steps):
        _, reward, terminated, truncated, info = env.step(np.zeros(1, dtype=np.float32))
        rewards.append(reward)
        infos.append(info)
        if terminated or truncated:
            break
    return rewards, terminated, truncated, infos


# Box2D ----------------------------------------------------------------------------------------------------------------


def roll(env, seed, n_steps=150):
    """Observations and rewards of one episode under actions that depend on the seed alone."""
    generator = np.random.default_rng(seed)
    trace = [np.append(env.reset(seed=seed)[0], 0.0)]
    for _ in range(n_steps):
        action = generator.uniform(-1, 1, env.action_space.shape).astype(np.float32)
        observation, reward, terminated, truncated, _ = env.step(action)
        trace.append(np.append(observation, reward))
        if terminated or truncated:
            break
    return np.array(trace)


@pytest.mark.parametrize("name", ["BipedalWalker-v3", "BipedalWalkerHardcore-v3", "LunarLanderContinuous-v3"])
def test_fresh_world_repeats_exactly(name):
    env = FreshBox2DWorld(gym.make(name))
    reused = [roll(env, seed) for seed in (0, 1, 0, 2)]
    fresh = [roll(gym.make(name), seed) for seed in (0, 1, 2)]
    for trace, expected in zip(reused, [fresh[0], fresh[1], fresh[0], fresh[2]], strict=True):
        np.testing.assert_array_equal(trace, expected)
    env.close()


def test_raw_walker_does_not_repeat():
    """Why the wrapper exists: the world of BipedalWalker outlives an episode. If this fails, Gymnasium has mended it."""
    env = gym.make("BipedalWalker-v3")
    traces = [roll(env, seed) for seed in (0, 1, 0)]
    assert not np.array_equal(traces[0], traces[2])


def test_fresh_world_keeps_gravity_and_unfinished_episodes_do_not_matter():
    env = FreshBox2DWorld(gym.make("LunarLanderContinuous-v3", gravity=-5.0))
    env.reset(seed=0)
    assert tuple(env.unwrapped.world.gravity) == (0, -5)
    env = FreshBox2DWorld(gym.make("BipedalWalker-v3"))
    expected = roll(env, 3)
    world = env.unwrapped.world
    roll(env, 4, n_steps=20)
    assert env.unwrapped.world is not world
    assert tuple(env.unwrapped.world.gravity) == tuple(world.gravity)
    assert len(world.bodies) == 0  # the old ones were destroyed
    np.testing.assert_array_equal(roll(env, 3), expected)


def test_needs_fresh_world():
    walker = gym.make("BipedalWalker-v3")
    assert needs_fresh_world(walker)
    assert not needs_fresh_world(FreshBox2DWorld(walker))
    assert not needs_fresh_world(Monitor(FreshBox2DWorld(walker)))
    pendulum = gym.make("Pendulum-v1")
    assert not needs_fresh_world(pendulum)
    with pytest.raises(TypeError, match="has no Box2D world"):
        FreshBox2DWorld(pendulum)


# Rewards for learning -------------------------------------------------------------------------------------------------


def test_simple_transforms():
    raw = [1.0, -100.0, -3.0, 5.0]
    for env, expected in (
        (RewardFloor(Scripted(raw)), [1, -10, -3, 5]),
        (RewardFloor(Scripted(raw), floor=-3.0), [1, -3, -3, 5]),
        (RewardScale(Scripted(raw), scale=0.1), [0.1, -10, -0.3, 0.5]),
        (RewardBonus(Scripted(raw)), [2, -99, -2, 6]),
        (RewardScale(RewardBonus(RewardFloor(Scripted(raw)), bonus=2.0), scale=3.0), [9, -24, -3, 21]),
    ):
        rewards, _, _, infos = play(env)
        assert rewards == pytest.approx(expected)
        assert [info["raw_reward"] for info in infos] == raw
        assert infos[-1]["episode"]["r"] == pytest.approx(sum(raw))  # the reported return is raw
        assert isinstance(env, LearningReward)


def test_stall_penalty():
    deltas = [0.01, 0.1, 0.3, 1.0, 3.0, 50.0]
    # Mean over dimensions of absolute changes: signs and dimensions differ
    steps = np.array([[1.5 * d, -0.5 * d] for d in deltas])
    observations = np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)])
    raw = [0.5] * len(deltas)
    env = StallPenalty(Scripted(raw, observations), coef=0.07, kind="B")
    expected = [-0.07, -0.07, -0.036601, 0, 0.033398, 0.07]
    for _ in range(2):  # the first step of an episode is compared with its own reset
        rewards, _, _, infos = play(env)
        np.testing.assert_allclose(np.array(rewards) - 0.5, expected, atol=1e-6)
        assert infos[-1]["episode"]["r"] == pytest.approx(3.0)
    rewards, *_ = play(StallPenalty(Scripted(raw, observations), coef=0.03, kind="A"))
    expected = [0.03 * (d - math.log(max(1 / (d + 1e-6), 1e-3))) for d in deltas]
    np.testing.assert_allclose(np.array(rewards) - 0.5, expected, atol=1e-9)
    rewards, *_ = play(StallPenalty(Scripted([0.0]), kind="A"))  # no change at all
    assert rewards == pytest.approx([0.07 * math.log(1e-6)])


def test_stride_bonus():
    # In front of the other by more than .25: nobody, first, nobody, first, second, nobody, second, first
    leads = [0.0, 0.3, 0.2, 0.4, -0.3, -0.2, -0.3, 0.26]
    observations = [[9.0, 1.0 + 0.1 + lead, 1.0] for lead in leads]
    env = StrideBonus(Scripted([0.5] * 7, observations), bonus=2.0, hips=(1, 2), offset=0.1, margin=0.25)
    for _ in range(2):  # an episode knows nothing of the one before
        rewards, _, _, infos = play(env)
        assert rewards == [0.5, 0.5, 0.5, 2.5, 0.5, 0.5, 2.5]
        assert infos[-1]["episode"]["r"] == pytest.approx(3.5)


def test_stride_bonus_by_width():
    # The first leg is in front by .4 at most, then the second by .3, then the first by .6: unpaid, not taken along
    observations = [[9.0, 1.0 + 0.1 + lead, 1.0] for lead in (0.0, 0.3, 0.4, -0.3, -0.2, 0.6)]
    env = StrideBonus(Scripted([0.5] * 5, observations), bonus=2.0, hips=(1, 2), offset=0.1, margin=0.25, per_radian=True)
    for _ in range(2):
        rewards, _, _, infos = play(env)
        assert rewards == pytest.approx([0.5, 0.5, 0.5 + 2 * 0.4, 0.5, 0.5 + 2 * 0.3])
        assert infos[-1]["episode"]["r"] == pytest.approx(2.5)


def test_stride_bonus_on_the_walker():
    """A leg that swings past the other earns it once; mirrored actions earn the same."""
    counts = []
    for legs_apart in ([1.0, -1.0, -1.0, 1.0], [-1.0, 1.0, 1.0, -1.0]):
        env = StrideBonus(gym.make("BipedalWalker-v3"), bonus=1.0)
        env.reset(seed=0)
        earned = []
        for sign in [1, -1, 1]:
            for _ in range(25):
                observation, reward, _, _, info = env.step(sign * np.array(legs_apart, dtype=np.float32))
                earned.append(reward - info["raw_reward"])
                legs = env.unwrapped.legs  # upper and lower, of either side
                apart = legs[0].angle - legs[2].angle
                assert observation[4] - observation[9] - env.offset == pytest.approx(apart, abs=1e-5)
        counts.append([round(sum(earned[i : i + 25]), 6) for i in (0, 25, 50)])
    assert counts == [[0, 1, 1]] * 2


@pytest.mark.parametrize(
    "last, penalty, expected", [(0.5, -100, (False, True)), (-100.0, -100, (True, False)), (-20.0, -20, (True, False))]
)
@pytest.mark.parametrize("around", [lambda env: env, RewardFloor])
@pytest.mark.parametrize("inside", [lambda env: env, RewardFloor])
def test_unseen_goal(last, penalty, expected, around, inside):
    env = around(UnseenGoal(inside(Scripted([1.0, -2.0, last])), penalty=penalty))
    rewards, terminated, truncated, infos = play(env)
    assert (terminated, truncated) == expected and len(rewards) == 3
    assert infos[-1]["episode"]["r"] == pytest.approx(-1 + last)


def test_sb3_bootstraps_through_the_goal_and_not_through_a_fall():
    for last, timeout in ((0.5, 1), (-100.0, 0)):
        model = TD3("MlpPolicy", UnseenGoal(Scripted([1.0, last])), learning_starts=100, buffer_size=50, seed=0, device="cpu")
        buffer = model.learn(4).replay_buffer
        assert buffer.dones[:4, 0].tolist() == [0, 1, 0, 1]
        assert buffer.timeouts[:4, 0].tolist() == [0, timeout, 0, timeout]


def test_learning_reward_keeps_one_monitor():
    monitored = Monitor(Scripted([1.0]))
    assert RewardFloor(monitored).env is monitored
    outer = RewardScale(RewardFloor(Scripted([1.0])), scale=2.0)
    assert isinstance(outer.env, RewardFloor) and isinstance(outer.env.env, Monitor)


def test_wrong_reward_values():
    env = Scripted([1.0])
    for make, message in (
        (lambda: RewardFloor(env, floor=float("nan")), "floor=nan"),
        (lambda: RewardBonus(env, bonus=float("inf")), "bonus=inf"),
        (lambda: UnseenGoal(env, penalty=float("nan")), "penalty=nan"),
        (lambda: RewardScale(env, scale=0.0), r"scale=0\.0"),
        (lambda: StallPenalty(env, coef=-1.0), r"coef=-1\.0"),
        (lambda: StallPenalty(env, kind="C"), "kind='C'"),
        (lambda: StrideBonus(env, bonus=float("nan")), "bonus=nan"),
        (lambda: StrideBonus(env, hips=(0, 2)), "hips=2: expected an integer >= 0 and <= 1"),
        (lambda: StrideBonus(env, hips=(0,)), r"hips=\(0,\): expected two numbers"),
        (lambda: StrideBonus(env, hips=(1, 1)), r"hips=\(1, 1\): expected two different indices"),
        (lambda: StrideBonus(env, hips=(0, 1), margin=-0.1), r"margin=-0\.1"),
        (lambda: StrideBonus(env, hips=(0, 1), per_radian="yes"), "per_radian='yes'"),
    ):
        with pytest.raises(ValueError, match=message):
            make()
    env.observation_space = gym.spaces.Dict({"a": gym.spaces.Box(0, 1)})
    for wrapper in (StallPenalty, StrideBonus):
        with pytest.raises(TypeError, match="Box observation space"):
            wrapper(env)


@pytest.mark.parametrize("through_make_vec_env", [False, True])
def test_sb3_learns_the_transform_and_reports_the_raw_return(through_make_vec_env):
    if through_make_vec_env:
        env = make_vec_env(
            lambda: Scripted([1.0, -2.0, -100.0]), wrapper_class=RewardFloor, wrapper_kwargs=dict(floor=-5.0), n_envs=1
        )
    else:
        env = RewardFloor(Scripted([1.0, -2.0, -100.0]), floor=-5.0)
    model = TD3("MlpPolicy", env, learning_starts=100, buffer_size=50, seed=0, device="cpu").learn(12)
    assert model.replay_buffer.rewards[:12, 0].tolist() == [1, -2, -5] * 4
    assert [info["r"] for info in model.ep_info_buffer] == [-101] * 4


# Tasks ----------------------------------------------------------------------------------------------------------------


def test_episode_step_limit():
    env = EpisodeStepLimit(Scripted([1.0] * 12), max_steps=5, until_total_steps=10)
    lengths = []
    for _ in range(4):
        rewards, terminated, truncated, _ = play(env)
        lengths.append((len(rewards), terminated, truncated))
    # Steps 1-5 and 6-10 are cut, the last of them being the tenth in all; then episodes are left alone
    assert lengths == [(5, False, True), (5, False, True), (12, True, False), (12, True, False)]
    assert env.total_steps == 34
    env = EpisodeStepLimit(Scripted([1.0] * 12), max_steps=5, until_total_steps=9)
    assert [len(play(env)[0]) for _ in range(2)] == [5, 12]  # the second would have been cut at step 10 in all
    env = EpisodeStepLimit(Scripted([1.0] * 3), max_steps=5, until_total_steps=10)
    assert play(env)[1:3] == (True, False)


def test_episode_step_limit_as_time_limit():
    """The same flags and the same `TimeLimit.truncated` in SB3's vectorised environments as Gymnasium's own limit."""

    def record(wrapper):
        env = DummyVecEnv([lambda: wrapper(Scripted([1.0] * 5))])
        env.reset()
        steps = [env.step(np.zeros((1, 1))) for _ in range(12)]
        return [(bool(dones[0]), infos[0]["TimeLimit.truncated"]) for _, _, dones, infos in steps]

    for limit in (3, 5):
        ours = record(lambda env, limit=limit: EpisodeStepLimit(env, limit, 1000))
        assert ours == record(lambda env, limit=limit: TimeLimit(env, limit))


@pytest.mark.parametrize("between", [lambda env: env, RewardFloor])
def test_episode_step_limit_reports_cut_episodes(between):
    env = EpisodeStepLimit(between(Monitor(Scripted([1.0] * 12))), max_steps=5, until_total_steps=10)
    reports = [play(env)[3][-1]["episode"] for _ in range(3)]
    assert [(report["r"], report["l"]) for report in reports] == [(5, 5), (5, 5), (12, 12)]
    assert env.total_steps == 22


def test_episode_step_limit_refusals():
    for kwargs in (dict(max_steps=0, until_total_steps=5), dict(max_steps=5, until_total_steps=-1)):
        with pytest.raises(ValueError, match="expected an integer"):
            EpisodeStepLimit(Scripted([1.0]), **kwargs)


def hopper(name):
    pytest.importorskip("mujoco")
    return gym.make(name)


@pytest.mark.filterwarnings("ignore:.*out of date.*:DeprecationWarning")
@pytest.mark.parametrize("name", ["Hopper-v4", "Hopper-v5"])
def test_torso_mass(name):
    original = hopper(name)
    mass = float(original.unwrapped.model.body("torso").mass[0])
    reference = roll(original, 0)
    np.testing.assert_array_equal(roll(TorsoMass(hopper(name), mass=mass), 0), reference)  # its own mass: no change
    env = TorsoMass(hopper(name), mass=2 * mass)
    heavy = roll(env, 0)
    assert not np.array_equal(heavy[:5], reference[:5])
    for _ in range(2):
        np.testing.assert_array_equal(roll(env, 0), heavy)
        assert float(env.unwrapped.model.body("torso").mass[0]) == 2 * mass
    assert env.unwrapped.model.body_subtreemass[0] == pytest.approx(
        original.unwrapped.model.body_subtreemass[0] + mass  # what MuJoCo derives from it follows
    )


@pytest.mark.filterwarnings("ignore:.*out of date.*:DeprecationWarning")
def test_torso_mass_drawn_for_each_episode():
    env = TorsoMass(hopper("Hopper-v4"), mass=(2.0, 10.0))
    masses = []
    for _ in range(200):
        env.reset()
        masses.append(env.mass)
        assert float(env.unwrapped.model.body("torso").mass[0]) == env.mass
    assert min(masses) < 2.5 and max(masses) > 9.5 and abs(np.mean(masses) - 6) < 0.6  # 3.7 standard errors
    first = roll(env, 7)  # an episode depends on its seed alone
    drawn = env.mass
    roll(env, 8)
    assert env.mass != drawn
    np.testing.assert_array_equal(roll(env, 7), first)
    assert env.mass == drawn
    np.testing.assert_array_equal(roll(TorsoMass(hopper("Hopper-v4"), mass=drawn), 7), first)


def test_torso_mass_refusals():
    with pytest.raises(TypeError, match="not a MuJoCo environment"):
        TorsoMass(gym.make("Pendulum-v1"), mass=3.0)
    with pytest.raises(TypeError, match="no body named 'torso'"):
        TorsoMass(hopper("Reacher-v5"), mass=3.0)
    for mass in (0.0, -1.0, float("nan")):
        with pytest.raises(ValueError, match=f"mass={mass!r}"):
            TorsoMass(gym.make("Pendulum-v1"), mass=mass)
    for masses in ((5.0, 3.0), (1.0, 2.0, 3.0), (0.0, 3.0)):
        with pytest.raises(ValueError, match="mass="):
            TorsoMass(hopper("Hopper-v4"), mass=masses)


def test_leg_mass():
    def walker():
        return FreshBox2DWorld(gym.make("BipedalWalker-v3"))

    def masses(env, episodes):
        for seed in range(episodes):
            env.reset(seed=seed)
        return np.array([body.mass for body in [env.unwrapped.hull, *env.unwrapped.legs]])

    own = masses(walker(), 1)
    np.testing.assert_allclose(masses(LegMass(walker(), 1.5), 3), own * [1, 1.5, 1.5, 1.5, 1.5], rtol=1e-6)  # not 1.5 ** 3
    np.testing.assert_array_equal(roll(LegMass(walker(), 1.0), 0), roll(walker(), 0))
    assert not np.array_equal(roll(LegMass(walker(), 1.2), 0), roll(walker(), 0))
    for env in (gym.make("Pendulum-v1"), gym.make("LunarLander-v3")):
        with pytest.raises(TypeError, match="is not a BipedalWalker"):
            LegMass(env, 1.5)
    for factor in (0.0, -1.0, float("nan")):
        with pytest.raises(ValueError, match="factor"):
            LegMass(walker(), factor)


def test_raw_reward_of_an_environment_that_keeps_its_dictionary():
    env = UnseenGoal(RewardScale(OneDictionary([1.0, 2.0, -100.0]), 0.5))
    env.reset()
    seen = []
    for _ in range(3):
        *_, terminated, truncated, info = env.step([0])
        seen.append((info["raw_reward"], terminated, truncated))
    assert seen == [(1.0, False, False), (2.0, False, False), (-100.0, True, False)]
