"""The cells of a grid while they run: a live table in a terminal, elsewhere lines that a log file can take."""

import sys
import time
from collections import Counter
from collections.abc import Sequence
from datetime import timedelta
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.live import Live
from rich.table import Table

from sb3_symphony.experiment.output import columns

if TYPE_CHECKING:
    from sb3_symphony.experiment.grid_progress import Progress


_COLUMNS = ("cell", "state", "step", "return", "time left")
_STYLES = {"running": "bold", "failed": "red", "queued": "dim", "stopped": "yellow", "done": "green"}
_STOPPING = "saving and stopping (Ctrl-C again: at once)"
#: without a terminal, how far a cell is is told after this share of its steps and so many seconds at least, and after so many
#: at most: a tenth may take hours
_SHARE, _SECONDS, _MOST_SECONDS = 0.1, 60.0, 600.0


def _time(seconds: float | None) -> str:
    return "" if seconds is None else str(timedelta(seconds=round(seconds)))


def _cells(each: "Progress") -> list[str]:
    state = each.state + " before" * each.kept
    steps = f"{each.steps} / {each.total}"
    left = each.seconds_left if each.state == "running" else None
    return [each.cell.name, state, steps, "" if each.latest is None else f"{each.latest:.1f}", each.reason or _time(left)]


def _counts(progress: "Sequence[Progress]") -> str:
    counts = Counter(each.state for each in progress)
    return ", ".join(
        f"{counts[state]} {state}" for state in ("running", "queued", "done", "stopped", "failed") if counts[state]
    )


def plain_table(progress: "Sequence[Progress]") -> str:
    """
    :param progress: all cells
    :return: state and steps of each, as text
    """
    rows = [(*_COLUMNS[:4], ""), *([*_cells(each)[:4], each.reason] for each in progress)]
    return "\n".join([*columns(rows, left=len(rows[0])), _counts(progress)])


class View:
    """
    Shows cells while they run.

    :param progress: all cells, changed from outside
    """

    def __init__(self, progress: "Sequence[Progress]") -> None:
        self.progress = progress
        self.console = Console(file=sys.stdout)
        self.live = Live(console=self.console, auto_refresh=False) if self.console.is_terminal else None
        # What was told of each cell, and when
        self.told = {each.cell.name: (each.state, each.steps, 0.0) for each in progress}
        self.stopping = False

    def __enter__(self) -> "View":
        if self.live is not None:
            self.live.start()
        return self

    def __exit__(self, *error: object) -> None:
        if self.live is not None:
            self.live.stop()

    def update(self, stopping: bool) -> None:
        """
        :param stopping: whether the cells are about to save and stop
        """
        if self.live is not None:
            self.live.update(self._table(stopping), refresh=True)
            return
        if stopping and not self.stopping:
            self.stopping = True
            print(_STOPPING, flush=True)
        now = time.monotonic()
        for each in self.progress:
            state, steps, moment = self.told[each.cell.name]
            wait = _SECONDS if each.steps >= steps + _SHARE * each.total else _MOST_SECONDS
            if each.state != state or (each.steps > steps and now >= moment + wait):
                self.told[each.cell.name] = (each.state, each.steps, now)
                print(self._line(each), flush=True)

    def _line(self, each: "Progress") -> str:
        name, state, steps, latest, note = _cells(each)
        parts = [f"{state} {name}", f"step {steps}", *([f"return {latest}"] if latest else [])]
        parts += [note if each.state == "failed" else f"{note} left"] if note else []
        return " | ".join([*parts, _counts(self.progress) + self._left()])

    def _table(self, stopping: bool) -> Table:
        """Those that run first; as many of the others as there is room for."""
        order = ("running", "failed", "stopped", "queued", "done")
        shown = sorted(self.progress, key=lambda each: order.index(each.state))
        room = max(self.console.height - 7, 5)
        caption = _counts(self.progress) + self._left()
        caption += f" — {_STOPPING}" if stopping else ""
        table = Table(caption=caption, caption_justify="left")
        for name, justify in zip(_COLUMNS, ("left", "left", "right", "right", "left"), strict=True):
            options: Any = {"justify": justify, "no_wrap": name != "time left", "overflow": "ellipsis"}
            table.add_column(name, **options)
        for each in shown[:room]:
            table.add_row(*_cells(each), style=_STYLES[each.state])
        if len(shown) > room:
            table.add_row(f"… {len(shown) - room} more", style="dim")
        return table

    def _left(self) -> str:
        """Time that all cells together still need, by the speed of those that run."""
        running = [each for each in self.progress if each.state == "running" and each.seconds_left is not None]
        if not running:
            return ""
        speed = sum((each.total - each.steps) / max(each.seconds_left or 0, 1e-9) for each in running)  # steps / s
        steps = sum(each.total - each.steps for each in self.progress if each.state in ("running", "queued"))
        return f"; about {_time(steps / speed)} left" if speed > 0 else ""
