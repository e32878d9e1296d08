"""What came out of a grid: tables, figures, pages, and the raw files that are worth keeping."""

import os
import re
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sb3_symphony.common.files import write_atomically
from sb3_symphony.experiment.cell import read_result
from sb3_symphony.experiment.config import ConfigError, read_yaml
from sb3_symphony.experiment.grid_progress import Progress
from sb3_symphony.experiment.plot import NothingToDraw, PlotOptions, plot
from sb3_symphony.experiment.run_folder import RunFolder
from sb3_symphony.experiment.study import Drawing, Environment, Study, sweep_options

if TYPE_CHECKING:
    from sb3_symphony.analysis.runs import Run, Scalar
    from sb3_symphony.analysis.tables import Result

#: files of a run, and beside the runs, that a report needs or that tell what a search has found
_RAW = ("*/args.yml", "*/config.yml", "*.monitor.csv", "evaluations.npz", "result.json")
_RAW_BESIDE = (
    "settings/*_best_of_*.yml",
    *(f"sweeps/*/tune/*/{name}" for name in ("*.csv", "best.yml", "plan.json", "*.png")),
)


def collect(study: Study, progress: Sequence[Progress], folder: Path, target: Path) -> None:
    """
    Copy what is small and worth keeping. Text loses the names of folders of this machine. Of TensorBoard logs only what the
    study's figures draw is kept, as tables; of figures that are drawn of models, which are not small, the figures.

    :param study: the study
    :param progress: all cells of the study
    :param folder: where their run folders are
    :param target: where the copies go
    :raises ConfigError: if it cannot be written
    """
    from sb3_symphony.analysis.tables import scalar_table

    found = [path for each in progress for pattern in _RAW for path in each.run.path.glob(pattern)]
    of_models = [f"{name}.*" for name, figure in study.figures.items() if figure.gait_at is not None]
    found += [path for pattern in (*_RAW_BESIDE, *of_models) for path in folder.glob(pattern)]
    recorded = [read_yaml(path).get("log_folder", "") for path in found if path.name == "args.yml"]
    # The results may have been moved since. Longest first, as one may be the beginning of another
    folders = sorted({str(folder), *filter(os.path.isabs, recorded)}, key=len, reverse=True)
    named = re.compile(rf"""(?:{"|".join(map(re.escape, folders))})(/|(?=[\s'",]|$))""".encode())
    contents = {path: path.read_bytes() for path in found}
    for path in found:
        if path.suffix in (".yml", ".json"):
            contents[path] = named.sub(lambda found: b"" if found[1] else b".", contents[path])
    for each in progress:
        if scalars := _drawn_scalars(study, each):
            contents[each.run.path / "scalars.csv"] = scalar_table(scalars).encode()
    for path, content in contents.items():
        copy = target / path.relative_to(folder)
        try:
            copy.parent.mkdir(parents=True, exist_ok=True)
            copy.write_bytes(content)
        except OSError as error:
            raise ConfigError(f"--collect: '{copy}' cannot be written — {error.strerror}") from None


def _drawn_scalars(study: Study, progress: Progress) -> dict[str, "Scalar"]:
    """What a run has logged and a figure draws."""
    cell = progress.cell
    figures = [each for each in study.figures.values() if each.kind == "scalars"]
    figures = [each for each in figures if each.shows(cell.algorithm, cell.environment.id)]
    run = _run_of(progress) if figures else None
    logged = {} if run is None else run.scalars
    return {tag: logged[tag] for tag in logged if any(tag in (each.tags or logged) for each in figures)}


def _run_of(progress: Progress) -> "Run | None":
    from sb3_symphony.analysis.runs import open_run

    return open_run(progress.run.path) if (progress.run.details / "args.yml").is_file() else None


_MARKS = ("<!-- results -->", "<!-- /results -->")
_PAGE = re.compile(rf"({_MARKS[0]}(\r?\n)).*({_MARKS[1]})", re.DOTALL)


def on_page(name: str, table: str) -> str:
    """
    A page with the tables between its two marks.

    :param name: file of the page
    :param table: the tables
    :return: its new content
    :raises ConfigError: if it cannot be read or has no such marks
    """
    try:
        page = Path(name).read_bytes().decode()  # with its own ends of lines
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"--page: '{name}' cannot be read — {error}") from None
    if _PAGE.search(page) is None or any(page.count(mark) != 1 for mark in _MARKS):
        raise ConfigError(f"--page: '{name}' — expected one line '{_MARKS[0]}' and, further down, one '{_MARKS[1]}'")
    return _PAGE.sub(lambda found: found[1] + f"\n{table}\n".replace("\n", found[2]) + found[3], page)


def report(study: Study, progress: Sequence[Progress], folder: Path) -> str:
    """
    Write tables and figures of what is there.

    :param study: the study, with a title
    :param progress: all cells of the study
    :param folder: where their run folders are, and where to write
    :return: the Markdown tables
    :raises ConfigError: if a file of a run is damaged, or nothing can be written
    """
    from sb3_symphony.analysis.matrix import matrix_rows, matrix_table, plot_matrix
    from sb3_symphony.analysis.tables import EPISODE_COLUMNS, as_csv, episode_rows, markdown_table, run_row

    try:
        results = [result_of(each) for each in progress]
        by_environment = [
            [each for each in results if each.environment == env]
            for env in dict.fromkeys(each.environment for each in results)
        ]
        rows = [run_row(each) for each in results]
        files = {
            "cells.csv": as_csv(rows[0], rows),
            "episodes.csv": as_csv(EPISODE_COLUMNS, episode_rows(results)),
        }
        tables = [*map(markdown_table, by_environment)]
        if study.matrix is not None:
            names = list(study.matrix.conditions)
            tables += [matrix_table(some, names, study.matrix.label) for some in by_environment]
            entries = matrix_rows(results)
            files["matrix.csv"] = as_csv(entries[0], entries) if entries else ""
        tables += _searches(study, folder)
        table = "\n".join([f"## {study.title}", "", *tables])
        for name, content in {"table.md": table, **files}.items():
            write_atomically(folder / name, content.encode())
        _draw(by_environment, folder)
        if study.matrix is not None:
            plot_matrix(results, list(study.matrix.conditions), study.matrix.label, folder / "matrix.png")
        _draw_figures(study, results, folder)
    except ValueError as error:
        raise ConfigError(str(error)) from None
    except OSError as error:
        raise ConfigError(f"'{error.filename or folder}' cannot be written — {error.strerror}") from None
    return table


def _searches(study: Study, folder: Path) -> list[str]:
    """Tables of the study's searches."""
    if not study.sweeps:
        return []
    from sb3_symphony.experiment.sweep_report import trials_table  # Optuna takes a second

    options = {name: sweep_options(study, name, folder, folder) for name in study.sweeps}
    return [trials_table(name, sweep.folder / "trials.csv", sweep.n_trials) for name, sweep in options.items()]


def result_of(progress: Progress) -> "Result":
    from sb3_symphony.analysis.tables import Result

    cell = progress.cell
    return Result(
        cell.algorithm,
        cell.environment.id,
        cell.seed,
        _thresholds(cell.environment),
        _run_of(progress),
        read_result(progress.run.path) if progress.state == "done" else None,
        progress.reported,
    )


def _thresholds(environment: Environment) -> Any:
    from sb3_symphony.analysis.tables import Thresholds
    from sb3_symphony.experiment.protocol import reward_threshold

    solved = reward_threshold(environment.id) if environment.threshold is None else environment.threshold
    below = environment.unstable_below
    if below is None and solved is not None and solved > 0:
        below = round(solved * 2 / 3, 6)
    return Thresholds(solved, below)


def _draw(by_environment: Sequence[Sequence["Result"]], folder: Path) -> None:
    """Learning curves of the runs that the tables tell of."""
    from sb3_symphony.analysis.tables import by_algorithm, told_of

    told = [each for results in by_environment for row in by_algorithm(results).values() for each in told_of(row)]
    for kind, figure in {"evaluations": PlotOptions(evaluations=True), "training": PlotOptions(episode_window=20)}.items():
        try:
            _draw_curves(figure, told, folder / f"{kind}.png")
        except NothingToDraw:
            (folder / f"{kind}.png").unlink(missing_ok=True)


def _draw_figures(study: Study, results: Sequence["Result"], folder: Path) -> None:
    """The study's own figures, of what there is to draw: a figure whose runs have not recorded it stays as it is."""
    for name, figure in study.figures.items():
        own = [each for each in results if each.run is not None and figure.shows(each.algorithm, each.environment)]
        if not own:
            continue
        try:
            (_draw_curves if figure.gait_at is None else _draw_gaits)(figure, own, folder / f"{name}.png")
        except ConfigError as error:
            print(f"{name}.png is not drawn: {error}", flush=True)


def _draw_curves(figure: PlotOptions, results: Sequence["Result"], output: Path) -> None:
    from sb3_symphony.analysis.runs import Group

    groups: dict[tuple[str, str], Group] = {}
    for each in results:
        assert each.run is not None
        group = groups.setdefault((each.algorithm, each.environment), Group(each.algorithm, each.environment, []))
        group.runs.append(each.run)
    plot(figure.model_copy(update={"output": str(output)}), list(groups.values()))


def _draw_gaits(figure: Drawing, results: Sequence["Result"], output: Path) -> None:
    from sb3_symphony.experiment.gait import gait
    from sb3_symphony.experiment.select import GaitOptions

    assert figure.gait_at is not None
    agents: dict[str, Path] = {}
    for each in results:
        assert each.run is not None
        saved = RunFolder(each.run.path, "").saved_models()
        episodes = each.run.episodes
        if each.algorithm not in agents and saved and episodes is not None and len(episodes.steps) >= figure.gait_at:
            end = int(episodes.steps[figure.gait_at - 1])
            agents[each.algorithm] = saved[min(saved, key=lambda steps: abs(steps - end))]
    if not agents:
        raise ConfigError(f"no run has {figure.gait_at} episodes and the models saved around the last of them")
    models = list(map(str, agents.values()))
    gait(GaitOptions(agents=models, labels=list(agents), output=str(output), json_file=str(output.with_suffix(".json"))))
