"""
Makes the other files of this folder, which test that models of earlier versions load.

In a fresh virtual environment of Python 3.11:

    pip install stable-baselines3==2.3.2 "numpy<2"
    python make.py

made them with stable-baselines3 2.3.2, gymnasium 0.29.1, numpy 1.26.4, torch 2.15.0 and cloudpickle 3.1.2.
"""

import json

import numpy as np
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecNormalize

POLICY = dict(net_arch=[8])

env = VecNormalize(make_vec_env("Pendulum-v1", n_envs=2, seed=1))
ppo = PPO(
    "MlpPolicy",
    env,
    learning_rate=lambda left: 1e-3 * left,
    n_steps=128,
    batch_size=64,
    policy_kwargs=POLICY,
    seed=1,
    device="cpu",
)
ppo.learn(1024)
ppo.save("ppo")
env.save("ppo_vecnormalize.pkl")

sac = SAC("MlpPolicy", "Pendulum-v1", learning_starts=50, buffer_size=500, policy_kwargs=POLICY, seed=1, device="cpu")
sac.learn(200)
sac.save("sac")

observations = np.random.default_rng(0).normal(size=(5, 3)).astype(np.float32)
with open("predictions.json", "w", encoding="utf-8") as file:
    json.dump(
        {
            "observations": observations.tolist(),
            "ppo": ppo.predict(env.normalize_obs(observations), deterministic=True)[0].tolist(),
            "sac": sac.predict(observations, deterministic=True)[0].tolist(),
        },
        file,
    )
