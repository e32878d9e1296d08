"""Arguments that may move with the environment step."""

from typing import Any, TypeGuard, cast

import numpy as np

from sb3_symphony.common.checks import check_number

Moving = float | tuple[float, float, int, int]  # a number, or one that moves: (initial, final, first step, last step)


def moves(value: Moving) -> TypeGuard[tuple[float, float, int, int]]:
    """Whether a value is one that moves."""
    return isinstance(value, (tuple, list))


def at_step(value: Moving, step: int) -> float:
    """
    :param value: a number, or ``(a, b, s, t)``: ``a`` until step ``s``, then linearly to ``b`` at step ``t``, where it stays
    :param step: the environment step
    :return: its value there
    """
    if moves(value):
        initial, final, first, last = value
        return float(np.interp(step, (first, last), (initial, final)))
    return cast(float, value)


def check_moving(name: str, value: Any, low: float, high: float = np.inf) -> None:
    """
    Refuse what :func:`at_step` cannot take, or what leaves ``[low, high]``.

    :param name: The argument's name
    :param value: Its value
    :param low: Smallest value allowed
    :param high: Largest value allowed
    :raises TypeError: if a number is none, or a step is not whole
    :raises ValueError: if a number is out of range, steps do not rise, or there are not four
    """
    if not moves(value):
        check_number(name, value, low, high)
        return
    if len(value) != 4:
        raise ValueError(f"{name}={value!r}: expected a number, or four (initial, final, first step, last step)")
    initial, final, first, last = value
    check_number(name, initial, low, high)
    check_number(name, final, low, high)
    check_number(f"{name}: first step", first, 0, integer=True)
    check_number(f"{name}: last step", last, first + 1, integer=True)
