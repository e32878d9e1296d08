"""
Updates on a GPU without Python between their kernels: recorded once as CUDA graphs, then replayed.

An update of small networks launches about a hundred kernels that take a few microseconds each, less than Python and autograd
need to launch one.
"""

from collections.abc import Callable, Hashable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, NamedTuple

import torch as th
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, FlattenExtractor
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from torch import nn

from sb3_symphony.common.hooks import are_hooked

WARM_UPS = 3  # plain calls before a recording: optimisers, cuBLAS and the allocator set up what they keep
MAX_RECORDINGS = 16  # of the latest kinds of calls

Outputs = dict[str, th.Tensor]


class Recording(NamedTuple):
    """A graph, what it reads and writes, and the learning rates that it reads."""

    graph: Any
    inputs: ReplayBufferSamples
    outputs: Outputs
    rates: list[th.Tensor]


class CudaGraphs:
    """
    Calls of functions that work on a GPU, which are replayed from the fourth call of a kind on.

    Everything but transitions and learning rates is part of a recording: where tensors lie, Python's numbers and decisions.
    """

    def __init__(self) -> None:
        self._graphs: dict[Hashable, Recording | int] = {}  # or the number of calls so far

    def __getstate__(self) -> dict[str, Any]:
        return {"_graphs": {}}

    def run(
        self,
        kind: Hashable,
        function: Callable[[Any], Outputs],
        samples: Any,
        optimizers: Sequence[th.optim.Optimizer],
    ) -> Outputs:
        """
        :param kind: Equal for calls that differ in transitions and learning rates alone
        :param function: What to call; it changes nothing but tensors, in place
        :param samples: Transitions, the function's argument: a named tuple of tensors or ``None``
        :param optimizers: All that the function steps
        :return: What the function returns
        """
        known = self._graphs.pop(kind, 0)
        if isinstance(known, int) and known < WARM_UPS:
            outputs, known = self._warm_up(function, samples), known + 1
        else:
            if isinstance(known, int):
                known = self._record(function, samples, optimizers)
            outputs = self._replay(known, samples, optimizers)
        self._graphs[kind] = known  # now the latest
        while len(self._graphs) > MAX_RECORDINGS:
            del self._graphs[next(iter(self._graphs))]
        return outputs

    def _warm_up(self, function: Callable[[Any], Outputs], samples: Any) -> Outputs:
        """On a stream of its own, as recordings are."""
        current = th.cuda.current_stream(samples[0].device)
        stream = th.cuda.Stream(samples[0].device)
        stream.wait_stream(current)
        with th.cuda.stream(stream):
            outputs = function(samples)
        current.wait_stream(stream)
        return outputs

    def _record(self, function: Callable[[Any], Outputs], samples: Any, optimizers: Sequence[th.optim.Optimizer]) -> Recording:
        inputs = type(samples)(*(None if field is None else field.clone() for field in samples))
        graph, stream = th.cuda.CUDAGraph(), th.cuda.Stream(inputs[0].device)
        try:
            # Other threads may use the GPU meanwhile
            with _rates_on_device(optimizers) as rates, th.cuda.graph(graph, None, stream, "thread_local"):
                outputs = function(inputs)  # nothing is computed yet
        except RuntimeError as error:
            raise RuntimeError(
                "the updates could not be recorded as a CUDA graph, maybe because a tensor is kept that gradients flow "
                "through (detach() it); without recordings: policy_kwargs=dict(critic_engine='autograd')"
            ) from error
        return Recording(graph, inputs, outputs, rates)

    def _replay(self, recording: Recording, samples: Any, optimizers: Sequence[th.optim.Optimizer]) -> Outputs:
        for static, field in zip(recording.inputs, samples, strict=True):
            if static is not None:
                static.copy_(field)
        for rate, group in zip(recording.rates, _groups(optimizers), strict=True):
            rate.fill_(group["lr"])
        recording.graph.replay()
        return {key: output.clone() for key, output in recording.outputs.items()}  # the next replay writes over them


def _groups(optimizers: Sequence[th.optim.Optimizer]) -> list[dict[str, Any]]:
    return [group for optimizer in optimizers for group in optimizer.param_groups]


@contextmanager
def _rates_on_device(optimizers: Sequence[th.optim.Optimizer]) -> Iterator[list[th.Tensor]]:
    """While it lasts, learning rates are tensors, which a recording reads at each replay: one for each group."""
    groups = _groups(optimizers)
    before = [(group["lr"], group["capturable"]) for group in groups]
    rates = [th.full((), float(group["lr"]), device=group["params"][0].device) for group in groups]
    try:
        for group, rate in zip(groups, rates, strict=True):
            group.update(lr=rate, capturable=True)
        yield rates
    finally:
        for group, (rate, capturable) in zip(groups, before, strict=True):
            group.update(lr=rate, capturable=capturable)


def recorded_state(policy: nn.Module, optimizers: Sequence[th.optim.Optimizer]) -> Hashable | None:
    """
    What a recording of updates depends on: where parameters and the optimisers' states lie, which are trained, in which mode.

    :param policy: The module that has all networks
    :param optimizers: All that are stepped
    :return: ``None`` if more happens than kernels (hooks, states that are made), or something is not known to be recordable
    """
    modules, parameters = list(policy.modules()), list(policy.parameters())
    if are_hooked(modules, parameters, optimizers):
        return None
    if any(isinstance(m, BaseFeaturesExtractor) and type(m) is not FlattenExtractor for m in modules):
        return None
    for optimizer in optimizers:
        if type(optimizer) not in (th.optim.Adam, th.optim.AdamW) or not all(g["fused"] for g in optimizer.param_groups):
            return None
        trained = (each for group in optimizer.param_groups for each in group["params"] if each.requires_grad)
        if any(each not in optimizer.state for each in trained):
            return None  # its first step makes the state; a recording of that step would make another one, again and again
    states = [state for optimizer in optimizers for each in optimizer.state.values() for state in each.values()]
    tensors = [*parameters, *policy.buffers(), *states]
    apart = ("params", "lr", "initial_lr")
    options = [{name: value for name, value in group.items() if name not in apart} for group in _groups(optimizers)]
    return (
        tuple(tensor.data_ptr() for tensor in tensors),
        tuple(parameter.requires_grad for parameter in parameters),
        tuple((module.training, getattr(module, "p", None)) for module in modules),
        str(options),
    )
