"""
RL Zoo's own commands with the algorithms of this package.

Importing this module is all that a script needs: afterwards ``rl_zoo3.train.train()``, ``rl_zoo3.enjoy.enjoy()`` and the
tuning of the former know Symphony, REDQ and DroQ, their configurations and their search spaces. On the command line::

    python -m sb3_symphony.zoo train --algo redq --env BipedalWalker-v3
    python -m sb3_symphony.zoo train --algo droq --env Pendulum-v1 -optimize --n-trials 50
    python -m sb3_symphony.zoo enjoy --algo redq --env BipedalWalker-v3 -f logs --no-render

Configurations of the three are read and checked as by ``sb3-symphony train``: nothing in them is evaluated, ``1e-3`` is a
number, classes and noises have names, ``policy_kwargs.net_arch`` changes one item. Other algorithms are left to RL Zoo.

Importing RL Zoo has side effects on the whole process: it replaces Gymnasium's ``TimeLimit`` and registers environments.
Nothing else in this package imports it.
"""

import sys
from collections.abc import Sequence
from copy import copy, deepcopy
from importlib import import_module
from pprint import pprint
from typing import Any

from gymnasium import spaces

from sb3_symphony.common.checks import suggestion
from sb3_symphony.experiment.config import ConfigError, RunConfig, RunSettings, TrainOptions, load_config, merge, validated
from sb3_symphony.experiment.decode import algorithm_arguments, class_by_name
from sb3_symphony.experiment.environment import for_training_only
from sb3_symphony.experiment.registry import ALGORITHMS, load_algorithm
from sb3_symphony.experiment.space import SearchSpace, TuneOptions, read_space

try:
    import rl_zoo3.enjoy
    import rl_zoo3.train
    from optuna import Trial
    from rl_zoo3.exp_manager import ExperimentManager
    from rl_zoo3.hyperparams_opt import HYPERPARAMS_CONVERTER, HYPERPARAMS_SAMPLER
    from rl_zoo3.utils import get_wrapper_class
except ImportError as error:
    message = f'RL Zoo is missing or not complete: pip install "sb3-symphony[zoo]" ({error})'
    if __name__ == "__main__":
        print(message, file=sys.stderr)
        sys.exit(2)
    raise ImportError(message, name=error.name) from error

#: algorithms of this package
OURS = [name for name, (module, _, _) in ALGORITHMS.items() if module.startswith("sb3_symphony.")]

_COMMANDS = {
    "train": "rl_zoo3.train",
    "enjoy": "rl_zoo3.enjoy",
    "plot_train": "rl_zoo3.plots",
    "all_plots": "rl_zoo3.plots",
    "plot_from_file": "rl_zoo3.plots",
}
#: keys that RL Zoo deals with
_RUN_KEYS = {"n_timesteps", "policy", "n_envs", "normalize", "frame_stack", "callback"}
_RUN_KEYS |= {"env_wrapper", "vec_env_wrapper", "env_kwargs", "monitor_kwargs"}


def _plain(value: Any) -> Any:
    """RL Zoo hands over what Python made of ``-params``: classes become names again, tuples lists."""
    if isinstance(value, type):
        return value.__name__
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    return [_plain(item) for item in value] if isinstance(value, list | tuple) else value


def _arguments(algo: str, config: RunConfig, action_space: spaces.Space) -> dict[str, Any]:
    """Arguments of the algorithm's constructor, with a noise of their own."""
    own = {key: value for key, value in config.arguments.items() if key not in _RUN_KEYS}
    return algorithm_arguments(algo, load_algorithm(algo), RunConfig(config.settings, own, config.plain), action_space)


def _task_wrappers(env_wrapper: Any) -> list[Any]:
    """RL Zoo's ``env_wrapper`` as a list, without those that change only what is learned from."""
    wrappers = env_wrapper if isinstance(env_wrapper, list) else [env_wrapper] if env_wrapper else []
    names = [next(iter(wrapper)) if isinstance(wrapper, dict) else wrapper for wrapper in wrappers]
    # Others are outside RL Zoo's monitor in evaluations, too
    trained = [isinstance(name, str) and name.startswith("sb3_symphony.") and for_training_only(name) for name in names]
    return [wrapper for wrapper, left_out in zip(wrappers, trained, strict=True) if not left_out]


class Search:
    """
    What RL Zoo calls sampler and converter of an algorithm, on the search space of ``sb3-symphony tune``.

    :param algo: name of the algorithm
    :param env_id: environment, which may have a space of its own
    :param given: hyper-parameters, dotted as in ``-params``, that are not searched
    :param entry: configuration that holds all that is not searched, as plain values
    """

    def __init__(
        self, algo: str, env_id: str = "default", given: dict[str, Any] | None = None, entry: dict[str, Any] | None = None
    ) -> None:
        self.algo = algo
        self.options = TuneOptions(algo=algo, env=env_id, hyperparams=given or {})
        self.entry = entry or {"n_timesteps": 1}

    @property
    def space(self) -> SearchSpace:
        """The search space."""
        return read_space(self.options)

    def sample(self, trial: Trial, n_actions: int, n_envs: int, additional_args: dict[str, Any]) -> dict[str, Any]:
        """
        :param trial: trial that hyper-parameters are wanted for
        :param n_actions: size of the actions, for the exploration noise
        :param n_envs: not used
        :param additional_args: not used
        :return: all arguments of the algorithm's constructor: what was sampled is merged into the configuration
        """
        options = TrainOptions(algo=self.algo, hyperparams=self.space.suggest(trial))
        return _arguments(self.algo, merge(self.entry, options), spaces.Box(-1, 1, (n_actions,)))

    def convert(self, params: dict[str, Any]) -> dict[str, Any]:
        """
        :param params: parameters of a trial, as a study stores them
        :return: hyper-parameters, dotted as in ``-params``
        """
        return self.space.values(params)


class SymphonyManager(ExperimentManager):
    """
    RL Zoo's experiment manager for the algorithms of this package. Configurations are YAML files or names of presets; the
    arguments are those of RL Zoo.
    """

    def __init__(self, *positional: Any, **keywords: Any) -> None:
        super().__init__(*positional, **keywords)
        self.conf_file = keywords.get("config")

    def read_hyperparameters(self) -> tuple[dict[str, Any], dict[str, Any]]:
        """
        :return: the merged configuration as plain values, twice: to work on, and to save
        """
        given = _plain(self.custom_hyperparams or {})
        if self.storage and self.study_name and self.trial_id is not None:
            given = {**self.load_trial(self.storage, self.study_name, self.trial_id), **given}
        env_id, env_kwargs = str(self.env_name.gym_id), _plain(self.env_kwargs)
        options = dict(algo=self.algo, env=env_id, conf_file=self.conf_file, hyperparams=given, env_kwargs=env_kwargs)
        self.run_config = load_config(validated(TrainOptions, options))
        for key, value in self.run_config.plain.items():
            if key in RunSettings.model_fields and key not in _RUN_KEYS | {"noise_type", "noise_std"}:
                raise ConfigError(f"{key}: {value!r} — RL Zoo has no such key, sb3-symphony train has")
        # Before anything is written; how many actions there are does not matter for that
        _arguments(self.algo, self.run_config, spaces.Box(-1, 1, (1,)))
        self.search = Search(self.algo, env_id, given, self.run_config.plain)
        if self._eval_env_kwargs_args is None:
            self.eval_env_kwargs = self.run_config.settings.env_kwargs
        saved = dict(sorted(deepcopy(self.run_config.plain).items()))
        if self.run_config.settings.env_wrapper:  # here and below, in the only form that RL Zoo knows
            saved["env_wrapper"] = [{name: arguments} for name, arguments in self.run_config.settings.env_wrapper]
        if self.run_config.settings.callback:
            classes = [(class_by_name("callback", name), arguments) for name, arguments in self.run_config.settings.callback]
            saved["callback"] = [{f"{class_.__module__}.{class_.__name__}": arguments} for class_, arguments in classes]
        print("Hyperparameters (those that are tuned will be overridden):")
        pprint(saved)
        return deepcopy(saved), saved

    def _preprocess_hyperparams(self, hyperparams: dict[str, Any]) -> Any:
        # RL Zoo deals with the run; gamma is also an argument of VecNormalize
        return super()._preprocess_hyperparams(
            {key: value for key, value in hyperparams.items() if key in _RUN_KEYS | {"gamma"}}
        )

    def _preprocess_action_noise(self, hyperparams: dict[str, Any], saved_hyperparams: dict[str, Any], env: Any) -> Any:
        super()._preprocess_action_noise({}, saved_hyperparams, env)  # counts the actions
        return _arguments(self.algo, self.run_config, env.action_space)

    def create_envs(self, n_envs: int, eval_env: bool = False, no_log: bool = False) -> Any:
        """
        :param n_envs: number of copies
        :param eval_env: whether to leave out wrappers that change only what is learned from
        :param no_log: whether to write no Monitor files
        :return: the vectorised environment
        """
        manager = self
        if eval_env:
            manager = copy(self)  # trials of a study run in threads
            named = [{name: arguments} for name, arguments in self.run_config.settings.env_wrapper]
            manager.env_wrapper = get_wrapper_class({"env_wrapper": _task_wrappers(named)})
        return super(SymphonyManager, manager).create_envs(n_envs, eval_env, no_log)

    def hyperparameters_optimization(self) -> None:
        """Run the study; samples are merged into this configuration, and every trial has a noise of its own."""
        HYPERPARAMS_SAMPLER[self.algo] = self.search.sample
        super().hyperparameters_optimization()


def _manager(args: Any, algo: str, *positional: Any, **keywords: Any) -> ExperimentManager:
    """Stands where RL Zoo's ``train`` makes an experiment manager."""
    return (SymphonyManager if algo in OURS else ExperimentManager)(args, algo, *positional, **keywords)


_create_test_env = rl_zoo3.utils.create_test_env


def _create_raw_test_env(*positional: Any, **keywords: Any) -> Any:
    """RL Zoo's, without the wrappers that change only what is learned from: returns it shows are the environment's own."""
    hyperparams = keywords.get("hyperparams") or {}
    if "env_wrapper" in hyperparams:
        keywords["hyperparams"] = {**hyperparams, "env_wrapper": _task_wrappers(hyperparams["env_wrapper"])}
    return _create_test_env(*positional, **keywords)


def _register() -> None:
    converters: dict[str, Any] = HYPERPARAMS_CONVERTER
    for name in OURS:
        rl_zoo3.utils.ALGOS[name] = load_algorithm(name)
        HYPERPARAMS_SAMPLER[name] = Search(name).sample
        converters[name] = Search(name).convert
    vars(rl_zoo3.train)["ExperimentManager"] = _manager
    for module in (rl_zoo3, rl_zoo3.utils, rl_zoo3.enjoy):
        vars(module)["create_test_env"] = _create_raw_test_env


_register()


def main(argv: Sequence[str] | None = None) -> int:
    """
    Run one of RL Zoo's commands.

    :param argv: its name and its arguments, those of the process if not given
    :return: exit status: 0, 2 for a mistake in the configuration
    """
    argv = sys.argv[1:] if argv is None else list(argv)
    usage = f"usage: python -m sb3_symphony.zoo {{{','.join(_COMMANDS)}}} ..."
    if not argv or argv[0] in ("-h", "--help"):
        print(f"{usage}\n{__doc__}")
        return 0 if argv else 2
    command, *arguments = argv
    if command not in _COMMANDS:
        print(f"sb3_symphony.zoo: error: unknown command '{command}'{suggestion(command, _COMMANDS)}", file=sys.stderr)
        return 2
    sys.argv = [f"sb3_symphony.zoo {command}", *arguments]
    try:
        getattr(import_module(_COMMANDS[command]), command)()
    except ConfigError as error:
        print(f"{sys.argv[0]}: error: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
