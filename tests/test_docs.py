"""
The pages that lead by the hand work as they stand.

Of a page, all blocks are run in their order, in an empty folder: ``bash`` line by line, ``python`` as it is. A block that
begins with the name of a file (``# my_robot.py``) is written to that file instead. Blocks named ``sh`` are for longer runs.
"""

import json
import re
import shlex
import sys
from pathlib import Path

import pytest

from sb3_symphony.cli import main

DOCS = Path(__file__).parents[1] / "docs"
BLOCK = re.compile(r"^```(\w*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)


def run_page(name, folder, monkeypatch):
    """Run a page; return what its Python blocks have defined."""
    monkeypatch.chdir(folder)
    monkeypatch.setattr(sys, "path", [*sys.path, ""])
    text = (DOCS / name).read_text(encoding="utf-8")
    namespace = {}
    for language, block in BLOCK.findall(text):
        file = re.match(r"# (\w+\.\w+)\n", block)
        if file and language in ("python", "yaml"):
            Path(file[1]).write_text(block, encoding="utf-8")
        elif language == "python":
            exec(compile(block, name, "exec"), namespace)
        elif language == "bash":
            for line in block.splitlines():
                command, *arguments = shlex.split(line)
                assert command == "sb3-symphony" and main(arguments) == 0, line
    promised = [path for line in text.splitlines() if line.startswith("→") for path in re.findall("`(.*?)`", line)]
    assert all(Path(path).stat().st_size > 0 for path in promised)
    return namespace


@pytest.mark.slow
def test_tour(tmp_path, monkeypatch):
    run_page("tour.md", tmp_path, monkeypatch)
    assert json.loads(Path("walker.json").read_text())["episodes"] == 5


def test_which_algorithm(tmp_path, monkeypatch, capsys):
    run_page("which-algorithm.md", tmp_path, monkeypatch)
    assert "6 queued" in capsys.readouterr().out


@pytest.mark.slow
def test_your_own_robot(tmp_path, monkeypatch):
    total = run_page("your-own-robot.md", tmp_path, monkeypatch)["total"]
    assert json.loads(Path("robot.json").read_text())["mean_length"] > 240  # of 250; an untrained one falls within 40
    assert total > 150  # of 250


@pytest.mark.slow
def test_notebook(tmp_path, monkeypatch):
    nbclient = pytest.importorskip("nbclient")
    nbformat = pytest.importorskip("nbformat")
    pytest.importorskip("ipykernel")
    notebook = nbformat.read(DOCS / "first-steps.ipynb", 4)

    def pictures():
        outputs = [(i, output) for i, cell in enumerate(notebook.cells) for output in cell.get("outputs", [])]
        return [i for i, output in outputs if "image/png" in output.get("data", {})]

    monkeypatch.delenv("MPLBACKEND", raising=False)  # the notebook's own, which shows figures below their cell
    shown = pictures()  # to readers on the web
    nbclient.NotebookClient(notebook, timeout=900, kernel_name="python3", resources={"metadata": {"path": tmp_path}}).execute()
    assert pictures() == shown and len(shown) == 4
    printed = "".join(output.get("text", "") for cell in notebook.cells for output in cell.get("outputs", []))
    (mean,) = re.findall(r"10 episodes without exploration: (-\d+)", printed)
    assert int(mean) > -600  # untrained: about -1300
    assert "2700 steps, 11000 updates, 2700 transitions" in printed


@pytest.mark.parametrize("page", [*sorted(path.name for path in DOCS.glob("*.md")), "../README.md"])
def test_links_lead_somewhere(page):
    text = re.sub(r"```.*?```", "", (DOCS / page).read_text(encoding="utf-8"), flags=re.DOTALL)
    for link in re.findall(r"\]\(([^)\s]+)\)", text):
        if "://" in link:
            continue
        file, _, anchor = link.partition("#")
        target = (DOCS / page).parent / file if file else DOCS / page
        assert target.exists(), link
        if anchor:
            headings = re.findall(r"^#+ (.*)$", target.read_text(encoding="utf-8"), flags=re.MULTILINE)
            slugs = {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}
            assert anchor in slugs, link
