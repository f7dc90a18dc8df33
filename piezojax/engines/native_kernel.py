"""Runs of many lanes in compiled C, called by XLA on a CPU."""

import math
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .lane_values import LaneValues
from .native_library import registered
from .native_source import has_source, shape_for, source
from .native_writer import Arrays, Rows
from .scalar_step import ScalarStep


def computes(step: ScalarStep, by_lane: bool) -> bool:
    """Return whether ``results`` exists for a step; for any inputs ``by_lane``."""
    return has_source(step)


def results(
    step: ScalarStep,
    values: LaneValues,
    inputs: Sequence[Array],
    counts: tuple[int, int, int],
    wanted: Sequence[tuple[int, int]],
    every: int,
) -> tuple[Array, Array]:
    """Return the elements of the carry after all steps, and the logged outputs.

    ``counts`` are the directions, outer and inner lanes; both results begin with these
    axes. The ``inputs`` end with them, [samples, ..., 1, 1, inner or 1]. ``wanted`` are
    the elements of the carry (leaf, element). The outputs are logged at the last of
    each ``every`` samples, for 0 never. Derivatives are returned if the step
    computes any.
    """
    directions, outer, inner = counts
    shape = shape_for(step, inner, every)
    block = shape.width * shape.groups
    blocks = -(-inner // block)

    def blocked(array: Array) -> Array:
        """Return [..., inner, n] as [..., blocks, n, lanes of a block]."""
        more = [(0, 0)] * array.ndim
        more[-2] = (0, -inner % block)
        # Copies of the last lane fill the last block.
        array = jnp.pad(array, more, mode="edge")
        split = array.reshape(*array.shape[:-2], blocks, block, array.shape[-1])
        return jnp.swapaxes(split, -1, -2)

    def by_direction(array: Array) -> Array:
        return jnp.moveaxis(blocked(array), 0, 2)

    leaves, rows = [], []
    for x in inputs:
        size, by_lane = math.prod(x.shape[1:-3]), x.shape[-1] > 1
        flat = x.astype(float).reshape(x.shape[0], size, x.shape[-1])
        more = [(0, 0), (0, 0), (0, -inner % block if by_lane else 0)]
        leaves.append(jnp.pad(flat, more, mode="edge"))
        rows.append(Rows(size, by_lane))
    carried = [each.place for each in step.carried]
    slopes = [each.place for each in step.slopes]
    numbers = values.read(step.steady)
    arrays = Arrays(
        [place for place in numbers if values.is_shared(place)],
        [place for place in numbers if not values.is_shared(place)],
        values.read(step.steady_slopes),
        [place for place in carried if (place.leaf, place.element) in wanted],
        [place for place in slopes if (place.leaf, place.element) in wanted],
    )
    name = registered(source(step, arrays, rows, shape), len(rows))
    logged = inputs[0].shape[0] // shape.every if shape.every else 0
    sizes = [
        (outer, blocks, len(arrays.end), block),
        (outer, blocks, logged, len(step.log), block),
        (outer, blocks, directions, len(arrays.slope_end), block),
        (outer, blocks, directions, logged, len(step.log_slopes), block),
    ]
    end, log, slope_end, slope_log = jax.ffi.ffi_call(
        name, [jax.ShapeDtypeStruct(size, float) for size in sizes]
    )(
        values.elements(arrays.shared, (1, 1, 1)).ravel(),
        blocked(values.elements(arrays.own, (1, outer, inner))[0]),
        blocked(values.elements(carried, (1, outer, inner))[0]),
        by_direction(values.elements(arrays.slopes, counts)),
        by_direction(values.elements(slopes, counts)),
        *leaves,
    )

    def unblocked(array: Array) -> Array:
        """Return [outer, blocks, ..., lanes of a block] as [outer, inner, ...]."""
        moved = jnp.moveaxis(array, -1, 2)
        return moved.reshape(outer, blocks * block, *moved.shape[3:])[:, :inner]

    found, places = (unblocked(end)[None], unblocked(log)[None]), arrays.end
    if step.slopes:
        both = unblocked(slope_end), unblocked(slope_log)
        found = jnp.moveaxis(both[0], 2, 0), jnp.moveaxis(both[1], 2, 0)
        places = arrays.slope_end
    # Derivatives that vanish are not computed.
    order = {(place.leaf, place.element): i for i, place in enumerate(places)}
    columns = np.array([order.get(each, -1) for each in wanted], int)
    return jnp.pad(found[0], [(0, 0)] * 3 + [(0, 1)])[..., columns], found[1]
