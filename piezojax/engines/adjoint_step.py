"""A step of the reverse pass of a run as scalar operations."""

from collections.abc import Callable, Collection, Sequence
from typing import Any

import jax
import jax.numpy as jnp

from ..scalar.graph import INPUT, Graph
from ..scalar.memory import NotScalarError
from .scalar_step import (
    FIRST_VALUE,
    INDEX,
    Place,
    ScalarStep,
    inputs_of,
    is_real,
    nodes_by_place,
    places_of,
    sorted_step,
    unrolled,
    vanishing,
)


def adjoint_step(
    step: Callable[..., Any],
    parts: Sequence[Sequence[jax.ShapeDtypeStruct]],
    outputs: Collection[tuple[int, int]],
    active: Collection[tuple[str, int]],
    logged: int,
) -> ScalarStep:
    """Return the scalar operations of a step and of its reverse pass.

    The arguments are those of ``scalar_step``; the outputs of the log have ``logged``
    elements. ``slopes`` map the derivatives of the run's result with respect to the
    carry after the step to those with respect to the carry before it. The derivatives
    with respect to the log are a further leaf of the row. Those with respect to the
    numbers of the system are added to the totals (part "total").

    Raises NotScalarError as ``scalar_step`` does, and if JAX has no reverse pass for
    the step.
    """
    system = [leaf for part, leaf in active if part == "system"]
    carry = [leaf for leaf, x in enumerate(parts[1]) if is_real(x)]
    numbers, states = [parts[0][i] for i in system], [parts[1][i] for i in carry]
    log = jax.ShapeDtypeStruct((logged,), float)
    places = [
        *inputs_of(parts),
        *places_of("carry", zip(carry, states, strict=True), tangent=True),
        *places_of("total", zip(system, numbers, strict=True), tangent=True),
        *places_of("row", [(len(parts[2]), log)], tangent=True),
    ]
    function = _with_reverse_pass(step, system, carry)
    try:
        with jax.ensure_compile_time_eval():
            graph, results = unrolled(
                function, *parts, INDEX, [*states], [*numbers], log
            )
    except NotScalarError:
        raise
    except (TypeError, ValueError, NotImplementedError) as error:
        raise NotScalarError(f"it has no reverse pass: {error}") from error
    ends = len(parts[1]), len(parts[1]) + len(carry)
    after = nodes_by_place("carry", enumerate(results[: ends[0]]))
    slopes = nodes_by_place(
        "carry", zip(carry, results[ends[0] : ends[1]], strict=True), tangent=True
    )
    totals = nodes_by_place(
        "total", zip(system, results[ends[1] :], strict=True), tangent=True
    )
    of_result = {Place("carry", *each, tangent=True) for each in outputs}
    constant = slopes.keys() - {
        place._replace(tangent=True)
        for place in _dependent(graph, places, after, active)
    }
    zero = vanishing(
        graph, places, slopes, slopes.keys() - of_result, frozenset(constant)
    )
    wanted = {place for place in slopes if ("carry", place.leaf) in active}
    return sorted_step(
        graph, places, after | slopes | totals, zero, wanted | totals.keys(), [], []
    )


def _with_reverse_pass(
    step: Callable[..., Any], system: Sequence[int], carry: Sequence[int]
) -> Callable[..., Any]:
    """Return the step followed by its reverse pass.

    ``system`` and ``carry`` are the leaves with derivatives.
    """

    def function(numbers, states, row, index, slopes, totals, log_slopes):
        def of(changed_numbers, changed_states):
            new_numbers, new_states = [*numbers], [*states]
            for leaf, x in zip(system, changed_numbers, strict=True):
                new_numbers[leaf] = x
            for leaf, x in zip(carry, changed_states, strict=True):
                new_states[leaf] = x
            results = step(new_numbers, new_states, row, index)
            after, log = results[: len(states)], results[len(states) :]
            columns = [jnp.ravel(x).astype(float) for x in log]
            found = [after[leaf] for leaf in carry]
            return (found, jnp.concatenate([jnp.zeros(0), *columns])), after

        values = [numbers[leaf] for leaf in system], [states[leaf] for leaf in carry]
        _, reverse, after = jax.vjp(of, *values, has_aux=True)
        more, before = reverse((slopes, log_slopes))
        totals = [total + x for total, x in zip(totals, more, strict=True)]
        return [*after, *before, *totals]

    return function


def _dependent(
    graph: Graph,
    places: Sequence[Place],
    after: dict[Place, int],
    active: Collection[tuple[str, int]],
) -> set[Place]:
    """Return the active elements, and those of the carry that depend on them."""
    found = {p for p in places if not p.tangent and (p.part, p.leaf) in active}
    while True:
        depends: set[int] = set()
        for number, node in enumerate(graph.nodes):
            values = node.operands[FIRST_VALUE.get(node.operation, 0) :]
            if node.operation == INPUT:
                if places[int(node.value)] in found:
                    depends.add(number)
            elif node.kind == "real" and not depends.isdisjoint(values):
                depends.add(number)
        more = {place for place, node in after.items() if node in depends} - found
        if not more:
            return found
        found |= more
