"""Compensated summation of the states of an exported System.

A state whose next value is a sum with itself, such as an integral, is stored with the
rounding error of its value (Knuth, The Art of Computer Programming 2, 4.2.2; Neumaier,
ZAMM 54, 1974). It then accumulates increments far below the last digit of its value.
"""

from collections.abc import Mapping, Sequence

from ..scalar.graph import INPUT, Graph

SUMS = {"add", "sub"}
"""Operations whose rounding error is carried."""

PASSING = {*SUMS, "neg", "select_n", "max", "min", "clamp"}
"""Operations that pass on the error of an operand."""


def compensate(
    graph: Graph, next_states: Mapping[int, int], first: int
) -> dict[int, tuple[int, int]]:
    """Return the nodes of next value and next error of each compensated state.

    ``next_states`` maps the place of each state among the inputs to the node of its
    next value. The result maps the places of the compensated states. Their errors are
    new inputs from place ``first`` on, in the order of the result.
    """
    needed = sorted(graph.needed(list(next_states.values())))
    places = _summed(graph, needed, next_states)
    errors = _Errors(graph)
    for i, place in enumerate(places):
        state = graph.add(INPUT, (), "real", place, "")
        errors.of[state] = graph.add(INPUT, (), "real", first + i, "")
    for number in needed:
        errors.follow(number)
    return {place: errors.renormalised(next_states[place]) for place in places}


def _summed(
    graph: Graph, needed: Sequence[int], next_states: Mapping[int, int]
) -> list[int]:
    """Return the places of the states whose next value is a sum with themselves."""
    bits = {place: 1 << i for i, place in enumerate(next_states)}
    reads: dict[int, int] = {}  # states that reach a node, one bit each
    summed: dict[int, int] = {}  # those that reach it through a sum
    for number in needed:
        node = graph.nodes[number]
        reads[number] = summed[number] = 0
        if node.operation == INPUT and node.kind == "real":
            reads[number] = bits.get(int(node.value), 0)
        elif node.operation in PASSING:
            for operand in node.operands:
                reads[number] |= reads[operand]
                summed[number] |= summed[operand]
            if node.operation in SUMS:
                summed[number] = reads[number]
    return [p for p, number in next_states.items() if summed[number] & bits[p]]


class _Errors:
    """Nodes of rounding errors; ``of`` maps each inexact node to its error."""

    def __init__(self, graph: Graph):
        self.graph = graph
        self.of: dict[int, int] = {}
        self.zero = graph.constant(0.0, "real")

    def _add(self, name: str, *operands: int, test: bool = False) -> int:
        kind = "boolean" if test else "real"
        return self.graph.add(name, operands, kind, None, "compensate")

    def follow(self, number: int) -> None:
        """Add the error of the node ``number`` if it passes on that of an operand."""
        name, operands, kind, *_ = self.graph.nodes[number]
        known = any(operand in self.of for operand in operands)
        if not known or name not in PASSING or kind != "real":
            return
        if self.graph.levels[number] > 0:
            return  # in a loop, whose result counts as exact
        a, b = operands[0], operands[-1]
        left, right = (self.of.get(operand, self.zero) for operand in (a, b))
        if name in SUMS:
            back = self._add("sub", number, a)
            of_a = self._add("sub", a, self._add("sub", number, back))
            of_b = self._add("sub" if name == "add" else "add", b, back)
            error = self._add(name, of_a, of_b)
            for operand, sign in ((a, "add"), (b, name)):
                if operand in self.of:
                    error = self._add(sign, error, self.of[operand])
        elif name == "neg":
            error = self._add("neg", left)
        elif name == "select_n":
            left = self.of.get(operands[1], self.zero)
            error = self._add("select_n", a, left, right)
        elif name == "clamp":
            inside = self._add("eq", number, operands[1], test=True)
            middle = self.of.get(operands[1], self.zero)
            error = self._add("select_n", inside, self.zero, middle)
        else:
            larger = self._add("gt", a, b, test=True)
            pair = (right, left) if name == "max" else (left, right)
            error = self._add("select_n", larger, *pair)
        self.of[number] = error

    def renormalised(self, number: int) -> tuple[int, int]:
        """Return the nodes of the rounded sum of value and error, and of its error."""
        error = self.of[number]
        finite = self._add("is_finite", error, test=True)
        error = self._add("select_n", finite, self.zero, error)
        value = self._add("add", number, error)
        return value, self._add("sub", error, self._add("sub", value, number))
