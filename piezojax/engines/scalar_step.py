"""A step of a System and its Metric as scalar operations, with derivatives."""

import math
from collections.abc import Callable, Collection, Iterable, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ..scalar.graph import CONSTANT, INPUT, Graph
from ..scalar.memory import NotScalarError
from ..scalar.trace import LONG, trace

unrolled = partial(trace, rolled=math.inf)
"""Trace without loops of a fixed number of repetitions: kernels have straight code."""

INDEX = jax.ShapeDtypeStruct((), jnp.int32)
"""Type of the number of a sample."""

MOST = 8000
"""Largest number of operations of a step; compilers take minutes for more."""


class Place(NamedTuple):
    """An input of a step: element ``element`` of leaf ``leaf`` of ``part``.

    The parts are "system", "carry" (state and totals of the metric), "row" (a sample of
    the inputs) and "index" (its number). A ``tangent`` is a derivative of such an
    element. In an adjoint step it is the derivative of the result of the run with
    respect to the element, for "row" with respect to a logged output; a "total" sums
    the derivatives with respect to a number of the system.
    """

    part: str
    leaf: int
    element: int
    tangent: bool = False


class Element(NamedTuple):
    """An element of the carry: its place, and its node after the step."""

    place: Place
    last: int


class ScalarStep(NamedTuple):
    """Scalar operations of a step.

    ``places`` are the inputs of ``graph`` by their number. ``carried`` are the elements
    of the carry that are computed, ``log`` the nodes of the logged outputs. ``steady``
    are the nodes that have the same value at each step, ``moving`` the others, both in
    the order of their computation.

    With derivatives, ``slopes`` are the computed tangents of the carry, in an adjoint
    step also the totals; ``log_slopes`` are the nodes of the derivatives of the logged
    outputs. The nodes that depend on tangents are ``steady_slopes`` and
    ``moving_slopes``; ``steady`` and ``moving`` exclude them. The nodes ``zero`` are
    derivatives that vanish, and the constant 0.
    """

    graph: Graph
    places: list[Place]
    carried: list[Element]
    log: list[int]
    steady: list[int]
    moving: list[int]
    slopes: list[Element]
    log_slopes: list[int]
    steady_slopes: list[int]
    moving_slopes: list[int]
    zero: frozenset[int]

    def place(self, number: int) -> Place | None:
        """Return the place of a node that is an input, else None."""
        node = self.graph.nodes[number]
        return self.places[int(node.value)] if node.operation == INPUT else None

    def read(self, numbers: Iterable[int]) -> list[Place]:
        """Return the places of the inputs among the nodes ``numbers``."""
        places = (self.place(number) for number in numbers)
        return [place for place in places if place is not None]

    @property
    def last(self) -> list[int]:
        """The nodes of all results of the step."""
        values = [element.last for element in (*self.carried, *self.slopes)]
        return [*values, *self.log, *self.log_slopes]

    def used(self, numbers: Sequence[int]) -> list[int]:
        """Return the nodes of ``numbers`` that a step reads or returns, in order."""
        moving = (*self.moving, *self.moving_slopes)
        read = {n for each in moving for n in self.graph.nodes[each].operands}
        read.update(self.last)
        return [number for number in numbers if number in read]

    def operations(self) -> set[str]:
        """Return the names of the operations of the step."""
        steady = (*self.steady, *self.steady_slopes)
        numbers = (*steady, *self.moving, *self.moving_slopes)
        return {self.graph.nodes[number].operation for number in numbers} - {INPUT}


def scalar_step(
    step: Callable[..., Any],
    parts: Sequence[Sequence[jax.ShapeDtypeStruct]],
    outputs: Collection[tuple[int, int]],
    active: Collection[tuple[str, int]] = (),
) -> ScalarStep:
    """Return the scalar operations of a step.

    ``step(system, carry, row, index)`` takes lists of leaves with the shapes ``parts``
    and returns the new leaves of the carry and those of the log. ``outputs`` are the
    elements (leaf, element) of the carry that are wanted after the run. ``active`` are
    the leaves (part, leaf) with derivatives, if any.

    Raises NotScalarError for a step that has no such form or is too long.
    """
    places = inputs_of(parts)
    differentiated = [*active]
    if active:
        carry = [("carry", leaf) for leaf, x in enumerate(parts[1]) if is_real(x)]
        differentiated += [each for each in carry if each not in active]
        names: tuple[str, ...] = ("system", "carry", "row")
        shape_of: dict[str, Any] = dict(zip(names, parts, strict=True))
        tangents = [shape_of[part][leaf] for part, leaf in differentiated]
        for (part, leaf), x in zip(differentiated, tangents, strict=True):
            places += places_of(part, [(leaf, x)], tangent=True)
        function, more = _with_slopes(step, differentiated), [tangents]
    else:
        function, more = step, []
    with jax.ensure_compile_time_eval():
        graph, results = unrolled(function, *parts, INDEX, *more)
    leaves, half = len(parts[1]), len(results) // 2 if active else len(results)
    after = nodes_by_place("carry", enumerate(results[:leaves]))
    slopes = nodes_by_place(
        "carry", enumerate(results[half : half + leaves]), tangent=True
    )
    zero: frozenset[int] = frozenset()
    if active:
        # The derivatives of leaves that are not active vanish before the first step.
        vanish = {
            place
            for place in places
            if place.tangent and (place.part, place.leaf) not in active
        }
        zero = vanishing(graph, places, slopes, vanish)
    return sorted_step(
        graph,
        places,
        after | slopes,
        zero,
        {Place("carry", *each, slope) for each in outputs for slope in (False, True)},
        _flat(results[leaves:half]),
        _flat(results[half + leaves :]),
    )


def inputs_of(parts: Sequence[Sequence[jax.ShapeDtypeStruct]]) -> list[Place]:
    """Return the places of the inputs of a step with leaves of these shapes.

    Raises NotScalarError if one is too long.
    """
    if max((math.prod(x.shape) for part in parts for x in part), default=0) >= LONG:
        raise NotScalarError("it has a long array")
    places = [
        place
        for part, leaves in zip(("system", "carry", "row"), parts, strict=True)
        for place in places_of(part, enumerate(leaves))
    ]
    return [*places, Place("index", 0, 0)]


def places_of(
    part: str, leaves: Iterable[tuple[int, Any]], *, tangent: bool = False
) -> list[Place]:
    """Return the places of the elements of numbered leaves."""
    return [
        Place(part, leaf, element, tangent)
        for leaf, x in leaves
        for element in range(math.prod(x.shape))
    ]


def _with_slopes(step: Callable, differentiated: Sequence[tuple[str, int]]) -> Callable:
    """Return the step with its derivatives in the direction ``tangents``."""

    def function(system, carry, row, index, tangents):
        parts = {"system": [*system], "carry": [*carry], "row": [*row]}
        values = [parts[part][leaf] for part, leaf in differentiated]

        def of(values):
            for (part, leaf), value in zip(differentiated, values, strict=True):
                parts[part][leaf] = value
            return step(parts["system"], parts["carry"], parts["row"], index)

        # The tangents of integers are of the type float0, without a value.
        results, slopes = jax.jvp(of, (values,), (tangents,))
        return results, jax.tree.map(
            lambda x, t: t if is_real(x) else jnp.zeros(jnp.shape(x)),
            results,
            slopes,
        )

    return function


def sorted_step(
    graph: Graph,
    places: list[Place],
    after: dict[Place, int],
    zero: frozenset[int],
    wanted: Collection[Place],
    log: list[int],
    log_slopes: list[int],
) -> ScalarStep:
    """Return the step that computes the elements ``wanted`` and the log.

    ``after`` are the nodes of the carry after the step, ``zero`` those of derivatives
    that vanish. Raises NotScalarError for a step that is too long or has a loop.
    """

    def needed() -> set[int]:
        nodes = [*(after[place] for place in kept), *log, *log_slopes]
        return graph.needed(nodes, zero) - zero

    # The elements of the carry on which the results depend, at this step or later ones.
    kept = {
        place
        for place in wanted
        if place in after and not (place.tangent and after[place] in zero)
    }
    while more := _read(graph, places, needed()) - kept:
        kept |= more
    numbers = needed()
    if graph.loops or len(numbers) > MOST:
        raise NotScalarError("it has a loop, or too many operations for a kernel")
    steady, steady_slopes, moving, moving_slopes = _divided(graph, places, numbers)
    elements = [Element(place, after[place]) for place in sorted(kept)]
    return ScalarStep(
        graph,
        places,
        [each for each in elements if not each.place.tangent],
        log,
        steady,
        moving,
        [each for each in elements if each.place.tangent],
        log_slopes,
        steady_slopes,
        moving_slopes,
        zero,
    )


def _read(
    graph: Graph, places: Sequence[Place], numbers: Collection[int]
) -> set[Place]:
    """Return the elements of the carry, and the totals, among nodes."""
    nodes = (graph.nodes[number] for number in numbers)
    read = {places[int(node.value)] for node in nodes if node.operation == INPUT}
    return {place for place in read if place.part in ("carry", "total")}


def _divided(
    graph: Graph, places: Sequence[Place], needed: Collection[int]
) -> tuple[list[int], ...]:
    """Return the needed nodes: steady, steady slopes, moving, and moving slopes.

    Each list is in the order of computation.
    """
    found: tuple[list[int], ...] = ([], [], [], [])
    moving: set[int] = set()
    sloping: set[int] = set()
    for number in graph.block.order:
        node = graph.nodes[number]
        if number not in needed or node.operation == CONSTANT:
            continue
        if node.operation == INPUT:
            place = places[int(node.value)]
            moves, slopes = place.part != "system", place.tangent
        else:
            moves = not moving.isdisjoint(node.operands)
            slopes = not sloping.isdisjoint(node.operands)
        if moves:
            moving.add(number)
        if slopes:
            sloping.add(number)
        found[2 * moves + slopes].append(number)
    return found


def vanishing(
    graph: Graph,
    places: Sequence[Place],
    slopes: dict[Place, int],
    vanish: set[Place],
    always: Collection[Place] = (),
) -> frozenset[int]:
    """Return the nodes of derivatives that vanish, and those of the constant 0.

    ``slopes`` are the nodes of the derivatives of the carry after a step. Derivatives
    at ``vanish`` are 0 before the first step, those at ``always`` before each step.
    """
    vanish = vanish.union(always)
    while True:
        zero: set[int] = set()
        directed: set[int] = set()
        for number, node in enumerate(graph.nodes):
            if node.operation == INPUT:
                place = places[int(node.value)]
                if place.tangent:
                    directed.add(number)
                    if place in vanish:
                        zero.add(number)
            elif node.operation == CONSTANT:
                if node.kind == "real" and node.value == 0.0:
                    zero.add(number)
            elif not directed.isdisjoint(node.operands):
                directed.add(number)
                values = node.operands[FIRST_VALUE.get(node.operation, 0) :]
                join = any if node.operation == "mul" else all
                if node.operation == "div":
                    values = values[:1]
                if node.kind == "real" and join(n in zero for n in values):
                    zero.add(number)
        left = {p for p in vanish if p in always or slopes.get(p) in zero}
        if left == vanish:
            return frozenset(zero)
        vanish = left


FIRST_VALUE = {"select_n": 1}
"""Position of the first operand that is a value and not a condition."""


def is_real(x: Any) -> bool:
    """Return whether an array, or its type, is of real numbers."""
    return bool(jnp.issubdtype(jnp.result_type(x), jnp.floating))


def _flat(arrays: Sequence[np.ndarray]) -> list[int]:
    return [int(number) for array in arrays for number in array.ravel()]


def nodes_by_place(
    part: str, leaves: Iterable[tuple[int, np.ndarray]], *, tangent: bool = False
) -> dict[Place, int]:
    """Return the nodes in the arrays of numbered leaves, by their place."""
    return {
        Place(part, leaf, element, tangent): int(number)
        for leaf, array in leaves
        for element, number in enumerate(array.ravel())
    }
