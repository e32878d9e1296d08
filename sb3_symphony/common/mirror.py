"""The left-right symmetry of a robot: what it has done with one side, it could have done with the other."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.type_aliases import ReplayBufferSamples

from sb3_symphony.common.checks import check_choice, check_number


class Reflection:
    """
    Exchanges components of a vector, turns signs and shifts zeros. Applied twice, it gives the vector back.

    :param name: what is reflected, for messages
    :param size: number of components
    :param swap: pairs of indices: components of the left side and their counterparts on the right
    :param negate: indices of components that change sign, such as sideways velocities; of a pair, both
    :param offset: pairs of an index and what is added to that component afterwards, for joints whose zeros differ between
        the sides
    :raises ValueError: for an index out of range or in two pairs of one kind, or if it does not give the vector back
    :raises TypeError: if something has the wrong type
    """

    def __init__(
        self,
        name: str,
        size: int,
        swap: Sequence[Sequence[int]] = (),
        negate: Sequence[int] = (),
        offset: Sequence[tuple[int, float]] = (),
    ) -> None:
        for key, pairs, example in (("swap", swap, "[[4, 9], [5, 10]]"), ("offset", offset, "[[4, 0.1], [9, -0.1]]")):
            if not isinstance(pairs, Sequence) or any(not isinstance(pair, Sequence) or len(pair) != 2 for pair in pairs):
                raise TypeError(f"{name}: {key}={pairs!r}: expected a list of pairs, such as {example}")
        if not isinstance(negate, Sequence):
            raise TypeError(f"{name}: negate={negate!r}: expected a list of indices, such as [1, 3]")
        swapped = [index for pair in swap for index in pair]
        for index in (*swapped, *negate, *(index for index, _ in offset)):
            check_number(f"{name}: index", index, 0, size - 1, integer=True)
        for index, value in offset:
            check_number(f"{name}: offset of {index}", value)
        for key, given, indices in (("swap", swap, swapped), ("offset", offset, [index for index, _ in offset])):
            if len(set(indices)) < len(indices):
                raise ValueError(f"{name}: {key}={given!r}: expected each index once")

        self.order = th.arange(size)
        for left, right in swap:
            self.order[[left, right]] = self.order[[right, left]]
        self.signs = th.ones(size)
        self.signs[list(negate)] = -1
        self.offset = th.zeros(size)
        for index, value in offset:
            self.offset[index] = value
        unit = th.eye(size)
        if not th.allclose(self(self(unit)), unit, atol=1e-6):
            raise ValueError(
                f"{name}: negate={negate!r}, offset={offset!r}: expected the same vector after mirroring twice: "
                "both of a pair negated or none, offsets that cancel"
            )

    def __call__(self, vectors: th.Tensor) -> th.Tensor:
        """
        :param vectors: shape ``(batch, size)``
        :return: their mirror images
        """
        order = self.order.to(vectors.device)
        return th.addcmul(self.offset.to(vectors), vectors.index_select(1, order), self.signs.to(vectors))


class Mirror:
    """
    Mirrors about every second transition that is drawn, so that each side learns from both. For robots whose sides are built
    alike, and tasks that prefer neither.

    Source: Abdolhosseini et al. (2019), "On Learning Symmetric Locomotion", the variant with duplicated experience.

    :param values: mapping with the keys ``observation`` and ``action``: for each a mapping with ``swap``, ``negate``
        and ``offset`` as needed, see :class:`Reflection`
    :param observation_space: a vector
    :param action_space: a vector; its components are mirrored as scaled to [-1, 1]
    :raises ValueError: if the values do not fit the spaces
    :raises TypeError: if a part of them has the wrong type
    """

    def __init__(self, values: Mapping[str, Any], observation_space: spaces.Space, action_space: spaces.Space) -> None:
        if not isinstance(values, Mapping) or set(values) != {"observation", "action"}:
            raise ValueError(f"mirror={values!r}: expected a mapping with the keys observation and action")
        reflections = []
        for name, space in (("observation", observation_space), ("action", action_space)):
            if not isinstance(space, spaces.Box) or len(space.shape) != 1 or not np.issubdtype(space.dtype, np.floating):
                raise ValueError(f"mirror: expected {name}s that are vectors (Box) of real numbers, got {space}")
            if not isinstance(values[name], Mapping):
                raise TypeError(f"mirror: {name}={values[name]!r}: expected a mapping of swap, negate and offset")
            for key in values[name]:
                check_choice(f"mirror: {name}", key, ("swap", "negate", "offset"))
            reflections.append(Reflection(f"mirror: {name}", space.shape[0], **values[name]))
        self.observation, self.action = reflections

    def __call__(self, samples: ReplayBufferSamples) -> ReplayBufferSamples:
        """
        :param samples: transitions of any kind, each field with shape ``(batch, ...)``
        :return: the same, each mirrored with probability ½
        """
        mirrored = th.as_tensor(np.random.random((len(samples.actions), 1)) < 0.5, device=samples.actions.device)
        return samples._replace(
            observations=th.where(mirrored, self.observation(samples.observations), samples.observations),
            actions=th.where(mirrored, self.action(samples.actions), samples.actions),
            next_observations=th.where(mirrored, self.observation(samples.next_observations), samples.next_observations),
        )
