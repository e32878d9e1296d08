"""Argument checks: one clear line that names the argument, its value and what was expected."""

import difflib
import inspect
import math
import operator
import sys
from collections.abc import Iterable
from typing import Any

import numpy as np


def check_number(
    name: str,
    value: Any,
    low: float = -math.inf,
    high: float = math.inf,
    integer: bool = False,
    exclusive: bool = False,
    below: float = math.inf,
) -> None:
    """
    Refuse anything but a finite number in ``[low, high]``, smaller than ``below``.

    :param name: The argument's name
    :param value: Its value
    :param low: Smallest value allowed
    :param high: Largest value allowed
    :param integer: Whether only whole numbers are allowed
    :param exclusive: Whether ``low`` itself is refused
    :param below: Smallest value that is too large
    :raises TypeError: if ``value`` is no number (of the kind asked for)
    :raises ValueError: if ``value`` is not finite or out of range
    """
    kind = "an integer" if integer else "a number"
    bounds = [f"{'>' if exclusive else '>='} {low:g}"] if low > -math.inf else []
    bounds += [f"<= {high:g}"] if high < math.inf else []
    bounds += [f"< {below:g}"] if below < math.inf else []
    message = f"{name}={value!r}: expected {kind} {' and '.join(bounds)}".rstrip()
    try:
        number: Any = operator.index(value)  # of NumPy's integers too
    except TypeError:
        number = value
    if isinstance(value, bool) or not isinstance(number, int if integer else (int, float, np.floating)):
        raise TypeError(message)
    largest = sys.float_info.max  # whole numbers may be larger
    if not max(low, -largest) <= number <= min(high, largest) or number >= below or (exclusive and number == low):
        raise ValueError(message)


def check_pair(
    name: str,
    value: Any,
    parts: str,
    low: float = -math.inf,
    high: float = math.inf,
    integer: bool = False,
    exclusive: bool = False,
) -> None:
    """
    Refuse anything but two finite numbers in ``[low, high]``.

    :param name: The argument's name
    :param value: Its value
    :param parts: What the two are, for the message
    :param low: Smallest value allowed
    :param high: Largest value allowed
    :param integer: Whether only whole numbers are allowed
    :param exclusive: Whether ``low`` itself is refused
    :raises TypeError: if one of the two is no number (of the kind asked for)
    :raises ValueError: if there are not two, or one is not finite or out of range
    """
    if not isinstance(value, (tuple, list)) or len(value) != 2:
        raise ValueError(f"{name}={value!r}: expected two numbers ({parts})")
    for number in value:
        check_number(name, number, low, high, integer, exclusive)


def check_choice(name: str, value: Any, options: Iterable[Any]) -> None:
    """
    Refuse a value that is not one of the options.

    :param name: The argument's name
    :param value: Its value
    :param options: What is allowed
    :raises ValueError: naming the options and the nearest one
    """
    options = list(options)
    if value not in options:
        raise ValueError(f"{name}={value!r}: expected one of {', '.join(map(repr, options))}{suggestion(value, options)}")


def suggestion(value: Any, options: Iterable[Any]) -> str:
    """
    The end of an error message that suggests the nearest spelling, upper and lower case apart.

    :param value: What was given
    :param options: What is known
    :return: ``": did you mean 'x'?"``, or ``""`` if nothing is near
    """
    by_lower = {str(option).lower(): option for option in options}
    nearest = [] if value is None else difflib.get_close_matches(str(value).lower(), by_lower, n=1)
    return f": did you mean {by_lower[nearest[0]]!r}?" if nearest else ""


def last_line(error: Exception) -> str:
    """
    :param error: what went wrong in somebody else's code
    :return: the last line of its message, where libraries say what it was; its kind if it has none
    """
    return (str(error).strip() or type(error).__name__).splitlines()[-1].strip()


def constructor_parameters(class_: type, eval_str: bool = False) -> dict[str, inspect.Parameter]:
    """
    :param class_: any class
    :param eval_str: whether annotations that are strings are evaluated
    :return: parameters of its constructor by name, ``self`` included; parents' too where it takes ``**kwargs``
    """
    found: dict[str, inspect.Parameter] = {}
    for parent in class_.__mro__:
        if "__init__" not in vars(parent):
            continue
        parameters = inspect.signature(vars(parent)["__init__"], eval_str=eval_str).parameters.values()
        for parameter in parameters:
            if parameter.kind not in (parameter.VAR_KEYWORD, parameter.VAR_POSITIONAL):
                found.setdefault(parameter.name, parameter)
        if all(parameter.kind != parameter.VAR_KEYWORD for parameter in parameters):
            break
    return found
