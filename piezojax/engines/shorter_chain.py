"""Sums of a step in another order, so that what is known last enters last.

A run of few lanes waits for the longest chain of operations that need each other's
results: from a state through the step back to the states. If the operand of a sum that
is known last is a sum too, its own last operand can enter the outer sum after all
others, and the chain loses an operation. Products with steady values join likewise.
Between two operations that are no sums, the chain becomes a single product and sum.
"""

from collections.abc import Sequence
from typing import NamedTuple

from ..scalar.graph import CONSTANT, Graph
from ..scalar.simplify import Simplifier
from .native_math import FORMS
from .scalar_step import ScalarStep, sorted_step

CYCLES = {
    **dict.fromkeys(("div", "sqrt", "rsqrt"), 13),
    # Series of a dozen terms, which wait for each other.
    **dict.fromkeys(FORMS, 60),
    # For one lane, compilers write choices as branches, which processors predict.
    **dict.fromkeys(("abs", "clamp", "max", "min", "select_n"), 1),
}
"""Cycles until the result of an operation is known, if not ``USUAL``.

These are the latencies of x86 processors since 2015; those of others are similar."""

USUAL = 4
"""Cycles of a sum, of a product, and of a sum with a product."""

EARLY = -1e6
"""Cycle in which inputs are known, which do not wait for a result."""

ROUNDS = 3
"""Number of steps in which the times of the states settle after a change."""

MOST = 200
"""Largest number of divided operands."""


class Term(NamedTuple):
    """The term ``sign * factor * node`` of a sum; a factor None is 1.

    The factor is a node of the new graph, and steady.
    """

    sign: int
    factor: int | None
    node: int


def shortened(step: ScalarStep) -> ScalarStep:
    """Return a step with a shorter chain and the same results up to rounding.

    The step computes no derivatives. It may get some operations more.
    """
    chain = Chain(step)
    chain.shorten()
    return chain.written()


class Chain:
    """The operations of a step at each sample, whose sums can be divided.

    ``times`` holds the cycle in which each node is known, and ``states`` those of the
    carry; the last is known at 0. ``cycles`` is the number of cycles of a step.
    """

    def __init__(self, step: ScalarStep):
        self.step, self.nodes = step, step.graph.nodes
        self._graph = Graph()
        self._add = Simplifier(self._graph).add
        self._copies: dict[int, int] = {}
        """Nodes of the new graph by those of the old."""
        constants = [n for n, x in enumerate(self.nodes) if x.operation == CONSTANT]
        for number in (*constants, *step.steady):
            self._copy(number)
        self._order = list(step.moving)
        """The nodes in the order of computation. Those that ``step`` lacks are parts
        of sums."""
        self._sums = {
            n: self._merged(terms) for n in self._order if (terms := self._terms(n))
        }
        """The terms of each sum, one for each node."""
        self._changed: set[int] = set()
        self.times: dict[int, float] = {}
        self.states = {each.place: 0.0 for each in step.carried}
        self._settle()

    def _copy(self, number: int) -> None:
        node = self.nodes[number]
        copies = [self._copies[n] for n in node.operands]
        self._copies[number] = self._graph.add(
            node.operation, copies, node.kind, node.value, node.source
        )

    def _real(self, operation: str, *operands: int) -> int:
        return self._add(operation, [*operands], "real", None, "")

    def _one(self) -> int:
        return self._graph.constant(1.0, "real")

    def _terms(self, number: int) -> list[Term]:
        """Return the terms of a sum, or of a product with a steady value."""
        node = self.nodes[number]
        steady = [self._copies.get(n) for n in node.operands]
        match node.operation if node.kind == "real" else "", steady:
            case "add" | "sub" as operation, _:
                signs = 1, 1 if operation == "add" else -1
                return [
                    Term(sign, None, n)
                    for sign, n in zip(signs, node.operands, strict=True)
                ]
            case "neg", _:
                return [Term(-1, None, node.operands[0])]
            case "mul", [int(factor), _]:
                return [Term(1, factor, node.operands[1])]
            case "mul", [_, int(factor)]:
                return [Term(1, factor, node.operands[0])]
            case "div", [_, int(divisor)]:
                inverse = self._real("div", self._one(), divisor)
                return [Term(1, inverse, node.operands[0])]
        return []

    def _settle(self) -> None:
        before = 0.0
        for _ in range(ROUNDS):
            self.times = {}
            for number in self._order:
                self.times[number] = self._time(number)
            after = {each.place: self._known(each.last) for each in self.step.carried}
            before = max(after.values(), default=0.0)
            self.states = {place: time - before for place, time in after.items()}
        self.cycles = before

    def _known(self, number: int) -> float:
        return self.times.get(number, EARLY)

    def _time(self, number: int) -> float:
        if number in self._sums:
            return self._sum_time(self._sums[number])[0]
        node, place = self.nodes[number], self.step.place(number)
        if place is not None:
            return self.states.get(place, EARLY)
        return max(map(self._known, node.operands)) + CYCLES.get(node.operation, USUAL)

    def _sorted(self, terms: Sequence[Term]) -> list[Term]:
        return sorted(terms, key=lambda term: self._known(term.node))

    def _sum_time(self, terms: Sequence[Term]) -> tuple[float, int]:
        """Return the time at which a sum is known, and the node for which it waits."""
        first, *more = self._sorted(terms)
        time, last = self._known(first.node), first.node
        if first.factor is not None or not more:
            time += USUAL
        for term in more:
            known = self._known(term.node)
            if known >= time:
                time, last = known, term.node
            time += USUAL
        return time, last

    def shorten(self) -> None:
        """Divide operands on the longest chain as long as that saves time."""
        for _ in range(MOST):
            if not any(self._divide(*pair) for pair in self._chain()):
                break
            self._settle()

    def _chain(self) -> list[tuple[int, int]]:
        """Return the longest chain: pairs of a node and the one for which it waits."""
        last = {each.place: each.last for each in self.step.carried}
        place = max(self.states, key=self.states.__getitem__, default=None)
        pairs: list[tuple[int, int]] = []
        while place is not None and place in last:
            number = last.pop(place)
            while (before := self._before(number)) is not None:
                pairs.append((number, before))
                number = before
            place = self.step.place(number)
        return pairs[::-1]

    def _before(self, number: int) -> int | None:
        """Return the node for which a node waits, if any."""
        if number in self._sums:
            return self._sum_time(self._sums[number])[1]
        if number not in self.times:
            return None
        return max(self.nodes[number].operands, key=self._known, default=None)

    def _divide(self, number: int, late: int) -> bool:
        """Replace the last operands of a sum by their terms, if that saves time.

        ``late`` is one of these operands.
        """
        if number not in self._sums or late not in self._sums:
            return False
        terms: list[Term] = []
        rests: dict[int, tuple[int, list[Term], list[Term]]] = {}
        for outer in self._sums[number]:
            parts = self._sums.get(outer.node)
            if parts is None or self._known(outer.node) < self._known(late):
                terms.append(outer)
                continue
            if len(parts) > 2:
                # Later operations share the sum of all terms but the last.
                *early, last = self._sorted(parts)
                rest = max(len(self.nodes), *self._order, *rests) + 1
                self.times[rest] = self._sum_time(early)[0]
                parts = [Term(1, None, rest), last]
                rests[rest] = outer.node, early, parts
            terms += [self._product(outer, part) for part in parts]
        terms = self._merged(terms)
        if self._sum_time(terms)[0] >= self.times[number]:
            return False
        for rest, (whole, early, parts) in rests.items():
            self._order.insert(self._order.index(whole), rest)
            self._sums |= {rest: early, whole: parts}
            self._changed |= {rest, whole}
        self._sums[number] = terms
        self._changed.add(number)
        return True

    def _product(self, outer: Term, inner: Term) -> Term:
        """Return the term of a sum for the term ``inner`` of its operand."""
        factors = [x for x in (outer.factor, inner.factor) if x is not None]
        factor = self._real("mul", *factors) if len(factors) == 2 else None
        factor = factors[0] if len(factors) == 1 else factor
        return Term(outer.sign * inner.sign, factor, inner.node)

    def _merged(self, terms: Sequence[Term]) -> list[Term]:
        """Return a sum with one term for each node."""
        found: dict[int, Term] = {}
        for term in terms:
            if (known := found.get(term.node)) is not None:
                pair = [
                    self._one() if x.factor is None else x.factor for x in (known, term)
                ]
                operation = "add" if known.sign == term.sign else "sub"
                term = Term(known.sign, self._real(operation, *pair), term.node)
            found[term.node] = term
        return [*found.values()]

    def written(self) -> ScalarStep:
        """Return the step as it is now."""
        for number in self._order:
            if number in self._changed:
                self._copies[number] = self._written(self._sums[number])
            else:
                self._copy(number)
        step, copies = self.step, self._copies
        after = {each.place: copies[each.last] for each in step.carried}
        log = [copies[n] for n in step.log]
        return sorted_step(self._graph, step.places, after, frozenset(), after, log, [])

    def _written(self, terms: Sequence[Term]) -> int:
        """Return the node of a sum; what is known last enters last."""
        total: int | None = None
        sign = 1
        for term in self._sorted(terms):
            node = self._copies[term.node]
            if term.factor is not None:
                node = self._real("mul", term.factor, node)
            if total is None:
                total, sign = node, term.sign
            elif sign == term.sign:
                total = self._real("add", total, node)
            elif sign > 0:
                total = self._real("sub", total, node)
            else:
                total, sign = self._real("sub", node, total), 1
        assert total is not None
        return total if sign > 0 else self._real("neg", total)
