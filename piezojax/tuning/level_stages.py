"""Stages of a plant that is scheduled by the level of its drive, one at each level."""

import dataclasses

import jax
import jax.numpy as jnp

from ..core.feedback import Feedback
from ..core.system import System
from ..dynamics import AmplitudeScheduled
from ..study import Stage


def levels_of(plant: System) -> int:
    """Return the number of drive levels of ``plant``, 0 if it is not scheduled."""
    return max((len(one.models) for one in _scheduled_in(plant)), default=0)


def level_stages(loop: Feedback) -> Stage | None:
    """Return the stages of ``loop`` at each level of its drive, stacked.

    Each stage has the linear model of one level at every drive, because the scheduled
    plant, linearised at rest, shows a single level. None if it is not scheduled.
    """
    count = levels_of(loop.plant)
    if count == 0:
        return None
    stages = [Stage(_at_level(loop.plant, i), loop.sensor) for i in range(count)]
    return jax.tree.map(lambda *parts: jnp.stack(parts), *stages)


def _is_scheduled(part: object) -> bool:
    return isinstance(part, AmplitudeScheduled)


def _scheduled_in(plant: System) -> list[AmplitudeScheduled]:
    leaves = jax.tree.leaves(plant, is_leaf=_is_scheduled)
    return [leaf for leaf in leaves if isinstance(leaf, AmplitudeScheduled)]


def _at_level(plant: System, level: int) -> System:
    """Return ``plant`` with the model of one ``level`` in place of all."""

    def fixed(part):
        if not isinstance(part, AmplitudeScheduled):
            return part
        one = part.models[min(level, len(part.models) - 1)]
        return dataclasses.replace(part, models=(one,) * len(part.models))

    return jax.tree.map(fixed, plant, is_leaf=_is_scheduled)
