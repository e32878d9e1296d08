"""
What a run is made of: options of the command line, YAML read safely, and the merged, validated settings.

No string is ever evaluated and no YAML tag builds an object, so a configuration from a stranger is harmless. Whatever
is wrong in it ends in one :class:`ConfigError` with the key, the value and what was expected. The keys that belong to
the algorithm's constructor are checked in :mod:`sb3_symphony.experiment.decode`; this module imports neither torch nor
Stable-Baselines3.
"""

import ast
import difflib
import re
from collections.abc import Iterable, Mapping
from copy import deepcopy
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import yaml
from pydantic import AfterValidator, BaseModel, BeforeValidator, Field, FiniteFloat, ValidationError

from sb3_symphony.common.checks import suggestion
from sb3_symphony.common.plain_yaml import PlainLoader
from sb3_symphony.experiment.registry import ALGORITHMS, is_file, without_module


class ConfigError(ValueError):
    """A user's mistake, told in one line."""

    def __init__(self, message: str) -> None:
        super().__init__(" ".join(message.split()))


def told(error: Exception) -> str:
    """
    :param error: what went wrong in somebody else's code
    :return: its kind and message
    """
    return f"{type(error).__name__}: {error}" if str(error) else type(error).__name__


def reason(error: Exception) -> str:
    """
    :param error: what went wrong in somebody else's code
    :return: its message; with its kind where that alone says little, as of a ``KeyError``
    """
    speaks = isinstance(error, ValueError | TypeError | AssertionError | MemoryError) and str(error)
    return str(error) if speaks else told(error)


# ----------------------------------------------------------------------------------------------------------------------
# Reading
# ----------------------------------------------------------------------------------------------------------------------


def parse_yaml(text: str, origin: str) -> Any:
    """
    Read YAML made of plain values.

    :param text: YAML
    :param origin: where it comes from, for messages
    :return: mappings, lists, text, numbers, true/false, null
    :raises ConfigError: if it is damaged or holds tags that build objects
    """
    try:
        return yaml.load(text, Loader=PlainLoader)
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        line = f", line {mark.line + 1}" if mark else ""
        if isinstance(error, yaml.constructor.ConstructorError) and "constructor for the tag" in str(error.problem):
            tag = str(error.problem).rpartition("tag ")[2].strip("'").replace("tag:yaml.org,2002:", "!!")
            raise ConfigError(f"{origin}{line}: tag '{tag}' refused — expected plain values and class names") from None
        raise ConfigError(f"{origin}{line}: not valid YAML — {error.problem or error.context}") from None
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise ConfigError(f"{origin}: not valid YAML — {error}") from None


def read_yaml(path: Path, what: str = "hyper-parameters") -> dict[str, Any]:
    """
    Read a YAML file that holds a mapping.

    :param path: the file
    :param what: what it describes, for messages
    :return: the mapping
    :raises ConfigError: if it cannot be read, is damaged, or is something else
    """
    try:
        content = parse_yaml(path.read_text(encoding="utf-8"), str(path))
    except FileNotFoundError:
        raise ConfigError(f"{path}: no such file — expected a YAML file of {what}") from None
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read — {error.strerror}") from None
    except UnicodeDecodeError:
        raise ConfigError(f"{path}: not a text file — expected a YAML file of {what}") from None
    if not isinstance(content, dict) or not all(isinstance(key, str) for key in content):
        raise ConfigError(f"{path}: expected a mapping of names to values")
    return content


def parse_pairs(pairs: list[str], flag: str) -> dict[str, Any]:
    """
    Read the ``key:value`` pairs of a flag; values are YAML (``learning_rate:1e-3 policy_kwargs:"{net_arch: [64]}"``).

    :param pairs: as given on the command line
    :param flag: the flag, for messages
    :return: keys and plain values
    """
    values: dict[str, Any] = {}
    for pair in pairs:
        key, colon, value = pair.partition(":")
        if not (key and colon):
            raise ConfigError(f"{flag}: '{pair}' — expected key:value, such as learning_rate:1e-3")
        key = key.strip()
        if key in values:
            raise ConfigError(f"{flag}: {key} is given twice, {values[key]!r} and {value} — expected one of them")
        values[key] = parse_yaml(value, f"{flag} {key}")
    return values


def _plain_expression(node: ast.AST, text: str) -> Any:
    match node:
        case ast.Constant(value=value) if value is None or isinstance(value, bool | int | float | str):
            return value
        case ast.UnaryOp(op=ast.USub(), operand=ast.Constant(value=value)) if isinstance(value, int | float):
            return -value
        case ast.List(elts=elements) | ast.Tuple(elts=elements):
            return [_plain_expression(element, text) for element in elements]
        case ast.Dict(keys=keys, values=values) if None not in keys:
            plain = [_plain_expression(part, text) for part in (*keys, *values) if part]
            return dict(zip(plain[: len(keys)], plain[len(keys) :], strict=True))
        case ast.Call(func=ast.Name(id="dict"), args=[], keywords=keywords) if all(word.arg for word in keywords):
            return {str(word.arg): _plain_expression(word.value, text) for word in keywords}
        case ast.Name() | ast.Attribute():
            return ast.unparse(node)  # a class name, looked up in an allow-list later
    raise ConfigError(f"'{text}' — expected a mapping, or dict(...) of plain values and class names")


def parse_expression(text: str) -> Any:
    """
    Read the notation of RL Zoo files, ``"dict(net_arch=[64, 64], activation_fn=nn.ReLU)"``, without evaluating it.

    :param text: the expression
    :return: plain values; class names stay names
    :raises ConfigError: for anything but literals, ``dict(...)`` and names
    """
    try:
        return _plain_expression(ast.parse(text.strip(), mode="eval").body, text)
    except (SyntaxError, ValueError, TypeError, RecursionError) as error:
        if isinstance(error, ConfigError):
            raise
        raise ConfigError(f"'{text}' — expected a mapping, or dict(...) of plain values and class names") from None


def shipped_folder(name: str = "hyperparams") -> Path:
    """
    :param name: folder of files that come with the package, by default the YAML files
    :return: its path: inside the package when installed, beside it in a checkout
    """
    package = Path(__file__).resolve().parents[1]
    installed = package / name
    return installed if installed.is_dir() else package.parent / name


def shipped_file(name: str) -> Path | None:
    """
    :param name: name of a preset, or of an algorithm
    :return: its shipped YAML file, None if there is none
    """
    places = (shipped_folder() / "presets" / f"{name}.yml", shipped_folder() / f"{name}.yml")
    return next((path for path in places if path.is_file()), None)


def shipped_environments(algo: str) -> list[str]:
    """
    :param algo: name of an algorithm
    :return: environments that have an entry in its shipped file
    """
    return [env for env in read_yaml(shipped_folder() / f"{algo}.yml") if env != "default"]


# ----------------------------------------------------------------------------------------------------------------------
# Options of the command line
# ----------------------------------------------------------------------------------------------------------------------


def _not_zero(value: int) -> int:
    if value == 0:
        raise ValueError("expected a whole number greater than 0")
    return value


NotZero = AfterValidator(_not_zero)

#: number of threads, -1: PyTorch's choice; PyTorch dies of far too many
Threads = Annotated[int, Field(ge=-1, le=1024)]


class TrainOptions(BaseModel, extra="forbid", frozen=True):
    """Options of ``sb3-symphony train``; their meaning is in its ``--help``."""

    algo: str = "symphony"
    env: str = "BipedalWalker-v3"
    n_timesteps: Annotated[int, NotZero] = Field(default=-1, ge=-1)
    seed: int = Field(default=-1, ge=-1, lt=2**31)
    log_folder: str = "logs"
    eval_freq: int = Field(default=10_000, ge=-1)
    eval_episodes: int = Field(default=10, ge=1)
    protocol: Literal["standard"] | None = None
    threshold: FiniteFloat | None = None
    hyperparams: dict[str, Any] = {}
    conf_file: str | None = None
    env_kwargs: dict[str, Any] = {}
    tensorboard_log: str = ""
    save_freq: int = Field(default=-1, ge=-1)
    keep: int = Field(default=2, ge=1)
    resume: str | None = None
    trained_agent: str | None = None
    with_replay_buffer: bool = False
    gym_packages: list[str] = []
    vec_env: Literal["dummy", "subproc"] = "dummy"
    eval_env_kwargs: dict[str, Any] = {}
    n_seeds: int = Field(default=1, ge=1, lt=2**31)
    device: str = "auto"
    num_threads: Threads = -1
    log_interval: Annotated[int, NotZero] = Field(default=-1, ge=-2)
    verbose: int | None = Field(default=None, ge=0, le=2)
    progress: bool | None = None
    quiet: bool = False
    json_file: str | None = None


# ----------------------------------------------------------------------------------------------------------------------
# Settings of a run
# ----------------------------------------------------------------------------------------------------------------------


def _named_list(value: Any) -> Any:
    """Zoo's forms of wrappers and callbacks (name, {name: arguments}, a list of both) as one list of (name, arguments)."""
    if value is None:
        return []
    items: list[tuple[str, dict[str, Any]]] = []
    for item in value if isinstance(value, list) else [value]:
        if isinstance(item, str):
            items.append((item, {}))
        elif isinstance(item, dict) and all(isinstance(v, dict | None) for v in item.values()):
            items += [(name, arguments or {}) for name, arguments in item.items()]
        elif isinstance(item, list | tuple) and [type(part) for part in item] == [str, dict]:  # as this function returns it
            items.append((item[0], item[1]))
        else:
            raise ValueError("expected a dotted name, {name: {argument: value}}, or a list of these")
    return items


#: wrappers or callbacks with their arguments
NamedList = Annotated[list[tuple[str, dict[str, Any]]], BeforeValidator(_named_list)]


def _no_boolean(value: Any) -> Any:
    if isinstance(value, bool):
        raise ValueError("expected a whole number")
    return value


#: a whole number from 1 on
Count = Annotated[int, BeforeValidator(_no_boolean), Field(ge=1)]
#: a whole number from 0 on
Whole = Annotated[int, BeforeValidator(_no_boolean), Field(ge=0)]


class RunSettings(BaseModel, extra="forbid"):
    """
    Keys of a configuration that are about the run; all others belong to the algorithm's constructor.

    :param n_timesteps: length of the training, in environment steps
    :param policy: name of a policy of the algorithm, such as ``MlpPolicy``
    :param n_envs: number of parallel environments
    :param normalize: ``VecNormalize`` with its defaults, or its arguments
    :param env_wrapper: dotted names of wrappers and their arguments, from the inside out
    :param vec_env_wrapper: the same for wrappers of the vectorised environment, inside ``VecNormalize``
    :param env_kwargs: arguments of the environment
    :param frame_stack: number of latest observations that the agent sees at once, by ``VecFrameStack``
    :param callback: names of callbacks and their arguments
    :param noise_type: exploration noise of Stable-Baselines3, by Zoo's names
    :param noise_std: its standard deviation, in scaled action units
    :param stop_reward: mean return of an evaluation that ends the training
    """

    n_timesteps: Count
    policy: str = "MlpPolicy"
    n_envs: Count = 1
    normalize: bool | dict[str, Any] = False
    env_wrapper: NamedList = []
    vec_env_wrapper: NamedList = []
    callback: NamedList = []
    env_kwargs: dict[str, Any] = {}
    frame_stack: Count | None = None
    noise_type: Literal["normal", "ornstein-uhlenbeck"] | None = None
    noise_std: Annotated[FiniteFloat, Field(ge=0)] | None = None
    stop_reward: FiniteFloat | None = None

    def varied(self, env_kwargs: dict[str, Any], env_wrapper: list[tuple[str, dict[str, Any]]]) -> "RunSettings":
        """
        :param env_kwargs: arguments of the environment that go before these
        :param env_wrapper: wrappers instead of those of the same names, else around them
        :return: the settings with them
        """
        given = dict(env_wrapper)
        wrappers = [(name, given.pop(name, arguments)) for name, arguments in self.env_wrapper]
        update = {"env_kwargs": {**self.env_kwargs, **env_kwargs}, "env_wrapper": [*wrappers, *given.items()]}
        return self.model_copy(update=update)


@dataclass
class RunConfig:
    """
    A merged configuration.

    :param settings: what concerns the run
    :param arguments: the algorithm's own keys, as plain values
    :param plain: everything as plain values, which ``config.yml`` holds and ``-conf`` reads back
    """

    settings: RunSettings
    arguments: dict[str, Any]
    plain: dict[str, Any]


def validated(model: type[BaseModel], values: dict[str, Any]) -> Any:
    """
    :param model: a pydantic model
    :param values: its fields
    :return: the model's instance
    :raises ConfigError: with the first field that is wrong
    """
    try:
        return model.model_validate(values)
    except ValidationError as error:
        # A key that is not known first: it may be the missing one, misspelt
        first = min(error.errors(), key=lambda each: each["type"] != "extra_forbidden" or len(each["loc"]) > 1)
        key = str(first["loc"][0]) if first["loc"] else model.__name__
        if first["type"] == "missing":
            raise ConfigError(f"{key}: missing — expected in the configuration") from None
        if first["type"] == "extra_forbidden":
            raise ConfigError(f"unknown option '{key}'{suggestion(key, model.model_fields)}") from None
        cause = first.get("ctx", {}).get("error")
        if isinstance(cause, ConfigError):  # from a part that is validated by itself
            raise ConfigError(f"{key}: {cause}" if first["loc"] else str(cause)) from None
        message = (
            first["msg"].removeprefix("Value error, ").partition(", unable to")[0].replace("Input should be", "expected", 1)
        )
        message = message.replace("String should have", "expected")
        signs = {"greater than or equal to": ">=", "greater than": ">", "less than or equal to": "<=", "less than": "<"}
        for words, sign in signs.items():
            message = message.replace(f"expected {words}", f"expected a number {sign}")
        message = message.replace("a valid integer", "a whole number").replace("a valid ", "a ")
        raise ConfigError(f"{key}: {values.get(key)!r} — {message}") from None


def check_algorithm(name: str, known: Iterable[str] = ALGORITHMS) -> None:
    """
    :param name: name of an algorithm
    :param known: those that can be meant, by default those that can be trained
    :raises ConfigError: if there is none of that name
    """
    if is_file(name):
        path = Path(name.rpartition(":")[0])
        if not path.is_file():
            raise ConfigError(f"unknown algorithm '{name}' — there is no file {path}")
    elif name not in known:
        near = suggestion(name, known) or f" — expected one of {', '.join(known)}"
        raise ConfigError(f"unknown algorithm '{name}'{near}")


def entry_name(content: Mapping[str, Any], env: str, path: Path) -> str | None:
    """
    :param content: content of a file with an entry for each environment, or with nothing but one
    :param env: environment
    :param path: the file, for messages
    :return: its entry, else ``default``; ``None``: the file has no entries
    :raises ConfigError: if it has others, or values stand beside that entry, which would not be used
    """
    name = next((name for name in (env, without_module(env), "default") if name in content), None)
    if name is None and _has_entries(content):
        raise ConfigError(f"{path}: no entry for '{env}'{suggestion(env, content)}")
    beside = [key for key, value in content.items() if name is not None and key != name and not isinstance(value, dict)]
    if beside:
        raise ConfigError(f"{path}: '{beside[0]}' stands beside the entry '{name}' — expected inside it")
    return name


def _has_entries(content: Mapping[str, Any]) -> bool:
    """Whether a file has entries of environments: keys as no hyper-parameter has, or all of them with settings below."""
    named = any(re.search(r"-v\d+$", str(key)) for key in content)
    return named or (bool(content) and all(isinstance(value, dict) and "n_timesteps" in value for value in content.values()))


def find_entry(options: TrainOptions) -> tuple[str, dict[str, Any]]:
    """
    Look up the environment's entry, else ``default``, in the given file or preset or the shipped file; a flat file is its own.

    :param options: options of the command line
    :return: where it stands, and the entry
    :raises ConfigError: if there is none, or the file cannot be read
    """
    path = Path(shipped_folder() / f"{options.algo}.yml" if options.conf_file is None else options.conf_file)
    if options.conf_file is None and is_file(options.algo):
        raise ConfigError(f"--conf-file: missing — expected settings for {options.algo}, such as the name of its parent, redq")
    try:
        if not path.is_file():
            path = shipped_file(str(path)) or path
    except OSError as error:
        raise ConfigError(f"-conf: '{path}' cannot be read — {error.strerror}") from None
    if not path.is_file() and not path.suffix and len(path.parts) == 1:
        presets = [file.stem for file in (*shipped_folder().glob("presets/*.yml"), *shipped_folder().glob("*.yml"))]
        near = suggestion(path, presets) or f" — expected a YAML file or one of {', '.join(sorted(presets))}"
        raise ConfigError(f"-conf: no such file or preset '{path}'{near}")
    content = read_yaml(path)
    name = entry_name(content, options.env, path)
    if name is not None:
        if not isinstance(content[name], dict):
            raise ConfigError(f"{path}: '{name}' — expected a mapping of hyper-parameters")
        return f"{path.name}, {name}" if options.conf_file is None else f"-conf {path}, {name}", content[name]
    return f"-conf {path}", with_env_kwargs(content, _arguments_of_run(path))


def whose(conf_file: str | None) -> dict[str, str]:
    """
    :param conf_file: value of ``-conf``
    :return: ``algo`` and ``env`` of the run whose ``config.yml`` that is, which does not hold them; of other files, nothing
    """
    return {name: value for name, value in _arguments_of_run(Path(conf_file or "")).items() if name in ("algo", "env")}


def _arguments_of_run(config: Path) -> dict[str, Any]:
    path = config.parent / "args.yml"
    return read_yaml(path) if config.name == "config.yml" and path.is_file() else {}


def is_zoo_run(arguments: dict[str, Any]) -> bool:
    """
    :param arguments: content of a run's ``args.yml``
    :return: whether they are not those of this package's ``train``
    """
    return "protocol" not in arguments


def with_env_kwargs(config: dict[str, Any], arguments: dict[str, Any]) -> dict[str, Any]:
    """
    :param config: content of a run's ``config.yml``
    :param arguments: content of its ``args.yml``, where alone RL Zoo keeps the arguments of the environment
    :return: the configuration with these
    :raises ConfigError: if they are no mapping
    """
    given = arguments.get("env_kwargs")
    if not given or not is_zoo_run(arguments):
        return config
    config = dict(config)
    _read_expressions(config)
    parts = [config.get("env_kwargs") or {}, given]
    for part in parts:
        if not isinstance(part, dict):
            raise ConfigError(f"env_kwargs: {part!r} — expected a mapping")
    return {**config, "env_kwargs": {**parts[0], **parts[1]}}


def _override(plain: dict[str, Any], key: str, value: Any) -> None:
    """``policy_kwargs.net_arch`` changes one item of a mapping, ``policy_kwargs`` replaces all of it."""
    *parents, last = key.split(".")
    for parent in parents:
        if plain.get(parent) is None:
            plain[parent] = {}
        plain = plain[parent]
        if not isinstance(plain, dict):
            raise ConfigError(f"-params: '{key}' — '{parent}' is not a mapping")
    plain[last] = value


def _read_expressions(plain: dict[str, Any]) -> None:
    for key in ("policy_kwargs", "replay_buffer_kwargs", "env_kwargs", "normalize"):
        if isinstance(plain.get(key), str):
            try:
                plain[key] = parse_expression(plain[key])
            except ConfigError as error:
                raise ConfigError(f"{key}: {error}") from None


def run_settings(content: dict[str, Any]) -> RunSettings:
    """
    Take what is about the run from a configuration, such as the ``config.yml`` of a run folder.

    :param content: plain values, the algorithm's keys among them
    :return: the run's settings
    :raises ConfigError: if one of them is wrong
    """
    plain = {key: value for key, value in content.items() if key in RunSettings.model_fields and value is not None}
    misspelt = [] if "n_timesteps" in plain else difflib.get_close_matches("n_timesteps", map(str, content), n=1)
    if misspelt:
        raise ConfigError(f"unknown hyper-parameter '{misspelt[0]}': did you mean 'n_timesteps'?")
    _read_expressions(plain)
    settings = validated(RunSettings, plain)
    if (settings.noise_type is None) != (settings.noise_std is None):
        raise ConfigError("noise_type and noise_std: expected both or neither")
    return settings


def load_config(options: TrainOptions, inherited: Mapping[str, Any] | None = None) -> RunConfig:
    """
    Merge the shipped entry (or the given file instead of it) with the command line, later ones winning.

    :param options: options of the command line
    :param inherited: values that go before those of the file, such as the networks of an agent to start from; None: a key of
        the file is left out
    :return: the configuration, of which the algorithm's keys are yet to be checked
    :raises ConfigError: if a file or a key of the run is wrong
    """
    check_algorithm(options.algo)
    _, entry = find_entry(options)
    inherited = inherited or {}
    plain = {key: value for key, value in {**entry, **inherited}.items() if value is not None or key not in inherited}
    return merge(plain, options)


#: what settles the networks of an agent and what they are given
_NETWORKS = ("policy", "policy_kwargs", "n_critics", "use_sde", "normalize", "frame_stack")


def of_networks(config: dict[str, Any]) -> dict[str, Any]:
    """
    :param config: configuration of a run
    :return: the keys that its networks depend on, which an agent that starts from them has to share; None for what it had by
        default
    """
    return {key: config.get(key) for key in _NETWORKS}


def merge(entry: dict[str, Any], options: TrainOptions) -> RunConfig:
    """
    Merge an entry of a file with the command line, later ones winning.

    :param entry: plain values
    :param options: options of the command line
    :return: the configuration, of which the algorithm's keys are yet to be checked
    :raises ConfigError: if a key of the run is wrong
    """
    plain = deepcopy(entry)
    _read_expressions(plain)  # before, so that items of them can be overridden
    for key, value in options.hyperparams.items():
        _override(plain, key, value)
    _read_expressions(plain)
    if options.n_timesteps > 0:
        plain["n_timesteps"] = options.n_timesteps
    if options.env_kwargs:
        plain["env_kwargs"] = {**(plain.get("env_kwargs") or {}), **options.env_kwargs}
    plain = {key: value for key, value in plain.items() if not (value is None and key in RunSettings.model_fields)}
    settings = run_settings(plain)
    plain["n_timesteps"] = settings.n_timesteps
    arguments = {key: value for key, value in plain.items() if key not in RunSettings.model_fields}
    return RunConfig(settings, arguments, plain)
