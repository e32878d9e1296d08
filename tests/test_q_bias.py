"""The bias of the critics: equal to a slow computation, and without any effect on training."""

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from sb3_contrib import TQC, CrossQ
from stable_baselines3 import DDPG, PPO, SAC, TD3
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv, VecMonitor, VecNormalize
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from sb3_symphony import REDQ, DroQ, Symphony
from sb3_symphony.cli import main
from sb3_symphony.common.q_bias import QBiasCallback, monte_carlo_returns, q_bias

ALGORITHMS = [TD3, DDPG, SAC, TQC, CrossQ, Symphony, REDQ, DroQ]
GAMMA = 0.9


class Chain(gym.Env):
    """Walks along the states 0, 0.1, 0.2, …; the reward depends on state and action. Remembers what it was given."""

    observation_space = gym.spaces.Box(-5.0, 5.0, (2,))
    action_space = gym.spaces.Box(-2.0, 2.0, (1,))

    def __init__(self, length=7, ends="terminated"):
        self.length, self.ends = length, ends
        self.episodes = []

    def observe(self):
        return np.array([self.start, 0.1 * self.position], dtype=np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.position, self.start = 0, self.np_random.uniform(-1, 1)
        self.episodes.append({"observations": [self.observe()], "actions": [], "rewards": []})
        return self.observe(), {}

    def step(self, action):
        self.position += 1
        reward = 1.0 + self.start + 0.3 * self.position - 0.2 * float(action[0])
        episode = self.episodes[-1]
        episode["observations"].append(self.observe())
        episode["actions"].append(np.array(action))
        episode["rewards"].append(reward)
        end = self.position == self.length
        return self.observe(), reward, end and self.ends == "terminated", end and self.ends == "truncated", {}


def small(cls, env, **kwargs):
    kwargs = {"learning_starts": 20, "buffer_size": 500, "batch_size": 8, "gamma": GAMMA, "seed": 3, **kwargs}
    policy_kwargs = {"net_arch": [16], **kwargs.pop("policy_kwargs", {})}
    if cls is TQC:
        policy_kwargs["n_quantiles"] = 5
    if cls in (REDQ, DroQ):
        kwargs.update(gradient_steps=2, policy_delay=2)
    if cls is Symphony:
        kwargs.update(initial_gradient_steps=(2, 2), episode_gradient_steps=3)
    return cls("MlpPolicy", env, device="cpu", policy_kwargs=policy_kwargs, **kwargs)


def slow_q(model, observation, scaled_action):
    """Mean over the critics (and quantiles), by hand."""
    model.policy.set_training_mode(False)
    obs, act = th.tensor(observation)[None], th.tensor(scaled_action, dtype=th.float32).reshape(1, 1)
    with th.no_grad():
        values = model.critic(obs, act)
    members = [*values] if isinstance(values, tuple) else values
    return float(np.mean([float(member) for member in th.cat([m.flatten() for m in members])]))


def slow_log_prob(model, observation, scaled_action):
    """log pi of a squashed Gaussian, by its textbook formula."""
    with th.no_grad():
        mean, log_std, _ = model.actor.get_action_dist_params(th.tensor(observation)[None])
    gaussian = np.arctanh(float(scaled_action))
    mean, std = float(mean), float(log_std.exp())
    log_density = -0.5 * ((gaussian - mean) / std) ** 2 - np.log(std) - 0.5 * np.log(2 * np.pi)
    return log_density - np.log(1 - float(scaled_action) ** 2 + 1e-6)


def slow_bias(model, env, n_kept, alpha):
    """From what the environment remembers: sums of discounted rewards and entropy bonuses, term by term."""
    biases, returns = [], []
    for episode in env.episodes:
        steps = len(episode["rewards"])
        if steps == 0:  # begun by the automatic reset after the last one
            continue
        scaled = [action[0] / 2.0 for action in episode["actions"]]
        bonus = [
            -alpha * slow_log_prob(model, obs, a) if alpha else 0.0
            for obs, a in zip(episode["observations"], scaled, strict=False)
        ]
        for t in range(min(steps, n_kept)):
            total = episode["rewards"][t]
            for later in range(t + 1, steps):
                total += GAMMA ** (later - t) * (bonus[later] + episode["rewards"][later])
            returns.append(total)
            biases.append(slow_q(model, episode["observations"][t], scaled[t]) - total)
    return np.array(biases), np.array(returns)


# ---------------------------------------------------------------- numbers


def test_returns_of_the_paper():
    """A worked example: r = 1, 2, 3; log pi = 0.5, -0.5, 1; gamma = 0.9; alpha = 0.2; Q = 6, 4, 2."""
    log_probs = np.array([0.5, -0.5, 1.0])
    returns = monte_carlo_returns(np.array([1.0, 2.0, 3.0]), -0.2 * log_probs, gamma=0.9)
    np.testing.assert_allclose(returns, [5.158, 4.52, 3.0])
    np.testing.assert_allclose(monte_carlo_returns(np.array([1.0, 2.0, 3.0]), np.zeros(3), gamma=0.9), [5.23, 4.7, 3.0])
    bias = np.array([6.0, 4.0, 2.0]) - returns
    np.testing.assert_allclose(bias.mean() / abs(returns.mean()), -0.05347847, rtol=1e-6)
    np.testing.assert_allclose(bias.std() / abs(returns.mean()), 0.18461902, rtol=1e-6)


@pytest.mark.parametrize("cls", ALGORITHMS)
def test_equals_a_slow_computation(cls):
    env = Chain()
    model = small(cls, Chain())
    model.learn(40)
    result = q_bias(model, env, n_pairs=15, max_episode_steps=5)  # three episodes of seven steps
    assert result.n_pairs == 15
    stochastic = cls not in (TD3, DDPG, Symphony)
    alpha = float(model.log_ent_coef.detach().exp()) if stochastic else 0.0
    bias, returns = slow_bias(model, env, 5, alpha)
    assert len(bias) == 15 and len({episode["observations"][0][0] for episode in env.episodes[:3]}) == 3
    np.testing.assert_allclose(
        [result.mean, result.std, result.mean_return], [bias.mean(), bias.std(), returns.mean()], rtol=1e-4
    )
    scale = abs(returns.mean())
    np.testing.assert_allclose(
        [result.normalized_mean, result.normalized_std], [bias.mean() / scale, bias.std() / scale], rtol=1e-4
    )


def test_actions_of_several_axes():
    class Table(Chain):
        action_space = gym.spaces.Box(-2.0, 2.0, (2, 3))

        def step(self, action):
            assert action.shape == (2, 3)
            return super().step(action[0])

    model = small(REDQ, Table())
    model.learn(40)
    assert np.isfinite(q_bias(model, Table(), n_pairs=8, max_episode_steps=5).mean)


def test_perfect_critics_have_no_bias():
    """Critics set to a constant that is every return: reward 1, gamma 0.5, cut by the time limit."""

    class Ones(Chain):
        def step(self, action):
            observation, _, terminated, truncated, info = super().step(action)
            return observation, 1.0, terminated, truncated, info

    model = small(TD3, Ones(), gamma=0.5)
    with th.no_grad():
        for parameter in model.critic.parameters():
            parameter.zero_()
        for network in model.critic.q_networks:
            network[-1].bias.fill_(2.0)
    cut = q_bias(model, gym.wrappers.TimeLimit(Ones(length=100), 4), n_pairs=8)
    assert cut.n_pairs == 8 and cut.mean_return == pytest.approx(2.0)
    assert (cut.mean, cut.std) == (pytest.approx(0.0), pytest.approx(0.0))
    ends = q_bias(model, Ones(length=2), n_pairs=2)  # returns 1.5 and 1
    assert ends.normalized_mean == pytest.approx(0.75 / 1.25) and ends.normalized_std == pytest.approx(0.25 / 1.25)


def test_rewards_are_normalised_as_in_training():
    train_env = VecNormalize(DummyVecEnv([Chain]), gamma=GAMMA)
    model = small(TD3, train_env)
    model.learn(60)
    plain = Chain()
    own = VecNormalize(DummyVecEnv([lambda: plain]), norm_reward=False, norm_obs=False)
    before = train_env.ret_rms.var, train_env.obs_rms.mean.copy()
    result = q_bias(model, own, n_pairs=7, max_episode_steps=7)
    rewards = np.array(plain.episodes[0]["rewards"]) / np.sqrt(train_env.ret_rms.var + train_env.epsilon)
    assert result.mean_return == pytest.approx(monte_carlo_returns(rewards, np.zeros(7), GAMMA).mean(), rel=1e-5)
    np.testing.assert_array_equal(before[0], train_env.ret_rms.var)
    np.testing.assert_array_equal(before[1], train_env.obs_rms.mean)
    watched = VecMonitor(VecNormalize(DummyVecEnv([Chain])))  # one more wrapper than in training
    assert q_bias(model, watched, n_pairs=7, max_episode_steps=7).mean_return == pytest.approx(result.mean_return)
    with pytest.raises(ValueError, match="expected VecNormalize around it"):
        q_bias(model, Chain())
    with pytest.raises(ValueError, match="expected none of VecNormalize"):
        q_bias(small(TD3, Chain()), own)


def test_a_loaded_model_is_measured_in_what_is_given(tmp_path):
    train_env = VecNormalize(DummyVecEnv([Chain]), gamma=GAMMA)
    model = small(TD3, train_env).learn(60)
    model.save(tmp_path / "model")
    train_env.save(tmp_path / "normalize.pkl")
    own = VecNormalize.load(tmp_path / "normalize.pkl", DummyVecEnv([Chain]))
    expected = q_bias(model, VecNormalize(DummyVecEnv([Chain])), n_pairs=7)
    assert q_bias(TD3.load(tmp_path / "model"), own, n_pairs=7) == expected
    assert own.ret_rms.var == train_env.ret_rms.var


def test_observations_that_are_numbers():
    class Steps(gym.Env):
        observation_space = gym.spaces.Discrete(5)
        action_space = gym.spaces.Box(-1.0, 1.0, (1,))

        def reset(self, *, seed=None, options=None):
            super().reset(seed=seed)
            self.position = 0
            return 0, {}

        def step(self, action):
            self.position += 1
            return self.position, 1.0, False, self.position == 4, {}

    assert q_bias(small(REDQ, Steps()), Steps(), n_pairs=8).n_pairs == 8


def test_a_measurement_repeats():
    model = small(SAC, Chain())
    assert q_bias(model, Chain(), n_pairs=20) == q_bias(model, Chain(), n_pairs=20)
    assert q_bias(model, Chain(), n_pairs=20, seed=1) != q_bias(model, Chain(), n_pairs=20)


def test_gsde_draws_a_new_matrix_for_every_action():
    class OneState(Chain):
        def observe(self):
            return np.full(2, 0.5, dtype=np.float32)

    env = OneState(length=40)
    q_bias(small(SAC, Chain(), use_sde=True), env, n_pairs=40)
    assert len({float(action[0]) for action in env.episodes[0]["actions"]}) == 40


# ---------------------------------------------------------------- no effect on training


class Draws(BaseCallback):
    """Draws from all global generators in every step, so that their state is part of the result."""

    def _on_training_start(self):
        self.drawn = []

    def _on_step(self):
        self.drawn.append((np.random.get_state()[2], float(th.rand(1)), float(np.random.rand())))
        return True


@pytest.mark.parametrize(
    "cls, kwargs",
    [(cls, {}) for cls in ALGORITHMS]
    + [(SAC, {"use_sde": True}), (TQC, {"use_sde": True, "train_freq": 10}), (REDQ, {"use_sde": True})],
)
@pytest.mark.parametrize("normalize", [False, True])
def test_training_is_the_same_bit_for_bit(cls, kwargs, normalize):
    def env():
        plain = make_vec_env("Pendulum-v1", env_kwargs=dict(max_episode_steps=15))
        return VecNormalize(plain) if normalize else plain

    runs = []
    for with_bias in (False, True):
        model = small(cls, env(), **kwargs)
        draws = Draws()
        bias = QBiasCallback(env(), eval_freq=7, n_pairs=20)
        model.learn(60, callback=[bias, draws] if with_bias else draws)
        runs.append((model.policy.state_dict(), model.replay_buffer, draws.drawn, model.policy.training))
    for name, value in runs[0][0].items():
        assert th.equal(value, runs[1][0][name]), name
    for field in ("observations", "actions", "rewards", "dones"):
        np.testing.assert_array_equal(getattr(runs[0][1], field), getattr(runs[1][1], field))
    assert runs[0][2:] == runs[1][2:]


@pytest.mark.parametrize("training", [True, False])
def test_modes_and_distribution_are_left_alone(training):
    model = small(DroQ, Chain())
    model.policy.set_training_mode(training)
    modes = [module.training for module in model.policy.modules()]
    distribution = model.actor.action_dist
    q_bias(model, Chain(), n_pairs=5)
    assert [module.training for module in model.policy.modules()] == modes
    assert model.actor.action_dist is distribution


# ---------------------------------------------------------------- logging and mistakes


def test_tensorboard(tmp_path):
    model = small(TD3, Chain(), tensorboard_log=str(tmp_path))
    model.learn(50, callback=QBiasCallback(Chain(), eval_freq=20, n_pairs=10), tb_log_name="run")
    events = EventAccumulator(str(tmp_path / "run_1")).Reload()
    keys = {f"q_bias/{key}" for key in ("normalized_mean", "normalized_std", "mean", "std", "mean_return")}
    assert keys <= set(events.Tags()["scalars"])
    for key in keys:
        assert [event.step for event in events.Scalars(key)] == [20, 40]
    mean, scale = (events.Scalars(f"q_bias/{key}")[1].value for key in ("mean", "mean_return"))
    assert events.Scalars("q_bias/normalized_mean")[1].value == pytest.approx(mean / abs(scale), rel=1e-5)


def test_verbose(capsys):
    small(TD3, Chain()).learn(10, callback=QBiasCallback(Chain(), eval_freq=10, n_pairs=5, verbose=1))
    assert "10 steps: normalised Q bias" in capsys.readouterr().out


def test_mistakes():
    with pytest.raises(TypeError, match="expected an off-policy actor-critic such as SAC or TD3, got PPO"):
        PPO("MlpPolicy", Chain(), n_steps=8, batch_size=8).learn(8, callback=QBiasCallback(Chain()))
    with pytest.raises(ValueError, match="Observation spaces do not match"):
        small(TD3, Chain()).learn(5, callback=QBiasCallback(gym.make("Pendulum-v1")))
    with pytest.raises(ValueError, match="expected one environment, got 2"):
        q_bias(small(TD3, Chain()), make_vec_env(Chain, n_envs=2))
    for argument in ("eval_freq", "n_pairs", "max_episode_steps"):
        with pytest.raises(ValueError, match=f"{argument}=0"):
            QBiasCallback(Chain(), **{argument: 0})
    with pytest.raises(TypeError, match="n_pairs='many'"):
        q_bias(small(TD3, Chain()), Chain(), n_pairs="many")


# ---------------------------------------------------------------- in a configuration


def train(*arguments):
    argv = "train --env Pendulum-v1 -n 80 --eval-freq 0 --no-progress --verbose 0 --seed 0 -tb tb --log-interval 1".split()
    return main([*argv, *arguments])


SMALL = ["-params", "learning_starts:20", "buffer_size:200", "batch_size:8", "policy_kwargs:{net_arch: [8]}"]


def test_from_the_command_line(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    wrapper = "env_wrapper:{sb3_symphony.common.wrappers.RewardScale: {scale: 0.001}}"
    callback = "callback:{QBiasCallback: {eval_freq: 40, n_pairs: 50, max_episode_steps: 50}}"
    assert train("--algo", "td3", *SMALL, wrapper, "normalize:{norm_reward: false}", callback) == 0
    events = EventAccumulator(str(tmp_path / "tb" / "Pendulum-v1" / "TD3_1")).Reload()
    assert [event.step for event in events.Scalars("q_bias/normalized_mean")] == [40, 80]
    returns = [event.value for event in events.Scalars("q_bias/mean_return")]
    assert -1.7 < min(returns) and max(returns) < 0  # of the scaled rewards, which are learned from
    assert train("--algo", "td3", *SMALL, wrapper, "normalize:{norm_reward: false}") == 0
    with_bias, without = (TD3.load(tmp_path / f"logs/td3/Pendulum-v1_{k}/Pendulum-v1.zip").policy.state_dict() for k in (1, 2))
    assert all(th.equal(with_bias[name], without[name]) for name in without)


def test_callbacks_of_sb3_by_name(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    callback = "callback:[{stable_baselines3.common.callbacks.StopTrainingOnMaxEpisodes: {max_episodes: 1}}]"
    stop = "{StopTrainingOnMaxEpisodes: {max_episodes: 2}}"
    yaml = f"{{n_timesteps: 900, buffer_size: 300, policy_kwargs: {{net_arch: [8]}}, callback: {stop}}}"
    (tmp_path / "short.yml").write_text(yaml)
    assert train("--algo", "td3", "-conf", "short.yml", "-n", "900", "-params", callback) == 0
    assert TD3.load(tmp_path / "logs/td3/Pendulum-v1_1/Pendulum-v1.zip").num_timesteps == 200
    assert train("--algo", "td3", "-conf", "short.yml", "-n", "900") == 0
    assert TD3.load(tmp_path / "logs/td3/Pendulum-v1_2/Pendulum-v1.zip").num_timesteps == 400


@pytest.mark.parametrize(
    "algo, value, message",
    [
        ("td3", "QBiasCalback", "callback: unknown class 'QBiasCalback': did you mean 'QBiasCallback'?"),
        ("td3", "stable_baselines3.common.callbacks.CheckpointCallback", "callback: unknown class"),
        ("td3", "os.system", "callback: unknown class"),
        ("td3", "{QBiasCallback: {eval_frq: 10}}", "unknown argument 'eval_frq' for QBiasCallback: did you mean 'eval_freq'?"),
        ("td3", "{QBiasCallback: {eval_freq: 0}}", "callback: QBiasCallback: eval_freq=0"),
        ("td3", "{QBiasCallback: {eval_freq: often}}", "QBiasCallback: eval_freq: 'often' — expected a whole number"),
        ("td3", "{QBiasCallback: {eval_env: Pendulum-v1}}", "unknown argument 'eval_env'"),
        ("td3", "{StopTrainingOnMaxEpisodes: {}}", "max_episodes"),
        ("td3", "5", "callback: 5 — expected a dotted name"),
        (
            "ppo",
            "QBiasCallback",
            "callback: QBiasCallback: model: expected an off-policy actor-critic such as SAC or TD3, got PPO",
        ),
    ],
)
def test_mistakes_in_a_configuration(tmp_path, monkeypatch, capsys, algo, value, message):
    monkeypatch.chdir(tmp_path)
    assert train("--algo", algo, "-params", f"callback:{value}", "policy_kwargs:{net_arch: [8]}") == 2
    errors = capsys.readouterr().err
    assert message in errors and errors.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_a_resumed_run_goes_on_counting(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    callback = "callback:{QBiasCallback: {eval_freq: 30, n_pairs: 20, max_episode_steps: 20}}"
    assert train("--algo", "td3", *SMALL, callback, "--save-freq", "50") == 0
    assert main("train --resume logs/td3/Pendulum-v1_1 -n 130 --no-progress".split()) == 0
    events = EventAccumulator(str(tmp_path / "tb" / "Pendulum-v1" / "TD3_1")).Reload()
    assert [event.step for event in events.Scalars("q_bias/mean")] == [30, 60, 90, 120]
