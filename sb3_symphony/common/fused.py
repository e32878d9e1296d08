"""
Hand-written forward and backward passes of stacked networks on the CPU, in memory that is allocated once.

Autograd allocates every activation anew, keeps a graph and walks it, and sweeps over memory for each small operation; for
networks of this size that costs more than the matrix products. Here torch makes the products, and the compiled loops of
:mod:`~sb3_symphony.common.kernels` do what lies between them.
"""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

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
from sb3_symphony.common.layers import LeakySine, StackedLayerNorm, StackedLinear

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
    known = (StackedLinear, StackedLayerNorm, nn.Dropout)
    return next((type(m).__name__ for m in network.layers if type(m) not in known and activation_of(m) is None), None)


def array(tensor: th.Tensor) -> np.ndarray:
    """The same memory, as the kernels take it."""
    return tensor.detach().numpy()


class Layer:
    """
    A linear layer of all members and what follows it.

    :param linear: The linear layer
    :param batch_size: Rows of its input
    """

    def __init__(self, linear: StackedLinear, batch_size: int) -> None:
        self.weight = linear.weight.detach()
        self.parameters: list[nn.Parameter] = [linear.weight, linear.bias]
        self.grads = [th.zeros_like(parameter).detach() for parameter in self.parameters]
        n_members, _, width = self.weight.shape
        # The result, and the gradient with respect to it: (n_members, batch, width)
        self.out, self.grad = (self.weight.new_zeros(n_members, batch_size, width) for _ in range(2))


class Hidden(Layer):
    """
    ``Linear → Dropout → LayerNorm → activation``; dropout and LayerNorm may be missing.

    The dropout masks are those of ``torch.nn.Dropout`` on the CPU with the same generator state.
    """

    def __init__(
        self,
        linear: StackedLinear,
        dropout: nn.Dropout | None,
        norm: StackedLayerNorm | None,
        activation: Activation,
        batch_size: int,
    ) -> None:
        super().__init__(linear, batch_size)
        self.dropout, self.activation = dropout, activation
        # LayerNorm and sine need what they were computed from in their backward pass; the others work in place
        keeps_product = norm is not None or activation.code == LEAKY_SINE
        self.product = th.zeros_like(self.out) if keeps_product else self.out
        self.mask = th.zeros_like(self.out) if dropout is not None else self.out
        gain = shift = linear.bias  # in place of what the kernel does not use
        if norm is not None:
            gain, shift = norm.weight, norm.bias
            self.parameters += [gain, shift]
            self.grads += [th.zeros_like(gain).detach(), th.zeros_like(shift).detach()]

        product, mask, out, grad = map(array, (self.product, self.mask, self.out, self.grad))
        bias, gains, shifts = map(array, (linear.bias, gain, shift))
        rstd = np.zeros(out.shape[:2], out.dtype)
        derivative = np.zeros_like(out) if activation.code == LEAKY_SINE else out
        eps, slope = out.dtype.type(0 if norm is None else norm.eps), out.dtype.type(activation.slope)
        options = norm is not None, dropout is not None, activation.code
        self._forward = partial(layer_forward(*options), product, bias, mask, gains, shifts, eps, slope, rstd, derivative, out)
        grads = map(array, (self.grads[1], self.grads[-2], self.grads[-1]))
        self._backward = partial(layer_backward(*options), grad, product, out, mask, gains, slope, rstd, derivative, *grads)

    def forward(self, x: th.Tensor, members: np.ndarray) -> th.Tensor:
        """
        :param x: ``(batch, in_features)`` or ``(n, batch, in_features)``
        :param members: Indices ``(n,)`` of the networks to compute
        :return: ``(n, batch, width)``
        """
        n = len(members)
        if n == len(self.out):
            th.bmm(x.expand(n, -1, -1), self.weight, out=self.product)
        else:
            for out, k, each in zip(self.product, members.tolist(), x.expand(n, -1, -1), strict=False):
                th.mm(each, self.weight[k], out=out)
        out = self.out[:n]
        if self.dropout is not None and self.dropout.training:
            keep = 1.0 - self.dropout.p
            self.mask[:n].bernoulli_(keep).div_(keep if keep > 0 else 1.0)
        elif self.dropout is not None:
            self.mask.fill_(1.0)
        self._forward(members)
        return out if self.activation.forward is None else self.activation.forward(out)

    def backward(self) -> th.Tensor:
        """Turn ``grad`` into the gradient with respect to the product; those of all but the weights are left in ``grads``."""
        if self.activation.backward is not None:
            self.activation.backward(self.grad, self.out)
        self._backward()
        return self.grad


class Output(Layer):
    """The last layer, with one unit: matrix-vector products."""

    def __init__(self, linear: StackedLinear, batch_size: int) -> None:
        super().__init__(linear, batch_size)
        weight, bias, grad_weight, grad_bias = map(array, (*self.parameters, *self.grads))
        n_members = len(weight)
        self.weights = weight.reshape(n_members, -1), bias.reshape(n_members)
        self.weight_grads = grad_weight.reshape(n_members, -1), grad_bias.reshape(n_members)

    def forward(self, x: th.Tensor, members: np.ndarray) -> th.Tensor:
        """Parameters and return value as in :meth:`Hidden.forward`."""
        n = len(members)
        self.input = array(x.expand(n, -1, -1).contiguous())
        out = self.out[:n]
        output_forward(self.input, *self.weights, members, array(out)[..., 0])
        return out

    def backward(self, grad: th.Tensor, grad_input: th.Tensor) -> None:
        """
        :param grad: ``(n_members, batch, 1)``
        :param grad_input: Where to write the gradient with respect to the input ``(n_members, batch, in_features)``
        """
        output_backward(array(grad)[..., 0], self.input, self.weights[0], *self.weight_grads, array(grad_input))


class FusedNetwork:
    """
    The passes of a :class:`~sb3_symphony.common.ensembles.StackedMLP` for one batch size.

    :param network: Its parameters are used where they are; gradients are kept apart from ``parameter.grad``
    :param batch_size: Rows of the input
    """

    def __init__(self, network: StackedMLP, batch_size: int) -> None:
        first = network.layers[0]
        assert isinstance(first, StackedLinear)
        n_members, in_features, _ = first.weight.shape
        self.input = first.weight.new_empty(batch_size, in_features).detach()
        self.all_members = np.arange(n_members)
        self.hidden: list[Hidden] = []

        modules = list(network.layers)
        while len(modules) > 1:
            linear, following = modules.pop(0), modules.pop(0)
            dropout = norm = None
            if isinstance(following, nn.Dropout):
                dropout, following = following, modules.pop(0)
            if isinstance(following, StackedLayerNorm):
                norm, following = following, modules.pop(0)
            activation = activation_of(following)
            assert isinstance(linear, StackedLinear) and activation is not None
            self.hidden.append(Hidden(linear, dropout, norm, activation, batch_size))
        (last,) = modules
        assert isinstance(last, StackedLinear)
        self.output = Output(last, batch_size)
        self.grad_input = self.input.new_empty(n_members, batch_size, in_features)

        layers: list[Layer] = [*self.hidden, self.output]
        self.parameters = [parameter for layer in layers for parameter in layer.parameters]
        self.grads = [grad for layer in layers for grad in layer.grads]
        self._addresses = [parameter.data_ptr() for parameter in self.parameters]

    def fits(self, batch_size: int) -> bool:
        """Whether the workspaces have this batch size, and the parameters are still where they were."""
        here = [parameter.data_ptr() for parameter in self.parameters]
        return len(self.input) == batch_size and here == self._addresses

    def forward(self, features: th.Tensor, actions: th.Tensor, members: list[int] | None = None) -> th.Tensor:
        """
        :param features: ``(batch, features_dim)``
        :param actions: ``(batch, action_dim)``
        :param members: Compute these networks only
        :return: ``(n_members, batch, 1)``, valid until the next call
        """
        chosen = self.all_members if members is None else np.array(members)
        x = th.cat((features, actions), dim=1, out=self.input)
        for layer in self.hidden:
            x = layer.forward(x, chosen)
        return self.output.forward(x, chosen)

    def backward(self, grad: th.Tensor) -> None:
        """
        Write the gradients of all parameters to ``grads``. The call before must have been ``forward`` of all members.

        :param grad: Gradient with respect to the result of ``forward`` ``(n_members, batch, 1)``
        """
        self._backward_output(grad)
        for i, layer in reversed(list(enumerate(self.hidden))):
            grad = layer.backward()
            x = self.hidden[i - 1].out if i > 0 else self.input.expand(len(grad), -1, -1)
            th.bmm(x.transpose(1, 2), grad, out=layer.grads[0])
            if i > 0:
                th.bmm(grad, layer.weight.transpose(1, 2), out=self.hidden[i - 1].grad)

    def action_gradient(self, grad: th.Tensor, action_dim: int) -> th.Tensor:
        """
        The gradient with respect to the actions. The call before must have been ``forward`` of all members.

        :param grad: As in :meth:`backward`
        :param action_dim: How many of the input's last columns are actions
        :return: ``(batch, action_dim)``
        """
        self._backward_output(grad)
        for i, layer in reversed(list(enumerate(self.hidden))):
            grad = layer.backward()
            if i > 0:
                th.bmm(grad, layer.weight.transpose(1, 2), out=self.hidden[i - 1].grad)
            else:
                return th.bmm(grad, layer.weight[:, -action_dim:].transpose(1, 2)).sum(dim=0)
        return self.grad_input[..., -action_dim:].sum(dim=0)

    def _backward_output(self, grad: th.Tensor) -> None:
        self.output.backward(grad, self.hidden[-1].grad if self.hidden else self.grad_input)
