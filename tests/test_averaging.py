"""The averaged actor: what it is, who asks it, and that training does not."""

import copy

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.torch_layers import FlattenExtractor
from torch import nn

from sb3_symphony import REDQ, DroQ, Symphony

OBSERVATIONS = np.random.default_rng(0).normal(size=(20, 3)).astype(np.float32)


class Actors(BaseCallback):
    """All actors there were, one update after the other."""

    def _on_training_start(self):
        self.actors = [copy.deepcopy(self.model.actor.state_dict())]
        update = self.model._update_actor

        def recorded(*args):
            update(*args)
            self.actors.append(copy.deepcopy(self.model.actor.state_dict()))

        self.model._update_actor = recorded

    def _on_step(self):
        return True


def test_average(make):
    model = make(policy_kwargs=dict(actor_averaging=0.3))
    assert not any(parameter.requires_grad for parameter in model.policy.averaged_actor.parameters())
    actors = Actors()
    model.learn(60, callback=actors)
    assert len(actors.actors) > 15
    actors = actors.actors[1:]  # the first one was not updated yet
    for name, averaged in model.policy.averaged_actor.state_dict().items():
        expected = actors[0][name].double()
        for k, actor in enumerate(actors, start=1):
            weight = min(1.0, 1 / (0.3 * k))
            expected = (1 - weight) * expected + weight * actor[name]
        th.testing.assert_close(averaged.double(), expected, rtol=1e-5, atol=1e-7)
        assert not th.equal(averaged, model.actor.state_dict()[name])


def test_who_is_asked(make):
    model = make(policy_kwargs=dict(actor_averaging=0.3)).learn(60)
    model.policy.set_training_mode(False)
    inputs = th.as_tensor(OBSERVATIONS)
    for actor, deterministic in ((model.policy.averaged_actor, True), (model.actor, False)):
        th.manual_seed(0)
        with th.no_grad():
            expected = actor._predict(inputs, deterministic).numpy()
        th.manual_seed(0)
        actions, _ = model.predict(OBSERVATIONS, deterministic=deterministic)
        np.testing.assert_allclose(actions, model.policy.unscale_action(expected), rtol=1e-6)


def test_training_does_not_ask(make):
    plain, averaged = (make(policy_kwargs=kwargs).learn(80) for kwargs in (dict(), dict(actor_averaging=0.3)))
    assert plain.policy.averaged_actor is None
    theirs = averaged.policy.state_dict()
    for name, value in plain.policy.state_dict().items():
        assert th.equal(value, theirs[name]), name
    assert {name.partition(".")[0] for name in theirs.keys() - plain.policy.state_dict().keys()} == {
        "averaged_actor",
        "n_averaged",
    }


def test_weights_that_come_without_an_average_start_a_new_one(make, tmp_path):
    kwargs = dict(actor_averaging=0.3)
    plain, model = make().learn(60), make(policy_kwargs=kwargs, seed=5).learn(60)
    plain.save(tmp_path / "plain")
    model.save(tmp_path / "averaged")
    answers = model.predict(OBSERVATIONS, deterministic=True)[0]
    expected = plain.predict(OBSERVATIONS, deterministic=True)[0]
    model.set_parameters(tmp_path / "plain", exact_match=False)
    np.testing.assert_array_equal(model.predict(OBSERVATIONS, deterministic=True)[0], expected)
    model.set_parameters(tmp_path / "averaged")  # with its own
    np.testing.assert_array_equal(model.predict(OBSERVATIONS, deterministic=True)[0], answers)
    assert not np.array_equal(answers, expected)


@pytest.mark.parametrize("share", [False, True])
def test_batch_normalisation(small, share):
    """Statistics are those of the actor, not an average of whole numbers."""

    class Normalised(FlattenExtractor):
        def __init__(self, observation_space: gym.Space) -> None:
            super().__init__(observation_space)
            self.norm = nn.BatchNorm1d(self.features_dim)

        def forward(self, observations: th.Tensor) -> th.Tensor:
            return self.norm(super().forward(observations))

    kwargs = dict(actor_averaging=0.3, features_extractor_class=Normalised, share_features_extractor=share)
    model = small(Symphony, policy_kwargs=kwargs).learn(60)
    own, averaged = (dict(actor.named_buffers()) for actor in (model.actor, model.policy.averaged_actor))
    assert own["features_extractor.norm.num_batches_tracked"] > 0
    assert all(th.equal(averaged[name], value) for name, value in own.items())
    model.predict(OBSERVATIONS[0], deterministic=True)  # with statistics of the training, not of this one observation


def test_deterministic_is_deterministic(make):
    """Also where a features extractor drops units in training."""

    class Dropped(FlattenExtractor):
        def forward(self, observations: th.Tensor) -> th.Tensor:
            return th.nn.functional.dropout(super().forward(observations), 0.5, self.training)

    model = make(policy_kwargs=dict(actor_averaging=0.3, features_extractor_class=Dropped)).learn(60)
    actions = [model.predict(OBSERVATIONS, deterministic=True)[0] for _ in range(4)]
    assert all(np.array_equal(actions[0], each) for each in actions)


@pytest.mark.parametrize("cls", [REDQ, DroQ])
def test_state_dependent_exploration(small, cls, tmp_path):
    plain, averaged = (
        small(cls, use_sde=True, policy_kwargs=dict(log_std_init=-1, actor_averaging=part)).learn(80) for part in (0, 0.3)
    )
    theirs = averaged.policy.state_dict()
    assert all(th.equal(value, theirs[name]) for name, value in plain.policy.state_dict().items())
    averaged.save(tmp_path / "model")
    first, second = (model.predict(OBSERVATIONS, deterministic=True)[0] for model in (averaged, cls.load(tmp_path / "model")))
    np.testing.assert_array_equal(first, second)
    assert not np.array_equal(first, plain.predict(OBSERVATIONS, deterministic=True)[0])
