"""C99 source of the operations of a graph."""

import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from types import MappingProxyType
from typing import NamedTuple

import jax
import numpy as np

from .graph import CARRY, CONSTANT, INPUT, READ, RESULT, Block, Graph, Node
from .rolled import ROLLED, Piece, constant_array, pieces

INFIX = {
    "add": "+", "sub": "-", "mul": "*", "div": "/",
    "eq": "==", "ne": "!=", "lt": "<", "le": "<=", "gt": ">", "ge": ">=",
}  # fmt: skip
"""Infix operators of C for real and integer operands, by operation of JAX."""

LOGICAL = {"and": "&&", "or": "||", "xor": "!=", "eq": "==", "ne": "!="}
"""Infix operators of C for boolean operands."""

BITWISE = {"and": "&", "or": "|", "xor": "^"}
"""Infix operators of C for integer operands."""

FUNCTIONS = {
    "abs": "fabs", "acos": "acos", "asin": "asin", "atan": "atan", "atan2": "atan2",
    "ceil": "ceil", "cos": "cos", "cosh": "cosh", "exp": "exp", "expm1": "expm1",
    "floor": "floor", "log": "log", "log1p": "log1p", "pow": "pow", "rem": "fmod",
    "sin": "sin", "sinh": "sinh", "sqrt": "sqrt", "tan": "tan",
    "tanh": "tanh",
}  # fmt: skip
"""Functions of libm by the name of the operation in JAX."""

FORMS = {
    "select_n": "{a} ? {c} : {b}",
    "not": "!{a}",
    "neg": "-{a}",
    "max": "{a} > {b} ? {a} : {b}",
    "min": "{a} < {b} ? {a} : {b}",
    "clamp": "{b} < {a} ? {a} : ({b} > {c} ? {c} : {b})",
    "sign": "({type})(({a} > 0) - ({a} < 0))",
    "square": "{a} * {a}",
    "rsqrt": "{one} / sqrt{f}({a})",
    "logistic": "{one} / ({one} + exp{f}(-{a}))",
    "is_finite": "isfinite({a}) != 0",
    "convert_element_type": "({type})({a})",
}
"""Expressions of other operations: operands a, b and c, suffix f of functions."""

OF_KIND = {
    ("convert_element_type", "boolean"): "{a} != 0",
    ("rem", "integer"): "{a} % {b}",
    ("not", "integer"): "~{a}",
    ("abs", "integer"): "labs({a})",
}
"""Expressions that replace those above for a result of this kind."""

NOTHING = (CONSTANT, INPUT, CARRY, RESULT)
"""Operations without a statement in C."""

TYPES = {"integer": "long", "boolean": "int"}


class Precision(NamedTuple):
    """C type of real numbers, with the suffix of its literals and functions.

    With ``compensated``, states that are sums carry their rounding errors.
    """

    real: str
    suffix: str
    dtype: type[np.floating]
    compensated: bool = False

    def number(self, value: float) -> str:
        """Return the C literal of ``value``, rounded to this precision."""
        rounded = self.dtype(value)
        if np.isnan(rounded):
            return "NAN"
        if np.isinf(rounded):
            return "HUGE_VAL" if rounded > 0 else "-HUGE_VAL"
        text = repr(float(rounded)) if self.dtype is np.float64 else str(rounded)
        return text + ("" if set(text) & set(".e") else ".0") + self.suffix


DOUBLE = Precision("double", "", np.float64)
SINGLE = Precision("float", "f", np.float32)
COMPENSATED = SINGLE._replace(compensated=True)
PRECISIONS = {"double": DOUBLE, "float": SINGLE, "compensated": COMPENSATED}
"""Precisions by their name in an export."""


def statements(
    graph: Graph,
    outputs: Sequence[int],
    names: Callable[[int], str],
    precision: Precision,
    held: Mapping[int, str] = MappingProxyType({}),
) -> tuple[list[str], Callable[[int], str]]:
    """Return the statements that compute ``outputs``, and a function for expressions.

    The function returns the C expression of a node. ``names`` returns the expression of
    an input by its place; ``held`` holds the expressions of nodes that are computed
    elsewhere. A comment names the Python function behind each group of operations.
    """
    writer = Writer(graph, outputs, names, precision, held)
    return list(writer.block(graph.block, "    ")), writer.expression


class Writer:
    """Writer of the operations of a graph, with the arguments of ``statements``.

    ``forms`` are the expressions of operations, ``logical`` the infix operators of
    boolean operands, and ``types`` the types of C.
    """

    forms: Mapping[str, str] = FORMS
    logical: Mapping[str, str] = LOGICAL
    types: Mapping[str, str] = TYPES

    def __init__(
        self,
        graph: Graph,
        outputs: Sequence[int],
        names: Callable[[int], str],
        precision: Precision,
        held: Mapping[int, str],
    ):
        self.graph, self.names, self.precision = graph, names, precision
        self.needed, self.held = graph.needed(outputs, held), held
        self.variables: dict[int, str] = {}

    def expression(self, number: int) -> str:
        """Return the expression of a node."""
        if number in self.held:
            return self.held[number]
        node = self.graph.nodes[number]
        if node.operation == CONSTANT:
            return self._constant(node)
        if node.operation == INPUT:
            return self.names(int(node.value))
        return self.variables[number]

    def _constant(self, node: Node) -> str:
        if node.kind == "real":
            text = self.precision.number(float(node.value))
        else:
            text = str(int(node.value))
        return f"({text})" if text.startswith("-") else text

    def type_of(self, node: Node) -> str:
        """Return the type of a node."""
        return self.types.get(node.kind, self.precision.real)

    def _name(self, number: int) -> str:
        return self.variables.setdefault(number, f"v{len(self.variables)}")

    def block(self, block: Block, indent: str) -> Iterator[str]:
        """Yield the statements of a block."""
        source = ""
        for alike, group in itertools.groupby(self._computed(block), self._alike):
            numbers = list(group)
            if alike is None:
                for number in numbers:
                    yield from self._loop(-1 - number, indent)
                continue
            node = self.graph.nodes[numbers[0]]
            if node.source and node.source != source:
                source = node.source
                yield f"{indent}/* {source} */"
            yield from self._statements(numbers, indent)

    def _computed(self, block: Block) -> Iterator[int]:
        """Yield the loops of a block, and the nodes that it computes."""
        for number in block.order:
            if number < 0:
                yield number
                continue
            operation = self.graph.nodes[number].operation
            skipped = operation in NOTHING or number in self.held
            if number in self.needed and not skipped:
                yield number

    def _alike(self, number: int) -> tuple | None:
        """Return a key shared by the operations of an array, or None for a loop."""
        if number < 0:
            return None
        node = self.graph.nodes[number]
        kinds = tuple(self.graph.nodes[n].kind for n in node.operands)
        return node._replace(operands=()), kinds

    def _statements(self, numbers: Sequence[int], indent: str) -> list[str]:
        """Return the statements of equal operations, in loops if these are shorter."""
        if len(numbers) < ROLLED:
            return [self.statement(number, indent) for number in numbers]
        name = f"a{len(self.variables)}"
        self.variables |= {number: f"{name}[{i}]" for i, number in enumerate(numbers)}
        tables, rows = self._tabulated(numbers, name, indent)
        found = list(pieces(rows))
        if 2 * len(found) <= len(numbers):
            return [*tables, *self._array(numbers, name, found, indent)]
        # Write long pieces as loops, and each other operation as a statement.
        for number in numbers:
            del self.variables[number]
        lines = []
        for first, end, _ in found:
            lines += self._statements(numbers[first:end], indent)
        return lines

    def statement(self, number: int, indent: str) -> str:
        """Return the statement of a single node."""
        node = self.graph.nodes[number]
        text = self._operation(node, [self.expression(n) for n in node.operands])
        return f"{indent}const {self.type_of(node)} {self._name(number)} = {text};"

    def _array(
        self, numbers: Sequence[int], name: str, found: Sequence[Piece], indent: str
    ) -> Iterator[str]:
        node = self.graph.nodes[numbers[0]]
        yield f"{indent}{self.type_of(node)} {name}[{len(numbers)}];"
        for first, end, operands in found:
            text = self._operation(node, operands)
            if end == first + 1:
                yield f"{indent}{name}[{first}] = {text};"
                continue
            yield f"{indent}for (int i = {first}; i < {end}; i++)"
            yield f"{indent}    {name}[i] = {text};"

    def _tabulated(
        self, numbers: Sequence[int], name: str, indent: str
    ) -> tuple[list[str], list[tuple[str, ...]]]:
        """Return tables of constants that differ from their neighbours, and operands.

        The operands are the expressions of all operations. Those of the constants in a
        table are elements of the table.
        """
        nodes, tables, columns = self.graph.nodes, [], []
        operands = [nodes[number].operands for number in numbers]
        for place, column in enumerate(zip(*operands, strict=True)):
            texts = [self.expression(number) for number in column]
            alone = [
                i
                for i, number in enumerate(column)
                if nodes[number].operation == CONSTANT
                and number not in column[max(i - 1, 0) : i] + column[i + 1 : i + 2]
            ]
            if alone:
                table = f"{name}_{place}"
                declaration = f"{self.type_of(nodes[column[alone[0]]])} {table}"
                tables += constant_array(declaration, [texts[i] for i in alone], indent)
                for index, i in enumerate(alone):
                    texts[i] = f"{table}[{index}]"
            columns.append(texts)
        return tables, list(zip(*columns, strict=True))

    def _loop(self, number: int, indent: str) -> Iterator[str]:
        loop, nodes = self.graph.loops[number], self.graph.nodes
        used = [i for i, node in enumerate(loop.carried) if node in self.needed]
        if not used:
            return
        for place in used:
            first, carried = loop.first[place], loop.carried[place]
            kind, name = self.type_of(nodes[first]), self._name(carried)
            yield f"{indent}{kind} {name} = {self.expression(first)};"
        for i, node in enumerate(nodes):
            if node.operation == RESULT and node.value[0] == number:
                self.variables[i] = self._name(loop.carried[node.value[1]])
        yield f"{indent}for (;;) {{"
        inner = indent + "    "
        yield from self.block(loop.head, inner)
        yield f"{inner}if (!{self.expression(loop.condition)}) break;"
        yield from self.block(loop.body, inner)
        changed = [p for p in used if loop.carried[p] != loop.last[p]]
        # New values may depend on old ones: compute all before assigning any.
        for p in changed:
            kind = self.type_of(nodes[loop.carried[p]])
            last = self.expression(loop.last[p])
            yield f"{inner}const {kind} n{loop.carried[p]} = {last};"
        for p in changed:
            name = self.expression(loop.carried[p])
            yield f"{inner}{name} = n{loop.carried[p]};"
        yield f"{indent}}}"

    def _operation(self, node: Node, operands: Sequence[str]) -> str:
        """Return the expression of a node with the expressions of its operands."""
        a, b, c = [*operands, "", ""][:3]
        name = node.operation
        kinds = [self.graph.nodes[n].kind for n in node.operands]
        if name == READ:
            return f"{self.names(int(node.value)).partition('[')[0]}[{a}]"
        if name in LOGICAL and kinds[0] == "boolean":
            return f"{a} {self.logical[name]} {b}"
        if name in BITWISE:
            return f"{a} {BITWISE[name]} {b}"
        if name in INFIX:
            return f"{a} {INFIX[name]} {b}"
        if name == "integer_pow":
            return self._power(a, int(node.value))
        if name == "round":
            even = node.value == jax.lax.RoundingMethod.TO_NEAREST_EVEN
            return f"{'rint' if even else 'round'}{self.precision.suffix}({a})"
        form = OF_KIND.get((name, node.kind)) or self.forms.get(name)
        if form is not None:
            more = {"one": self._one(), "f": self.precision.suffix}
            return form.format(a=a, b=b, c=c, type=self.type_of(node), **more)
        if name in FUNCTIONS:
            function = FUNCTIONS[name] + self.precision.suffix
            return f"{function}({a}, {b})" if b else f"{function}({a})"
        raise ValueError(f"the operation {name} has no form in C")

    def _one(self) -> str:
        return self.precision.number(1.0)

    def _power(self, base: str, exponent: int) -> str:
        product = " * ".join([base] * abs(exponent)) or self._one()
        return product if exponent >= 0 else f"{self._one()} / ({product})"
