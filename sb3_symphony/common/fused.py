"""
Hand-written forward and backward passes of stacked networks on the CPU, in memory that is allocated once.

Autograd allocates every activation anew, keeps a graph and walks it, and sweeps over memory for each small operation; for
networks of this size that costs more than the matrix products. Here torch makes the products, and the compiled loops of
:mod:`~sb3_symphony.common.kernels` do what lies between them.
"""

import operator
from collections.abc import Callable, Iterator, Sequence
from functools import cache, partial
from typing import Any, NamedTuple

import numpy as np
import torch as th
from torch import nn

from sb3_symphony.common.ensembles import StackedMLP
from sb3_symphony.common.kernels import (
    IDENTITY,
    LEAKY_RELU,
    LEAKY_SINE,
    layer_backward,
    layer_forward,
    output_backward,
    output_forward,
)
from sb3_symphony.common.layers import Dropout, LeakySine, StackedLayerNorm, StackedLinear, draw_dropped

aten = th.ops.aten


class Activation(NamedTuple):
    """
    How an activation is computed.

    :param code: What the kernel applies
    :param slope: For values below zero
    :param forward: What torch does in place after the kernel, if anything
    :param backward: Its derivative times the first argument, in place; the second is the result of ``forward``
    """

    code: int
    slope: float = 1.0
    forward: Callable[[th.Tensor], th.Tensor] | None = None
    backward: Callable[[th.Tensor, th.Tensor], th.Tensor] | None = None


def activation_of(module: nn.Module) -> Activation | None:
    """How a module is computed if it is an activation that has hand-written passes, else ``None``."""
    # Exact classes: a subclass may compute something else
    if type(module) is nn.Identity:
        return Activation(IDENTITY)
    if type(module) is nn.ReLU:
        return Activation(LEAKY_RELU, 0.0)
    if type(module) is nn.LeakyReLU and module.negative_slope > 0:
        return Activation(LEAKY_RELU, module.negative_slope)
    if type(module) is LeakySine:
        return Activation(LEAKY_SINE, module.slope)
    if type(module) is nn.Tanh:
        return Activation(IDENTITY, 1.0, th.tanh_, lambda grad, out: aten.tanh_backward.grad_input(grad, out, grad_input=grad))
    if type(module) is nn.ELU and module.alpha > 0:
        alpha = module.alpha

        def elu_backward(grad: th.Tensor, out: th.Tensor) -> th.Tensor:
            return aten.elu_backward.grad_input(grad, alpha, 1.0, 1.0, True, out, grad_input=grad)

        return Activation(IDENTITY, 1.0, partial(nn.functional.elu_, alpha=alpha), elu_backward)
    return None


def uncovered(network: StackedMLP) -> str | None:
    """The first layer that has no hand-written passes, ``None`` if all have."""
    known = (StackedLinear, StackedLayerNorm, Dropout)
    return next((type(m).__name__ for m in network.layers if type(m) not in known and activation_of(m) is None), None)


def parameters_of(network: StackedMLP) -> list[nn.Parameter]:
    """The same as ``network.parameters()``, in a fifth of the time."""
    return [parameter for layer in network.layers for parameter in layer._parameters.values() if parameter is not None]


def are_same(objects: Sequence[Any], others: Sequence[Any]) -> bool:
    """Whether two lists hold the very same objects."""
    return len(objects) == len(others) and all(map(operator.is_, objects, others))


def array(tensor: th.Tensor) -> np.ndarray:
    """The same memory, as the kernels take it."""
    return tensor.detach().numpy()


@cache
def all_members(n: int) -> np.ndarray:
    """Indices ``(n,)`` of all networks in their order: always the same array, so that asking for it costs no comparison."""
    return np.arange(n)


NOTHING = np.zeros(0, dtype=np.int64)  # positions of what is dropped where nothing is


class Products:
    """
    The products of a hidden layer: with its weights, and the two of its backward pass.

    :param weight: ``(n_members, in_features, width)``
    """

    def __init__(self, weight: th.Tensor) -> None:
        self.weight = weight
        self._all_members = all_members(weight.shape[0])

    def forward(self, x: th.Tensor, members: np.ndarray, out: th.Tensor) -> None:
        """
        :param x: ``(n, batch, in_features)``
        :param members: Indices ``(n,)`` of the networks to compute
        :param out: Where to write the result ``(n, batch, width)``
        """
        if members is self._all_members:
            th.bmm(x, self.weight, out=out)
        else:  # one by one, rather than gather the weights first
            for k, each, result in zip(members.tolist(), x, out, strict=True):
                th.mm(each, self.weight[k], out=result)

    def backward(self, x: th.Tensor, grad: th.Tensor, grad_weight: th.Tensor | None, grad_input: th.Tensor | None) -> None:
        """
        Of all members.

        :param x: The same as in ``forward``
        :param grad: Gradient with respect to the product ``(n_members, batch, width)``
        :param grad_weight: Where to write that with respect to the weights, if it is wanted
        :param grad_input: Where to write that with respect to ``x``, if it is wanted
        """
        if grad_weight is not None:
            th.bmm(x.transpose(1, 2), grad, out=grad_weight)
        if grad_input is not None:
            th.bmm(grad, self.weight.transpose(1, 2), out=grad_input)


class BFloat16Products(Products):
    """
    The same on operands rounded to bfloat16; sums are in single precision, results rounded.

    Twice as fast where the processor has such arithmetic, several times slower where it has not.

    :param weight: ``(n_members, in_features, width)``
    :param batch_size: Rows of the input
    """

    def __init__(self, weight: th.Tensor, batch_size: int) -> None:
        super().__init__(weight)
        n_members, in_features, width = weight.shape

        def rounded(*shape: int) -> th.Tensor:
            return th.zeros(n_members, *shape, dtype=th.bfloat16)

        self.operands = rounded(batch_size, in_features), rounded(in_features, width), rounded(batch_size, width)
        self.results = rounded(batch_size, in_features), rounded(in_features, width), rounded(batch_size, width)

    def forward(self, x: th.Tensor, members: np.ndarray, out: th.Tensor) -> None:
        n = len(members)
        rounded_x, weight, product = self.operands[0][:n], self.operands[1][:n], self.results[2][:n]
        rounded_x.copy_(x)
        if members is self._all_members:
            weight.copy_(self.weight)
        else:
            for k, each in zip(members.tolist(), weight, strict=True):
                each.copy_(self.weight[k])
        out.copy_(th.bmm(rounded_x, weight, out=product))

    def backward(self, x: th.Tensor, grad: th.Tensor, grad_weight: th.Tensor | None, grad_input: th.Tensor | None) -> None:
        rounded_x, weight, rounded_grad = self.operands  # the first two are still there from the forward pass
        rounded_grad.copy_(grad)
        if grad_weight is not None:
            grad_weight.copy_(th.bmm(rounded_x.transpose(1, 2), rounded_grad, out=self.results[1]))
        if grad_input is not None:
            grad_input.copy_(th.bmm(rounded_grad, weight.transpose(1, 2), out=self.results[0]))


def _zeros(linear: StackedLinear, batch_size: int) -> th.Tensor:
    """Memory for the result of a layer, ``(n_members, batch, width)``."""
    n_members, _, width = linear.weight.shape
    return linear.weight.detach().new_zeros(n_members, batch_size, width)


MIN_ROUNDED = 4096  # weights per member: below, the casts cost more than the products gain


class Layer:
    """
    A linear layer of all members and what follows it.

    :param linear: The linear layer
    """

    def __init__(self, linear: StackedLinear) -> None:
        self.weight = linear.weight.detach()
        self._n_members = self.weight.shape[0]
        self.parameters: list[nn.Parameter] = [linear.weight, linear.bias]
        self.grads = [th.zeros_like(parameter).detach() for parameter in self.parameters]


class Hidden(Layer):
    """
    ``Linear → Dropout → LayerNorm → activation``; dropout and LayerNorm may be missing.

    What is dropped is what the module drops with the same generator state.

    :param lender: A layer of the same shape, of another network, whose memory is used; what that has computed is lost then.
        Critics and targets take turns, and what both keep for themselves does not fit a second-level cache
    """

    def __init__(
        self,
        linear: StackedLinear,
        dropout: Dropout | None,
        norm: StackedLayerNorm | None,
        activation: Activation,
        batch_size: int,
        bfloat16: bool,
        lender: "Hidden | None" = None,
    ) -> None:
        super().__init__(linear)
        self.dropout, self.activation = dropout, activation
        rounded = bfloat16 and self.weight[0].numel() >= MIN_ROUNDED
        self.products = BFloat16Products(self.weight, batch_size) if rounded else Products(self.weight)
        if lender is None:
            # The result, and the gradient with respect to it: (n_members, batch, width)
            self.out, self.grad = (_zeros(linear, batch_size) for _ in range(2))
            # LayerNorm and sine need what they were computed from in their backward pass; the others work in place
            keeps_product = norm is not None or activation.code == LEAKY_SINE
            self.product = th.zeros_like(self.out) if keeps_product else self.out
            self.rstd = self.out.new_zeros(self.out.shape[:2])
            self.derivative = th.zeros_like(self.out) if activation.code == LEAKY_SINE else self.out
        else:
            self.out, self.grad, self.product = lender.out, lender.grad, lender.product
            self.rstd, self.derivative = lender.rstd, lender.derivative
        gain = shift = linear.bias  # in place of what the kernel does not use
        if norm is not None:
            gain, shift = norm.weight, norm.bias
            self.parameters += [gain, shift]
            self.grads += [th.zeros_like(gain).detach(), th.zeros_like(shift).detach()]

        product, out, grad, rstd, derivative = map(array, (self.product, self.out, self.grad, self.rstd, self.derivative))
        bias, gains, shifts = map(array, (linear.bias, gain, shift))
        self._real = out.dtype.type
        eps, slope = self._real(0 if norm is None else norm.eps), self._real(activation.slope)
        options = norm is not None, dropout is not None, activation.code
        self._forward = partial(layer_forward(*options), product, bias, gains, shifts, eps, slope, rstd, derivative, out)
        grads = map(array, (self.grads[1], self.grads[-2], self.grads[-1]))
        self._backward = partial(layer_backward(*options), grad, product, out, gains, slope, rstd, derivative, *grads)
        self._dropout = self._real(1), NOTHING  # factor of what dropout keeps, positions of what it drops

    def forward(self, x: th.Tensor, members: np.ndarray) -> th.Tensor:
        """
        :param x: ``(n, batch, in_features)``
        :param members: Indices ``(n,)`` of the networks to compute
        :return: ``(n, batch, width)``
        """
        n = len(members)
        product, out = self.product, self.out
        if n < self._n_members:
            product, out = product[:n], out[:n]
        self.input = x
        self.products.forward(x, members, product)
        if self.dropout is not None:
            if self.dropout.training and self.dropout.p > 0:
                self._dropout = self._real(self.dropout.scale), draw_dropped(out.numel(), self.dropout.p)
            else:
                self._dropout = self._real(1), NOTHING
        self._forward(members, *self._dropout)
        return out if self.activation.forward is None else self.activation.forward(out)

    def backward(self) -> th.Tensor:
        """
        Turn ``grad`` into the gradient with respect to the product, and leave those of all parameters but the weights in
        ``grads``.
        """
        if self.activation.backward is not None:
            self.activation.backward(self.grad, self.out)
        self._backward(*self._dropout)
        return self.grad


class Output(Layer):
    """
    The last layer, with one unit: matrix-vector products.

    :param linear: The linear layer
    :param batch_size: Rows of its input
    """

    def __init__(self, linear: StackedLinear, batch_size: int) -> None:
        super().__init__(linear)
        self.out = _zeros(linear, batch_size)
        weight, bias, grad_weight, grad_bias = map(array, (*self.parameters, *self.grads))
        self.weights = weight.reshape(self._n_members, -1), bias.reshape(self._n_members)
        self.weight_grads = grad_weight.reshape(self._n_members, -1), grad_bias.reshape(self._n_members)

    def forward(self, x: th.Tensor, members: np.ndarray) -> th.Tensor:
        """Parameters and return value as in :meth:`Hidden.forward`."""
        self.input = array(x.contiguous())
        out = self.out[: len(members)]
        output_forward(self.input, *self.weights, members, array(out)[..., 0])
        return out

    def backward(self, grad: th.Tensor, grad_input: th.Tensor) -> None:
        """
        :param grad: ``(n_members, batch, 1)``
        :param grad_input: Where to write the gradient with respect to the input ``(n_members, batch, in_features)``
        """
        output_backward(array(grad)[..., 0], self.input, self.weights[0], *self.weight_grads, array(grad_input))


class WideOutput(Layer):
    """The last layer, with several units. Parameters and return values as in :class:`Output`."""

    def __init__(self, linear: StackedLinear, batch_size: int) -> None:
        super().__init__(linear)
        self.out = _zeros(linear, batch_size)
        self.bias = linear.bias.detach()
        self.products = Products(self.weight)

    def forward(self, x: th.Tensor, members: np.ndarray) -> th.Tensor:
        self.input = x
        if members is all_members(self._n_members):  # in their order
            return th.baddbmm(self.bias, x, self.weight, out=self.out)
        out = self.out[: len(members)]
        self.products.forward(self.input, members, out)
        return out.add_(self.bias[members])

    def backward(self, grad: th.Tensor, grad_input: th.Tensor) -> None:
        th.sum(grad, dim=1, keepdim=True, out=self.grads[1])
        self.products.backward(self.input, grad, self.grads[0], grad_input)


class FusedNetwork:
    """
    The passes of a :class:`~sb3_symphony.common.ensembles.StackedMLP` for one batch size.

    :param network: Its parameters are used where they are; gradients are kept apart from ``parameter.grad``
    :param batch_size: Rows of the input
    :param bfloat16: Whether to round the operands of large products
    :param lender: Passes of a network of the same shape, for the same batch size, whose memory is used: only the latest of
        both forward passes can be gone back through
    """

    def __init__(
        self, network: StackedMLP, batch_size: int, bfloat16: bool = False, lender: "FusedNetwork | None" = None
    ) -> None:
        self._layers = list(network.layers)
        first = self._layers[0]
        assert isinstance(first, StackedLinear)
        n_members, in_features, _ = first.weight.shape
        self.input = first.weight.new_empty(batch_size, in_features).detach()
        self.hidden: list[Hidden] = []

        modules = list(self._layers)
        while len(modules) > 1:
            linear, following = modules.pop(0), modules.pop(0)
            dropout = norm = None
            if isinstance(following, Dropout):
                dropout, following = following, modules.pop(0)
            if isinstance(following, StackedLayerNorm):
                norm, following = following, modules.pop(0)
            activation = activation_of(following)
            assert isinstance(linear, StackedLinear) and activation is not None
            lending = None if lender is None else lender.hidden[len(self.hidden)]
            self.hidden.append(Hidden(linear, dropout, norm, activation, batch_size, bfloat16, lending))
        (last,) = modules
        assert isinstance(last, StackedLinear)
        self.output = (Output if last.weight.shape[-1] == 1 else WideOutput)(last, batch_size)
        self.grad_input = self.input.new_empty(n_members, batch_size, in_features)

        layers: list[Layer] = [*self.hidden, self.output]
        self.parameters = [parameter for layer in layers for parameter in layer.parameters]
        self.grads = [grad for layer in layers for grad in layer.grads]
        self._addresses = [parameter.data_ptr() for parameter in parameters_of(network)]

    def fits(self, network: StackedMLP, batch_size: int) -> bool:
        """Whether the workspaces have this batch size, the layers are those of the network, the parameters where they were."""
        return (
            self.input.shape[0] == batch_size
            and are_same(self._layers, list(network.layers))
            and [parameter.data_ptr() for parameter in parameters_of(network)] == self._addresses
        )

    def resembles(self, network: StackedMLP) -> bool:
        """Whether a network's layers are of the same kinds and shapes, in the precision of these workspaces."""
        others = parameters_of(network)
        return (
            [type(layer) for layer in self._layers] == [type(layer) for layer in network.layers]
            and [parameter.shape for parameter in self.parameters] == [parameter.shape for parameter in others]
            and {self.input.dtype} == {parameter.dtype for parameter in others}
        )

    def forward(self, features: th.Tensor, actions: th.Tensor, members: list[int] | None = None) -> th.Tensor:
        """
        :param features: ``(batch, features_dim)``
        :param actions: ``(batch, action_dim)``
        :param members: Compute these networks only
        :return: ``(n_members, batch, n_outputs)``, valid until the next call
        """
        chosen = all_members(self.grad_input.shape[0]) if members is None else np.array(members)
        x = th.cat((features, actions), dim=1, out=self.input).expand(len(chosen), -1, -1)
        for layer in self.hidden:
            x = layer.forward(x, chosen)
        return self.output.forward(x, chosen)

    def backward(self, grad: th.Tensor) -> None:
        """
        Write the gradients of all parameters to ``grads``. The call before must have been ``forward`` of all members.

        :param grad: Gradient with respect to the result of ``forward`` ``(n_members, batch, n_outputs)``
        """
        for layer, grad_input in self._backward_layers(grad):
            layer.products.backward(layer.input, layer.grad, layer.grads[0], grad_input)

    def action_gradient(self, grad: th.Tensor, action_dim: int) -> th.Tensor:
        """
        The gradient with respect to the actions. The call before must have been ``forward`` of all members.

        :param grad: As in :meth:`backward`
        :param action_dim: How many of the input's last columns are actions
        :return: ``(batch, action_dim)``
        """
        for layer, grad_input in self._backward_layers(grad):
            if grad_input is None:  # the first layer
                return th.bmm(layer.grad, layer.weight[:, -action_dim:].transpose(1, 2)).sum(dim=0)
            layer.products.backward(layer.input, layer.grad, None, grad_input)
        return self.grad_input[..., -action_dim:].sum(dim=0)

    def _backward_layers(self, grad: th.Tensor) -> Iterator[tuple[Hidden, th.Tensor | None]]:
        """
        Hidden layers from last to first, once what comes after their products has been gone through.

        With each, where the caller is to write the gradient with respect to its input; ``None`` for the first layer.
        """
        below = [None, *(layer.grad for layer in self.hidden)]
        self.output.backward(grad, self.grad_input if below[-1] is None else below[-1])
        for layer, grad_input in zip(reversed(self.hidden), reversed(below[:-1]), strict=True):
            layer.backward()
            yield layer, grad_input
