"""
``sb3-symphony bench``: all cells of a study, on one machine or many, and what came out.

Results lie in one folder, which holds all that is needed to go on or to make the tables anew::

    <folder>/study.yml                       the study
    <folder>/settings/<algorithm>_<env>.yml  merged hyper-parameters of each variant, and files of its own algorithms
    <folder>/sweeps/<algo>/tune/<name>/      what a search has found
    <folder>/<algorithm>/<env>_<seed>/       run folder of a cell, with result.json once it is done
    <folder>/<algorithm>/<env>_<seed>.log    what its process printed
    <folder>/cells.csv, episodes.csv, matrix.csv, table.md, evaluations.png, training.png, matrix.png, …
"""

import os
import re
import shutil
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from queue import SimpleQueue
from typing import TYPE_CHECKING, Any, Literal

import yaml
from pydantic import BaseModel, ConfigDict, Field

from sb3_symphony.common.files import write_atomically
from sb3_symphony.experiment.cell import Control, Job, Outcome, begun, read_result, supervise
from sb3_symphony.experiment.config import ConfigError, RunConfig, TrainOptions, parse_yaml, read_yaml
from sb3_symphony.experiment.registry import is_file, without_folder
from sb3_symphony.experiment.run_folder import RunFolder
from sb3_symphony.experiment.signals import handled_by
from sb3_symphony.experiment.study import (
    Cell,
    Drawing,
    Environment,
    Study,
    cells_of,
    configuration,
    found_by,
    read_study,
    sweep_options,
)

if TYPE_CHECKING:  # the command line imports this module before it knows what is to be done
    from sb3_symphony.analysis.tables import Result
    from sb3_symphony.experiment.backends import Backend

#: seconds between two signs of life for the cells
_BEAT = 10.0


class BenchOptions(BaseModel):
    """Options of ``sb3-symphony bench``; their meaning is in its ``--help``."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    study: str
    quick: bool = False
    folder: str | None = None
    backend: Literal["loky", "ray"] = "loky"
    n_jobs: int | None = Field(default=None, ge=1)
    address: str | None = None
    algo: list[str] = []
    report: bool = False
    page: str | None = None
    collect: str | None = None
    dry_run: bool = False


State = Literal["queued", "running", "done", "failed", "stopped"]


@dataclass
class Progress:
    """
    How far a cell is.

    :param cell: the cell
    :param config: its merged configuration
    :param run: its run folder
    :param state: of its present execution
    :param kept: whether it was done before
    :param reason: why it failed
    :param steps: environment steps at the end of its latest training episode
    :param latest: mean return of the latest ten training episodes, None before the first
    :param since: moment and steps when it was first seen running
    :param reported: what others have reported of it
    """

    cell: Cell
    config: RunConfig
    run: RunFolder
    state: State = "queued"
    kept: bool = False
    reason: str = ""
    steps: int = 0
    latest: float | None = None
    since: tuple[float, int] | None = None
    reported: str = ""

    @property
    def total(self) -> int:
        """Environment steps that it is to take."""
        return self.config.settings.n_timesteps

    @property
    def seconds_left(self) -> float | None:
        """Until it is done, as far as that can be told yet."""
        if self.since is None or self.steps <= self.since[1]:
            return None
        return (time.monotonic() - self.since[0]) / (self.steps - self.since[1]) * (self.total - self.steps)

    def look(self) -> None:
        """Read how far the run is, from its files: they are on a file system that all machines share."""
        from sb3_symphony.analysis.runs import read_episodes

        try:
            episodes = read_episodes(self.run.path)
        except ValueError:  # just being written
            return
        if episodes is not None and len(episodes.steps):
            self.steps = min(int(episodes.steps[-1]), self.total)
            self.latest = float(episodes.returns[-10:].mean())


@dataclass(frozen=True)
class BenchResult:
    """
    What became of a grid.

    :param folder: where its results are
    :param table: the Markdown tables; with ``dry_run``, what its cells are and how far
    :param failed: cells that failed, and why
    :param interrupted: whether it was stopped by a signal
    :param untouched: whether nothing was to be run or written
    """

    folder: Path
    table: str
    failed: list[tuple[str, str]] = field(default_factory=list)
    interrupted: bool = False
    untouched: bool = False

    def summary(self) -> str:
        """:return: table, and failures, for the end of the command"""
        if self.untouched:
            return self.table
        lines = [self.table]
        lines += [f"failed: {name}: {reason} (see {self.folder / name}.log)" for name, reason in self.failed]
        if self.interrupted:
            lines.append(f"interrupted, saved in {self.folder} — the same command goes on")
        else:
            lines.append(f"results in {self.folder}")
        return "\n".join(lines)


def bench(options: BenchOptions) -> BenchResult:
    """
    Run the cells of a study that are not done yet, then write tables and figures of all that are.

    :param options: options of the command line
    :return: what became of it
    :raises ConfigError: if the study is wrong, its folder holds other results, or the cluster cannot be used; nothing is
        changed then
    """
    if options.address is not None and options.backend != "ray":
        raise ConfigError(f"--address: '{options.address}' — is for --backend ray")
    if options.page is not None:
        _on_page(options.page, "")
    path = Path(options.study)
    for flag in ("page", "collect"):
        if getattr(options, flag) is not None and not options.report:
            raise ConfigError(f"--{flag}: '{getattr(options, flag)}' — belongs to --report")
    study = read_study(path, options.quick, options.algo)
    name = path.absolute().parent.name if path.stem == "study" else path.stem
    study = study.model_copy(update={"title": study.title or name})
    folder = Path(options.folder or f"logs/bench/{name}{'_quick' if options.quick else ''}").absolute()
    progress = _standings(study, path, folder)
    if options.dry_run:
        from sb3_symphony.experiment.grid_view import plain_table

        _check_models([each for each in progress if not each.kept])
        return BenchResult(folder, plain_table(progress), untouched=True)
    if options.report:
        from sb3_symphony.experiment.output import output_folder, write_output

        if not any(each.run.path.is_dir() for each in progress):
            raise ConfigError(f"--report: no results in '{folder}' — expected those of an earlier run, or -f")
        table = report(study, progress, folder)
        if options.page is not None:
            write_output(Path(options.page), _on_page(options.page, table).encode(), "--page")
        if options.collect is not None:
            _collect(progress, folder, output_folder(Path(options.collect).absolute(), "--collect"))
        return BenchResult(folder, table)
    return _run(options, study, progress, folder, path)


# ----------------------------------------------------------------------------------------------------------------------
# Before
# ----------------------------------------------------------------------------------------------------------------------

#: options of ``train`` that results depend on
_DECISIVE = ("algo", "env", "seed", "eval_freq", "eval_episodes", "protocol", "threshold", "device")


def _standings(study: Study, path: Path, folder: Path) -> list[Progress]:
    progress = [_standing(cell, folder) for cell in cells_of(study, path.absolute().parent, folder)]
    reported = {each.name: each.reported for each in study.algorithms}
    for each in progress:
        each.reported = reported[each.cell.algorithm]
    return progress


def _standing(cell: Cell, folder: Path) -> Progress:
    """How far a cell is; what is there has to be of the same settings."""
    config = configuration(cell)
    run = RunFolder(folder / cell.name, RunFolder.file_name(cell.environment.id))
    progress = Progress(cell, config, run)
    if cell.waits:
        progress.reason = f"waits for the search '{cell.sweep}'"
        return progress
    if not begun(run):
        return progress
    _check_same(progress)
    progress.look()
    result = read_result(run.path)
    if result is not None and result["n_timesteps"] == progress.total and _is_evaluated(result, cell):
        progress.state, progress.kept, progress.steps = "done", True, progress.total
    return progress


def _is_evaluated(result: dict[str, Any], cell: Cell) -> bool:
    evaluations = [result.get("final", {}), *(result.get("conditions", {}).get(name, {}) for name in cell.conditions)]
    return all(len(each.get("returns", [])) >= cell.final_episodes for each in evaluations)


def _check_same(progress: Progress) -> None:
    """Refuse to mix runs of one study with those of another, or of the same one before it was changed."""
    run, cell = progress.run, progress.cell
    stored = {"options": read_yaml(run.details / "args.yml"), "config": read_yaml(run.details / "config.yml")}
    options = {name: getattr(cell.options, name) for name in _DECISIVE}
    if cell.options.protocol is not None:  # settles these; the threshold too, if none is given
        for name in ("eval_freq", "eval_episodes", *(["threshold"] if cell.options.threshold is None else [])):
            del options[name]
    config = parse_yaml(yaml.safe_dump(progress.config.plain), "study")
    pairs = [(name, stored["options"].get(name), value) for name, value in options.items() if name != "algo"]
    pairs.append(("algo", without_folder(str(stored["options"].get("algo"))), without_folder(cell.options.algo)))
    source = cell.start_from.name if cell.start_from else None
    pairs.append(("start_from", _place(stored["options"].get("trained_agent")), source))
    pairs += [(name, stored["config"].get(name), config.get(name)) for name in dict.fromkeys([*stored["config"], *config])]
    for name, there, wanted in pairs:
        if name == "n_timesteps":
            if there is not None and there > wanted:
                raise ConfigError(
                    f"{cell.name}: has {there} steps, the study {wanted} — expected as many or more, or another -f"
                )
        elif there != wanted:
            raise ConfigError(
                f"{cell.name}: was trained with {name} {there!r}, the study has {wanted!r} — expected the same, or another -f"
            )


def _place(run: str | None) -> str | None:
    """A run folder, without the folder of all results, which may have moved."""
    return run and "/".join(Path(run).parts[-2:])


def _check_models(progress: Sequence[Progress]) -> None:
    """Build each model once: whatever is wrong with algorithms, environments or settings shows before anything runs."""
    from sb3_symphony.experiment.protocol import keep_protocol
    from sb3_symphony.experiment.train import build_model

    for each in {(p.cell.algorithm, p.cell.environment.id): p for p in progress if not p.kept}.values():
        cell = each.cell
        try:
            model = build_model(cell.options, each.config, seed=0, verbose=0)
            env = model.get_env()
            assert env is not None
            env.close()
            keep_protocol(cell.options, each.config)
        except ConfigError as error:
            raise ConfigError(f"{cell.algorithm} on {cell.environment.id}: {error}") from None


def _write_settings(progress: Sequence[Progress], folder: Path, study: Path) -> None:
    """What the cells read. They may run on machines that have neither the study nor its files."""
    settings = folder / "settings"
    settings.mkdir(parents=True, exist_ok=True)
    write_atomically(folder / "study.yml", study.read_bytes())
    for each in progress:
        if each.cell.waits:
            continue
        content = yaml.safe_dump(each.config.plain, sort_keys=False)
        path = _settings_file(each, folder)
        if not path.is_file() or path.read_text(encoding="utf-8") != content:
            write_atomically(path, content.encode())
        file, _, _ = each.cell.options.algo.rpartition(":")
        if file:
            shutil.copy(file, settings)


def _settings_file(progress: Progress, folder: Path) -> Path:
    return folder / "settings" / f"{progress.cell.algorithm}_{progress.run.env_name}.yml"


def _job(progress: Progress, folder: Path, session: Path, tensorboard: bool) -> Job:
    """All settings come from one file, whose content was merged and checked here."""
    cell = progress.cell
    merged: dict[str, Any] = {"conf_file": str(_settings_file(progress, folder)), "hyperparams": {}, "env_kwargs": {}}
    if is_file(cell.options.algo):
        merged["algo"] = str(folder / "settings" / without_folder(cell.options.algo))
    if cell.start_from is not None:
        merged["trained_agent"] = str(folder / cell.start_from.name)
    if tensorboard:
        merged["tensorboard_log"] = str(progress.run.path / "tensorboard")
    given = cell.options.model_dump(include=cell.options.model_fields_set)
    options = TrainOptions(**{**given, **merged, "n_timesteps": progress.total, "log_folder": str(folder)})
    return Job(
        name=cell.name,
        options=options.model_dump(include=options.model_fields_set),
        run=str(progress.run.path),
        final_episodes=cell.final_episodes,
        conditions=cell.conditions,
        session=str(session),
    )


# ----------------------------------------------------------------------------------------------------------------------
# Meanwhile
# ----------------------------------------------------------------------------------------------------------------------


@contextmanager
def _alone(folder: Path) -> Iterator[None]:
    from filelock import FileLock, Timeout

    try:
        with FileLock(folder / ".lock", timeout=0):
            yield
    except Timeout:
        raise ConfigError(f"-f: '{folder}' is being worked on by another process") from None


def _run(options: BenchOptions, study: Study, progress: list[Progress], folder: Path, path: Path) -> BenchResult:
    from sb3_symphony.experiment.backends import open_backend
    from sb3_symphony.experiment.output import full_disk_told, output_folder

    left = [each for each in progress if not each.kept]
    interrupted = False
    if left:
        print(f"{len(left)} of {len(progress)} cells to do, into {folder}", flush=True)
        _check_models(left)
        gpus = any(each.cell.options.device.startswith("cuda") for each in left)
        backend = open_backend(options.backend, options.n_jobs, options.address, gpus)
        try:
            new = not folder.exists()
            with _alone(output_folder(folder, "-f")), full_disk_told(folder, "the same command goes on"):
                session = _new_session(backend, folder, new)
                _write_settings(progress, folder, path)
                interrupted = _run_ready(study, progress, folder, session, backend)
                waiting = {each.cell.name for each in progress if each.cell.waits}
                if waiting and not interrupted:
                    interrupted = _search(study, progress, options, path, folder)
                    now = {each.cell.name: each for each in _standings(study, path, folder)}
                    progress = [now[each.cell.name] if each.cell.name in waiting else each for each in progress]
                    _write_settings(progress, folder, path)
                    interrupted = interrupted or _run_ready(study, progress, folder, session, backend)
                shutil.rmtree(session)
        finally:
            backend.close()
    for each in progress:
        if each.state == "queued" and not interrupted:
            each.state, each.reason = "failed", each.reason or "the run that it starts from is not done"
    failed = [(each.cell.name, each.reason) for each in progress if each.state == "failed"]
    return BenchResult(folder, report(study, progress, folder), failed, interrupted)


def _run_ready(study: Study, progress: list[Progress], folder: Path, session: Path, backend: "Backend") -> bool:
    """
    Run cells as long as there are some whose beginning is there.

    :return: whether that was stopped by a signal
    """
    while ready := _ready(progress):
        if _Session(progress, ready, folder, session, backend, study.tensorboard).run():
            return True
    return False


def _ready(progress: Sequence[Progress]) -> list[Progress]:
    """Cells to do of which all is there that they begin with."""
    done = {each.cell.name for each in progress if each.state == "done"}
    queued = [each for each in progress if each.state == "queued" and not each.cell.waits]
    return [each for each in queued if each.cell.start_from is None or each.cell.start_from.name in done]


def _search(study: Study, progress: Sequence[Progress], options: BenchOptions, path: Path, folder: Path) -> bool:
    """
    Search for the settings that cells wait for.

    :return: whether that was stopped by a signal
    """
    from sb3_symphony.experiment.tune import tune

    cores = options.n_jobs or os.cpu_count() or 1
    wanted = {each.cell.sweep for each in progress if each.cell.waits}
    for name in (name for name in study.sweeps if name in wanted):
        sweep = sweep_options(study, name, path.absolute().parent, folder)
        n_jobs = max(1, cores // sweep.seeds_per_trial)
        result = tune(sweep.model_copy(update={"n_jobs": n_jobs}))
        print(result.summary, flush=True)
        if result.interrupted:
            return True
        best = result.folder / "best.yml"
        if best.is_file():
            write_atomically(found_by(study, name, folder), best.read_bytes())
    return False


def _new_session(backend: "Backend", folder: Path, new: bool) -> Path:
    """Folder of this execution, which all machines see."""
    session = folder / ".session"
    shutil.rmtree(session, ignore_errors=True)
    session.mkdir()
    try:
        backend.check_folder(session)
    except ConfigError:
        shutil.rmtree(folder if new else session)
        raise
    return session


class _Session:
    """
    One execution of a grid: workers in a thread, while the main one looks after display, signals and signs of life.

    :param progress: all cells
    :param ready: those to run
    :param folder: where results are kept
    :param session: folder of this execution
    :param backend: where to run them
    :param tensorboard: whether they write TensorBoard logs
    """

    def __init__(
        self,
        progress: list[Progress],
        ready: list[Progress],
        folder: Path,
        session: Path,
        backend: "Backend",
        tensorboard: bool,
    ) -> None:
        self.progress = progress
        self.left = {each.cell.name: each for each in ready}
        self.jobs = [_job(each, folder, session, tensorboard) for each in ready]
        self.control = Control(session / "control.json")
        self.backend = backend
        self.stop = 0  # how often that was asked for
        self.ended: SimpleQueue[tuple[Job, Outcome | Exception]] = SimpleQueue()
        self.error: Exception | None = None

    def run(self) -> bool:
        """
        :return: whether it was stopped by a signal
        """
        from sb3_symphony.experiment.grid_view import View

        self.control.say(0)
        with handled_by(self._on_signal), View(self.progress) as view:
            thread = threading.Thread(target=self._work, daemon=True)
            thread.start()
            said, beat = 0, time.monotonic()
            while thread.is_alive():
                thread.join(timeout=1.0)
                with suppress(OSError):  # a full disk: said again. Cells that hear nothing for long save and stop
                    if self.stop != said or time.monotonic() - beat >= _BEAT:
                        self.control.say(self.stop)
                        said, beat = self.stop, time.monotonic()
                self._look()
                view.update(stopping=self.stop > 0)
        if self.error is not None:
            raise self.error
        return self.stop > 0

    def _on_signal(self, signum: int, frame: Any) -> None:
        """Ctrl-C stops all cells, wherever they run; each saves what it has. A second one does not wait for that."""
        self.stop += 1

    def _work(self) -> None:
        try:
            for ended in self.backend.map(supervise, self.jobs):
                self.ended.put(ended)
        except Exception as error:  # raised again by the main thread
            self.error = error

    def _look(self) -> None:
        """Take up what is new of each cell."""
        for job in self.jobs:
            each = self.left[job.name]
            if each.state == "queued" and job.started.is_file():
                each.state = "running"
            if each.state == "running":
                each.look()
                if each.since is None:
                    each.since = (time.monotonic(), each.steps)
        while not self.ended.empty():
            job, outcome = self.ended.get()
            if isinstance(outcome, Exception):
                told = str(outcome).strip().splitlines() or [type(outcome).__name__]
                outcome = Outcome("failed", f"its worker died — {told[-1]}")
            elif outcome.state == "stopped" and not self.stop:
                outcome = Outcome("failed", "was stopped by a signal from elsewhere")
            each = self.left[job.name]
            each.state, each.reason = outcome.state, outcome.reason
            each.look()
            if each.state == "done":
                each.steps = each.total


# ----------------------------------------------------------------------------------------------------------------------
# Afterwards
# ----------------------------------------------------------------------------------------------------------------------


#: files of a run, and beside the runs, that a report needs or that tell what a search has found
_RAW = ("*/args.yml", "*/config.yml", "*.monitor.csv", "evaluations.npz", "result.json")
_RAW_BESIDE = ("settings/*_best_of_*.yml", "sweeps/*/tune/*/*.csv", "sweeps/*/tune/*/best.yml", "sweeps/*/tune/*/*.png")


def _collect(progress: Sequence[Progress], folder: Path, target: Path) -> None:
    """Copy what is small and worth keeping. Text loses the names of folders of this machine."""
    if target == folder:
        raise ConfigError(f"--collect: '{target}' — expected another folder than that of the results")
    found = [path for each in progress for pattern in _RAW for path in each.run.path.glob(pattern)]
    found += [path for pattern in _RAW_BESIDE for path in folder.glob(pattern)]
    for path in found:
        content = path.read_bytes()
        if path.suffix == ".yml":
            content = content.replace(f"{folder}/".encode(), b"").replace(str(folder).encode(), b".")
        copy = target / path.relative_to(folder)
        try:
            copy.parent.mkdir(parents=True, exist_ok=True)
            copy.write_bytes(content)
        except OSError as error:
            raise ConfigError(f"--collect: '{copy}' cannot be written — {error.strerror}") from None


_PAGE = re.compile(r"(?<=<!-- results -->\n).*?(?=<!-- /results -->)", re.DOTALL)


def _on_page(name: str, table: str) -> str:
    """A page with the tables between its two marks."""
    try:
        page = Path(name).read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"--page: '{name}' cannot be read — {error}") from None
    if len(_PAGE.findall(page)) != 1:
        raise ConfigError(f"--page: '{name}' — expected one line '<!-- results -->' and, further down, '<!-- /results -->'")
    return _PAGE.sub(lambda _: f"\n{table}\n", page)


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
        results = [_result(each) for each in progress]
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


def _result(progress: Progress) -> "Result":
    from sb3_symphony.analysis.runs import open_run
    from sb3_symphony.analysis.tables import Result

    run, cell = progress.run, progress.cell
    return Result(
        cell.algorithm,
        cell.environment.id,
        cell.seed,
        _thresholds(cell.environment),
        open_run(run.path) if (run.details / "args.yml").is_file() else None,
        read_result(run.path) if progress.state == "done" else None,
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
    """Learning curves of the runs that are done."""
    from sb3_symphony.analysis.plots import episode_curve, evaluation_curve, plot_curves, summarised
    from sb3_symphony.analysis.runs import NotRecorded, Run

    def line(kind: str, run: Run) -> Any:
        return evaluation_curve(run, "steps", "reward") if kind == "evaluations" else episode_curve(run, "steps", "reward", 20)

    notes = {"evaluations": "mean of each evaluation's episodes", "training": "running mean of 20 training episodes"}
    for kind, smoothed in notes.items():
        panels: dict[str, list[Any]] = {}
        for results in by_environment:
            lines: dict[str, list[Any]] = {}
            for each in results:
                if each.run is None or each.summary is None:
                    continue
                try:
                    x, y = line(kind, each.run)
                except NotRecorded:
                    continue
                if len(x):
                    lines.setdefault(each.algorithm, []).append((x, y))
            if lines:
                panels[results[0].environment] = [summarised(name, seeds) for name, seeds in lines.items()]
        output = folder / f"{kind}.png"
        if panels:
            plot_curves(panels, "steps", "reward", smoothed, output)
        else:
            output.unlink(missing_ok=True)


def _draw_figures(study: Study, results: Sequence["Result"], folder: Path) -> None:
    """The study's own figures, of what there is to draw: a figure whose runs have not recorded it stays as it is."""
    for name, figure in study.figures.items():
        own = [
            each
            for each in results
            if each.run is not None
            and each.algorithm in (figure.algorithms or [each.algorithm])
            and each.environment in (figure.environments or [each.environment])
        ]
        try:
            (_draw_curves if figure.gait_at is None else _draw_gaits)(figure, own, folder / f"{name}.png")
        except ConfigError as error:
            print(f"{name}.png is not drawn: {error}", flush=True)


def _draw_curves(figure: Drawing, results: Sequence["Result"], output: Path) -> None:
    from sb3_symphony.analysis.runs import Group
    from sb3_symphony.experiment.plot import plot

    groups: dict[tuple[str, str], Group] = {}
    for each in results:
        assert each.run is not None
        group = groups.setdefault((each.algorithm, each.environment), Group(each.algorithm, each.environment, []))
        group.runs.append(each.run)
    plot(figure.model_copy(update={"output": str(output)}), list(groups.values()))


def _draw_gaits(figure: Drawing, results: Sequence["Result"], output: Path) -> None:
    from sb3_symphony.experiment.gait import gait
    from sb3_symphony.experiment.select import GaitOptions, checkpoints

    assert figure.gait_at is not None
    agents: dict[str, Path] = {}
    for each in results:
        assert each.run is not None
        saved = checkpoints(RunFolder(each.run.path, ""))
        episodes = each.run.episodes
        if each.algorithm not in agents and saved and episodes is not None and len(episodes.steps) >= figure.gait_at:
            end = int(episodes.steps[figure.gait_at - 1])
            agents[each.algorithm] = saved[min(saved, key=lambda steps: abs(steps - end))]
    if not agents:
        raise ConfigError(f"no run has {figure.gait_at} episodes and the models saved around the last of them")
    models = list(map(str, agents.values()))
    gait(GaitOptions(agents=models, labels=list(agents), output=str(output), json_file=str(output.with_suffix(".json"))))
