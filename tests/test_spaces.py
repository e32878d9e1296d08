"""Dict observations, images, frame stacks, and spaces that must be refused."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import DictReplayBuffer
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.envs import FakeImageEnv, SimpleMultiObsEnv
from stable_baselines3.common.torch_layers import CombinedExtractor, NatureCNN
from stable_baselines3.common.vec_env import DummyVecEnv, VecFrameStack

from sb3_symphony import REDQ, DroQ, Symphony
from sb3_symphony.common.buffers import FadingDictReplayBuffer
from sb3_symphony.common.regression import CriticRegression, FusedRegression


class RandomEnv(gym.Env):
    """Random observations and rewards; episodes of 10 steps, ended by a time limit."""

    def __init__(self, observation_space: spaces.Space, action_space: spaces.Space | None = None) -> None:
        self.observation_space = observation_space
        self.action_space = spaces.Box(-1, 1, (2,)) if action_space is None else action_space
        self.steps = 0

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[Any, dict]:
        super().reset(seed=seed)
        if seed is not None:
            self.observation_space.seed(seed)
        self.steps = 0
        return self.observation_space.sample(), {}

    def step(self, action: np.ndarray) -> tuple[Any, float, bool, bool, dict]:
        self.steps += 1
        return self.observation_space.sample(), float(self.np_random.normal()), False, self.steps >= 10, {}


IMAGE = spaces.Box(0, 255, (36, 36, 1), np.uint8)
VECTORS = spaces.Dict(position=spaces.Box(-1, 1, (3,)), gripper=spaces.Box(0, 1, (2, 2)), mode=spaces.Discrete(3))
MIXED = spaces.Dict(image=IMAGE, vector=spaces.Box(-1, 1, (4,)))
SMALL_CNN = dict(features_extractor_kwargs=dict(features_dim=8))


def weights(module: th.nn.Module) -> th.Tensor:
    return th.nn.utils.parameters_to_vector(module.parameters()).detach().clone()


# ---------------------------------------------------------------- Dict


@pytest.mark.parametrize("n_envs", [1, 2])
@pytest.mark.parametrize("share_features_extractor", [False, True])
def test_dict_observations(make, algorithm, tmp_path, n_envs, share_features_extractor):
    env = DummyVecEnv([lambda: RandomEnv(VECTORS)] * n_envs)
    policy_kwargs = dict(share_features_extractor=share_features_extractor)
    model = make(env, policy="MultiInputPolicy", policy_kwargs=policy_kwargs, gradient_steps=2)
    assert type(model.replay_buffer) is (FadingDictReplayBuffer if algorithm is Symphony else DictReplayBuffer)
    assert isinstance(model.actor.features_extractor, CombinedExtractor)
    before = weights(model.critic)
    model.learn(60)
    assert not th.equal(weights(model.critic), before)
    model.save(tmp_path / "model")
    loaded = algorithm.load(tmp_path / "model", env=env)
    observation = {key: np.asarray(value) for key, value in VECTORS.sample().items()}
    np.testing.assert_array_equal(
        model.predict(observation, deterministic=True)[0], loaded.predict(observation, deterministic=True)[0]
    )
    loaded.learn(40, reset_num_timesteps=False)


def test_dict_with_images(make):
    env = DummyVecEnv([lambda: RandomEnv(MIXED)])
    policy_kwargs = dict(features_extractor_kwargs=dict(cnn_output_dim=8))
    model = make(env, policy="MultiInputPolicy", policy_kwargs=policy_kwargs, buffer_size=100)
    model.learn(40)
    assert th.isfinite(weights(model.policy)).all()


def test_sb3_multi_input_env(make):
    env = make_vec_env(lambda: SimpleMultiObsEnv(random_start=False, discrete_actions=False, channel_last=False), n_envs=2)
    policy_kwargs = dict(features_extractor_kwargs=dict(cnn_output_dim=8))
    make(env, policy="MultiInputPolicy", policy_kwargs=policy_kwargs, buffer_size=200).learn(50)


def test_dict_needs_its_policy(make):
    with pytest.raises(ValueError, match="MultiInputPolicy"):
        make(DummyVecEnv([lambda: RandomEnv(VECTORS)]), policy="MlpPolicy")


def test_dict_frame_stack(make):
    env = VecFrameStack(DummyVecEnv([lambda: RandomEnv(spaces.Dict(vector=spaces.Box(-1, 1, (3,))))] * 2), n_stack=3)
    model = make(env, policy="MultiInputPolicy")
    assert model.observation_space["vector"].shape == (9,)
    model.learn(50)


def test_dict_and_n_steps_are_refused(make):
    with pytest.raises(ValueError, match=r"n_steps=3.*Dict"):
        make(DummyVecEnv([lambda: RandomEnv(VECTORS)]), policy="MultiInputPolicy", n_steps=3)


# ---------------------------------------------------------------- images


@pytest.mark.parametrize("share_features_extractor", [False, True])
def test_images(make, algorithm, tmp_path, share_features_extractor):
    policy_kwargs = dict(share_features_extractor=share_features_extractor, **SMALL_CNN)
    env = FakeImageEnv(screen_height=36, screen_width=36, n_channels=1, discrete=False)
    model = make(env, policy="CnnPolicy", policy_kwargs=policy_kwargs, buffer_size=100)
    assert isinstance(model.actor.features_extractor, NatureCNN)
    assert (model.critic.features_extractor is model.actor.features_extractor) == share_features_extractor
    assert model.critic_target.features_extractor is not model.critic.features_extractor
    before = [weights(module) for module in (model.actor, model.critic, model.critic_target)]
    model.learn(40)
    for module, old in zip((model.actor, model.critic, model.critic_target), before, strict=True):
        assert not th.equal(weights(module), old)
    model.save(tmp_path / "model")
    loaded = algorithm.load(tmp_path / "model")
    observation = model.observation_space.sample()
    np.testing.assert_array_equal(
        model.predict(observation, deterministic=True)[0], loaded.predict(observation, deterministic=True)[0]
    )


def test_images_channel_last_and_frame_stack(make):
    env = VecFrameStack(DummyVecEnv([lambda: RandomEnv(IMAGE)] * 2), n_stack=2, channels_order="last")
    model = make(env, policy="CnnPolicy", policy_kwargs=SMALL_CNN, buffer_size=100)
    assert model.observation_space.shape == (2, 36, 36)  # SB3 puts the channels first
    model.learn(40)


@pytest.mark.parametrize("normalize_images", [True, False])
def test_images_are_scaled_once(make, normalize_images):
    space = spaces.Box(0, 255, (1, 36, 36), np.uint8) if normalize_images else spaces.Box(0, 1, (1, 36, 36), np.float32)
    kwargs = dict(normalized_image=not normalize_images, features_dim=8)
    policy_kwargs = dict(normalize_images=normalize_images, features_extractor_kwargs=kwargs)
    model = make(RandomEnv(space), policy="CnnPolicy", policy_kwargs=policy_kwargs, buffer_size=50)
    seen = []
    for module in (model.actor, model.critic, model.critic_target):
        module.features_extractor.register_forward_pre_hook(lambda module, args: seen.append(args[0]))
    model.learn(25)
    assert seen and all(0 <= each.min() and 0.5 < each.max() <= 1 for each in seen)


def test_shared_extractor_is_not_trained_by_the_critics(make):
    """Its parameters are the actor's; the critics' optimizer does not have them, and they change with the actor only."""
    env = FakeImageEnv(screen_height=36, screen_width=36, n_channels=1, discrete=False)
    policy_kwargs = dict(share_features_extractor=True, **SMALL_CNN)
    model = make(env, policy="CnnPolicy", policy_kwargs=policy_kwargs, policy_delay=1000, buffer_size=100)
    extractor = model.actor.features_extractor

    def ids(optimizer: th.optim.Optimizer) -> set[int]:
        return {id(parameter) for group in optimizer.param_groups for parameter in group["params"]}

    shared = {id(parameter) for parameter in extractor.parameters()}
    assert shared and shared <= ids(model.actor.optimizer) and not shared & ids(model.critic.optimizer)
    model.learn(20)
    before, critic = weights(extractor), weights(model.critic.q_networks)
    model.learn(4, reset_num_timesteps=False)
    assert not th.equal(weights(model.critic.q_networks), critic)
    assert th.equal(weights(extractor), before)


def test_own_extractor_is_trained_by_the_critics(make):
    env = FakeImageEnv(screen_height=36, screen_width=36, n_channels=1, discrete=False)
    model = make(env, policy="CnnPolicy", policy_kwargs=SMALL_CNN, policy_delay=1000, buffer_size=100).learn(20)
    before = weights(model.critic.features_extractor), weights(model.actor.features_extractor)
    model.learn(4, reset_num_timesteps=False)
    assert not th.equal(weights(model.critic.features_extractor), before[0])
    assert th.equal(weights(model.actor.features_extractor), before[1])


def test_large_observations_are_drawn_a_few_at_a_time(make, monkeypatch):
    """Many updates of many images must not be drawn at once."""
    model = make(RandomEnv(IMAGE), policy="CnnPolicy", policy_kwargs=SMALL_CNN, buffer_size=100).learn(20)
    monkeypatch.setattr("sb3_symphony.common.off_policy.MAX_SAMPLE_BYTES", 36 * 36 * 8 * 16 * 2)
    sizes = []
    original = model.replay_buffer.sample
    model.replay_buffer.sample = lambda n, *args, **kwargs: (sizes.append(n), original(n, *args, **kwargs))[1]
    model._n_updates = 2  # not the first ones
    model._new_episodes = 0
    model.train(gradient_steps=5, batch_size=16)
    assert sizes == [32, 32, 16]
    assert model._n_updates == 7


def test_fused_engine_where_possible(make):
    assert type(make()._regression) is FusedRegression
    env = RandomEnv(IMAGE)
    assert type(make(env, policy="CnnPolicy", policy_kwargs=SMALL_CNN, buffer_size=10)._regression) is CriticRegression
    with pytest.raises(ValueError, match="NatureCNN"):
        make(env, policy="CnnPolicy", policy_kwargs=dict(critic_engine="fused", **SMALL_CNN), buffer_size=10)


# ---------------------------------------------------------------- other observations


@pytest.mark.parametrize(
    "observation_space",
    [
        spaces.Box(-1, 1, (2, 3)),
        spaces.Box(-1, 1, (3,), np.float64),
        spaces.Box(-5, 5, (3,), np.int64),
        spaces.Discrete(4),
        spaces.MultiDiscrete([3, 2]),
        spaces.MultiBinary(3),
    ],
    ids=str,
)
def test_observation_spaces(make, observation_space):
    model = make(RandomEnv(observation_space))
    model.learn(50)
    assert th.isfinite(weights(model.policy)).all()
    assert th.equal(weights(make(RandomEnv(observation_space)).learn(50).policy), weights(model.policy))


@pytest.mark.parametrize("shape", [(1,), (2, 3), (1, 1)])
def test_action_shapes(make, shape):
    model = make(RandomEnv(spaces.Box(-1, 1, (3,)), spaces.Box(-2, 2, shape)))
    model.learn(50)
    assert model.predict(np.zeros(3, dtype=np.float32))[0].shape == shape


# ---------------------------------------------------------------- refused


@pytest.mark.parametrize(
    "action_space",
    [spaces.Discrete(3), spaces.MultiDiscrete([2, 2]), spaces.MultiBinary(2), spaces.Dict(a=spaces.Box(-1, 1, (1,)))],
    ids=str,
)
def test_action_space_must_be_a_box(make, action_space):
    with pytest.raises(ValueError, match="Box") as caught:
        make(RandomEnv(spaces.Box(-1, 1, (3,)), action_space))
    assert str(caught.value).count("\n") == 0


@pytest.mark.parametrize(
    "action_space",
    [spaces.Box(-np.inf, np.inf, (2,)), spaces.Box(-1, np.inf, (2,)), spaces.Box(np.array([-1, -np.inf]), np.ones(2))],
    ids=str,
)
def test_action_space_must_be_bounded(make, action_space):
    with pytest.raises(ValueError, match="bound"):
        make(RandomEnv(spaces.Box(-1, 1, (3,)), action_space))


def test_unknown_policy(make):
    with pytest.raises(ValueError, match="NoPolicy"):
        make(policy="NoPolicy")


@pytest.mark.parametrize("cls", [Symphony, REDQ, DroQ])
def test_env_by_name(cls):
    model = cls("MlpPolicy", "Pendulum-v1", buffer_size=10, policy_kwargs=dict(net_arch=[4]))
    assert model.get_env().num_envs == 1
    with pytest.raises(gym.error.Error):
        cls("MlpPolicy", "NoSuchEnv-v0", buffer_size=10)
