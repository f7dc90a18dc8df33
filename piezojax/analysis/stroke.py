"""Stroke of a stage: its displacements between the limits of its actuator."""

import itertools
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..core.arrays import as_array
from ..core.axes import packed
from ..core.rollout import simulate
from ..core.system import System

SAMPLES = 250
"""Samples from one limit to the other, at the rate of the stage."""


class Stroke(NamedTuple):
    """Lowest and highest displacement, in the unit of the axis [axes]."""

    lowest: Float[np.ndarray, " axes"]
    highest: Float[np.ndarray, " axes"]


def stroke_of(
    stage: System, lower: tuple[float, ...], upper: tuple[float, ...]
) -> Stroke:
    """Return the stroke of ``stage`` between commands ``lower`` and ``upper`` [axes].

    ``stage`` is a plant behind its actuator. Each run begins at rest at one end, goes
    to the other end in ``SAMPLES`` samples, and returns. On one axis the ends are the
    limits, in both orders. On several axes there is a run from each corner of the box
    of the limits to the opposite one, and from each limit of an axis to the other, with
    the other axes in the middle.

    The state at rest includes the whole creep and the full static gain, even of a slow
    stage; the runs include both branches of the hysteresis. Noise and drift of the
    stage can only widen the stroke. An axis with a displacement that is not finite has
    infinite bounds.
    """
    ends = _ends(np.array(lower), np.array(upper))
    alone = ends.shape[2] == 1
    low, high = _extremes(stage, as_array(ends[..., 0] if alone else ends))
    low, high = (np.atleast_1d(np.asarray(x)) for x in (low, high))
    known = np.isfinite(low) & np.isfinite(high)
    return Stroke(np.where(known, low, -np.inf), np.where(known, high, np.inf))


def _ends(lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
    """Return the first and the second end [runs, 2, axes] of each run."""
    middle, half = 0.5 * lower + 0.5 * upper, 0.5 * upper - 0.5 * lower
    axes = len(lower)
    corners = np.array(list(itertools.product((-1.0, 1.0), repeat=axes)))
    directions = np.unique(np.vstack([corners, np.eye(axes), -np.eye(axes)]), axis=0)
    return np.stack([middle - directions * half, middle + directions * half], axis=1)


@eqx.filter_jit
def _extremes(stage: System, ends: Array) -> tuple[Array, Array]:
    """Return the lowest and highest outputs over all runs between ``ends``."""

    def signal(points: Array) -> Array | tuple[Array, ...]:
        return points if points.ndim < 2 else tuple(points.T)

    def run(pair: Array) -> Array:
        there = jnp.linspace(pair[0], pair[1], SAMPLES)
        path = signal(jnp.concatenate([there, there[::-1]]))
        first = jax.tree.map(lambda x: x[0], path)
        return packed(simulate(stage, path, stage.init(first))[1])

    outputs = jax.vmap(run)(ends)
    return jnp.min(outputs, axis=(0, 1)), jnp.max(outputs, axis=(0, 1))
