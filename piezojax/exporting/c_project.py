"""Header and source of a System in C99."""

import re
from collections.abc import Callable, Sequence
from functools import cached_property
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ..core.about import About
from ..core.parameter import Parameter
from ..core.paths import declared
from ..core.system import System, resolve
from ..scalar.c_source import PRECISIONS
from ..scalar.rolled import ROLLED, constant_array
from .c_bodies import Fields, StepBodies, init_body, step_bodies
from .c_templates import FIXED_REST, HEADER, PREPARED_TYPE, SOURCE
from .driven import Driven
from .slots import PREPARED, Interface, Slot, expressions, slots, type_of


class CProject:
    """Header and source of a System; the arguments are those of ``c_export.write_c``.

    ``parameters``, ``states``, ``starts``, ``inputs`` and ``outputs`` are the slots of
    fields and arguments in C. ``values`` holds a flat array for each parameter.
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
        dynamic = eqx.filter(system, eqx.is_array)
        self.state = system.init(self.interface.start)
        self.output = eqx.filter_eval_shape(
            system.step, self.state, self.interface.input
        )[1]
        self.parameters = slots(dynamic, "parameter")
        self.states = slots(self.state, "state")
        self.starts = slots(self.interface.start, "input")
        self.inputs = slots(self.interface.input, "input")
        self.outputs = slots(self.output, "output")
        self.values = [np.ravel(leaf) for leaf in jax.tree.leaves(dynamic)]

    @property
    def _all_fields(self) -> Fields:
        return Fields(
            self.parameters, self.states, self.starts, self.inputs, self.outputs
        )

    @cached_property
    def _step(self) -> StepBodies:
        return step_bodies(
            self.system, self.state, self.interface, self._all_fields, self.precision
        )

    @cached_property
    def _init(self) -> tuple[str, bool]:
        return init_body(
            self.system,
            self.interface,
            self._all_fields,
            self.precision,
            self.rounding,
        )

    @property
    def rounding(self) -> list[Slot]:
        """Slots of the rounding errors of compensated states, if there are any."""
        return self._step.rounding

    def operations(self) -> int:
        """Return the number of operations of a step; the body of a loop counts once."""
        return self._step.operations

    def _type(self, dtype: Any) -> str:
        return type_of(dtype, self.precision)

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
            "prepare": f"void {name}_prepare({name}_parameters *parameters)",
            "init": f"void {name}_init({both}{self._arguments(self.starts)})",
            "step": f"{self._returned} {name}_step({both}"
            f"{self._arguments(self.inputs)}{more})",
        }

    def step_call(self, arguments: Sequence[str], targets: Sequence[str]) -> str:
        """Return the lines that call ``step`` and assign its outputs to ``targets``.

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
        """Declaration of the variable that ``step_call`` uses, "" if it uses none."""
        several = len(self.outputs) > 1
        return f"    {self.name}_output output;\n" if several else ""

    def step_block(self, arguments: Sequence[str], targets: Sequence[str]) -> str:
        """Return the lines of ``step_call`` as a C block that declares its variable."""
        call = self.step_call(arguments, targets)
        return f"    {{\n{self.output_variable}{call}\n    }}"

    def files(self) -> dict[str, str]:
        """Return the texts of header and source by file name."""
        return {f"{self.name}.h": self.header(), f"{self.name}.c": self.source()}

    def head(self) -> list[str]:
        """Return the first lines of a file: the alarms, the System and its origin."""
        kind = type(self.system).__name__
        if isinstance(self.system, Driven):
            kind = f"{type(self.system.controller).__name__} with its voltage limits"
        return self.about.origin(kind)

    def origin(self) -> str:
        """Return ``head`` as the text of a comment in C."""
        return "\n   ".join(line.replace("*/", "* /") for line in self.head())

    def header(self) -> str:
        """Return the text of the header."""
        name, signatures = self.name, self._signatures()
        units = self.about.units
        output = ""
        if len(self.outputs) > 1:
            fields = self._fields(self.outputs, lambda slot: "")
            output = f"typedef struct {{\n{fields}\n}} {name}_output;\n\n"
        fields = self._fields(self.parameters, self.meaning)
        prepared = ""
        if self._step.prepared:
            prepared = PREPARED_TYPE.format(name=name, fields=self._step.prepared)
            fields += f"\n    {name}_{PREPARED} {PREPARED};"
        return HEADER.format(
            origin=self.origin(),
            guard=f"{name.upper()}_H",
            name=name,
            prepared=prepared,
            parameters=fields,
            state=self._fields([*self.states, *self.rounding], lambda slot: ""),
            output=output,
            rest="" if self._init[1] else FIXED_REST,
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
            init_body=self._init[0],
            prepare_body=self._step.prepare,
            step_body=self._step.step,
            **signatures,
        )

    def _number(self, value: Any) -> str:
        if np.issubdtype(np.asarray(value).dtype, np.floating):
            return self.precision.number(float(value))
        return str(int(value))

    def _defaults(self) -> str:
        lines = []
        for slot, values in zip(self.parameters, self.values, strict=True):
            numbers = [self._number(value) for value in values]
            if len(numbers) < ROLLED:
                places = expressions([slot], "parameters.")
                lines += [
                    f"    {a} = {b};" for a, b in zip(places, numbers, strict=True)
                ]
                continue
            table = f"{type_of(slot.dtype, self.precision)} values"
            lines += ["    {", *constant_array(table, numbers, " " * 8)]
            lines += [f"        for (int i = 0; i < {slot.size}; i++)"]
            lines += [f"            parameters.{slot.name}[i] = values[i];", "    }"]
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
