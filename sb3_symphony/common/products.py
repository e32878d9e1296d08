"""
The matrix products of stacked linear layers: by torch's BLAS, by compiled tiles, or in bfloat16.

Torch's BLAS on x86 is Intel's, which computes with half the width of vectors that AMD's processors have from Zen 5 on. There
the tiles are twice as fast.
"""

from collections.abc import Callable
from functools import cache, partial
from typing import Any, NamedTuple

import llvmlite.binding as llvm
import numpy as np
import torch as th
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from sb3_symphony.common.kernels import compiled, compiler


def array(tensor: th.Tensor) -> np.ndarray:
    """The same memory, as compiled loops take it."""
    return tensor.detach().numpy()


@cache
def all_members(n: int) -> np.ndarray:
    """Indices ``(n,)`` of all networks in their order: always the same array, so that asking for it costs no comparison."""
    return np.arange(n)


LANES = 16  # numbers of single precision in a register of AVX-512
COLUMNS = 2 * LANES  # of a tile
ROWS = 8  # of a tile: its 16 sums, two vectors of columns and what a row is multiplied with fit the 32 registers
MOST_ALONE = 2**23  # multiplications of a product up to which one thread is enough


def _tile(n_rows: int) -> Callable[..., None]:
    """
    A function, for compiled loops, that computes ``n_rows × COLUMNS`` sums of a product, in registers from first to last::

        for k in range(depth):
            for i in range(n_rows):
                for j in range(COLUMNS):
                    sums[i, j] += a[i, k] * b[k, j]

    It is written in LLVM's language, since a compiler given these loops keeps the sums in memory. Arguments are addresses,
    and strides counted in numbers: of the first factor, and those of its rows and columns; of packed columns
    ``(depth, COLUMNS)`` of the second one; of the result, and that of its rows; and the depth.
    """

    @intrinsic
    def tile(typing_context, a, a_row, a_column, b, out, out_row, depth):
        def generate(context, builder, signature, arguments):
            a, a_row, a_column, b, out, out_row, depth = arguments
            number, index, lane = ir.FloatType(), ir.IntType(64), ir.IntType(32)
            vector = ir.VectorType(number, LANES)
            fma_type = ir.FunctionType(vector, [vector] * 3)
            fma = cgutils.get_or_insert_function(builder.module, fma_type, f"llvm.fma.v{LANES}f32")
            nothing, first_lane = ir.Constant(vector, ir.Undefined), ir.Constant(ir.VectorType(lane, LANES), [0] * LANES)

            def rows(address: Any, stride: Any) -> list[Any]:
                start = builder.inttoptr(address, number.as_pointer())
                return [builder.gep(start, [builder.mul(stride, index(i))]) for i in range(n_rows)]

            def vectors(start: Any) -> list[Any]:
                starts = [builder.gep(start, [index(j)]) for j in range(0, COLUMNS, LANES)]
                return [builder.bitcast(each, vector.as_pointer()) for each in starts]

            a_rows, out_rows = rows(a, a_row), rows(out, out_row)
            packed = builder.inttoptr(b, number.as_pointer())
            before, loop, end = builder.block, builder.append_basic_block(), builder.append_basic_block()
            builder.branch(loop)

            builder.position_at_end(loop)
            k = builder.phi(index)
            sums = [[builder.phi(vector) for _ in range(COLUMNS // LANES)] for _ in range(n_rows)]
            columns = [builder.load(each, align=4) for each in vectors(builder.gep(packed, [builder.mul(k, index(COLUMNS))]))]
            offset = builder.mul(k, a_column)
            for start, row in zip(a_rows, sums, strict=True):
                value = builder.load(builder.gep(start, [offset]), align=4)
                factor = builder.shuffle_vector(builder.insert_element(nothing, value, lane(0)), nothing, first_lane)
                for j, each in enumerate(row):
                    each.add_incoming(ir.Constant(vector, [0.0] * LANES), before)
                    row[j] = builder.call(fma, [factor, columns[j], each])
                    each.add_incoming(row[j], loop)
            following = builder.add(k, index(1))
            k.add_incoming(index(0), before)
            k.add_incoming(following, loop)
            builder.cbranch(builder.icmp_signed("<", following, depth), loop, end)

            builder.position_at_end(end)
            for start, row in zip(out_rows, sums, strict=True):
                for each, place in zip(row, vectors(start), strict=True):
                    builder.store(each, place, align=4)
            return context.get_dummy_value()

        return types.void(*[types.intp] * 7), generate

    return tile


def _strip(n_rows: int) -> Callable[..., int]:
    """A function, for compiled loops, that makes tiles of so many rows as long as there are as many; returns the next row."""
    tile = _tile(n_rows)

    @compiled
    def strip(row, rows, a, a_row, a_column, b, out, out_row, depth):
        while row + n_rows <= rows:
            tile(a + row * a_row * 4, a_row, a_column, b, out + row * out_row * 4, out_row, depth)
            row += n_rows
        return row

    return strip


_eights, _fours, _ones = _strip(ROWS), _strip(ROWS // 2), _strip(1)


@cache
def multiplication() -> Callable[..., None]:
    """:return: ``multiply``, compiled when it is first asked for: numba keeps it on disk"""

    @compiler(signature="void(f4[:, :, :], f4[:, :, :], intp[::1], f4[:, :, ::1], f4[:, ::1], f4[:, ::1])")
    def multiply(a, b, members, out, packed, edge):
        """
        ``out[s] = a[s] @ b[members[s]]``, in single precision.

        :param a: ``(n, rows, depth)``, any strides, depth > 0
        :param b: ``(n_members, depth, width)``, any strides
        :param members: Indices ``(n,)``
        :param out: ``(n, rows, width)``
        :param packed: Memory for some columns of ``b``, at least ``(depth, COLUMNS)``
        :param edge: Memory for the last columns of ``out``, at least ``(rows, COLUMNS)``
        """
        n, rows, depth = a.shape
        width = out.shape[2]
        a_row, a_column = a.strides[1] // 4, a.strides[2] // 4
        for s in range(n):
            from_a, from_b = a[s], b[members[s]]
            for first in range(0, width, COLUMNS):
                count = min(COLUMNS, width - first)
                whole = count == COLUMNS
                for k in range(depth):
                    if whole:
                        for j in range(COLUMNS):
                            packed[k, j] = from_b[k, first + j]
                    else:
                        for j in range(count):
                            packed[k, j] = from_b[k, first + j]
                # Tiles have all their columns: those beyond the last one are computed, but not kept
                target, out_row = (out[s, 0, first:].ctypes.data, width) if whole else (edge.ctypes.data, COLUMNS)
                there = from_a.ctypes.data, a_row, a_column, packed.ctypes.data, target, out_row, depth
                _ones(_fours(_eights(0, rows, *there), rows, *there), rows, *there)
                if not whole:
                    for i in range(rows):
                        for j in range(count):
                            out[s, i, first + j] = edge[i, j]

    return multiply


class Operands(NamedTuple):
    """
    Where the factors and the results of a layer's products are, always.

    :param weight: ``(n_members, in_features, width)``
    :param x: Its input ``(n_members, batch, in_features)``, maybe the same for all members
    :param out: Their product ``(n_members, batch, width)``
    :param grad: Gradient with respect to the product
    :param grad_weight: Gradient with respect to the weights
    :param grad_x: Gradient with respect to the input, if it is wanted
    """

    weight: th.Tensor
    x: th.Tensor
    out: th.Tensor
    grad: th.Tensor
    grad_weight: th.Tensor
    grad_x: th.Tensor | None


class Products:
    """
    The products of a layer, by torch: with its weights, and the two of its backward pass.

    :param operands: Where they read and write
    """

    def __init__(self, operands: Operands) -> None:
        self._operands = operands
        self._weight_transposed, self._x_transposed = operands.weight.transpose(1, 2), operands.x.transpose(1, 2)
        self._all_members = all_members(len(operands.weight))

    def forward(self, members: np.ndarray) -> None:
        """
        Write the product to the first rows of ``out``.

        :param members: Indices ``(n,)`` of the networks to compute, each with one of the first ``n`` inputs
        """
        weight, x, out = self._operands[:3]
        if members is self._all_members:
            th.bmm(x, weight, out=out)
        else:  # one by one, rather than gather the weights first
            for i, k in enumerate(members.tolist()):
                th.mm(x[i], weight[k], out=out[i])

    def backward(self, parameters: bool) -> None:
        """
        Write the gradients.

        :param parameters: Whether that with respect to the weights is wanted
        """
        grad, grad_weight, grad_x = self._operands[3:]
        if parameters:
            th.bmm(self._x_transposed, grad, out=grad_weight)
        if grad_x is not None:
            th.bmm(grad, self._weight_transposed, out=grad_x)


@cache
def scratch(length: int) -> list[np.ndarray]:
    """
    The two kinds of memory of ``multiply``, one for all who need so much: compiled loops hold the interpreter's lock, so they
    are never run side by side.
    """
    return [array(th.empty(length, COLUMNS)) for _ in range(2)]  # aligned, unlike NumPy's


class TiledProducts(Products):
    """
    The same by compiled tiles.

    :param operands: As for :class:`Products`, in single precision
    """

    def __init__(self, operands: Operands) -> None:
        super().__init__(operands)
        self._multiply = multiplication()
        batch_size = operands.x.shape[1]
        memory = scratch(max(batch_size, *operands.weight.shape[1:]))
        weight, x, out, grad, grad_weight = map(array, operands[:5])
        self._x, self._weight, self._out, self._memory = x, weight, out, memory
        self._weight_product = partial(self._multiply, x.transpose(0, 2, 1), grad, self._all_members, grad_weight, *memory)
        self._x_product: partial | None = None
        if operands.grad_x is not None:
            grad_x = array(operands.grad_x)
            self._x_product = partial(self._multiply, grad, weight.transpose(0, 2, 1), self._all_members, grad_x, *memory)
        self._is_large = operands.weight.numel() * batch_size > MOST_ALONE

    def forward(self, members: np.ndarray) -> None:
        if self._is_shared():
            super().forward(members)
        else:
            n = len(members)
            self._multiply(self._x[:n], self._weight, members, self._out[:n], *self._memory)

    def backward(self, parameters: bool) -> None:
        if self._is_shared():
            super().backward(parameters)
            return
        if parameters:
            self._weight_product()
        if self._x_product is not None:
            self._x_product()

    def _is_shared(self) -> bool:
        """Whether the threads of torch's BLAS are to make it: alone, tiles are as fast as two of them."""
        return self._is_large and th.get_num_threads() > 2


class BFloat16Products(Products):
    """
    The same on operands rounded to bfloat16; sums are in single precision, results rounded.

    Twice as fast where the processor has such arithmetic, several times slower where it has not.

    :param operands: As for :class:`Products`
    """

    def __init__(self, operands: Operands) -> None:
        super().__init__(operands)
        rounded = partial(th.zeros_like, dtype=th.bfloat16)
        grad_x = None if operands.grad_x is None else rounded(operands.grad_x)
        self._rounded = Operands._make([*map(rounded, operands[:5]), grad_x])

    def forward(self, members: np.ndarray) -> None:
        n = len(members)
        weight, x, out = (each[:n] for each in self._rounded[:3])
        x.copy_(self._operands.x[:n])
        if members is self._all_members:
            weight.copy_(self._operands.weight)
        else:
            for i, k in enumerate(members.tolist()):
                weight[i].copy_(self._operands.weight[k])
        self._operands.out[:n].copy_(th.bmm(x, weight, out=out))

    def backward(self, parameters: bool) -> None:
        weight, x, _, grad, grad_weight, grad_x = self._rounded  # the first two are still there from the forward pass
        grad.copy_(self._operands.grad)
        to_grad_weight, to_grad_x = self._operands[4:]
        if parameters:
            to_grad_weight.copy_(th.bmm(x.transpose(1, 2), grad, out=grad_weight))
        if to_grad_x is not None:
            to_grad_x.copy_(th.bmm(grad, weight.transpose(1, 2), out=grad_x))


MIN_ROUNDED = 4096  # weights per member: below, the casts cost more than the products gain


@cache
def tiles_are_faster() -> bool:
    """Whether this processor is one of AMD's that have the full width of AVX-512 (Zen 5 and later)."""
    name = llvm.get_host_cpu_name()
    return name.startswith("znver") and name != "znver4" and llvm.get_host_cpu_features().get("avx512f", False)


def products_of(operands: Operands, bfloat16: bool = False) -> Products:
    """
    The fastest products of a layer.

    :param operands: Where they read and write
    :param bfloat16: Whether large ones may be rounded
    """
    if bfloat16 and operands.weight[0].numel() >= MIN_ROUNDED:
        return BFloat16Products(operands)
    if operands.weight.dtype == th.float32 and tiles_are_faster():
        return TiledProducts(operands)
    return Products(operands)
