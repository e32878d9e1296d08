"""
Cost of one gradient update: ours beside its bare matrix products, SB3, SBX and a loop over separate networks.

All contestants see the same shapes and random data in one process, and take turns, so that a change of the machine's speed
meets all of them alike: trust the ratios. The process is pinned to as many cores as it may use threads.

    pip install ".[dev]" sbx-rl
    python benchmarks/speed/updates.py --quick
    python benchmarks/speed/updates.py --threads 1 --output benchmarks/results/speed/updates_1_thread.json
"""

import argparse
import copy
import itertools
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path

import gymnasium as gym
import numpy as np
import torch as th
from measuring import pin, write
from sb3_contrib import TQC, CrossQ
from stable_baselines3 import SAC, TD3
from stable_baselines3.common.logger import configure
from stable_baselines3.common.utils import polyak_update
from torch import nn
from torch.nn import functional as F

from sb3_symphony import REDQ, Symphony
from sb3_symphony.common.regression import has_bfloat16

SHAPES = {"BipedalWalker": (24, 4), "Hopper": (11, 3), "Humanoid": (348, 17)}
UPDATES_PER_TURN = 20


@dataclass(frozen=True)
class Setting:
    """One row of the table. ``policy_delay``: critic updates per actor update; ``subset``: critics in the target."""

    name: str
    shape: str
    batch: int = 256
    n_critics: int = 10
    subset: int = 2
    width: int = 256
    layer_norm: bool = False
    n_steps: int = 1
    policy_delay: int = 20


class Shape(gym.Env):
    """An environment that is nothing but its spaces."""

    def __init__(self, shape: str) -> None:
        observation_dim, action_dim = SHAPES[shape]
        self.observation_space = gym.spaces.Box(-np.inf, np.inf, (observation_dim,), np.float32)
        self.action_space = gym.spaces.Box(-1, 1, (action_dim,), np.float32)

    def reset(self, *, seed=None, options=None):
        return self.observation_space.sample(), {}

    def step(self, action):
        return self.observation_space.sample(), 0.0, False, False, {}


def prepared(model, n_transitions: int = 5000):
    """The model with a filled replay buffer and a silent logger."""
    observation_dim, action_dim = model.observation_space.shape[0], model.action_space.shape[0]
    observations = np.random.randn(n_transitions + 1, 1, observation_dim).astype(np.float32)
    for i in range(n_transitions):
        action = np.random.uniform(-1, 1, (1, action_dim)).astype(np.float32)
        model.replay_buffer.add(observations[i], observations[i + 1], action, np.random.randn(1), np.zeros(1), [{}])
    model.set_logger(configure(None, []))
    model.num_timesteps = n_transitions
    return model


Turn = Callable[[int], None]  # make this many updates


class DelayedSAC(SAC):
    """SB3's SAC with its actor and temperature updated every ``delay``-th time only: the same work as ours."""

    delay = 20

    def train(self, gradient_steps: int, batch_size: int = 64) -> None:
        self.policy.set_training_mode(True)
        self._update_learning_rate([self.actor.optimizer, self.critic.optimizer, self.ent_coef_optimizer])
        critic_losses = []
        for _ in range(gradient_steps):
            data = self.replay_buffer.sample(batch_size, env=self._vec_normalize_env)
            ent_coef = self.log_ent_coef.detach().exp()
            with th.no_grad():
                actions, log_prob = self.actor.action_log_prob(data.next_observations)
                q_values = th.cat(self.critic_target(data.next_observations, actions), dim=1).min(dim=1, keepdim=True).values
                discounts = self.gamma if data.discounts is None else data.discounts
                target = data.rewards + (1 - data.dones) * discounts * (q_values - ent_coef * log_prob.reshape(-1, 1))
            critic_losses.append(sb3_critic_step(self, data, target).item())
            self._n_updates += 1
            if self._n_updates % self.delay == 0:
                actions, log_prob = self.actor.action_log_prob(data.observations)
                ent_coef_loss = -(self.log_ent_coef * (log_prob + self.target_entropy).detach()).mean()
                self.ent_coef_optimizer.zero_grad()
                ent_coef_loss.backward()
                self.ent_coef_optimizer.step()
                q_values = th.cat(self.critic(data.observations, actions), dim=1).min(dim=1, keepdim=True).values
                actor_loss = (ent_coef * log_prob.reshape(-1, 1) - q_values).mean()
                self.actor.optimizer.zero_grad()
                actor_loss.backward()
                self.actor.optimizer.step()
        self.logger.record("train/critic_loss", np.mean(critic_losses))


def sb3_critic_step(model, data, target: th.Tensor) -> th.Tensor:
    """What SB3's SAC and TD3 do with a target: loss, backward, Adam, Polyak."""
    loss = sum(F.mse_loss(q_values, target) for q_values in model.critic(data.observations, data.actions))
    model.critic.optimizer.zero_grad()
    loss.backward()
    model.critic.optimizer.step()
    polyak_update(model.critic.parameters(), model.critic_target.parameters(), 0.005)
    return loss


class SeparateNetworks:
    """N critics as N modules with N optimisers, in the manner of the REDQ authors' code; actor and data as in ours."""

    def __init__(self, setting: Setting, model: REDQ) -> None:
        self.setting, self.model = setting, model
        sizes = [sum(SHAPES[setting.shape]), setting.width, setting.width]
        self.critics = [self.network(sizes, setting.layer_norm) for _ in range(setting.n_critics)]
        self.targets = copy.deepcopy(self.critics)
        self.optimizers = [th.optim.Adam(critic.parameters(), lr=3e-4) for critic in self.critics]

    @staticmethod
    def network(sizes: list[int], layer_norm: bool) -> nn.Sequential:
        layers: list[nn.Module] = []
        for size_in, size_out in itertools.pairwise(sizes):
            layers += [nn.Linear(size_in, size_out), *([nn.LayerNorm(size_out)] if layer_norm else []), nn.ReLU()]
        return nn.Sequential(*layers, nn.Linear(sizes[-1], 1))

    def critic_step(self, data, target: th.Tensor) -> None:
        inputs = th.cat([data.observations, data.actions], dim=1)
        q_values = th.cat([critic(inputs) for critic in self.critics], dim=1)
        loss = F.mse_loss(q_values, target.expand(-1, len(self.critics))) * len(self.critics)
        for optimizer in self.optimizers:
            optimizer.zero_grad()
        loss.backward()
        for optimizer in self.optimizers:
            optimizer.step()
        for critic, target_network in zip(self.critics, self.targets, strict=True):
            polyak_update(critic.parameters(), target_network.parameters(), 0.005)

    def train(self, n_updates: int) -> None:
        actor = self.model.actor
        for i in range(n_updates):
            data = self.model.replay_buffer.sample(self.setting.batch)
            with th.no_grad():
                actions, log_prob = actor.action_log_prob(data.next_observations)
                inputs = th.cat([data.next_observations, actions], dim=1)
                subset = np.random.choice(len(self.targets), self.setting.subset, replace=False)
                q_values = th.cat([self.targets[k](inputs) for k in subset], dim=1).min(dim=1, keepdim=True).values
                target = data.rewards + (1 - data.dones) * 0.99 * (q_values - 0.2 * log_prob.reshape(-1, 1))
            self.critic_step(data, target)
            if (i + 1) % self.setting.policy_delay == 0:
                actions, log_prob = actor.action_log_prob(data.observations)
                inputs = th.cat([data.observations, actions], dim=1)
                for critic in self.critics:
                    critic.requires_grad_(False)
                loss = (0.2 * log_prob - th.cat([critic(inputs) for critic in self.critics], dim=1).mean(dim=1)).mean()
                actor.optimizer.zero_grad()
                loss.backward()
                actor.optimizer.step()
                for critic in self.critics:
                    critic.requires_grad_(True)


class BareProducts:
    """The matrix products of an update and nothing else: the floor."""

    def __init__(self, setting: Setting) -> None:
        n, batch, width = setting.n_critics, setting.batch, setting.width
        observation_dim, action_dim = SHAPES[setting.shape]
        self.setting = setting
        self.inputs = th.randn(batch, observation_dim + action_dim)
        self.weights = th.randn(n, observation_dim + action_dim, width), th.randn(n, width, width), th.randn(n, width, 1)
        self.hidden, self.grad = th.randn(n, batch, width), th.randn(n, batch, 1)
        self.actor = th.randn(observation_dim, width), th.randn(width, width), th.randn(width, 2 * action_dim)
        self.states = th.randn(batch, observation_dim)

    def forward(self, n: int) -> None:
        first, second, last = (weight[:n] for weight in self.weights)
        th.bmm(self.inputs.expand(n, -1, -1), first)
        th.bmm(self.hidden[:n], second)
        th.bmm(self.hidden[:n], last)

    def critic(self, n_updates: int) -> None:
        first, second, last = self.weights
        for _ in range(n_updates):
            self.forward(len(first))
            th.bmm(self.grad, last.transpose(1, 2))
            th.bmm(self.hidden.transpose(1, 2), self.grad)
            th.bmm(self.hidden, second.transpose(1, 2))
            th.bmm(self.hidden.transpose(1, 2), self.hidden)
            th.bmm(self.inputs.t().expand(len(first), -1, -1), self.hidden)

    def train(self, n_updates: int) -> None:
        """Critics, target subset and next actions; once in ``policy_delay`` the actor's step."""
        self.critic(n_updates)
        first, second, last = self.actor
        for i in range(n_updates):
            self.forward(self.setting.subset)
            self.states @ first
            self.hidden[0] @ second
            self.hidden[0] @ last
            if (i + 1) % self.setting.policy_delay == 0:
                self.actor_step()

    def actor_step(self) -> None:
        """The actor forward, all critics forward and back to the actions, the actor back."""
        first, second, last = self.actor
        hidden = self.hidden[0]
        self.states @ first
        hidden @ second
        actions = hidden @ last
        self.forward(len(self.hidden))
        th.bmm(self.grad, self.weights[2].transpose(1, 2))
        th.bmm(self.hidden, self.weights[1].transpose(1, 2))
        th.bmm(self.hidden, self.weights[0][:, self.states.shape[1] :].transpose(1, 2))
        actions @ last.t()
        hidden.t() @ actions
        hidden @ second.t()
        hidden.t() @ hidden
        self.states.t() @ hidden


def critic_step(model: REDQ | Symphony, setting: Setting) -> Turn:
    """The critics' step alone, toward a given target."""
    data = model.replay_buffer.sample(setting.batch)
    target = th.randn(setting.batch, 1)

    def critic(n_updates: int) -> None:
        for _ in range(n_updates):
            model._regression.fit(data.observations, data.actions, target, 0.005)

    return critic


def redq(setting: Setting, engine: str) -> tuple[Turn, Turn]:
    model = prepared(
        REDQ(
            "MlpPolicy",
            Shape(setting.shape),
            batch_size=setting.batch,
            n_critics=setting.n_critics,
            subset_size=setting.subset,
            policy_delay=setting.policy_delay,
            n_steps=setting.n_steps,
            policy_kwargs=dict(net_arch=[setting.width] * 2, layer_norm=setting.layer_norm, critic_engine=engine),
            device="cpu",
        )
    )
    return critic_step(model, setting), lambda n_updates: model.train(gradient_steps=n_updates, batch_size=setting.batch)


def sb3(setting: Setting, algorithm=SAC, **policy_kwargs) -> tuple[Turn | None, Turn]:
    """As users run it: the actor at every update (TD3: every second); SB3 has no LayerNorm option."""
    policy_kwargs = {"net_arch": [setting.width] * 2, **policy_kwargs}
    arguments = dict(batch_size=setting.batch, buffer_size=100_000, device="cpu")
    if algorithm is not CrossQ:
        arguments["n_steps"] = setting.n_steps
    model = prepared(algorithm("MlpPolicy", Shape(setting.shape), policy_kwargs=policy_kwargs, **arguments))
    if isinstance(model, DelayedSAC):
        model.delay = setting.policy_delay
    data = model.replay_buffer.sample(setting.batch)
    target = th.randn(setting.batch, 1)

    def critic(n_updates: int) -> None:
        for _ in range(n_updates):
            sb3_critic_step(model, data, target)

    has_plain_critics = issubclass(algorithm, (SAC, TD3))
    return critic if has_plain_critics else None, lambda n: model.train(gradient_steps=n, batch_size=setting.batch)


def sbx(setting: Setting, delayed: bool) -> tuple[None, Turn]:
    import jax
    import sbx as sbx_package

    policy_kwargs = dict(net_arch=[setting.width] * 2, n_critics=setting.n_critics, layer_norm=setting.layer_norm)
    model = sbx_package.SAC(
        "MlpPolicy",
        Shape(setting.shape),
        batch_size=setting.batch,
        buffer_size=100_000,
        policy_delay=setting.policy_delay if delayed else 1,
        gradient_steps=UPDATES_PER_TURN,
        policy_kwargs=policy_kwargs,
    )
    prepared(model)

    def train(n_updates: int) -> None:
        model.train(gradient_steps=n_updates, batch_size=setting.batch)
        jax.block_until_ready(model.policy.qf_state.params)  # updates are dispatched asynchronously

    return None, train


def separate(setting: Setting) -> tuple[Turn, Turn]:
    model = prepared(
        REDQ(
            "MlpPolicy",
            Shape(setting.shape),
            n_critics=2,
            batch_size=setting.batch,
            policy_kwargs=dict(net_arch=[setting.width] * 2),
            device="cpu",
        )
    )
    loop = SeparateNetworks(setting, model)
    data = model.replay_buffer.sample(setting.batch)
    target = th.randn(setting.batch, 1)

    def critic(n_updates: int) -> None:
        for _ in range(n_updates):
            loop.critic_step(data, target)

    return critic, loop.train


def symphony(setting: Setting, engine: str, policy_delay: int = 1) -> tuple[Turn, Turn]:
    model = prepared(
        Symphony(
            "MlpPolicy",
            Shape(setting.shape),
            n_critics=setting.n_critics,
            policy_delay=policy_delay,
            initial_gradient_steps=(0, 0),
            policy_kwargs=dict(net_arch=[setting.width] * 2, critic_engine=engine),
            device="cpu",
        )
    )
    return critic_step(model, setting), lambda n_updates: model.train(gradient_steps=n_updates, batch_size=setting.batch)


def contestants(setting: Setting) -> dict[str, Callable[[], tuple[Turn | None, Turn]]]:
    """Constructors by name; the first one is what the others are compared with."""
    ours = symphony if setting.name == "symphony" else redq
    engines = ["fused", "autograd", *(["bf16"] if has_bfloat16() else [])]
    constructors: dict[str, Callable] = {f"ours, {engine}": partial(ours, setting, engine) for engine in engines}
    floor = BareProducts(setting)
    constructors["bare products"] = lambda: (floor.critic, floor.train)
    if setting.name == "symphony":
        constructors["ours, fused, policy_delay 2"] = partial(symphony, setting, "fused", policy_delay=2)
        return {**constructors, "SB3 TD3 (policy_delay 2)": lambda: sb3(setting, TD3)}
    constructors |= {
        "separate networks": lambda: separate(setting),
        "SB3 SAC": lambda: sb3(setting, n_critics=setting.n_critics),
        "SB3 SAC, our policy_delay": lambda: sb3(setting, DelayedSAC, n_critics=setting.n_critics),
        "SBX SAC": lambda: sbx(setting, delayed=False),
        "SBX SAC, our policy_delay": lambda: sbx(setting, delayed=True),
    }
    if setting.name in ("shape", "ensemble"):
        return constructors
    return {  # other algorithms, for orientation
        **constructors,
        "SB3 TD3": lambda: sb3(setting, TD3),
        "TQC": lambda: sb3(setting, TQC, n_critics=setting.n_critics),
        "CrossQ": lambda: sb3(setting, CrossQ, n_critics=setting.n_critics),
    }


def measure(setting: Setting, turns: int) -> list[dict]:
    """Milliseconds per update of every contestant, as quartiles over interleaved turns."""
    built = {name: make() for name, make in contestants(setting).items()}
    samples: dict[tuple[str, str], list[float]] = {}
    for turn in range(turns + 1):
        for name, (critic, train) in built.items():
            for column, run in (("critic", critic), ("train", train)):
                if run is None:
                    continue
                start = time.perf_counter()
                run(UPDATES_PER_TURN)
                if turn > 0:  # the first one warms up: allocations, compilation
                    elapsed = 1e3 * (time.perf_counter() - start) / UPDATES_PER_TURN
                    samples.setdefault((name, column), []).append(elapsed)
    rows = []
    for (name, column), values in samples.items():
        quartiles = np.percentile(values, [25, 50, 75])
        reference = np.median(samples["ours, fused", column]) if ("ours, fused", column) in samples else np.nan
        rows.append(
            {
                **asdict(setting),
                "threads": th.get_num_threads(),
                "contestant": name,
                "column": column,
                "ms": round(float(quartiles[1]), 4),
                "ms_quartiles": [round(float(quartiles[0]), 4), round(float(quartiles[2]), 4)],
                "times_ours": round(float(quartiles[1] / reference), 3),
            }
        )
    return rows


def settings(quick: bool) -> list[Setting]:
    chosen = [
        Setting("redq", "BipedalWalker"),
        Setting("walker", "BipedalWalker", 128, 2, 2, 128, layer_norm=True, n_steps=3, policy_delay=10),
        Setting("symphony", "BipedalWalker", 128, 2, 2, 256, policy_delay=1),
    ]
    if not quick:
        chosen += [Setting("shape", shape, batch) for shape in SHAPES for batch in (128, 256, 1024)]
        chosen += [Setting("ensemble", "BipedalWalker", n_critics=n) for n in (2, 5, 20)]
    return chosen


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="the first three settings, few turns")
    parser.add_argument("--threads", type=int, default=1, help="threads, and cores the process is pinned to")
    parser.add_argument("--turns", type=int, help="counted turns per contestant (default 15, with --quick 7)")
    parser.add_argument("--output", type=Path, help="JSON file, written after each setting")
    arguments = parser.parse_args()
    pin(arguments.threads)

    rows: list[dict] = []
    for setting in settings(arguments.quick):
        new = measure(setting, arguments.turns or (7 if arguments.quick else 15))
        rows += new
        print(f"\n{setting}, {arguments.threads} thread(s)")
        for row in new:
            low, high = row["ms_quartiles"]
            spread = f"({low:.3f}, {high:.3f})"
            print(
                f"  {row['contestant']:26s} {row['column']:7s} {row['ms']:8.3f} ms  {spread}  x {row['times_ours']:.2f}",
                flush=True,
            )
        if arguments.output is not None:
            write(arguments.output, rows)


if __name__ == "__main__":
    main()
