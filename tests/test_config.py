"""Reading and checking configurations: safe, with clear messages, and fitting the classes they name."""

import gymnasium as gym
import numpy as np
import pytest
import torch as th
import yaml
from gymnasium import spaces
from stable_baselines3.common.envs import FakeImageEnv
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.utils import LinearSchedule

from sb3_symphony.common.buffers import FadingReplayBuffer
from sb3_symphony.common.checks import suggestion
from sb3_symphony.common.noise import StickyActionNoise
from sb3_symphony.common.regression import FusedRegression
from sb3_symphony.common.wrappers import RewardFloor
from sb3_symphony.experiment.config import (
    ConfigError,
    RunConfig,
    TrainOptions,
    find_entry,
    load_config,
    parse_expression,
    parse_pairs,
    parse_yaml,
    read_yaml,
    shipped_environments,
    shipped_folder,
    validated,
)
from sb3_symphony.experiment.decode import algorithm_arguments, argument_types, class_by_name, typed_arguments
from sb3_symphony.experiment.environment import find_wrapper, for_training_only, split_wrappers
from sb3_symphony.experiment.registry import ALGORITHMS, load_algorithm
from sb3_symphony.experiment.signals import ended_by
from sb3_symphony.experiment.space import TuneOptions

ACTIONS = spaces.Box(-1.0, 1.0, (4,))


def config(algo="sac", env="Pendulum-v1", **hyperparams) -> RunConfig:
    return load_config(validated(TrainOptions, {"algo": algo, "env": env, "hyperparams": hyperparams}))


def decode(algo="sac", env="Pendulum-v1", actions=ACTIONS, **hyperparams):
    return algorithm_arguments(algo, load_algorithm(algo), config(algo, env, **hyperparams), actions)


@pytest.mark.parametrize("text, value", [("1e-3", 1e-3), ("1e6", 1e6), ("-2.5E+2", -250.0), ("3e4", 3e4), ("7_0e1", 700.0)])
def test_numbers_without_a_dot(text, value):
    assert parse_yaml(text, "here") == value


@pytest.mark.parametrize("text", ["1e", "e3", "lin_1e-3", "1e3x"])
def test_text_stays_text(text):
    assert parse_yaml(text, "here") == text


@pytest.mark.parametrize(
    "text",
    ["!!python/object/apply:os.system [ls]", "!!python/name:os.system", "a: !!python/tuple [1, 2]", "!mine {a: 1}"],
)
def test_tags_are_refused(text):
    with pytest.raises(ConfigError, match=r"here, line 1: tag '!.*' refused"):
        parse_yaml(text, "here")


@pytest.mark.parametrize("text", ["{a: [1", "a: b: c", "\t- x", "a: *unknown", "\x00"])
def test_damaged_yaml_is_one_line(text):
    with pytest.raises(ConfigError, match=r"here.*not valid YAML") as error:
        parse_yaml(text, "here")
    assert "\n" not in str(error.value)


def test_pairs():
    assert parse_pairs(["a:1e-3", "b:{c: [1, 2]}", "d:lin_3e-4", "e:'x'"], "-p") == {
        "a": 1e-3,
        "b": {"c": [1, 2]},
        "d": "lin_3e-4",
        "e": "x",
    }
    with pytest.raises(ConfigError, match=r"a=1.*key:value"):
        parse_pairs(["a=1"], "-p")
    with pytest.raises(ConfigError, match="-p: a is given twice, 1 and 2"):
        parse_pairs(["a:1", "b:1", "a:2"], "-p")


def test_zoo_expressions():
    text = "dict(net_arch=dict(pi=[64, 64], qf=(32,)), activation_fn=nn.ReLU, log_std_init=-2, ortho_init=False)"
    expected = {"net_arch": {"pi": [64, 64], "qf": [32]}, "activation_fn": "nn.ReLU", "log_std_init": -2, "ortho_init": False}
    assert parse_expression(text) == expected
    assert parse_expression("{'norm_obs': True, 'norm_reward': False}") == {"norm_obs": True, "norm_reward": False}
    for bad in ("__import__('os').system('ls')", "dict(**{})", "[x for x in y]", "1 +", "dict(a=open('x'))", "{[1]: 2}"):
        with pytest.raises(ConfigError):
            parse_expression(bad)


def test_merging():
    merged = config(**{"batch_size": 64, "policy_kwargs.net_arch": [8], "gamma": 0.9})
    assert merged.plain["learning_rate"] == 1e-3  # shipped for Pendulum-v1
    assert merged.arguments == {"learning_rate": 1e-3, "batch_size": 64, "policy_kwargs": {"net_arch": [8]}, "gamma": 0.9}
    walker = config(env="BipedalWalker-v3", **{"policy_kwargs.net_arch": [8]})
    assert walker.arguments["policy_kwargs"] == {"net_arch": [8], "log_std_init": -3, "use_expln": True}
    unknown_env = config(env="Reacher-v4")
    assert unknown_env.settings.n_timesteps == 1_000_000  # the default entry


def test_conf_file_stands_instead_of_the_shipped_one(tmp_path):
    path = tmp_path / "own.yml"
    path.write_text("Pendulum-v1: {n_timesteps: 1e3, batch_size: 32}\ndefault: {n_timesteps: 7, policy: MlpPolicy}\n")
    options = {"algo": "sac", "env": "Pendulum-v1", "conf_file": str(path)}
    loaded = load_config(validated(TrainOptions, options))
    assert loaded.plain == {"n_timesteps": 1000, "batch_size": 32}
    assert load_config(validated(TrainOptions, {**options, "env": "X-v0"})).settings.n_timesteps == 7
    path.write_text("n_timesteps: 5\ngamma: 0.5\n")  # flat, as in a run folder
    assert load_config(validated(TrainOptions, options)).plain == {"n_timesteps": 5, "gamma": 0.5}
    assert load_config(validated(TrainOptions, {**options, "n_timesteps": 9})).plain["n_timesteps"] == 9


def test_values_are_decoded():
    arguments = decode(
        learning_rate="lin_3e-4",
        buffer_size=1e4,
        train_freq=[1, "episode"],
        action_noise={"StickyActionNoise": {"sigma": 0.2, "hold": 3}},
        replay_buffer_class="FadingReplayBuffer",
        replay_buffer_kwargs={"fade_factor": 5},
        policy_kwargs={"activation_fn": "nn.ELU", "optimizer_class": "AdamW", "net_arch": {"pi": [8], "qf": [16]}},
        ent_coef="auto_0.1",
    )
    assert isinstance(arguments["learning_rate"], LinearSchedule)
    assert arguments["learning_rate"](0.5) == pytest.approx(1.5e-4)
    assert arguments["buffer_size"] == 10_000 and isinstance(arguments["buffer_size"], int)
    assert arguments["train_freq"] == (1, "episode")
    noise = arguments["action_noise"]
    assert isinstance(noise, StickyActionNoise) and noise.n_actions == 4 and noise.hold == 3
    assert arguments["replay_buffer_class"] is FadingReplayBuffer
    assert arguments["policy_kwargs"]["activation_fn"] is th.nn.ELU
    assert arguments["policy_kwargs"]["optimizer_class"] is th.optim.AdamW
    assert arguments["policy_kwargs"]["net_arch"] == {"pi": [8], "qf": [16]}
    assert arguments["ent_coef"] == "auto_0.1"


def test_zoo_noise():
    noise = decode("td3", noise_type="normal", noise_std=0.3)["action_noise"]
    assert isinstance(noise, NormalActionNoise)
    np.testing.assert_array_equal(noise._sigma, np.full(4, 0.3))


def test_action_noise():
    for name in ("NormalActionNoise", "OrnsteinUhlenbeckActionNoise", "StickyActionNoise", "PinkActionNoise"):
        value = {name: {"sigma": 0.3}}
        noise = decode("sac", action_noise=value)["action_noise"]
        assert type(noise).__name__ == name and noise().shape == (4,)
        assert value == {name: {"sigma": 0.3}}  # the run folder keeps what was written, in plain values
    assert decode("symphony", action_noise="default")["action_noise"] == "default"
    assert decode("symphony", action_noise=None)["action_noise"] is None


def test_class_names():
    for name in ("ReLU", "nn.ReLU", "th.nn.ReLU", "torch.nn.ReLU"):
        assert class_by_name("activation_fn", name) is th.nn.ReLU
    for name in ("LU", "os.system", "torch.nn.Linear", "torch.optim.Adam", 5, ""):
        with pytest.raises(ConfigError, match="unknown class"):
            class_by_name("activation_fn", name)


@pytest.mark.parametrize(
    "algo, key, value, message",
    [
        (
            "symphony",
            "learning_ratee",
            1,
            "unknown hyper-parameter 'learning_ratee' for symphony: did you mean 'learning_rate'?",
        ),
        ("sac", "learning_rate", "fast", "learning_rate: 'fast' — expected a number or lin_<number>"),
        ("sac", "learning_rate", "lin_fast", "expected a number or lin_<number>"),
        ("sac", "learning_rate", True, "expected a number or lin_<number>"),
        ("sac", "learning_rate", "lin_-1", "expected a number >= 0"),
        ("sac", "learning_rate", float("nan"), "expected a finite number"),
        ("redq", "buffer_size", -5, "buffer_size: -5 — expected a number >= 1"),
        ("sac", "batch_size", 1.5, "batch_size: 1.5 — expected a whole number"),
        ("sac", "gamma", 1.1, r"expected a number in \[0, 1\]"),
        ("sac", "train_freq", "often", r"expected a whole number or \[a whole number, a name\]"),
        ("sac", "policy", "MlpPolcy", "did you mean 'MlpPolicy'"),
        ("sac", "policy_kwargs.net_archh", [4], "did you mean 'net_arch'"),
        ("sac", "policy_kwargs.net_arch", [4, 0], "expected a number >= 1"),
        ("sac", "policy_kwargs.activation_fn", "Relu", "did you mean 'ReLU'"),
        ("sac", "policy_kwargs", [1], r"policy_kwargs: \[1\] — expected a mapping"),
        ("sac", "replay_buffer_class", "FadeReplayBuffer", "did you mean"),
        ("sac", "replay_buffer_class", "PrioritizedReplayBuffer", "does not apply its importance weights"),
        ("sac", "action_noise", {"StickyActionNoise": {"sigm": 1}}, "did you mean 'sigma'"),
        ("sac", "action_noise", {"StickyActionNoise": {"sigma": -1}}, "expected a number >= 0"),
        (
            "sac",
            "action_noise",
            {"NormalActionNoise": {"sigma": "abc"}},
            "NormalActionNoise: sigma: 'abc' — expected a number or",
        ),
        ("sac", "action_noise", {"NormalActionNoise": {"sigma": -1}}, "expected a number >= 0"),
        (
            "sac",
            "action_noise",
            {"NormalActionNoise": {"sigma": [0.1, 0.2, 0.3]}},
            "action_noise: NormalActionNoise: could not",
        ),
        ("sac", "action_noise", {"OrnsteinUhlenbeckActionNoise": {"sigma": 0.1, "theta": "abc"}}, "theta: 'abc' — expected a"),
        ("sac", "action_noise", 0.1, "action_noise: 0.1 — expected {NameOfTheNoise"),
        ("ppo", "policy_kwargs.net_arch", {"pi": [8], "v": [8]}, "unknown net_arch key 'v' for .*did you mean 'vf'"),
        ("td3", "policy_kwargs.net_arch", {"pi": [8], "vf": [8]}, "unknown net_arch key 'vf' for TD3Policy"),
        ("sac", "ent_coef", "foo", "ent_coef: 'foo' — expected a number or auto or auto_<number>"),
        ("tqc", "ent_coef", "auto_foo", "ent_coef: 'auto_foo' — expected"),
        ("sac", "target_entropy", "foo", "target_entropy: 'foo' — expected a number or auto"),
        ("symphony", "replay_buffer_kwargs.fade_facto", 3, "did you mean 'fade_factor'"),
        ("redq", "replay_buffer_kwargs.fade", 3, "unknown replay_buffer_kwargs key 'fade' for"),
        ("sac", "seed", 3, "set on the command line"),
        ("sac", "device", "cpu", "set on the command line"),
        ("sac", "n_envs", 0, "n_envs: 0 — expected a number >= 1"),
        ("sac", "n_envs", True, "n_envs: True — expected a whole number"),
        ("sac", "n_timesteps", "many", "n_timesteps: 'many' — expected a whole number"),
        ("sac", "env_wrapper", 3, "expected a dotted name"),
        ("sac", "noise_type", "normal", "expected both or neither"),
        (
            "td3",
            "policy_kwargs.optimizer_kwargs",
            {"weight_dekay": 1},
            "optimizer_kwargs key 'weight_dekay' for Adam: did you",
        ),
        ("td3", "policy_kwargs.optimizer_kwargs", {"lr": 1}, "unknown optimizer_kwargs key 'lr' for Adam"),
        (
            "symphony",
            "policy_kwargs",
            {"optimizer_class": "SGD", "optimizer_kwargs": {"betas": [0, 0]}},
            "unknown optimizer_kwargs key 'betas' for SGD",
        ),
        ("sac", "policy_kwargs.optimizer_kwargs", {"eps": "small"}, "optimizer_kwargs: eps: 'small' — expected a number"),
        ("sac", "policy_kwargs.optimizer_kwargs", {"betas": 0.9}, r"betas: 0.9 — expected \[a number, a number\]$"),
        ("tqc", "top_quantiles_to_drop_per_net", 25, "25 — expected fewer than the n_quantiles of a critic, 25"),
        ("tqc", "policy_kwargs.n_quantiles", 2, "top_quantiles_to_drop_per_net: 2 — expected fewer than the n_quantiles"),
        (
            "redq",
            "policy_kwargs.features_extractor_kwargs",
            {"dim": 3},
            "features_extractor_kwargs key 'dim' for FlattenExtractor",
        ),
        (
            "ppo",
            "policy_kwargs",
            {"features_extractor_class": "NatureCNN", "features_extractor_kwargs": {"feature_dim": 3}},
            "for NatureCNN: did you mean 'features_dim'",
        ),
        ("td3", "replay_buffer_kwargs.handle_timeout_terminaton", False, "did you mean 'handle_timeout_termination'"),
        ("sac", "replay_buffer_kwargs.buffer_size", 3, "unknown replay_buffer_kwargs key 'buffer_size'"),
        ("td3", "noise_type", "pink", "noise_type: 'pink' — expected 'normal' or 'ornstein-uhlenbeck'"),
    ],
)
def test_wrong_values(algo, key, value, message):
    with pytest.raises(ConfigError, match=message) as error:
        decode(algo, **{key: value})
    assert "\n" not in str(error.value)


def test_noise_type_for_an_algorithm_without_noise():
    with pytest.raises(ConfigError, match="noise_type: 'normal' — ppo takes no action noise"):
        decode("ppo", noise_type="normal", noise_std=0.1)


def test_two_noises():
    with pytest.raises(
        ConfigError, match="action_noise: beside it the configuration has noise_type 'normal' — expected action_noise: null"
    ):
        decode("td3", noise_type="normal", noise_std=0.1, action_noise={"PinkActionNoise": {"sigma": 0.3}})


def test_wrappers():
    assert find_wrapper("sb3_symphony.common.wrappers.RewardFloor") is RewardFloor
    named = [("gymnasium.wrappers.ClipAction", {}), ("sb3_symphony.common.wrappers.RewardFloor", {"floor": -3})]
    task, training = split_wrappers(named)
    assert [w.func for w in task] == [gym.wrappers.ClipAction] and [w.func for w in training] == [RewardFloor]
    for name in (
        "os.system",
        "gymnasium.wrappers.NormalizeObservation",  # whose statistics would not be kept
        "gymnasium.wrappers.NormalizeReward",
        "stable_baselines3.common.monitor.Monitor",  # writes files
        "gymnasium.wrappers.RecordVideo",
        "gymnasium.wrappers.np",
        "sb3_contrib.nothing.X",
        "sb3_symphony.cli.main",
    ):
        with pytest.raises(ConfigError, match="env_wrapper"):
            find_wrapper(name)
    with pytest.raises(ConfigError, match="NormalizeReward' — expected as the key normalize"):
        find_wrapper("gymnasium.wrappers.NormalizeReward")
    for name in ("gymnasium.wrappers.ClipReward", "stable_baselines3.common.atari_wrappers.ClipRewardEnv"):
        assert for_training_only(name)
    with pytest.raises(ConfigError, match="did you mean 'RewardFloor'"):
        find_wrapper("sb3_symphony.common.wrappers.RewardFlor")
    with pytest.raises(ConfigError, match="did you mean 'floor'"):
        split_wrappers([("sb3_symphony.common.wrappers.RewardFloor", {"flor": 1})])
    with pytest.raises(ConfigError, match="expected a number"):
        split_wrappers([("sb3_symphony.common.wrappers.RewardFloor", {"floor": "low"})])


def test_episodes_as_a_unit_need_one_environment():
    assert decode("td3", train_freq=[1, "episode"])["train_freq"] == (1, "episode")
    with pytest.raises(ConfigError, match=r"train_freq: \[1, 'episode'\] — expected steps where n_envs is 2"):
        decode("td3", train_freq=[1, "episode"], n_envs=2)


@pytest.mark.parametrize("limit", [-1, -1.0, [-1, -0.5, -1, -0.5, -1]])
def test_arrays_of_wrappers(limit):
    """Gymnasium annotates such arguments with NumPy's numbers and arrays."""
    (wrapper,), _ = split_wrappers([("gymnasium.wrappers.RescaleAction", {"min_action": limit, "max_action": 1})])
    env = wrapper(FakeImageEnv(discrete=False))  # five actions
    np.testing.assert_array_equal(env.action_space.low, np.broadcast_to(limit, env.action_space.shape))
    with pytest.raises(ConfigError, match=r"RescaleAction: min_action: 'low' — expected a number or \[a number, …\]"):
        split_wrappers([("gymnasium.wrappers.RescaleAction", {"min_action": "low", "max_action": 1})])


def test_annotations_that_are_none():
    """A user's own class may annotate its arguments with anything."""

    class Odd:
        def __init__(self, x: [int], y: "3" = 3):
            pass

    assert typed_arguments({"x": 1, "y": "a"}, Odd, []) == {"x": 1, "y": "a"}


def test_suggestions():
    assert suggestion("bipedalwalker-v3", ["BipedalWalker-v3"]) == ": did you mean 'BipedalWalker-v3'?"
    assert suggestion("zzz", ["sac"]) == ""


def test_every_algorithm_is_shipped_for_the_main_environments():
    wanted = {"Pendulum-v1", "BipedalWalker-v3", "BipedalWalkerHardcore-v3", "Hopper-v4", "Hopper-v5"}
    for algo in ALGORITHMS:
        assert wanted <= set(shipped_environments(algo)), algo
    for algo in set(ALGORITHMS) - {"symphony", "redq", "droq"}:  # RL Zoo's values; ours have a default for other tasks
        assert "LunarLanderContinuous-v3" in shipped_environments(algo), algo


@pytest.mark.parametrize("algo", ALGORITHMS)
def test_every_shipped_entry_fits_its_class(algo):
    for env in [*shipped_environments(algo), "default"]:
        loaded = config(algo, env)
        assert yaml.safe_load(yaml.safe_dump(loaded.plain)) == loaded.plain
        arguments = algorithm_arguments(algo, load_algorithm(algo), loaded, ACTIONS)
        assert arguments.keys() <= argument_types(load_algorithm(algo)).keys()
        split_wrappers(loaded.settings.env_wrapper)


@pytest.mark.parametrize("algo", ["symphony", "redq", "droq"])
def test_every_shipped_entry_takes_the_fused_way(algo):
    for env in shipped_environments(algo):
        made = gym.make(env)
        model = load_algorithm(algo)(env=made, device="cpu", **decode(algo, env, made.action_space))
        assert type(model._regression) is FusedRegression, env


def test_shipped_hopper_entries_agree():
    for algo in ALGORITHMS:
        content = read_yaml(shipped_folder() / f"{algo}.yml")
        assert content["Hopper-v4"] == content["Hopper-v5"], algo


def test_arguments_of_the_optimizer_as_it_takes_them():
    arguments = decode("tqc", policy_kwargs={"optimizer_kwargs": {"betas": [0.9, 0.99], "eps": "1e-5"}})
    assert arguments["policy_kwargs"]["optimizer_kwargs"] == {"betas": (0.9, 0.99), "eps": 1e-5}


def test_one_quantile_of_a_critic_is_enough():
    decode("tqc", top_quantiles_to_drop_per_net=24)
    decode("tqc", policy_kwargs={"n_quantiles": 3})


@pytest.mark.parametrize("value", [float("inf"), "1e-3", [3e-4]])
def test_a_number_may_be_text_but_nothing_else(value):
    if value == "1e-3":  # zoo's inner quotes
        assert decode(learning_rate=value)["learning_rate"] == 1e-3
    else:
        with pytest.raises(ConfigError):
            decode(learning_rate=value)


@pytest.mark.parametrize("env", ["Pendulum-v1", "gymnasium:Pendulum-v1"])
def test_the_module_of_an_environment_is_no_part_of_its_name(tmp_path, monkeypatch, env):
    monkeypatch.chdir(tmp_path)
    assert find_entry(TrainOptions(algo="sac", env=env))[0] == "sac.yml, Pendulum-v1"
    (tmp_path / "own.yml").write_text("Pendulum-v1: {n_timesteps: 1}\ngymnasium:Pendulum-v1: {n_timesteps: 2}\n")
    entry = find_entry(TrainOptions(algo="sac", env=env, conf_file="own.yml"))[1]
    assert entry == {"n_timesteps": 2 if ":" in env else 1}


@pytest.mark.parametrize("text", ["Hopper-v5: {gamma: 0.9}", "Own: {n_timesteps: 9}"])
def test_a_file_without_the_environment(tmp_path, text):
    (tmp_path / "own.yml").write_text(text)
    with pytest.raises(ConfigError, match=r"own\.yml: no entry for 'Pendulum-v1'"):
        find_entry(TrainOptions(algo="sac", env="Pendulum-v1", n_timesteps=5, conf_file=str(tmp_path / "own.yml")))


@pytest.mark.parametrize("text", ["a: 1\nb: 2\na: 3", "x: {a: 1, a: 1}", "- {a: 1}\n- {1: a, 1: b}"])
def test_keys_twice_are_refused(text):
    with pytest.raises(ConfigError, match="is there twice"):
        parse_yaml(text, "here")


def test_merged_keys_may_be_changed():
    text = "a: &a {x: 1, y: 2}\nb: {<<: *a, y: 3, '1': 5, 1: 6}\nc: {<<: *a, x: 4}"
    content = parse_yaml(text, "here")
    assert content["b"] == {"x": 1, "y": 3, "1": 5, 1: 6} and content["c"] == {"x": 4, "y": 2}


def test_misspelt_presets_and_keys(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name, message in (("symphony-orignal", "did you mean 'symphony-original'"), ("xyz", "expected a YAML file or one of")):
        with pytest.raises(ConfigError, match=message):
            load_config(validated(TrainOptions, {"conf_file": name}))
    (tmp_path / "own.yml").write_text("n_timestep: 1000")
    with pytest.raises(ConfigError, match="unknown hyper-parameter 'n_timestep': did you mean 'n_timesteps'"):
        load_config(validated(TrainOptions, {"conf_file": "own.yml"}))


def test_presets_are_found_by_name():
    presets = [path.stem for path in (shipped_folder() / "presets").glob("*.yml")]
    assert {"symphony-original", "symphony-enhanced"} <= set(presets)
    for name in presets:
        options = validated(TrainOptions, {"algo": "symphony", "env": "BipedalWalker-v3", "conf_file": name})
        arguments = algorithm_arguments("symphony", load_algorithm("symphony"), load_config(options), ACTIONS)
        assert arguments.get("n_critics", 2) == (1 if name == "symphony-original" else 2)
        assert "env_wrapper" not in load_config(options).plain


def test_bounds_are_told_in_signs():
    with pytest.raises(ConfigError, match="timeout: 0 — expected a number > 0"):
        validated(TuneOptions, {"timeout": 0})


def test_signals_without_a_name():
    assert ended_by(-9) == "its process was ended by SIGKILL (out of memory?)"
    assert ended_by(-50) == "its process was ended by signal 50"  # a real-time one
