"""Runs of many lanes in compiled C, called by XLA on a CPU."""

import math
from collections.abc import Collection, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .lane_values import LaneValues
from .native_library import registered
from .native_source import Shape, has_source, shape_for, source, waits
from .native_writer import Arrays, Rows
from .scalar_step import Place, ScalarStep
from .shorter_chain import shortened


def computes(step: ScalarStep, by_lane: bool) -> bool:
    """Return whether ``results`` can compute a step; inputs may be ``by_lane``."""
    return has_source(step)


def results(
    step: ScalarStep,
    values: LaneValues,
    inputs: Sequence[Array],
    counts: tuple[int, int, int],
    wanted: Sequence[tuple[int, int]],
    every: int,
) -> tuple[Array, Array]:
    """Return the elements ``wanted`` of the carry after all steps, and the log.

    ``counts`` are the numbers of directions, outer and inner lanes; both results begin
    with these axes. The ``inputs`` end with them, [samples, ..., 1, 1, inner or 1].
    ``wanted`` are pairs (leaf, element). The log holds the last output of each
    ``every`` samples; it is empty if ``every`` is 0. If the step computes derivatives,
    they are returned instead of the values.
    """
    _, outer, inner = counts
    if waits(step, inner):
        step = shortened(step)
    blocks = _Blocks(shape_for(step, inner, every), counts)
    leaves, rows = blocks.inputs(inputs)
    carried = [each.place for each in step.carried]
    slopes = [each.place for each in step.slopes]
    arrays = _arrays(step, values, wanted)
    name = registered(source(step, arrays, rows, blocks.shape), len(rows))
    logged = inputs[0].shape[0] // every if every else 0
    end, log, slope_end, slope_log = blocks.called(
        name,
        [
            (len(arrays.end),),
            (logged, len(step.log)),
            (counts[0], len(arrays.slope_end)),
            (counts[0], logged, len(step.log_slopes)),
        ],
        values.elements(arrays.shared, (1, 1, 1)).ravel(),
        blocks.split(values.elements(arrays.own, (1, outer, inner))[0]),
        blocks.split(values.elements(carried, (1, outer, inner))[0]),
        blocks.by_direction(values.elements(arrays.slopes, counts)),
        blocks.by_direction(values.elements(slopes, counts)),
        *leaves,
    )
    found, places = (end[None], log[None]), arrays.end
    if step.slopes:
        found = jnp.moveaxis(slope_end, 2, 0), jnp.moveaxis(slope_log, 2, 0)
        places = arrays.slope_end
    return _at([(x.leaf, x.element) for x in places], wanted, found[0]), found[1]


def reversed_results(
    step: ScalarStep,
    values: LaneValues,
    inputs: Sequence[Array],
    counts: tuple[int, int, int],
    segment: int,
    starts: Array,
    slopes: Array,
    results: Sequence[Place],
    wanted: Sequence[Place],
) -> Array:
    """Return the derivatives of a result with respect to the elements ``wanted``.

    ``slopes`` are the derivatives with respect to the elements ``results`` of the carry
    after all steps. The last of the ``inputs`` holds the derivatives with respect to
    the log. ``starts`` [..., segments, elements] are the carries before each segment of
    ``segment`` samples. ``slopes`` and ``starts`` begin with the axes of ``counts``, or
    with axes of size 1. The other arguments are those of the function ``results``.
    """
    _, outer, inner = counts
    blocks = _Blocks(shape_for(step, inner, 0, segment), counts)
    leaves, rows = blocks.inputs(inputs)
    after = [each.place for each in step.slopes]
    known = [place for place in wanted if place in after]
    arrays = _arrays(step, values, ())._replace(slope_end=known)
    name = registered(source(step, arrays, rows, blocks.shape), len(rows))
    more = jnp.broadcast_to(slopes, (1, outer, inner, slopes.shape[-1]))
    starts = jnp.broadcast_to(starts, (1, outer, inner, *starts.shape[3:]))[0]
    found = blocks.called(
        name,
        [(0,), (0, 0), (1, len(known)), (1, 0, 0)],
        values.elements(arrays.shared, (1, 1, 1)).ravel(),
        blocks.split(values.elements(arrays.own, (1, outer, inner))[0]),
        jnp.moveaxis(blocks.split(jnp.moveaxis(starts, 2, 0)), 0, 2),
        blocks.by_direction(jnp.zeros((1, outer, inner, 0))),
        blocks.by_direction(_at(results, after, more)),
        *leaves,
    )[2]
    return _at(known, wanted, jnp.moveaxis(found, 2, 0))


class _Blocks:
    """Blocks of lanes; ``counts`` are the directions, outer and inner lanes."""

    def __init__(self, shape: Shape, counts: tuple[int, int, int]):
        self.shape, self._lanes = shape, shape.width * shape.groups
        _, self._outer, self._inner = counts
        self._blocks = -(-self._inner // self._lanes)

    def split(self, array: Array) -> Array:
        """Return [..., inner, n] as [..., blocks, n, lanes of a block]."""
        more = [(0, 0)] * array.ndim
        more[-2] = (0, -self._inner % self._lanes)
        # Copies of the last lane fill the last block.
        array = jnp.pad(array, more, mode="edge")
        lead, last = array.shape[:-2], array.shape[-1]
        split = array.reshape(*lead, self._blocks, self._lanes, last)
        return jnp.swapaxes(split, -1, -2)

    def by_direction(self, array: Array) -> Array:
        """Return [directions, outer, inner, n] with directions after the blocks."""
        return jnp.moveaxis(self.split(array), 0, 2)

    def inputs(self, inputs: Sequence[Array]) -> tuple[list[Array], list[Rows]]:
        """Return the arrays of the inputs, and the Rows of each."""
        leaves, rows = [], []
        for x in inputs:
            size, by_lane = math.prod(x.shape[1:-3]), x.shape[-1] > 1
            flat = x.astype(float).reshape(x.shape[0], size, x.shape[-1])
            more = -self._inner % self._lanes if by_lane else 0
            leaves.append(jnp.pad(flat, [(0, 0), (0, 0), (0, more)], mode="edge"))
            rows.append(Rows(size, by_lane))
        return leaves, rows

    def called(
        self, name: str, sizes: Sequence[tuple[int, ...]], *arrays: Array
    ) -> list[Array]:
        """Return the results of a library as [outer, inner, *size], one per size."""
        lead = self._outer, self._blocks
        types = [
            jax.ShapeDtypeStruct((*lead, *size, self._lanes), float) for size in sizes
        ]
        return [self._joined(x) for x in jax.ffi.ffi_call(name, types)(*arrays)]

    def _joined(self, array: Array) -> Array:
        moved = jnp.moveaxis(array, -1, 2)
        lanes = self._blocks * self._lanes
        return moved.reshape(self._outer, lanes, *moved.shape[3:])[:, : self._inner]


def _arrays(
    step: ScalarStep, values: LaneValues, wanted: Collection[tuple[int, int]]
) -> Arrays:
    """Return the arrays of a step; ``wanted`` are elements of the carry."""
    numbers = step.read(step.steady)
    shared = [place for place in numbers if values.is_shared(place)]
    ends = [
        [x.place for x in each if (x.place.leaf, x.place.element) in wanted]
        for each in (step.carried, step.slopes)
    ]
    own = [place for place in numbers if not values.is_shared(place)]
    return Arrays(shared, own, step.read(step.steady_slopes), *ends)


def _at(places: Sequence[Any], wanted: Sequence[Any], array: Array) -> Array:
    """Return the columns at the places ``wanted``; those that ``array`` lacks are 0."""
    order = {place: i for i, place in enumerate(places)}
    columns = np.array([order.get(each, -1) for each in wanted], int)
    return jnp.pad(array, [(0, 0)] * (array.ndim - 1) + [(0, 1)])[..., columns]
