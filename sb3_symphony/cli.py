"""Command line: arguments only. Each command calls one function of :mod:`sb3_symphony.experiment`, imported when needed."""

import argparse
import errno
import io
import os
import re
import shlex
import sys
from collections.abc import Sequence
from contextlib import nullcontext, redirect_stdout
from functools import partial
from typing import Any, NoReturn

from sb3_symphony.common.checks import suggestion
from sb3_symphony.experiment.config import (
    ConfigError,
    TrainOptions,
    check_algorithm,
    parse_pairs,
    shipped_environments,
    validated,
    whose,
)
from sb3_symphony.experiment.plot import PlotOptions
from sb3_symphony.experiment.registry import ALGORITHMS
from sb3_symphony.experiment.select import (
    EnjoyOptions,
    EvaluateOptions,
    ExportOptions,
    GaitOptions,
    SelectOptions,
    VideoOptions,
)
from sb3_symphony.experiment.space import TuneOptions

_TRAIN_EXAMPLES = """examples:
  sb3-symphony train --algo redq -n 50000 -params gradient_steps:5 policy_kwargs.net_arch:[64,64]
  sb3-symphony train --env BipedalWalkerHardcore-v3 -i logs/symphony/BipedalWalker-v3_1
"""

_EVALUATE_EXAMPLES = """examples:
  sb3-symphony evaluate --algo sac --env Pendulum-v1 --load-best
  sb3-symphony evaluate --model ppo.zip --algo ppo --env Hopper-v5 --vecnormalize stats.pkl
  sb3-symphony evaluate --model logs/sac/Pendulum-v1_1 --obs-noise 0.05 --action-delay 2
"""
_ENJOY_EXAMPLES = """examples:
  sb3-symphony enjoy                                  the latest run of Symphony on BipedalWalker-v3
  sb3-symphony enjoy --algo sac --env Pendulum-v1 --load-best -n 5000
  sb3-symphony enjoy --model logs/sac/Pendulum-v1_1 --seed 20017 --no-render
"""
_EXPORT_EXAMPLES = """examples:
  sb3-symphony export --algo sac --env Pendulum-v1 --load-best
  sb3-symphony export --model ppo.zip --algo ppo --env Hopper-v5 -o robot.onnx
"""
_VIDEO_EXAMPLES = """examples:
  sb3-symphony video                                  the latest run of Symphony on BipedalWalker-v3
  sb3-symphony video --algo sac --env Hopper-v5 --load-best -n 500 -o hopper.gif --width 300
  sb3-symphony video logs/symphony/BipedalWalker-v3_1 logs/redq/BipedalWalker-v3_1 --grid
"""
_GAIT_EXAMPLES = """examples:
  sb3-symphony gait                                   the latest run of Symphony on BipedalWalker-v3
  sb3-symphony gait logs/symphony/BipedalWalker-v3_1 logs/redq/BipedalWalker-v3_1 -o gaits.svg
"""
_TUNE_EXAMPLES = """examples:
  sb3-symphony tune --algo td3 --n-trials 200 --n-jobs 2
  sb3-symphony tune --algo ppo --env Pendulum-v1 -n 50000 --seeds-per-trial 2 -params gamma:0.9
  sb3-symphony tune --storage postgresql://me@database.lab/sweeps      on each machine
  sb3-symphony tune --show
"""
_BENCH_EXAMPLES = """examples:
  sb3-symphony bench benchmarks/studies/bipedalwalker/study.yml --quick
  sb3-symphony bench study.yml -j 8                   again: goes on after Ctrl-C or a power cut
  sb3-symphony bench study.yml --backend ray --address 192.168.0.10:6379 -f /shared/results
  sb3-symphony bench study.yml --report               tables and figures of the results so far
"""
_PLOT_EXAMPLES = """examples:
  sb3-symphony plot                                   all runs in logs, a panel per environment
  sb3-symphony plot -a symphony sac -e BipedalWalker-v3 -o walker.svg
  sb3-symphony plot -a symphony -e BipedalWalker-v3 -x episodes --mean-per 10
  sb3-symphony plot logs/sac/Pendulum-v1_1 logs/sac/Pendulum-v1_2 --evaluations -x time
  sb3-symphony plot -a ppo --scalars
"""


_SEVERAL: Any = {"action": "extend", "nargs": "+"}  # a flag that is given twice adds to what it was
#: arguments that are pairs, whose values are YAML -> their flags
_PAIRS = {"hyperparams": "-params", "env_kwargs": "--env-kwargs", "eval_env_kwargs": "--eval-env-kwargs"}
_PAIRS |= {"env_wrapper": "--env-wrapper"}


_SEARCHES = (
    "-optimize",
    "--optimize-hyperparameters",
    "--n-trials",
    "--sampler",
    "--pruner",
    "--n-startup-trials",
    "--n-evaluations",
    "--storage",
    "--study-name",
)
_TRACKS = ("--track", "--uuid", "-uuid", "-tags", "--wandb-tags", "--wandb-project-name", "--wandb-entity", "--wandb-group")
# Flags of RL Zoo's train that ours lacks, and what has them
_OF_RL_ZOO = {
    **dict.fromkeys(_SEARCHES, "sb3-symphony tune"),
    **dict.fromkeys(_TRACKS, "python -m sb3_symphony.zoo train"),
    "--save-replay-buffer": "--save-freq N, whose checkpoints hold it",
}


class _Parser(argparse.ArgumentParser):
    """Tells a mistake in one line, with the nearest valid spelling."""

    def __init__(self, **kwargs: Any) -> None:
        kwargs.setdefault("formatter_class", _Formatter)
        super().__init__(allow_abbrev=False, **kwargs)
        self._negative_number_matcher = re.compile(r"^-(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?$")  # argparse's knows no exponents

    def error(self, message: str) -> NoReturn:
        self.exit(2, f"{self.prog}: error: {' '.join(message.split())}\n")

    def unknown(self, argument: str) -> NoReturn:
        """
        :param argument: an argument that no command takes
        """
        near = suggestion(argument, self._option_string_actions)
        if self.prog.endswith(" train") and argument in _OF_RL_ZOO:
            near = f" — RL Zoo's, for which there is {_OF_RL_ZOO[argument]}"
        self.error(f"unknown argument '{argument}'{near}")

    def takes(self, option: str) -> bool:
        """
        :param option: such as ``--progress``
        :return: whether there is such an option
        """
        return option in self._option_string_actions

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        if action.choices is not None and value not in action.choices:
            choices = [str(choice) for choice in action.choices]
            near = suggestion(str(value), choices) or f" — expected one of {', '.join(choices)}"
            raise argparse.ArgumentError(None, f"unknown {action.dest} '{value}'{near}")


def _add_quiet(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--quiet", dest="silent", action="store_true", help="print nothing but errors and notes")


class _Formatter(argparse.RawDescriptionHelpFormatter):
    def __init__(self, prog: str) -> None:
        super().__init__(prog, max_help_position=34, width=100)

    def _format_args(self, action: argparse.Action, default_metavar: str) -> str:
        return f"{action.metavar} ..." if action.nargs == "+" else super()._format_args(action, default_metavar)

    def _format_action_invocation(self, action: argparse.Action) -> str:
        """``-f, --folder DIR``: the value once, as newer versions of Python have it."""
        if not action.option_strings or action.nargs == 0:
            return super()._format_action_invocation(action)
        return f"{', '.join(action.option_strings)} {self._format_args(action, action.dest.upper())}"


def _whole_number(text: str) -> int:
    """``1e6`` is what one types for a million."""
    try:
        return int(text)
    except ValueError:
        number = float(text)
    if not number.is_integer():  # nor are infinity and nan
        raise ValueError
    return int(number)


_whole_number.__name__ = "whole number"  # argparse names it in messages


def _add_train(commands: Any) -> None:
    parser = commands.add_parser(
        "train",
        help="train an agent",
        usage="%(prog)s [--algo ALGO] [--env ENV] [options]",
        description="Train an agent, by default symphony; files go to <log-folder>/<algo>/<env>_<k>/.",
        epilog=_TRAIN_EXAMPLES,
    )
    # Only what is given reaches the options, so that --resume can tell it from the defaults
    add = partial(parser.add_argument, default=argparse.SUPPRESS)
    default = TrainOptions()
    add("--algo", metavar="ALGO", help=", ".join(ALGORITHMS))
    add("--env", metavar="ID", help=f"registered environment (default: {default.env})")
    add("--gym-packages", **_SEVERAL, metavar="M", help="modules to import, which register environments")
    add("-n", "--n-timesteps", type=_whole_number, metavar="N", help="environment steps (default: the configuration's)")
    add("--seed", type=_whole_number, metavar="N", help=f"seed; -1 draws one (default: {default.seed})")
    add("--n-seeds", type=_whole_number, metavar="K", help="K runs one after the other, on seeds N, N + 1, … (default: 1)")
    agent = "start from a trained agent: model's zip file or run folder"
    add("-i", "--trained-agent", metavar="PATH", help=agent)
    add("--with-replay-buffer", action="store_true", help="with -i: take over its replay buffer too")
    add("-f", "--log-folder", metavar="DIR", help=f"where runs are kept (default: {default.log_folder})")
    every, episodes = f"(default: {default.eval_freq})", f"(default: {default.eval_episodes})"
    add("--eval-freq", type=_whole_number, metavar="N", help=f"steps between evaluations, 0: none {every}")
    add("--eval-episodes", type=_whole_number, metavar="N", help=f"episodes of an evaluation {episodes}")
    add("--protocol", metavar="P", choices=("standard",), help="evaluate as all published tables do: standard")
    add("--threshold", type=float, metavar="R", help="return that solves it, for --protocol (default: as registered)")
    add("-params", "--hyperparams", **_SEVERAL, metavar="K:V", help="override hyper-parameters; values are YAML")
    add("-conf", "--conf-file", metavar="FILE", help="YAML file or preset, e.g. symphony-original (default: shipped)")
    add("--env-kwargs", **_SEVERAL, metavar="K:V", help="arguments of the environment")
    add("--eval-env-kwargs", **_SEVERAL, metavar="K:V", help="those of the evaluations, over these")
    add("--vec-env", metavar="KIND", choices=("dummy", "subproc"), help="subproc: a process for each of n_envs")
    add("-tb", "--tensorboard-log", metavar="DIR", help="write TensorBoard logs there")
    add("--save-freq", type=_whole_number, metavar="N", help="steps between checkpoints (default: none)")
    add("--keep", type=_whole_number, metavar="K", help=f"checkpoints to keep (default: {default.keep})")
    add("--resume", metavar="RUN_FOLDER", help="go on with a run from its newest checkpoint")
    add("--device", help=f"auto, cpu or cuda (default: {default.device})")
    add("--num-threads", type=_whole_number, metavar="N", help="threads of PyTorch (default: PyTorch's)")
    add("--log-interval", type=_whole_number, metavar="N", help="episodes (or rollouts) between log lines, -1: default")
    add("-P", "--progress", action=argparse.BooleanOptionalAction, help="progress bar (default: in a terminal)")
    add("--verbose", type=int, choices=(0, 1, 2), help="log to the terminal (default: 1, with a progress bar 0)")
    add("--quiet", action="store_true", help="print nothing but errors and notes")
    add("--json", dest="json_file", metavar="OUT", help="write results as JSON; -: print them so, and nothing else")
    add("--dry-run", action="store_true", help="only print the configuration, and where each value is from")
    parser.set_defaults(run=_train, parser=parser)


def _train(arguments: dict[str, Any], argv: Sequence[str]) -> int:
    only_show = arguments.pop("dry_run", False)
    if arguments.get("json_file") == "-":
        arguments["quiet"] = True
    if arguments.get("quiet"):
        arguments |= {"progress": False, "verbose": 0}
    arguments.setdefault("progress", sys.stdout.isatty())
    options = validated(TrainOptions, whose(arguments.get("conf_file")) | arguments)
    check_algorithm(options.algo)  # before the slow imports

    from sb3_symphony.experiment.output import json_report

    if only_show:
        from sb3_symphony.experiment.dry_run import as_yaml, dry_run

        tell = json_report(options.json_file)
        values = dry_run(options)
        tell({key: {"value": value, "source": source} for key, (value, source) in values.items()})
        if options.json_file != "-":
            print(as_yaml(options, values))
        return 0

    from sb3_symphony.experiment.train import train_seeds

    tell = json_report(options.json_file)
    results = train_seeds(options, command=shlex.join(["sb3-symphony", *argv]))
    tell({"runs": [result.plain() for result in results]})
    if not options.quiet:
        print(results[-1].summary())
    return 130 if results[-1].interrupted or len(results) < options.n_seeds else 0


def _wrapper(text: str) -> str:
    """A wrapper's arguments may be left out."""
    return text if ":" in text else f"{text}:{{}}"


def _add_selection(parser: argparse.ArgumentParser, several: bool = False) -> None:
    """The flags of :class:`SelectOptions`, which all commands on trained agents share; ``several`` may be given by name."""
    add = partial(parser.add_argument_group("which agent").add_argument, default=argparse.SUPPRESS)
    if several:
        add("agents", nargs="*", metavar="AGENT", help="model's zip file or run folder (default: found by what follows)")
    add("--model", metavar="PATH", help="model's zip file, or run folder (default: found by what follows)")
    add("--algo", metavar="ALGO", help="its algorithm (default: the run's; else symphony)")
    add("--env", metavar="ID", help="its environment (default: the run's; else BipedalWalker-v3)")
    add("-f", "--folder", metavar="DIR", help=f"where runs are kept (default: {SelectOptions().folder})")
    add("--exp-id", type=_whole_number, metavar="N", help="number of the run; -1: no run folder (default: 0, the latest)")
    add("--load-best", action="store_true", help="model with the best evaluation instead of the last one")
    add("--load-checkpoint", type=_whole_number, metavar="N", help="model saved after N steps")
    add("--load-last-checkpoint", action="store_true", help="model saved latest, of a run that did not end")
    add("--vecnormalize", metavar="PKL", help="statistics of VecNormalize, or none (default: the run's)")
    add("--env-kwargs", **_SEVERAL, metavar="K:V", help="arguments of the environment")
    add("--env-wrapper", **_SEVERAL, type=_wrapper, metavar="W[:{K: V}]", help="wrappers, or arguments of the run's")
    add("--gym-packages", **_SEVERAL, metavar="M", help="modules to import, which register environments")
    add("--device", help="auto, cpu or cuda (default: auto)")
    add("--num-threads", type=_whole_number, metavar="N", help="threads of PyTorch")


def _add_deterministic(parser: argparse.ArgumentParser) -> None:
    either = parser.add_mutually_exclusive_group()
    add = partial(either.add_argument, dest="deterministic", default=argparse.SUPPRESS)
    add("--deterministic", action="store_true", help="ask the policy for its mode (default)")
    add("--stochastic", action="store_false", help="ask it for samples")


def _add_evaluate(commands: Any) -> None:
    parser = commands.add_parser(
        "evaluate",
        help="returns of a trained agent over many episodes",
        usage="%(prog)s [which agent] [options]",
        description="Play episodes with an agent trained by this package, Stable-Baselines3 or SB3-Contrib.",
        epilog=_EVALUATE_EXAMPLES,
    )
    _add_selection(parser)
    add = partial(parser.add_argument, default=argparse.SUPPRESS)
    default = EvaluateOptions()
    add("-n", "--n-episodes", type=_whole_number, metavar="N", help=f"episodes (default: {default.n_episodes})")
    add("--seed", type=_whole_number, metavar="N", help=f"episode i has environment seed N + i (default: {default.seed})")
    _add_deterministic(parser)
    add("--n-envs", type=_whole_number, metavar="N", help="processes, results do not depend on it (default: 1)")
    add("--obs-noise", type=float, metavar="S", help="Gaussian noise on observations, std in their units (default: 0)")
    add("--action-delay", type=_whole_number, metavar="K", help="steps from an action to its effect (default: 0)")
    add("--json", dest="json_file", metavar="OUT", help="write results as JSON; -: print them so")
    add("-P", "--progress", action=argparse.BooleanOptionalAction, help="progress bar (default: in a terminal)")
    _add_quiet(parser)
    parser.set_defaults(run=_evaluate, parser=parser)


def _evaluate(arguments: dict[str, Any], argv: Sequence[str]) -> int:
    arguments.setdefault("progress", sys.stderr.isatty())
    options = validated(EvaluateOptions, arguments)

    from sb3_symphony.experiment.evaluate import evaluate

    result = evaluate(options)
    if options.json_file != "-":
        print(result)
    return 0


def _add_enjoy(commands: Any) -> None:
    parser = commands.add_parser(
        "enjoy",
        help="watch a trained agent",
        usage="%(prog)s [which agent] [options]",
        description="Let a trained agent act, in a window or without one, and print the returns of its episodes.",
        epilog=_ENJOY_EXAMPLES,
    )
    _add_selection(parser)
    add = partial(parser.add_argument, default=argparse.SUPPRESS)
    default = EnjoyOptions()
    add("-n", "--n-timesteps", type=_whole_number, metavar="N", help=f"steps (default: {default.n_timesteps})")
    add("--n-envs", type=_whole_number, metavar="N", help="copies of the environment (default: 1)")
    add("--seed", type=_whole_number, metavar="N", help=f"seed of the first episode (default: {default.seed})")
    _add_deterministic(parser)
    add("--no-render", dest="render", action="store_false", help="no window")
    add("--norm-reward", action="store_true", help="also show returns as normalised in training")
    add("--reward-log", metavar="DIR", help="write the episodes as Monitor files there")
    add("-P", "--progress", action="store_true", help="progress bar")
    # Needed by RL Zoo for old files, always so here
    parser.add_argument("--custom-objects", action="store_true", help=argparse.SUPPRESS)
    parser.set_defaults(run=_enjoy, parser=parser)


def _enjoy(arguments: dict[str, Any], argv: Sequence[str]) -> int:
    del arguments["custom_objects"]
    options = validated(EnjoyOptions, arguments)

    from sb3_symphony.experiment.enjoy import enjoy

    enjoy(options)
    return 0


def _add_export(commands: Any) -> None:
    parser = commands.add_parser(
        "export",
        help="write a trained actor as ONNX",
        usage="%(prog)s [which agent] [-o FILE]",
        description="Write a trained actor as ONNX: raw observation in, action in the environment's units out.",
        epilog=_EXPORT_EXAMPLES,
    )
    _add_selection(parser)
    parser.add_argument("-o", "--output", metavar="FILE", help="ONNX file (default: the model's name with .onnx)")
    parser.set_defaults(run=_export, parser=parser)


def _export(arguments: dict[str, Any], argv: Sequence[str]) -> int:
    options = validated(ExportOptions, arguments)

    from sb3_symphony.experiment.export import export

    print(export(options))
    return 0


def _add_agents(parser: argparse.ArgumentParser, output: str) -> Any:
    """The flags of :class:`AgentsOptions`, which commands that show agents share."""
    _add_selection(parser, several=True)
    add = partial(parser.add_argument, default=argparse.SUPPRESS)
    add("-l", "--labels", **_SEVERAL, metavar="NAME", help="what to call the agents")
    add("-o", "--output", metavar="FILE", help=output)
    add("-n", "--n-timesteps", type=_whole_number, metavar="N", help="leave an episode after N steps (default: at its end)")
    add("--seed", type=_whole_number, metavar="N", help="seed of the first episode (default: 0)")
    _add_deterministic(parser)
    add("-P", "--progress", action=argparse.BooleanOptionalAction, help="progress bar (default: in a terminal)")
    return add


def _add_video(commands: Any) -> None:
    parser = commands.add_parser(
        "video",
        help="film trained agents",
        usage="%(prog)s [AGENT ...] [which agent] [options]",
        description="Film episodes of trained agents, in real time of the simulated world; no display is needed.",
        epilog=_VIDEO_EXAMPLES,
    )
    add = _add_agents(parser, "film, .mp4 or .gif (default: in the run's folder videos)")
    add("--grid", action="store_true", help="all agents side by side in one film (default: a film for each)")
    add("--n-episodes", type=_whole_number, metavar="N", help="episodes in a film; the next seeds (default: 1)")
    add("--fps", type=_whole_number, metavar="N", help="pictures per second (default: the environment's, up to 50, GIF 25)")
    add("--width", type=_whole_number, metavar="N", help="pixels for each agent (default: the environment's, in a grid 400)")
    _add_quiet(parser)
    parser.set_defaults(run=_video, parser=parser)


def _video(arguments: dict[str, Any], argv: Sequence[str]) -> int:
    arguments.setdefault("progress", sys.stderr.isatty())
    options = validated(VideoOptions, arguments)

    from sb3_symphony.experiment.video import video

    print(*video(options), sep="\n")
    return 0


def _add_gait(commands: Any) -> None:
    parser = commands.add_parser(
        "gait",
        help="draw and measure how trained agents walk (BipedalWalker)",
        usage="%(prog)s [AGENT ...] [which agent] [options]",
        description="Measure how agents walk: cadence, duty factor, symmetry; draw foot contact and joint angles.",
        epilog=_GAIT_EXAMPLES,
    )
    add = _add_agents(parser, ".png, .svg or .pdf (default: gait.png in the run's folder)")
    add("--skip", type=float, metavar="S", help="seconds left out at the episode's beginning (default: 2)")
    add("--window", type=float, metavar="S", help="seconds that are drawn; numbers are of all that follow (default: 2)")
    add("--n-frames", type=_whole_number, metavar="N", help="pictures in the strip (default: 8)")
    add("--json", dest="json_file", metavar="OUT", help="write the numbers as JSON; -: print them so")
    _add_quiet(parser)
    parser.set_defaults(run=_gait, parser=parser)


def _gait(arguments: dict[str, Any], argv: Sequence[str]) -> int:
    arguments.setdefault("progress", sys.stderr.isatty())
    options = validated(GaitOptions, arguments)

    from sb3_symphony.experiment.gait import gait

    gait(options)
    return 0


def _add_plot(commands: Any) -> None:
    parser = commands.add_parser(
        "plot",
        help="draw learning curves and logged quantities",
        usage="%(prog)s [RUN ...] [-a ALGO ...] [-e ID ...] [options]",
        description="Draw runs; those that differ in seed only are one curve: interquartile mean and its 95 % interval.",
        epilog=_PLOT_EXAMPLES,
    )
    add = partial(parser.add_argument, default=argparse.SUPPRESS)
    add("runs", nargs="*", metavar="RUN", help="run folders, TensorBoard logs (default: looked for by -a, -e)")
    add("-a", "--algo", **_SEVERAL, metavar="ALGO", help="algorithms (default: all)")
    add("-e", "--env", **_SEVERAL, metavar="ID", help="environments (default: all)")
    add("-f", "--folder", metavar="DIR", help="where runs are kept (default: logs)")
    add("--evaluations", action="store_true", help="evaluations instead of training episodes")
    add("--scalars", action="store_true", help="quantities logged for TensorBoard, as small multiples")
    add("--tags", **_SEVERAL, metavar="TAG", help="only these quantities, e.g. train/approx_kl train/clip_fraction")
    add("-x", "--x-axis", choices=("steps", "episodes", "time"), help="(default: steps)")
    add("-y", "--y-axis", choices=("reward", "length", "success"), help="(default: reward)")
    add("-w", "--episode-window", type=_whole_number, metavar="N", help="running mean of N episodes (default: 100)")
    add("--mean-per", type=_whole_number, metavar="N", help="instead of it, one point for every N episodes: their mean")
    add("-max", "--max-timesteps", type=_whole_number, metavar="N", help="leave out what came after N environment steps")
    add("-l", "--labels", **_SEVERAL, metavar="LABEL", help="names of the curves, in their order")
    add("-o", "--output", metavar="FILE", help=".png, .svg or .pdf (default: in the run's folder, or -f's)")
    add("--json", dest="json_file", metavar="FILE", help="write the numbers of the curves as JSON; -: print them so")
    _add_quiet(parser)
    parser.set_defaults(run=_plot, parser=parser)


def _plot(arguments: dict[str, Any], argv: Sequence[str]) -> int:
    from sb3_symphony.experiment.plot import plot

    options = validated(PlotOptions, arguments)
    output = plot(options)
    if options.json_file != "-":
        print(output)
    return 0


def _add_tune(commands: Any) -> None:
    parser = commands.add_parser(
        "tune",
        help="search for hyper-parameters",
        usage="%(prog)s [--algo ALGO] [--env ENV] [options]",
        description="Search for hyper-parameters, or go on with a search; files go to <log-folder>/<algo>/tune/<study>/.",
        epilog=_TUNE_EXAMPLES,
    )
    add = partial(parser.add_argument, default=argparse.SUPPRESS)
    default = TuneOptions()
    add("--algo", metavar="ALGO", help=f"one of those of list (default: {default.algo})")
    add("--env", metavar="ID", help=f"registered environment (default: {default.env})")
    add("-n", "--n-timesteps", type=_whole_number, metavar="N", help="steps of each training (default: the configuration's)")
    add("--n-trials", type=_whole_number, metavar="N", help=f"trials of the whole study (default: {default.n_trials})")
    add("--n-startup-trials", type=_whole_number, metavar="N", help=f"random ones (default: {default.n_startup_trials})")
    add("--n-evaluations", type=_whole_number, metavar="N", help=f"in each training (default: {default.n_evaluations})")
    add("--eval-episodes", type=_whole_number, metavar="N", help=f"of an evaluation (default: {default.eval_episodes})")
    seeds = f"seeds N, N + 1, … of every trial (default: {default.seed})"
    add("--seed", type=_whole_number, metavar="N", help=seeds)
    add("--seeds-per-trial", type=_whole_number, metavar="N", help=f"how many (default: {default.seeds_per_trial})")
    add("--n-jobs", type=_whole_number, metavar="N", help="trials at a time, -1: as many as there are cores for (default: 1)")
    add("--timeout", type=float, metavar="SECONDS", help="begin no trial after that time (default: none)")
    add("--sampler", choices=("tpe", "random", "gp", "cmaes"), help=f"(default: {default.sampler})")
    add("--pruner", choices=("median", "halving", "hyperband", "none"), help=f"(default: {default.pruner})")
    add("--space", metavar="FILE", help="YAML file of the search space (default: shipped)")
    add("-params", "--hyperparams", **_SEVERAL, metavar="K:V", help="fix hyper-parameters; values are YAML")
    add("-conf", "--conf-file", metavar="FILE", help="YAML file or preset, all that is not searched (default: shipped)")
    add("--env-kwargs", **_SEVERAL, metavar="K:V", help="arguments of the environment")
    add("-f", "--log-folder", metavar="DIR", help=f"where files are kept (default: {default.log_folder})")
    add("--storage", metavar="WHERE", help="journal file or postgresql:// URL (default: with the files)")
    add("--study-name", metavar="NAME", help="name of the study (default: <algo>-<env>)")
    add("--heartbeat", type=_whole_number, metavar="S", help=f"seconds between signs of life (default: {default.heartbeat})")
    add("--device", help=f"auto, cpu or cuda (default: {default.device})")
    add("--num-threads", type=_whole_number, metavar="N", help="threads of each training (default: share of the cores)")
    add("--show", action="store_true", help="only print what a study has found so far, and write its files")
    _add_quiet(parser)
    parser.set_defaults(run=_tune, parser=parser)


def _tune(arguments: dict[str, Any], argv: Sequence[str]) -> int:
    options = validated(TuneOptions, whose(arguments.get("conf_file")) | arguments)
    check_algorithm(options.algo)  # before the slow imports

    from sb3_symphony.experiment.tune import tune

    result = tune(options)
    print(result.summary)
    return 130 if result.interrupted else 0


def _add_bench(commands: Any) -> None:
    parser = commands.add_parser(
        "bench",
        help="train a grid of algorithms, environments and seeds, and compare them",
        usage="%(prog)s STUDY.yml [options]",
        description="Train all cells of a study that are not done yet, several at a time; write tables and figures.",
        epilog=_BENCH_EXAMPLES,
    )
    parser.add_argument("study", metavar="STUDY.yml", help="algorithms, environments and seeds, see docs/command-line.md")
    add = partial(parser.add_argument, default=argparse.SUPPRESS)
    add("--quick", action="store_true", help="the study's version of a few minutes")
    add("-j", "--n-jobs", type=_whole_number, metavar="N", help="cells at a time (default: one for each core)")
    add("--backend", choices=("loky", "ray"), help="loky: this machine; ray: a cluster (default: loky)")
    add("--address", metavar="A", help="Ray cluster, HOST:PORT or auto (default: one is started on this machine)")
    add("-a", "--algo", **_SEVERAL, metavar="NAME", help="only these algorithms of the study (default: all)")
    add("-f", "--folder", metavar="DIR", help="where results are kept (default: logs/bench/<study>)")
    add("--report", action="store_true", help="only write tables and figures")
    add("--collect", metavar="DIR", help="with --report: copy the small files that it needs, for version control")
    add("--page", metavar="FILE", help="with --report: put the tables into this page, between <!-- results --> marks")
    add("--dry-run", action="store_true", help="only check all settings, and show the cells and how far they are")
    _add_quiet(parser)
    parser.set_defaults(run=_bench, parser=parser)


def _bench(arguments: dict[str, Any], argv: Sequence[str]) -> int:
    from sb3_symphony.experiment.grid import BenchOptions, bench

    result = bench(validated(BenchOptions, arguments))
    print(result.summary())
    for name, reason in result.failed:
        print(f"failed: {name}: {reason} (see {result.folder / name}.log)", file=sys.stderr)
    return 130 if result.interrupted else int(bool(result.failed))


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
        if arguments["algo"] not in ALGORITHMS:
            raise ConfigError(f"--algo: '{arguments['algo']}' — expected one of {', '.join(ALGORITHMS)}, which have settings")
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
    _add_enjoy(commands)
    _add_evaluate(commands)
    _add_export(commands)
    _add_tune(commands)
    _add_plot(commands)
    _add_video(commands)
    _add_gait(commands)
    _add_bench(commands)
    _add_list(commands)
    return parser


def _forget_output() -> None:
    """What could not be written: Python would try again, and tell it again, when it ends."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _fail(command: str, message: str) -> int:
    print(f"sb3-symphony {command}: error: {message}", file=sys.stderr)
    return 2


def main(argv: Sequence[str] | None = None) -> int:
    """
    Run the command line.

    :param argv: arguments, those of the process if not given
    :return: exit status: 0, 1 if cells of a grid failed, 2 for a mistake in the input, 130 after an interruption, 141 if
        nobody reads the output any more
    """
    argv = sys.argv[1:] if argv is None else list(argv)
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is None:  # closed by the one who started it
            setattr(sys, name, open(os.devnull, "w", encoding="utf-8"))
        elif isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")  # results are not lost for a character that a terminal does not have
    if "" not in sys.path:
        sys.path.append("")  # one's own robot.py in the working folder is found, as by `python -m`
    namespace, unknown = make_parser().parse_known_args(argv)
    arguments = vars(namespace)
    command, run, parser = (arguments.pop(name) for name in ("command", "run", "parser"))
    if unknown:
        parser.unknown(unknown[0])
    silent = arguments.pop("silent", False)
    if silent and parser.takes("--progress"):
        arguments["progress"] = False
    quiet = silent and arguments.get("json_file") != "-"
    try:
        arguments |= {name: parse_pairs(arguments[name], flag) for name, flag in _PAIRS.items() if name in arguments}
        with open(os.devnull, "w", encoding="utf-8") as nowhere, redirect_stdout(nowhere) if quiet else nullcontext():
            code = run(arguments, argv)
        sys.stdout.flush()
        return code
    except ConfigError as error:
        return _fail(command, str(error))
    except KeyboardInterrupt:
        return 130
    except BrokenPipeError:  # of `sb3-symphony … | head`: nobody reads any more
        _forget_output()
        return 141  # as a shell reports SIGPIPE
    except OSError as error:
        if error.errno != errno.ENOSPC:
            raise
        _forget_output()
        return _fail(command, f"output cannot be written — {error.strerror}")
