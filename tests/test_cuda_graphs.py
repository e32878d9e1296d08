"""
Recorded updates: the same numbers as without. What CUDA does is tested where there is a GPU, which has to be shown to the
tests: CUDA_VISIBLE_DEVICES=0 pytest tests/test_cuda_graphs.py. The rest is tested everywhere, with a graph that calls again.
"""

import copy

import pytest
import torch as th
from torch import nn

from sb3_symphony import REDQ, DroQ, Symphony
from sb3_symphony.common.buffers import PrioritizedReplayBuffer
from sb3_symphony.common.cuda_graphs import WARM_UPS, CudaGraphs, Recording, recorded_state

on_gpu = pytest.mark.skipif(not th.cuda.is_available(), reason="needs a GPU")

# Everything that Symphony's updates can have: noise, dropout, moving averages, n-step returns, penalties
SETTINGS = dict(
    n_steps=3,
    policy_delay=5,
    gradient_steps=12,
    min_mix=((0.2, 0.9, 30, 60), 0.5),
    target_policy_noise=0.2,
    saturation_penalty=0.1,
    policy_kwargs=dict(net_arch=[32, 32], dropout_rate=0.1, layer_norm=True, activation_fn=nn.ReLU, actor_averaging=0.125),
)


class Again:
    """In place of a graph: calls the function again, whose results go where a graph's would."""

    def __init__(self, function, inputs, outputs):
        self.function, self.inputs, self.outputs = function, inputs, outputs

    def replay(self):
        for key, value in self.function(self.inputs).items():
            self.outputs.setdefault(key, th.empty_like(value)).copy_(value)


class GraphsOnCpu(CudaGraphs):
    def __init__(self):
        super().__init__()
        self.n_recorded = self.n_replayed = 0

    def _warm_up(self, function, samples):
        return function(samples)

    def _record(self, function, samples, optimizers):
        self.n_recorded += 1
        inputs = type(samples)(*(None if field is None else th.full_like(field, th.nan) for field in samples))
        outputs: dict[str, th.Tensor] = {}
        rates = [th.zeros(()) for optimizer in optimizers for _ in optimizer.param_groups]
        return Recording(Again(function, inputs, outputs), inputs, outputs, rates)

    def _replay(self, recording, samples, optimizers):
        self.n_replayed += 1
        return super()._replay(recording, samples, optimizers)


@pytest.fixture
def recorded(small, monkeypatch):
    """A model on the CPU whose updates are recorded, by such graphs."""

    def make(**kwargs):
        model = small(Symphony, **{**SETTINGS, **kwargs})
        model._cuda_graphs = GraphsOnCpu()
        optimizers = [model.actor.optimizer, model.critic.optimizer]
        monkeypatch.setattr(model, "_recorded_state", lambda: recorded_state(model.policy, optimizers))
        return model

    return make


def logged(model, monkeypatch):
    """The list of what training logs, one dictionary per call."""
    logs = []
    log_update = model._log_update

    def log(values, noise_std):
        logs.append({key: th.stack(list(value)) for key, value in values.items()})
        log_update(values, noise_std)

    monkeypatch.setattr(model, "_log_update", log)
    return logs


def assert_same(model, other, logs, other_logs, **tolerance):
    for (name, a), b in zip(model.policy.state_dict().items(), other.policy.state_dict().values(), strict=True):
        th.testing.assert_close(a, b, msg=lambda text, name=name: f"{name}: {text}", **tolerance)
    assert model._n_updates == other._n_updates and model._logged_updates == other._logged_updates
    assert len(logs) == len(other_logs) > 0
    for mine, theirs in zip(logs, other_logs, strict=True):
        assert mine.keys() == theirs.keys()
        for key in mine:
            th.testing.assert_close(mine[key], theirs[key], msg=lambda text, key=key: f"{key}: {text}", **tolerance)


@pytest.mark.parametrize("gradient_steps", [12, 7, -1])
def test_recorded_updates_are_the_plain_ones(recorded, small, monkeypatch, gradient_steps):
    ours = recorded(gradient_steps=gradient_steps)
    logs = logged(ours, monkeypatch)
    ours.learn(70)
    plain = small(Symphony, **{**SETTINGS, "gradient_steps": gradient_steps})
    plain_logs = logged(plain, monkeypatch)
    plain.learn(70)
    assert_same(ours, plain, logs, plain_logs, rtol=0, atol=0)
    assert ours._cuda_graphs.n_replayed > ours._n_updates / 20
    assert ours._cuda_graphs.n_recorded < 16


def test_calls_of_one_kind_are_recorded_once():
    recordings, calls = GraphsOnCpu(), []
    parameter = nn.Parameter(th.zeros(2))
    optimizer = th.optim.Adam([parameter])

    def double(samples):
        calls.append(samples[0])
        return {"twice": 2 * samples[0]}

    given = [(th.full((3,), float(i)), None) for i in range(8)]

    class Pair(tuple):
        def __new__(cls, *fields):
            return super().__new__(cls, fields)

    results = [recordings.run("kind", double, Pair(*each), [optimizer])["twice"] for each in given]
    for i, result in enumerate(results):  # each its own: no later replay wrote over it
        assert th.equal(result, th.full((3,), 2.0 * i))
    assert recordings.n_recorded == 1 and recordings.n_replayed == len(given) - WARM_UPS
    assert len({call.data_ptr() for call in calls[WARM_UPS:]}) == 1
    recordings.run("other", double, Pair(*given[0]), [optimizer])
    assert recordings.n_recorded == 1  # its first call


def test_the_latest_kinds_are_kept(monkeypatch):
    monkeypatch.setattr("sb3_symphony.common.cuda_graphs.MAX_RECORDINGS", 3)
    recordings = GraphsOnCpu()
    for kind in [*"abcab", *"ddd", "a"]:
        recordings.run(kind, lambda samples: {}, (), [])
    assert list(recordings._graphs) == ["b", "d", "a"]
    assert recordings._graphs["a"] == 3 and recordings._graphs["d"] == 3


def test_a_recording_is_not_used_once_something_it_depends_on_changes(small):
    model = small(Symphony, **SETTINGS).learn(60)
    optimizers = [model.actor.optimizer, model.critic.optimizer]

    def state():
        return recorded_state(model.policy, optimizers)

    seen = [state()]
    assert state() == seen[0] is not None
    model.learn(30, reset_num_timesteps=False)
    model.policy.set_training_mode(True)
    assert state() == seen[0]  # updates change what is in memory, not where it is

    def changed():
        seen.append(state())
        return seen[-1] is not None and seen[-1] not in seen[:-1]

    model.policy.set_training_mode(False)
    assert changed()
    next(model.actor.parameters()).requires_grad_(False)
    assert changed()
    next(m for m in model.critic.modules() if isinstance(m, nn.Dropout)).p = 0.3
    assert changed()
    model.critic.optimizer.param_groups[0]["betas"] = (0.5, 0.9)
    assert changed()
    model.critic.optimizer.load_state_dict(copy.deepcopy(model.critic.optimizer.state_dict()))  # states lie elsewhere
    assert changed()
    model.critic.q_networks.layers[0].weight = nn.Parameter(model.critic.q_networks.layers[0].weight.detach().clone())
    assert changed()
    model.critic.optimizer.param_groups[0]["lr"] = 0.1  # read at each replay
    assert state() == seen[-1]


@pytest.mark.parametrize(
    "spoil",
    [
        lambda model: model.actor.mu.register_forward_hook(lambda *args: None),
        lambda model: next(model.critic.parameters()).register_hook(lambda gradient: gradient),
        lambda model: model.actor.optimizer.register_step_post_hook(lambda *args: None),
        lambda model: model.critic.optimizer.param_groups[0].update(fused=False),
    ],
)
def test_what_happens_in_python_is_not_recorded(small, spoil):
    model = small(Symphony, **SETTINGS).learn(60)
    optimizers = [model.actor.optimizer, model.critic.optimizer]
    assert recorded_state(model.policy, optimizers) is not None
    spoil(model)
    assert recorded_state(model.policy, optimizers) is None


def test_other_optimizers_are_not_recorded(small):
    policy_kwargs = {"optimizer_class": th.optim.SGD}
    model = small(Symphony, policy_kwargs=policy_kwargs)
    assert recorded_state(model.policy, [model.actor.optimizer, model.critic.optimizer]) is None


def test_nothing_is_recorded_before_optimizers_have_states(small):
    """Which the first step makes: replays of a recording of it would go on with states that nobody has any more."""
    model = small(Symphony, **SETTINGS)
    optimizers = [model.actor.optimizer, model.critic.optimizer]
    untrained = copy.deepcopy(model.get_parameters())
    assert recorded_state(model.policy, optimizers) is None
    model.learn(60)
    assert recorded_state(model.policy, optimizers) is not None
    model.set_parameters(untrained)
    assert recorded_state(model.policy, optimizers) is None
    model.actor.requires_grad_(False)  # what is frozen needs none
    model.learn(60)
    assert not model.actor.optimizer.state and recorded_state(model.policy, optimizers) is not None


def test_nothing_is_recorded_on_the_cpu(small):
    model = small(Symphony).learn(60)
    assert model._recorded_state() is None and not model._cuda_graphs._graphs


def test_only_our_own_updates_are_recorded(small):
    class Own(Symphony):
        pass

    def state(cls=Symphony, **kwargs):
        model = small(cls, **kwargs).learn(60)
        model.device = th.device("cuda")  # its networks are not looked at
        return model, model._recorded_state()

    model, first = state()
    assert first is not None and model._recorded_state() == first
    for name, value in {"tau": 0.5, "target_policy_noise": 0.3, "actor_loss": "mean", "baseline": th.zeros(())}.items():
        before = model._recorded_state()
        setattr(model, name, value)
        assert model._recorded_state() not in (None, before)
    model._update_actor = lambda *args: None
    assert model._recorded_state() is None
    assert state(Own)[1] is None and state(REDQ)[1] is None and state(DroQ)[1] is None
    assert state(policy_kwargs={"critic_engine": "autograd"})[1] is None
    assert state(replay_buffer_class=PrioritizedReplayBuffer)[1] is None


# ---------------------------------------------------------------------------------------------------------------- on a GPU


def on_cuda(engine="auto", env="Pendulum-v1", **kwargs):
    settings = {**SETTINGS, "learning_starts": 50, "batch_size": 32, "buffer_size": 2000, "seed": 0, **kwargs}
    settings["policy_kwargs"] = {**settings["policy_kwargs"], "critic_engine": engine}
    return Symphony("MlpPolicy", env, device="cuda", **settings)


@on_gpu
@pytest.mark.parametrize("critic_loss", ["mse", "rehe", "hl_gauss"])
def test_graphs_compute_what_autograd_does(monkeypatch, critic_loss):
    range_ = {"value_range": (-300, 10)} if critic_loss == "hl_gauss" else {}
    kwargs = dict(critic_loss=critic_loss, policy_kwargs={**SETTINGS["policy_kwargs"], **range_})
    results = []
    for engine in ("auto", "autograd"):
        model = on_cuda(engine, **kwargs)
        logs = logged(model, monkeypatch)
        model.learn(70)
        graphs = sum(isinstance(each, Recording) for each in model._cuda_graphs._graphs.values())
        assert (graphs > 0) == (engine == "auto")
        results.append((model, logs))
    (ours, logs), (plain, plain_logs) = results
    assert_same(ours, plain, logs, plain_logs, rtol=2e-3, atol=2e-4)


@on_gpu
def test_graphs_follow_learning_rates(monkeypatch):
    def rate(progress):
        return 1e-3 if progress > 0.2 else 0.0

    model = on_cuda(learning_rate=rate, critic_learning_rate=rate, tau=0.01)
    weights = []
    monkeypatch.setattr(
        model, "_log_update", lambda *args: weights.append(model.critic.q_networks.layers[0].weight.detach().clone())
    )
    model.learn(100)
    assert any(isinstance(each, Recording) for each in model._cuda_graphs._graphs.values())
    assert not th.equal(weights[20], weights[21])
    assert th.equal(weights[-1], weights[-5])  # in the last fifth they stand still
    assert isinstance(model.critic.optimizer.param_groups[0]["lr"], float)
    assert model.critic.optimizer.param_groups[0]["capturable"] is False


@on_gpu
def test_graphs_after_loading(tmp_path, monkeypatch):
    model = on_cuda().learn(80)
    model.save(tmp_path / "model")
    model.save_replay_buffer(tmp_path / "buffer")
    results = []
    for engine in ("auto", "autograd"):
        loaded = Symphony.load(tmp_path / "model", env="Pendulum-v1", device="cuda")
        loaded.policy.critic_engine = engine
        loaded.load_replay_buffer(tmp_path / "buffer")
        loaded.set_random_seed(7)
        logs = logged(loaded, monkeypatch)
        loaded.learn(20, reset_num_timesteps=False)
        results.append((loaded, logs))
    (ours, logs), (plain, plain_logs) = results
    assert any(isinstance(each, Recording) for each in ours._cuda_graphs._graphs.values())
    assert_same(ours, plain, logs, plain_logs, rtol=2e-3, atol=2e-4)
