"""Search spaces: what is read from YAML, what Optuna is asked for, and one clear line for every mistake."""

import math

import optuna
import pytest
import yaml

from sb3_symphony.experiment.config import ConfigError, shipped_folder
from sb3_symphony.experiment.registry import ALGORITHMS
from sb3_symphony.experiment.space import Choice, Interval, SearchSpace, TuneOptions, parse_space, read_space
from sb3_symphony.experiment.tune import Plan

optuna.logging.set_verbosity(optuna.logging.WARNING)


def written(folder, text: str, **options) -> SearchSpace:
    """The space of a YAML file."""
    (folder / "space.yml").write_text(text)
    return read_space(TuneOptions(space=str(folder / "space.yml"), **options))


def test_kinds_of_parameters(tmp_path):
    space = written(
        tmp_path,
        """
        learning_rate: {float: [1e-5, 1], log: true}
        vf_coef: {float: [0, 1]}
        learning_starts: {int: [1000, 1e4], step: 500}
        gamma: [0.9, 0.99]
        policy_kwargs.net_arch: [[64, 64], {pi: [8], qf: [16]}]
        batch_size: [256]
        """,
    )
    assert space.parameters == {
        "learning_rate": Interval(1e-5, 1.0, log=True),
        "vf_coef": Interval(0.0, 1.0),
        "learning_starts": Interval(1000, 10_000, step=500),
        "gamma": Choice((0.9, 0.99)),
        "policy_kwargs.net_arch": Choice(([64, 64], {"pi": [8], "qf": [16]})),
    }
    assert space.fixed == {"batch_size": 256}
    assert isinstance(space.parameters["vf_coef"].low, float) and isinstance(space.parameters["learning_starts"].high, int)
    assert parse_space(space.plain(), "a study") == SearchSpace("a study", space.parameters, space.fixed)


def test_suggested_values_are_those_of_the_space(tmp_path):
    space = written(
        tmp_path,
        """
        learning_rate: {float: [1e-5, 1], log: true}
        learning_starts: {int: [1000, 10000], step: 500}
        n_epochs: {int: [1, 1000], log: true}
        policy_kwargs.net_arch: [[64, 64], {pi: [8], qf: [16]}]
        batch_size: [256]
        """,
    )
    study = optuna.create_study(sampler=optuna.samplers.RandomSampler(seed=0))
    trials = [study.ask() for _ in range(200)]
    drawn = [space.suggest(trial) for trial in trials]
    rates = [values["learning_rate"] for values in drawn]
    assert 1e-5 <= min(rates) and max(rates) <= 1 and sum(rate < math.sqrt(1e-5) for rate in rates) in range(80, 121)
    starts = {values["learning_starts"] for values in drawn}
    assert starts == set(range(1000, 10_001, 500)) and all(isinstance(value, int) for value in starts)
    assert sum(values["n_epochs"] <= 31 for values in drawn) in range(90, 131)
    assert {str(values["policy_kwargs.net_arch"]) for values in drawn} == {"[64, 64]", "{'pi': [8], 'qf': [16]}"}
    assert all(values["batch_size"] == 256 for values in drawn)
    assert [space.values(trial.params) for trial in trials] == drawn


def test_examples_hold_every_choice_and_both_ends(tmp_path):
    space = written(tmp_path, "tau: {float: [0.1, 0.2]}\ngamma: [1, 2, 3]\nbatch_size: [7]\n")
    first = {"batch_size": 7, "tau": 0.1, "gamma": 1}
    assert list(space.examples()) == [
        ("", first),
        ("tau", {**first, "tau": 0.2}),
        ("gamma", {**first, "gamma": 2}),
        ("gamma", {**first, "gamma": 3}),
    ]


def test_whole_ends_do_not_hide_a_wish_for_whole_numbers(tmp_path):
    values = [each for _, each in written(tmp_path, "a: {float: [16, 64]}\nb: {float: [0, 1], step: 0.25}\n").examples()]
    assert [each["a"] for each in values[:2]] == [16, 64] and 16 < values[2]["a"] < 64 and not values[2]["a"].is_integer()
    assert [each["b"] for each in values[3:]] == [1, 0.25]


def test_what_is_given_is_not_searched(tmp_path):
    text = "tau: {float: [0.1, 0.2]}\ngamma: [1, 2, 3]\nbatch_size: [7]\n"
    space = written(tmp_path, text, hyperparams={"gamma": 0.5, "batch_size": 8})
    assert list(space.parameters) == ["tau"] and space.fixed == {}
    with pytest.raises(ConfigError, match="nothing is left to search"):
        written(tmp_path, text, hyperparams={"gamma": 0.5, "tau": 0.1})


def test_entry_of_the_environment_comes_before_the_default(tmp_path):
    text = "default:\n  tau: [0.1, 0.2]\nPendulum-v1:\n  gamma: [0.1, 0.2]\n"
    assert list(written(tmp_path, text, env="Pendulum-v1").parameters) == ["gamma"]
    assert list(written(tmp_path, text).parameters) == ["tau"]


@pytest.mark.parametrize(
    "text, message",
    [
        ("tau: {float: [1, 0]}", r"space.yml: tau: \[1, 0\] is empty — expected low < high"),
        ("tau: {int: [3, 3]}", r"tau: \[3, 3\] is empty"),
        ("tau: []", r"tau: \[\] is empty — expected at least one choice"),
        ("tau: {float: [0, 1], log: true}", r"tau: \[0, 1\] — expected low > 0 for log: true"),
        ("tau: {float: [0, .inf]}", "expected numbers"),
        ("tau: {float: [0, yes]}", "expected numbers"),
        ("tau: {int: [0, 1.5]}", "expected whole numbers"),
        ("tau: {float: [0]}", r"expected numbers, \{float: \[low, high\]\}"),
        ("tau: {float: 3}", "expected numbers"),
        ("tau: {flaot: [0, 1]}", "tau: unknown key 'flaot': did you mean 'float'?"),
        ("tau: {zzz: 1}", "unknown key 'zzz' — expected float, int, log, step"),
        ("tau: {log: true}", r"expected \{float: \[low, high\]\} or \{int: \[low, high\]\}"),
        ("tau: {float: [0, 1], int: [0, 1]}", "expected"),
        ("tau: {float: [0, 1], log: 3}", "log: 3 — expected true or false"),
        ("tau: {float: [0, 1], step: 2}", r"step: 2 — expected a number in \(0, 1\]"),
        ("tau: {int: [1, 9], step: 2, log: true}", "step: 2"),
        ("tau: {int: [16, 60], step: 16}", "step: 16 — does not lead from 16 to 60, but to 48 or 64"),
        ("tau: {float: [0, 1], step: 0.3}", "step: 0.3 — does not lead from 0 to 1, but to 0.9 or 1.2"),
        ("tau: [1, 2, 1]", "1 is there twice"),
        ("tau: {int: [1, 1.0e+30]}", "expected numbers of at most 63 bits"),
        ("a.b: [1, 2]\na: [{b: 3}, {b: 4}]", "a.b — expected it or its items, not both"),
        ("a: [1, 2]\na.b.c: [1]", "a — expected it or its items, not both"),
        ("tau: 0.1", r"tau: 0.1 — expected \[choice, …\]"),
        ("default: {}", "space.yml: default: {} — expected a mapping"),
        ("- tau", "expected a mapping"),
        ("default:\n  1: [0.1, 0.2]\n  tau: [0.1, 0.2]", "expected a mapping of hyper-parameters to choices"),
        ("gamma: [0.9]\ndefault:\n  tau: [0.1, 0.2]", "'gamma' stands beside the entry 'default' — expected inside it"),
        ("Hopper-v5:\n  gamma: [0.9, 0.99]", "space.yml: no entry for 'BipedalWalker-v3'$"),
        ("BipedalWalker-v2:\n  gamma: [0.9]", "no entry for 'BipedalWalker-v3': did you mean 'BipedalWalker-v2'"),
        ("tau: !!python/name:os.system", "refused"),
    ],
)
def test_mistakes(tmp_path, text, message):
    with pytest.raises(ConfigError, match=message):
        written(tmp_path, text + "\n")


def test_what_the_command_line_gives_is_not_searched(tmp_path):
    text = "n_timesteps: [100, 200]\ngamma: [0.9, 0.99]\ntau: [0.1]\n"
    assert set(written(tmp_path, text).parameters) == {"n_timesteps", "gamma"}
    space = written(tmp_path, text, n_timesteps=150, hyperparams={"tau": 0.2})
    assert set(space.parameters) == {"gamma"} and space.fixed == {}


@pytest.mark.parametrize(
    "given, searched",
    [
        ({"policy_kwargs": {"net_arch": [8]}}, {"gamma"}),
        ({"policy_kwargs.net_arch": [8]}, {"gamma", "policy_kwargs.n_critics"}),
        ({"policy_kwargs_": 1}, {"gamma", "policy_kwargs.net_arch", "policy_kwargs.n_critics"}),
    ],
)
def test_mappings_that_the_command_line_gives(tmp_path, given, searched):
    text = "gamma: [0.9, 0.99]\npolicy_kwargs.net_arch: [[16], [32]]\npolicy_kwargs.n_critics: [1, 2]\n"
    assert set(written(tmp_path, text, hyperparams=given).parameters) == searched
    with pytest.raises(ConfigError, match="nothing is left to search"):
        written(tmp_path, "policy_kwargs: [{net_arch: [16]}, {}]\n", hyperparams={"policy_kwargs.net_arch": [8]})


def test_missing_file():
    with pytest.raises(ConfigError, match=r"^nowhere\.yml: no such file — expected a YAML file of a search space$"):
        read_space(TuneOptions(space="nowhere.yml"))


@pytest.mark.parametrize("algo", ALGORITHMS)
def test_algorithms_take_every_value_of_their_shipped_space(algo):
    plan = Plan.read(TuneOptions(algo=algo, env="Pendulum-v1"))
    plan.check()
    assert len(plan.space.parameters) >= 6


@pytest.mark.parametrize(
    "text, message",
    [
        (
            "learning_ratee: [1, 2]",
            "space.yml: unknown hyper-parameter 'learning_ratee' for ppo: did you mean 'learning_rate'?",
        ),
        ("policy_kwargs.net_arhc: [[8], [9]]", "unknown policy_kwargs key 'net_arhc'"),
        ("gamma: [0.9, 1.1]", r"space.yml: gamma: gamma: 1.1 — expected a number in \[0, 1\]"),
        ("clip_range: [0.2, fast]", "clip_range: 'fast'"),
        ("gamma.x: [1, 2]", "gamma"),
    ],
)
def test_values_that_the_algorithm_does_not_take(tmp_path, text, message):
    (tmp_path / "space.yml").write_text(text + "\n")
    options = TuneOptions(algo="ppo", env="Pendulum-v1", space=str(tmp_path / "space.yml"))
    with pytest.raises(ConfigError, match=message):
        Plan.read(options).check()


#: Habaraduwa (2024), whose sweeps are to be repeatable
PPO = {
    "n_steps": [8, 16, 32, 64, 128, 256, 512, 1024, 2048],
    "learning_rate": (1e-5, 1, "log"),
    "n_epochs": [1, 5, 10, 20],
    "batch_size": [8, 16, 32, 64, 128, 256, 512],
    "gamma": [0.9, 0.95, 0.98, 0.99, 0.995, 0.999, 0.9999],
    "gae_lambda": [0.8, 0.9, 0.92, 0.95, 0.98, 0.99, 1.0],
    "ent_coef": (1e-8, 0.1, "log"),
    "clip_range": [0.1, 0.2, 0.3, 0.4],
    "max_grad_norm": [0.3, 0.5, 0.6, 0.7, 0.8, 0.9, 1, 2, 5],
    "vf_coef": (0, 1, "uniform"),
    "target_kl": (0.001, 0.3, "log"),
}
DDPG = {
    "learning_rate": (1e-5, 1, "log"),
    "batch_size": [16, 32, 64, 100, 128, 256, 512],
    "buffer_size": [1e4, 1e5, 1e6],
    "gamma": [0.9, 0.95, 0.98, 0.99, 0.995, 0.999, 0.9999],
    "tau": [0.001, 0.005, 0.01, 0.02],
    "train_freq": [1, 16, 128, 256, 1000, 2000],
    "noise_type": ["ornstein-uhlenbeck", "normal"],
    "noise_std": (0, 1, "uniform"),
}


@pytest.mark.parametrize("algo, table", [("ppo", PPO), ("ddpg", DDPG)])
def test_spaces_of_the_report(algo, table):
    found = {}
    for name, parameter in read_space(TuneOptions(algo=algo)).parameters.items():
        if isinstance(parameter, Choice):
            found[name] = list(parameter.values)
        else:
            assert isinstance(parameter.low, float) and parameter.step is None
            found[name] = (parameter.low, parameter.high, "log" if parameter.log else "uniform")
    assert found == table


def test_every_algorithm_has_a_space():
    shipped = {path.stem for path in (shipped_folder() / "tuning").glob("*.yml")}
    assert shipped == set(ALGORITHMS)
    for name in shipped:
        content = yaml.safe_load((shipped_folder() / "tuning" / f"{name}.yml").read_text())
        assert "default" in content
