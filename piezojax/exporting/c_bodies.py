"""Bodies of the C functions of an exported System: init, prepare and step."""

from collections.abc import Callable, Collection, Iterator, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import numpy as np

from ..core.system import System
from ..scalar.c_source import NOTHING, TYPES, Precision, statements
from ..scalar.graph import READ, Graph
from ..scalar.memory import Memory, NotScalarError
from ..scalar.trace import trace
from .compensated import compensate
from .prepared import prepared_nodes
from .products import shorten_products
from .slots import PREPARED, Interface, Slot, expressions, type_of

MANY = 8
"""Largest array of equal elements that is assigned without a loop."""

EMPTY = "    (void)parameters;"


class Fields(NamedTuple):
    """Struct fields and function arguments of an exported System in C."""

    parameters: list[Slot]
    states: list[Slot]
    starts: list[Slot]
    inputs: list[Slot]
    outputs: list[Slot]


class StepBodies(NamedTuple):
    """C text of the prepared fields and of the bodies of ``prepare`` and ``step``.

    ``rounding`` lists the slots of rounding errors in the state, if any. ``operations``
    is the number of operations of a step; the body of a loop counts once.
    """

    prepared: str
    prepare: str
    step: str
    rounding: list[Slot]
    operations: int


def init_body(
    system: System,
    interface: Interface,
    fields: Fields,
    precision: Precision,
    rounding: Sequence[Slot] = (),
) -> tuple[str, bool]:
    """Return the body of ``init``, and whether it computes with the parameters.

    ``init`` sets the state at rest. If this state solves equations, it is computed here
    for the exported parameters. The states ``rounding`` start at 0.
    """
    dynamic, static = eqx.partition(system, eqx.is_array)

    def init(dynamic, start):
        return eqx.combine(dynamic, static).init(start)

    names, general = expressions(fields.starts, ""), True
    try:
        graph, outputs = trace(init, dynamic, interface.start)
        names = [*expressions(fields.parameters, "parameters->"), *names]
    except NotScalarError:
        # The state at rest solves equations: solve them for the exported parameters.
        general = False
        graph, outputs = trace(system.init, interface.start)
    for slot in rounding:
        outputs.append(np.full(slot.size, graph.constant(0.0, "real")))
    fields = fields._replace(states=[*fields.states, *rounding])
    outputs = _copied(graph, outputs, fields, names)
    lines, expression = statements(
        graph, _flat(outputs), lambda place: names[place], precision
    )
    lines += _assignments(fields, outputs, expression, precision)
    return "\n".join([*_unused(fields.starts), *lines]), general


def step_bodies(
    system: System,
    state: Any,
    interface: Interface,
    fields: Fields,
    precision: Precision,
) -> StepBodies:
    """Return the bodies of ``prepare`` and ``step``; ``state`` gives the shapes."""
    dynamic, static = eqx.partition(system, eqx.is_array)

    def step(dynamic, state, input):
        return eqx.combine(dynamic, static).step(state, input)

    graph, outputs = trace(step, dynamic, state, interface.input)
    rounding: list[Slot] = []
    if precision.compensated:
        outputs, rounding = _compensated(graph, outputs, fields)
    parameters = expressions(fields.parameters, "parameters->")
    names = [
        *parameters,
        *expressions(fields.states, "state->"),
        *expressions(fields.inputs, ""),
        *expressions(rounding, "state->"),
    ]
    fields = fields._replace(states=[*fields.states, *rounding])
    outputs = _copied(graph, outputs, fields, names)
    shorten_products(graph, len(parameters))
    nodes = prepared_nodes(graph, _flat(outputs), len(parameters))
    held = {n: f"parameters->{PREPARED}.p{i}" for i, n in enumerate(nodes)}
    prepared, prepare = _prepared(graph, nodes, names, held, precision)
    lines, expression = statements(
        graph, _flat(outputs), lambda place: names[place], precision, held
    )
    count = len(fields.states)
    results = [expression(int(n)) for each in outputs[count:] for n in each.ravel()]
    returned = []
    if len(results) == 1:
        kind = type_of(fields.outputs[0].dtype, precision)
        lines.append(f"    const {kind} result = {results[0]};")
        returned = ["    return result;"]
    else:
        targets = expressions(fields.outputs, "output->")
        lines += [f"    {a} = {b};" for a, b in zip(targets, results, strict=True)]
    lines += _assignments(fields, outputs[:count], expression, precision)
    body = "\n".join([*_unused(fields.inputs), *lines, *returned])
    operations = _operations(graph, _flat(outputs), held)
    return StepBodies(prepared, prepare, body, rounding, operations)


def _compensated(
    graph: Graph, outputs: list[Any], fields: Fields
) -> tuple[list[Any], list[Slot]]:
    """Return ``outputs`` with compensated states, and the slot of their errors."""
    before = fields.parameters, fields.states, fields.inputs
    places = np.cumsum([0, *(slot.size for part in before for slot in part)]).tolist()
    parts = list(
        zip(fields.states, outputs, places[len(fields.parameters) :], strict=False)
    )
    nodes = {
        place + i: int(number)
        for slot, each, place in parts
        if isinstance(each, np.ndarray) and np.issubdtype(slot.dtype, np.floating)
        for i, number in enumerate(each.ravel())
    }
    found = compensate(graph, nodes, places[-1])
    if not found:
        return outputs, []
    states = [
        np.array([found.get(place + i, (n,))[0] for i, n in enumerate(each.ravel())])
        if isinstance(each, np.ndarray)
        else each
        for _, each, place in parts
    ]
    errors = np.array([error for _, error in found.values()])
    name = "rounding"
    while name in {slot.name for slot in fields.states}:
        name += "_"
    rounding = [Slot(name, name, np.dtype(float), len(errors))]
    return [*states, errors, *outputs[len(parts) :]], rounding


def _operations(graph: Graph, outputs: Sequence[int], held: Collection[int]) -> int:
    """Return the number of operations of a step, without the nodes ``held``."""
    needed = graph.needed(outputs, held).difference(held)
    kinds = (graph.nodes[n].operation for n in needed)
    return sum(kind not in (*NOTHING, READ) for kind in kinds)


def _prepared(
    graph: Graph,
    nodes: Sequence[int],
    names: Sequence[str],
    held: dict[int, str],
    precision: Precision,
) -> tuple[str, str]:
    """Return the fields of the prepared numbers, and the body that computes them."""
    lines, expression = statements(graph, nodes, lambda place: names[place], precision)
    lines += [f"    {held[n]} = {expression(n)};" for n in nodes]
    fields = []
    for n in nodes:
        node = graph.nodes[n]
        kind = TYPES.get(node.kind, precision.real)
        source = f" /* {node.source} */" if node.source else ""
        fields.append(f"    {kind} {held[n].rpartition('.')[2]};{source}")
    return "\n".join(fields), "\n".join(lines or [EMPTY])


def _copied(
    graph: Graph, outputs: Sequence[Any], fields: Fields, names: Sequence[str]
) -> list[Any]:
    """Return the outputs; a long array from another field is copied by element."""
    own = [f"state->{slot.name}[0]" for slot in fields.states]
    own += [""] * len(fields.outputs)
    return [
        each.elements(graph)
        if isinstance(each, Memory)
        and (names[each.place] != place or each.offset is not None)
        else each
        for each, place in zip(outputs, own, strict=False)
    ]


def _flat(outputs: Sequence[Any]) -> list[int]:
    """Return the nodes of the outputs of a trace."""
    return [
        int(n)
        for each in outputs
        for n in (
            [n for pair in each.writes for n in pair]
            if isinstance(each, Memory)
            else np.ravel(each)
        )
    ]


def _unused(arguments: Sequence[Slot]) -> list[str]:
    names = ["state", "parameters", *(slot.name for slot in arguments)]
    return [f"    (void){name};" for name in names]


def _assignments(
    fields: Fields,
    states: Sequence[Any],
    expression: Callable[[int], str],
    precision: Precision,
) -> Iterator[str]:
    """Yield the lines that assign the next state.

    An old value that another field needs is saved in a variable first.
    """
    places = {
        place: type_of(slot.dtype, precision)
        for slot in fields.states
        for place in expressions([slot], "state->")
    }
    pairs, old = [], {}
    for slot, each in zip(fields.states, states, strict=True):
        if isinstance(each, Memory):
            # Written first: the index may be a state that changes below.
            for index, value in each.writes:
                at = f"state->{slot.name}[{expression(index)}]"
                yield f"    {at} = {expression(value)};"
            continue
        numbers = [int(n) for n in each.ravel()]
        if len(numbers) > MANY and len(set(numbers)) == 1:
            yield f"    for (long i = 0; i < {slot.size}; i++)"
            yield f"        state->{slot.name}[i] = {expression(numbers[0])};"
            continue
        texts = map(expression, numbers)
        pairs += zip(expressions([slot], "state->"), texts, strict=True)
    for place, text in pairs:
        if text in places and text != place and text not in old:
            old[text] = f"s{len(old)}"
            yield f"    const {places[text]} {old[text]} = {text};"
    for place, text in pairs:
        if text != place:
            yield f"    {place} = {old.get(text, text)};"
