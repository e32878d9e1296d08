"""Hindsight experience replay with goal environments."""

import warnings

import numpy as np
import pytest
import torch as th
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.envs import BitFlippingEnv
from stable_baselines3.her import HerReplayBuffer

from sb3_symphony import Symphony
from sb3_symphony.common.buffers import FadingDictReplayBuffer


def goal_env(n_envs=1):
    return make_vec_env(lambda: BitFlippingEnv(n_bits=4, continuous=True, max_steps=8), n_envs=n_envs)


@pytest.fixture
def make_her(make):
    def build(n_envs=1, replay_buffer_kwargs=None, **kwargs):
        kwargs.setdefault("replay_buffer_class", HerReplayBuffer)
        if kwargs["replay_buffer_class"] is HerReplayBuffer:
            replay_buffer_kwargs = dict(n_sampled_goal=2) if replay_buffer_kwargs is None else replay_buffer_kwargs
        return make(goal_env(n_envs), policy="MultiInputPolicy", replay_buffer_kwargs=replay_buffer_kwargs, **kwargs)

    return build


def parameters(model):
    return th.nn.utils.parameters_to_vector(model.policy.parameters()).detach().clone()


@pytest.mark.parametrize("goal_selection_strategy", ["future", "final", "episode"])
@pytest.mark.parametrize("n_envs", [1, 2])
def test_her(make_her, goal_selection_strategy, n_envs):
    model = make_her(
        n_envs, dict(n_sampled_goal=2, goal_selection_strategy=goal_selection_strategy), gradient_steps=3, policy_delay=2
    )
    before = parameters(model)
    model.learn(80)
    assert not th.equal(parameters(model), before)
    assert th.isfinite(parameters(model)).all()
    assert "train/critic_loss" in model.logger.name_to_value


def test_a_second_training_warns_of_nothing(make_her):
    model = make_her()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        model.learn(32).learn(32)


def test_her_is_deterministic(make_her):
    assert th.equal(parameters(make_her().learn(80)), parameters(make_her().learn(80)))


def test_relabelled_goals_are_reached(make_her):
    """Relabelled transitions of the final strategy have the reward of a reached goal now and then."""
    model = make_her(replay_buffer_kwargs=dict(n_sampled_goal=4, goal_selection_strategy="final")).learn(80)
    assert (model.replay_buffer.sample(500).rewards == 0).any()


@pytest.mark.parametrize("n_envs", [1, 2])
def test_save_and_load(make_her, algorithm, tmp_path, n_envs):
    model = make_her(n_envs).learn(80)
    model.save(tmp_path / "model")
    model.save_replay_buffer(tmp_path / "buffer")
    with pytest.raises(AssertionError, match="environment"):
        algorithm.load(tmp_path / "model")
    loaded = algorithm.load(tmp_path / "model", env=goal_env(n_envs))
    loaded.load_replay_buffer(tmp_path / "buffer")
    assert loaded.replay_buffer.size() == model.replay_buffer.size()
    loaded.learn(40, reset_num_timesteps=False)
    observation = {key: np.asarray(value) for key, value in model.observation_space.sample().items()}
    assert model.predict(observation, deterministic=True)[0].shape == (4,)


def test_real_goals_are_in_every_batch(make_her):
    """SB3 samples real goals first, then relabelled ones: one sample cut into batches would sort them apart."""
    model = make_her(policy_delay=4).learn(200)
    shares = []
    for _, batches in model._segments(40, 64):
        # The real goal is all ones; with two relabelled goals for each, a third is real at least
        shares += [batch.observations["desired_goal"].eq(1).all(dim=1).float().mean().item() for batch in batches]
    assert len(shares) == 40
    assert min(shares) > 0.2 and max(shares) < 0.8


def test_without_her(make_her, algorithm):
    """A goal environment is an ordinary Dict environment, too."""
    model = make_her(replay_buffer_class=None)
    if algorithm is Symphony:
        assert type(model.replay_buffer) is FadingDictReplayBuffer
    model.learn(50)


def test_fading_dict_buffer_may_be_given(make_her):
    make_her(replay_buffer_class=FadingDictReplayBuffer, replay_buffer_kwargs=dict(fade_factor=3.0)).learn(50)


def test_her_does_not_fade(make_her):
    with pytest.raises(ValueError, match=r"fade_factor.*Her"):
        make_her(replay_buffer_kwargs=dict(n_sampled_goal=2, fade_factor=7.0))


def test_her_has_no_n_steps(make_her):
    with pytest.raises(ValueError, match="n_steps=3"):
        make_her(n_steps=3)


def test_her_with_initial_updates(small):
    """Symphony's initial updates draw uniformly where the buffer can fade, and just draw where it cannot."""
    model = small(
        Symphony,
        goal_env(),
        policy="MultiInputPolicy",
        replay_buffer_class=HerReplayBuffer,
        initial_gradient_steps=(3, 4),
        episode_gradient_steps=0,
    )
    model.learn(21)
    assert model._n_updates == 3 + 4 + 1
