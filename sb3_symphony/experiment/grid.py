"""
``sb3-symphony bench``: all cells of a study, on one machine or many, and what came out.

Results lie in one folder, which holds all that is needed to go on or to make the tables anew::

    <folder>/study.yml                       the study
    <folder>/settings/<algorithm>@<env>.yml  merged hyper-parameters of each variant, and files of its own algorithms
    <folder>/sweeps/<algo>/tune/<name>/      what a search has found
    <folder>/<algorithm>/<env>_<seed>/       run folder of a cell, with result.json once it is done
    <folder>/<algorithm>/<env>_<seed>.log    what its process printed
    <folder>/cells.csv, episodes.csv, matrix.csv, table.md, evaluations.png, training.png, matrix.png, …
"""

import os
import shutil
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from queue import SimpleQueue
from typing import TYPE_CHECKING, Any, Literal
from uuid import uuid4

import yaml
from pydantic import BaseModel, Field

from sb3_symphony.common.checks import last_line
from sb3_symphony.common.files import write_atomically
from sb3_symphony.experiment.cell import Control, Job, Outcome, supervise
from sb3_symphony.experiment.config import ConfigError, RunConfig, TrainOptions
from sb3_symphony.experiment.grid_progress import Progress, standings
from sb3_symphony.experiment.grid_report import collect, on_page, report
from sb3_symphony.experiment.registry import is_file, without_folder
from sb3_symphony.experiment.signals import handled_by
from sb3_symphony.experiment.space import TuneOptions
from sb3_symphony.experiment.study import Cell, Study, configuration, found_by, read_study, sweep_options

if TYPE_CHECKING:  # the command line imports this module before it knows what is to be done
    from stable_baselines3.common.base_class import BaseAlgorithm

    from sb3_symphony.experiment.backends import Backend

#: seconds between two signs of life for the cells
_BEAT = 10.0


class BenchOptions(BaseModel, extra="forbid", frozen=True):
    """Options of ``sb3-symphony bench``; their meaning is in its ``--help``."""

    study: str
    quick: bool = False
    folder: str | None = None
    backend: Literal["loky", "ray"] = "loky"
    n_jobs: int | None = Field(default=None, ge=1)
    address: str | None = None
    algo: list[str] = []
    report: bool = False
    page: str | None = Field(default=None, min_length=1)
    collect: str | None = Field(default=None, min_length=1)
    dry_run: bool = False


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
        """:return: table, and where all is, for the end of the command"""
        saved = f"interrupted, saved in {self.folder} — the same command goes on"
        end = saved if self.interrupted else f"results in {self.folder}"
        return self.table if self.untouched else f"{self.table}\n{end}"


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
    if options.dry_run and options.report:
        raise ConfigError("--dry-run and --report: expected only one of them")
    path = Path(options.study)
    for flag in ("page", "collect"):
        if getattr(options, flag) is not None and not options.report:
            raise ConfigError(f"--{flag}: '{getattr(options, flag)}' — belongs to --report")
    if options.page is not None:
        on_page(options.page, "")
    study = read_study(path, options.quick, options.algo)
    name = Path(os.path.abspath(path)).parent.name if path.stem == "study" else path.stem
    study = study.model_copy(update={"title": study.title or name})
    folder = Path(options.folder or f"logs/bench/{name}{'_quick' if options.quick else ''}").absolute()
    try:
        if not options.report:
            _check_kept_study(path, folder)
        progress = standings(study, path, folder)
    except OSError as error:  # no permission to look, or a name that is no name
        raise ConfigError(f"-f: '{folder}' cannot be read — {error.strerror}") from None
    if options.dry_run:
        from sb3_symphony.experiment.grid_view import plain_table
        from sb3_symphony.experiment.output import check_folder

        check_folder(folder, "-f")
        _check_models([each for each in progress if not each.kept])
        _check_searches(study, progress, path, folder)
        return BenchResult(folder, plain_table(progress), untouched=True)
    if options.report:
        return _report(options, study, progress, folder)
    return _run(options, study, progress, folder, path)


def _report(options: BenchOptions, study: Study, progress: Sequence[Progress], folder: Path) -> BenchResult:
    """Write tables and figures, once all that is to be written can be."""
    from sb3_symphony.experiment.output import output_file, output_folder, write_output

    if not any(each.run.path.is_dir() for each in progress) and not (folder / "sweeps").is_dir():
        raise ConfigError(f"--report: no results in '{folder}' — expected those of an earlier run, or -f")
    target = None if options.collect is None else Path(options.collect).absolute()
    if target is not None and target.resolve() == folder.resolve():
        raise ConfigError(f"--collect: '{target}' — expected another folder than that of the results")
    if options.page is not None:
        output_file(options.page, "--page")
    if target is not None:
        output_folder(target, "--collect")
    table = report(study, progress, folder)
    if options.page is not None:
        write_output(Path(options.page), on_page(options.page, table).encode(), "--page")
    if target is not None:
        collect(study, progress, folder, target)
    return BenchResult(folder, table)


# ----------------------------------------------------------------------------------------------------------------------
# Before
# ----------------------------------------------------------------------------------------------------------------------


def _check_kept_study(path: Path, folder: Path) -> None:
    """Results have a copy of their study; a ``study.yml`` that is none is left alone."""
    kept = folder / "study.yml"
    holds_results = (folder / "settings").is_dir() and not folder.samefile(path.parent)
    if kept.is_file() and not holds_results and not kept.samefile(path) and kept.read_bytes() != path.read_bytes():
        raise ConfigError(f"-f: '{folder}' has a study.yml of its own, which would be replaced — expected another folder")


def _check_models(progress: Sequence[Progress]) -> None:
    """Build each model once: whatever is wrong with algorithms, environments or settings shows before anything runs."""
    from sb3_symphony.experiment.protocol import keep_protocol
    from sb3_symphony.experiment.train import build_model
    from sb3_symphony.experiment.transfer import check_source

    def model_of(cell: Cell, config: RunConfig) -> "BaseAlgorithm":
        model = build_model(cell.options, config, seed=0, verbose=0)
        env = model.get_env()
        assert env is not None
        env.close()
        return model

    for each in {(p.cell.algorithm, p.cell.environment.id): p for p in progress}.values():
        cell = each.cell
        try:
            model = model_of(cell, each.config)
            if cell.start_from is not None:
                source = model_of(cell.start_from, configuration(cell.start_from))
                check_source(model, source, cell.start_from.name, cell.options.with_replay_buffer)
            keep_protocol(cell.options, each.config)
            for name, condition in cell.conditions.items():
                _check_condition(name, condition, cell, each.config, model)
        except ConfigError as error:
            raise ConfigError(f"{cell.algorithm} on {cell.environment.id}: {error}") from None


def _searches(study: Study, progress: Sequence[Progress], path: Path, folder: Path) -> Iterator[tuple[str, TuneOptions]]:
    """Searches that cells wait for, in the study's order."""
    wanted = {each.cell.sweep for each in progress if each.cell.waits}
    for name in study.sweeps:
        if name in wanted:
            yield name, sweep_options(study, name, path.absolute().parent, folder)


def _check_searches(study: Study, progress: Sequence[Progress], path: Path, folder: Path) -> None:
    """Build a model with each value of the spaces, as :func:`_check_models` does with settings that are known."""
    for name, options in _searches(study, progress, path, folder):
        from sb3_symphony.experiment.tune import Plan  # Optuna takes a second

        try:
            Plan.read(options).check()
        except ConfigError as error:
            raise ConfigError(f"sweeps: {name}: {error}") from None


def _check_condition(name: str, condition: dict[str, Any], cell: Cell, config: RunConfig, model: "BaseAlgorithm") -> None:
    from sb3_symphony.experiment.agent import check_match
    from sb3_symphony.experiment.environment import check_task_wrappers, make_evaluation_env

    settings = config.settings.varied(condition["env_kwargs"], condition["env_wrapper"])
    try:
        check_task_wrappers(condition["env_wrapper"], "env_wrapper")
        env = make_evaluation_env(cell.environment.id, settings)
        env.close()
        check_match(model, env, "the model", cell.environment.id)
    except ConfigError as error:
        raise ConfigError(f"condition '{name}': {error}") from None


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
    # Neither name can hold an @, so that no two cells meet in one file
    return folder / "settings" / f"{progress.cell.algorithm}@{progress.run.env_name}.yml"


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


def _run(options: BenchOptions, study: Study, progress: list[Progress], folder: Path, path: Path) -> BenchResult:
    from sb3_symphony.experiment.backends import Loky, Ray
    from sb3_symphony.experiment.output import alone, full_disk_told, output_folder

    left = [each for each in progress if not each.kept]
    interrupted = False
    in_use = f"-f: '{folder}' is being worked on by another process"
    if left:
        print(f"{len(left)} of {len(progress)} cells to do, into {folder}", flush=True)
        _check_models(left)
        _check_searches(study, left, path, folder)
        gpus = any(each.cell.options.device.startswith("cuda") for each in left)
        use_ray = options.backend == "ray"
        backend: Backend = Ray(options.n_jobs, options.address, gpus) if use_ray else Loky(options.n_jobs)
        try:
            new = not folder.exists()
            with alone(output_folder(folder, "-f"), in_use), full_disk_told([folder], "the same command goes on"):
                session = _new_session(backend, folder, new)
                _write_settings(progress, folder, path)
                interrupted = _run_ready(study, progress, folder, session, backend)
                waiting = {each.cell.name for each in progress if each.cell.waits}
                if waiting and not interrupted:
                    interrupted = _search(study, progress, options, path, folder)
                    now = {each.cell.name: each for each in standings(study, path, folder)}
                    progress = [now[each.cell.name] if each.cell.name in waiting else each for each in progress]
                    _write_settings(progress, folder, path)
                    interrupted = interrupted or _run_ready(study, progress, folder, session, backend)
                shutil.rmtree(session.parent)
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
    import joblib

    from sb3_symphony.experiment.tune import tune

    cores = options.n_jobs or joblib.cpu_count()
    for name, sweep in _searches(study, progress, path, folder):
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
    sessions = folder / ".session"
    shutil.rmtree(sessions, ignore_errors=True)
    session = sessions / uuid4().hex  # cells of one that was killed look for theirs, and end
    session.mkdir(parents=True)
    try:
        backend.check_folder(sessions)
    except ConfigError:
        shutil.rmtree(folder if new else sessions)
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
        self.look_at: dict[str, float] = {}  # when to read next how far a cell is
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
            running = True
            while running:
                thread.join(timeout=1.0)
                running = thread.is_alive()  # asked before the look: what it says last is taken up, too
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
            now = time.monotonic()
            if each.state == "running" and now >= self.look_at.get(job.name, 0.0):
                each.look()
                # Long files take time, which is not taken from the trainings: at most a hundredth of it
                self.look_at[job.name] = now + 100 * (time.monotonic() - now)
                if each.since is None:
                    each.since = (time.monotonic(), each.steps)
        while not self.ended.empty():
            job, outcome = self.ended.get()
            if isinstance(outcome, Exception):
                outcome = Outcome("failed", f"its worker died — {last_line(outcome)}")
            elif outcome.state == "stopped" and not self.stop:
                outcome = Outcome("failed", "was stopped by a signal from elsewhere")
            each = self.left[job.name]
            each.state, each.reason = outcome.state, outcome.reason
            each.look()
            if each.state == "done":
                each.steps = each.total
