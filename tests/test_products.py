"""Products of stacked layers: all ways of making them give what a loop over members in double precision gives."""

import numpy as np
import pytest
import torch as th

from sb3_symphony.common import products
from sb3_symphony.common.products import BFloat16Products, Operands, Products, TiledProducts, all_members, products_of
from sb3_symphony.common.regression import has_bfloat16

KINDS = {Products: 1e-5, TiledProducts: 1e-5, BFloat16Products: 2e-2}  # tolerances


def operands_of(n_members=3, batch=5, in_features=4, width=6, shared=False, grad_x=True, dtype=th.float32):
    """With random factors; where results are to be stands a number that none of them is."""
    generator = th.Generator().manual_seed(0)

    def random(*shape):
        return th.randn(*shape, generator=generator, dtype=dtype)

    x = random(batch, in_features).expand(n_members, -1, -1) if shared else random(n_members, batch, in_features)
    weight, grad = random(n_members, in_features, width), random(n_members, batch, width)
    out, grad_weight, grad_input = (th.full(each.shape, 1e9, dtype=dtype) for each in (grad, weight, x))
    return Operands(weight, x, out, grad, grad_weight, grad_input if grad_x else None)


def assert_product(result, a, b, kind):
    """To a precision that is relative to what is summed up, as that of floating-point sums is."""
    a, b = a.double(), b.double()
    assert ((result.double() - a @ b).abs() <= KINDS[kind] * (a.abs() @ b.abs())).all()


@pytest.fixture(params=KINDS, ids=lambda kind: kind.__name__)
def kind(request):
    if request.param is BFloat16Products and not has_bfloat16():
        pytest.skip("no arithmetic for it: slow, and rounded otherwise")
    return request.param


# Tiles have 8, 4 or 1 rows and 32 columns: fewer, as many, a few more
@pytest.mark.parametrize("batch", [1, 7, 8, 15, 33])
@pytest.mark.parametrize("in_features, width", [(1, 1), (28, 32), (5, 31), (33, 65), (64, 96)])
@pytest.mark.parametrize("shared", [False, True])
def test_every_size(kind, batch, in_features, width, shared):
    operands = operands_of(2, batch, in_features, width, shared)
    weight, x, _, grad, *_ = operands
    made = kind(operands)
    made.forward(all_members(2))
    made.backward(parameters=True)
    for k in range(2):
        assert_product(operands.out[k], x[k], weight[k], kind)
        assert_product(operands.grad_weight[k], x[k].T, grad[k], kind)
        assert_product(operands.grad_x[k], grad[k], weight[k].T, kind)


@pytest.mark.parametrize("members", [[2], [3, 1], [1, 0, 3, 2]])
def test_some_members_in_any_order(kind, members):
    operands = operands_of(4, 9, 10, 40)
    made = kind(operands)
    made.forward(np.array(members))
    for i, k in enumerate(members):
        assert_product(operands.out[i], operands.x[i], operands.weight[k], kind)
    assert (operands.out[len(members) :] == 1e9).all()


def test_only_what_is_wanted(kind):
    operands = operands_of()
    made = kind(operands)
    made.forward(all_members(3))
    made.backward(parameters=False)
    assert (operands.grad_weight == 1e9).all() and not (operands.grad_x == 1e9).any()
    operands = operands_of(grad_x=False)
    made = kind(operands)
    made.forward(all_members(3))
    made.backward(parameters=True)
    assert not (operands.grad_weight == 1e9).any()


def test_factors_are_read_anew(kind):
    """Weights change with every update, in place."""
    operands = operands_of()
    made = kind(operands)
    made.forward(all_members(3))
    for factor in operands.weight, operands.x, operands.grad:
        factor.mul_(2)
    made.forward(all_members(3))
    made.backward(parameters=True)
    for k in range(3):
        assert_product(operands.out[k], operands.x[k], operands.weight[k], kind)
        assert_product(operands.grad_x[k], operands.grad[k], operands.weight[k].T, kind)


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_a_diverged_network_does_not_look_healthy(kind, value):
    operands = operands_of(width=33)
    operands.weight[1, 0, 32] = value
    kind(operands).forward(all_members(3))
    assert not operands.out[1, :, 32].isfinite().any()
    assert operands.out[[0, 2]].isfinite().all() and operands.out[1, :, :32].isfinite().all()


@pytest.mark.parametrize(
    "dtype, bfloat16, tiles, expected",
    [
        (th.float32, False, True, TiledProducts),
        (th.float32, False, False, Products),
        (th.float64, False, True, Products),
        (th.float32, True, True, TiledProducts),  # too small to round
    ],
)
def test_which_products(monkeypatch, dtype, bfloat16, tiles, expected):
    monkeypatch.setattr(products, "tiles_are_faster", lambda: tiles)
    assert type(products_of(operands_of(dtype=dtype), bfloat16)) is expected


@pytest.mark.parametrize("threads, tiled", [(1, True), (2, True), (3, False)])
def test_large_products_are_shared_by_threads(monkeypatch, threads, tiled):
    monkeypatch.setattr(products, "MOST_ALONE", 100)
    monkeypatch.setattr(th, "get_num_threads", lambda: threads)
    by_torch = []
    for name in ("forward", "backward"):
        monkeypatch.setattr(Products, name, lambda *_args, _name=name: by_torch.append(_name))
    made = TiledProducts(operands_of())
    made.forward(all_members(3))
    made.backward(parameters=True)
    assert by_torch == ([] if tiled else ["forward", "backward"])
