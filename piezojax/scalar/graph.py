"""Graph of scalar operations, from which C and kernels are written."""

from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple

Kind = Literal["real", "integer", "boolean"]
"""Type of a scalar."""

CONSTANT, INPUT, CARRY, RESULT = "constant", "input", "carry", "result"
READ = "read"
"""Operations of nodes that compute nothing.

They are a constant, an input by its place, a carried value before an iteration of a
loop, a result of a loop after its last iteration, and an element of an array of inputs.
The ``value`` of the last is the place of the first element of the array."""


class Node(NamedTuple):
    """A scalar operation: its name in JAX, its operands, and the type of its result.

    ``operands`` are numbers of nodes. ``value`` is the value of a constant, the place
    of an input, the exponent of a power, the method of a rounding, or a key and the
    place of a carried value or result of a loop; for a result the key is the number of
    the loop. ``source`` is the Python function that the operation comes from.
    """

    operation: str
    operands: tuple[int, ...]
    kind: Kind
    value: Any = None
    source: str = ""


@dataclass
class Block:
    """Nodes and loops in the order of their computation.

    ``order`` holds the numbers of nodes, and -1 - i for loop i of ``Graph.loops``.
    ``level`` is the number of loops around the block. ``known`` maps the content of
    each node to its number.
    """

    level: int = 0
    order: list[int] = field(default_factory=list)
    known: dict[tuple, int] = field(default_factory=dict)


class Loop(NamedTuple):
    """A loop that repeats ``body`` while a condition holds.

    ``first`` are the nodes of the values before the loop, ``carried`` those of the
    values at the start of an iteration, and ``last`` those of the values at its end.
    ``condition`` is the node of the condition, which ``head`` computes.
    """

    first: tuple[int, ...]
    carried: tuple[int, ...]
    head: Block
    condition: int
    body: Block
    last: tuple[int, ...]


class Graph:
    """Scalar operations, each stored once.

    ``nodes`` holds all operations by number, ``levels`` the number of loops around
    each, and ``block`` the order of those outside any loop. A loop-invariant operation
    is placed before its loop.
    """

    def __init__(self):
        self.nodes: list[Node] = []
        self.levels: list[int] = []
        self.loops: list[Loop] = []
        self.block = Block()
        self._open = [self.block]

    @property
    def level(self) -> int:
        """Number of loops around the block that is being filled."""
        return self._open[-1].level

    @contextmanager
    def inside(self, block: Block) -> Iterator[Block]:
        """Add nodes to ``block`` in this context; they may use the nodes outside it."""
        self._open.append(block)
        try:
            yield block
        finally:
            self._open.pop()

    def constant(self, value: float | int | bool, kind: Kind) -> int:
        """Return the node of a constant."""
        return self.add(CONSTANT, (), kind, value)

    def add(
        self,
        operation: str,
        operands: Sequence[int],
        kind: Kind,
        value: Any = None,
        source: str = "",
    ) -> int:
        """Return the number of a node, which is added unless an equal one is known."""
        # Constants are compared as text, because 0.0 == -0.0 and nan != nan.
        key = (operation, tuple(operands), kind, repr(value))
        for block in reversed(self._open):
            if key in block.known:
                return block.known[key]
        level = max((self.levels[n] for n in operands), default=0)
        if operation in (CARRY, RESULT):
            level = self.level
        block = next(each for each in reversed(self._open) if each.level == level)
        self.nodes.append(Node(operation, tuple(operands), kind, value, source))
        self.levels.append(level)
        number = block.known[key] = len(self.nodes) - 1
        block.order.append(number)
        return number

    def add_loop(self, loop: Loop) -> list[int]:
        """Add a loop; return the nodes of its results."""
        number = len(self.loops)
        self.loops.append(loop)
        self._open[-1].order.append(-1 - number)
        return [
            self.add(RESULT, (), self.nodes[first].kind, (number, place))
            for place, first in enumerate(loop.first)
        ]

    def needed(self, outputs: Sequence[int], held: Collection[int] = ()) -> set[int]:
        """Return the numbers of the nodes that ``outputs`` depend on.

        The nodes ``held`` are included, but not the nodes on which these depend.
        """
        carried = {
            number: (loop, place)
            for loop in self.loops
            for place, number in enumerate(loop.carried)
        }
        found: set[int] = set()
        open_ = list(outputs)
        while open_:
            number = open_.pop()
            if number in found:
                continue
            found.add(number)
            if number in held:
                continue
            node = self.nodes[number]
            open_ += node.operands
            if node.operation == RESULT:
                loop, place = self.loops[node.value[0]], node.value[1]
                open_.append(loop.carried[place])
            if number in carried:
                loop, place = carried[number]
                open_ += [loop.first[place], loop.last[place], loop.condition]
        return found
