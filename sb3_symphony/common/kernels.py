"""
The elementwise halves of a stacked network's passes, each one compiled loop over the rows of a matrix product.

A layer is a product followed by bias, dropout, LayerNorm and activation. In torch the latter are a dozen sweeps over the
whole result; here a row is swept while it is in the first-level cache. numba compiles a kernel when it is first called
(a second or two, kept on disk), for the options given and the precision of its arguments.

Shapes: activations ``(n, batch, width)``, parameters ``(n_members, 1, width)``; ``members (n,)`` are the indices of the
``n`` networks that are computed.
"""

import math
from collections.abc import Callable
from functools import cache

import numpy as np
from numba import njit

# Sums may be reordered, as in torch; NaN and infinity stay what they are, or a diverged run would look healthy
_FAST = frozenset({"reassoc", "contract", "arcp", "nsz"})


def compiler(fastmath: frozenset[str] = _FAST, signature: str | None = None) -> Callable[[Callable], Callable]:
    """
    A decorator of functions that are to be compiled.

    :param fastmath: What may be changed in the arithmetic, by LLVM's names
    :param signature: For which types, at once; ``None``: for those it is called with, when it is called first
    """

    def compiled(function: Callable) -> Callable:
        try:
            return njit(signature, fastmath=set(fastmath), error_model="numpy", cache=True)(function)
        except RuntimeError:  # numba finds no folder it may write to: each process compiles for itself
            return njit(signature, fastmath=set(fastmath), error_model="numpy")(function)

    return compiled


compiled = compiler()
_compiled_in_order = compiler(frozenset({"contract"}))

IDENTITY, LEAKY_RELU, LEAKY_SINE = range(3)

# Taylor series of sin(r) / r and cos(r) in r², to double precision for |r| <= pi / 2
_SIN = tuple((-1) ** k / math.factorial(2 * k + 1) for k in range(11))
_COS = tuple((-1) ** k / math.factorial(2 * k) for k in range(12))
_PI_HIGH = 3.140625  # few bits, so its products with small integers are exact
_PI_LOW = math.pi - _PI_HIGH


@_compiled_in_order  # that of the reduction matters
def _sin_cos(x, real):
    """Sine and cosine of one value; unlike ``math.sin`` it vectorises. Precise for values of a few thousands at most."""
    turns = np.rint(x * real(1 / math.pi))
    r = (x - turns * real(_PI_HIGH)) - turns * real(_PI_LOW)
    sign = real(1) - real(2) * (turns - real(2) * np.floor(turns * real(0.5)))
    square = r * r
    sine, cosine = real(_SIN[10]), real(_COS[11])
    for k in range(9, -1, -1):
        sine = sine * square + real(_SIN[k])
    for k in range(10, -1, -1):
        cosine = cosine * square + real(_COS[k])
    return sign * sine * r, sign * cosine


@compiled
def positions_from_gaps(gaps, last, stop):
    """Turn gaps, in place, into the positions that follow ``last``; returns the latest, and how many are below ``stop``."""
    count = 0
    for k in range(gaps.size):
        last += gaps[k]
        gaps[k] = last
        if last >= stop:
            break
        count += 1
    return last, count


@compiled
def _mark(factors, value, start, dropped, k):
    """Set the factors of what is dropped of a row that begins at position ``start``, from ``dropped[k]`` on; returns ``k``."""
    while k < dropped.size and dropped[k] < start + factors.size:
        factors[dropped[k] - start] = value
        k += 1
    return k


@cache
def layer_forward(layer_norm: bool, dropout: bool, activation: int) -> Callable:
    """
    The forward pass of ``bias → dropout → LayerNorm → activation`` over the result of a product.

    It leaves in ``product`` what LayerNorm normalised (without it, the activation's argument) and in ``out`` the result.
    They are the same memory, and only ``product`` is used, if there is neither LayerNorm nor a sine.

    :param layer_norm: Whether there is LayerNorm, with ``gain`` and ``shift``; it leaves its factors in ``rstd (n, batch)``
    :param dropout: Whether there is dropout, with the positions that are ``dropped``, rising, among the ``n`` results one
        after another; the others are multiplied with ``kept``
    :param activation: One of the constants above; ``slope`` is that of negative values, 0 for a plain ReLU. That of the
        sine is left in ``derivative``
    :return: A kernel; it does not touch the arrays of what is switched off
    """
    in_place = not layer_norm and activation != LEAKY_SINE

    @compiled
    def forward(product, bias, gain, shift, eps, slope, rstd, derivative, out, members, kept, dropped):
        real = product.dtype.type
        batch, width = product.shape[1:]
        zero, scale = real(0), real(1 / width)
        factors, row_start, beyond = np.full(width, kept), 0, 0
        for s in range(len(members)):
            b, g, c = bias[members[s], 0], gain[members[s], 0], shift[members[s], 0]
            for i in range(batch):
                x = product[s, i]
                y = x if in_place else out[s, i]
                mean, variance = zero, zero
                if dropout:
                    first, beyond = beyond, _mark(factors, zero, row_start, dropped, beyond)
                for j in range(width):
                    x[j] = (x[j] + b[j]) * factors[j] if dropout else x[j] + b[j]
                    mean += x[j]
                if dropout:
                    _mark(factors, kept, row_start, dropped, first)
                    row_start += width
                if layer_norm:
                    mean *= scale
                    for j in range(width):
                        variance += (x[j] - mean) * (x[j] - mean)
                    r = real(1) / math.sqrt(variance * scale + eps)
                    rstd[s, i] = r
                    for j in range(width):
                        x[j] = (x[j] - mean) * r
                if activation == LEAKY_SINE:
                    d = derivative[s, i]
                    for j in range(width):
                        sine, cosine = _sin_cos(x[j] * g[j] + c[j] if layer_norm else x[j], real)
                        factor = slope if sine < zero else real(1)
                        y[j] = sine * factor
                        d[j] = cosine * factor
                else:
                    for j in range(width):
                        z = x[j] * g[j] + c[j] if layer_norm else x[j]
                        if activation == LEAKY_RELU:
                            z = z * slope if z < zero else z
                        y[j] = z

    return forward


@cache
def layer_backward(layer_norm: bool, dropout: bool, activation: int) -> Callable:
    """
    The backward pass of the same: turns ``grad``, the gradient with respect to the result, into that with respect to the
    product, in place, and leaves the parameters' in ``grad_bias``, ``grad_gain`` and ``grad_shift``.

    Parameters and return value as in :func:`layer_forward`; ``normal`` is what that left in ``product``.
    """
    in_place = not layer_norm and activation != LEAKY_SINE

    @compiled
    def backward(grad, normal, out, gain, slope, rstd, derivative, grad_bias, grad_gain, grad_shift, kept, dropped):
        real = grad.dtype.type
        n, batch, width = grad.shape
        zero, scale = real(0), real(1 / width)
        factors, row_start, beyond = np.full(width, kept), 0, 0
        for k in range(n):
            grad_b, grad_g, grad_c, g = grad_bias[k, 0], grad_gain[k, 0], grad_shift[k, 0], gain[k, 0]
            grad_b[:] = zero
            if layer_norm:
                grad_g[:] = zero
                grad_c[:] = zero
            for i in range(batch):
                d = grad[k, i]
                x = normal[k, i]
                y = x if in_place else out[k, i]
                if activation == LEAKY_SINE:
                    slopes = derivative[k, i]
                    for j in range(width):
                        d[j] *= slopes[j]
                elif activation == LEAKY_RELU:
                    for j in range(width):
                        d[j] = d[j] if y[j] > zero else d[j] * slope
                if layer_norm:
                    mean, along = zero, zero
                    for j in range(width):
                        grad_g[j] += d[j] * x[j]
                        grad_c[j] += d[j]
                        d[j] *= g[j]
                        mean += d[j]
                        along += d[j] * x[j]
                    mean *= scale
                    along *= scale
                    r = rstd[k, i]
                    for j in range(width):
                        d[j] = r * (d[j] - mean - x[j] * along)
                if dropout:
                    first, beyond = beyond, _mark(factors, zero, row_start, dropped, beyond)
                    for j in range(width):
                        d[j] *= factors[j]
                    _mark(factors, kept, row_start, dropped, first)
                    row_start += width
                for j in range(width):
                    grad_b[j] += d[j]

    return backward


@compiled
def output_forward(x, weight, bias, members, out):
    """
    ``out[s, i] = x[s, i] · weight[members[s]] + bias[members[s]]``: products of width 1, for which BLAS is not made.

    Shapes without the last axis: ``weight (n_members, width)``, ``bias (n_members,)``, ``out (n, batch)``.
    """
    batch, width = x.shape[1:]
    for s in range(len(members)):
        w = weight[members[s]]
        for i in range(batch):
            row = x[s, i]
            total = bias[members[s]]
            for j in range(width):
                total += row[j] * w[j]
            out[s, i] = total


@compiled
def output_backward(grad, x, weight, grad_weight, grad_bias, grad_x):
    """The gradients of :func:`output_forward` with respect to its weights, biases and input."""
    n, batch, width = x.shape
    for k in range(n):
        w, grad_w = weight[k], grad_weight[k]
        grad_w[:] = 0
        total = grad.dtype.type(0)
        for i in range(batch):
            g = grad[k, i]
            row, grad_row = x[k, i], grad_x[k, i]
            total += g
            for j in range(width):
                grad_w[j] += g * row[j]
                grad_row[j] = g * w[j]
        grad_bias[k] = total


@compiled
def adam_polyak(parameter, grad, exp_avg, exp_avg_sq, step, target, lr, beta1, beta2, eps, weight_decay, decoupled, tau):
    """One Adam (``decoupled``: AdamW) step of ``parameter``, then a Polyak step of ``target``; arrays flat, in one sweep."""
    real = parameter.dtype.type
    step[0] += 1
    rate = real(lr / (1 - beta1 ** step[0]))
    scale = real(1 / math.sqrt(1 - beta2 ** step[0]))
    b1, b2, c2, tau_, eps_ = real(1 - beta1), real(beta2), real(1 - beta2), real(tau), real(eps)
    decay, shrink = real(0 if decoupled else weight_decay), real(1 - lr * weight_decay if decoupled else 1)
    for j in range(parameter.size):
        p = parameter[j]
        g = grad[j] + decay * p
        m = exp_avg[j] + b1 * (g - exp_avg[j])
        v = b2 * exp_avg_sq[j] + c2 * g * g
        p = shrink * p - rate * m / (math.sqrt(v) * scale + eps_)
        exp_avg[j], exp_avg_sq[j], parameter[j] = m, v, p
        target[j] += tau_ * (p - target[j])
