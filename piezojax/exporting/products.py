"""Rewriting of products of a signal and parameters as one multiplication."""

from ..scalar.graph import CONSTANT, Graph
from .prepared import varying_nodes

SHARP = {
    *("floor", "ceil", "round", "sign", "rem", "convert_element_type"),
    *("eq", "ne", "lt", "le", "gt", "ge"),
}
"""Discontinuous operations: a rounding error of an operand may cause a jump."""


def shorten_products(graph: Graph, parameters: int) -> None:
    """Rewrite products of a signal x with numbers that depend on parameters alone.

    The first ``parameters`` inputs are parameters. With such numbers p and q, x / p
    becomes x * (1 / p), and x * p * q becomes x * (p * q). A step then has a shorter
    chain of operations and fewer divisions. The results differ by rounding errors; the
    operands of ``SHARP`` operations are not rewritten.
    """
    _Products(graph, parameters).rewrite()


class _Products:
    def __init__(self, graph: Graph, parameters: int):
        self.graph = graph
        self.varying = varying_nodes(graph, parameters)
        self.sharp = {
            operand
            for node in graph.nodes
            if node.operation in SHARP
            for operand in node.operands
        }
        self.products: dict[int, tuple[int, int]] = {}
        """Signal and factor of each product, by node."""

    def rewrite(self) -> None:
        for number in range(len(self.graph.nodes)):
            product = self._product(number)
            if product is None or number in self.sharp:
                continue
            self.products[number] = product
            node = self.graph.nodes[number]
            if node.operation != "neg":
                new = node._replace(operation="mul", operands=product)
                self.graph.nodes[number] = new

    def _fixed(self, number: int) -> bool:
        return number not in self.varying and self.graph.levels[number] == 0

    def _product(self, number: int) -> tuple[int, int] | None:
        """Return signal and factor of a node, or None if it is not such a product."""
        node = self.graph.nodes[number]
        if node.kind != "real" or number not in self.varying:
            return None
        if node.operation == "neg":
            signal, factor = node.operands[0], self.graph.constant(-1.0, "real")
        elif node.operation == "div" and self._fixed(node.operands[1]):
            signal, factor = node.operands[0], self._reciprocal(node.operands[1])
        elif node.operation == "mul" and any(map(self._fixed, node.operands)):
            signal, factor = sorted(node.operands, key=self._fixed)
        else:
            return None
        if signal in self.products:
            signal, inner = self.products[signal]
            factor = self._times(inner, factor)
        return signal, factor

    def _reciprocal(self, number: int) -> int:
        node = self.graph.nodes[number]
        if node.operation == CONSTANT and node.value:
            return self.graph.constant(1.0 / node.value, "real")
        return self._added("div", (self.graph.constant(1.0, "real"), number))

    def _times(self, one: int, other: int) -> int:
        """Return the node of a product of two nodes; constants are multiplied here."""
        a, b = self._value(one), self._value(other)
        if a is not None and b is not None:
            return self.graph.constant(a * b, "real")
        for value, number in ((a, other), (b, one)):
            if value == 1.0:
                return number
            if value == -1.0:
                return self._added("neg", (number,))
        return self._added("mul", (one, other))

    def _value(self, number: int) -> float | None:
        node = self.graph.nodes[number]
        return node.value if node.operation == CONSTANT else None

    def _added(self, operation: str, operands: tuple[int, ...]) -> int:
        source = self.graph.nodes[operands[-1]].source
        return self.graph.add(operation, operands, "real", source=source)
