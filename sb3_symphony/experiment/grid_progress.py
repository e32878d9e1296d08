"""How far the cells of a grid are, and whether what is there is of the same settings."""

import json
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import yaml

from sb3_symphony.experiment.cell import begun, read_result
from sb3_symphony.experiment.config import ConfigError, RunConfig, parse_yaml, read_yaml
from sb3_symphony.experiment.registry import without_folder
from sb3_symphony.experiment.run_folder import RunFolder, last_parts
from sb3_symphony.experiment.study import Cell, Study, cells_of, configuration, found_by, sweep_options

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


#: options of ``train`` that results depend on
_DECISIVE = ("algo", "env", "seed", "eval_freq", "eval_episodes", "protocol", "threshold")


def standings(study: Study, path: Path, folder: Path) -> list[Progress]:
    """
    All cells of a study.

    :param study: the study
    :param path: its file
    :param folder: where results are kept
    :return: the cells, and how far each is
    :raises ConfigError: if a run or search that is there has other settings
    """
    _check_searches(study, path.absolute().parent, folder)
    progress = [_standing(cell, folder) for cell in cells_of(study, path.absolute().parent, folder)]
    reported = {each.name: each.reported for each in study.algorithms}
    known = {each.cell.name: each for each in progress}
    for each in progress:
        if each.cell.start_from is not None:
            _check_beginning(each, known[each.cell.start_from.name])
        told = reported[each.cell.algorithm]
        each.reported = told if isinstance(told, str) else told.get(each.cell.environment.id, "")
    return progress


def _check_searches(study: Study, beside: Path, folder: Path) -> None:
    """Refuse the best settings of a search that the study describes otherwise now."""
    for name in study.sweeps:
        options = sweep_options(study, name, beside, folder)
        plan = options.folder / "plan.json"  # results of early versions have none
        if found_by(study, name, folder).is_file() and plan.is_file():
            from sb3_symphony.experiment.tune import Plan  # Optuna takes a second

            try:
                searched = json.loads(plan.read_text(encoding="utf-8"))
                if not isinstance(searched, dict):
                    raise ValueError("expected a mapping")
            except (OSError, ValueError) as error:
                raise ConfigError(f"'{plan}' is damaged — {error}") from None
            Plan.read(options).check_same(searched, f"the search '{name}' in '{options.folder}'")


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
    _check_file(cell, folder)
    progress.look()
    result = read_result(run.path)
    _check_conditions(progress, result or {})
    if result is not None and result["n_timesteps"] == progress.total and _is_evaluated(result, cell):
        progress.state, progress.kept, progress.steps = "done", True, progress.total
    return progress


def _is_evaluated(result: dict[str, Any], cell: Cell) -> bool:
    evaluations = [result.get("final", {}), *(result.get("conditions", {}).get(name, {}) for name in cell.conditions)]
    return all(len(each.get("returns", [])) >= cell.final_episodes for each in evaluations)


def _check_conditions(progress: Progress, result: dict[str, Any]) -> None:
    """Refuse numbers of a condition that has another meaning now."""
    for name, condition in progress.cell.conditions.items():
        there = result.get("conditions", {}).get(name, {}).get("condition")  # results of early versions do not tell it
        wanted = json.loads(json.dumps(condition))
        if there not in (None, wanted):
            raise ConfigError(
                f"{progress.cell.name}: was evaluated under condition '{name}' as {there!r}, the study has {wanted!r} — "
                "expected the same, another name of it, or another -f"
            )


def _check_same(progress: Progress) -> None:
    """Refuse to mix runs of one study with those of another, or of the same one before it was changed."""
    from sb3_symphony.experiment.protocol import reward_threshold

    run, cell = progress.run, progress.cell
    stored = {"options": read_yaml(run.details / "args.yml"), "config": read_yaml(run.details / "config.yml")}
    options = {name: getattr(cell.options, name) for name in _DECISIVE}
    if cell.options.protocol is not None:
        del options["eval_freq"], options["eval_episodes"]  # the protocol settles these
        if options["threshold"] is None:
            options["threshold"] = reward_threshold(cell.options.env)
    config = parse_yaml(yaml.safe_dump(progress.config.plain), "study")
    pairs = [(name, stored["options"].get(name), value) for name, value in options.items() if name != "algo"]
    pairs.append(("algo", without_folder(str(stored["options"].get("algo"))), without_folder(cell.options.algo)))
    source = cell.start_from.name if cell.start_from else None
    agent = stored["options"].get("trained_agent")
    pairs.append(("start_from", agent and last_parts(agent), source))
    if source is not None:
        replay = bool(stored["options"].get("with_replay_buffer"))
        pairs.append(("start_from.replay_buffer", replay, cell.options.with_replay_buffer))
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


def _check_file(cell: Cell, folder: Path) -> None:
    """Refuse to go on with another version of the algorithm's own file."""
    file, _, _ = cell.options.algo.rpartition(":")
    kept = folder / "settings" / Path(file).name
    if file and kept.is_file() and kept.read_bytes() != Path(file).read_bytes():
        raise ConfigError(
            f"{cell.name}: was trained with '{kept}', from which '{file}' differs — expected the same, or another -f"
        )


def _check_beginning(progress: Progress, source: Progress) -> None:
    """Refuse more steps for an agent that another run has begun with: other seeds would begin with an older one."""
    result = read_result(source.run.path)
    if result is not None and result["n_timesteps"] != source.total and begun(progress.run):
        raise ConfigError(
            f"{progress.cell.name}: began with {source.cell.name} after {result['n_timesteps']} steps, the study has "
            f"{source.total} of them — expected as many, or another -f"
        )
