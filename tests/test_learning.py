"""Trivial tasks are solved in seconds, Pendulum with the shipped hyper-parameters in minutes."""

import numpy as np
import pytest
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.envs import BitFlippingEnv, IdentityEnvBox
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.her import HerReplayBuffer

from sb3_symphony import Symphony
from sb3_symphony.common.buffers import PrioritizedReplayBuffer

FAST = dict(learning_rate=3e-3, batch_size=64, gamma=0.0, tau=0.05, policy_delay=1, gradient_steps=1, learning_starts=200)


def fast(algorithm, **options):
    extra = dict(critic_learning_rate=3e-3) if algorithm is Symphony else dict(ent_coef=0.01)
    return {**FAST, **extra, "policy_kwargs": dict(net_arch=[32, 32]), **options}


@pytest.mark.parametrize("replay_buffer_class", [None, PrioritizedReplayBuffer])
def test_identity(make, algorithm, replay_buffer_class):
    """The action that equals the observation, within 0.25 of a range of 2: reward 1, else 0. A random one gets 0.23."""
    env = make_vec_env(lambda: IdentityEnvBox(eps=0.25), seed=0)
    model = make(env, **fast(algorithm, replay_buffer_class=replay_buffer_class))
    model.learn(1000)
    mean, _ = evaluate_policy(model, env, n_eval_episodes=5, warn=False)
    assert mean > 85


@pytest.mark.slow
def test_her_solves_bit_flipping(make, algorithm):
    env = make_vec_env(lambda: BitFlippingEnv(n_bits=3, continuous=True, max_steps=3), seed=0)
    options = fast(algorithm, gamma=0.9, policy="MultiInputPolicy", replay_buffer_class=HerReplayBuffer, buffer_size=5000)
    options["replay_buffer_kwargs"] = dict(n_sampled_goal=4)
    if algorithm is Symphony:
        options["action_noise"] = NormalActionNoise(np.zeros(3), 0.8 * np.ones(3))
    model = make(env, **options)
    model.learn(1500)
    successes = []
    evaluate_policy(model, env, 50, callback=lambda locals_, _: successes.append(locals_["info"].get("is_success", False)))
    assert np.sum(successes) / 50 > 0.8


@pytest.mark.slow
@pytest.mark.parametrize("algo", ["symphony", "redq", "droq"])
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_pendulum_with_shipped_hyperparameters(algo, seed, tmp_path):
    """10 000 steps; a swing-up costs about -150 on average."""
    from sb3_symphony.experiment.config import TrainOptions
    from sb3_symphony.experiment.registry import load_algorithm
    from sb3_symphony.experiment.train import train

    options = TrainOptions(
        algo=algo, env="Pendulum-v1", n_timesteps=10_000, seed=seed, log_folder=str(tmp_path), eval_freq=-1, num_threads=1
    )
    run = train(options).run
    model = load_algorithm(algo).load(run.model, device="cpu")
    env = make_vec_env("Pendulum-v1", seed=1000)
    mean, _ = evaluate_policy(model, env, n_eval_episodes=20)
    assert mean >= -200
