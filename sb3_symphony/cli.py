"""Command line: arguments only. Each command calls one function of :mod:`sb3_symphony.experiment`, imported when needed."""

import argparse
import shlex
import sys
from collections.abc import Sequence
from typing import Any, NoReturn

from sb3_symphony.common.checks import suggestion
from sb3_symphony.experiment.config import (
    ConfigError,
    TrainOptions,
    check_algorithm,
    parse_pairs,
    shipped_environments,
    validated,
)
from sb3_symphony.experiment.registry import ALGORITHMS
from sb3_symphony.experiment.select import SelectOptions

_TRAIN_EXAMPLES = """examples:
  sb3-symphony train                                  Symphony learns to walk
  sb3-symphony train --algo sac --env Pendulum-v1 --seed 0
  sb3-symphony train --algo redq -n 50000 -params gradient_steps:5 policy_kwargs.net_arch:[64,64]
  sb3-symphony train -conf logs/symphony/BipedalWalker-v3_1/BipedalWalker-v3/config.yml
"""


class _Parser(argparse.ArgumentParser):
    """Tells a mistake in one line, with the nearest valid spelling."""

    def __init__(self, **kwargs: Any) -> None:
        kwargs.setdefault("formatter_class", _Formatter)
        super().__init__(allow_abbrev=False, **kwargs)

    def error(self, message: str) -> NoReturn:
        self.exit(2, f"{self.prog}: error: {' '.join(message.split())}\n")

    def unknown(self, argument: str) -> NoReturn:
        """
        :param argument: an argument that no command takes
        """
        self.error(f"unknown argument '{argument}'{suggestion(argument, self._option_string_actions)}")

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        if action.choices is not None and value not in action.choices:
            choices = [str(choice) for choice in action.choices]
            near = suggestion(str(value), choices) or f" — expected one of {', '.join(choices)}"
            raise argparse.ArgumentError(None, f"unknown {action.dest} '{value}'{near}")


class _Formatter(argparse.RawDescriptionHelpFormatter):
    def __init__(self, prog: str) -> None:
        super().__init__(prog, max_help_position=34, width=110)


def _whole_number(text: str) -> int:
    """``1e6`` is what one types for a million."""
    number = float(text)
    if number != int(number):
        raise ValueError
    return int(number)


_whole_number.__name__ = "whole number"  # argparse names it in messages


def _add_train(commands: Any) -> None:
    parser = commands.add_parser(
        "train",
        help="train an agent",
        usage="%(prog)s [--algo ALGO] [--env ENV] [options]",
        description="Train an agent; files go to <log-folder>/<algo>/<env>_<k>/.",
        epilog=_TRAIN_EXAMPLES,
    )
    add = parser.add_argument
    add("--algo", metavar="ALGO", help=f"{', '.join(ALGORITHMS)} (default: %(default)s)")
    add("--env", metavar="ID", help="registered environment (default: %(default)s)")
    add("-n", "--n-timesteps", type=_whole_number, metavar="N", help="environment steps (default: the configuration's)")
    add("--seed", type=_whole_number, metavar="N", help="seed; -1 draws one (default: %(default)s)")
    add("-f", "--log-folder", metavar="DIR", help="where runs are kept (default: %(default)s)")
    add("--eval-freq", type=_whole_number, metavar="N", help="steps between evaluations, 0: none (default: %(default)s)")
    add("--eval-episodes", type=_whole_number, metavar="N", help="episodes of an evaluation (default: %(default)s)")
    add("-params", "--hyperparams", nargs="+", metavar="K:V", help="override hyper-parameters; values are YAML")
    add("-conf", "--conf-file", metavar="FILE", help="YAML file or preset to use, e.g. symphony-original (default: shipped)")
    add("--env-kwargs", nargs="+", metavar="K:V", help="arguments of the environment")
    add("-tb", "--tensorboard-log", metavar="DIR", help="write TensorBoard logs there")
    add("--save-freq", type=_whole_number, metavar="N", help="steps between saved models, -1: none (default: %(default)s)")
    add("--device", help="auto, cpu or cuda (default: %(default)s)")
    add("--num-threads", type=_whole_number, metavar="N", help="threads of PyTorch (default: PyTorch's)")
    add("--log-interval", type=_whole_number, metavar="N", help="episodes between log lines, -1: default, -2: none")
    add("-P", "--progress", action=argparse.BooleanOptionalAction, help="progress bar (default: in a terminal)")
    add("--verbose", type=int, choices=(0, 1, 2), help="log to the terminal (default: 1, with a progress bar 0)")
    defaults = TrainOptions().model_dump()
    parser.set_defaults(run=_train, parser=parser, **{**defaults, "hyperparams": [], "env_kwargs": []})


def _train(arguments: dict[str, Any], argv: Sequence[str]) -> int:
    arguments["hyperparams"] = parse_pairs(arguments["hyperparams"], "-params")
    arguments["env_kwargs"] = parse_pairs(arguments["env_kwargs"], "--env-kwargs")
    if arguments["progress"] is None:
        arguments["progress"] = sys.stdout.isatty()
    options = validated(TrainOptions, arguments)
    check_algorithm(options.algo)  # before the slow imports

    from sb3_symphony.experiment.train import train

    result = train(options, command=shlex.join(["sb3-symphony", *argv]))
    print(result.summary())
    return 130 if result.interrupted else 0


def _add_selection(parser: argparse.ArgumentParser) -> None:
    """The flags of :class:`SelectOptions`, which all commands on trained agents share."""
    add = parser.add_argument_group("which agent").add_argument
    add("--model", metavar="PATH", help="model's zip file, or run folder (default: looked for by the next flags)")
    add("--algo", metavar="ALGO", help="its algorithm (default: the run's, or symphony)")
    add("--env", metavar="ID", help="its environment (default: the run's, or BipedalWalker-v3)")
    add("-f", "--folder", metavar="DIR", help="where runs are kept (default: %(default)s)")
    add("--exp-id", type=_whole_number, metavar="N", help="number of the run; 0: latest, -1: no run folder (default: 0)")
    add("--load-best", action="store_true", help="model with the best evaluation instead of the last")
    add("--load-checkpoint", type=_whole_number, metavar="N", help="model saved after N steps")
    add("--load-last-checkpoint", action="store_true", help="model saved last")
    add("--vecnormalize", metavar="PKL", help="statistics of VecNormalize (default: the run's)")
    add("--env-kwargs", nargs="+", metavar="K:V", help="arguments of the environment")
    add("--gym-packages", nargs="+", metavar="M", help="modules to import, which register environments")
    add("--device", help="auto, cpu or cuda (default: %(default)s)")
    add("--num-threads", type=_whole_number, metavar="N", help="threads of PyTorch (default: PyTorch's)")
    parser.set_defaults(**{**SelectOptions().model_dump(), "env_kwargs": []})


def _add_list(commands: Any) -> None:
    parser = commands.add_parser(
        "list",
        help="list algorithms and the environments they have settings for",
        description="List the algorithms and, for each, the environments that have an entry in its shipped YAML file.",
        epilog="examples:\n  sb3-symphony list\n  sb3-symphony list --algo sac\n",
    )
    parser.add_argument("--algo", metavar="ALGO", help="only this algorithm")
    parser.set_defaults(run=_list, parser=parser)


def _list(arguments: dict[str, Any], argv: Sequence[str]) -> int:
    if arguments["algo"]:
        check_algorithm(arguments["algo"])
    names = [arguments["algo"]] if arguments["algo"] else list(ALGORITHMS)
    print("\n".join(f"{name:10}{ALGORITHMS[name][2]}\n{'':10}{', '.join(shipped_environments(name))}" for name in names))
    return 0


def make_parser() -> argparse.ArgumentParser:
    """
    :return: parser of all commands
    """
    parser = _Parser(
        prog="sb3-symphony",
        description="Train and compare Symphony, REDQ, DroQ and the algorithms of Stable-Baselines3.",
        epilog="examples:\n  sb3-symphony train\n  sb3-symphony list\n  sb3-symphony train --help\n",
    )
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", required=True)
    _add_train(commands)
    _add_list(commands)
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """
    Run the command line.

    :param argv: arguments, those of the process if not given
    :return: exit status: 0, 2 for a mistake in the input, 130 after an interruption
    """
    argv = sys.argv[1:] if argv is None else list(argv)
    namespace, unknown = make_parser().parse_known_args(argv)
    arguments = vars(namespace)
    command, run, parser = (arguments.pop(name) for name in ("command", "run", "parser"))
    if unknown:
        parser.unknown(unknown[0])
    try:
        return run(arguments, argv)
    except ConfigError as error:
        print(f"sb3-symphony {command}: error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        return 130
