"""Training that starts from a trained agent: ``train -i``."""

import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.save_util import load_from_pkl, recursive_getattr
from stable_baselines3.common.utils import set_random_seed
from stable_baselines3.common.vec_env import unwrap_vec_normalize

from sb3_symphony.common.averaging import AveragedActor
from sb3_symphony.common.checkpoint import newest_checkpoint
from sb3_symphony.common.checks import last_line
from sb3_symphony.common.files import DamagedFile
from sb3_symphony.common.replay_files import ReplaySegments, add_transitions
from sb3_symphony.experiment.agent import check_finite, check_match, load_model, load_normalization
from sb3_symphony.experiment.config import ConfigError, TrainOptions, of_networks, read_yaml, told
from sb3_symphony.experiment.run_folder import RunFolder
from sb3_symphony.experiment.select import Selection, SelectOptions, select_model


def find_trained(options: TrainOptions) -> Selection:
    """
    :param options: options of the command line, ``trained_agent`` among them
    :return: the agent to start from
    :raises ConfigError: if there is none, or another algorithm trained it
    """
    wanted = SelectOptions(model=options.trained_agent, algo=options.algo, env=options.env)
    try:
        return select_model(wanted)
    except ConfigError as error:
        raise ConfigError(f"-i: {str(error).removeprefix('--model: ').partition(' — see --')[0]}") from None


def inherited(selection: Selection) -> dict[str, Any]:
    """
    :param selection: the agent to start from
    :return: keys of its run's configuration that its networks depend on; none for a file outside a run folder
    """
    if selection.run is None:
        return {}
    (path,) = sorted(selection.run.glob("*/config.yml"))[:1]
    return of_networks(read_yaml(path))


def start_from(model: BaseAlgorithm, selection: Selection, with_replay_buffer: bool) -> None:
    """
    Give a new model weights, optimiser states and statistics of ``VecNormalize`` of a trained one, and its experience if
    wanted. Counters and schedules start anew; learning rates and other settings are the configuration's.

    :param model: a new model with its environment
    :param selection: the agent to start from
    :param with_replay_buffer: whether its replay buffer is taken over
    :raises ConfigError: if spaces or networks differ, or something is missing or damaged
    """
    env = model.get_env()
    assert env is not None
    normalization = unwrap_vec_normalize(env)
    unknown = ConfigError(
        f"-i: {selection.model}: its statistics of VecNormalize are not known — expected it in its run folder"
    )
    if normalization is not None and selection.normalization is None:
        raise unknown
    try:
        trained = load_model(selection, str(model.device))
    except ConfigError as error:
        if "--vecnormalize" in str(error):  # a flag of other commands
            raise unknown from None
        raise ConfigError(f"-i: {error}") from None
    check_finite(trained, f"-i: {selection.model}")
    check_match(trained, env, str(selection.model), selection.env_id)
    _take_networks(model, trained, str(selection.model))
    assert model.seed is not None
    set_random_seed(model.seed)  # loading has left the trained one's
    if normalization is not None and selection.normalization is not None:
        stored = load_normalization(selection.normalization, normalization.venv)
        if normalization.norm_obs and not stored.norm_obs:
            raise ConfigError(f"-i: {selection.model}: was trained without norm_obs — expected normalize: {{norm_obs: false}}")
        for name in ("obs_rms", "ret_rms"):
            if name in vars(stored):
                setattr(normalization, name, getattr(stored, name))
    if with_replay_buffer:
        _take_experience(model, selection)


def check_source(model: BaseAlgorithm, source: BaseAlgorithm, name: str, with_replay_buffer: bool) -> None:
    """
    See whether a model can start from another one, which is yet to be trained.

    :param model: a new model with its environment
    :param source: another new model with its environment; the first one gets its weights
    :param name: what the other one is called
    :param with_replay_buffer: whether its replay buffer is to be taken over
    :raises ConfigError: if it cannot
    """
    env, theirs = model.get_env(), source.get_env()
    assert env is not None and theirs is not None
    if unwrap_vec_normalize(env) is not None and unwrap_vec_normalize(theirs) is None:
        raise ConfigError(f"start_from: {name} has no statistics of VecNormalize — expected normalize for both or for neither")
    check_match(source, env, name, "the environment")
    _take_networks(model, source, name)
    if with_replay_buffer:
        buffer = _replay_buffer_of(model)
        try:
            add_transitions(buffer, [ReplaySegments.of(_replay_buffer_of(source))])
        except (ValueError, TypeError) as error:
            raise ConfigError(f"start_from: replay_buffer: {name} — {error}") from None


def _take_networks(model: BaseAlgorithm, trained: BaseAlgorithm, origin: str) -> None:
    given, (names, tensors) = trained.get_parameters(), model._get_torch_save_params()
    try:
        for name in names:
            target = recursive_getattr(model, name)
            if isinstance(target, th.optim.Optimizer):
                if name not in given:  # such as that of an entropy coefficient that was fixed
                    continue
                settings = [{k: v for k, v in group.items() if k != "params"} for group in target.param_groups]
                target.load_state_dict(given[name])
                for group, own in zip(target.param_groups, settings, strict=True):
                    group.update(own)
            else:
                target.load_state_dict(given[name], strict=True)
    except (RuntimeError, ValueError, KeyError) as error:
        raise ConfigError(
            f"-i: networks of {origin} (policy_kwargs {trained.policy_kwargs}) do not fit the configuration's "
            f"({model.policy_kwargs}) — {last_line(error)}"
        ) from None
    if isinstance(model.policy, AveragedActor):
        model.policy.restart_average()  # its count of updates came along
    known = set(trained._get_torch_save_params()[1]) - {"ent_coef_tensor"}  # SAC's, which the configuration fixes
    for name in known & set(tensors):
        recursive_getattr(model, name).data.copy_(recursive_getattr(trained, name))


# ----------------------------------------------------------------------------------------------------------------------
# Experience
# ----------------------------------------------------------------------------------------------------------------------


def _replay_buffer_of(model: BaseAlgorithm) -> ReplayBuffer:
    buffer = getattr(model, "replay_buffer", None)
    if not isinstance(buffer, ReplayBuffer):
        raise ConfigError(f"--with-replay-buffer: {type(model).__name__} has no replay buffer")
    return buffer


def _take_experience(model: BaseAlgorithm, selection: Selection) -> None:
    buffer = _replay_buffer_of(model)
    parts, source = _experience(selection)
    try:
        taken = add_transitions(buffer, parts)
    except DamagedFile as error:
        raise ConfigError(f"--with-replay-buffer: {source}: {error}") from None
    except (ValueError, TypeError) as error:
        raise ConfigError(f"--with-replay-buffer: {source} — {error}") from None
    if not taken:
        raise ConfigError(f"--with-replay-buffer: {source} is empty")


def _experience(selection: Selection) -> tuple[Iterator[dict[str, np.ndarray]], Path]:
    """Transitions of a run's newest checkpoint, or of a buffer that SB3 or RL Zoo saved beside the model."""
    pickled = selection.model.with_name("replay_buffer.pkl")
    if selection.run is not None and not pickled.is_file():
        run = RunFolder(selection.run, "")
        try:
            checkpoint = newest_checkpoint(run.checkpoints)
        except DamagedFile as error:
            raise ConfigError(f"--with-replay-buffer: {run.checkpoints} — {error}") from None
        if checkpoint is not None:
            return ReplaySegments(run.checkpoints, checkpoint.state["segments"]).transitions(), run.checkpoints
    if not pickled.is_file():
        raise ConfigError(
            f"--with-replay-buffer: {selection.model.parent} has neither checkpoints (`train --save-freq`) nor {pickled.name}"
        )
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)  # of old pickles
            stored = load_from_pkl(pickled)
        assert isinstance(stored, ReplayBuffer), f"a {type(stored).__name__}"
    except Exception as error:  # a pickle can fail in any way
        raise ConfigError(f"{pickled}: not a replay buffer of SB3, or damaged — {told(error)}") from error
    return iter([ReplaySegments.of(stored)]), pickled
