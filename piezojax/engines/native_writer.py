"""Statements in C for a lane of a run."""

from collections.abc import Iterable, Sequence
from types import MappingProxyType
from typing import NamedTuple

from ..scalar.c_source import BITWISE, DOUBLE, FORMS, LOGICAL, Writer
from ..scalar.graph import CONSTANT, INPUT, Node
from . import native_math
from .scalar_step import Place, ScalarStep


class Rows(NamedTuple):
    """A leaf of the inputs: its number of elements, and whether they differ by lane."""

    size: int
    by_lane: bool


class Arrays(NamedTuple):
    """Elements in the columns of the arrays of ``run_blocks``.

    ``shared`` are the numbers of a system that are equal in all lanes, ``own`` those
    that differ, and ``slopes`` the tangents of numbers. ``end`` and ``slope_end`` are
    the elements of the carry that are wanted after the last step.
    """

    shared: list[Place]
    own: list[Place]
    slopes: list[Place]
    end: list[Place]
    slope_end: list[Place]


class LaneWriter(Writer):
    """Writer of the statements of a lane.

    Maximum and minimum are NaN if an operand is NaN, because a loop that diverges must
    not look finite behind a limit. A division by a constant or steady value is written
    as a product with its reciprocal.
    """

    forms = FORMS | {
        "max": "(({a} > {b}) | ({a} != {a})) ? {a} : {b}",
        "min": "(({a} < {b}) | ({a} != {a})) ? {a} : {b}",
        "sign": "{a} > 0 ? 1 : ({a} < 0 ? -1 : {a})",
        "is_finite": "fabs({a}) <= 1.7976931348623157e308",
        **native_math.FORMS,
    }
    logical = LOGICAL | BITWISE  # without branches
    types = MappingProxyType({"integer": "int64_t", "boolean": "bool"})

    def __init__(self, step: ScalarStep, arrays: Arrays, rows: Sequence[Rows]):
        self.step, self.rows = step, rows
        self.columns = {place: f"shared[{i}]" for i, place in enumerate(arrays.shared)}
        for name in ("own", "slopes"):
            for i, place in enumerate(getattr(arrays, name)):
                self.columns[place] = f"{name}[{i}*STRIDE + l]"
        self.kinds = {n.value: n.kind for n in step.graph.nodes if n.operation == INPUT}
        self.inverse: dict[int, str] = {}
        self.stored = {number: "0.0" for number in step.zero}
        super().__init__(step.graph, step.last, self.input, DOUBLE, self.stored)

    def input(self, number: int) -> str:
        """Return the expression of an input of the step."""
        place = self.step.places[number]
        if place.part == "system":
            return self.typed(self.columns[place], self.kinds[number])
        if place.part == "index":
            return "k"
        if place.part in ("carry", "total"):
            return carried_name(place)
        size, by_lane = self.rows[place.leaf]
        where = f"k*{size} + {place.element}"
        return f"in{place.leaf}[{f'({where})*lanes + l' if by_lane else where}]"

    def typed(self, text: str, kind: str) -> str:
        """Return an element of an array of doubles in the type of a kind."""
        if kind == "boolean":
            return f"({text} != 0.0)"
        return f"(int64_t){text}" if kind == "integer" else text

    def _operation(self, node: Node, operands: Sequence[str]) -> str:
        if node.operation == "div" and node.kind == "real":
            divisor = node.operands[1]
            if self.graph.nodes[divisor].operation == CONSTANT:
                return f"{operands[0]} * (1.0 / {operands[1]})"
            if divisor in self.inverse:
                return f"{operands[0]} * {self.inverse[divisor]}"
        return super()._operation(node, operands)

    def real(self, number: int) -> str:
        """Return the expression of a node as a double.

        Compilers do not vectorise the conversion of a boolean.
        """
        text = self.expression(number)
        return f"{text} ? 1.0 : 0.0" if self._kind(number) == "boolean" else text

    def _kind(self, number: int) -> str:
        return self.graph.nodes[number].kind

    def statements(self, numbers: Iterable[int]) -> list[str]:
        """Return the statements of nodes that are not inputs."""
        nodes = self.graph.nodes
        return [
            self.statement(number, "")
            for number in numbers
            if nodes[number].operation != INPUT
        ]

    def store(self, numbers: Iterable[int], write: str, read: str) -> list[str]:
        """Return the statements that store nodes; later expressions read the copies."""
        lines = []
        for number in numbers:
            lines.append(f"{write.format(f'v{number}')} = {self.real(number)};")
            text = read.format(f"v{number}")
            self.stored[number] = self.typed(text, self._kind(number))
        return lines

    def invert(self, numbers: Iterable[int], write: str, read: str) -> list[str]:
        """Return the statements that store the reciprocals of nodes."""
        lines = []
        for number in numbers:
            value = self.expression(number)
            lines.append(f"{write.format(f'r{number}')} = 1.0 / {value};")
            self.inverse[number] = read.format(f"r{number}")
        return lines


def carried_name(place: Place) -> str:
    """Return the name of an element of the carry, or of a total of derivatives."""
    letter = "t" if place.part == "total" else "d" if place.tangent else "x"
    return f"{letter}{place.leaf}_{place.element}"
