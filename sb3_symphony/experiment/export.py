"""A trained actor as an ONNX file: from a raw observation to an action in the environment's units, without SB3 or torch."""

import io
import warnings
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.vec_env import VecNormalize, VecTransposeImage, unwrap_vec_normalize, unwrap_vec_wrapper
from torch import nn

from sb3_symphony.experiment.agent import Agent, check_device, check_finite, open_agent
from sb3_symphony.experiment.config import ConfigError
from sb3_symphony.experiment.output import output_file, write_output
from sb3_symphony.experiment.select import ExportOptions

#: observations that the file is checked on
N_OBSERVATIONS = 1000
#: largest difference of an action, as a share of half its range or, where that is less, of 1
TOLERANCE = 1e-5


class DeployedActor(nn.Module):
    """
    What ``predict(deterministic=True)`` does around a policy's network, as one module.

    :param policy: policy with continuous actions
    :param normalization: statistics of the observations, None without
    :param transposes: whether observations are images with their channels last, which the policy wants first
    """

    low: th.Tensor
    high: th.Tensor
    mean: th.Tensor
    std: th.Tensor

    def __init__(self, policy: BasePolicy, normalization: VecNormalize | None, transposes: bool = False) -> None:
        super().__init__()
        self.transposes = transposes
        space = policy.action_space
        assert isinstance(space, spaces.Box)
        self.policy = policy
        self.register_buffer("low", th.as_tensor(space.low, dtype=th.float32))
        self.register_buffer("high", th.as_tensor(space.high, dtype=th.float32))
        self.clip = None
        if normalization is not None and normalization.norm_obs:
            statistics = normalization.obs_rms
            assert isinstance(statistics, RunningMeanStd)  # of an array, not of a Dict
            self.clip = float(normalization.clip_obs)
            self.register_buffer("mean", th.as_tensor(statistics.mean))  # float64, as in VecNormalize
            self.register_buffer("std", th.as_tensor(np.sqrt(statistics.var + normalization.epsilon)))

    def forward(self, observation: th.Tensor) -> th.Tensor:
        """
        :param observation: raw observations, shape ``(batch, *observation_shape)``
        :return: actions in the environment's units, shape ``(batch, *action_shape)``
        """
        if self.clip is not None:
            observation = ((observation - self.mean) / self.std).clip(-self.clip, self.clip).float()
        if self.transposes:
            observation = observation.permute(0, 3, 1, 2)
        action = self.policy._predict(observation, deterministic=True).reshape(-1, *self.low.shape)
        if self.policy.squash_output:
            return self.low + 0.5 * (action + 1.0) * (self.high - self.low)
        return th.max(th.min(action, self.high), self.low)


@dataclass(frozen=True)
class Export:
    """
    An exported actor.

    :param path: ONNX file, with one input ``observation`` and one output ``action``, batches first
    :param difference: largest difference from ``predict`` on observations of played episodes, in the actions' units
    """

    path: Path
    difference: float

    def __str__(self) -> str:
        size = self.path.stat().st_size / 1000
        same = f"equal to predict on {N_OBSERVATIONS} observations (largest difference {self.difference:.1e})"
        return f"saved {self.path} ({size:.0f} kB), {same}"


def export(options: ExportOptions) -> Export:
    """
    Write a trained actor as ONNX, once the file's actions were found equal to those of ``predict``.

    :param options: which agent, and where to write it
    :return: the file
    :raises ConfigError: if something is missing or damaged, the agent cannot be exported, or the file not be written
    """
    try:
        for package in ("onnx", "onnxruntime"):
            import_module(package)
    except ImportError as error:
        message = f'{error.name} is not installed: pip install "sb3-symphony[export]"'
        raise ConfigError(message) from None
    check_device(options.device)  # though tracing goes on on the CPU
    with open_agent(options.model_copy(update={"device": "cpu"})) as agent:
        path = output_file(options.output or agent.selection.beside(".onnx"), "--output", (".onnx",))
        _check_exportable(agent)
        transposes = _transposition(agent) is not None
        content = onnx_model(agent.model, _raw_space(agent), _normalization(agent), _properties(agent), transposes)
        difference = _difference(content, agent)
    write_output(path, content, "--output")
    return Export(path, difference)


def onnx_model(
    model: BaseAlgorithm,
    space: spaces.Box,
    normalization: VecNormalize | None,
    properties: dict[str, str] | None = None,
    transposes: bool = False,
) -> bytes:
    """
    :param model: model with an array observation and continuous actions, on the CPU
    :param space: raw observations, before they are normalised and transposed
    :param normalization: statistics of the observations, None without
    :param properties: what the file is to say about itself
    :param transposes: whether observations are images with their channels last, which the policy wants first
    :return: its actor in ONNX format
    """
    import onnx

    actor = DeployedActor(model.policy, normalization, transposes).eval()
    model.policy.set_training_mode(False)
    example = th.as_tensor(np.zeros((1, *space.shape), dtype=space.dtype))
    batch = {0: "batch"}
    content = io.BytesIO()
    with th.no_grad(), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # about checks of shapes that tracing makes constant, as they are
        th.onnx.export(
            actor,
            (example,),
            content,  # type: ignore[arg-type]  # the annotation is that of the other exporter
            input_names=["observation"],
            output_names=["action"],
            dynamic_axes={"observation": batch, "action": batch},
            dynamo=False,  # the exporter by torch.export does not take SB3's distributions
        )
    result = onnx.load_model_from_string(content.getvalue())
    onnx.helper.set_model_props(result, properties or {})
    onnx.checker.check_model(result)
    return result.SerializeToString()


def _transposition(agent: Agent) -> VecTransposeImage | None:
    """What puts the channels of images first, None if the environment does or has no images."""
    return unwrap_vec_wrapper(agent.env, VecTransposeImage)


def _normalization(agent: Agent) -> VecNormalize | None:
    """What normalises the observations; rewards alone do not concern an actor."""
    normalization = unwrap_vec_normalize(agent.env)
    return normalization if normalization is not None and normalization.norm_obs else None


def _check_exportable(agent: Agent) -> None:
    selection, model = agent.selection, agent.model
    check_finite(model, str(selection.model))
    if not isinstance(model.action_space, spaces.Box):
        raise ConfigError(f"{selection.model}: its actions are {model.action_space} — expected continuous ones (Box)")
    if not isinstance(model.observation_space, spaces.Box):
        raise ConfigError(f"{selection.model}: its observations are {model.observation_space} — expected an array (Box)")
    if selection.algo == "ppo_lstm":
        raise ConfigError(f"{selection.model}: a recurrent policy keeps a state between steps — expected one without")
    if _normalization(agent) is not None and selection.settings.frame_stack is not None:
        raise ConfigError(f"{selection.model}: stacks normalised observations — expected no frame_stack, or no normalize")


def _raw_space(agent: Agent) -> spaces.Box:
    """Observations below ``VecNormalize``, which makes images real numbers, and ``VecTransposeImage``, around it."""
    outer = _normalization(agent) or _transposition(agent)
    space = agent.model.observation_space if outer is None else outer.venv.observation_space
    assert isinstance(space, spaces.Box)
    return space


def _properties(agent: Agent) -> dict[str, str]:
    return {
        "algorithm": agent.selection.algo,
        "environment": agent.selection.env_id,
        "observation_space": str(_raw_space(agent)),
        "action_space": str(agent.model.action_space),
    }


def _raw_observations(agent: Agent) -> np.ndarray:
    """Observations of played episodes before normalisation, shape ``(N_OBSERVATIONS, *observation_shape)``."""
    normalization, transposed = _normalization(agent), _transposition(agent) is not None
    found: list[np.ndarray] = []
    seed = 0
    while True:
        for step in agent.episode(seed, deterministic=False):  # for variety
            if normalization is not None:
                found.append(np.asarray(normalization.get_original_obs())[0])
            else:
                observation = np.asarray(step.observation)
                found.append(np.moveaxis(observation, 0, -1) if transposed else observation)
            if len(found) == N_OBSERVATIONS:  # in the middle of an episode, which may have no end
                return np.stack(found)
        seed += 1


def _difference(content: bytes, agent: Agent) -> float:
    import onnxruntime

    raw = _raw_observations(agent)
    normalization = _normalization(agent)
    seen = raw if normalization is None else normalization.normalize_obs(raw)
    if _transposition(agent) is not None:
        seen = np.moveaxis(np.asarray(seen), -1, 1)
    expected, _ = agent.model.predict(seen, deterministic=True)
    session = onnxruntime.InferenceSession(content, providers=["CPUExecutionProvider"])
    given = session.run(None, {"observation": raw})[0]
    space = agent.model.action_space
    assert isinstance(space, spaces.Box)
    errors = np.abs(given - expected)
    if not (errors <= TOLERANCE * np.maximum((space.high - space.low) / 2, 1.0)).all():
        raise RuntimeError(f"the exported actor differs from predict by {errors.max():.2e}, nothing was written")
    return float(errors.max())
