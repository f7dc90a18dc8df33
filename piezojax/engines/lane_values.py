"""Values of the steady nodes of a step for many lanes, as tables of columns."""

import math
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from ..scalar.graph import CONSTANT, INPUT, Graph, Kind
from .scalar_step import Place, ScalarStep

TYPES: dict[Kind, Any] = {
    "real": jnp.float64,
    "integer": jnp.int32,
    "boolean": jnp.bool_,
}


def _larger(a: Array, b: Array) -> Array:
    """Return the larger number, or NaN if one is NaN; Triton's maximum drops NaN.

    A loop that diverges must not look finite behind a limit.
    """
    return jnp.where((a > b) | (a != a), a, b)


def _smaller(a: Array, b: Array) -> Array:
    """Return the smaller number, or NaN if one is NaN."""
    return jnp.where((a < b) | (a != a), a, b)


def _rounded(x: Array, method: Any) -> Array:
    below = lax.floor(x)
    rest = x - below
    if method == lax.RoundingMethod.TO_NEAREST_EVEN:
        up = below != 2.0 * lax.floor(0.5 * below)
    else:
        up = x > 0.0
    return jnp.where((rest > 0.5) | ((rest == 0.5) & up), below + 1.0, below)


OPERATIONS: dict[str, Callable[..., Array]] = {
    **{
        name: getattr(lax, name)
        for name in (
            *("abs", "acos", "add", "asin", "atan", "atan2", "ceil", "cos", "cosh"),
            *("div", "eq", "exp", "expm1", "floor", "ge", "gt", "is_finite", "le"),
            *("log", "log1p", "logistic", "lt", "mul", "ne", "neg"),
            *("pow", "rem", "rsqrt", "sign", "sin", "sinh", "sqrt", "square", "sub"),
            *("tan", "tanh"),
        )
    },
    "and": lax.bitwise_and,
    "clamp": lambda least, x, most: _larger(least, _smaller(x, most)),
    "integer_pow": lax.integer_pow,
    "max": _larger,
    "min": _smaller,
    "not": lax.bitwise_not,
    "or": lax.bitwise_or,
    "round": _rounded,
    "select_n": lax.select_n,
    "xor": lax.bitwise_xor,
}
"""Operations on arrays, by their name in a graph."""

CONVERT = "convert_element_type"


def has_values(step: ScalarStep) -> bool:
    """Return whether ``values`` can compute all operations of a step."""
    return step.operations() <= {*OPERATIONS, CONVERT}


class LaneValues:
    """Values of the steady nodes of a step, and of the carry before the first step.

    ``leaves`` holds the leaves of system and carry by (part, leaf, tangent). Their
    first axes are directions, outer and inner lanes (see ``Batch``). An axis has the
    size 1 if all values along it are equal.
    """

    def __init__(self, step: ScalarStep, leaves: dict[tuple[str, int, bool], Array]):
        self.step = step
        self._where: dict[tuple, tuple[tuple[int, ...], int]] = {}
        parts: dict[tuple[int, ...], list[Array]] = {}
        for key, leaf in leaves.items():
            shape = leaf.shape[:3]
            rows = leaf.reshape(*shape, math.prod(leaf.shape[3:])).astype(float)
            known = parts.setdefault(shape, [])
            first = sum(part.shape[-1] for part in known)
            for element in range(rows.shape[-1]):
                self._where[(*key, element)] = shape, first + element
            known.append(rows)
        self._arrays = {
            shape: jnp.concatenate(each, axis=-1) for shape, each in parts.items()
        }

    def _find(self, place: Place) -> tuple[tuple[int, ...], int]:
        return self._where[place.part, place.leaf, place.tangent, place.element]

    def _given(self, number: int, kind: Kind) -> Array:
        shape, column = self._find(self.step.places[number])
        return typed(self._arrays[shape][..., column], kind)

    def is_shared(self, place: Place) -> bool:
        """Return whether an element has the same value in all lanes."""
        return math.prod(self._find(place)[0]) == 1

    def elements(self, places: Sequence[Place], counts: Sequence[int]) -> Array:
        """Return the values at places, [*counts, places]."""
        found, order = [jnp.zeros((*counts, 0))], []
        for key, array in self._arrays.items():
            mine = [i for i, place in enumerate(places) if self._find(place)[0] == key]
            if not mine:
                continue
            # The elements are read in one operation: thousands of small ones would
            # take the compiler minutes.
            columns = np.array([self._find(places[i])[1] for i in mine], int)
            found.append(jnp.broadcast_to(array[..., columns], (*counts, len(mine))))
            order += mine
        return jnp.concatenate(found, axis=-1)[..., np.argsort(np.array(order, int))]

    def nodes(self) -> dict[int, Array]:
        """Return the values of the steady nodes that are not inputs."""
        step, nodes = self.step, self.step.graph.nodes
        computed = [n for n in step.steady if nodes[n].operation != INPUT]
        read = {n for each in computed for n in nodes[each].operands}
        numbers = [n for n in step.steady if n in read or nodes[n].operation != INPUT]
        known = values(step.graph, numbers, {}, self._given)
        return {number: known[number] for number in computed}


def values(
    graph: Graph,
    numbers: Iterable[int],
    known: dict[int, Array],
    given: Callable[[int, Kind], Array],
) -> dict[int, Array]:
    """Add the values of nodes to ``known`` and return it; ``given`` returns inputs."""
    for number in numbers:
        node = graph.nodes[number]
        if node.operation == INPUT:
            known[number] = given(int(node.value), node.kind)
            continue
        operands = [value(graph, known, each) for each in node.operands]
        shape = jnp.broadcast_shapes(*(x.shape for x in operands))
        operands = [jnp.broadcast_to(x, shape) for x in operands]
        if node.operation == CONVERT:
            known[number] = typed(operands[0], node.kind)
        else:
            more = () if node.value is None else (node.value,)
            known[number] = OPERATIONS[node.operation](*operands, *more)
    return known


def value(graph: Graph, known: dict[int, Array], number: int) -> Array:
    """Return the value of a node, which is a constant or ``known``."""
    node = graph.nodes[number]
    if node.operation == CONSTANT:
        return jnp.asarray(node.value, TYPES[node.kind])
    return known[number]


def typed(x: Array, kind: Kind) -> Array:
    """Return ``x`` in the type of a kind."""
    if kind == "boolean":
        return x if x.dtype == bool else x != 0
    return x.astype(TYPES[kind])
