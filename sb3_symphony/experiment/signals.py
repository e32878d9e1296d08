"""Ctrl-C, requests to terminate and closed terminals, answered without leaving anything half done, or running."""

import multiprocessing
import os
import signal
import stat
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any

Handler = Callable[[int, Any], None]


@contextmanager
def handled_by(handler: Handler) -> Iterator[None]:
    """
    Handle SIGINT, SIGTERM and SIGHUP inside the block, where Python allows it (the main thread). SIGHUP tells that the
    terminal is closed; ``nohup`` has it ignored, and it stays so.

    :param handler: called with the signal's number and the current frame
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    handlers: dict[int, Handler] = {signal.SIGINT: handler, signal.SIGTERM: handler}
    if hasattr(signal, "SIGHUP") and signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:  # Windows has none
        handlers[signal.SIGHUP] = _without_terminal(handler)
    before = {number: signal.signal(number, own) for number, own in handlers.items()}
    try:
        yield
    finally:
        for number, previous in before.items():
            signal.signal(number, previous)


def end_with_parent() -> None:
    """End this process when the one that started it has ended in any way."""
    parent = multiprocessing.parent_process()

    def wait() -> None:
        if parent is not None:
            parent.join()
            os._exit(1)

    threading.Thread(target=wait, daemon=True).start()


def ended_by(code: int) -> str:
    """
    :param code: exit code of a process, negative if a signal has ended it
    :return: what it ended by, in words
    """
    if code >= 0:
        return f"its process ended with code {code}"
    name = signal.Signals(-code).name if -code in set(signal.Signals) else f"signal {-code}"  # real-time ones have no name
    return f"its process was ended by {name}" + " (out of memory?)" * (name == "SIGKILL")


def _without_terminal(handler: Handler) -> Handler:
    """The same once nothing goes to the terminal any more: to write there would be an error."""

    def hung_up(signum: int, frame: Any) -> None:
        nowhere = os.open(os.devnull, os.O_WRONLY)
        for output in (1, 2):
            with suppress(OSError):  # closed
                if stat.S_ISCHR(os.fstat(output).st_mode):
                    os.dup2(nowhere, output)
        os.close(nowhere)
        handler(signum, frame)

    return hung_up
