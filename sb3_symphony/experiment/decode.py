"""
Plain values of a configuration → arguments of an algorithm, checked against the signatures of the classes themselves.

Classes are found by name in allow-lists, never by evaluating text.
"""

import inspect
import math
import re
from collections.abc import Callable, Iterable, Mapping
from functools import reduce
from importlib import import_module
from operator import is_, or_
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin

import gymnasium as gym
import numpy as np
import torch as th
from pydantic import AfterValidator, ConfigDict, PydanticSchemaGenerationError, TypeAdapter, ValidationError
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.buffers import DictReplayBuffer, NStepReplayBuffer, ReplayBuffer
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.utils import LinearSchedule

from sb3_symphony.common.checks import constructor_parameters, suggestion
from sb3_symphony.experiment.config import ConfigError, RunConfig, RunSettings

_SB3 = "stable_baselines3.common"
_OURS = "sb3_symphony.common"
_BUFFERS: dict[str, tuple[str, ...]] = {
    f"{_SB3}.buffers": ("ReplayBuffer", "DictReplayBuffer", "NStepReplayBuffer", "RolloutBuffer", "DictRolloutBuffer"),
    "stable_baselines3.her.her_replay_buffer": ("HerReplayBuffer",),
    f"{_OURS}.buffers": ("FadingReplayBuffer", "FadingDictReplayBuffer", "PrioritizedReplayBuffer"),
}
_SB3_BUFFERS = (DictReplayBuffer, NStepReplayBuffer, ReplayBuffer)  # of which SB3 takes one by itself
_EXTRACTORS: dict[str, tuple[str, ...]] = {f"{_SB3}.torch_layers": ("FlattenExtractor", "NatureCNN", "CombinedExtractor")}
#: key → module → classes that it may name
_CLASSES: dict[str, dict[str, tuple[str, ...]]] = {
    "activation_fn": {
        "torch.nn": ("ReLU", "ELU", "Tanh", "LeakyReLU", "SiLU", "GELU", "Identity"),
        f"{_OURS}.layers": ("LeakySine",),
    },
    "optimizer_class": {
        "torch.optim": ("Adam", "AdamW", "Adamax", "NAdam", "RAdam", "RMSprop", "SGD"),
        f"{_SB3}.sb2_compat.rmsprop_tf_like": ("RMSpropTFLike",),
    },
    "replay_buffer_class": _BUFFERS,
    "rollout_buffer_class": _BUFFERS,
    "features_extractor_class": _EXTRACTORS,
    # None that writes files: a configuration must not choose what is written where
    "callback": {
        f"{_OURS}.callbacks": ("EntropyOnReturn", "GreedyEpisodes", "QuietOnReturn", "SlowOnReturn"),
        f"{_OURS}.q_bias": ("QBiasCallback",),
        f"{_SB3}.callbacks": ("StopTrainingOnMaxEpisodes", "LogEveryNTimesteps"),
    },
    "action_noise": {
        f"{_SB3}.noise": ("NormalActionNoise", "OrnsteinUhlenbeckActionNoise"),
        f"{_OURS}.noise": ("DecayingNormalActionNoise", "StickyActionNoise", "PinkActionNoise", "DisturbanceActionNoise"),
    },
}

#: set by the command line
RESERVED = {"self", "env", "policy", "verbose", "seed", "device", "tensorboard_log", "_init_setup_model"}
#: given by the algorithm to its replay buffer, and to its policy
_BUFFER_RESERVED = {"self", "buffer_size", "observation_space", "action_space", "device", "n_envs", "optimize_memory_usage"}
_POLICY_RESERVED = {"self", "observation_space", "action_space", "lr_schedule", "use_sde"}

#: classes that a policy makes, and the arguments that it gives them
_PARTS = {"optimizer": {"self", "params", "lr"}, "features_extractor": {"self", "observation_space"}}

_AT_LEAST_ONE = {
    "batch_size",
    "buffer_size",
    "cg_max_steps",
    "hold",
    "n_critics",
    "n_epochs",
    "n_quantiles",
    "n_steps",
    "policy_delay",
    "stats_window_size",
    "subset_size",
    "target_update_interval",
    "train_freq",
}
_FRACTION = {"actor_averaging", "dropout_rate", "gae_lambda", "gamma", "tau"}
_ANY_SIGN = {"gradient_steps", "sde_sample_freq", "target_entropy"}
#: NumPy's types in annotations, and the plain ones instead
_NUMPY: list[tuple[type, Any]] = [
    (np.floating, float),
    (np.integer, int),
    (np.ndarray, float | Annotated[list[float], AfterValidator(np.array)]),
]
#: what text may say where SB3 takes text and numbers, and tells it without the argument's name
_WORDS = {"ent_coef": r"auto(_[0-9.eE+-]+)?", "target_entropy": "auto"}


# ----------------------------------------------------------------------------------------------------------------------
# Names and signatures
# ----------------------------------------------------------------------------------------------------------------------


def class_by_name(key: str, name: Any) -> Any:
    """
    :param key: the key whose value names a class, such as ``activation_fn``
    :param name: name of the class, short (``ReLU``) or with its module (``nn.ReLU``, ``torch.nn.ReLU``)
    :return: the class
    :raises ConfigError: if the name is not in the key's allow-list
    """
    known = {f"{module}.{short}": (module, short) for module, shorts in _CLASSES[key].items() for short in shorts}
    if isinstance(name, str):
        ending = "." + re.sub(r"^th\.", "torch.", name)
        for full, (module, short) in known.items():
            if f".{full}".endswith(ending):
                return getattr(import_module(module), short)
    shorts = [short for _, short in known.values()]
    near = suggestion(str(name).rpartition(".")[2], shorts) or f" — expected one of {', '.join(shorts)}"
    raise ConfigError(f"{key}: unknown class {name!r}{near}")


def _alternatives(annotation: Any) -> tuple[Any, ...]:
    return get_args(annotation) if get_origin(annotation) in (Union, UnionType) else (annotation,)


def _plain(annotation: Any) -> Any:
    """NumPy's numbers and arrays as what a YAML file has for them: numbers and lists."""
    given = _alternatives(annotation)
    plain = [next((yaml for numpy, yaml in _NUMPY if (get_origin(each) or each) is numpy), each) for each in given]
    return annotation if all(map(is_, given, plain)) else reduce(or_, plain)


def argument_types(class_: type) -> dict[str, Any]:
    """
    :param class_: any class
    :return: arguments of its constructor with their annotations, parents' included where it takes ``**kwargs``
    """
    annotations = {name: each.annotation for name, each in constructor_parameters(class_, eval_str=True).items()}
    return {name: Any if each is inspect.Parameter.empty else _plain(each) for name, each in annotations.items()}


def check_keys(given: Iterable[str], known: Iterable[str], what: str, owner: str) -> None:
    """
    :param given: keys of the configuration
    :param known: valid keys
    :param what: what a key is called in the message
    :param owner: what it would belong to
    :raises ConfigError: for the first unknown key, with the nearest valid one
    """
    known = set(known)
    for key in given:
        if key not in known:
            raise ConfigError(f"unknown {what} '{key}' for {owner}{suggestion(str(key), known)}")


# ----------------------------------------------------------------------------------------------------------------------
# Values
# ----------------------------------------------------------------------------------------------------------------------


def _describe(annotation: Any) -> str:
    """What an annotation allows, in words."""
    words = {int: "a whole number", float: "a number", bool: "true or false", str: "a name", NoneType: "null"}
    parts = []
    alternatives = _alternatives(annotation)
    for alternative in alternatives:
        origin = get_origin(alternative)
        if alternative is th.Tensor:  # torch's optimizers take them, a file has none
            continue
        if isinstance(alternative, type) and alternative in words:
            if not (alternative is int and float in alternatives):
                parts.append(words[alternative])
        elif Callable in (origin, alternative):
            parts.append("lin_<number>")
        elif origin is Literal:
            parts += [repr(choice) for choice in get_args(alternative)]
        elif origin is tuple:
            parts.append(f"[{', '.join(_describe(item) for item in get_args(alternative))}]")
        elif origin is dict:
            parts.append("a mapping")
        elif origin is type:
            parts.append("the name of a class")
        elif origin is list:
            parts.append(f"[{_describe(get_args(alternative)[0])}, …]")
        elif origin is Annotated:
            parts.append(_describe(get_args(alternative)[0]))
        elif isinstance(alternative, type):
            parts.append(f"{{{alternative.__name__}: {{…}}}}")
    return " or ".join(dict.fromkeys(parts))


def _numbers(value: Any) -> Iterable[float]:
    if isinstance(value, int | float) and not isinstance(value, bool):
        yield value
    elif isinstance(value, list | tuple | np.ndarray):
        for item in value:
            yield from _numbers(item)
    elif isinstance(value, Mapping):
        for item in value.values():
            if not isinstance(item, Mapping):  # what lies deeper is its owner's to check
                yield from _numbers(item)
    elif isinstance(value, LinearSchedule):
        yield value.start


def _check_range(key: str, plain: Any, value: Any, lowest: float) -> None:
    """Numbers are finite; a name that means a count or a fraction has that range; else they are at least ``lowest``."""
    name = key.rpartition(" ")[2]
    for number in _numbers(value):
        if not math.isfinite(number):
            raise ConfigError(f"{key}: {plain!r} — expected a finite number")
        if name in _AT_LEAST_ONE or name == "net_arch":
            if number < 1:
                raise ConfigError(f"{key}: {plain!r} — expected a number >= 1")
        elif name in _FRACTION:
            if not 0 <= number <= 1:
                raise ConfigError(f"{key}: {plain!r} — expected a number in [0, 1]")
        elif name not in _ANY_SIGN and number < lowest:
            raise ConfigError(f"{key}: {plain!r} — expected a number >= {lowest:g}")


def _typed(key: str, plain: Any, value: Any, annotation: Any, lowest: float) -> Any:
    """The value as its annotation wants it (``1e6`` → 1000000, list → tuple), or an error that says what it wants."""
    expected = ConfigError(f"{key}: {plain!r} — expected {_describe(annotation)}")
    if isinstance(value, bool) and annotation is not Any and bool not in _alternatives(annotation):
        raise expected  # else taken for 0 or 1
    try:
        adapter: TypeAdapter = TypeAdapter(annotation, config=ConfigDict(arbitrary_types_allowed=True))
        value = adapter.validate_python(value)
    except PydanticSchemaGenerationError:  # an annotation that pydantic cannot read says nothing
        return value
    except ValidationError:
        raise expected from None
    _check_range(key, plain, value, lowest)
    return value


def typed_arguments(
    plain: Mapping[str, Any], class_: type, filled: Iterable[str], lowest: float = -math.inf, path: str = ""
) -> dict[str, Any]:
    """
    Check arguments of a class against its constructor.

    :param plain: names and plain values
    :param class_: the class
    :param filled: arguments that a configuration does not give
    :param lowest: smallest number
    :param path: the key of the configuration that holds them, for messages; else they name the class
    :return: the arguments, of the annotated types
    :raises ConfigError: for an unknown name or a wrong value
    """
    types = argument_types(class_)
    check_keys(plain, types.keys() - {"self", *filled}, f"{path} key" if path else "argument", class_.__name__)
    owner = path or class_.__name__
    return {key: _typed(f"{owner}: {key}", value, value, types[key], lowest) for key, value in plain.items()}


def _schedule(key: str, value: Any) -> Any:
    """``lin_<v>``: from v at the start to 0 at the end."""
    if isinstance(value, str) and value.startswith("lin_"):
        try:
            return LinearSchedule(float(value.removeprefix("lin_")), 0.0, 1.0)
        except ValueError:
            raise ConfigError(f"{key}: {value!r} — expected a number or lin_<number>") from None
    return value


def _takes_schedule(annotation: Any) -> bool:
    return any(Callable in (get_origin(item), item) for item in _alternatives(annotation))


def _named_classes(key: str, value: Any) -> Any:
    """Names → classes, also in lists and mappings (one activation per layer, or per network)."""
    if isinstance(value, Mapping):
        return {name: _named_classes(key, item) for name, item in value.items()}
    if isinstance(value, list):
        return [_named_classes(key, item) for item in value]
    return class_by_name(key, value)


def _action_noise(value: Any, n_actions: int | tuple[int, ...], n_envs: int) -> Any:
    """``{StickyActionNoise: {sigma: 0.3}}`` → that noise for this action space."""
    name, arguments = next(iter(value.items())) if isinstance(value, dict) and len(value) == 1 else (value, {})
    if not (isinstance(name, str) and isinstance(arguments, dict | None)):
        raise ConfigError(f"action_noise: {value!r} — expected {{NameOfTheNoise: {{sigma: 0.3}}}}")
    arguments = dict(arguments or {})  # the configuration is written as it is
    class_ = class_by_name("action_noise", name)
    types = argument_types(class_)
    filled = {"n_actions": n_actions, "n_envs": n_envs}
    if "n_actions" in types:
        arguments = typed_arguments(arguments, class_, filled, lowest=0)
    else:  # SB3's own noises want one number per action
        check_keys(arguments, types.keys() - {"self", "dtype", *filled}, "argument", name)
        for key, plain in {"mean": 0.0, **arguments}.items():
            lowest = 0 if key != "mean" else -math.inf
            arguments[key] = _typed(f"action_noise: {name}: {key}", plain, plain, types[key], lowest)
    arguments |= {key: filled[key] for key in filled if key in types}
    try:
        if "n_actions" not in types:
            arguments |= {key: np.full(n_actions or 1, arguments[key]) for key in ("mean", "sigma") if key in arguments}
        return class_(**arguments)
    except (ValueError, TypeError) as error:
        raise ConfigError(f"action_noise: {name}: {error}") from None


def _policy_kwargs(value: Any, policy_class: Any) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise ConfigError(f"policy_kwargs: {value!r} — expected a mapping")
    types = argument_types(policy_class)
    check_keys(value, types.keys() - _POLICY_RESERVED, "policy_kwargs key", policy_class.__name__)
    if isinstance(value.get("net_arch"), dict):  # policies leave keys out that they do not know
        critics = "vf" if issubclass(policy_class, ActorCriticPolicy) else "qf"
        check_keys(value["net_arch"], {"pi", critics}, "net_arch key", policy_class.__name__)
    decoded = {}
    for key, plain in value.items():
        item = _named_classes(key, plain) if key in _CLASSES and plain is not None else plain
        decoded[key] = _typed(key, plain, item, types[key], -math.inf)
    for part, filled in _PARTS.items():
        if given := decoded.get(f"{part}_kwargs"):
            default = constructor_parameters(policy_class)[f"{part}_class"].default
            class_ = decoded.get(f"{part}_class") or default or policy_class.default_features_extractor
            decoded[f"{part}_kwargs"] = typed_arguments(given, class_, filled, path=f"{part}_kwargs")
    return decoded


def _is_ours(algorithm: type[BaseAlgorithm]) -> bool:
    """Symphony, REDQ and what is derived from them."""
    return hasattr(algorithm, "default_buffers")


def _check_words(decoded: Mapping[str, Any]) -> None:
    """Text among the arguments of SB3's algorithms says what they can read; ours tell it themselves."""
    for key, pattern in _WORDS.items():
        value = decoded.get(key)
        if isinstance(value, str) and not re.fullmatch(pattern, value):
            raise ConfigError(f"{key}: {value!r} — expected a number or auto{' or auto_<number>' * (key == 'ent_coef')}")


def _check_replay(name: str, algorithm: Any, decoded: Mapping[str, Any]) -> None:
    """The replay buffer fits the algorithm, and its arguments the buffer."""
    chosen, arguments = decoded.get("replay_buffer_class"), decoded.get("replay_buffer_kwargs")
    if getattr(chosen, "__name__", "") == "PrioritizedReplayBuffer" and not _is_ours(algorithm):
        raise ConfigError(f"replay_buffer_class: 'PrioritizedReplayBuffer' — {name} does not apply its importance weights")
    classes = [chosen] if chosen is not None else getattr(algorithm, "default_buffers", _SB3_BUFFERS)
    if arguments:
        known = {key for class_ in classes for key in argument_types(class_)} - _BUFFER_RESERVED
        owner = " or ".join(dict.fromkeys(class_.__name__ for class_ in classes))
        check_keys(arguments, known, "replay_buffer_kwargs key", owner)


def _check_quantiles(algorithm: Any, policy_class: Any, decoded: Mapping[str, Any]) -> None:
    """TQC keeps some of each critic's quantiles; from none it would learn nothing, without a word."""
    policy = {name: each.default for name, each in constructor_parameters(policy_class).items()}
    if "n_quantiles" in policy:
        name = "top_quantiles_to_drop_per_net"
        dropped = decoded.get(name, constructor_parameters(algorithm)[name].default)
        quantiles = {**policy, **(decoded.get("policy_kwargs") or {})}["n_quantiles"]
        if dropped >= quantiles:
            raise ConfigError(f"{name}: {dropped} — expected fewer than the n_quantiles of a critic, {quantiles}")


# ----------------------------------------------------------------------------------------------------------------------
# The whole
# ----------------------------------------------------------------------------------------------------------------------


def algorithm_arguments(
    name: str, algorithm: type[BaseAlgorithm], config: RunConfig, action_space: gym.Space
) -> dict[str, Any]:
    """
    Decode and check the algorithm's part of a configuration.

    :param name: the algorithm's name on the command line
    :param algorithm: its class
    :param config: the merged configuration
    :param action_space: action space of the environment, which sizes the exploration noise
    :return: keyword arguments for the constructor, ``policy`` included
    :raises ConfigError: for an unknown key or a wrong value
    """
    types = argument_types(algorithm)
    for key in config.arguments:
        if key in RESERVED:
            raise ConfigError(f"'{key}' is not a hyper-parameter — it is set on the command line")
    known = types.keys() - RESERVED
    check_keys(config.arguments, known | RunSettings.model_fields.keys(), "hyper-parameter", name)
    settings = config.settings
    if settings.policy not in algorithm.policy_aliases:
        near = suggestion(settings.policy, algorithm.policy_aliases)
        near = near or f" — expected one of {', '.join(algorithm.policy_aliases)}"
        raise ConfigError(f"policy: unknown policy '{settings.policy}' for {name}{near}")

    shape = action_space.shape
    assert shape is not None  # of a Box or a discrete space
    n_actions = shape[0] if len(shape) == 1 else shape
    plain_arguments = dict(config.arguments)
    if settings.noise_type is not None:
        if "action_noise" not in known:
            raise ConfigError(f"noise_type: {settings.noise_type!r} — {name} takes no action noise")
        if plain_arguments.get("action_noise") is not None:
            raise ConfigError(
                f"action_noise: beside it the configuration has noise_type {settings.noise_type!r} — "
                "expected action_noise: null, or noise_type: null and noise_std: null"
            )
        noise = {"normal": "NormalActionNoise", "ornstein-uhlenbeck": "OrnsteinUhlenbeckActionNoise"}[settings.noise_type]
        plain_arguments["action_noise"] = {noise: {"sigma": settings.noise_std}}

    decoded: dict[str, Any] = {}
    for key, plain in plain_arguments.items():
        value = plain
        if value is None:
            pass
        elif key == "policy_kwargs":
            decoded[key] = _policy_kwargs(value, algorithm.policy_aliases[settings.policy])
            continue
        elif key == "action_noise" and not (value == "default" and str in _alternatives(types[key])):
            value = _action_noise(value, n_actions, settings.n_envs)
        elif key in _CLASSES and key != "action_noise":
            value = _named_classes(key, value)
        elif _takes_schedule(types[key]):
            value = _schedule(key, value)
        decoded[key] = _typed(key, plain, value, types[key], 0)
    if not _is_ours(algorithm):
        _check_words(decoded)
    train_freq = decoded.get("train_freq")
    if isinstance(train_freq, tuple) and train_freq[1] == "episode" and settings.n_envs > 1:
        raise ConfigError(f"train_freq: {list(train_freq)!r} — expected steps where n_envs is {settings.n_envs}")
    _check_replay(name, algorithm, decoded)
    _check_quantiles(algorithm, algorithm.policy_aliases[settings.policy], decoded)
    return {"policy": settings.policy, **decoded}
