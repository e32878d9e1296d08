"""Slow, obvious counterparts of the stacked networks, and what the numeric tests share."""

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.torch_layers import FlattenExtractor
from torch import nn

from sb3_symphony.common.ensembles import EnsembleCritic
from sb3_symphony.common.layers import StackedLayerNorm, StackedLinear

OBS_DIM, ACTION_DIM = 5, 2


def box(dim):
    return spaces.Box(-1.0, 1.0, (dim,), np.float32)


def make_critic(net_arch=(16, 16), dtype=th.float64, obs_dim=OBS_DIM, action_dim=ACTION_DIM, **kwargs):
    space = box(obs_dim)
    kwargs = {"share_features_extractor": False, "n_critics": 3, **kwargs}
    return EnsembleCritic(space, box(action_dim), list(net_arch), FlattenExtractor(space), obs_dim, **kwargs).to(dtype)


def fade_weights(size, fade_factor=7.0, fade_power=2.0):
    """Probability of every stored transition under fading replay, oldest first."""
    if fade_factor is None or np.isinf(fade_factor):
        return np.full(size, 1.0 / size)
    weights = np.tanh(fade_factor * (np.arange(size) / size) ** fade_power)
    return weights / weights.sum() if weights.any() else np.full(size, 1.0 / size)


def separate_networks(stacked):
    """N ordinary networks with copies of the weights of a ``StackedMLP``."""
    n_members = len(stacked.layers[-1].weight)
    networks = []
    for k in range(n_members):
        modules = []
        for layer in stacked.layers:
            if isinstance(layer, StackedLinear):
                linear = nn.Linear(*layer.weight.shape[1:])
                linear.weight.data = layer.weight.data[k].t().clone()
                linear.bias.data = layer.bias.data[k, 0].clone()
                modules.append(linear)
            elif isinstance(layer, StackedLayerNorm):
                norm = nn.LayerNorm(layer.weight.shape[-1])
                norm.weight.data = layer.weight.data[k, 0].clone()
                norm.bias.data = layer.bias.data[k, 0].clone()
                modules.append(norm)
            else:
                modules.append(layer)  # without parameters
        networks.append(nn.Sequential(*modules))
    return networks


def assert_same_weights(stacked, networks, tolerance, attribute="data"):
    """Compare parameters (or their gradients) of a ``StackedMLP`` with those of N separate networks."""
    parametric = [layer for layer in stacked.layers if list(layer.parameters())]
    for k, network in enumerate(networks):
        own = [layer for layer in network if list(layer.parameters())]
        for layer, single in zip(parametric, own, strict=True):
            weight, bias = getattr(layer.weight, attribute)[k], getattr(layer.bias, attribute)[k, 0]
            weight = weight.t() if isinstance(single, nn.Linear) else weight[0]
            th.testing.assert_close(weight, getattr(single.weight, attribute), rtol=tolerance, atol=tolerance)
            th.testing.assert_close(bias, getattr(single.bias, attribute), rtol=tolerance, atol=tolerance)


def perturb(module, scale=0.1, seed=7):
    """Move every parameter, so that none is 0 or 1 (biases and LayerNorm)."""
    generator = th.Generator().manual_seed(seed)
    for parameter in module.parameters():
        noise = th.randn(parameter.shape, generator=generator, dtype=th.float64)
        parameter.data += scale * noise.to(parameter.dtype)


def batch_of(size, seed=0, obs_dim=OBS_DIM, action_dim=ACTION_DIM, dtype=th.float64):
    """Observations, actions and a target."""
    generator = th.Generator().manual_seed(seed)
    observations = th.randn(size, obs_dim, generator=generator)
    actions = th.rand(size, action_dim, generator=generator, dtype=th.float64) * 2 - 1
    target = 2 * th.randn(size, 1, generator=generator, dtype=th.float64)
    return observations, actions.to(dtype), target.to(dtype)


def double_precision(model, monkeypatch):
    """Let a built model, its batches included, compute in double precision."""
    monkeypatch.setattr("stable_baselines3.common.policies.preprocess_obs", lambda obs, *args, **kwargs: obs.double())
    model.policy.double()
    monkeypatch.setattr(model.replay_buffer, "to_torch", lambda array, copy=True: th.as_tensor(array).double())
    if getattr(model, "log_ent_coef", None) is not None:
        model.log_ent_coef.data = model.log_ent_coef.data.double()
    if hasattr(model, "baseline"):
        model.baseline = model.baseline.double()


def fill(buffer, n_transitions, seed=0):
    """
    Random transitions with ends of both kinds. Returned as columns, ``terminated`` without the truncations.
    """
    rng = np.random.default_rng(seed)
    columns = {name: [] for name in ("observations", "next_observations", "actions", "rewards", "terminated", "truncated")}
    obs_dim, action_dim = buffer.obs_shape[0], buffer.action_dim
    for _ in range(n_transitions):
        obs, next_obs = rng.normal(size=(2, 1, obs_dim)).astype(np.float32)
        action = rng.uniform(-1, 1, (1, action_dim)).astype(np.float32)
        reward = np.float32(rng.normal())
        terminated, truncated = [(False, False), (True, False), (False, True)][rng.choice(3, p=[0.7, 0.15, 0.15])]
        buffer.add(
            obs,
            next_obs,
            action,
            np.array([reward]),
            np.array([terminated or truncated]),
            [{"TimeLimit.truncated": truncated}],
        )
        row = (obs[0], next_obs[0], action[0], [reward], [terminated], [truncated])
        for column, value in zip(columns.values(), row, strict=True):
            column.append(value)
    return {name: th.tensor(np.array(column), dtype=th.float64) for name, column in columns.items()}
