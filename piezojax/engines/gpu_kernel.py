"""Runs of many lanes in one kernel of a GPU.

XLA runs every step of a loop on a GPU as several kernels, which read the state of all
lanes from memory and write it back. Here one kernel runs all steps with the state of a
lane in registers.
"""

import math
from bisect import bisect_left
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from ..scalar.graph import Kind
from .lane_values import LaneValues, has_values, typed, value
from .lane_values import values as values_of
from .scalar_step import ScalarStep

WIDTH = 64
"""Number of lanes of a block of the kernel, one per thread; a multiple of 32."""

REGISTERS = 100
"""Largest number of values of a lane for which the shared ones stay in registers.

With more, the values that all lanes share are read from memory at each step. A thread
has 255 registers of 32 bits on the GPUs of 2026."""

MOST = 4000
"""Largest number of operations of a step in the kernel."""


class _Table(NamedTuple):
    """Values of nodes, one node per column of an array [lanes, nodes] or [1, nodes]."""

    numbers: list[int]
    array: Array


def computes(step: ScalarStep, by_lane: bool) -> bool:
    """Return whether ``results`` can compute a step.

    ``by_lane`` is true if inputs differ between lanes.
    """
    if by_lane or step.log or step.slopes:
        return False
    return has_values(step) and len(step.steady) + len(step.moving) <= MOST


def results(
    step: ScalarStep,
    values: LaneValues,
    inputs: Sequence[Array],
    counts: tuple[int, int, int],
    wanted: Sequence[tuple[int, int]],
    every: int,
    *,
    interpret: bool = False,
) -> tuple[Array, Array]:
    """Return the elements ``wanted`` of the carry after all steps, and an empty log.

    See ``native_kernel.results``. ``interpret`` computes the kernel without a GPU.
    """
    lanes = math.prod(counts)
    computed, used = values.nodes(), step.used(step.steady)
    plain = {n: place for n in used if (place := step.place(n)) is not None}

    def is_shared(number: int) -> bool:
        if number in plain:
            return values.is_shared(plain[number])
        return computed[number].size == 1

    def table(shared: bool) -> _Table:
        shape = (1, 1, 1) if shared else counts
        mine = [n for n in used if is_shared(n) == shared]
        read, rest = [n for n in mine if n in plain], [n for n in mine if n in computed]
        columns = [values.elements([plain[n] for n in read], shape)]
        columns += [jnp.broadcast_to(computed[n], shape)[..., None] for n in rest]
        array = jnp.concatenate([x.astype(float) for x in columns], axis=-1)
        return _Table(read + rest, array.reshape(math.prod(shape), -1))

    places = [each.place for each in step.carried]
    start = values.elements(places, counts).reshape(lanes, -1)
    rows = [x.astype(float).reshape(x.shape[0], -1) for x in inputs]
    end = _final(
        step, table(True), table(False), start, jnp.concatenate(rows, axis=1), interpret
    )
    order = [(place.leaf, place.element) for place in places]
    columns = np.array([order.index(each) for each in wanted], int)
    return end[:, columns].reshape(*counts, -1), jnp.zeros((*counts, 0, 0))


def _final(
    step: ScalarStep,
    shared: _Table,
    own: _Table,
    start: Array,
    rows: Array,
    interpret: bool,
) -> Array:
    """Return the elements of state and metric after all steps, [lanes, elements].

    ``shared`` are the values of steady nodes that are equal in all lanes, ``own`` those
    of the others, ``start`` the elements before the first step, and ``rows`` the inputs
    [samples, elements].
    """
    from jax.experimental import pallas

    graph, first = step.graph, _first_columns(step)
    lanes, count = start.shape
    samples, blocks = len(rows), -(-lanes // WIDTH)
    kinds: list[Kind] = [graph.nodes[each.last].kind for each in step.carried]
    column = {each.place: i for i, each in enumerate(step.carried)}
    in_memory = len(shared.numbers) + len(own.numbers) + count > REGISTERS

    def kernel(shared_ref, own_ref, start_ref, rows_ref, end_ref):
        block = pallas.ds(pallas.program_id(0) * WIDTH, WIDTH)

        def of(columns: _Table, ref: Any, at: Any) -> dict[int, Array]:
            return {
                number: typed(ref[at(place)], graph.nodes[number].kind)
                for place, number in enumerate(columns.numbers)
            }

        before = of(own, own_ref, lambda place: (place, block))
        if not in_memory:
            before |= of(shared, shared_ref, lambda place: (0, place))

        def body(k, carry):
            known = dict(before)
            if in_memory:
                # The table has two equal rows. Their index depends on k, so that the
                # compiler does not move the reads in front of the loop.
                known |= of(shared, shared_ref, lambda place: (k & 1, place))

            def given(number: int, kind: Kind) -> Array:
                place = step.places[number]
                if place.part == "carry":
                    return typed(carry[column[place]], kind)
                if place.part == "index":
                    return typed(k, kind)
                at = first[place.leaf] + place.element
                return typed(rows_ref[k, at], kind)

            values_of(graph, step.moving, known, given)
            after = [value(graph, known, each.last) for each in step.carried]
            return tuple(_plain(jnp.broadcast_to(x, WIDTH)) for x in after)

        begin = [start_ref[place, block] for place in range(count)]
        begun = [_plain(typed(x, kind)) for x, kind in zip(begin, kinds, strict=True)]
        end = lax.fori_loop(0, samples, body, tuple(begun))
        for place, x in enumerate(end):
            end_ref[place, block] = x.astype(float)

    def padded(array: Array) -> Array:
        # Copies of the last lane fill the last block. ``_filled`` adds a column,
        # because a kernel cannot read an empty array.
        more = ((0, 0), (0, blocks * WIDTH - lanes))
        return jnp.pad(_filled(array).T, more, mode="edge")

    call = pallas.pallas_call(
        kernel,
        out_shape=jax.ShapeDtypeStruct((count, blocks * WIDTH), float),
        grid=(blocks,),
        **_compiler(interpret),
    )
    twice = jnp.repeat(_filled(shared.array), 2, axis=0)
    return call(twice, padded(own.array), padded(start), rows)[:, :lanes].T


def _first_columns(step: ScalarStep) -> list[int]:
    """Return the column of the first element of each leaf of the inputs."""
    leaves = [place.leaf for place in step.places if place.part == "row"]
    return [bisect_left(leaves, leaf) for leaf in range(max(leaves, default=-1) + 1)]


def _filled(array: Array) -> Array:
    return jnp.concatenate([array, jnp.zeros((len(array), 1))], axis=1)


def _compiler(interpret: bool) -> dict[str, Any]:
    if interpret:
        return {"interpret": True}
    from jax.experimental.pallas import triton

    parameters = triton.CompilerParams(num_warps=WIDTH // 32, num_stages=1)
    return {"compiler_params": parameters}


def _plain(x: Array) -> Array:
    """Return ``x`` with booleans as 1 and 0, because a kernel carries numbers."""
    return x.astype(jnp.int32) if x.dtype == bool else x
