"""The files of a run, laid out and named as RL Zoo does, so that scripts for its folders work here too."""

import json
import re
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from sb3_symphony.common.files import write_atomically
from sb3_symphony.experiment.config import ConfigError
from sb3_symphony.experiment.registry import without_folder, without_module


def steps_in_name(model: Path) -> int | None:
    """
    :param model: file of a model
    :return: the number of steps after which it was saved, if it is one of those that are saved on the way
    """
    name = re.fullmatch(r"rl_model_(\d+)_steps", model.stem)
    return int(name[1]) if name else None


def saved_count(model: Path, name: str) -> int:
    """
    :param model: file of a model saved by SB3
    :param name: attribute that counts something, such as ``num_timesteps``
    :return: its value, read without loading the model
    :raises OSError, zipfile.BadZipFile, ValueError, KeyError, TypeError: if there is no such file or it is damaged
    """
    with zipfile.ZipFile(model) as archive:
        return int(json.loads(archive.read("data"))[name])


def last_parts(run: str) -> str:
    """
    :param run: a run folder, or a model
    :return: the same without the folder of all results, which may have been moved
    """
    return "/".join(Path(run).parts[-2:])


@dataclass(frozen=True)
class RunFolder:
    """
    ``<log-folder>/<algo>/<env>_<k>/``.

    :param path: the folder
    :param env_name: the environment's id as it appears in file names
    """

    path: Path
    env_name: str

    @classmethod
    def create(cls, log_folder: str, algo: str, env_id: str, path: Path | None = None) -> "RunFolder":
        """
        Make the next free folder; an existing one is never used again, also if two runs start at the same moment.

        :param log_folder: where runs are kept
        :param algo: name of the algorithm
        :param env_id: id of the environment
        :param path: the new folder itself, instead of the next free one
        :return: the new folder
        :raises ConfigError: if it cannot be written
        """
        env_name = cls.file_name(env_id)
        parent = Path(log_folder) / without_folder(algo) if path is None else path.parent
        try:
            parent.mkdir(parents=True, exist_ok=True)
            while True:
                run = cls(path or parent / f"{env_name}_{1 + max(cls.numbers(parent, env_name), default=0)}", env_name)
                try:
                    run.path.mkdir()
                except FileExistsError:
                    if path is not None:
                        raise
                    continue
                run.details.mkdir()
                return run
        except OSError as error:
            raise ConfigError(f"--log-folder: '{log_folder}' cannot be written — {error.strerror}") from None

    @staticmethod
    def file_name(env_id: str) -> str:
        """
        :param env_id: id of an environment
        :return: the id as it appears in file names
        """
        return without_module(env_id).replace("/", "-")

    @staticmethod
    def numbers(parent: Path, env_name: str) -> set[int]:
        """
        :param parent: folder of an algorithm's runs
        :param env_name: the environment's id as it appears in file names
        :return: numbers of its runs
        """
        entries = parent.iterdir() if parent.is_dir() else ()
        return {int(found[1]) for entry in entries if (found := re.fullmatch(rf"{re.escape(env_name)}_(\d+)", entry.name))}

    @property
    def details(self) -> Path:
        """Folder of configuration and statistics."""
        return self.path / self.env_name

    @property
    def model(self) -> Path:
        """The model at the end of the run."""
        return self.path / f"{self.env_name}.zip"

    @property
    def best_model(self) -> Path:
        """The model with the best mean evaluation."""
        return self.path / "best_model.zip"

    @property
    def normalization(self) -> Path:
        """Statistics of ``VecNormalize`` that belong to :attr:`model`."""
        return self.details / "vecnormalize.pkl"

    @property
    def best_normalization(self) -> Path:
        """Statistics of ``VecNormalize`` that belong to ``best_model.zip``."""
        return self.path / "best_model_vecnormalize.pkl"

    def model_at(self, steps: int) -> Path:
        """The model that was saved after so many steps."""
        return self.path / f"rl_model_{steps}_steps.zip"

    def normalization_at(self, steps: int) -> Path:
        """Statistics of ``VecNormalize`` that belong to :meth:`model_at`."""
        return self.path / f"rl_model_vecnormalize_{steps}_steps.pkl"

    def saved_models(self) -> dict[int, Path]:
        """:return: number of steps → model saved then, in ascending order"""
        found = ((steps_in_name(path), path) for path in self.path.glob("rl_model_*_steps.zip"))
        return dict(sorted((steps, path) for steps, path in found if steps is not None))

    @property
    def checkpoints(self) -> Path:
        """Folder of what the run resumes from."""
        return self.path / "checkpoints"

    @property
    def command(self) -> str:
        """The command lines the run was started and resumed with."""
        path = self.details / "command.txt"
        return path.read_text(encoding="utf-8", errors="replace").strip() if path.is_file() else ""

    def changing_files(self) -> list[Path]:
        """:return: files that get longer or are replaced while training, as far as they are there"""
        best = [path for path in (self.best_model, self.best_normalization) if path.is_file()]
        return [*sorted(self.path.glob("*.monitor.csv")), *self.path.glob("evaluations.npz"), *best]

    @property
    def log_folder(self) -> Path:
        """File that says where the TensorBoard log is."""
        return self.details / "tensorboard.txt"

    def write_configuration(self, options: dict[str, Any], config: dict[str, Any], command: str) -> None:
        """
        Write what the run was started with, as plain YAML.

        :param options: options of the command line
        :param config: merged hyper-parameters, which ``-conf`` reads back
        :param command: the command line
        """
        texts = [yaml.safe_dump(each, sort_keys=False, allow_unicode=True) for each in (config, options)]
        contents = {"config.yml": texts[0], "command.txt": command + "\n"}
        contents["args.yml"] = texts[1]  # the last one: a folder that has it is complete
        for name, content in contents.items():
            write_atomically(self.details / name, content.encode())
