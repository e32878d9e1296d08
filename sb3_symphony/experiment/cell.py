"""
One cell of a grid: a training run in a process of its own, which goes on where it was stopped, and its final quality.

A worker calls :func:`supervise`, which starts ``python -m sb3_symphony.experiment.cell`` and waits. So a crash, a lack of
memory or whatever an environment does to its process ends one cell and nothing else, and every cell begins in a process
that nothing has happened in. Workers may be on other machines: the one who started the grid tells them through a file on
the file system that all share (:class:`Control`) whether he is still there and whether to stop.

A worker imports this module; what is heavy is imported by the cell's own process only.
"""

import json
import os
import shlex
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
import traceback
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal
from urllib.parse import quote

from sb3_symphony.common.files import completed, write_atomically
from sb3_symphony.common.versions import package_versions, processor
from sb3_symphony.experiment.config import ConfigError, TrainOptions, told
from sb3_symphony.experiment.run_folder import RunFolder, saved_count
from sb3_symphony.experiment.signals import ended_by

#: seconds without a sign of life after which a cell stops by itself
PATIENCE = 120.0
#: seconds between two looks at the control file
_POLL = 0.5


class Control:
    """
    What the one who started a grid tells its cells.

    :param path: file on a file system that all machines share
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.beats = 0

    def say(self, stop: int) -> None:
        """
        Tell that he is still there.

        :param stop: 0: go on; 1: save and stop; 2: stop at once; 3: end without saving
        """
        self.beats += 1
        with completed(self.path) as unfinished:
            unfinished.write_text(json.dumps({"beat": self.beats, "stop": stop}), encoding="utf-8")

    def heard(self) -> dict[str, int] | None:
        """:return: ``beat`` and ``stop``; None if the file cannot be read just now"""
        try:
            return json.loads(self.path.read_text(encoding="utf-8"))
        except (OSError, ValueError):
            return None


@dataclass(frozen=True)
class Job:
    """
    What a worker is to do. Paths are absolute and the same on all machines.

    :param name: name of the cell
    :param options: options of ``train``, of a run that begins
    :param run: its run folder
    :param final_episodes: episodes to evaluate the model on at the end
    :param conditions: name → options of ``evaluate`` that differ when it is evaluated on as many episodes once more
    :param session: folder of this execution of the grid, with ``control.json``
    """

    name: str
    options: dict[str, Any]
    run: str
    final_episodes: int
    conditions: dict[str, dict[str, Any]]
    session: str

    @property
    def log(self) -> Path:
        """What its process prints."""
        return Path(f"{self.run}.log")

    @property
    def started(self) -> Path:
        """File that tells that a worker has begun with it."""
        return Path(self.session) / f"{quote(self.name, safe='')}.started"

    @property
    def control(self) -> Control:
        """What the one who started the grid says."""
        return Control(Path(self.session) / "control.json")


@dataclass(frozen=True)
class Outcome:
    """
    How a job ended.

    :param state: ``done``; ``failed``; ``stopped`` before it was done; ``queued`` if it was not begun
    :param reason: why it failed
    """

    state: Literal["done", "failed", "stopped", "queued"]
    reason: str = ""


def supervise(job: Job) -> Outcome:
    """
    Run a cell in a process of its own.

    :param job: what to do
    :return: how it ended
    """
    if hasattr(signal, "pthread_sigmask"):
        # Ctrl-C in a terminal reaches all processes there; they are told by the control file instead. The cell inherits this
        signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    said = job.control.heard()
    if said is None or said["stop"]:
        return Outcome("queued")
    try:
        code = _execute(job)
    except OSError as error:  # a full disk, for example
        return Outcome("failed", f"'{error.filename or job.log}' cannot be written — {error.strerror}")
    if code == 0:
        return Outcome("done")
    said = job.control.heard()
    if code == _STOPPED or (said is not None and said["stop"]):
        return Outcome("stopped")
    return Outcome("failed", _reason(code, job.log))


def _execute(job: Job) -> int:
    """Start the cell's own process and wait for its exit code."""
    job.log.parent.mkdir(parents=True, exist_ok=True)
    job.started.write_text(socket.gethostname(), encoding="utf-8")
    one_thread = dict.fromkeys(("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"), "1")
    with job.log.open("ab") as log:
        log.write(f"--- {time.strftime('%Y-%m-%d %H:%M:%S')} on {socket.gethostname()}\n".encode())
        log.flush()
        ended = subprocess.run(
            [sys.executable, "-m", __name__],
            input=json.dumps(vars(job)).encode(),
            stdout=log,
            stderr=subprocess.STDOUT,
            env={**os.environ, **one_thread},
            check=False,
        )
    return ended.returncode


def _reason(code: int, log: Path) -> str:
    if code != _FAILED:
        return ended_by(code)
    return log.read_text(encoding="utf-8", errors="replace").rstrip().splitlines()[-1]


# ----------------------------------------------------------------------------------------------------------------------
# The cell's own process
# ----------------------------------------------------------------------------------------------------------------------

_FAILED = 70  # with the reason in the last line of the log; not 1, with which anything else may end the process
_STOPPED = 130


def _obey(control: Control) -> None:
    """Stop when that is said, or when nobody is left to say it. Signals do the stopping, as if by hand."""
    parent, beat, heard, obeyed = os.getppid(), None, time.monotonic(), 0
    while True:
        time.sleep(_POLL)
        if os.getppid() != parent:  # the worker was killed: another one may begin with this cell any moment
            os._exit(1)
        session = control.path.parent
        if session.parent.is_dir() and not session.is_dir():  # the grid was killed, and another execution begins
            os._exit(1)
        said = control.heard()
        if said is not None and said["beat"] != beat:
            beat, heard = said["beat"], time.monotonic()
        wanted = said["stop"] if said is not None else 0
        if time.monotonic() - heard > PATIENCE:
            wanted = max(wanted, 1)
        while obeyed < wanted:
            obeyed += 1
            if obeyed == 3:
                os._exit(_STOPPED)
            signal.raise_signal(signal.SIGTERM)  # os.kill() would end the process on Windows


def result_file(run: Path) -> Path:
    """
    :param run: run folder of a cell
    :return: the file that is there once the cell is done
    """
    return run / "result.json"


def read_result(run: Path) -> dict[str, Any] | None:
    """
    :param run: run folder of a cell
    :return: content of its :func:`result_file`; None if there is none
    """
    try:
        result = json.loads(result_file(run).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    return result if isinstance(result, dict) and "n_timesteps" in result else None


def begun(run: RunFolder) -> bool:
    """
    :param run: folder of a cell
    :return: whether its run has begun; else there is nothing, or what a process left that died before
    :raises ConfigError: if something else is there
    """
    if (run.details / "args.yml").is_file():
        return True
    files = [path for path in run.path.rglob("*") if path.is_file()]
    for path in files:
        if path.name not in ("config.yml", "command.txt", ".lock") and path.suffix != ".tmp":
            raise ConfigError(f"'{run.path}' is there already, with {path.name} — expected another -f")
    return False


def _command(options: TrainOptions) -> str:
    """The command line that does the same as a cell, but for the name of its folder."""
    flags = {
        "--algo": options.algo,
        "--env": options.env,
        "-n": options.n_timesteps,
        "--seed": options.seed,
        "-conf": options.conf_file,
        "--save-freq": options.save_freq,
        "--device": options.device,
        "--num-threads": options.num_threads,
        "--verbose": options.verbose,
        "--protocol": options.protocol,
        "--threshold": options.threshold,
        "-i": options.trained_agent,
        "-tb": options.tensorboard_log or None,
    }
    if options.protocol is None:
        flags |= {"--eval-freq": options.eval_freq, "--eval-episodes": options.eval_episodes}
    words = [f"{flag} {shlex.quote(str(value))}" for flag, value in flags.items() if value is not None]
    return " ".join(["sb3-symphony train", *words, *["--with-replay-buffer"] * options.with_replay_buffer])


def run_cell(job: Job) -> bool:
    """
    Train, going on with what is there, and evaluate the model.

    :param job: what to do
    :return: whether it is done; False if it was stopped
    :raises ConfigError: if options or configuration are wrong
    """
    from sb3_symphony.experiment.train import train

    options = TrainOptions.model_validate(job.options)
    run = RunFolder(Path(job.run), RunFolder.file_name(options.env))
    if begun(run):
        _wait_for_predecessor(run)
        onward = {name: getattr(options, name) for name in ("algo", "n_timesteps", "save_freq", "device", "trained_agent")}
        again = TrainOptions(resume=str(run.path), **onward)
        result = train(again, _command(options))
    else:
        if run.path.exists():
            shutil.rmtree(run.path)
        result = train(options, _command(options), run.path)
    if result.interrupted:
        return False
    told = read_result(run.path) if result.untouched else None
    seconds = round(result.seconds, 3)
    content = {
        "n_timesteps": options.n_timesteps,
        "steps": result.steps,
        "updates": saved_count(run.model, "_n_updates"),
        "seconds": told["seconds"] if told is not None and told["n_timesteps"] == options.n_timesteps else seconds,
        "machine": _machine(options.device),
        **({"final": _evaluated(job, {})} if job.final_episodes else {}),
        **({"conditions": _under_conditions(job)} if job.conditions else {}),
    }
    write_atomically(result_file(run.path), (json.dumps(content, indent=1) + "\n").encode())
    return True


def _wait_for_predecessor(run: RunFolder) -> None:
    """A cell of an execution that was killed notices that there is another one, soon or when the file system tells."""
    from filelock import FileLock, Timeout

    if run.checkpoints.is_dir():
        with suppress(Timeout), FileLock(run.checkpoints / ".lock", timeout=PATIENCE):
            pass


def _machine(device: str) -> dict[str, Any]:
    import torch as th
    from stable_baselines3.common.utils import get_device

    return {
        "host": socket.gethostname(),
        "processor": processor(),
        "cores": os.cpu_count(),
        **({"gpu": th.cuda.get_device_name()} if get_device(device).type == "cuda" else {}),
        **package_versions(),
    }


def _under_conditions(job: Job) -> dict[str, Any]:
    return {name: {"condition": different, **_evaluated(job, different)} for name, different in job.conditions.items()}


def _evaluated(job: Job, different: dict[str, Any]) -> dict[str, Any]:
    from sb3_symphony.experiment.evaluate import evaluate
    from sb3_symphony.experiment.select import EvaluateOptions

    settled = {"model": job.run, "algo": job.options["algo"], "device": job.options["device"]}
    result = evaluate(EvaluateOptions.model_validate({**settled, "n_episodes": job.final_episodes, **different}))
    return {
        "seed": result.options.seed,
        "returns": [episode.reward for episode in result.episodes],
        "lengths": [episode.length for episode in result.episodes],
        "successes": [episode.success for episode in result.episodes],
    }


def main() -> int:
    """
    What the process does: the job comes on standard input.

    :return: exit code
    """
    job = Job(**json.loads(sys.stdin.read()))
    threading.Thread(target=_obey, args=(job.control,), daemon=True).start()
    try:
        return 0 if run_cell(job) else _STOPPED
    except KeyboardInterrupt:
        return _STOPPED
    except ConfigError as error:
        print(error)
    except Exception as error:
        traceback.print_exc()
        sys.stderr.flush()
        print(told(error).splitlines()[0])
    return _FAILED


if __name__ == "__main__":
    sys.exit(main())
