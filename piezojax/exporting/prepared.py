"""Nodes of a step that depend on parameters alone and are computed in advance."""

from collections.abc import Sequence

from ..scalar.graph import CARRY, CONSTANT, INPUT, READ, RESULT, Graph


def prepared_nodes(graph: Graph, outputs: Sequence[int], parameters: int) -> list[int]:
    """Return the nodes to compute in advance, from which ``outputs`` are computed.

    They depend on the first ``parameters`` inputs alone. The step computes no other
    such node, except inside loops.
    """
    varying = varying_nodes(graph, parameters)
    fixed = {
        number
        for number, level in enumerate(graph.levels)
        if level == 0 and number not in varying
    }
    plain = (CONSTANT, INPUT)
    used = fixed & graph.needed(outputs, fixed)
    return sorted(n for n in used if graph.nodes[n].operation not in plain)


def varying_nodes(graph: Graph, parameters: int) -> set[int]:
    """Return the nodes that may change while the first ``parameters`` inputs do not."""
    loops = {
        number: (loop.condition, loop.first[place], loop.last[place])
        for loop in graph.loops
        for place, number in enumerate(loop.carried)
    }
    varying: set[int] = set()
    before = -1
    while len(varying) > before:
        before = len(varying)
        for number, node in enumerate(graph.nodes):
            operands = node.operands
            if node.operation == CARRY:
                operands = loops[number]
            elif node.operation == RESULT:
                operands = (graph.loops[node.value[0]].carried[node.value[1]],)
            own = node.operation in (INPUT, READ) and node.value >= parameters
            if own or not varying.isdisjoint(operands):
                varying.add(number)
    return varying
