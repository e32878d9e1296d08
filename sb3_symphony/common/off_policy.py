"""What Symphony and REDQ share: everything that SB3 expects of an off-policy algorithm with an ensemble of critics."""

import inspect
import io
import math
import pathlib
import warnings
from abc import abstractmethod
from collections import defaultdict, deque
from collections.abc import Hashable, Iterator
from typing import Any, ClassVar, TypeVar

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import DictReplayBuffer, NStepReplayBuffer, ReplayBuffer
from stable_baselines3.common.noise import ActionNoise, VectorizedActionNoise
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.preprocessing import get_flattened_obs_dim
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, ReplayBufferSamples, RolloutReturn, TrainFreq
from stable_baselines3.common.utils import get_parameters_by_name
from stable_baselines3.her.her_replay_buffer import HerReplayBuffer

from sb3_symphony.common.buffers import (
    FadedSampling,
    FadingDictReplayBuffer,
    FadingReplayBuffer,
    PrioritizedReplayBuffer,
    check_mirror,
    end_trajectory,
)
from sb3_symphony.common.checks import check_choice, check_number, constructor_parameters, suggestion
from sb3_symphony.common.cuda_graphs import CudaGraphs, recorded_state
from sb3_symphony.common.ensembles import TARGET_MODES, EnsembleCritic
from sb3_symphony.common.losses import CLASSIFICATION, CRITIC_LOSSES
from sb3_symphony.common.noise import DecayingActionNoise
from sb3_symphony.common.regression import make_regression

SelfEnsemble = TypeVar("SelfEnsemble", bound="EnsembleOffPolicyAlgorithm")
MAX_SAMPLE_BYTES = 2**26  # of observations drawn at once: vectors need one draw per call of train(), images several
MAX_SEGMENT_ROWS = 1024  # of next actions computed at once: activations that fit the cache, not fresh pages of memory
# Rows of their samples are drawn alike, so one draw may serve several updates. Not so hindsight's (those with their real goal
# come first), priorities (which change with every update) and what users derive, perhaps to mix sources within a minibatch
DRAWN_AT_ONCE = (ReplayBuffer, DictReplayBuffer, NStepReplayBuffer, FadingReplayBuffer, FadingDictReplayBuffer)


#: log key (without ``train/``) to tensors of one shape, one for each of the latest updates of a ``train()`` call
UpdateLogs = defaultdict[str, deque[th.Tensor]]


def update_logs() -> UpdateLogs:
    """:return: empty logs, of at most 1 000 updates: those of a long call, on recorded data, would fill the memory"""
    return defaultdict(lambda: deque(maxlen=1000))


class ActsGreedily(OffPolicyAlgorithm):
    """
    Mixin, in front of an off-policy algorithm of SB3: environments named in ``greedy_envs`` get the action that an evaluation
    would take, without noise. :class:`~sb3_symphony.common.callbacks.GreedyEpisodes` says which, and when.
    """

    greedy_envs: np.ndarray | None = None  # bool (n_envs,); None: none of them
    resets_envs = True  # whether the latest learn() began with new episodes, or went on in those of the one before

    def _setup_learn(
        self, total_timesteps: int, callback: MaybeCallback = None, reset_num_timesteps: bool = True, *args: Any, **kwargs: Any
    ) -> Any:
        self.greedy_envs = None  # of an earlier learn(), whose callback may not be there any more
        self.resets_envs = reset_num_timesteps or self._last_obs is None  # as SB3 decides it; some return the same array again
        return super()._setup_learn(total_timesteps, callback, reset_num_timesteps, *args, **kwargs)

    def _sample_action(
        self, learning_starts: int, action_noise: ActionNoise | None = None, n_envs: int = 1
    ) -> tuple[np.ndarray, np.ndarray]:
        action, buffer_action = super()._sample_action(learning_starts, action_noise, n_envs)  # the noise's clock goes on
        if self.greedy_envs is None or not self.greedy_envs.any():
            return action, buffer_action
        assert self._last_obs is not None
        greedy, _ = self.predict(self._last_obs, deterministic=True)
        action[self.greedy_envs] = greedy[self.greedy_envs]
        scaled = self.policy.scale_action(greedy) if isinstance(self.action_space, spaces.Box) else greedy
        buffer_action[self.greedy_envs] = scaled[self.greedy_envs]
        return action, buffer_action


class EnsembleOffPolicyAlgorithm(ActsGreedily):
    """
    Base class of Symphony and REDQ. Its arguments are those of SB3's ``OffPolicyAlgorithm``.

    :param n_critics: Number of critics; may be given in ``policy_kwargs`` instead (the default here counts as not given)
    :param policy_delay: Critic updates per actor update
    :param target_mode: How the target combines the critics: ``"min"``, ``"mean"`` or ``"rem"``
    :param critic_loss: Error function, see :data:`sb3_symphony.common.losses.CRITIC_LOSSES`; ``"hl_gauss"`` for critics that
        classify, whose ``policy_kwargs`` have a ``value_range``
    :param critic_reduction: ``"independent"`` (each critic meets the target) or ``"ensemble_mean"`` (their mean does)
    :raises ValueError: if an argument is out of range, or the action space no bounded Box
    :raises TypeError: if an argument has the wrong type
    """

    policy: Any  # SymphonyPolicy or REDQPolicy
    base_policy: ClassVar[type[BasePolicy]]  # what a policy class has to be derived from
    actor: Any  # of that policy
    critic: EnsembleCritic
    critic_target: EnsembleCritic
    # Buffers used without ``replay_buffer_class``: for Dict observations, for n-step returns, otherwise
    default_buffers: ClassVar[tuple[type[ReplayBuffer], type[ReplayBuffer], type[ReplayBuffer]]] = (
        DictReplayBuffer,
        NStepReplayBuffer,
        ReplayBuffer,
    )
    # What ``_learn_from`` reads, of a class whose updates on a GPU are recorded; classes derived from it have to say so anew
    recorded_attributes: ClassVar[tuple[str, ...]] = ()

    def __init__(
        self,
        *args: Any,
        n_critics: int,
        policy_delay: int,
        target_mode: str,
        critic_loss: str,
        critic_reduction: str = "independent",
        policy_kwargs: dict[str, Any] | None = None,
        **kwargs: Any,
    ) -> None:
        policy_kwargs = dict(policy_kwargs or {})  # the caller's own stays as it is
        signatures = (inspect.signature(base).parameters for base in type(self).__mro__)
        default = next(parameters["n_critics"].default for parameters in signatures if "n_critics" in parameters)
        in_policy = policy_kwargs.setdefault("n_critics", n_critics)
        if n_critics not in (default, in_policy):
            raise ValueError(f"n_critics={n_critics!r}, but policy_kwargs has n_critics={in_policy!r}: give one of them")
        kwargs.update(policy_kwargs=policy_kwargs, supported_action_spaces=(spaces.Box,), support_multi_env=True)
        try:
            super().__init__(*args, **kwargs)
        except AssertionError as error:  # SB3 asserts what is a user's error: the kind of the action space
            raise ValueError(str(error)) from error
        self.n_critics = in_policy
        self.policy_delay = policy_delay
        self.target_mode = target_mode
        self.critic_loss = critic_loss
        self.critic_reduction = critic_reduction
        self._timesteps_at_update = 0
        self._logged_updates = self._logged_transitions = 0  # since the log was written
        self._was_set_up = False  # in a saved model: True

    def _check_arguments(self) -> None:
        """Of a new model, and of a loaded one, whose arguments may have been replaced."""
        if not issubclass(self.policy_class, self.base_policy):
            raise ValueError(
                f"policy={self.policy_class.__name__}: expected {self.base_policy.__name__} or a class derived from it"
            )
        if not callable(self.learning_rate):
            check_number("learning_rate", self.learning_rate, 0)
        check_number("buffer_size", self.buffer_size, 1, integer=True)
        check_number("learning_starts", self.learning_starts, 0, integer=True)
        if self.batch_size is not None:
            check_number("batch_size", self.batch_size, 1, integer=True)
            self.batch_size = int(self.batch_size)
        check_number("tau", self.tau, 0, 1)
        check_number("gamma", self.gamma, 0, 1)
        self.tau, self.gamma = float(self.tau), float(self.gamma)  # powers of NumPy's would be in double precision
        if not np.issubdtype(self.action_space.dtype, np.floating):
            raise ValueError(f"action_space={self.action_space}: expected real numbers, scaled ones are not whole")
        assert isinstance(self.action_space, spaces.Box)  # the only supported one
        if not np.all(self.action_space.low < self.action_space.high):
            raise ValueError(f"action_space={self.action_space}: expected low < high, an action that is constant has no scale")
        if not isinstance(self.train_freq, TrainFreq):
            frequency = self.train_freq[0] if isinstance(self.train_freq, tuple) else self.train_freq
            check_number("train_freq", frequency, 1, integer=True)
        check_number("gradient_steps", self.gradient_steps, -1, integer=True)
        check_number("n_steps", self.n_steps, 1, integer=True)
        check_number("n_critics", self.n_critics, 1, integer=True)
        check_number("policy_delay", self.policy_delay, 1, integer=True)
        check_number("stats_window_size", self._stats_window_size, 1, integer=True)
        self._stats_window_size = int(self._stats_window_size)  # deques take no number of NumPy
        check_choice("target_mode", self.target_mode, TARGET_MODES)
        check_choice("critic_loss", self.critic_loss, (*CRITIC_LOSSES, CLASSIFICATION))
        check_choice("critic_reduction", self.critic_reduction, ("independent", "ensemble_mean"))
        self._check_classification()
        # Those that load() got as one of its custom_objects are without what the constructor adds
        self.policy_kwargs = {"n_critics": self.n_critics, **self.policy_kwargs}
        for name in ("n_critics", "use_sde"):
            built = self.policy_kwargs.get(name, False)
            if getattr(self, name) != built:
                raise ValueError(f"{name}={getattr(self, name)!r}: the saved model has {built!r}")
        if self.action_noise is not None and not isinstance(self.action_noise, ActionNoise):
            raise TypeError(f"action_noise={self.action_noise!r}: expected an ActionNoise or None")
        self._check_noise_shape()
        if self.optimize_memory_usage and self.n_steps > 1:
            raise ValueError("optimize_memory_usage=True: n-step returns need n_steps=1 then")

    def _check_noise_shape(self) -> None:
        noise = self.action_noise.noises[0] if isinstance(self.action_noise, VectorizedActionNoise) else self.action_noise
        given, wanted = np.shape(getattr(noise, "_mu", 0.0)), self.action_space.shape
        assert wanted is not None  # of a Box
        if isinstance(noise, DecayingActionNoise):
            given, fits = noise.shape, noise.shape == wanted
        else:  # SB3's takes one mean for all actions, too
            fits = given == wanted[len(wanted) - len(given) :] or math.prod(given) == 1
        if not fits:
            raise ValueError(f"action_noise={noise}: its shape is {given}, expected {wanted}, that of an action")

    def _check_classification(self) -> None:
        value_range = self.policy_kwargs.get("value_range")
        if self.critic_loss == CLASSIFICATION and value_range is None:
            raise ValueError(f"critic_loss={CLASSIFICATION!r}: expected policy_kwargs with a value_range (low, high)")
        if self.critic_loss != CLASSIFICATION and value_range is not None:
            raise ValueError(f"critic_loss={self.critic_loss!r}: expected {CLASSIFICATION!r} with value_range={value_range!r}")
        if self.critic_loss == CLASSIFICATION and self.critic_reduction != "independent":
            raise ValueError(f"critic_reduction={self.critic_reduction!r}: expected 'independent' for {CLASSIFICATION!r}")

    # ---------------------------------------------------------------- set-up

    def _setup_model(self) -> None:
        self._check_arguments()
        n_steps, given_class, given = self.n_steps, self.replay_buffer_class, self.replay_buffer_kwargs
        is_dict = isinstance(self.observation_space, spaces.Dict)
        if is_dict and n_steps > 1:
            raise ValueError(f"n_steps={n_steps}: expected 1 for Dict observations, as in SB3")
        chosen = given_class
        if chosen is None:
            for_dict, for_n_steps, otherwise = self.default_buffers
            self.replay_buffer_class = chosen = for_dict if is_dict else for_n_steps if n_steps > 1 else otherwise
        if is_dict and not issubclass(chosen, DictReplayBuffer):
            raise ValueError(f"replay_buffer_class={chosen.__name__}: expected one for Dict observations")
        if "fade_factor" in given and not issubclass(chosen, FadedSampling):
            raise ValueError(f"fade_factor={given['fade_factor']!r}: {chosen.__name__} does not fade")
        if issubclass(chosen, NStepReplayBuffer):
            own = {"n_steps": n_steps, "gamma": self.gamma}
            for name, value in own.items():
                if given.get(name, value) != value:
                    raise ValueError(f"replay_buffer_kwargs has {name}={given[name]!r}: expected that of the model, {value!r}")
            self.replay_buffer_kwargs = {**given, **own}
        elif n_steps > 1:
            raise ValueError(f"n_steps={n_steps}: {chosen.__name__} has no n-step returns, expected n_steps=1")
        # SB3 takes a given class for one without n-step returns, and warns: the buffer has its horizon already
        self.n_steps = 1
        super()._setup_model()
        self.n_steps, self.replay_buffer_class, self.replay_buffer_kwargs = n_steps, given_class, given
        self._create_aliases()
        self._was_set_up = True

    def _create_regression(self) -> None:
        parts = self.critic, self.critic_target, self.critic_loss, self.critic_reduction
        try:
            self._regression = make_regression(*parts, self.policy.critic_engine)
        except ValueError as error:
            if not self._was_set_up:
                raise
            # Loaded on another kind of machine, maybe only to act
            warnings.warn(f"{error}. The loaded model goes on with 'auto'", stacklevel=2)
            self._regression = make_regression(*parts, "auto")

    def _create_aliases(self) -> None:
        self.actor = self.policy.actor
        self.critic = self.policy.critic
        self.critic_target = self.policy.critic_target
        self._has_batch_norm = bool(get_parameters_by_name(self.actor, ["running_"]))
        self._create_regression()  # of these critics
        self._cuda_graphs = CudaGraphs()

    def _setup_learn(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        reset_num_timesteps: bool = True,
        *args: Any,
        **kwargs: Any,
    ) -> Any:
        assert self.env is not None, "You must set the environment before calling learn()"
        noise = self.action_noise
        if isinstance(noise, VectorizedActionNoise) and noise.n_envs != self.env.num_envs:
            # The model was loaded with another number of environments: go on from the first one's state
            self.action_noise = noise = noise.noises[0]
        if noise is not None and self.env.num_envs > 1 and not isinstance(noise, VectorizedActionNoise):
            self.action_noise = noise = VectorizedActionNoise(noise, self.env.num_envs)
        for each in noise.noises if isinstance(noise, VectorizedActionNoise) else [noise]:
            if isinstance(each, DecayingActionNoise):
                each.n_envs = self.env.num_envs  # a decay counts environment steps
        check_mirror(self.replay_buffer, self._vec_normalize_env)  # now, not after the warm-up
        result = super()._setup_learn(total_timesteps, callback, reset_num_timesteps, *args, **kwargs)
        if self.resets_envs:
            self.start_anew()
        self._timesteps_at_update = min(self._timesteps_at_update, self.num_timesteps)  # whose count may have restarted
        return result

    def start_anew(self) -> None:
        """To be called when all environments were reset: no episode goes on."""
        if self.replay_buffer is not None:
            end_trajectory(self.replay_buffer)

    # ---------------------------------------------------------------- training

    def _store_transition(self, replay_buffer: ReplayBuffer, *args: Any, **kwargs: Any) -> None:
        # SB3 writes it only if it handles timeouts, end_trajectory() always: a row overwritten later would keep it
        if hasattr(replay_buffer, "timeouts"):  # one's own buffers may do without
            replay_buffer.timeouts[replay_buffer.pos] = 0
        super()._store_transition(replay_buffer, *args, **kwargs)

    def collect_rollouts(self, *args: Any, **kwargs: Any) -> RolloutReturn:
        continues = False
        try:
            rollout = super().collect_rollouts(*args, **kwargs)
            continues = rollout.continue_training
        finally:
            if not continues:  # a callback has stopped it, or something was raised
                # Environments are a step ahead of the latest observation, maybe in another episode: the next learn() resets
                self._last_obs = None
        return rollout

    def _segments(
        self, gradient_steps: int, batch_size: int, **sample_kwargs: Any
    ) -> Iterator[tuple[ReplayBufferSamples, list[ReplayBufferSamples]]]:
        """
        Draw ``gradient_steps`` minibatches and cut them where the actor changes, or earlier.

        A segment ends with every ``policy_delay``-th update (counted over the model's life), after which the caller steps
        the actor. Inside it the actor is frozen, so its next actions can be computed for all minibatches at once.

        :param gradient_steps: Number of critic updates
        :param batch_size: Transitions per update
        :param sample_kwargs: Passed to ``replay_buffer.sample``
        :return: Pairs of a segment's transitions and the same as minibatches
        """
        assert self.replay_buffer is not None
        row_bytes = 8 * get_flattened_obs_dim(self.observation_space)  # two observations in single precision
        updates_per_draw = max(1, MAX_SAMPLE_BYTES // (row_bytes * batch_size))
        if type(self.replay_buffer) not in DRAWN_AT_ONCE:
            updates_per_draw = 1
        # With gSDE each update has noise of its own, as in SAC; batch normalisation has statistics of its own
        longest = 1 if self.use_sde or self._has_batch_norm else max(1, MAX_SEGMENT_ROWS // batch_size)
        while gradient_steps > 0:
            draw = min(gradient_steps, updates_per_draw)
            samples = self.replay_buffer.sample(draw * batch_size, env=self._vec_normalize_env, **sample_kwargs)
            start = 0
            while start < draw:
                until_actor = self.policy_delay - self._n_updates % self.policy_delay
                length = min(draw - start, until_actor, longest)
                segment = _rows(samples, start * batch_size, length * batch_size)
                with self._regression.unchanged():
                    yield segment, _minibatches(segment, length, batch_size)
                start += length
            gradient_steps -= draw

    def _update(self, gradient_steps: int, batch_size: int, logs: UpdateLogs, **sample_kwargs: Any) -> None:
        """
        Make updates.

        :param gradient_steps: Number of critic updates
        :param batch_size: Transitions per update
        :param logs: Where to add what is logged
        :param sample_kwargs: Passed to ``replay_buffer.sample``
        """
        if self._regression.critic is not self.critic or self._regression.critic_target is not self.critic_target:
            self._create_regression()  # somebody has replaced them
        state = self._recorded_state()
        for segment, batches in self._segments(gradient_steps, batch_size, **sample_kwargs):
            if state is None:
                self._learn_from(segment, batches, logs)
            else:
                self._learn_recorded(state, segment, batches, logs)

    @abstractmethod
    def _learn_from(self, segment: ReplayBufferSamples, batches: list[ReplayBufferSamples], logs: UpdateLogs) -> None:
        """
        One step of the critics with each minibatch of a segment, then, if the actor changes where it ends, one of the actor.

        :param segment: See :meth:`_segments`
        :param batches: The same
        :param logs: Where to add what is logged
        """

    def _recorded_state(self) -> Hashable | None:
        """What a recording of ``_learn_from`` on a GPU depends on besides transitions; ``None``: none is made."""
        if self.device.type != "cuda" or self.policy.critic_engine != "auto":
            return None
        # What is overridden may do something in Python
        own = "recorded_attributes" in vars(type(self)) and type(self.policy) in self.policy_aliases.values()
        if not own or vars(self).keys() & {"_learn_from", "_fit_critics", "_update_actor"}:
            return None
        if isinstance(self.replay_buffer, PrioritizedReplayBuffer):
            return None  # priorities go back to the CPU
        state = recorded_state(self.policy, [self.actor.optimizer, self.critic.optimizer])
        values = [getattr(self, name) for name in self.recorded_attributes]
        return state and (state, *(value.data_ptr() if isinstance(value, th.Tensor) else value for value in values))

    def _learn_recorded(
        self, state: Hashable, segment: ReplayBufferSamples, batches: list[ReplayBufferSamples], logs: UpdateLogs
    ) -> None:
        """``_learn_from``, by a recording of it."""
        n_updates, logged_updates = self._n_updates, self._logged_updates
        n_batches, batch_size = len(batches), len(batches[0].rewards)

        def learn(segment: ReplayBufferSamples) -> dict[str, th.Tensor]:
            values = update_logs()
            self._learn_from(segment, _minibatches(segment, n_batches, batch_size), values)
            return {key: th.stack(list(each)) for key, each in values.items()}

        kind = state, n_batches, batch_size, n_updates % self.policy_delay, self.policy_delay, segment.discounts is None
        outputs = self._cuda_graphs.run(kind, learn, segment, [self.actor.optimizer, self.critic.optimizer])
        for key, values in outputs.items():
            logs[key].extend(values)
        # A replay does not count
        self._n_updates, self._logged_updates = n_updates + n_batches, logged_updates + n_batches

    def _fit_critics(self, batch: ReplayBufferSamples, target: th.Tensor, logs: UpdateLogs) -> None:
        """
        One step of the critics, after which the targets move.

        :param batch: The transitions
        :param target: What their values are to be ``(batch, 1)``
        :param logs: Where to add what is logged
        """
        weights = getattr(batch, "weights", None)
        loss, q_values = self._regression.fit(batch.observations, batch.actions, target, self.tau, weights)
        if isinstance(self.replay_buffer, PrioritizedReplayBuffer):
            # Priority of a transition: its error averaged over the critics
            errors = (target - q_values).abs().mean(dim=0)
            self.replay_buffer.update_priorities(batch.indices, errors)  # type: ignore[attr-defined]  # this buffer's have it
        self._n_updates += 1
        self._logged_updates += 1
        logs["critic_loss"].append(loss)
        logs["q_values"].append(q_values)
        logs["target_q_mean"].append(target)

    def _step_actor(self, loss: th.Tensor) -> None:
        """One step of the actor. No gradient reaches the critics, nor what is frozen."""
        learned = [parameter for parameter in self.actor.parameters() if parameter.requires_grad]
        if learned:
            self.actor.optimizer.zero_grad()
            loss.backward(inputs=learned)
            self.actor.optimizer.step()

    def _discounts(self, batch: ReplayBufferSamples) -> th.Tensor | float:
        """Discount of the bootstrap value: ``gamma`` to the power of the steps summed in ``rewards``."""
        return self.gamma if batch.discounts is None else batch.discounts

    def _log_update(self, logs: UpdateLogs, noise_std: th.Tensor | float) -> None:
        """
        Record the mean of each quantity over the updates of one ``train()`` call (the latest 1 000 of a long one): the only
        transfer off the device; and the ratio of updates to environment steps since the log was written.

        :param logs: Log key (without ``train/``) to tensors of one shape, one per update. ``q_values``
            ``(n_critics, batch, 1)`` become ``q_mean`` and ``q_std``, the spread over the critics averaged over the batch
        :param noise_std: Standard deviation of the exploration noise in [-1, 1] action units; of a stochastic actor, that of
            its Gaussian, before the tanh
        """
        if not logs:
            return
        means = {}
        for key, values in logs.items():
            stacked = th.stack(list(values))
            if key == "q_values":
                deviation = stacked - stacked.mean(dim=1, keepdim=True)  # std(dim=1) takes fifteen times as long
                means["q_mean"], means["q_std"] = stacked.mean(), deviation.square().mean(dim=1).sqrt().mean()
            else:
                means[key] = stacked.mean()
        for key, value in zip(means, th.stack(list(means.values())).tolist(), strict=True):
            self.logger.record(f"train/{key}", value)
        self.logger.record("train/noise_std", float(noise_std))

        # Steps of the warm-up have no updates
        self._logged_transitions += max(1, self.num_timesteps - max(self._timesteps_at_update, self.learning_starts))
        self._timesteps_at_update = self.num_timesteps
        self.logger.record("train/update_ratio", self._logged_updates / self._logged_transitions)
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")

    def dump_logs(self) -> None:
        super().dump_logs()
        self._logged_updates = self._logged_transitions = 0

    # ---------------------------------------------------------------- saving

    @classmethod
    def load(
        cls: type[SelfEnsemble],
        path: str | pathlib.Path | io.BufferedIOBase,
        env: GymEnv | None = None,
        device: th.device | str = "auto",
        custom_objects: dict[str, Any] | None = None,
        print_system_info: bool = False,
        force_reset: bool = True,
        **kwargs: Any,
    ) -> SelfEnsemble:
        """
        SB3's, except that it does not take any keyword for an attribute.

        :param kwargs: Arguments of the constructor, in place of the saved ones. What ``policy_kwargs`` names has to be what
            the saved model has
        :raises TypeError: for another keyword
        :raises ValueError: if an argument is out of range or does not fit the saved model
        """
        algorithms = cls.__mro__[: cls.__mro__.index(EnsembleOffPolicyAlgorithm)]  # what is behind takes what not all have
        known = {name for each in algorithms for name in constructor_parameters(each)} - {
            "self",
            "policy",
            "_init_setup_model",
        }
        for name in kwargs:
            if name not in known:
                raise TypeError(f"load() got an unexpected argument {name!r}{suggestion(name, known)}")
        policy_kwargs = kwargs.pop("policy_kwargs", None) or {}  # SB3 compares them with those that a constructor completed
        if "stats_window_size" in kwargs:
            kwargs["_stats_window_size"] = kwargs.pop("stats_window_size")
        model = super().load(path, env, device, custom_objects, print_system_info, force_reset, **kwargs)
        defaults = constructor_parameters(model.policy_class)
        for name, value in policy_kwargs.items():
            if name in model.policy_kwargs:
                saved = [model.policy_kwargs[name]]
            else:  # the default, or what the policy has made of it
                default = defaults[name].default if name in defaults else None
                saved = [default, getattr(model.policy, name, default)]
            if _without_tuples(value) not in map(_without_tuples, saved):  # SB3 saves them as JSON
                raise ValueError(f"policy_kwargs has {name}={value!r}: the saved model has {saved[-1]!r}")
        if "_stats_window_size" in kwargs:
            model.ep_info_buffer = deque(model.ep_info_buffer or (), model._stats_window_size)
            model.ep_success_buffer = deque(model.ep_success_buffer or (), model._stats_window_size)
        return model

    def load_replay_buffer(self, path: str | pathlib.Path | io.BufferedIOBase, truncate_last_traj: bool = True) -> None:
        """
        SB3's; the horizon of the buffer's returns and their discount become the model's. All else (its class, fading,
        priorities) stays what was saved, whatever ``replay_buffer_class`` and ``replay_buffer_kwargs`` say.

        :param truncate_last_traj: Whether the buffer's last episode ends there; else it is the one that the model is in
        :raises ValueError: if the file holds no replay buffer, or one of other spaces, of another number of environments, or
            without n-step returns where the model needs them; the model's own buffer then stays
        """
        before = self.replay_buffer
        try:
            super().load_replay_buffer(path, truncate_last_traj)
            self._check_loaded_buffer()
        except BaseException as error:
            self.replay_buffer = before
            if isinstance(error, AssertionError):  # SB3 asserts what is a user's error: what the file holds
                raise ValueError(f"{path}: {error}") from error
            raise
        loaded: Any = self.replay_buffer
        if isinstance(loaded, NStepReplayBuffer):
            loaded.n_steps, loaded.gamma = self.n_steps, self.gamma
        if truncate_last_traj and not isinstance(loaded, HerReplayBuffer):  # for HER, SB3 does it
            end_trajectory(loaded)

    def _check_loaded_buffer(self) -> None:
        loaded: Any = self.replay_buffer
        kind = type(loaded).__name__
        for name in ("observation_space", "action_space", "n_envs"):
            wanted, there = getattr(self, name), getattr(loaded, name)
            if there != wanted:
                raise ValueError(f"{name}={wanted!r}: the saved {kind} is of {there!r}")
        if self.n_steps > 1 and not isinstance(loaded, NStepReplayBuffer):
            raise ValueError(f"n_steps={self.n_steps}: the saved {kind} has no n-step returns, expected n_steps=1")

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "actor", "critic", "critic_target", "_regression", "_cuda_graphs"]

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        return ["policy", "actor.optimizer", "critic.optimizer"], []


def _without_tuples(value: Any) -> Any:
    """With lists instead, as JSON has it."""
    if isinstance(value, dict):
        return {key: _without_tuples(each) for key, each in value.items()}
    return [_without_tuples(each) for each in value] if isinstance(value, tuple | list) else value


def _rows(samples: ReplayBufferSamples, start: int, length: int) -> Any:
    """``length`` rows of every field, from ``start`` on."""

    def cut(field: Any) -> Any:
        if isinstance(field, dict):
            return {key: cut(value) for key, value in field.items()}
        return None if field is None else field[start : start + length]

    return type(samples)(*map(cut, samples))


def _minibatches(segment: ReplayBufferSamples, n_batches: int, batch_size: int) -> list[ReplayBufferSamples]:
    return [_rows(segment, i * batch_size, batch_size) for i in range(n_batches)]


def noise_std(action_noise: ActionNoise | None) -> float:
    """
    Current standard deviation of an action noise, averaged over its dimensions and environments.

    :param action_noise: SB3's, of which it is ``sigma``, or one of :mod:`sb3_symphony.common.noise`; ``None`` counts as 0
    """
    if action_noise is None:
        return 0.0
    if isinstance(action_noise, VectorizedActionNoise):
        return float(np.mean([noise_std(noise) for noise in action_noise.noises]))
    return float(np.mean(getattr(action_noise, "std", getattr(action_noise, "_sigma", np.nan))))
