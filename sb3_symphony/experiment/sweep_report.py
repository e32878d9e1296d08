"""What a study has found: a table of its trials, the best configuration, and Optuna's figures."""

import csv
import json
import re
import shlex
import warnings
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import optuna
import yaml
from optuna.trial import FrozenTrial, TrialState

from sb3_symphony.analysis.tables import aligned, as_csv
from sb3_symphony.common.files import completed, write_atomically
from sb3_symphony.experiment.config import ConfigError, TrainOptions, merge, told
from sb3_symphony.experiment.output import columns
from sb3_symphony.experiment.space import parse_space, scalar
from sb3_symphony.experiment.sweep_storage import WORKER

#: attribute of a study: what all its trials have in common
PLAN = "plan"
#: attributes of a trial: why it failed, in words; how it ended (see ``TrialFailed``); last mean return of each seed
REASON, ENDED, RETURNS = "reason", "ended", "returns"

_N_BEST = 5  # trials that are shown
_FIGURES = ("optimization_history", "intermediate_values", "param_importances", "slice", "parallel_coordinate", "timeline")

# States of trials in the order they are told, and their words
_STATES = {"complete": "completed", "pruned": "pruned", "fail": "failed", "running": "running", "waiting": "waiting"}
# Columns of ``SweepReport.rows`` that are no hyper-parameters
_ABOUT = re.compile(r"number|state|value|reason|retry_of|evaluations|started|seconds|worker|seed_\d+")


def reason_of(trial: FrozenTrial) -> str:
    """
    :param trial: a trial
    :return: why it failed, ``""`` if it did not
    """
    return trial.user_attrs.get(REASON, "its process died") if trial.state == TrialState.FAIL else ""


def replaced(trials: list[FrozenTrial]) -> set[int]:
    """
    :param trials: all trials of a study
    :return: numbers of those that were enqueued again
    """
    return {number for trial in trials for number in trial.system_attrs.get("retry_history", ())}


def ranked(trials: list[FrozenTrial]) -> list[FrozenTrial]:
    """
    :param trials: trials of a study
    :return: those that completed, the best first, the earliest of equals before the others
    """
    completed = [trial for trial in trials if trial.state == TrialState.COMPLETE]
    return sorted(completed, key=lambda trial: (-trial.values[0], trial.number))


def best_of(trials: list[FrozenTrial]) -> FrozenTrial | None:
    """
    :param trials: trials of a study
    :return: the best one, None if none has completed
    """
    return next(iter(ranked(trials)), None)


def parameters_of(trial: FrozenTrial | optuna.Trial) -> dict[str, str]:
    """
    :param trial: a trial
    :return: its parameters, short enough for the terminal
    """
    return {k: f"{v:.4g}" if isinstance(v, float) else str(v) for k, v in trial.params.items()}


def check_results(folder: Path, name: str, trials: list[FrozenTrial]) -> None:
    """
    See whether the results in a folder are those of a study, as another storage may have one of the same name. Studies are
    told apart by when their first trial began.

    :param folder: where results are written
    :param name: name of the study
    :param trials: all its trials
    :raises ConfigError: if they are those of another study, or cannot be read
    """
    path = folder / "trials.csv"
    try:
        with path.open(encoding="utf-8", newline="") as file:
            rows = list(csv.DictReader(file))
    except FileNotFoundError:
        return
    except (OSError, ValueError, csv.Error) as error:
        raise ConfigError(f"'{path}': no table of trials — {told(error)}") from None
    began = [str(trial.datetime_start or "") for trial in trials[:1]]
    if [row.get("started") for row in rows[:1]] != began:
        raise ConfigError(
            f"--study-name: '{name}' — expected another one, or another --log-folder: '{folder}' holds the results of a study "
            "of this name in another storage"
        )


class SweepReport:
    """
    Results of a study, as they are at the moment of each call.

    :param study: the study
    :param folder: where files are written
    """

    def __init__(self, study: optuna.Study, folder: Path) -> None:
        self.study = study
        self.folder = folder
        self.plan: dict[str, Any] = study.user_attrs[PLAN]
        self.space = parse_space(self.plan["space"], study.study_name)

    def rows(self) -> list[dict[str, Any]]:
        """:return: a row for each trial, the same columns in all"""
        rows = []
        for trial in self.study.get_trials(deepcopy=False):
            retries = trial.system_attrs.get("retry_history", [])
            returns = trial.user_attrs.get(RETURNS, [])
            row = {
                "number": trial.number,
                "state": trial.state.name.lower(),
                "value": trial.value,
                "reason": reason_of(trial),
                "retry_of": retries[-1] if retries else None,
                "evaluations": len(trial.intermediate_values),
                "started": trial.datetime_start,
                "seconds": trial.duration.total_seconds() if trial.duration else None,
                "worker": trial.user_attrs.get(WORKER),
            }
            row |= dict(zip((f"seed_{seed}" for seed in self.plan["seeds"]), returns, strict=False))
            rows.append({**row, **{name: scalar(value) for name, value in self.space.values(trial.params).items()}})
        names = list(dict.fromkeys(name for row in rows for name in row))
        return [{name: row.get(name) for name in names} for row in rows]

    def configuration(self, trial: FrozenTrial) -> dict[str, Any]:
        """
        :param trial: a trial
        :return: all hyper-parameters it was trained with, as plain values that ``-conf`` reads
        """
        values = self.space.values(trial.params)
        options = TrainOptions(algo=self.plan["algo"], env=self.plan["env"], hyperparams=values)
        return merge(self.plan["configuration"], options).plain

    def write(self) -> None:
        """
        Write ``plan.json``, ``trials.csv``, ``best.yml`` if a trial has completed, and figures if two have.

        :raises ConfigError: if they cannot be written, or the folder holds the results of another study
        """
        check_results(self.folder, self.study.study_name, self.study.get_trials(deepcopy=False))
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            write_atomically(self.folder / "plan.json", json.dumps(self.plan, indent=1).encode())
            rows = self.rows()
            if rows:
                write_atomically(self.folder / "trials.csv", as_csv(rows[0], rows).encode())
            best = best_of(self.study.get_trials(deepcopy=False))
            if best is not None:
                write_atomically(self.folder / "best.yml", self._best_yaml(best).encode())
                self._draw()
        except OSError as error:
            raise ConfigError(f"--log-folder: '{self.folder}' cannot be written — {error.strerror}") from None

    def _best_yaml(self, best: FrozenTrial) -> str:
        plan = self.plan
        completed, best_file = self._count(TrialState.COMPLETE), self.folder / "best.yml"
        lines = [
            f"Trial {best.number} of the study '{self.study.study_name}', the best of {completed} that completed:",
            f"mean return {best.value:.2f} of {plan['eval_episodes']} episodes for each of the seeds {plan['seeds']}.",
            shlex.join(["sb3-symphony", "train", "--algo", plan["algo"], "--env", plan["env"], "-conf", str(best_file)]),
        ]
        text = yaml.safe_dump(self.configuration(best), sort_keys=False, allow_unicode=True)
        return "".join(f"# {line}\n" for line in lines) + text

    def _count(self, *states: TrialState) -> int:
        return len(self.study.get_trials(deepcopy=False, states=states))

    def _draw(self) -> None:
        if self._count(TrialState.COMPLETE) < 2:
            return  # nothing to compare
        import matplotlib

        matplotlib.use("Agg")  # Optuna draws by pyplot, which else would look for a display
        import matplotlib.pyplot as plt
        from optuna.visualization import matplotlib as drawings

        for name in _FIGURES:
            with plt.rc_context(), warnings.catch_warnings():
                warnings.simplefilter("ignore")  # of axes with a single value, and that the module is experimental
                axes = getattr(drawings, f"plot_{name}")(self.study)
                figure = np.ravel(axes)[0].get_figure()
                with completed(self.folder / f"{name}.png") as unfinished:
                    figure.savefig(unfinished, dpi=120, bbox_inches="tight")
                plt.close(figure)

    def summary(self) -> str:
        """:return: state, best trials and where the files are, for the terminal"""
        trials = self.study.get_trials(deepcopy=False)
        again = replaced(trials)
        states = _counted([trial.state.name.lower() for trial in trials]) or "none"
        repeated = f"; {len(again)} of them tried again" if again else ""
        lines = [f"{self.study.study_name}: {len(trials)} trials ({states}{repeated})"]
        reasons = Counter(reason_of(trial) for trial in trials if trial.state == TrialState.FAIL)
        lines += [f"  failed {count} ×: {reason}" for reason, count in reasons.most_common(5)]
        for trial in trials:
            if trial.state == TrialState.RUNNING and trial.last_step is not None:
                latest, step = trial.intermediate_values[trial.last_step], trial.last_step
                lines.append(f"  trial {trial.number}: {latest:.2f} at evaluation {step} of {self.plan['n_evaluations']}")
        best = ranked(trials)
        if not best:
            return "\n".join([*lines, "no trial has completed yet"])
        names = list(best[0].params)
        table = [["trial", "value", *names]]
        table += [[str(t.number), f"{t.value:.2f}", *map(parameters_of(t).__getitem__, names)] for t in best[:_N_BEST]]
        lines += columns(table, left=0)
        return "\n".join([*lines, f"best: trial {best[0].number}, {best[0].value:.2f} | {self.folder / 'best.yml'}"])


def trials_table(name: str, path: Path, n_trials: int) -> str:
    """
    A search on a page, from the table that :meth:`SweepReport.write` has left.

    :param name: name of the search
    :param path: its ``trials.csv``, which need not be there yet
    :param n_trials: how many trials it is to have
    :return: heading, what became of the trials, and the five best ones with what differs between trials
    :raises ConfigError: if that is no table of trials
    """
    heading = f"### Search: {name}\n\n"
    if not path.is_file():
        return f"{heading}Not run yet.\n"
    try:
        with path.open(encoding="utf-8", newline="") as file:
            rows = list(csv.DictReader(file))
        again = {row["retry_of"] for row in rows}
        rows = [row for row in rows if row["number"] not in again]
        states = [row["state"] for row in rows]
        counted = _counted(states)
        hours = sum(float(row["seconds"] or 0) for row in rows) / 3600
        completed = [(-float(row["value"]), int(row["number"]), row) for row in rows if row["state"] == "complete"]
    except (OSError, csv.Error, KeyError, ValueError) as error:
        raise ConfigError(f"'{path}': no table of trials — {told(error)}") from None
    ended = sum(state in ("complete", "pruned", "fail") for state in states)
    summary = f"{ended} of {n_trials} trials ({counted}), {hours:.1f} hours one after the other."
    if not completed:
        return f"{heading}{summary}\n"
    names = [column for column in rows[0] if not _ABOUT.fullmatch(column) and len({row[column] for row in rows}) > 1]
    table = [["trial", "mean return", *names]]
    for value, number, row in sorted(completed)[:_N_BEST]:
        table.append([str(number), f"{-value:.2f}", *(_short(row[column]) for column in names)])
    return "\n".join([f"{heading}{summary} The best:", "", *aligned(table), ""])


def _counted(states: list[str]) -> str:
    """How many trials are in which state, in words."""
    counts = Counter(_STATES[state] for state in states)
    return ", ".join(f"{counts[word]} {word}" for word in _STATES.values() if counts[word])


def _short(cell: str) -> str:
    return f"{float(cell):.4g}" if re.fullmatch(r"-?\d*\.\d+(e-?\d+)?", cell) else cell
