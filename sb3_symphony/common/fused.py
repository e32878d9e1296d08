"""
Hand-written forward and backward passes of stacked networks, on workspaces that are allocated once.

Autograd allocates every activation anew, keeps a graph and walks it; for networks of this size that costs more than the
matrix products. Each operation below owns its workspaces: ``forward`` takes what the one before it computed, ``backward``
the gradient with respect to its own result, and both may overwrite their argument.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable
from functools import partial

import torch as th
from torch import nn

from sb3_symphony.common.ensembles import StackedMLP
from sb3_symphony.common.layers import LeakySine, StackedLayerNorm, StackedLinear

aten = th.ops.aten


class Operation(ABC):
    """
    One layer of all members: ``(n_members, batch, features)`` in and out.

    :param module: The layer whose parameters are used
    :param like: A tensor of its result's shape, type and device, for workspaces
    """

    def __init__(self, module: nn.Module, like: th.Tensor) -> None:
        self.parameters: list[nn.Parameter] = list(module.parameters())
        self.grads = [th.zeros_like(parameter) for parameter in self.parameters]

    @abstractmethod
    def forward(self, x: th.Tensor) -> th.Tensor:
        """The layer's result."""

    @abstractmethod
    def backward(self, grad: th.Tensor) -> th.Tensor:
        """The gradient with respect to the layer's argument; those of its parameters are left in ``grads``."""


class Linear(Operation):
    """:param first: Whether nobody asks for the gradient with respect to the input"""

    def __init__(self, module: StackedLinear, like: th.Tensor, first: bool) -> None:
        super().__init__(module, like)
        self.module, self.first, self.out = module, first, th.empty_like(like)
        n_members, batch, _ = like.shape
        self.grad_input = None if first else like.new_empty(n_members, batch, module.weight.shape[1])

    def forward(self, x: th.Tensor) -> th.Tensor:
        self.input = x.expand(len(self.out), -1, -1)  # the first layer's is shared by all members
        return th.baddbmm(self.module.bias, self.input, self.module.weight, out=self.out)

    def backward(self, grad: th.Tensor) -> th.Tensor:
        grad_weight, grad_bias = self.grads
        th.bmm(self.input.transpose(1, 2), grad, out=grad_weight)
        th.sum(grad, 1, keepdim=True, out=grad_bias)
        return grad if self.first else th.bmm(grad, self.module.weight.transpose(1, 2), out=self.grad_input)


class Output(Linear):
    """The last layer, with one unit: matrix-vector products, member by member, beat batched ones of width 1."""

    def forward(self, x: th.Tensor) -> th.Tensor:
        self.input = x.expand(len(self.out), -1, -1)
        for bias, each, weight, out in zip(self.module.bias, self.input, self.module.weight, self.out, strict=True):
            th.addmv(bias[0], each, weight[:, 0], out=out[:, 0])
        return self.out

    def backward(self, grad: th.Tensor) -> th.Tensor:
        grad_weight, grad_bias = self.grads
        for each, one, out in zip(self.input, grad, grad_weight, strict=True):
            th.mv(each.t(), one[:, 0], out=out[:, 0])
        th.sum(grad, 1, keepdim=True, out=grad_bias)
        return grad if self.first else th.mul(grad, self.module.weight.transpose(1, 2), out=self.grad_input)


class LayerNorm(Operation):
    def __init__(self, module: StackedLayerNorm, like: th.Tensor) -> None:
        super().__init__(module, like)
        self.module = module
        self.out, self.normal, self.scratch = (th.empty_like(like) for _ in range(3))
        self.mean, self.rstd = (like.new_empty(*like.shape[:2], 1) for _ in range(2))

    def forward(self, x: th.Tensor) -> th.Tensor:
        self.input = x
        features = x.shape[-1]
        th.mean(x, -1, keepdim=True, out=self.mean)
        th.sub(x, self.mean, out=self.normal)
        th.linalg.vector_norm(self.normal, dim=-1, keepdim=True, out=self.rstd)
        self.rstd.square_().mul_(1.0 / features).add_(self.module.eps).rsqrt_()
        self.normal.mul_(self.rstd)
        return th.addcmul(self.module.bias, self.normal, self.module.weight, out=self.out)

    def backward(self, grad: th.Tensor) -> th.Tensor:
        grad_weight, grad_bias = self.grads
        th.sum(grad, 1, keepdim=True, out=grad_bias)
        th.mul(grad, self.normal, out=self.scratch)
        th.sum(self.scratch, 1, keepdim=True, out=grad_weight)
        grad.mul_(self.module.weight)
        shape = [grad.shape[-1]]
        mask = [True, False, False]
        return aten.native_layer_norm_backward(grad, self.input, shape, self.mean, self.rstd, None, None, mask)[0]


class Dropout(Operation):
    """Draws the same masks as ``torch.nn.Dropout`` does on the CPU with the same generator state."""

    def __init__(self, module: nn.Dropout, like: th.Tensor) -> None:
        super().__init__(module, like)
        self.keep, self.mask = 1.0 - module.p, th.empty_like(like)

    def forward(self, x: th.Tensor) -> th.Tensor:
        self.mask.bernoulli_(self.keep).div_(self.keep if self.keep > 0 else 1.0)
        return x.mul_(self.mask)

    def backward(self, grad: th.Tensor) -> th.Tensor:
        return grad.mul_(self.mask)


class InPlace(Operation):
    """
    An activation whose derivative follows from its result.

    :param forward_: Overwrites its argument
    :param backward_: Takes the gradient, the result and, as ``grad_input``, where to write: over the gradient
    """

    def __init__(self, module: nn.Module, like: th.Tensor, forward_: Callable, backward_: Callable) -> None:
        super().__init__(module, like)
        self.forward_, self.backward_ = forward_, backward_

    def forward(self, x: th.Tensor) -> th.Tensor:
        self.out = self.forward_(x)
        return self.out

    def backward(self, grad: th.Tensor) -> th.Tensor:
        return self.backward_(grad, self.out, grad_input=grad)


class Sine(Operation):
    def __init__(self, module: LeakySine, like: th.Tensor) -> None:
        super().__init__(module, like)
        self.slope, self.sine, self.out = module.slope, th.empty_like(like), th.empty_like(like)

    def forward(self, x: th.Tensor) -> th.Tensor:
        self.input = x
        th.sin(x, out=self.sine)
        return aten.leaky_relu.out(self.sine, self.slope, out=self.out)

    def backward(self, grad: th.Tensor) -> th.Tensor:
        aten.leaky_relu_backward.grad_input(grad, self.sine, self.slope, False, grad_input=grad)
        return grad.mul_(self.input.cos_())


def in_place(module: nn.Module) -> tuple[Callable, Callable] | None:
    """The two passes of an activation whose derivative follows from its result, ``None`` for any other module."""
    # Exact classes: a subclass may compute something else
    if type(module) is nn.ReLU:
        return th.relu_, lambda grad, out, grad_input: aten.threshold_backward.grad_input(grad, out, 0, grad_input=grad_input)
    if type(module) is nn.Tanh:
        return th.tanh_, aten.tanh_backward.grad_input
    if type(module) is nn.ELU and module.alpha > 0:
        alpha = module.alpha
        return partial(nn.functional.elu_, alpha=alpha), lambda grad, out, grad_input: aten.elu_backward.grad_input(
            grad, alpha, 1.0, 1.0, True, out, grad_input=grad_input
        )
    if type(module) is nn.LeakyReLU and module.negative_slope > 0:
        slope = module.negative_slope
        return partial(
            nn.functional.leaky_relu_, negative_slope=slope
        ), lambda grad, out, grad_input: aten.leaky_relu_backward.grad_input(grad, out, slope, True, grad_input=grad_input)
    return None


def uncovered(network: StackedMLP) -> str | None:
    """The first layer that has no hand-written passes, ``None`` if all have."""
    known = (StackedLinear, StackedLayerNorm, nn.Dropout, nn.Identity, LeakySine)
    return next((type(m).__name__ for m in network.layers if type(m) not in known and in_place(m) is None), None)


class FusedNetwork:
    """
    The passes of a :class:`~sb3_symphony.common.ensembles.StackedMLP` in training mode, for one batch size.

    :param network: Its parameters are used where they are; gradients are kept apart from ``parameter.grad``
    :param batch_size: Rows of the input
    """

    def __init__(self, network: StackedMLP, batch_size: int) -> None:
        first = network.layers[0]
        assert isinstance(first, StackedLinear)
        n_members, input_dim, _ = first.weight.shape
        self.input = first.weight.new_empty(batch_size, input_dim).detach()
        self.operations: list[Operation] = []
        like = self.input
        for module in network.layers:
            if isinstance(module, StackedLinear):
                like = self.input.new_empty(n_members, batch_size, module.weight.shape[2])
                linear = Output if module.weight.shape[2] == 1 else Linear
                self.operations.append(linear(module, like, first=module is first))
            elif isinstance(module, StackedLayerNorm):
                self.operations.append(LayerNorm(module, like))
            elif isinstance(module, nn.Dropout):
                self.operations.append(Dropout(module, like))
            elif isinstance(module, LeakySine):
                self.operations.append(Sine(module, like))
            elif (passes := in_place(module)) is not None:
                self.operations.append(InPlace(module, like, *passes))
        self.parameters: list[th.Tensor] = [parameter for operation in self.operations for parameter in operation.parameters]
        self.grads = [grad for operation in self.operations for grad in operation.grads]

    def forward(self, *parts: th.Tensor) -> th.Tensor:
        """
        :param parts: Tensors ``(batch, ...)`` whose concatenation is the input
        :return: ``(n_members, batch, 1)``, valid until the next call
        """
        x = th.cat(parts, dim=1, out=self.input)
        for operation in self.operations:
            x = operation.forward(x)
        return x

    def backward(self, grad: th.Tensor) -> None:
        """
        Write the gradients of all parameters to ``grads``.

        :param grad: Gradient with respect to the result of ``forward``, is overwritten
        """
        for operation in reversed(self.operations):
            grad = operation.backward(grad)
