"""What a run would be made of, and where each value comes from: ``train --dry-run``."""

import inspect
from contextlib import ExitStack
from typing import Any

import yaml

from sb3_symphony.common.checks import constructor_parameters
from sb3_symphony.experiment.config import ConfigError, RunConfig, RunSettings, TrainOptions, find_entry
from sb3_symphony.experiment.decode import RESERVED
from sb3_symphony.experiment.registry import load_algorithm
from sb3_symphony.experiment.train import check_folders, effective_config, prepare
from sb3_symphony.experiment.transfer import find_trained, inherited

#: keys whose items are shown one by one, as each may come from somewhere else
_MAPPINGS = ("policy_kwargs", "replay_buffer_kwargs", "env_kwargs")


def dry_run(options: TrainOptions) -> dict[str, tuple[Any, str]]:
    """
    Build everything that a run consists of, so that all mistakes show, and write nothing.

    :param options: options of the command line
    :return: dotted key → plain value, and where it comes from
    :raises ConfigError: if something is wrong
    """
    if options.resume is not None:
        raise ConfigError("--dry-run: --resume takes everything from the run's own config.yml — expected only one of them")
    config = effective_config(options)
    with ExitStack() as cleanup:
        check_folders(options)
        prepare(options, config, max(options.seed, 0), 0, cleanup)
    return {**_given(options, config), **_defaults(options.algo, config)}


def _given(options: TrainOptions, config: RunConfig) -> dict[str, tuple[Any, str]]:
    origin, _ = find_entry(options)
    from_agent = {} if options.trained_agent is None else inherited(find_trained(options))
    values: dict[str, Any] = {}
    for key, value in config.plain.items():
        if key in _MAPPINGS and isinstance(value, dict) and value:
            values |= {f"{key}.{name}": item for name, item in value.items()}
        else:
            values[key] = value

    def source(key: str) -> str:
        top, _, item = key.partition(".")
        if top == "n_timesteps" and options.n_timesteps > 0:
            return "-n"
        if top == "env_kwargs" and item in options.env_kwargs:
            return "--env-kwargs"
        if any(f"{key}.".startswith(f"{name}.") or name.startswith(f"{key}.") for name in options.hyperparams):
            return "-params"
        return f"-i {options.trained_agent}" if top in from_agent else origin

    return {key: (value, source(key)) for key, value in values.items()}


def _defaults(algo: str, config: RunConfig) -> dict[str, tuple[Any, str]]:
    """What nobody gave: defaults of a run, and of the algorithm's constructor."""
    algorithm = load_algorithm(algo)
    defaults: dict[str, tuple[Any, str]] = {}
    for name, field in RunSettings.model_fields.items():
        if name not in config.plain and not field.is_required():
            defaults[name] = (field.default, "default of train")
    parents = [parent for parent in algorithm.__mro__ if "__init__" in vars(parent)]
    given = {*RESERVED, *config.plain, *defaults, *(["action_noise"] if config.settings.noise_type else [])}
    for name, parameter in constructor_parameters(algorithm).items():
        if name not in given and parameter.default is not parameter.empty:
            owner = next(parent for parent in parents if name in inspect.signature(parent).parameters)
            defaults[name] = (_plain(parameter.default), f"default of {owner.__name__}")
    return defaults


def _plain(value: Any) -> Any:
    """As a configuration would say it."""
    if isinstance(value, tuple | list):
        return [_plain(item) for item in value]
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    return value if isinstance(value, bool | int | float | str | None) else getattr(value, "__name__", str(value))


def as_yaml(options: TrainOptions, values: dict[str, tuple[Any, str]]) -> str:
    """
    :param options: options of the command line
    :param values: result of :func:`dry_run`
    :return: YAML that ``-conf`` reads, with the sources as comments
    """
    lines: list[tuple[str, str]] = []
    parent = ""
    for key, (value, source) in values.items():
        top, _, item = key.partition(".")
        if item and top != parent:
            lines.append((f"{top}:", ""))
        parent = top
        flow = yaml.safe_dump({item or top: value}, default_flow_style=True, width=10**6, sort_keys=False).strip()
        lines.append(("  " * bool(item) + flow[1:-1], source))
    width = min(max(len(text) for text, _ in lines), 60)
    seed = "drawn" if options.seed < 0 else options.seed
    head = f"# {options.algo} on {options.env}, seed {seed}, device {options.device}, {options.vec_env} environments"
    return "\n".join([head, *(f"{text:{width}}  # {source}" if source else text for text, source in lines)])
