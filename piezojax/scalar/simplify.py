"""Simplification of operations as they are added to a graph."""

from typing import Any

from .graph import CONSTANT, Graph, Kind


class Simplifier:
    """Builder that adds simplified operations to ``graph``.

    An operation with a neutral operand, such as 0 in a sum, is left out. The product of
    x and the sign of x becomes the absolute value of x, because the sign of a noisy
    signal is a branch that processors cannot predict.
    """

    def __init__(self, graph: Graph):
        self.graph = graph
        self._signs: dict[int, tuple[int, int]] = {}
        """x and p of each node that is p for x >= 0, and -p otherwise."""

    def add(
        self, name: str, operands: list[int], kind: Kind, value: Any, source: str
    ) -> int:
        """Return the node of an operation, simplified if possible."""
        neutral = self._neutral(name, operands, kind)
        if neutral is not None:
            return neutral
        if name == "mul":
            return self._product(operands, kind, source)
        number = self.graph.add(name, operands, kind, value, source)
        if name == "select_n" and kind == "real":
            self._note_sign(number, operands)
        return number

    def _neutral(self, name: str, operands: list[int], kind: Kind) -> int | None:
        """Return the operand that equals the result, or None."""
        known = [self._constant(number) for number in operands]
        if name == "convert_element_type":
            return operands[0] if self.graph.nodes[operands[0]].kind == kind else None
        if name == "select_n":
            if known[0] is not None:
                return operands[1 + int(known[0])]
            return operands[1] if len(set(operands[1:])) == 1 else None
        if (name in ("mul", "div") and known[1] == 1.0) or (
            name in ("add", "sub") and known[1] == 0.0
        ):
            return operands[0]
        if (name, known[0]) in (("mul", 1.0), ("add", 0.0)):
            return operands[1]
        return None

    def _product(self, operands: list[int], kind: Kind, source: str) -> int:
        for one, other in (operands, operands[::-1]):
            x, size = self._signs.get(one, (None, one))
            if x == other:
                absolute = self.add("abs", [other], kind, None, source)
                return self.add("mul", [size, absolute], kind, None, source)
        number = self.graph.add("mul", operands, kind, None, source)
        for one, other in (operands, operands[::-1]):
            if one in self._signs:
                x, size = self._signs[one]
                product = self.add("mul", [size, other], kind, None, source)
                self._signs[number] = x, product
                break
        return number

    def _note_sign(self, number: int, operands: list[int]) -> None:
        condition = self.graph.nodes[operands[0]]
        negative, positive = map(self._constant, operands[1:])
        if condition.operation != "ge" or negative is None or positive is None:
            return
        x, limit = condition.operands
        if self._constant(limit) == 0.0 and positive == -negative > 0.0:
            self._signs[number] = x, operands[2]

    def _constant(self, number: int) -> Any:
        """Return the value of a constant, or None for every other node."""
        node = self.graph.nodes[number]
        return node.value if node.operation == CONSTANT else None
