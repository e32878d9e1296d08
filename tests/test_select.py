"""Which files the flags of `evaluate`, `enjoy` and `export` mean, in folders of ours and of RL Zoo."""

import pytest
import yaml

from sb3_symphony.cli import main
from sb3_symphony.experiment.config import ConfigError
from sb3_symphony.experiment.select import SelectOptions, select_model

#: as rl_zoo3 2.9.2 writes them
ZOO_CONFIG = """!!python/object/apply:collections.OrderedDict
- - - frame_stack
    - 3
  - - learning_rate
    - 0.001
  - - n_timesteps
    - 100000.0
  - - normalize
    - '{''norm_obs'': True, ''norm_reward'': False}'
"""
ZOO_ARGUMENTS = """!!python/object/apply:collections.OrderedDict
- - - algo
    - ppo
  - - env
    - Pendulum-v1
  - - env_kwargs
    - g: 9.0
"""


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sb3_symphony.experiment.select.pretrained_folder", lambda: tmp_path / "shipped")
    return tmp_path


def make_run(parent, number=1, algo="sac", env="Pendulum-v1", config=None, files=("Pendulum-v1.zip",), **arguments):
    """A run folder whose models are empty files."""
    run = parent / algo / f"{env}_{number}"
    (run / env).mkdir(parents=True)
    (run / env / "config.yml").write_text(yaml.safe_dump({"n_timesteps": 10, **(config or {})}))
    (run / env / "args.yml").write_text(yaml.safe_dump({"algo": algo, "env": env, **arguments}))
    for name in files:
        (run / name).touch()
    return run


def select(**options):
    return select_model(SelectOptions(**options))


def fails(message, **options):
    with pytest.raises(ConfigError) as error:
        select(**options)
    assert message in str(error.value)
    assert "\n" not in str(error.value)


def test_latest_run_and_run_by_number(folder):
    for number in (1, 2, 10):
        make_run(folder / "logs", number)
    found = select(algo="sac", env="Pendulum-v1")
    assert found.model.samefile("logs/sac/Pendulum-v1_10/Pendulum-v1.zip")
    assert (found.algo, found.env_id, found.normalization) == ("sac", "Pendulum-v1", None)
    assert found.run is not None and found.run.samefile("logs/sac/Pendulum-v1_10")
    assert select(algo="sac", env="Pendulum-v1", exp_id=2).model.samefile("logs/sac/Pendulum-v1_2/Pendulum-v1.zip")
    fails("--exp-id: 3 — logs/sac has Pendulum-v1 number 1, 2, 10", algo="sac", env="Pendulum-v1", exp_id=3)


def test_models_of_a_run(folder):
    names = ["Pendulum-v1.zip", "best_model.zip", "rl_model_900_steps.zip", "rl_model_1000_steps.zip", "rl_model_x_steps.zip"]
    make_run(folder / "elsewhere", files=names)
    flags = {"algo": "sac", "env": "Pendulum-v1", "folder": "elsewhere"}
    assert select(**flags).model.name == "Pendulum-v1.zip"
    assert select(**flags, load_best=True).model.name == "best_model.zip"
    assert select(**flags, load_last_checkpoint=True).model.name == "rl_model_1000_steps.zip"
    assert select(**flags, load_checkpoint=900).model.name == "rl_model_900_steps.zip"
    fails("--load-checkpoint: 5 — elsewhere/sac/Pendulum-v1_1 has checkpoints at 900, 1000", **flags, load_checkpoint=5)
    fails("--load-best and --load-last-checkpoint", **flags, load_best=True, load_last_checkpoint=True)


def test_models_that_a_run_lacks(folder):
    make_run(folder / "logs", files=[])
    flags = {"algo": "sac", "env": "Pendulum-v1"}
    fails("Pendulum-v1.zip: missing, the run has not ended", **flags)
    fails("--load-best: logs/sac/Pendulum-v1_1/best_model.zip is missing", **flags, load_best=True)
    fails("--load-last-checkpoint: logs/sac/Pendulum-v1_1 has no checkpoint", **flags, load_last_checkpoint=True)
    fails("--load-checkpoint: logs/sac/Pendulum-v1_1 has no checkpoint", **flags, load_checkpoint=7)


def test_model_file_in_a_run_needs_nothing_else(folder):
    make_run(folder / "logs", config={"env_kwargs": {"g": 9.0}}, files=["best_model.zip"])
    for name in ("best_model.zip", "best_model"):
        found = select(model=f"logs/sac/Pendulum-v1_1/{name}")
        assert (found.algo, found.env_id, found.settings.env_kwargs) == ("sac", "Pendulum-v1", {"g": 9.0})
    assert select(model="logs/sac/Pendulum-v1_1", load_best=True).model.name == "best_model.zip"
    fails("--algo: td3 — logs/sac/Pendulum-v1_1/best_model.zip was trained with sac", model=found.model.as_posix(), algo="td3")
    fails("--load-best: chooses among the models of a run", model="logs/sac/Pendulum-v1_1/best_model.zip", load_best=True)
    fails("--exp-id: 2", model="logs/sac/Pendulum-v1_1", exp_id=2)
    fails("-f: 'elsewhere' — expected --model or -f to look for runs", model="logs/sac/Pendulum-v1_1", folder="elsewhere")


def test_model_file_from_elsewhere(folder):
    (folder / "mine.zip").touch()
    found = select(model="mine.zip", algo="a2c", env="Pendulum-v1", env_kwargs={"g": 1.0})
    assert (found.algo, found.run, found.settings.env_kwargs) == ("a2c", None, {"g": 1.0})
    assert not found.normalization_known
    fails("--algo: missing — expected the algorithm that trained mine.zip", model="mine.zip", env="Pendulum-v1")
    fails("--env: missing — expected the environment that mine.zip", model="mine.zip", algo="a2c")
    fails("other.zip: no such file", model="other.zip", algo="a2c", env="Pendulum-v1")
    fails("unknown algorithm 'scc': did you mean 'sac'?", model="mine.zip", algo="scc", env="Pendulum-v1")
    (folder / "empty").mkdir()
    fails("'empty' — expected a model's zip file, or a run folder", model="empty", algo="a2c", env="Pendulum-v1")


def test_without_run_folder(folder):
    (folder / "logs" / "symphony").mkdir(parents=True)
    (folder / "logs" / "symphony" / "BipedalWalker-v3.zip").touch()
    found = select(exp_id=-1)
    assert found.model.as_posix() == "logs/symphony/BipedalWalker-v3.zip"
    assert (found.algo, found.env_id, found.run) == ("symphony", "BipedalWalker-v3", None)
    fails("--load-best: chooses among the models of a run — --exp-id -1", exp_id=-1, load_best=True)
    fails("--load-checkpoint: chooses among", exp_id=-1, load_checkpoint=7)


def test_flags_about_the_environment_come_first(folder):
    make_run(folder / "logs", config={"env_kwargs": {"g": 9.0, "render_mode": "rgb_array"}})
    run = "logs/sac/Pendulum-v1_1"
    assert select(model=run, env_kwargs={"g": 5.0}).settings.env_kwargs == {"g": 5.0, "render_mode": "rgb_array"}
    other = select(model=run, env="MountainCarContinuous-v0")
    assert other.env_id == "MountainCarContinuous-v0" and other.settings.env_kwargs == {}  # those were the run's environment's


def test_statistics_belong_to_models(folder):
    names = ["Pendulum-v1.zip", "best_model.zip", "rl_model_7_steps.zip"]
    statistics = ["best_model_vecnormalize.pkl", "rl_model_vecnormalize_7_steps.pkl", "Pendulum-v1/vecnormalize.pkl"]
    run = make_run(folder / "logs", config={"normalize": True})
    for name in (*names, *statistics):
        (run / name).touch()
    flags = {"algo": "sac", "env": "Pendulum-v1"}
    assert select(**flags).normalization == run.relative_to(folder) / "Pendulum-v1" / "vecnormalize.pkl"
    assert select(**flags, load_best=True).normalization.name == "best_model_vecnormalize.pkl"
    assert select(**flags, load_checkpoint=7).normalization.name == "rl_model_vecnormalize_7_steps.pkl"
    assert select(model=str(run / "rl_model_7_steps.zip")).normalization.name == "rl_model_vecnormalize_7_steps.pkl"
    (folder / "mine.pkl").touch()
    assert select(**flags, vecnormalize="mine.pkl").normalization.name == "mine.pkl"
    assert select(**flags, vecnormalize="none").normalization is None
    fails("--vecnormalize: 'other.pkl' — no such file", **flags, vecnormalize="other.pkl")
    (run / "best_model_vecnormalize.pkl").unlink()
    assert select(**flags, load_best=True).normalization.name == "vecnormalize.pkl"  # RL Zoo has only this one
    args = run / "Pendulum-v1" / "args.yml"
    args.write_text(args.read_text() + "protocol: null\n")  # but this package has one for each model
    fails("best_model_vecnormalize.pkl are missing", **flags, load_best=True)
    (run / "Pendulum-v1" / "vecnormalize.pkl").unlink()
    fails("was trained with VecNormalize, but its statistics", **flags, load_best=True)


def test_a_configuration_that_is_no_run(folder):
    """Any project may have one above its models."""
    (folder / "conf").mkdir()
    (folder / "conf" / "config.yml").write_text("- lr")
    (folder / "mine.zip").touch()
    found = select(model="mine.zip", algo="sac", env="Pendulum-v1")
    assert found.run is None and not found.normalization_known


def test_runs_that_a_model_does_not_belong_to(folder):
    """Two copies of RL Zoo's Hub repositories side by side, files in one folder; a run beside a folder of models."""
    for name in ("sac-Pendulum-v1", "sac-Pendulum-v1-moon"):
        (folder / name).mkdir()
        (folder / name / "sac-Pendulum-v1.zip").touch()
        (folder / name / "config.yml").write_text("{n_timesteps: 10, normalize: true}")
        (folder / name / "args.yml").write_text("{algo: sac, env: Pendulum-v1}")
    (folder / "beside.zip").touch()
    for path in ("sac-Pendulum-v1-moon/sac-Pendulum-v1.zip", "beside.zip"):
        found = select(model=path, algo="td3", env="Pendulum-v1")
        assert found.run is None and found.settings.normalize is False and not found.normalization_known
    run = make_run(folder / "logs")
    (run / "others").mkdir()
    (run / "others" / "mine.zip").touch()
    assert select(model=str(run / "others" / "mine.zip"), algo="td3", env="Pendulum-v1").run is None
    make_run(folder / "logs", number=2, files=["best_model.zip"])  # did not end
    assert select(model="logs/sac/Pendulum-v1_2/best_model.zip").algo == "sac"


def test_run_of_rl_zoo(folder):
    run = make_run(folder / "logs", algo="ppo", files=["Pendulum-v1.zip", "Pendulum-v1/vecnormalize.pkl"])
    (run / "Pendulum-v1" / "config.yml").write_text(ZOO_CONFIG)
    (run / "Pendulum-v1" / "args.yml").write_text(ZOO_ARGUMENTS)
    found = select(algo="ppo", env="Pendulum-v1")
    assert found.settings.frame_stack == 3 and found.settings.env_kwargs == {"g": 9.0}
    assert found.settings.normalize == {"norm_obs": True, "norm_reward": False} and found.normalization is not None
    assert select(model=str(run)).algo == "ppo"
    assert select(model=str(run), env_kwargs={"g": 5.0}).settings.env_kwargs == {"g": 5.0}


def test_configuration_of_a_run_of_rl_zoo(folder, capsys):
    run = make_run(folder / "logs", algo="ppo")
    (run / "Pendulum-v1" / "config.yml").write_text(ZOO_CONFIG)
    (run / "Pendulum-v1" / "args.yml").write_text(ZOO_ARGUMENTS)
    argv = ["train", "-conf", str(run / "Pendulum-v1" / "config.yml"), "--dry-run"]
    pixels = {"render_mode": "rgb_array"}
    for flags, expected in (([], {"g": 9.0}), (["--env-kwargs", "render_mode:rgb_array"], {"g": 9.0, **pixels})):
        assert main([*argv, *flags]) == 0
        out = capsys.readouterr().out
        assert out.startswith("# ppo on Pendulum-v1, ") and yaml.safe_load(out)["env_kwargs"] == expected
    expression = "dict(g=8.0, render_mode='rgb_array')"
    (run / "Pendulum-v1" / "config.yml").write_text(f'{ZOO_CONFIG}  - - env_kwargs\n    - "{expression}"\n')
    assert main(argv) == 0
    assert yaml.safe_load(capsys.readouterr().out)["env_kwargs"] == {"g": 9.0, **pixels}
    assert select(model=str(run), vecnormalize="none").settings.env_kwargs == {"g": 9.0, **pixels}
    (run / "Pendulum-v1" / "args.yml").write_text("algo: ppo\nenv: Pendulum-v1\nenv_kwargs: [g, 9.0]\n")
    assert main(argv) == 2
    assert "env_kwargs: ['g', 9.0] — expected a mapping" in capsys.readouterr().err
    fails("env_kwargs: ['g', 9.0] — expected a mapping", model=str(run))


def test_configuration_of_ones_own_run_may_be_edited(folder, capsys):
    run = make_run(folder / "logs", config={"env_kwargs": {"g": 5.0}}, env_kwargs={"g": 9.0}, protocol=None)
    assert select(model=str(run)).settings.env_kwargs == {"g": 5.0}
    assert main(["train", "-conf", str(run / "Pendulum-v1" / "config.yml"), "--dry-run"]) == 0
    assert yaml.safe_load(capsys.readouterr().out)["env_kwargs"] == {"g": 5.0}


def test_pretrained_agents(folder, capsys):
    make_run(folder / "shipped", algo="symphony", env="BipedalWalker-v3", files=["BipedalWalker-v3.zip"])
    found = select()
    assert found.model == folder / "shipped" / "symphony" / "BipedalWalker-v3_1" / "BipedalWalker-v3.zip"
    assert found.shipped and "no such run in 'logs', this is the agent that comes with" in capsys.readouterr().err
    fails("logs/symphony: no run of symphony on BipedalWalker-v3", load_best=True)  # it has one model only
    fails("runs/symphony: no run of symphony on BipedalWalker-v3", folder="runs")  # asked for elsewhere
    fails("logs/symphony: no run of symphony on BipedalWalker-v3", exp_id=1)  # one's own have numbers
    own = make_run(folder / "logs", algo="symphony", env="BipedalWalker-v3", files=["BipedalWalker-v3.zip"])
    assert select().model.samefile(own / "BipedalWalker-v3.zip") and not select().shipped
    assert capsys.readouterr().err == ""


def test_no_such_run(folder):
    fails("logs/symphony: no run of symphony on BipedalWalker-v3 — expected a run folder there, or --model")
    make_run(folder / "logs")
    make_run(folder / "logs", env="CartPole-v1")
    fails("no run of sac on Pendulum-v2: did you mean 'Pendulum-v1'?", algo="sac", env="Pendulum-v2")
    fails("— there are runs of CartPole-v1, Pendulum-v1", algo="sac", env="xyz")
    (folder / "logs" / "sac" / "Broken-v0_1").mkdir()
    fails("Broken-v0_1: not a run folder — Broken-v0/config.yml is missing", algo="sac", env="Broken-v0")


def test_a_name_that_is_too_long():
    fails("File name too long", model="a" * 300, algo="sac", env="Pendulum-v1")
    fails("File name too long", folder="a" * 300)


@pytest.mark.parametrize(
    "name, content, message",
    [
        ("config.yml", "a: !!python/object/apply:os.system ['touch owned']", "tag '!!python/object/apply:os.system'"),
        ("config.yml", "!!python/object/apply:collections.OrderedDict [[1]]", "not an ordered mapping"),
        ("config.yml", '{normalize: \'__import__("os").mkdir("owned")\'}', "normalize: '__import__"),
        ("config.yml", "{n_timesteps: 10, frame_stack: 0}", "frame_stack: 0"),
        ("args.yml", "just text", "expected a mapping"),
        ("args.yml", "{algo: wrong, env: Pendulum-v1}", "was trained with wrong"),
    ],
)
def test_damaged_run_folder(folder, name, content, message):
    run = make_run(folder / "logs")
    (run / "Pendulum-v1" / name).write_text(content)
    fails(message, algo="sac", env="Pendulum-v1")
    assert not (folder / "owned").exists()


def test_wrappers_over_those_of_the_run(folder):
    one, two = "gymnasium.wrappers.TimeLimit", "gymnasium.wrappers.RescaleAction"
    run = make_run(folder / "logs", config={"env_wrapper": [{one: {"max_episode_steps": 5}}, two]})
    run = str(run)
    assert select(model=run).settings.env_wrapper == [(one, {"max_episode_steps": 5}), (two, {})]
    changed = select(model=run, env_wrapper={"a.B": {"c": 1}, one: {"max_episode_steps": 9}})
    assert changed.settings.env_wrapper == [(one, {"max_episode_steps": 9}), (two, {}), ("a.B", {"c": 1})]
