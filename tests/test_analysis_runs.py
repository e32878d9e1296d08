"""Files of runs, as arrays."""

from collections import OrderedDict

import gymnasium as gym
import numpy as np
import pytest
import yaml
from stable_baselines3.common.monitor import Monitor
from torch.utils.tensorboard import SummaryWriter

from sb3_symphony.analysis.runs import (
    Damaged,
    Scalar,
    find_runs,
    group_runs,
    open_run,
    read_episodes,
    read_evaluations,
    read_scalars,
)
from sb3_symphony.analysis.tables import scalar_table
from sb3_symphony.experiment.plot import PlotOptions, _groups


def write_monitor(path, start, rows, columns="r,l,t"):
    path.parent.mkdir(parents=True, exist_ok=True)
    lines = [f'#{{"t_start": {start}, "env_id": "X"}}', columns, *(",".join(map(str, row)) for row in rows)]
    path.write_text("\n".join(lines) + "\n")


def make_run(folder, algo="sac", env="X-v0", seed=0, number=1, **config):
    path = folder / algo / f"{env}_{number}"
    write_monitor(path / "0.monitor.csv", 0.0, [(1.0, 10, 1.0)])
    (path / env).mkdir()
    (path / env / "args.yml").write_text(yaml.safe_dump({"algo": algo, "env": env, "seed": seed}))
    (path / env / "config.yml").write_text(yaml.safe_dump({"n_timesteps": 100, **config}))
    return path


# ---------------------------------------------------------------- files


def test_parallel_environments_step_together(tmp_path):
    """When one of two has taken 10 steps, so has the other, whose episode goes on."""
    write_monitor(tmp_path / "0.monitor.csv", 100.0, [(1.0, 10, 1.0), (3.0, 20, 5.0)])
    write_monitor(tmp_path / "1.monitor.csv", 101.0, [(2.0, 15, 1.5)])
    episodes = read_episodes(tmp_path)
    np.testing.assert_array_equal(episodes.steps, [20, 30, 60])
    np.testing.assert_array_equal(episodes.returns, [1.0, 2.0, 3.0])
    np.testing.assert_array_equal(episodes.lengths, [10, 15, 20])
    np.testing.assert_array_equal(episodes.seconds, [1.0, 2.5, 5.0])
    assert episodes.successes is None


def test_a_folder_of_sb3s_monitor(tmp_path):
    """With names as SB3 gives them; the file knows the environment."""
    (tmp_path / "mine").mkdir()
    env = Monitor(gym.make("Pendulum-v1", max_episode_steps=5), str(tmp_path / "mine"))
    for _ in range(2):
        env.reset(seed=0)
        while not env.step([0.0])[3]:
            pass
    env.close()
    run = open_run(tmp_path / "mine")
    assert (run.algo, run.env) == ("mine", "Pendulum-v1")
    np.testing.assert_array_equal(run.episodes.steps, [5, 10])
    np.testing.assert_array_equal(run.episodes.returns, np.round(env.get_episode_rewards(), 6))
    (tmp_path / "mine" / "monitor.csv").write_text("r,l,t\n")
    with pytest.raises(ValueError, match="not a monitor file"):
        open_run(tmp_path / "mine")


def test_a_torn_last_line_is_left_out(tmp_path):
    write_monitor(tmp_path / "0.monitor.csv", 0.0, [(1.0, 10, 1.0)])
    with (tmp_path / "0.monitor.csv").open("a") as file:
        file.write("-12.3,")
    assert len(read_episodes(tmp_path).returns) == 1


def test_time_of_a_resumed_run_goes_on(tmp_path):
    write_monitor(tmp_path / "0.monitor.csv", 50.0, [(1, 10, 1.0), (1, 10, 8.0), (2, 10, 0.5), (3, 10, 3.0)])
    np.testing.assert_array_equal(read_episodes(tmp_path).seconds, [1.0, 8.0, 8.5, 11.0])


def test_successes(tmp_path):
    write_monitor(tmp_path / "0.monitor.csv", 0.0, [(1, 10, 1.0, True), (1, 10, 2.0, False)], "r,l,t,is_success")
    np.testing.assert_array_equal(read_episodes(tmp_path).successes, [1.0, 0.0])


def test_successes_as_numbers(tmp_path):
    """As environments for grasping tell them."""
    write_monitor(tmp_path / "0.monitor.csv", 0.0, [(-50, 50, 1, 0.0), (-20, 50, 2, 1.0), (-20, 50, 3, 1)], "r,l,t,is_success")
    np.testing.assert_array_equal(read_episodes(tmp_path).successes, [0.0, 1.0, 1.0])


def test_no_episode_yet(tmp_path):
    assert read_episodes(tmp_path) is None and read_evaluations(tmp_path) is None
    write_monitor(tmp_path / "0.monitor.csv", 0.0, [])
    assert read_episodes(tmp_path).steps.shape == (0,)


def test_nulls_of_a_power_cut(tmp_path):
    write_monitor(tmp_path / "0.monitor.csv", 0.0, [(1.0, 10, 1.0)])
    with (tmp_path / "0.monitor.csv").open("a") as file:
        file.write("\0" * 200_000)
    with pytest.raises(Damaged, match="or damaged"):
        read_episodes(tmp_path)


def test_rows_that_are_cut(tmp_path):
    """The last one may be: a process was killed while it wrote. One in between would shift the steps of all that follow."""
    write_monitor(tmp_path / "0.monitor.csv", 0.0, [(1.0, 10, 1.0), (2.0, 20, 2.0)])
    text = (tmp_path / "0.monitor.csv").read_text()
    (tmp_path / "0.monitor.csv").write_text(text + "-3.1")
    assert read_episodes(tmp_path).steps.tolist() == [10, 30]
    (tmp_path / "0.monitor.csv").write_text(text + "-3.1\n4.0,40,4.0\n")
    with pytest.raises(Damaged, match=r"0\.monitor\.csv: .*line 5: expected numbers r,l,t"):
        read_episodes(tmp_path)


def test_damaged_files(tmp_path):
    (tmp_path / "0.monitor.csv").write_text("r,l,t\n1,2,3\n")
    with pytest.raises(ValueError, match=r"0\.monitor\.csv: not a monitor file"):
        read_episodes(tmp_path)
    (tmp_path / "evaluations.npz").write_bytes(b"PK\x03\x04 nothing")
    with pytest.raises(ValueError, match=r"evaluations\.npz: not evaluations"):
        read_evaluations(tmp_path)
    np.savez(tmp_path / "evaluations.npz", timesteps=[1])
    with pytest.raises(ValueError, match=r"evaluations\.npz: not evaluations"):
        read_evaluations(tmp_path)


def test_scalars_are_not_thinned(tmp_path):
    with SummaryWriter(tmp_path) as writer:
        for step in range(0, 30_000, 10):
            writer.add_scalar("train/x", step**0.5, step, walltime=1000.0 + step)
    scalar = read_scalars(tmp_path)["train/x"]
    np.testing.assert_array_equal(scalar.steps, np.arange(0, 30_000, 10))
    np.testing.assert_allclose(scalar.values, scalar.steps**0.5, rtol=1e-6)
    np.testing.assert_allclose(np.diff(scalar.seconds), 10.0)


def test_scalars_as_a_table(tmp_path):
    logged = {
        "train/x": Scalar(np.array([0, 8, 8, 16]), np.array([0.0, 1.0, 1.5, 2.0]), np.array([1.0, np.nan, 1 / 3, -2e-9])),
        "rollout/y": Scalar(np.array([8, 24]), np.array([1.0, 3.25]), np.array([1e6, 7.0])),
    }
    path = tmp_path / "X_1" / "scalars.csv"
    write_monitor(path.with_name("0.monitor.csv"), 0.0, [])
    path.write_text(scalar_table(logged))
    assert path.read_text().splitlines()[:3] == ["step,seconds,train/x,rollout/y", "0,0.00,1,", "8,1.00,nan,1e+06"]
    read = open_run(path.parent).scalars
    assert list(read) == list(logged)
    for tag, scalar in logged.items():
        np.testing.assert_array_equal(read[tag].steps, scalar.steps)
        np.testing.assert_array_equal(read[tag].seconds, scalar.seconds)
        np.testing.assert_allclose(read[tag].values, scalar.values, rtol=1e-5)
    assert scalar_table(read) == path.read_text()
    path.write_text("step,seconds,train/x\n8,1.0,high\n")
    with pytest.raises(ValueError, match=r"scalars\.csv: no table of scalars, or damaged"):
        _ = open_run(path.parent).scalars


# ---------------------------------------------------------------- folders


def test_open_run(tmp_path):
    path = make_run(tmp_path, "td3", "Y-v1", seed=7, gamma=0.9)
    run = open_run(path)
    assert (run.algo, run.env, run.seed, run.config["gamma"], run.log) == ("td3", "Y-v1", 7, 0.9, None)
    (path / "Y-v1" / "tensorboard.txt").write_text("../../../tb/TD3_1\n")
    assert open_run(path).log == tmp_path / "tb" / "TD3_1"


def test_folders_of_rl_zoo_are_read(tmp_path):
    path = make_run(tmp_path, "ppo", "CartPole-v1")
    for name in ("args.yml", "config.yml"):
        text = "!!python/object/apply:collections.OrderedDict\n- - - algo\n    - ppo\n"
        (path / "CartPole-v1" / name).write_text(text)
    run = open_run(path)
    assert (run.algo, run.env, run.seed, run.config) == ("ppo", "CartPole-v1", None, {"algo": "ppo"})


def test_a_tensorboard_log_alone(tmp_path):
    with SummaryWriter(tmp_path / "Y-v1" / "SAC_3") as writer:
        writer.add_scalar("train/x", 1.0, 1)
    run = open_run(tmp_path / "Y-v1" / "SAC_3")
    assert (run.algo, run.env, list(run.scalars)) == ("sac", "Y-v1", ["train/x"])


def test_no_run(tmp_path):
    with pytest.raises(ValueError, match="no such folder"):
        open_run(tmp_path / "x")
    with pytest.raises(ValueError, match="no run folder and no TensorBoard log"):
        open_run(tmp_path)


def test_find_runs_takes_names_exactly(tmp_path):
    for algo, env, number in [
        ("sac", "W-v3", 1),
        ("sac", "W-v3", 10),
        ("sac", "W-v3", 2),
        ("td3", "W-v3", 1),
        ("sac", "WHard-v3", 1),
    ]:
        make_run(tmp_path, algo, env, number=number, seed=number)
    (tmp_path / "sac" / "W-v3_77").mkdir()  # not a run
    names = [str(run.path.relative_to(tmp_path)) for run in find_runs(tmp_path)]
    assert names == ["sac/W-v3_1", "sac/W-v3_2", "sac/W-v3_10", "sac/WHard-v3_1", "td3/W-v3_1"]
    assert find_runs(tmp_path / "none") == []
    chosen = _groups(PlotOptions(algo=["td3", "sac"], env=["W-v3"], folder=str(tmp_path)))  # exactly, in the order given
    names = [str(run.path.relative_to(tmp_path)) for group in chosen for run in group.runs]
    assert names == ["td3/W-v3_1", "sac/W-v3_1", "sac/W-v3_2", "sac/W-v3_10"]


# ---------------------------------------------------------------- groups


def test_seeds_of_one_configuration_are_a_group(tmp_path):
    runs = [open_run(make_run(tmp_path, seed=k, number=k + 1, gamma=0.9)) for k in range(3)]
    longer = make_run(tmp_path, seed=3, number=4, gamma=0.9)
    (longer / "X-v0" / "config.yml").write_text(yaml.safe_dump({"n_timesteps": 999, "gamma": 0.9}))
    groups = group_runs([*runs, open_run(longer), open_run(make_run(tmp_path, "td3"))])
    assert [(group.label, len(group.runs)) for group in groups] == [("sac", 4), ("td3", 1)]


def test_a_seed_counts_once(tmp_path, capsys):
    for number, (seed, rows) in enumerate([(0, 1), (0, 3), (1, 1), (0, 2)], 1):
        path = make_run(tmp_path, number=number, seed=seed, gamma=0.9)
        write_monitor(path / "0.monitor.csv", 0.0, [(1.0, 10, 1.0)] * rows)
    (group,) = _groups(PlotOptions(folder=str(tmp_path)))
    assert [run.path.name for run in group.runs] == ["X-v0_2", "X-v0_3"]
    told = capsys.readouterr().err.splitlines()
    assert told == [f"left out: {tmp_path}/sac/X-v0_{k}: has the seed and settings of {tmp_path}/sac/X-v0_2" for k in (1, 4)]


def test_groups_are_named_apart(tmp_path):
    settings = [{"gamma": 0.9, "tau": 0.1, "batch_size": 8}, {"gamma": 0.99, "tau": 0.2, "batch_size": 16}]
    runs = [open_run(make_run(tmp_path / name, **each)) for name, each in zip("ab", settings, strict=True)]
    groups = group_runs([*runs, open_run(make_run(tmp_path, "td3"))])
    assert [group.label for group in groups] == ["sac 1 (a/sac/X-v0_1)", "sac 1 (b/sac/X-v0_1)", "td3"]


def test_logs_without_settings_are_no_seeds_of_each_other(tmp_path):
    for number in (1, 2):
        with SummaryWriter(tmp_path / "tb" / f"PPO_{number}") as writer:
            writer.add_scalar("train/loss", 1.0, 0)
    groups = group_runs(open_run(tmp_path / "tb" / f"PPO_{number}") for number in (1, 2))
    assert [(group.label, len(group.runs)) for group in groups] == [("ppo (PPO_1)", 1), ("ppo (PPO_2)", 1)]


def test_runs_that_start_elsewhere_are_another_group(tmp_path):
    paths = [make_run(tmp_path, number=k, seed=k, gamma=0.9) for k in range(1, 6)]
    for path, options in zip(
        paths[1:],
        [
            {"trained_agent": "logs/sac/X-v0_1"},
            {"trained_agent": "logs/sac/X-v0_2"},
            {"trained_agent": "logs/sac/X-v0_1", "with_replay_buffer": True},
            {"eval_env_kwargs": {"g": 1.0}},
        ],
        strict=True,
    ):
        (path / "X-v0" / "args.yml").write_text(yaml.safe_dump({"algo": "sac", "env": "X-v0", **options}))
    assert [[int(run.path.name[-1]) for run in group.runs] for group in group_runs(map(open_run, paths))] == [
        [1],
        [2, 3],
        [4],
        [5],
    ]


def test_groups_of_rl_zoo_are_told_apart_too(tmp_path):
    for number, rate in enumerate((0.001, 0.0001), 1):
        path = make_run(tmp_path, number=number)
        config = OrderedDict(learning_rate=rate, n_timesteps=100)
        (path / "X-v0" / "config.yml").write_text(yaml.dump(config))
        (path / "X-v0" / "args.yml").write_text(yaml.dump(OrderedDict(algo="sac", env="X-v0", seed=number)))
        assert "OrderedDict" in (path / "X-v0" / "config.yml").read_text()
    runs = find_runs(tmp_path)
    assert [(run.config["learning_rate"], run.seed) for run in runs] == [(0.001, 1), (0.0001, 2)]
    assert [len(group.runs) for group in group_runs(runs)] == [1, 1]


def test_arguments_of_the_environment_in_rl_zoo(tmp_path):
    for number, gravity in enumerate((9.0, 5.0, 9.0, None), 1):
        path = make_run(tmp_path, number=number, gamma=0.9)
        arguments = {"algo": "sac", "env": "X-v0", "seed": number, "env_kwargs": gravity and {"g": gravity}}
        (path / "X-v0" / "args.yml").write_text(yaml.safe_dump(arguments))
    groups = group_runs(find_runs(tmp_path))
    assert [(group.label, len(group.runs)) for group in groups] == [
        ("sac env_kwargs {'g': 9.0}", 2),
        ("sac env_kwargs {'g': 5.0}", 1),
        ("sac env_kwargs default", 1),
    ]


def test_arguments_of_the_environment_in_both_files(tmp_path):
    both = [({"g": 5.0}, {"g": 9.0}), ({"g": 5.0}, {"g": 3.0}), ({"g": 9.0}, {"g": 9.0}), ({"g": 9.0}, None)]
    for number, (configured, given) in enumerate(both, 1):
        path = make_run(tmp_path, number=number, env_kwargs=configured)
        arguments = {"algo": "sac", "env": "X-v0", "seed": number, "env_kwargs": given}
        (path / "X-v0" / "args.yml").write_text(yaml.safe_dump(arguments))
    groups = group_runs(find_runs(tmp_path))
    assert [[run.seed for run in group.runs] for group in groups] == [[1], [2], [3, 4]]  # 3 and 4: one pendulum


def test_groups_are_told_apart_by_what_differs(tmp_path):
    paths = [
        make_run(tmp_path, number=1, gamma=0.9, policy_kwargs={"net_arch": [64], "n_critics": 2}),
        make_run(tmp_path, number=2, gamma=0.9, policy_kwargs={"net_arch": [64], "n_critics": 5}),
        make_run(tmp_path, number=3, gamma=0.9, policy_kwargs={"net_arch": [64]}),
        make_run(tmp_path, number=4, env="Z-v0", gamma=0.5),
    ]
    labels = [group.label for group in group_runs(map(open_run, paths))]
    assert labels == ["sac n_critics 2", "sac n_critics 5", "sac n_critics default", "sac"]
    paths = [make_run(tmp_path, "td3", number=1, a=1, b=1, c=1), make_run(tmp_path, "td3", number=2, a=2, b=2, c=2)]
    assert [group.label for group in group_runs(map(open_run, paths))] == ["td3 1", "td3 2"]
    wrappers = [{"sb3_symphony.common.wrappers.RewardFloor": {"floor": -30}}]  # too long for a legend
    paths = [make_run(tmp_path, "ppo", number=1, env_wrapper=wrappers), make_run(tmp_path, "ppo", number=2)]
    assert [group.label for group in group_runs(map(open_run, paths))] == ["ppo 1", "ppo 2"]
