"""Graph of scalar operations, the form in which a System leaves piezojax."""

from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple

Kind = Literal["real", "integer", "boolean"]
"""Type of a scalar."""

CONSTANT, INPUT, CARRY, RESULT = "constant", "input", "carry", "result"
READ = "read"
"""Operations of nodes that compute nothing: a number, an input by its place, the value
of a loop before an iteration, the one after its last, and an element of an array of
inputs, whose ``value`` is the place of the first element."""


class Node(NamedTuple):
    """A scalar operation: its name in JAX, its operands, and the type of its result.

    ``operands`` are numbers of nodes. ``value`` is the number of a constant, the place
    of an input, an exponent, or the loop and place of a value of a loop. ``source`` is
    the function that computes it.
    """

    operation: str
    operands: tuple[int, ...]
    kind: Kind
    value: Any = None
    source: str = ""


@dataclass
class Block:
    """Nodes in the order of their computation, with the loops between them.

    A loop stands as -1 - i, i its number in ``Graph.loops``. ``level`` is the number of
    loops around the nodes.
    """

    level: int = 0
    order: list[int] = field(default_factory=list)
    known: dict[tuple, int] = field(default_factory=dict)


class Loop(NamedTuple):
    """A loop that repeats ``body`` while a condition holds.

    ``first`` are the values before the loop, ``carried`` the nodes that stand for them
    in the loop, ``last`` the values after an iteration. ``condition`` is computed in
    ``head``.
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
    each, and ``block`` the order of those outside any loop. An operation whose operands
    do not change in a loop stands before the loop.
    """

    def __init__(self):
        self.nodes: list[Node] = []
        self.levels: list[int] = []
        self.loops: list[Loop] = []
        self.block = Block()
        self._open = [self.block]

    @property
    def level(self) -> int:
        """Number of loops around the next node."""
        return self._open[-1].level

    @contextmanager
    def inside(self, block: Block) -> Iterator[Block]:
        """Add nodes to ``block``, which may use all nodes outside it."""
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
        """Return the number of a node, which is new unless the same one is known."""
        # Constants are compared as text: 0.0 equals -0.0, and no number equals nan.
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

        What the nodes ``held`` depend on does not count.
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
