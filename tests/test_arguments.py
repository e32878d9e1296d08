"""Bad arguments: one clear line that names the argument and its value."""

import math
import re

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3 import SAC, TD3
from stable_baselines3.common.buffers import DictReplayBuffer, ReplayBuffer
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.save_util import save_to_pkl
from stable_baselines3.her import HerReplayBuffer

from sb3_symphony import REDQ, DroQ, Symphony
from sb3_symphony.common.buffers import FadingReplayBuffer, PrioritizedReplayBuffer
from sb3_symphony.common.callbacks import GreedyEpisodes
from sb3_symphony.common.noise import DecayingNormalActionNoise, StickyActionNoise


def refused(build, name, value, *errors):
    with pytest.raises(errors or (ValueError, TypeError)) as caught:
        build(**{name: value})
    message = str(caught.value)
    assert name in message, message
    assert repr(value) in message or str(value) in message, message
    assert len(message.splitlines()) == 1, message
    return message


INTEGERS = dict(
    buffer_size=(0, -1),
    learning_starts=(-1,),
    batch_size=(0, -5),
    gradient_steps=(-2,),
    n_steps=(0, -1),
    n_critics=(0, -1),
    policy_delay=(0, -1),
)
NUMBERS = dict(tau=(-0.1, 1.1), gamma=(-0.1, 1.1), learning_rate=(-1e-3,))
WRONG = (math.nan, math.inf, -math.inf, True, "3", [1])

CASES = [
    *((name, value) for name, values in INTEGERS.items() for value in (*values, *WRONG, 1.5)),
    *((name, value) for name, values in NUMBERS.items() for value in (*values, *WRONG)),
]


def test_whole_numbers_as_actions(make):
    """Scaled to [-1, 1] they are not whole, and a buffer of whole numbers would cut them."""
    env = gym.wrappers.TransformAction(gym.make("Pendulum-v1"), float, gym.spaces.Box(0, 5, (1,), dtype=np.int64))
    with pytest.raises(ValueError, match=re.escape("action_space=Box(0, 5, (1,), int64): expected real numbers")):
        make(env)


def test_constant_actions(make):
    """They cannot be scaled to [-1, 1]."""
    env = gym.wrappers.TransformAction(gym.make("Pendulum-v1"), np.copy, gym.spaces.Box(1, 1, (1,)))
    with pytest.raises(ValueError, match=re.escape("action_space=Box(1.0, 1.0, (1,), float32): expected low < high")):
        make(env)


@pytest.mark.parametrize("name, value", CASES, ids=lambda x: str(x))
def test_numbers(make, name, value):
    refused(make, name, value)


@pytest.mark.parametrize(
    "name, value",
    [
        ("critic_learning_rate", -1e-3),
        ("critic_learning_rate", math.nan),
        ("critic_learning_rate", "1e-3"),
        ("min_mix", -0.1),
        ("min_mix", 1.1),
        ("min_mix", math.nan),
        ("min_mix", True),
        ("min_mix", "1"),
        ("min_mix", (1,)),
        ("min_mix", (1, 0, 0)),
        ("min_mix", (0, 1, 0, 100)),
        ("target_policy_noise", -0.1),
        ("saturation_penalty", -0.1),
        ("saturation_penalty", math.nan),
        ("target_policy_noise", math.inf),
        ("episode_gradient_steps", -1),
        ("episode_gradient_steps", 1.5),
        ("episode_gradient_steps", True),
        ("episode_gradient_steps", math.inf),
        ("initial_gradient_steps", (1, 2, 3)),
        ("initial_gradient_steps", (1,)),
        ("initial_gradient_steps", 5),
        ("warmup_policy", "acter"),
        ("actor_loss", "rehea"),
        ("action_noise", "defalt"),
    ],
    ids=str,
)
def test_symphony(small, name, value):
    refused(lambda **kwargs: small(Symphony, **kwargs), name, value)


@pytest.mark.parametrize("value, shown", [((-1, 2), "-1"), ((1, 2.5), "2.5"), ((True, 1), "True"), (("1", 2), "'1'")], ids=str)
def test_initial_gradient_steps(small, value, shown):
    with pytest.raises((ValueError, TypeError), match=f"initial_gradient_steps=.*{shown}"):
        small(Symphony, initial_gradient_steps=value)


@pytest.mark.parametrize("cls", [REDQ, DroQ])
@pytest.mark.parametrize(
    "name, value",
    [
        ("subset_size", 0),
        ("subset_size", 0.5),
        ("subset_size", -1),
        ("subset_size", 11),
        ("subset_size", 3.5),
        ("subset_size", math.nan),
        ("subset_size", math.inf),
        ("subset_size", True),
        ("subset_size", "2"),
        ("subset_size", "al"),
        ("subset_size", None),
        ("ent_coef", -0.1),
        ("ent_coef", math.nan),
        ("ent_coef", math.inf),
        ("ent_coef", True),
        ("ent_coef", None),
        ("ent_coef", "automatic"),
        ("ent_coef", "auto_x"),
        ("target_entropy", math.nan),
        ("target_entropy", math.inf),
        ("target_entropy", True),
        ("target_entropy", None),
        ("target_entropy", "mbop"),
    ],
    ids=str,
)
def test_redq(small, cls, name, value):
    refused(lambda **kwargs: small(cls, **kwargs), name, value)


@pytest.mark.parametrize("cls", [REDQ, DroQ])
@pytest.mark.parametrize("ent_coef", ["auto_-1", "auto_0", "auto_nan", "auto_inf"])
def test_initial_entropy_coefficient(small, cls, ent_coef):
    with pytest.raises(ValueError, match=f"ent_coef='?(auto_)?{ent_coef.removeprefix('auto_')}"):
        small(cls, ent_coef=ent_coef)


@pytest.mark.parametrize("cls", [REDQ, DroQ])
def test_batch_size_is_needed(small, cls):
    """Only Symphony's grows by itself."""
    refused(lambda **kwargs: small(cls, **kwargs), "batch_size", None)


def test_subset_larger_than_the_ensemble(small):
    message = refused(lambda **kwargs: small(REDQ, n_critics=3, **kwargs), "subset_size", 4, ValueError)
    assert "n_critics=3" in message


def test_subset_of_critics_given_in_the_policy(small):
    small(REDQ, subset_size=5, policy_kwargs=dict(n_critics=5))
    with pytest.raises(ValueError, match="subset_size=5"):
        small(REDQ, subset_size=5, policy_kwargs=dict(n_critics=4))


@pytest.mark.parametrize(
    "name, value, nearest",
    [
        ("target_mode", "mni", "min"),
        ("target_mode", "maen", "mean"),
        ("critic_loss", "hubre", "huber"),
        ("critic_loss", "MSE", None),
        ("critic_loss", "rehe_element", "rehe_elementwise"),
        ("critic_loss", None, None),
        ("target_mode", 3, None),
    ],
)
def test_choices(make, name, value, nearest):
    message = refused(make, name, value, ValueError)
    if nearest is not None:
        assert f"did you mean '{nearest}'?" in message


@pytest.mark.parametrize(
    "kwargs, message",
    [
        (dict(critic_loss="hl_gauss"), "critic_loss='hl_gauss': expected policy_kwargs with a value_range (low, high)"),
        (dict(critic_loss="huber", policy_kwargs=dict(value_range=(0, 1))), "critic_loss='huber': expected 'hl_gauss' with"),
        (dict(critic_loss="hl_gauss", policy_kwargs=dict(value_range=(1, 0))), "value_range=(1, 0): expected the smaller"),
        (dict(critic_loss="hl_gauss", policy_kwargs=dict(value_range=7)), "value_range=7: expected two numbers"),
        (dict(critic_loss="hl_gauss", policy_kwargs=dict(value_range=(0, 1), n_bins=1)), "n_bins=1: expected an integer >= 2"),
    ],
)
def test_critics_that_classify(make, kwargs, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        make(**kwargs)


def test_the_mean_of_classifications_is_none(small):
    with pytest.raises(ValueError, match="critic_reduction='ensemble_mean': expected 'independent' for 'hl_gauss'"):
        small(REDQ, critic_loss="hl_gauss", critic_reduction="ensemble_mean", policy_kwargs=dict(value_range=(0, 1)))


@pytest.mark.parametrize("value", [(1.5, 0), [1, 1.5]])
def test_each_of_two_mixes(small, value):
    with pytest.raises(ValueError, match=r"min_mix=1\.5: expected a number >= 0 and <= 1"):
        small(Symphony, min_mix=value)


@pytest.mark.parametrize(
    "value, message",
    [
        ((0, 1, 100), r"min_mix=\(0, 1, 100\): expected a number, or four"),
        ((0, 1.5, 0, 100), r"min_mix=1\.5: expected a number >= 0 and <= 1"),
        ((0, 1, -1, 100), "first step=-1: expected an integer >= 0"),
        ((0, 1, 100, 100), "last step=100: expected an integer >= 101"),
    ],
)
def test_moving_mix(small, value, message):
    with pytest.raises(ValueError, match=message):
        small(Symphony, min_mix=(value, 0))


@pytest.mark.parametrize("cls", [REDQ, DroQ])
def test_reduction(small, cls):
    message = refused(lambda **kwargs: small(cls, **kwargs), "critic_reduction", "ensemble_men", ValueError)
    assert "did you mean 'ensemble_mean'?" in message


@pytest.mark.parametrize(
    "name, value",
    [
        ("critic_engine", "fusd"),
        ("dropout_rate", -0.1),
        ("dropout_rate", 1.0),
        ("dropout_rate", 1.5),
        ("dropout_rate", math.nan),
        ("dropout_rate", True),
        ("n_critics", 0),
        ("n_critics", True),
        ("n_critics", "2"),
        ("n_critics", 2.5),
        ("actor_averaging", -0.1),
        ("actor_averaging", 1.1),
        ("actor_averaging", "0.1"),
    ],
    ids=str,
)
def test_policy_arguments(make, name, value):
    refused(lambda **kwargs: make(policy_kwargs=kwargs), name, value)


@pytest.mark.parametrize("net_arch", [[0], [16, -1], [16.5], ["16"], [True]], ids=str)
def test_net_arch(make, net_arch):
    with pytest.raises((ValueError, TypeError), match="net_arch"):
        make(policy_kwargs=dict(net_arch=net_arch))


def test_unknown_policy_argument(make):
    with pytest.raises(TypeError, match="no_such_argument"):
        make(policy_kwargs=dict(no_such_argument=1))


def test_unknown_argument(make):
    with pytest.raises(TypeError, match="no_such_argument"):
        make(no_such_argument=1)


@pytest.mark.parametrize("train_freq", [0, -1, (0, "step"), (-1, "episode"), True], ids=str)
def test_train_freq_must_be_positive(make, train_freq):
    """SB3 itself notices at ``learn()``, by an assertion."""
    with pytest.raises((ValueError, TypeError), match="train_freq"):
        make(train_freq=train_freq)


@pytest.mark.parametrize("train_freq", ["4", ([1], "step"), (1.5, "step"), (1, "steps"), (1, "")], ids=str)
def test_train_freq(make, train_freq):
    with pytest.raises((ValueError, TypeError), match="train_freq"):
        make(train_freq=train_freq)


@pytest.mark.parametrize("replay_buffer_class", [FadingReplayBuffer, PrioritizedReplayBuffer])
def test_memory_optimisation_is_refused(make, replay_buffer_class):
    with pytest.raises(ValueError, match="optimize_memory_usage"):
        make(replay_buffer_class=replay_buffer_class, optimize_memory_usage=True)


def test_memory_optimisation_of_symphonys_default_buffer(small):
    with pytest.raises(ValueError, match="optimize_memory_usage"):
        small(Symphony, optimize_memory_usage=True)


def test_memory_optimisation_and_n_steps(make):
    with pytest.raises(ValueError, match="optimize_memory_usage"):
        make(optimize_memory_usage=True, n_steps=3)


@pytest.mark.parametrize("fade_factor", [0, -1.0, math.nan])
def test_fade_factor(make, fade_factor):
    with pytest.raises(ValueError, match="fade_factor"):
        make(replay_buffer_class=FadingReplayBuffer, replay_buffer_kwargs=dict(fade_factor=fade_factor))


@pytest.mark.parametrize(
    "name, value", [("start_share", -0.1), ("start_share", 1.5), ("start_steps", 0), ("start_steps", 2.5)]
)
def test_share_of_first_steps(make, name, value):
    with pytest.raises((ValueError, TypeError), match=name):
        make(replay_buffer_class=FadingReplayBuffer, replay_buffer_kwargs={name: value})


def test_her_needs_dict_observations(make):
    with pytest.raises((ValueError, TypeError, AssertionError)):
        make(replay_buffer_class=HerReplayBuffer)


def test_gsde_needs_a_stochastic_actor(small):
    with pytest.raises(TypeError, match="use_sde"):
        small(Symphony, use_sde=True)


def test_numpy_numbers_are_numbers(make, algorithm):
    extra = {} if algorithm is Symphony else dict(subset_size=np.int64(2))
    make(
        learning_rate=np.float64(1e-3),
        buffer_size=np.int64(100),
        batch_size=np.int32(8),
        policy_delay=np.int64(2),
        n_critics=np.int64(2),
        gamma=np.float64(0.9),
        stats_window_size=np.int64(9),
        **extra,
    ).learn(30, callback=GreedyEpisodes((0, 1), stall_steps=np.int64(3)))


def test_a_discount_of_numpy_leaves_samples_in_single_precision(make):
    classifying = dict(critic_loss="hl_gauss", policy_kwargs=dict(value_range=(-100, 0)))
    model = make(n_steps=3, gamma=np.float64(0.9), tau=np.float64(0.1), **classifying).learn(40)
    samples = model.replay_buffer.sample(4)
    assert samples.discounts.dtype == samples.rewards.dtype == th.float32


def test_edges_are_allowed(make):
    make(tau=0, gamma=1, learning_rate=0, learning_starts=0).learn(10)
    make(tau=1.0, gamma=0.0, gradient_steps=-1, buffer_size=1, batch_size=1).learn(30)


@pytest.mark.parametrize("noise", [NormalActionNoise(np.zeros(3), np.ones(3)), StickyActionNoise(3)], ids=str)
def test_noise_of_a_wrong_size(make, noise):
    with pytest.raises(ValueError, match=r"action_noise=.*: its shape is \(3,\), expected \(1,\), that of an action"):
        make(action_noise=noise)


def test_one_number_for_several_actions():
    """An own noise has one for each; SB3's may have one mean for all."""
    env = gym.make("BipedalWalker-v3")
    with pytest.raises(ValueError, match=r"its shape is \(1,\), expected \(4,\)"):
        Symphony("MlpPolicy", env, action_noise=DecayingNormalActionNoise(1), buffer_size=10)
    Symphony("MlpPolicy", env, action_noise=NormalActionNoise(np.zeros(1), np.ones(1)), buffer_size=10)


@pytest.mark.parametrize("value", [dict(pi=False, qf=False), "yes", [True, "no"], None], ids=str)
def test_layer_norm_of_redq(small, value):
    with pytest.raises(ValueError, match=r"layer_norm=.*: expected one of True, False"):
        small(REDQ, policy_kwargs=dict(layer_norm=value))


@pytest.mark.parametrize("value", ["yes", dict(pi=True, qf="no"), [True, None]], ids=str)
def test_layer_norm_of_symphony(small, value):
    with pytest.raises(ValueError, match=r"layer_norm=.*: expected one of True, False"):
        small(Symphony, policy_kwargs=dict(layer_norm=value))


@pytest.mark.parametrize("policy", [TD3.policy_aliases["MlpPolicy"], SAC.policy_aliases["MlpPolicy"]])
def test_policies_of_sb3(algorithm, policy):
    with pytest.raises(ValueError, match=rf"policy={policy.__name__}: expected (Symphony|REDQ)Policy or a class derived"):
        algorithm(policy, "Pendulum-v1", buffer_size=10)


LOADED_WRONGLY = [
    dict(n_critics=7),
    dict(target_mode="man"),
    dict(policy_delay=0),
    dict(critic_loss="msee"),
    dict(tau=7.0),
    dict(batch_size=0),
    dict(action_noise="pink"),
    dict(stats_window_size=0),
]


@pytest.mark.parametrize("wrong", LOADED_WRONGLY, ids=lambda wrong: next(iter(wrong)))
def test_arguments_of_load(make, algorithm, tmp_path, wrong):
    """They replace the saved ones, and are looked at like those of a new model."""
    make().save(tmp_path / "model")
    with pytest.raises((ValueError, TypeError), match=f"{next(iter(wrong))}="):
        algorithm.load(tmp_path / "model", **wrong)


def test_own_arguments_of_load(small, tmp_path):
    small(REDQ).save(tmp_path / "redq")
    with pytest.raises(ValueError, match="subset_size=20: expected at most n_critics=3"):
        REDQ.load(tmp_path / "redq", subset_size=20)
    small(Symphony).save(tmp_path / "symphony")
    with pytest.raises(ValueError, match="did you mean 'rehae'"):
        Symphony.load(tmp_path / "symphony", actor_loss="rehaee")
    with pytest.raises(ValueError, match="critic_reduction='ensemble'"):
        REDQ.load(tmp_path / "redq", critic_reduction="ensemble")
    for name in ("critic_reduction", "use_sde"):  # its base classes have them
        with pytest.raises(TypeError, match=f"unexpected argument '{name}'"):
            Symphony.load(tmp_path / "symphony", **{name: "independent"})
    with pytest.raises(ValueError, match="target_entropy='mbpo': expected an env"):
        REDQ.load(tmp_path / "redq", target_entropy="mbpo")


def test_models_of_another_algorithm(small, tmp_path):
    small(REDQ).save(tmp_path / "redq")
    small(Symphony).save(tmp_path / "symphony")
    with pytest.raises(ValueError, match="policy=REDQPolicy: expected SymphonyPolicy"):
        Symphony.load(tmp_path / "redq")
    with pytest.raises(ValueError, match="policy=SymphonyPolicy: expected REDQPolicy"):
        REDQ.load(tmp_path / "symphony")


def test_unknown_arguments_of_load(make, algorithm, tmp_path):
    make().save(tmp_path / "model")
    with pytest.raises(TypeError, match=r"load\(\) got an unexpected argument 'gama': did you mean 'gamma'\?"):
        algorithm.load(tmp_path / "model", gama=0.5)
    assert algorithm.load(tmp_path / "model", gamma=0.5, verbose=0).gamma == 0.5
    for name in ("policy", "args", "kwargs", "support_multi_env"):  # signatures have them, a saved model does not
        with pytest.raises(TypeError, match=f"unexpected argument {name!r}"):
            algorithm.load(tmp_path / "model", **{name: "CnnPolicy"})


class Narrow(REDQ):
    """Takes less than its parent."""

    def __init__(self, policy, env, device="auto", _init_setup_model=True):
        small = dict(n_critics=3, buffer_size=100, policy_kwargs=dict(net_arch=[8]))
        super().__init__(policy, env, device=device, _init_setup_model=_init_setup_model, **small)


def test_own_constructors(tmp_path):
    Narrow("MlpPolicy", "Pendulum-v1").save(tmp_path / "model")
    loaded = Narrow.load(tmp_path / "model", gamma=0.5)
    assert (loaded.n_critics, loaded.gamma) == (3, 0.5)


def test_statistics_of_load(make, algorithm, tmp_path):
    model = make().learn(76)
    assert len(model.ep_info_buffer) == 3
    model.save(tmp_path / "model")
    loaded = algorithm.load(tmp_path / "model", env=model.env, stats_window_size=2)
    assert list(loaded.ep_info_buffer) == list(model.ep_info_buffer)[1:]
    assert loaded.learn(60, reset_num_timesteps=False).ep_info_buffer.maxlen == 2
    assert loaded.learn(30).ep_info_buffer.maxlen == 2


def test_sde_of_load(small, tmp_path):
    for use_sde in (False, True):
        small(REDQ, use_sde=use_sde).save(tmp_path / "model")
        with pytest.raises(ValueError, match=f"use_sde={not use_sde}: the saved model has {use_sde}"):
            REDQ.load(tmp_path / "model", use_sde=not use_sde)


def test_policy_kwargs_of_load(make, algorithm, tmp_path):
    """Those that a model was made with load again, though constructors add to them."""
    given = dict(net_arch=[8], n_critics=2)
    make(policy_kwargs=given).save(tmp_path / "model")
    assert algorithm.load(tmp_path / "model", policy_kwargs=given).policy.net_arch == [8]
    assert given == dict(net_arch=[8], n_critics=2)
    assert algorithm.load(tmp_path / "model", policy_kwargs=dict(net_arch=[8], actor_averaging=0.0)).n_critics == 2
    with pytest.raises(ValueError, match=r"policy_kwargs has net_arch=\[9\]: the saved model has \[8\]"):
        algorithm.load(tmp_path / "model", policy_kwargs=dict(net_arch=[9]))


def test_entropy_coefficients_of_load(small, tmp_path):
    small(REDQ, ent_coef=0.1).save(tmp_path / "fixed")
    assert REDQ.load(tmp_path / "fixed")._current_ent_coef().item() == pytest.approx(0.1)
    assert REDQ.load(tmp_path / "fixed", ent_coef=0.5)._current_ent_coef().item() == 0.5
    with pytest.raises(ValueError, match="ent_coef='auto': the saved model has a fixed one"):
        REDQ.load(tmp_path / "fixed", ent_coef="auto")
    small(REDQ).save(tmp_path / "learned")
    with pytest.raises(ValueError, match=r"ent_coef=0\.1: the saved model has a learned one"):
        REDQ.load(tmp_path / "learned", ent_coef=0.1)


def test_a_replay_buffer_takes_the_horizon_of_the_model(make, algorithm, tmp_path):
    model = make(n_steps=3, gamma=0.9).learn(60)
    model.save(tmp_path / "model")
    model.save_replay_buffer(tmp_path / "buffer")
    loaded = algorithm.load(tmp_path / "model", env=model.get_env(), n_steps=2, gamma=0.5)
    loaded.load_replay_buffer(tmp_path / "buffer")
    discounts = loaded.replay_buffer.sample(200).discounts
    assert {0.25} <= set(discounts.flatten().tolist()) <= {0.25, 0.5}  # the last step of an episode has one reward
    assert model.replay_buffer.sample(200).discounts.min().item() == pytest.approx(0.9**3)


@pytest.mark.parametrize("truncate", [True, False])
def test_a_replay_buffer_of_another_episode(make, tmp_path, truncate):
    """Its n-step returns do not go on with the episode that the model is in."""
    other = make(n_steps=3, gamma=0.5, gradient_steps=0).learn(30)
    other.save_replay_buffer(tmp_path / "buffer")
    model = make(n_steps=3, gamma=0.5, gradient_steps=0, seed=1).learn(30)
    model.load_replay_buffer(tmp_path / "buffer", truncate_last_traj=truncate)
    model.learn(10, reset_num_timesteps=False)
    rewards = model.replay_buffer.rewards[:, 0]
    last = model.replay_buffer._get_samples(np.array([29]))
    own = rewards[29] if truncate else rewards[29] + 0.5 * rewards[30] + 0.25 * rewards[31]
    assert last.rewards.item() == pytest.approx(own) and last.dones.item() == 0


def test_a_replay_buffer_without_horizon(small, tmp_path):
    plain = small(REDQ, replay_buffer_class=ReplayBuffer).learn(30)
    plain.save_replay_buffer(tmp_path / "buffer")
    model = small(REDQ, n_steps=3)
    own = model.replay_buffer
    with pytest.raises(ValueError, match="n_steps=3: the saved ReplayBuffer has no n-step returns"):
        model.load_replay_buffer(tmp_path / "buffer")
    assert model.replay_buffer is own


def test_a_replay_buffer_of_more_environments(small, tmp_path):
    small(REDQ, n_envs=2).learn(30).save_replay_buffer(tmp_path / "buffer")
    model = small(REDQ)
    own = model.replay_buffer
    with pytest.raises(ValueError, match="n_envs=1: the saved ReplayBuffer is of 2"):
        model.load_replay_buffer(tmp_path / "buffer")
    assert model.replay_buffer is own


def test_a_replay_buffer_of_another_task(small, tmp_path):
    model = small(REDQ)
    own = model.replay_buffer
    other = spaces.Dict(x=model.observation_space)
    save_to_pkl(tmp_path / "buffer.pkl", DictReplayBuffer(10, other, model.action_space))
    with pytest.raises(ValueError, match=r"observation_space=Box.*: the saved DictReplayBuffer is of Dict"):
        model.load_replay_buffer(tmp_path / "buffer.pkl")
    save_to_pkl(tmp_path / "buffer.pkl", {"not": "a buffer"})
    with pytest.raises(ValueError, match=r"buffer\.pkl: .*ReplayBuffer"):
        model.load_replay_buffer(tmp_path / "buffer.pkl")
    with pytest.raises(FileNotFoundError):
        model.load_replay_buffer(tmp_path / "nothing")
    assert model.replay_buffer is own


def test_a_subset_that_is_not_drawn(small):
    assert small(REDQ, n_critics=1, target_mode="mean").learn(30).num_timesteps == 30


def test_a_noise_is_an_object(small):
    with pytest.raises(TypeError, match="action_noise='default': expected an ActionNoise or None"):
        small(REDQ, action_noise="default")
    with pytest.raises(ValueError, match=r"action_noise='defalt': expected one of 'default': did you mean 'default'\?"):
        small(Symphony, action_noise="defalt")


@pytest.mark.parametrize("ent_coef", [0, 1, 0.0])
def test_whole_entropy_coefficients(small, ent_coef):
    assert small(REDQ, ent_coef=ent_coef).learn(40)._n_updates == 20


@pytest.mark.parametrize("n_steps", [1, 3])
def test_the_buffers_horizon_and_discount_are_the_models(make, algorithm, tmp_path, n_steps):
    model = make(n_steps=n_steps, gamma=0.9, replay_buffer_class=FadingReplayBuffer)
    assert (model.replay_buffer.n_steps, model.replay_buffer.gamma) == (n_steps, 0.9)
    assert model.replay_buffer_kwargs == {}  # as given
    model.save(tmp_path / "model")
    loaded = algorithm.load(tmp_path / "model", env=model.env, n_steps=2, gamma=0.8)
    assert (loaded.replay_buffer.n_steps, loaded.replay_buffer.gamma) == (2, 0.8)
    make(n_steps=n_steps, replay_buffer_class=FadingReplayBuffer, replay_buffer_kwargs=dict(n_steps=n_steps))
    for name, value, own in (("n_steps", 5, n_steps), ("gamma", 0.5, 0.99)):
        with pytest.raises(ValueError, match=f"replay_buffer_kwargs has {name}={value}: expected that of the model, {own}"):
            make(n_steps=n_steps, replay_buffer_class=FadingReplayBuffer, replay_buffer_kwargs={name: value})


@pytest.mark.parametrize("name", ["layer_norm", "activation_fn"])
@pytest.mark.parametrize("value", [[], dict(qf=True)], ids=["empty", "one network"])
def test_layers_of_symphony(small, name, value):
    with pytest.raises(ValueError, match=rf"{name}=.*expected (at least one entry|one for both, or a dict with keys)"):
        small(Symphony, policy_kwargs={name: value})


def test_another_implementation_of_adam(make):
    model = make(policy_kwargs=dict(optimizer_kwargs=dict(foreach=True)))
    assert model.critic.optimizer.defaults["foreach"] and not model.critic.optimizer.defaults["fused"]


def test_a_number_of_single_precision(make):
    make(tau=np.float32(0.25))
