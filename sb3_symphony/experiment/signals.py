"""Ctrl-C and requests to terminate, answered without leaving anything half done."""

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any


@contextmanager
def handled_by(handler: Callable[[int, Any], None]) -> Iterator[None]:
    """
    Handle SIGINT and SIGTERM inside the block, where Python allows it (the main thread).

    :param handler: called with the signal's number and the current frame
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.signal(number, handler) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, previous in before.items():
            signal.signal(number, previous)
