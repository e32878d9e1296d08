"""The cells of a grid as they are shown while they run, in a terminal and elsewhere."""

import io
import threading

import pytest
import yaml
from rich.console import Console

from sb3_symphony.experiment import grid_view
from sb3_symphony.experiment.cell import Outcome
from sb3_symphony.experiment.grid import _Session
from sb3_symphony.experiment.grid_progress import Progress
from sb3_symphony.experiment.grid_view import View, plain_table
from sb3_symphony.experiment.run_folder import RunFolder
from sb3_symphony.experiment.study import cells_of, configuration, read_study


@pytest.fixture
def cells(tmp_path):
    """Three cells of 1000 steps, the first done before, the second at 100 steps."""
    study = tmp_path / "study.yml"
    study.write_text(yaml.safe_dump({"algorithms": ["sac"], "environments": ["Pendulum-v1"], "seeds": 3, "steps": 1000}))
    cells = cells_of(read_study(study), tmp_path)
    progress = [Progress(cell, configuration(cell), RunFolder(tmp_path / cell.name, "Pendulum-v1")) for cell in cells]
    progress[0].state, progress[0].kept, progress[0].steps = "done", True, 1000
    progress[1].steps, progress[1].latest = 100, -1234.56
    return progress


def test_what_ends_while_the_view_is_drawn_is_taken_up(cells, tmp_path, monkeypatch):
    """The worker's last word may come between a look at the cells and the end of its thread."""
    drawing, said = threading.Event(), threading.Event()
    worker = []

    class SlowView(View):
        def update(self, stopping):
            drawing.set()
            assert said.wait(60)
            worker[0].join()

    class Backend:
        def map(self, function, jobs):
            worker.append(threading.current_thread())
            assert drawing.wait(60)
            yield jobs[0], Outcome("done")
            said.set()

    monkeypatch.setattr(grid_view, "View", SlowView)
    assert not _Session(cells, cells[1:2], tmp_path, tmp_path, Backend(), tensorboard=False).run()
    assert cells[1].state == "done"


@pytest.fixture
def clock(monkeypatch):
    """``clock(seconds)``: that much later."""
    now = [1000.0]
    monkeypatch.setattr(grid_view.time, "monotonic", lambda: now[0])
    return lambda seconds: now.__setitem__(0, now[0] + seconds)


def run(progress, clock):
    progress.state, progress.since = "running", (grid_view.time.monotonic(), progress.steps)


def test_lines_where_there_is_no_terminal(cells, clock, capsys):
    view = View(cells)

    def told(stopping=False):
        view.update(stopping)
        return capsys.readouterr().out.splitlines()

    with view:
        assert told() == []
        run(cells[1], clock)
        begins = "running sac/Pendulum-v1_1 | step 100 / 1000 | return -1234.6 | 1 running, 1 queued, 1 done"
        assert told() == [begins] and told() == []

        clock(59)
        cells[1].steps = 400
        assert told() == []  # a third further, but too soon
        clock(1)
        assert told() == [
            "running sac/Pendulum-v1_1 | step 400 / 1000 | return -1234.6 | 0:02:00 left | "
            "1 running, 1 queued, 1 done; about 0:05:20 left"  # 300 steps took 60 s, 600 + 1000 are left
        ]
        clock(599)
        cells[1].steps = 499
        assert told() == []  # less than a tenth further
        clock(1)
        assert told() == [
            "running sac/Pendulum-v1_1 | step 499 / 1000 | return -1234.6 | 0:13:49 left | "
            "1 running, 1 queued, 1 done; about 0:41:23 left"
        ]
        clock(1000)
        assert told() == []  # no further
        assert told(stopping=True) == ["saving and stopping (Ctrl-C again: at once)"] and told(stopping=True) == []

        cells[1].state, cells[1].reason = "failed", "RuntimeError: the motor is hot"
        cells[2].state = "stopped"
        assert told(stopping=True) == [
            "failed sac/Pendulum-v1_1 | step 499 / 1000 | return -1234.6 | RuntimeError: the motor is hot | "
            "1 done, 1 stopped, 1 failed",
            "stopped sac/Pendulum-v1_2 | step 0 / 1000 | 1 done, 1 stopped, 1 failed",
        ]


def test_table_in_a_terminal(cells, clock, monkeypatch):
    console = Console(file=io.StringIO(), force_terminal=True, width=120, height=30)
    monkeypatch.setattr(grid_view, "Console", lambda file: console)
    run(cells[1], clock)
    with View(cells) as view:
        clock(60)
        cells[1].steps = 400
        view.update(stopping=True)
    shown = console.file.getvalue()
    rows = [line for line in shown.splitlines() if "sac/" in line]
    assert [row.split("sac/Pendulum-v1_")[1][0] for row in rows[:3]] == ["1", "2", "0"]  # what runs comes first
    for part in ("400 / 1000", "-1234.6", "0:02:00", "done before", "about 0:05:20 left — saving and stopping"):
        assert part in shown


def test_a_terminal_that_is_too_small_for_all(cells, monkeypatch):
    console = Console(file=io.StringIO(), force_terminal=True, width=120, height=10)
    monkeypatch.setattr(grid_view, "Console", lambda file: console)
    with View(cells * 3) as view:
        view.update(stopping=False)
    assert "… 4 more" in console.file.getvalue()


def test_plain_table(cells):
    assert plain_table(cells).splitlines() == [
        "cell               state        step         return",
        "sac/Pendulum-v1_0  done before  1000 / 1000",
        "sac/Pendulum-v1_1  queued       100 / 1000   -1234.6",
        "sac/Pendulum-v1_2  queued       0 / 1000",
        "2 queued, 1 done",
    ]
