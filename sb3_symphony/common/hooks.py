"""What users may have attached to networks and optimisers."""

from collections.abc import Iterable

import torch as th
from torch import nn


def are_hooked(
    modules: Iterable[nn.Module], parameters: Iterable[nn.Parameter], optimizers: Iterable[th.optim.Optimizer]
) -> bool:
    """
    Whether more happens than passes and steps: hooks (to clip gradients, say), or an optimiser's ``step`` that was replaced.

    :param modules: Networks and their layers
    :param parameters: Those that are trained
    :param optimizers: What steps them
    """
    return (
        any(m._forward_hooks or m._forward_pre_hooks or m._backward_hooks or m._backward_pre_hooks for m in modules)
        or any("step" in vars(o) or o._optimizer_step_pre_hooks or o._optimizer_step_post_hooks for o in optimizers)
        or any(p._backward_hooks or p._post_accumulate_grad_hooks for p in parameters)
    )
