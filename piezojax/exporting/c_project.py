"""Header and source of a System in C99."""

import math
import re
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ..core.about import About
from ..core.parameter import Parameter
from ..core.paths import declared
from ..core.system import System, resolve
from .c_source import PRECISIONS, TYPES, statements
from .c_templates import HEADER, SOURCE
from .driven import Driven
from .node_arrays import Memory, NotScalarError
from .trace import trace

MANY = 8
"""Number of equal elements above which they are set in a loop."""


class Slot(NamedTuple):
    """A scalar of a tree: its path, its name in C, and its type."""

    path: str
    name: str
    dtype: Any
    size: int = 1


class Interface(NamedTuple):
    """Signals of an exported System.

    ``start`` is an example of the input of ``init``, ``input`` one of ``step``. The
    function ``step`` has an argument for each leaf, named by its path.
    """

    start: Any
    input: Any


def _nodes(output: Any) -> list[int]:
    """Return the nodes of an output of a trace."""
    if isinstance(output, Memory):
        return [n for pair in output.writes for n in pair]
    return output.ravel().tolist()


def slots(tree: Any, word: str) -> list[Slot]:
    """Return the leaves of ``tree``, an array as one slot of its size.

    ``word`` begins a name that has no letter of its own.
    """
    found, taken = [], set()
    for keys, leaf in jax.tree_util.tree_flatten_with_path(tree)[0]:
        path = ".".join(jax.tree_util.keystr((key,), simple=True) for key in keys)
        name = re.sub(r"\W+", "_", path)
        if not name or name[0].isdigit():
            name = f"{word}_{name}".rstrip("_")
        base, count = name, 1
        while name in taken:
            count += 1
            name = f"{base}_{count}"
        taken.add(name)
        found.append(Slot(path, name, leaf.dtype, math.prod(jnp.shape(leaf))))
    return found


def expressions(slots: Sequence[Slot], start: str) -> list[str]:
    """Return the expression of every scalar of ``slots`` behind ``start``."""
    return [
        f"{start}{slot.name}" if slot.size == 1 else f"{start}{slot.name}[{i}]"
        for slot in slots
        for i in range(slot.size)
    ]


class CProject:
    """The texts of a C project; the arguments are those of ``c_export.write_c``.

    ``parameters``, ``states``, ``starts``, ``inputs`` and ``outputs`` are the fields
    and arguments in C, ``values`` the values of the parameters.
    """

    def __init__(
        self,
        system: System,
        interface: Interface,
        name: str,
        about: About,
        precision: str = "double",
    ):
        if not re.fullmatch(r"[a-z_][a-z0-9_]*", name):
            raise ValueError(
                f"the name {name!r} is not one of C: use small letters, digits and _"
            )
        if precision not in PRECISIONS:
            raise ValueError(
                f"precision {precision!r}: choose from {', '.join(PRECISIONS)}"
            )
        system = resolve(system)
        self.name, self.about, self.precision = name, about, PRECISIONS[precision]
        self.system, self.interface = system, jax.tree.map(jnp.asarray, interface)
        self.dynamic, self.static = eqx.partition(system, eqx.is_array)
        self.state = system.init(self.interface.start)
        self.output = eqx.filter_eval_shape(
            system.step, self.state, self.interface.input
        )[1]
        self.parameters = slots(self.dynamic, "parameter")
        self.states = slots(self.state, "state")
        self.starts = slots(self.interface.start, "input")
        self.inputs = slots(self.interface.input, "input")
        self.outputs = slots(self.output, "output")
        self.values = [np.ravel(leaf) for leaf in jax.tree.leaves(self.dynamic)]

    # Text

    def _type(self, dtype: Any) -> str:
        if np.issubdtype(dtype, np.bool_):
            return TYPES["boolean"]
        if np.issubdtype(dtype, np.integer):
            return TYPES["integer"]
        return self.precision.real

    def _fields(self, slots: Sequence[Slot], comment: Callable[[Slot], str]) -> str:
        lines = []
        for slot in slots:
            size = "" if slot.size == 1 else f"[{slot.size}]"
            text = comment(slot)
            text = f" /* {text} */" if text else ""
            lines.append(f"    {self._type(slot.dtype)} {slot.name}{size};{text}")
        return "\n".join(lines or ["    char unused; /* C has no empty struct */"])

    def _declaration(self, slot: Slot) -> Parameter | None:
        return declared(self.system, slot.path)

    def meaning(self, slot: Slot) -> str:
        """Return meaning, limits and unit of a parameter."""
        declaration = self._declaration(slot)
        unit = self.about.parameter_units.get(slot.path.removeprefix("controller."))
        if declaration is None:
            return unit or ""
        unit = unit or declaration.unit
        ends = {
            "above": declaration.above,
            "at least": declaration.least,
            "at most": declaration.most,
            "below": declaration.below,
        }
        limits = [f"{word} {end:.6g}" for word, end in ends.items() if np.isfinite(end)]
        return ", ".join([declaration.meaning, *limits, f"unit {unit}"])

    def _arguments(self, slots: Sequence[Slot]) -> str:
        return "".join(f", {self._type(slot.dtype)} {slot.name}" for slot in slots)

    @property
    def _returned(self) -> str:
        return self._type(self.outputs[0].dtype) if len(self.outputs) == 1 else "void"

    def _signatures(self) -> dict[str, str]:
        name = self.name
        more = "" if len(self.outputs) == 1 else f", {name}_output *output"
        both = f"{name}_state *state, const {name}_parameters *parameters"
        return {
            "defaults": f"{name}_parameters {name}_defaults(void)",
            "check": f"int {name}_check(const {name}_parameters *parameters)",
            "init": f"void {name}_init({both}{self._arguments(self.starts)})",
            "step": f"{self._returned} {name}_step({both}"
            f"{self._arguments(self.inputs)}{more})",
        }

    def step_call(self, arguments: Sequence[str], targets: Sequence[str]) -> str:
        """Return the lines that step and assign each output to one of ``targets``.

        ``arguments`` are the expressions of state, parameters and inputs. Several
        outputs pass through a variable ``output``.
        """
        call = f"{self.name}_step({', '.join(arguments)}"
        if len(targets) == 1:
            return f"        {targets[0]} = {call});"
        fields = zip(targets, expressions(self.outputs, "output."), strict=True)
        lines = [f"        {target} = {field};" for target, field in fields]
        return "\n".join([f"        {call}, &output);", *lines])

    @property
    def output_variable(self) -> str:
        """Declaration of the variable of ``step_call``, "" if it needs none."""
        several = len(self.outputs) > 1
        return f"    {self.name}_output output;\n" if several else ""

    def origin(self) -> str:
        """Return what the code is, where it comes from, and its alarms first."""
        kind = type(self.system).__name__
        if isinstance(self.system, Driven):
            kind = f"{type(self.system.controller).__name__} with its voltage limits"
        lines = self.about.origin(kind)
        return "\n   ".join(line.replace("*/", "* /") for line in lines)

    def header(self) -> str:
        """Return the text of the header."""
        signatures, guard = self._signatures(), f"{self.name.upper()}_H"
        units = self.about.units
        output = ""
        if len(self.outputs) > 1:
            fields = self._fields(self.outputs, lambda slot: "")
            output = f"typedef struct {{\n{fields}\n}} {self.name}_output;\n\n"
        return HEADER.format(
            origin=self.origin(),
            guard=guard,
            name=self.name,
            parameters=self._fields(self.parameters, self.meaning),
            state=self._fields(self.states, lambda slot: ""),
            output=output,
            units=", ".join(f"{k} in {v}" for k, v in units.items()) or "as simulated",
            **signatures,
        )

    def source(self) -> str:
        """Return the text of the source."""
        signatures = self._signatures()
        return SOURCE.format(
            origin=self.origin(),
            name=self.name,
            set=self._defaults(),
            checks=self._checks(),
            init_body=self._init_body(),
            step_body=self._step_body(),
            **signatures,
        )

    def _number(self, value: Any) -> str:
        if np.issubdtype(np.asarray(value).dtype, np.floating):
            return self.precision.number(float(value))
        return str(int(value))

    def _defaults(self) -> str:
        places = expressions(self.parameters, "parameters.")
        numbers = [self._number(v) for values in self.values for v in values]
        lines = [f"    {a} = {b};" for a, b in zip(places, numbers, strict=True)]
        return "\n".join(lines or ["    parameters.unused = 0;"])

    def _checks(self) -> str:
        lines = []
        for number, slot in enumerate(self.parameters, 1):
            declaration = self._declaration(slot)
            if declaration is None:
                continue
            tests = {
                ">": declaration.above,
                ">=": declaration.least,
                "<=": declaration.most,
                "<": declaration.below,
            }
            for place in expressions([slot], "parameters->"):
                wrong = [
                    f"!({place} {sign} {self.precision.number(end)})"
                    for sign, end in tests.items()
                    if np.isfinite(end)
                ]
                if wrong:
                    lines.append(f"    if ({' || '.join(wrong)}) return {number};")
        return "\n".join(lines or ["    (void)parameters;"])

    def _init_body(self) -> str:
        def init(dynamic, start):
            return eqx.combine(dynamic, self.static).init(start)

        names = expressions(self.starts, "")
        try:
            graph, outputs = trace(init, self.dynamic, self.interface.start)
            names = [*expressions(self.parameters, "parameters->"), *names]
        except NotScalarError:
            # Equations of several unknowns are solved here, once for all.
            graph, outputs = trace(self.system.init, self.interface.start)
        return self._body(graph, outputs, names, self.starts)

    def _step_body(self) -> str:
        def step(dynamic, state, input):
            return eqx.combine(dynamic, self.static).step(state, input)

        graph, outputs = trace(step, self.dynamic, self.state, self.interface.input)
        names = [
            *expressions(self.parameters, "parameters->"),
            *expressions(self.states, "state->"),
            *expressions(self.inputs, ""),
        ]
        return self._body(graph, outputs, names, self.inputs, result=True)

    def _body(
        self,
        graph: Any,
        outputs: list[Any],
        names: list[str],
        arguments: Sequence[Slot],
        result: bool = False,
    ) -> str:
        # A long array stays where it is; elsewhere its elements are copied.
        own = [f"state->{slot.name}[0]" for slot in self.states]
        own += [""] * len(self.outputs)
        outputs = [
            each.elements(graph)
            if isinstance(each, Memory) and names[each.place] != place
            else each
            for each, place in zip(outputs, own, strict=False)
        ]
        flat = [int(n) for each in outputs for n in _nodes(each)]
        lines, expression = statements(
            graph, flat, lambda place: names[place], self.precision
        )
        count = len(self.states)
        results = [expression(int(n)) for each in outputs[count:] for n in each.ravel()]
        returned = ""
        if result and len(self.outputs) == 1:
            kind = self._type(self.outputs[0].dtype)
            lines.append(f"    const {kind} result = {results[0]};")
            returned = "\n    return result;"
        elif result:
            targets = expressions(self.outputs, "output->")
            lines += [f"    {a} = {b};" for a, b in zip(targets, results, strict=True)]
        lines += self._assignments(outputs[:count], expression)
        unused = ["state", "parameters", *(slot.name for slot in arguments)]
        lines[:0] = [f"    (void){name};" for name in unused]
        return "\n".join(lines) + returned

    def _assignments(
        self, states: Sequence[Any], expression: Callable[[int], str]
    ) -> Iterator[str]:
        """Yield the lines that assign the next state; each value is read before."""
        places = {
            place: self._type(slot.dtype)
            for slot in self.states
            for place in expressions([slot], "state->")
        }
        pairs, old = [], {}
        for slot, each in zip(self.states, states, strict=True):
            if isinstance(each, Memory):
                # Before all others: an index may be a state.
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
