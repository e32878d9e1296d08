"""
Search for hyper-parameters: trials of a study, run by any number of processes on any number of machines.

What a process does in one direction: claim a trial → let Optuna suggest its parameters → train it with each seed → report
the mean over seeds of each evaluation → complete, prune or fail it. All that must survive is in the storage. A process may
be killed at any moment: the next claim, by whichever process, finds its trials and enqueues them again.
"""

import copy
import json
import os
import threading
import time
import warnings
from contextlib import suppress
from dataclasses import dataclass
from datetime import timedelta
from functools import partial
from multiprocessing.connection import wait
from pathlib import Path
from typing import Any

import joblib
import numpy as np
import optuna
from optuna.exceptions import ExperimentalWarning, UpdateFinishedTrialError
from optuna.storages import RetryHeartbeatStaleTrialCallback
from optuna.trial import FrozenTrial, TrialState

from sb3_symphony.common.checks import suggestion
from sb3_symphony.experiment.callbacks import StopOnSignal
from sb3_symphony.experiment.config import ConfigError, check_algorithm, load_config, merge
from sb3_symphony.experiment.output import check_folder, output_folder
from sb3_symphony.experiment.registry import without_folder
from sb3_symphony.experiment.space import SearchSpace, TuneOptions, read_space
from sb3_symphony.experiment.sweep_report import (
    ENDED,
    PLAN,
    REASON,
    RETURNS,
    SweepReport,
    best_of,
    check_results,
    parameters_of,
    replaced,
)
from sb3_symphony.experiment.sweep_storage import WORKER, StorageAway, SweepStorage, is_url, open_storage
from sb3_symphony.experiment.train import build_model
from sb3_symphony.experiment.trial import TrialFailed, TrialProcesses, evaluation_frequency, ignore_mini_batches

#: how often a trial whose process died is tried again
RETRIES = 3

_FLAGS = {  # entries of a plan, and what chooses them
    "algo": "--algo",
    "env": "--env",
    "configuration": "-conf, -params, -n, --env-kwargs",
    "space": "--space, -params",
    "seeds": "--seed, --seeds-per-trial",
    "n_evaluations": "--n-evaluations",
    "eval_episodes": "--eval-episodes",
}


class ProgramError(RuntimeError):
    """A mistake in the program, not in hyper-parameters, ended a training; the message is its traceback."""


@dataclass(frozen=True)
class Plan:
    """
    What all trials of a study have in common. A study is continued with the same plan only.

    :param options: options of the command line
    :param configuration: hyper-parameters that are not searched, as plain values
    :param space: those that are
    """

    options: TuneOptions
    configuration: dict[str, Any]
    space: SearchSpace

    @classmethod
    def read(cls, options: TuneOptions) -> "Plan":
        """
        :param options: options of the command line
        :return: the plan, yet to be checked against the algorithm
        :raises ConfigError: if configuration or search space are wrong
        """
        check_algorithm(options.algo)
        return cls(options, load_config(options.training(options.hyperparams)).plain, read_space(options))

    def plain(self) -> dict[str, Any]:
        """:return: the plan as a study keeps it"""
        options = self.options
        plan: dict[str, Any] = {
            "algo": options.algo,
            "env": options.env,
            "configuration": self.configuration,
            "space": self.space.plain(),
        }
        plan |= {"seeds": options.seeds, "n_evaluations": options.n_evaluations, "eval_episodes": options.eval_episodes}
        return json.loads(json.dumps(plan, default=str))

    def check(self) -> None:
        """
        See whether the algorithm can be made with each value of the space. Nothing is written.

        :raises ConfigError: if not
        """
        if self.configuration.get("stop_reward") is not None:
            stop_reward = self.configuration["stop_reward"]
            raise ConfigError(f"stop_reward: {stop_reward} — expected none, as trials take all of their steps")
        with warnings.catch_warnings():
            ignore_mini_batches()
            self._build("", {})
            for name, values in self.space.examples():
                self._build(self.space.origin + f": {name}" * bool(name), values)

    def _build(self, where: str, values: dict[str, Any]) -> None:
        training = self.options.training(values)
        try:
            config = merge(self.configuration, training)
            evaluation_frequency(config, self.options.n_evaluations)
            model = build_model(training, config, self.options.seed, verbose=0)
        except ConfigError as error:
            raise ConfigError(f"{where}: {error}" if where else str(error)) from None
        assert model.env is not None
        model.env.close()

    def check_study(self, study: optuna.Study, storage: str) -> None:
        """
        :param study: an existing study
        :param storage: name of its storage
        :raises ConfigError: if the study was made with another plan
        """
        found = study.user_attrs.get(PLAN)
        where = f"--study-name: '{study.study_name}' in {storage}"
        if found is None:
            raise ConfigError(f"{where} was not made by this command — expected another name")
        self.check_same(found, where)

    def check_same(self, found: dict[str, Any], where: str) -> None:
        """
        :param found: an earlier plan, as :meth:`plain` gives it
        :param where: where it comes from, for messages
        :raises ConfigError: if this is another one
        """
        plan = self.plain()
        if without_folder(str(found.get("algo"))) == without_folder(plan["algo"]):  # the file may have been moved
            found = {**found, "algo": plan["algo"]}
        for key, value in plan.items():
            if found.get(key) != value:
                what, there, here = _difference(key, found.get(key), value)
                if there is None:
                    told = f"has no {what}, here {here}"
                elif here is None:
                    told = f"has {what} {there}, here none"
                else:
                    told = f"has {what} {there}, not {here}"
                raise ConfigError(f"{where} {told} — expected the same ({_FLAGS[key]}), or another name")


def _difference(name: str, found: Any, wanted: Any) -> tuple[str, Any, Any]:
    """The first entry of nested mappings that differs."""
    if isinstance(found, dict) and isinstance(wanted, dict):
        for key in [*found, *wanted]:
            if found.get(key) != wanted.get(key):
                return _difference(f"{name}: {key}", found.get(key), wanted.get(key))
    return name, found, wanted


@dataclass
class _Running:
    study: optuna.Study
    trial: optuna.Trial
    processes: TrialProcesses


class Sweep:
    """
    One process's part in a study.

    :param plan: what is searched
    :param storage: where trials are kept
    :param study: the study
    :param stop: tells whether to stop
    """

    def __init__(self, plan: Plan, storage: SweepStorage, study: optuna.Study, stop: StopOnSignal) -> None:
        self.plan = plan
        self.options = plan.options
        self.storage = storage
        self.study = study
        self.stop = stop
        self._study_id = storage.optuna.get_study_id_from_name(study.study_name)
        self._pruner = _pruner(self.options)
        n_seeds = len(self.options.seeds)
        self._n_jobs = self.options.n_jobs if self.options.n_jobs > 0 else max(1, joblib.cpu_count() // n_seeds)
        threads = self.options.num_threads if self.options.num_threads > 0 else joblib.cpu_count() // (self._n_jobs * n_seeds)
        self._training = self.options.training({}).model_copy(update={"num_threads": max(1, threads)})
        self._running: list[_Running] = []
        self._own: set[int] = set()  # ids of the trials that this process has claimed and not ended
        self._others = 0  # trials of other processes that had not ended when nothing was left to claim
        self._claim_at = 0.0
        self._ends_at = time.monotonic() + (self.options.timeout or float("inf"))
        self._began, self._ended_before = time.monotonic(), self._ended(study.get_trials(deepcopy=False))

    def run(self) -> None:
        """
        Run trials until the study has as many as are wanted, and all have ended, those of other processes too: they are
        taken over if these die.

        :raises KeyboardInterrupt: if it was stopped
        :raises StorageAway: if the storage was away for too long
        :raises ProgramError: if a training ended in a mistake of the program
        """
        ended = threading.Event()
        threading.Thread(target=self._beat, args=(ended,), daemon=True).start()
        try:
            while not self._over():
                if self._claim_is_due() and self._start():
                    continue
                self._wait()
                for running in list(self._running):
                    self._follow(running)
        except (KeyboardInterrupt, ProgramError):
            with suppress(KeyboardInterrupt, StorageAway):  # what is not marked now is found by the next claim
                for running in list(self._running):
                    self._end(running, TrialState.FAIL, {REASON: "interrupted", ENDED: "interrupted"})
            raise
        finally:
            ended.set()
            for running in self._running:
                running.processes.stop()

    def _over(self) -> bool:
        if self.stop.requested:
            raise KeyboardInterrupt
        if self._running:
            return False
        return self._timed_out() or (self._claim_at > 0 and self._others == 0)

    def _timed_out(self) -> bool:
        return time.monotonic() >= self._ends_at

    def _claim_is_due(self) -> bool:
        return len(self._running) < self._n_jobs and time.monotonic() >= self._claim_at and not self._timed_out()

    def _beat(self, ended: threading.Event) -> None:
        """What a thread of its own does, as suggesting values and starting processes may take long."""
        while not ended.wait(self.options.heartbeat):
            with suppress(Exception):  # where the storage is away, the sweep itself waits for it
                self.storage.beat(list(self._own))

    def _wait(self) -> None:
        """Until there is something to read, but not for long, as there may be a signal."""
        connections = [connection for running in self._running for connection in running.processes.connections]
        if connections:
            wait(connections, timeout=0.5)
        else:
            time.sleep(0.5)

    # Claiming ---------------------------------------------------------------------------------------------------------

    def claim(self) -> int | None:
        """
        Take a trial that nobody else will take. Trials of processes that died are enqueued again before.

        :return: id of the trial; None if there is nothing to do
        :raises UpdateFinishedTrialError: if this process was asleep for so long that the lock went to another one, which
            repeats the trial
        """
        self.study.get_trials(deepcopy=False)  # what is new since the last time is read outside of the lock
        with self.storage.locked():
            self.storage.bury(self.study)
            self._retry()
            trials = self.study.get_trials(deepcopy=False)
            trial_id = self._take(trials)
            if trial_id is None:
                running = (trial for trial in trials if trial.state == TrialState.RUNNING)
                self._others = sum(trial._trial_id not in self._own for trial in running)
            else:
                self.storage.patience(partial(self.storage.beat, [trial_id]))
                self.storage.optuna.set_trial_user_attr(trial_id, WORKER, self.storage.worker)
                self._own.add(trial_id)
        return trial_id

    def _take(self, trials: list[FrozenTrial]) -> int | None:
        """A trial that waits, or a new one if there are to be more."""
        for trial in trials:
            if trial.state == TrialState.WAITING:
                trial_id = trial._trial_id
                if self.storage.optuna.set_trial_state_values(trial_id, TrialState.RUNNING):
                    return trial_id
        if len(trials) - len(replaced(trials)) < self.options.n_trials:
            return self.storage.optuna.create_new_trial(self._study_id)
        return None

    def _retry(self) -> None:
        """Enqueue again what ended for other reasons than its parameters."""
        trials = self.study.get_trials(deepcopy=False)
        done = replaced(trials)
        for trial in trials:
            ended = trial.user_attrs.get(ENDED, "died")
            if trial.state == TrialState.FAIL and trial.number not in done and ended != "failed":
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore", ExperimentalWarning)
                    enqueue = RetryHeartbeatStaleTrialCallback(None if ended == "interrupted" else RETRIES)
                again = copy.deepcopy(trial)  # it is changed, and this one is the storage's own
                again.user_attrs = {}  # they tell how it went
                enqueue(self.study, again)

    def _start(self) -> bool:
        """Claim a trial and start its trainings, if there is one."""
        try:
            trial_id = self.claim()
        except UpdateFinishedTrialError:
            return True
        if trial_id is None:
            self._claim_at = time.monotonic() + min(5.0, self.options.heartbeat)
            return False
        number = self.storage.optuna.get_trial(trial_id).number
        # A study object of its own, as it keeps what one trial has read; draws depend on the seed and the trial's number,
        # not on the process that makes them
        study = optuna.load_study(
            study_name=self.study.study_name,
            storage=self.storage.optuna,
            sampler=_sampler(self.options, number),
            pruner=self._pruner,
        )
        trial = optuna.Trial(study, trial_id)
        try:
            values = self.plan.space.suggest(trial)
        except UpdateFinishedTrialError:
            self._own.discard(trial_id)
            return True  # see _forget
        try:
            config = merge(self.plan.configuration, self.options.training(values))
            evaluation_frequency(config, self.options.n_evaluations)
            processes = TrialProcesses(self._training, config, self.options.seeds, self.options.n_evaluations)
        except ConfigError as error:
            self._tell(study, trial, TrialState.FAIL, {REASON: str(error), ENDED: "failed"})
        except TrialFailed as failure:
            self._tell(study, trial, TrialState.FAIL, {REASON: failure.reason, ENDED: failure.kind})
        else:
            self._running.append(_Running(study, trial, processes))
            drawn = ", ".join(f"{name} {value}" for name, value in parameters_of(trial).items())
            print(f"begins: trial {number} | {drawn}", flush=True)
        return True

    # Following --------------------------------------------------------------------------------------------------------

    def _follow(self, running: _Running) -> None:
        """Hand on what the trainings of a trial have sent."""
        trial, processes = running.trial, running.processes
        step = processes.reported
        try:
            for mean in processes.poll():
                step += 1
                trial.report(mean, step)
                if step < self.options.n_evaluations and trial.should_prune():
                    self._end(running, TrialState.PRUNED, {RETURNS: [returns[step - 1] for returns in processes.returns]})
                    return
        except TrialFailed as failure:
            self._end(running, TrialState.FAIL, {REASON: failure.reason.splitlines()[-1], ENDED: failure.kind})
            if failure.kind == "error":
                raise ProgramError(f"trial {trial.number}, {failure.reason}") from None
            return
        except UpdateFinishedTrialError:
            self._forget(running)
            return
        if processes.finished:
            self._end(running, TrialState.COMPLETE, {RETURNS: [returns[-1] for returns in processes.returns]})

    def _end(self, running: _Running, state: TrialState, attributes: dict[str, Any]) -> None:
        running.processes.stop()
        self._tell(running.study, running.trial, state, attributes)
        self._running.remove(running)
        self._claim_at = 0.0

    def _forget(self, running: _Running) -> None:
        """Another process took this one for dead and has enqueued the trial again."""
        running.processes.stop()
        self._running.remove(running)
        self._own.discard(running.trial._trial_id)
        self._claim_at = 0.0
        print(f"trial {running.trial.number}: no sign of life had reached the storage, another process repeats it", flush=True)

    def _tell(self, study: optuna.Study, trial: optuna.Trial, state: TrialState, attributes: dict[str, Any]) -> None:
        value = float(np.mean(attributes[RETURNS])) if state == TrialState.COMPLETE else None
        try:
            for key, attribute in attributes.items():
                trial.set_user_attr(key, attribute)
            told = study.tell(trial, value, state, skip_if_finished=True)
        except UpdateFinishedTrialError:
            return  # see _forget
        finally:
            self._own.discard(trial._trial_id)
        print(f"{_words(told, attributes)} | {self._progress()}", flush=True)

    def _progress(self) -> str:
        trials = self.study.get_trials(deepcopy=False)
        ended, best, n_trials = self._ended(trials), best_of(trials), self.options.n_trials
        told = [f"{ended} of {n_trials}"]
        if self._ended_before < ended < n_trials:  # of all processes together
            each = (time.monotonic() - self._began) / (ended - self._ended_before)
            told.append(f"about {timedelta(seconds=round(each * (n_trials - ended)))} left")
        return ", ".join([*told, *([f"best {best.value:.2f} (trial {best.number})"] if best else [])])

    @staticmethod
    def _ended(trials: list[FrozenTrial]) -> int:
        again = replaced(trials)
        interrupted = {trial.number for trial in trials if trial.user_attrs.get(ENDED) == "interrupted"}
        return sum(trial.state.is_finished() for trial in trials) - len(again | interrupted)


def _words(told: FrozenTrial, attributes: dict[str, Any]) -> str:
    """One trial's end for the terminal."""
    match told.state:
        case TrialState.COMPLETE:
            end = f"{told.value:.2f}"
        case TrialState.PRUNED:
            end = f"pruned at evaluation {told.last_step}, {told.value:.2f}"
        case _:
            end = f"failed: {attributes[REASON]}"
    return f"trial {told.number} {end}"


def _sampler(options: TuneOptions, number: int) -> optuna.samplers.BaseSampler:
    seed = int(np.random.SeedSequence([options.seed, number]).generate_state(1)[0])
    startup = options.n_startup_trials
    match options.sampler:
        case "tpe":
            return optuna.samplers.TPESampler(seed=seed, n_startup_trials=startup)
        case "gp":
            return optuna.samplers.GPSampler(seed=seed, n_startup_trials=startup, warn_independent_sampling=False)
        case "cmaes":
            return optuna.samplers.CmaEsSampler(seed=seed, n_startup_trials=startup, warn_independent_sampling=False)
        case _:
            return optuna.samplers.RandomSampler(seed=seed)


def _pruner(options: TuneOptions) -> optuna.pruners.BasePruner:
    match options.pruner:
        case "median":
            warmup = options.n_evaluations // 3
            return optuna.pruners.MedianPruner(n_startup_trials=options.n_startup_trials, n_warmup_steps=warmup)
        case "halving":
            return optuna.pruners.SuccessiveHalvingPruner(min_resource=1)
        case "hyperband":
            return optuna.pruners.HyperbandPruner(min_resource=1, max_resource=options.n_evaluations)
        case _:
            return optuna.pruners.NopPruner()


@dataclass(frozen=True)
class TuneResult:
    """
    What a sweep has found.

    :param folder: where the files are
    :param summary: some lines for the terminal
    :param interrupted: whether it was stopped by a signal
    """

    folder: Path
    summary: str
    interrupted: bool = False


def tune(options: TuneOptions) -> TuneResult:
    """
    Run a sweep, or go on with it, and write its results. With ``show`` set, only write the results.

    :param options: options of the command line
    :return: what it has found
    :raises ConfigError: if options, configuration, search space or storage are wrong
    :raises ProgramError: if a training ended in a mistake of the program
    """
    verbosity = optuna.logging.get_verbosity()
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    try:
        return _show(options) if options.show else _tune(options)
    finally:
        optuna.logging.set_verbosity(verbosity)


def _tune(options: TuneOptions) -> TuneResult:
    plan = Plan.read(options)
    plan.check()
    stop = StopOnSignal()

    def stopping() -> None:
        if stop.requested:
            raise KeyboardInterrupt

    check_folder(options.folder, "--log-folder")
    storage = open_storage(options.where, stopping, options.heartbeat)
    try:
        study = _open_study(plan, storage)
        interrupted = False
        with stop.listening():
            try:
                Sweep(plan, storage, study, stop).run()
            except KeyboardInterrupt:
                interrupted = True
        return _result(study, options, interrupted)
    finally:
        storage.close()


def _open_study(plan: Plan, storage: SweepStorage) -> optuna.Study:
    options, steps = plan.options, plan.configuration["n_timesteps"]
    with storage.locked():
        study = None
        if options.name in optuna.get_all_study_names(storage.optuna):
            study = optuna.load_study(study_name=options.name, storage=storage.optuna)
        trials = [] if study is None else study.get_trials(deepcopy=False)
        check_results(options.folder, options.name, trials)
        if study is None:
            output_folder(options.folder, "--log-folder")
            study = optuna.create_study(study_name=options.name, storage=storage.optuna, direction="maximize")
        if not study.user_attrs and not trials:  # the process that created it may have died before this
            study.set_user_attr(PLAN, plan.plain())
    plan.check_study(study, storage.name)
    output_folder(options.folder, "--log-folder")
    print(
        f"{options.algo} on {options.env}: study '{study.study_name}' in {storage.name}, {len(trials)} trials so far; "
        f"each {steps} steps with seeds {', '.join(map(str, options.seeds))}",
        flush=True,
    )
    return study


def _show(options: TuneOptions) -> TuneResult:
    where = options.where
    if not is_url(where) and not os.path.exists(where):
        raise ConfigError(f"--show: there is no sweep at {where}")
    storage = open_storage(where, lambda: None, options.heartbeat)
    try:
        try:
            study = optuna.load_study(study_name=options.name, storage=storage.optuna)
        except KeyError:
            names = optuna.get_all_study_names(storage.optuna)
            near = suggestion(options.name, names) or f" — it has {', '.join(names) or 'none'}"
            raise ConfigError(f"--study-name: no study '{options.name}' in {storage.name}{near}") from None
        if PLAN not in study.user_attrs:
            raise ConfigError(f"--study-name: '{options.name}' in {storage.name} was not made by this command")
        return _result(study, options)
    finally:
        storage.close()


def _result(study: optuna.Study, options: TuneOptions, interrupted: bool = False) -> TuneResult:
    report = SweepReport(study, options.folder)
    report.write()
    onward = "\ninterrupted — the same command goes on" if interrupted else ""
    return TuneResult(options.folder, report.summary() + onward, interrupted)
