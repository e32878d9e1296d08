"""
Critic regression: one step of all critics toward a given target.

The only place with two implementations: plain autograd, for any network and optimiser, and a fused one for plain MLPs
with Adam. They compute the same numbers up to rounding, on the same parameters and optimiser state.
"""

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any, NamedTuple

import torch as th
from stable_baselines3.common.torch_layers import FlattenExtractor
from stable_baselines3.common.type_aliases import PyTorchObs
from stable_baselines3.common.utils import get_parameters_by_name, polyak_update
from torch.autograd.function import once_differentiable

from sb3_symphony.common.ensembles import EnsembleCritic, StackedMLP
from sb3_symphony.common.fused import FusedNetwork, are_same, array, parameters_of, uncovered
from sb3_symphony.common.hooks import are_hooked
from sb3_symphony.common.kernels import adam_polyak
from sb3_symphony.common.losses import CRITIC_LOSS_SLOPES, CRITIC_LOSSES, ValueBins

logger = logging.getLogger(__name__)

ENGINES = ("auto", "autograd", "fused", "bf16")


class Fit(NamedTuple):
    """What a regression step computed, before the step: ``loss`` a scalar, ``q_values (n_critics, batch, 1)``."""

    loss: th.Tensor
    q_values: th.Tensor


class Error:
    """
    The objective of critics whose outputs are values: to have small errors.

    :param loss: Error function by name
    :param reduction: ``"independent"`` or ``"ensemble_mean"``
    """

    def __init__(self, loss: str, reduction: str) -> None:
        self._loss, self._slope, self.reduction = CRITIC_LOSSES[loss], CRITIC_LOSS_SLOPES[loss], reduction

    def _error(self, outputs: th.Tensor, target: th.Tensor) -> th.Tensor:
        """``(n_critics, batch, 1)``, or ``(1, batch, 1)`` if the critics' mean is what meets the target."""
        return target - (outputs if self.reduction == "independent" else outputs.mean(dim=0, keepdim=True))

    def loss(self, outputs: th.Tensor, target: th.Tensor, weights: th.Tensor | None) -> th.Tensor:
        """
        :param outputs: What the networks give ``(n_critics, batch, n_outputs)``
        :param target: ``(batch, 1)``
        :param weights: Importance weights ``(batch, 1)`` of a prioritised replay
        :return: The loss of each critic ``(n_critics,)``, or of their mean ``(1,)``
        """
        return self._loss(self._error(outputs, target), weights)

    def loss_slope_and_values(
        self, outputs: th.Tensor, target: th.Tensor, weights: th.Tensor | None
    ) -> tuple[th.Tensor, th.Tensor, th.Tensor]:
        """The losses, the derivative of their sum with respect to ``outputs``, and the values, in memory of their own."""
        error = self._error(outputs, target)
        # d error / d outputs = -1, or -1 / n_critics where the error is that of their mean
        slope = self._slope(error, weights).expand_as(outputs) * (-len(error) / len(outputs))
        return self._loss(error, weights), slope, outputs.clone()

    def values(self, outputs: th.Tensor) -> th.Tensor:
        """The critics' values ``(n_critics, batch, 1)``, maybe in the same memory."""
        return outputs

    def values_slope(self, outputs: th.Tensor, grad: th.Tensor) -> th.Tensor:
        """The gradient with respect to ``outputs`` of what has the gradient ``grad`` with respect to the values."""
        return grad


class CriticRegression:
    """
    Steps the critics toward a target and their targets toward them, by plain autograd.

    :param critic: The critics; ``critic.optimizer`` is the optimiser that is stepped
    :param critic_target: Their targets
    :param loss: Error function by name, see :data:`sb3_symphony.common.losses.CRITIC_LOSSES`; ``"hl_gauss"`` for critics
        that classify
    :param reduction: ``"independent"``: sum of each critic's loss; ``"ensemble_mean"``: loss of the critics' mean
    """

    def __init__(self, critic: EnsembleCritic, critic_target: EnsembleCritic, loss: str, reduction: str) -> None:
        self.critic, self.critic_target = critic, critic_target
        self.objective = Error(loss, reduction) if critic.bins is None else critic.bins
        # Running statistics of batch normalisation (in features extractors) are copied, as in SB3
        self.running_stats = get_parameters_by_name(critic, ["running_"])
        self.running_stats_target = get_parameters_by_name(critic_target, ["running_"])

    @contextmanager
    def unchanged(self) -> Iterator[None]:
        """While it lasts nobody loads critics or replaces parts of them: what was looked at once need not be again."""
        yield

    def fit(
        self,
        observations: PyTorchObs,
        actions: th.Tensor,
        target: th.Tensor,
        tau: float,
        weights: th.Tensor | None = None,
    ) -> Fit:
        """
        One optimiser step of the critics, then one Polyak step of their targets.

        :param observations: ``(batch, ...)``
        :param actions: ``(batch, action_dim)`` in [-1, 1]
        :param target: ``(batch, 1)``, without gradient
        :param tau: Polyak coefficient
        :param weights: Importance weights ``(batch, 1)`` of a prioritised replay
        :return: The loss and the critics' values before the step
        """
        # By calling the module, unless bins become a value there: so a subclass's forward() counts, and hooks do
        compute = self.critic if self.critic.bins is None else self.critic.outputs
        outputs = compute(observations, actions)  # (n_critics, batch, 1 or n_bins)
        loss = self.objective.loss(outputs, target, weights).sum()

        self.critic.optimizer.zero_grad()
        loss.backward()
        self.critic.optimizer.step()

        with th.no_grad():  # the numbers of SB3's polyak_update, in two kernels of a GPU
            parameters: list[th.Tensor] = list(self.critic.parameters())
            targets: list[th.Tensor] = list(self.critic_target.parameters())
            th._foreach_mul_(targets, 1 - tau)
            th._foreach_add_(targets, parameters, alpha=tau)
        polyak_update(self.running_stats, self.running_stats_target, 1.0)
        return Fit(loss.detach(), self.objective.values(outputs.detach()))

    def q_values(self, observations: PyTorchObs, actions: th.Tensor) -> th.Tensor:
        """
        Values for the actor's step: differentiable with respect to the actions. Go back through them before the next call.

        :param observations: ``(batch, ...)``
        :param actions: ``(batch, action_dim)`` in [-1, 1]
        :return: ``(n_critics, batch, 1)``
        """
        return self.critic(observations, actions)

    def target_q_values(self, observations: PyTorchObs, actions: th.Tensor, members: list[int] | None = None) -> th.Tensor:
        """
        Values of the target critics, without gradient, valid until the next call.

        :param observations: ``(batch, ...)``
        :param actions: ``(batch, action_dim)`` in [-1, 1]
        :param members: Indices of the critics to compute, all of them by default
        :return: ``(n_critics, batch, 1)``
        """
        with th.no_grad():
            return self.critic_target(observations, actions, members)


class _QValues(th.autograd.Function):
    """The critics' values by hand-written passes, differentiable with respect to the actions alone."""

    @staticmethod
    def forward(
        ctx: Any, actions: th.Tensor, features: th.Tensor, network: FusedNetwork, objective: Error | ValueBins
    ) -> th.Tensor:
        ctx.network, ctx.objective, ctx.action_dim = network, objective, actions.shape[1]
        ctx.outputs = network.forward(features, actions)
        return objective.values(ctx.outputs).clone()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: th.Tensor) -> tuple[th.Tensor, None, None, None]:
        slope = ctx.objective.values_slope(ctx.outputs, grad)
        return ctx.network.action_gradient(slope, ctx.action_dim), None, None, None


class FusedRegression(CriticRegression):
    """
    The same by hand-written passes in memory kept between calls, Adam and Polyak in one sweep.

    :param bfloat16: Whether to round the operands of large products, see
        :class:`~sb3_symphony.common.products.BFloat16Products`
    """

    def __init__(
        self, critic: EnsembleCritic, critic_target: EnsembleCritic, loss: str, reduction: str, bfloat16: bool = False
    ) -> None:
        super().__init__(critic, critic_target, loss, reduction)
        self.bfloat16 = bfloat16
        self._networks: dict[EnsembleCritic, list[FusedNetwork]] = {}
        self._sweeps: list[partial] = []  # of Adam and Polyak, one per parameter
        # Network, addresses of the optimiser's state and of the targets, all of them in the sweeps
        self._swept: tuple[FusedNetwork | None, list[int]] = (None, [])
        # While nothing changes: whether there are passes (None: it may change), those looked up, whether the sweeps are theirs
        self._has_passes: bool | None = None
        self._known: dict[tuple[EnsembleCritic, int], FusedNetwork] = {}
        self._sweeps_known = False

    def __getstate__(self) -> dict[str, Any]:
        made_again: dict[str, Any] = {"_networks": {}, "_sweeps": [], "_swept": (None, []), "_known": {}}
        return {**vars(self), **made_again, "_has_passes": None}

    @contextmanager
    def unchanged(self) -> Iterator[None]:
        self._has_passes, self._known, self._sweeps_known = self._are_fusable(), {}, False
        try:
            yield
        finally:
            self._has_passes = None

    def fit(
        self,
        observations: PyTorchObs,
        actions: th.Tensor,
        target: th.Tensor,
        tau: float,
        weights: th.Tensor | None = None,
    ) -> Fit:
        network = self._passes(self.critic, actions.shape[0])
        if network is None:
            return super().fit(observations, actions, target, tau, weights)
        with th.no_grad():
            features = self.critic.extract_features(observations, self.critic.features_extractor)
            outputs = network.forward(features, actions)
            loss, slope, q_values = self.objective.loss_slope_and_values(outputs, target, weights)
            network.backward(slope)
            self._step(network, tau)
            return Fit(loss.sum(), q_values)

    def q_values(self, observations: PyTorchObs, actions: th.Tensor) -> th.Tensor:
        network = self._passes(self.critic, actions.shape[0])
        if network is None:
            return super().q_values(observations, actions)
        with th.no_grad():
            features = self.critic.extract_features(observations, self.critic.features_extractor)
        return _QValues.apply(actions, features, network, self.objective)

    def target_q_values(self, observations: PyTorchObs, actions: th.Tensor, members: list[int] | None = None) -> th.Tensor:
        network = self._passes(self.critic_target, actions.shape[0])
        if network is None:
            return super().target_q_values(observations, actions, members)
        with th.no_grad():
            features = self.critic_target.extract_features(observations, self.critic_target.features_extractor)
            return self.objective.values(network.forward(features, actions, members))

    def _passes(self, critic: EnsembleCritic, batch_size: int) -> FusedNetwork | None:
        """Hand-written passes of critics; ``None`` if something about them is autograd's business."""
        if self._has_passes is None:
            return self._network(critic, batch_size) if self._are_fusable() else None
        if not self._has_passes:
            return None
        key = critic, batch_size
        if key not in self._known:
            self._known[key] = self._network(critic, batch_size)
        return self._known[key]

    def _are_fusable(self) -> bool:
        both = self.critic, self.critic_target
        return not any(not_fusable(each) is not None or _has_more_than_passes(each) for each in both)

    def _network(self, critic: EnsembleCritic, batch_size: int) -> FusedNetwork:
        known = self._networks.get(critic, [])
        for network in known:
            if network.fits(critic.q_networks, batch_size):
                return network
        others = (each for owner, networks in self._networks.items() if owner is not critic for each in networks)
        lenders = (each for each in others if len(each.input) == batch_size and each.resembles(critic.q_networks))
        network = FusedNetwork(critic.q_networks, batch_size, self.bfloat16, next(lenders, None))
        self._networks[critic] = [network, *known[:1]]  # the actor's batch may have another size
        return network

    def _step(self, network: FusedNetwork, tau: float) -> None:
        """Adam and Polyak of all parameters."""
        if self._has_passes is None or not self._sweeps_known or network is not self._swept[0]:
            self._prepare_sweeps(network)
            self._sweeps_known = True
        group = self.critic.optimizer.param_groups[0]
        weight_decay = group["weight_decay"], group["decoupled_weight_decay"]
        for sweep in self._sweeps:
            sweep(group["lr"], *group["betas"], group["eps"], *weight_decay, tau)

    def _prepare_sweeps(self, network: FusedNetwork) -> None:
        """Over parameters and targets where they are, with states where torch's optimiser keeps them."""
        optimizer = self.critic.optimizer
        states = [optimizer.state[parameter] for parameter in network.parameters]
        targets = parameters_of(self.critic_target.q_networks)
        for parameter, state in zip(network.parameters, states, strict=True):
            if not state:  # as Adam itself does at a parameter's first step
                state["step"] = th.zeros((), dtype=th.float32)
                state.update(exp_avg=th.zeros_like(parameter), exp_avg_sq=th.zeros_like(parameter))
            for name in ("exp_avg", "exp_avg_sq"):  # others' may have been loaded
                state[name] = state[name].contiguous()
        addresses = [state["exp_avg"].data_ptr() for state in states] + [target.data_ptr() for target in targets]
        if network is not self._swept[0] or addresses != self._swept[1]:  # another batch size; what was loaded lies elsewhere
            self._swept = (network, addresses)
            self._sweeps = []
            for parameter, grad, state, target in zip(network.parameters, network.grads, states, targets, strict=True):
                tensors = (parameter, grad, state["exp_avg"], state["exp_avg_sq"], state["step"], target)
                self._sweeps.append(partial(adam_polyak, *(array(tensor).reshape(-1) for tensor in tensors)))


def _optimizer_of(critic: EnsembleCritic) -> th.optim.Optimizer | None:
    """Targets have none."""
    return getattr(critic, "optimizer", None)


def _has_more_than_passes(critic: EnsembleCritic) -> bool:
    """
    Whether more happens to fusable critics than their passes and Adam: hooks (to clip gradients, say), a frozen layer. Or
    less: compiled loops would work on copies of what is not contiguous.
    """
    network, optimizer = critic.q_networks, _optimizer_of(critic)
    modules = (critic, network, *network.layers)
    parameters = parameters_of(network)
    if not all(parameter.is_contiguous() for parameter in parameters):
        return True
    if optimizer is None:
        return are_hooked(modules, [], [])
    return are_hooked(modules, parameters, [optimizer]) or not all(parameter.requires_grad for parameter in parameters)


def not_fusable(critic: EnsembleCritic) -> str | None:
    """
    Why critics cannot be fitted by :class:`FusedRegression`.

    :param critic: The critics, or their targets
    :return: A reason, or ``None`` if they can
    """
    optimizer = _optimizer_of(critic)
    if type(critic) is not EnsembleCritic:  # a subclass may compute something else
        return f"the critic is {type(critic).__name__}, not EnsembleCritic"
    if type(critic.features_extractor) is not FlattenExtractor:
        return f"the features extractor is {type(critic.features_extractor).__name__}, not FlattenExtractor"
    if type(critic.q_networks) is not StackedMLP:
        return f"the networks are {type(critic.q_networks).__name__}, not StackedMLP"
    if (device := parameters_of(critic.q_networks)[0].device).type != "cpu":  # critic.device looks through all modules
        return f"the device is {device}, not the CPU"
    if (layer := uncovered(critic.q_networks)) is not None:
        return f"no hand-written passes for {layer}"
    if optimizer is None:
        return None
    if type(optimizer) not in (th.optim.Adam, th.optim.AdamW):
        return f"the optimizer is {type(optimizer).__name__}, not Adam or AdamW"
    if len(optimizer.param_groups) > 1:
        return f"the optimizer has {len(optimizer.param_groups)} groups of parameters"
    (group,) = optimizer.param_groups
    if not group["fused"]:
        return f"the optimizer has fused={group['fused']}"
    if not are_same(group["params"], parameters_of(critic.q_networks)):
        return "the optimizer's parameters are not those of the critics"
    special = [name for name in ("amsgrad", "maximize", "capturable", "differentiable") if group[name]]
    return f"the optimizer has {special[0]}=True" if special else None


def has_bfloat16() -> bool:
    """Whether the processor multiplies bfloat16 natively: AVX512-BF16, AMX or ARM's BF16."""
    capabilities = th.cpu.get_capabilities() if hasattr(th.cpu, "get_capabilities") else {}
    return any(capabilities.get(name) for name in ("avx512_bf16", "amx_bf16", "bf16"))


def make_regression(
    critic: EnsembleCritic, critic_target: EnsembleCritic, loss: str, reduction: str, engine: str = "auto"
) -> CriticRegression:
    """
    The regression of given critics.

    :param critic: The critics, with their optimiser
    :param critic_target: Their targets
    :param loss: Error function by name
    :param reduction: ``"independent"`` or ``"ensemble_mean"``
    :param engine: ``"auto"`` (fused if possible), ``"autograd"``, ``"fused"``, or ``"bf16"``: fused, with large products in
        bfloat16
    :raises ValueError: if ``"fused"`` or ``"bf16"`` cannot be, saying why
    """
    reason = not_fusable(critic)
    if engine == "bf16" and reason is None and not has_bfloat16():
        reason = "the processor has no bfloat16 arithmetic (AVX512-BF16 or AMX)"
    if engine in ("fused", "bf16") and reason is not None:
        raise ValueError(f"critic_engine='{engine}' is not possible: {reason}; expected critic_engine='auto' or 'autograd'")
    if engine == "auto" and reason is not None:
        logger.info("critics are fitted by autograd: %s", reason)
    if engine == "autograd" or reason is not None:
        return CriticRegression(critic, critic_target, loss, reduction)
    return FusedRegression(critic, critic_target, loss, reduction, bfloat16=engine == "bf16")
