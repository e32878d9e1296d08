"""What a saved model holds, and that training goes on from it as if nothing had happened."""

import copy
import inspect
import io
import json
import random
import warnings
import zipfile
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from stable_baselines3.common.noise import NormalActionNoise, VectorizedActionNoise
from stable_baselines3.common.save_util import load_from_zip_file
from stable_baselines3.common.vec_env import VecFrameStack

from sb3_symphony import REDQ, DroQ, Symphony
from sb3_symphony.common.buffers import FadingReplayBuffer, PrioritizedReplayBuffer
from sb3_symphony.common.noise import DecayingNormalActionNoise


def state(model: Any) -> dict[str, Any]:
    """Everything that a model learns, flat."""
    flat: dict[str, Any] = {}
    for name, parameters in model.get_parameters().items():
        if "optimizer" not in name:
            flat |= {f"{name}.{key}": value for key, value in parameters.items()}
            continue
        for index, each in parameters["state"].items():
            flat |= {f"{name}.{index}.{key}": value for key, value in each.items()}
        flat |= {f"{name}.lr": th.tensor([group["lr"] for group in parameters["param_groups"]])}
    for name in model._get_torch_save_params()[1]:
        flat[name] = getattr(model, name)
    return {key: th.as_tensor(value).detach().clone() for key, value in flat.items()}


def assert_equal(first: dict[str, th.Tensor], second: dict[str, th.Tensor]) -> None:
    assert first.keys() == second.keys()
    for key, value in first.items():
        assert th.equal(value, second[key]), key


def generators() -> tuple:
    return random.getstate(), np.random.get_state(), th.get_rng_state()


def restore(saved: tuple) -> None:
    random.setstate(saved[0])
    np.random.set_state(saved[1])
    th.set_rng_state(saved[2])


def saved_data(path: Any) -> dict[str, Any]:
    with zipfile.ZipFile(path) as archive:
        return json.loads(archive.read("data"))


OPTIONS = {
    "plain": dict(),
    "n_steps": dict(n_steps=3),
    "autograd": dict(policy_kwargs=dict(critic_engine="autograd")),
    "autograd, n_steps": dict(n_steps=3, policy_kwargs=dict(critic_engine="autograd")),
    "prioritised": dict(replay_buffer_class=PrioritizedReplayBuffer),
    "fading": dict(replay_buffer_class=FadingReplayBuffer, replay_buffer_kwargs=dict(fade_factor=3.0)),
    "dropout": dict(policy_kwargs=dict(dropout_rate=0.2, layer_norm=True)),
    "averaged actor": dict(policy_kwargs=dict(actor_averaging=0.1)),
    "classification": dict(critic_loss="hl_gauss", policy_kwargs=dict(value_range=(-20, 5), n_bins=9)),
    "AdamW": dict(policy_kwargs=dict(optimizer_class=th.optim.AdamW)),
    "SGD": dict(policy_kwargs=dict(optimizer_class=th.optim.SGD, optimizer_kwargs=dict(momentum=0.9))),
    "schedule": dict(learning_rate=lambda left: 1e-3 * left),
    "three envs": dict(n_envs=3, gradient_steps=3),
}


@pytest.mark.parametrize("options", OPTIONS.values(), ids=OPTIONS)
def test_everything_learned_is_saved(make, algorithm, tmp_path, options):
    model = make(**options).learn(80)
    model.save(tmp_path / "model.zip")
    loaded = algorithm.load(tmp_path / "model.zip", device="cpu")
    assert_equal(state(model), state(loaded))
    for name in ("num_timesteps", "_n_updates", "_episode_num", "n_critics", "n_steps", "policy_delay", "gamma", "tau"):
        assert getattr(loaded, name) == getattr(model, name), name
    for name in ("target_mode", "critic_loss", "critic_reduction", "gradient_steps", "_timesteps_at_update"):
        assert getattr(loaded, name) == getattr(model, name), name
    assert type(loaded._regression) is type(model._regression)
    assert type(loaded.critic.optimizer) is type(model.critic.optimizer)
    observations = np.random.default_rng(0).normal(size=(20, 3)).astype(np.float32)
    for each in (model, loaded):
        each.policy.set_training_mode(False)
    np.testing.assert_array_equal(
        model.predict(observations, deterministic=True)[0], loaded.predict(observations, deterministic=True)[0]
    )


@pytest.mark.parametrize("cls", [REDQ, DroQ])
@pytest.mark.parametrize("ent_coef", ["auto", "auto_0.3", 0.2])
@pytest.mark.parametrize("target_entropy", ["auto", -0.5])
def test_entropy_coefficient_is_saved(small, cls, ent_coef, target_entropy, tmp_path):
    model = small(cls, ent_coef=ent_coef, target_entropy=target_entropy).learn(60)
    model.save(tmp_path / "model")
    data, _, _ = load_from_zip_file(tmp_path / "model")
    assert not [name for name, value in data.items() if isinstance(value, th.Tensor)]  # on a device that others may not have
    loaded = cls.load(tmp_path / "model", env=model.env)
    assert loaded._current_ent_coef() == model._current_ent_coef()
    assert loaded.target_entropy == model.target_entropy
    before = loaded._current_ent_coef().item()
    loaded.learn(40, reset_num_timesteps=False)
    assert (loaded._current_ent_coef().item() != before) == isinstance(ent_coef, str)
    assert loaded._current_ent_coef().requires_grad is False


def test_symphony_state_is_saved(small, tmp_path):
    model = small(Symphony).learn(80)
    assert model.baseline.item() != 0.0
    model.save(tmp_path / "model")
    loaded = Symphony.load(tmp_path / "model", env=model.env)
    assert loaded.baseline == model.baseline
    assert loaded.critic_lr_schedule(1.0) == model.critic_lr_schedule(1.0) == 7e-4
    for name in ("_new_episodes", "_redraw_actor", "_n_updates", "episode_gradient_steps"):
        assert getattr(loaded, name) == getattr(model, name), name
    assert tuple(loaded.initial_gradient_steps) == model.initial_gradient_steps


@pytest.mark.parametrize(
    "steps, redraw, new_episodes, updated", [(10, False, 0, False), (25, True, 0, False), (75, True, 0, True)]
)
def test_symphony_episode_boundary_is_saved(small, tmp_path, steps, redraw, new_episodes, updated):
    model = small(Symphony, learning_starts=30).learn(steps)
    model.save(tmp_path / "model")
    loaded = Symphony.load(tmp_path / "model", env=model.env)
    for each in (model, loaded):
        assert each._redraw_actor is redraw
        assert each._new_episodes == new_episodes
        assert (each._n_updates > 0) is updated


def test_symphony_pending_episode_updates_survive(small, tmp_path):
    """Training every 4 steps: episode ends at 50, its additional updates come with step 52."""
    model = small(Symphony, train_freq=4, episode_gradient_steps=7)
    saved: list[Any] = []

    def save(locals_: dict, globals_: dict) -> bool:
        if model.num_timesteps == 51:
            model.save(tmp_path / "model")
            saved.append(model._new_episodes)
        return True

    model.learn(60, callback=save)
    assert saved == [1]
    loaded = Symphony.load(tmp_path / "model", env=model.env)
    assert loaded._new_episodes == 1
    n_updates = loaded._n_updates
    loaded.replay_buffer = model.replay_buffer
    loaded.set_logger(model.logger)
    loaded.train(gradient_steps=1, batch_size=16)
    assert loaded._n_updates == n_updates + 1 + 7


def test_symphony_mid_warm_up(small, tmp_path):
    """The warm-up goes on: an actor is drawn for the next episode, and the initial updates are made once."""
    model = small(Symphony, learning_starts=60, initial_gradient_steps=(4, 4), episode_gradient_steps=0).learn(30)
    model.save(tmp_path / "model")
    loaded = Symphony.load(tmp_path / "model", env=model.env)
    loaded.replay_buffer = model.replay_buffer
    loaded.learn(31, reset_num_timesteps=False)
    assert loaded._n_updates == 4 + 4 + 1


# ---------------------------------------------------------------- exact resume


@pytest.mark.parametrize("options", OPTIONS.values(), ids=OPTIONS)
def test_next_updates_are_bitwise_equal(make, algorithm, tmp_path, options):
    model = make(**options).learn(80)
    model.save(tmp_path / "model")
    model.save_replay_buffer(tmp_path / "buffer")
    now = generators()
    model.train(gradient_steps=5, batch_size=16)

    loaded = algorithm.load(tmp_path / "model", device="cpu")  # seeds the generators anew
    loaded.load_replay_buffer(tmp_path / "buffer")
    loaded.set_logger(model.logger)
    restore(now)
    loaded.train(gradient_steps=5, batch_size=16)
    assert loaded._n_updates == model._n_updates
    assert_equal(state(model), state(loaded))


@pytest.mark.parametrize("options", OPTIONS.values(), ids=OPTIONS)
def test_training_goes_on_bitwise_equal(make, algorithm, tmp_path, options):
    """Save in the middle of an episode, load, restore generators and environment: as if it had never been interrupted."""
    model = make(**options).learn(80)
    environment = copy.deepcopy(model.env)
    model.save(tmp_path / "model")
    model.save_replay_buffer(tmp_path / "buffer")
    now, space = generators(), copy.deepcopy(model.action_space)
    model.learn(60, reset_num_timesteps=False)

    loaded = algorithm.load(tmp_path / "model", env=environment, device="cpu", force_reset=False)
    loaded.load_replay_buffer(tmp_path / "buffer", truncate_last_traj=False)
    loaded.action_space = space
    environment._seeds = [None] * environment.num_envs  # loading seeds the environments for their next reset
    restore(now)
    loaded.learn(60, reset_num_timesteps=False)
    assert loaded.num_timesteps == model.num_timesteps
    np.testing.assert_array_equal(loaded.replay_buffer.observations, model.replay_buffer.observations)
    np.testing.assert_array_equal(loaded.replay_buffer.actions, model.replay_buffer.actions)
    assert_equal(state(model), state(loaded))


@pytest.mark.parametrize("options", [OPTIONS["plain"], OPTIONS["fading"], OPTIONS["prioritised"], OPTIONS["three envs"]])
def test_replay_buffer_is_saved(make, algorithm, tmp_path, options):
    model = make(**options).learn(50)
    model.save_replay_buffer(tmp_path / "buffer")
    old = model.replay_buffer
    model.load_replay_buffer(tmp_path / "buffer", truncate_last_traj=False)
    new = model.replay_buffer
    assert new is not old and type(new) is type(old)
    assert (new.pos, new.full) == (old.pos, old.full)
    for name in ("observations", "next_observations", "actions", "rewards", "dones", "timeouts"):
        np.testing.assert_array_equal(getattr(new, name), getattr(old, name))
    if isinstance(old, PrioritizedReplayBuffer):
        np.testing.assert_array_equal(new.tree.nodes, old.tree.nodes)
        assert new.max_priority == old.max_priority
    model.learn(40, reset_num_timesteps=False)


# ---------------------------------------------------------------- the file


def test_no_optimizer_is_pickled(make, tmp_path):
    """SB3 pickles every attribute that is not listed, silently: none may hold an optimizer, a network or a buffer."""
    model = make().learn(60)
    model.save(tmp_path / "model.zip")
    data = saved_data(tmp_path / "model.zip")
    for name in ("actor", "critic", "critic_target", "_regression", "policy", "replay_buffer", "ent_coef_optimizer", "env"):
        assert name not in data, name
    for name, value in data.items():
        if name in ("policy_class", "policy_kwargs"):
            continue  # classes, by name
        assert not isinstance(model.__dict__[name], (th.Tensor, th.nn.Module, th.optim.Optimizer)), name
        assert "optimizer" not in json.dumps(value), name
    with zipfile.ZipFile(tmp_path / "model.zip") as archive:
        names = {name for name in archive.namelist() if name.endswith(".pth")}
        assert sum(entry.file_size for entry in archive.infolist()) < 500_000  # no replay buffer in it
    expected = {"policy.pth", "actor.optimizer.pth", "critic.optimizer.pth", "pytorch_variables.pth"}
    if not isinstance(model, Symphony):
        expected.add("ent_coef_optimizer.pth")
    assert names == expected


def test_saved_parameters_load_without_pickle(make, tmp_path):
    """SB3 loads state dicts with ``weights_only=True``: tensors and plain values only."""
    make().learn(60).save(tmp_path / "model.zip")
    with zipfile.ZipFile(tmp_path / "model.zip") as archive:
        for name in archive.namelist():
            if name.endswith(".pth"):
                th.load(io.BytesIO(archive.read(name)), weights_only=True)


def test_include_and_exclude(make, algorithm, tmp_path):
    model = make(action_noise=NormalActionNoise(np.zeros(1), np.ones(1))).learn(40)
    model.save(tmp_path / "model", exclude=["learning_rate", "action_noise"])
    data, _, _ = load_from_zip_file(tmp_path / "model")
    assert "learning_rate" not in data and "action_noise" not in data
    model.save(tmp_path / "all", include=["replay_buffer"])
    data, _, _ = load_from_zip_file(tmp_path / "all")
    assert data["replay_buffer"].size() == 40
    loaded = algorithm.load(tmp_path / "all")
    assert loaded.replay_buffer.size() == 40
    assert algorithm.load(tmp_path / "model").num_timesteps == 40


def test_custom_objects(make, algorithm, tmp_path):
    model = make().learn(40)
    model.save(tmp_path / "model")
    custom = dict(learning_rate=1e-5, lr_schedule=lambda _: 1e-5, action_noise=None, unknown=1)
    loaded = algorithm.load(tmp_path / "model", env=model.env, custom_objects=custom)
    assert loaded.learning_rate == 1e-5 and loaded.action_noise is None
    loaded.learn(30, reset_num_timesteps=False)
    assert loaded.actor.optimizer.param_groups[0]["lr"] == 1e-5


def test_policy_kwargs_as_custom_objects(make, algorithm, tmp_path):
    """Those of the user, without what the constructor has added to them."""
    model = make(n_critics=3).learn(40)
    model.save(tmp_path / "model")
    added = ("n_critics", "use_sde", "dropout_rate", "layer_norm")
    own = {name: value for name, value in model.policy_kwargs.items() if name not in added}
    loaded = algorithm.load(tmp_path / "model", custom_objects=dict(policy_kwargs=own))
    assert loaded.critic.n_critics == 3 and "n_critics" not in own
    with pytest.raises(ValueError, match="n_critics=3: the saved model has 4"):
        algorithm.load(tmp_path / "model", custom_objects=dict(policy_kwargs={**own, "n_critics": 4}))


def test_policy_kwargs_that_built_the_model(make, algorithm, tmp_path):
    """SB3 saves plain ones as JSON, which knows no tuples."""
    own = dict(net_arch=[16, 16], layer_norm=(True, False))
    make(policy_kwargs=own).save(tmp_path / "model")
    assert algorithm.load(tmp_path / "model", policy_kwargs=own).policy_kwargs["layer_norm"] == [True, False]
    with pytest.raises(ValueError, match="layer_norm="):
        algorithm.load(tmp_path / "model", policy_kwargs={**own, "layer_norm": (True, True)})


def test_arguments_given_to_load(make, algorithm, tmp_path):
    model = make().learn(40)
    model.save(tmp_path / "model")
    loaded = algorithm.load(
        tmp_path / "model", env=model.env, gamma=0.5, policy_kwargs=model.policy_kwargs, buffer_size=7, gradient_steps=2
    )
    assert (loaded.gamma, loaded.gradient_steps, loaded.replay_buffer.buffer_size) == (0.5, 2, 7)
    loaded.learn(30)
    for name, parameter in inspect.signature(model.policy_class).parameters.items():
        if parameter.default is not parameter.empty and name not in model.policy_kwargs:
            algorithm.load(tmp_path / "model", policy_kwargs={name: parameter.default})
    with pytest.raises(ValueError, match=r"policy_kwargs has net_arch=\[32\]: the saved model has \[16\]"):
        algorithm.load(tmp_path / "model", policy_kwargs=dict(net_arch=[32]))


@pytest.mark.parametrize(("before", "after"), [(1, 3), (3, 1)])
def test_n_steps_may_change_at_load(make, algorithm, tmp_path, before, after):
    model = make(n_steps=before).learn(40)
    model.save(tmp_path / "model")
    loaded = algorithm.load(tmp_path / "model", env=model.env, n_steps=after)
    assert getattr(loaded.replay_buffer, "n_steps", 1) == after
    loaded.learn(30)


def test_learning_rate_may_change_at_load(make, algorithm, tmp_path):
    model = make().learn(40)
    model.save(tmp_path / "model")
    loaded = algorithm.load(tmp_path / "model", env=model.env, learning_rate=1e-5, batch_size=8)
    loaded.learn(30, reset_num_timesteps=False)
    assert loaded.actor.optimizer.param_groups[0]["lr"] == 1e-5


def test_set_parameters(make, algorithm):
    model, other = make().learn(40), make(seed=1)
    other.set_parameters(model.get_parameters(), exact_match=True)
    first, second = state(model), state(other)
    for name in first:
        if name not in model._get_torch_save_params()[1]:
            assert th.equal(first[name], second[name]), name
    other.learn(40)
    with pytest.raises(ValueError, match="Names of parameters"):
        other.set_parameters({"policy": model.policy.state_dict()}, exact_match=True)
    other.set_parameters({"policy": model.policy.state_dict()}, exact_match=False)
    with pytest.raises(ValueError, match="nonsense"):
        other.set_parameters({"nonsense": {}})


@pytest.mark.parametrize("content", [b"", b"not a zip file", None], ids=["empty", "text", "truncated"])
def test_corrupted_file(make, algorithm, tmp_path, content):
    path = tmp_path / "model.zip"
    if content is None:
        make().save(path)
        content = path.read_bytes()[:-200]
    path.write_bytes(content)
    # Of a truncated file, zipfile may find a network's archive instead of the whole
    with pytest.raises((AssertionError, ValueError), match=r"zip-file|No data found"):
        algorithm.load(path)


def test_missing_file(algorithm, tmp_path):
    with pytest.raises(FileNotFoundError):
        algorithm.load(tmp_path / "missing.zip")


def test_file_objects(make, algorithm, tmp_path):
    model = make()
    stream = io.BytesIO()
    model.save(stream)
    stream.seek(0)
    assert_equal(state(model), state(algorithm.load(stream)))
    model.save(str(tmp_path / "folder" / "model"))
    assert (tmp_path / "folder" / "model.zip").exists()


# ---------------------------------------------------------------- environments


def test_load_without_env(make, algorithm, tmp_path, pendulum):
    model = make(n_envs=2).learn(50)
    model.save(tmp_path / "model")
    loaded = algorithm.load(tmp_path / "model")
    assert loaded.env is None
    loaded.predict(np.zeros(3, dtype=np.float32), deterministic=True)
    with pytest.raises(AssertionError, match="environment"):
        loaded.learn(10)
    loaded.set_env(pendulum(2))
    loaded.learn(30)
    with pytest.raises((AssertionError, ValueError), match="number of environments"):
        loaded.set_env(pendulum(3))


def test_set_env(make, pendulum):
    model = make(n_envs=2).learn(50)
    model.set_env(pendulum(2))
    assert model._last_obs is None
    model.learn(30, reset_num_timesteps=False)
    model.set_env(pendulum(2), force_reset=False)
    assert model._last_obs is not None


@pytest.mark.parametrize(("reset", "n_stack"), [(True, 1), (True, 2), (False, 1)])
def test_returns_end_where_an_episode_is_given_up(make, pendulum, reset, n_stack):
    """The environment is reset in the middle of an episode: three-step returns must not reach into the next one."""
    env = VecFrameStack(pendulum(), n_stack)  # resets into the array that its last step returned
    model = make(env, n_steps=3, gamma=0.5).learn(60)  # episodes of 25 steps
    model.learn(10, reset_num_timesteps=False)  # goes on in its episode
    if not reset:
        model.set_env(pendulum())
    model.learn(20, reset_num_timesteps=reset)
    samples = model.replay_buffer._get_samples(np.arange(90))
    lengths = np.log(samples.discounts.flatten().numpy()) / np.log(0.5)
    expected = np.full(90, 3.0)
    for end in (25, 50, 70, 90):
        expected[end - 2 : end] = 2, 1
    np.testing.assert_allclose(lengths, expected, rtol=1e-6)
    assert not samples.dones.any()  # Pendulum never terminates


def test_wrong_spaces(make, algorithm, tmp_path):
    make().save(tmp_path / "model")
    with pytest.raises(ValueError, match="spaces do not match"):
        algorithm.load(tmp_path / "model", env=gym.make("MountainCarContinuous-v0"))


@pytest.mark.parametrize(
    "noise", [None, NormalActionNoise(np.zeros(1), np.ones(1)), DecayingNormalActionNoise(1, decay_steps=500)], ids=str
)
@pytest.mark.parametrize("before, after", [(3, 1), (1, 3), (3, 2)])
def test_other_number_of_envs(make, algorithm, tmp_path, pendulum, noise, before, after):
    """The vectorised noise is saved: it must fit the new number of environments."""
    model = make(n_envs=before, action_noise=copy.deepcopy(noise)).learn(60)
    model.save(tmp_path / "model")
    loaded = algorithm.load(tmp_path / "model", env=pendulum(after))
    assert loaded.n_envs == after
    n_updates = loaded._n_updates
    loaded.learn(60, reset_num_timesteps=False)
    assert loaded._n_updates > n_updates
    assert loaded.replay_buffer.actions.shape[1] == after
    assert isinstance(loaded.action_noise, VectorizedActionNoise) == (after > 1 and noise is not None)
    if isinstance(noise, DecayingNormalActionNoise):
        noises = loaded.action_noise.noises if after > 1 else [loaded.action_noise]
        assert all(each.t == 120 for each in noises)


def test_symphony_default_noise_with_other_number_of_envs(small, tmp_path, pendulum):
    model = small(Symphony, n_envs=3).learn(60)
    model.save(tmp_path / "model")
    loaded = Symphony.load(tmp_path / "model", env=pendulum(1)).learn(30, reset_num_timesteps=False)
    assert isinstance(loaded.action_noise, DecayingNormalActionNoise)
    assert loaded.action_noise.t == 90
    assert loaded.action_noise.n_envs == 1


def test_decay_survives(make, algorithm, tmp_path):
    """Neither saving, nor loading, nor ``learn()`` restarts the decay of the exploration noise."""
    model = make(action_noise=DecayingNormalActionNoise(1, sigma=0.4, decay_steps=100, decay="linear")).learn(50)
    assert model.action_noise.sigma_t == pytest.approx(0.2)
    model.save(tmp_path / "model")
    loaded = algorithm.load(tmp_path / "model", env=model.env)
    assert loaded.action_noise.sigma_t == pytest.approx(0.2)
    loaded.learn(25)
    assert loaded.action_noise.sigma_t == pytest.approx(0.1)


def test_fine_tuning_keeps_the_trained_actor(make, algorithm, tmp_path):
    """A loaded model that starts a new count of steps warms up with what it has learned."""
    model = make(learning_starts=30).learn(60)
    model.save(tmp_path / "model")
    before = {key: value.clone() for key, value in model.actor.state_dict().items()}
    loaded = algorithm.load(tmp_path / "model", env=model.env).learn(30)
    assert_equal(before, loaded.actor.state_dict())


@pytest.mark.parametrize("n_steps", [1, 3])
def test_load_does_not_warn(make, algorithm, tmp_path, n_steps):
    """SB3's own algorithms warn at loading that ``n_steps`` would be ignored."""
    model = make(n_steps=n_steps).learn(50)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        model.save(tmp_path / "model")
        loaded = algorithm.load(tmp_path / "model", env=model.env)
        assert loaded.n_steps == n_steps
        assert getattr(loaded.replay_buffer, "n_steps", 1) == n_steps
        loaded.learn(50)


@pytest.mark.parametrize("cls", [REDQ, DroQ])
def test_gsde_model(small, cls, tmp_path, pendulum):
    model = small(cls, n_envs=2, use_sde=True).learn(50)
    model.save(tmp_path / "model")
    loaded = cls.load(tmp_path / "model")
    observation = np.ones(3, dtype=np.float32)
    np.testing.assert_array_equal(
        model.predict(observation, deterministic=True)[0], loaded.predict(observation, deterministic=True)[0]
    )
    loaded.predict(observation)
    cls.load(tmp_path / "model", env=pendulum(3)).learn(40)


# ---------------------------------------------------------------- the policy alone


@pytest.mark.parametrize(
    "policy_kwargs",
    [
        dict(),
        dict(net_arch=dict(pi=[8], qf=[16, 8]), n_critics=4, actor_averaging=0.1),
        dict(layer_norm=True, dropout_rate=0.1, critic_engine="autograd", activation_fn=th.nn.Tanh),
        dict(share_features_extractor=True, optimizer_class=th.optim.AdamW, optimizer_kwargs=dict(weight_decay=0.1)),
    ],
    ids=str,
)
def test_policy_alone(make, tmp_path, policy_kwargs):
    model = make(policy_kwargs=policy_kwargs).learn(40)
    model.policy.save(tmp_path / "policy.pth")
    loaded = type(model.policy).load(tmp_path / "policy.pth", device="cpu")
    assert_equal(model.policy.state_dict(), loaded.state_dict())
    networks = (
        "net_arch",
        "n_critics",
        "layer_norm",
        "dropout_rate",
        "share_features_extractor",
        "actor_averaging",
        "critic_engine",
    )
    for name in networks:
        if hasattr(model.policy, name):
            assert getattr(loaded, name) == getattr(model.policy, name), name
    assert [type(layer) for layer in loaded.critic.q_networks.layers] == [
        type(layer) for layer in model.policy.critic.q_networks.layers
    ]
    observations = np.random.default_rng(0).normal(size=(20, 3)).astype(np.float32)
    np.testing.assert_array_equal(
        model.predict(observations, deterministic=True)[0], loaded.predict(observations, deterministic=True)[0]
    )


def test_actor_alone(make, tmp_path):
    """The actor can be saved by itself, which is all a robot needs."""
    model = make(policy_kwargs=dict(layer_norm=False, net_arch=[16, 8])).learn(40)
    model.actor.save(tmp_path / "actor.pth")
    loaded = type(model.actor).load(tmp_path / "actor.pth", device="cpu")
    assert_equal(model.actor.state_dict(), loaded.state_dict())


def test_deepcopy(make):
    """As with SAC: no graph of the last update hangs on the policy."""
    model = make().learn(40)
    clone = copy.deepcopy(model.policy)
    assert_equal(model.policy.state_dict(), clone.state_dict())
