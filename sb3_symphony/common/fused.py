"""
Hand-written forward and backward passes of stacked networks on the CPU, in memory that is allocated once.

Autograd allocates every activation anew, keeps a graph and walks it, and sweeps over memory for each small operation; for
networks of this size that costs more than the matrix products. Here :mod:`~sb3_symphony.common.products` makes those, and the
compiled loops of :mod:`~sb3_symphony.common.kernels` do what lies between them.
"""

import operator
from collections.abc import Callable, Sequence
from functools import partial
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
from sb3_symphony.common.products import Operands, all_members, array, products_of

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


NOTHING = np.zeros(0, dtype=np.int64)  # positions of what is dropped where nothing is


class Layer:
    """
    A linear layer of all members and what follows it.

    :param linear: The linear layer
    :param x: Where its input will be ``(n_members, batch, in_features)``
    :param lender: A layer of the same shape, of another network, whose memory is used; what that has computed is lost then.
        Critics and targets take turns, and what both keep for themselves does not fit a second-level cache
    """

    def __init__(self, linear: StackedLinear, x: th.Tensor, lender: "Layer | None" = None) -> None:
        self.weight = linear.weight.detach()
        self._n_members, _, width = self.weight.shape
        # The result (n_members, batch, width)
        self.out: th.Tensor = self.weight.new_zeros(*x.shape[:2], width) if lender is None else lender.out
        self.parameters: list[nn.Parameter] = [linear.weight, linear.bias]
        self.grads = [th.zeros_like(parameter).detach() for parameter in self.parameters]


class Hidden(Layer):
    """
    ``Linear → Dropout → LayerNorm → activation``; dropout and LayerNorm may be missing.

    What is dropped is what the module drops with the same generator state.

    :param grad_x: Where the gradient with respect to the input is to be, if it is wanted
    """

    def __init__(
        self,
        linear: StackedLinear,
        dropout: Dropout | None,
        norm: StackedLayerNorm | None,
        activation: Activation,
        x: th.Tensor,
        grad_x: th.Tensor | None,
        bfloat16: bool,
        lender: "Hidden | None" = None,
    ) -> None:
        super().__init__(linear, x, lender)
        self.dropout, self.activation = dropout, activation
        if lender is None:
            self.grad = th.zeros_like(self.out)  # with respect to the result
            # LayerNorm and sine need what they were computed from in their backward pass; the others work in place
            keeps_product = norm is not None or activation.code == LEAKY_SINE
            self.product = th.zeros_like(self.out) if keeps_product else self.out
            self.rstd = self.out.new_zeros(self.out.shape[:2])
            self.derivative = th.zeros_like(self.out) if activation.code == LEAKY_SINE else self.out
        else:
            self.grad, self.product = lender.grad, lender.product
            self.rstd, self.derivative = lender.rstd, lender.derivative
        self.products = products_of(Operands(self.weight, x, self.product, self.grad, self.grads[0], grad_x), bfloat16)
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

    def forward(self, members: np.ndarray) -> None:
        """
        :param members: Indices ``(n,)`` of the networks to compute; their results are the first ``n``
        """
        self.products.forward(members)
        if self.dropout is not None:
            if self.dropout.training and self.dropout.p > 0:
                n_results = self.out[0].numel() * len(members)
                self._dropout = self._real(self.dropout.scale), draw_dropped(n_results, self.dropout.p)
            else:
                self._dropout = self._real(1), NOTHING
        self._forward(members, *self._dropout)
        if self.activation.forward is not None:
            self.activation.forward(self.out[: len(members)])

    def backward(self, parameters: bool) -> None:
        """
        Turn ``grad`` into the gradient with respect to the product, then leave that with respect to the input where it was
        wanted, and those of the parameters in ``grads``.

        :param parameters: Whether that of the weights, which is dear, is wanted
        """
        if self.activation.backward is not None:
            self.activation.backward(self.grad, self.out)
        self._backward(*self._dropout)
        self.products.backward(parameters)


class Output(Layer):
    """
    The last layer, with one unit: matrix-vector products.

    :param grad_x: Where the gradient with respect to the input is to be
    """

    def __init__(self, linear: StackedLinear, x: th.Tensor, grad_x: th.Tensor) -> None:
        super().__init__(linear, x)
        self._x, self._grad_x, self._out = map(array, (x, grad_x, self.out[..., 0]))
        weight, bias, grad_weight, grad_bias = map(array, (*self.parameters, *self.grads))
        self._weights = weight.reshape(self._n_members, -1), bias.reshape(self._n_members)
        self._weight_grads = grad_weight.reshape(self._n_members, -1), grad_bias.reshape(self._n_members)

    def forward(self, members: np.ndarray) -> th.Tensor:
        """
        :param members: As in :meth:`Hidden.forward`
        :return: ``(n, batch, width)``
        """
        n = len(members)
        output_forward(self._x[:n], *self._weights, members, self._out[:n])
        return self.out[:n]

    def backward(self, grad: th.Tensor, parameters: bool) -> None:
        """
        :param grad: ``(n_members, batch, width)``
        :param parameters: As in :meth:`Hidden.backward`; with one unit they cost nothing, and are written anyway
        """
        output_backward(array(grad)[..., 0], self._x, self._weights[0], *self._weight_grads, self._grad_x)


class WideOutput(Layer):
    """The last layer, with several units. Parameters and return values as in :class:`Output`."""

    def __init__(self, linear: StackedLinear, x: th.Tensor, grad_x: th.Tensor) -> None:
        super().__init__(linear, x)
        self._grad = th.zeros_like(self.out)
        self._bias = linear.bias.detach()
        self._products = products_of(Operands(self.weight, x, self.out, self._grad, self.grads[0], grad_x))

    def forward(self, members: np.ndarray) -> th.Tensor:
        self._products.forward(members)
        return self.out[: len(members)].add_(self._bias[members])

    def backward(self, grad: th.Tensor, parameters: bool) -> None:
        self._grad.copy_(grad)
        th.sum(grad, dim=1, keepdim=True, out=self.grads[1])
        self._products.backward(parameters)


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
        self.grad_input = self.input.new_empty(n_members, batch_size, in_features)  # written if there are no hidden layers
        self.hidden: list[Hidden] = []
        x, grad_x = self.input.expand(n_members, -1, -1), None

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
            self.hidden.append(Hidden(linear, dropout, norm, activation, x, grad_x, bfloat16, lending))
            x, grad_x = self.hidden[-1].out, self.hidden[-1].grad
        (last,) = modules
        assert isinstance(last, StackedLinear)
        output = Output if last.weight.shape[-1] == 1 else WideOutput
        self.output = output(last, x, self.grad_input if grad_x is None else grad_x)

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
        th.cat((features, actions), dim=1, out=self.input)
        for layer in self.hidden:
            layer.forward(chosen)
        return self.output.forward(chosen)

    def backward(self, grad: th.Tensor) -> None:
        """
        Write the gradients of all parameters to ``grads``. The call before must have been ``forward`` of all members.

        :param grad: Gradient with respect to the result of ``forward`` ``(n_members, batch, n_outputs)``
        """
        self._backward(grad, parameters=True)

    def action_gradient(self, grad: th.Tensor, action_dim: int) -> th.Tensor:
        """
        The gradient with respect to the actions. The call before must have been ``forward`` of all members.

        :param grad: As in :meth:`backward`
        :param action_dim: How many of the input's last columns are actions
        :return: ``(batch, action_dim)``
        """
        self._backward(grad, parameters=False)
        if not self.hidden:
            return self.grad_input[..., -action_dim:].sum(dim=0)
        first = self.hidden[0]
        return th.bmm(first.grad, first.weight[:, -action_dim:].transpose(1, 2)).sum(dim=0)

    def _backward(self, grad: th.Tensor, parameters: bool) -> None:
        self.output.backward(grad, parameters)
        for layer in reversed(self.hidden):
            layer.backward(parameters)
