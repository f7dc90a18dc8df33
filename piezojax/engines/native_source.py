"""C source of a run of many lanes, whose inner loops become SIMD instructions."""

import math
from collections.abc import Iterable, Sequence
from string import Template
from typing import NamedTuple

import jax

from ..scalar.graph import CONSTANT, INPUT
from .native_math import FORMS, SOURCE
from .native_templates import BACK, HEAD, PART, REVERSE, RUN, SLOPES, VALUES
from .native_writer import Arrays, LaneWriter, Rows, carried_name
from .scalar_step import Element, Place, ScalarStep

OPERATIONS = frozenset(
    (
        *("abs", "add", "and", "ceil", "clamp", "convert_element_type", "div", "eq"),
        *("floor", "ge", "gt", "integer_pow", "is_finite", "le", "lt", "max", "min"),
        *("mul", "ne", "neg", "not", "or", "round", "rsqrt", "select_n", "sign"),
        *("sqrt", "square", "sub", "xor", *FORMS),
    )
)
"""Operations that compilers vectorise. A single other operation keeps the whole loop
from becoming SIMD."""

EXTREMES = ("max", "min")

GROUP = 8
"""Lanes of an inner loop: the numbers of an AVX-512 register."""

SHORT = 400
"""Number of operations below which a step mostly waits for its own results. Two groups
of lanes then run in turn; a single group gets a shorter chain of operations."""


class Shape(NamedTuple):
    """Lanes of a group, groups that run in turn, and samples between logged outputs.

    ``segment`` is the number of samples between stored carries of a reverse pass; it is
    0 for other runs.
    """

    width: int
    groups: int
    every: int
    segment: int = 0


def shape_for(step: ScalarStep, lanes: int, every: int, segment: int = 0) -> Shape:
    """Return the fastest shape for a number of lanes."""
    short = len(step.moving) < SHORT and (segment > 0 or not step.slopes)
    paired = lanes > GROUP and short
    return Shape(1 if lanes == 1 else GROUP, 2 if paired else 1, every, segment)


def waits(step: ScalarStep, lanes: int) -> bool:
    """Return whether a run without derivatives mostly waits for its own results."""
    return lanes <= GROUP and len(step.moving) < SHORT and not step.slopes


def spreads(step: ScalarStep, counts: tuple[int, int, int]) -> bool:
    """Return whether derivatives run faster with each direction as a lane of its own.

    ``counts`` are the numbers of directions, outer and inner lanes. A lane of its own
    repeats the values of the step, but leaves no place in a group of lanes empty.
    """
    directions, _, inner = counts
    values, slopes = len(step.moving), len(step.moving_slopes)
    together = math.ceil(inner / GROUP) * (values + directions * slopes)
    return math.ceil(directions * inner / GROUP) * (values + slopes) < together


def has_source(step: ScalarStep) -> bool:
    """Return whether the moving nodes of a step become SIMD instructions."""
    away = jax.lax.RoundingMethod.AWAY_FROM_ZERO
    nodes = (step.graph.nodes[n] for n in (*step.moving, *step.moving_slopes))
    return all(
        node.operation in OPERATIONS and node.value != away
        for node in nodes
        if node.operation != INPUT
    )


def source(step: ScalarStep, arrays: Arrays, rows: Sequence[Rows], shape: Shape) -> str:
    """Return the C source of ``run_blocks`` for a step.

    ``run_blocks`` returns NULL, or a message if memory cannot be allocated.

    All arrays are of doubles. Except for ``shared`` and the inputs, they have a last
    dimension STRIDE, for the lanes of a block:

        shared        [columns]
        in0, ...      [samples][elements][1, or inner lanes if their inputs differ];
                      all outer lanes share them
        own, start    [outer][blocks][columns, or elements of the carry]
        end           [outer][blocks][columns]
        log           [outer][blocks][samples / EVERY][outputs]
        slopes, slope_start, slope_end, slope_log
                      as own, start, end and log, with [directions] after [blocks]

    With a ``segment`` in ``shape``, the step is that of a reverse pass. Its ``start``,
    [outer][blocks][segments][elements of the carry], are the carries before each
    segment. ``slope_start`` holds the derivatives with respect to the carry after the
    run, and the totals at the start; ``slope_end`` holds the derivatives with respect
    to the carry before the run, and the final totals.
    """
    return _Source(step, arrays, rows).text(shape)


class _Before(NamedTuple):
    """Names of values stored before the first step, and statements that store them."""

    names: list[str]
    lines: list[str]


class _Source:
    """Source for a step; the parts are written in the order in which they run."""

    def __init__(
        self,
        step: ScalarStep,
        arrays: Arrays,
        rows: Sequence[Rows],
    ):
        self.step, self.arrays, self.rows = step, arrays, rows
        self.writer = LaneWriter(step, arrays, rows)
        self.inputs = [f"in{i}" for i in range(len(rows))]
        self.pointers = "".join(f", const double *restrict {x}" for x in self.inputs)
        self.ahead = [
            f"__builtin_prefetch({name} + ((k + AHEAD)*{leaf.size} + {element})*lanes);"
            for name, leaf in zip(self.inputs, rows, strict=True)
            for element in range(leaf.size)
            if leaf.by_lane
        ]
        self.moving = [*step.moving, *step.moving_slopes]
        self.divisors = {
            node.operands[1]
            for node in (step.graph.nodes[n] for n in self.moving)
            if node.operation == "div" and node.kind == "real"
        }

    def text(self, shape: Shape) -> str:
        step, arrays, nodes = self.step, self.arrays, self.step.graph.nodes
        fixed: dict[int, None] = {}
        steady: dict[int, None] = {}
        for number in step.steady:
            operands = (n for n in nodes[number].operands if n not in fixed)
            equal = all(nodes[n].operation == CONSTANT for n in operands)
            if nodes[number].operation == INPUT:
                equal = step.place(number) in arrays.shared
            (fixed if equal else steady)[number] = None

        in_fixed = self._before(fixed, [*steady, *step.steady_slopes], "fixed", "")
        in_steady = self._before(steady, step.steady_slopes, "steady", "[l]")
        limits = sorted(self._limits() & fixed.keys())
        in_steady.names.extend(f"v{n}" for n in limits)
        in_steady.lines.extend(self.writer.store(limits, "of->{}[l]", "steady->{}[l]"))
        kept = [n for n in step.moving if n in self._read_by_slopes()]
        values = self._part(
            "values", [], step.moving, step.carried, step.log, kept, arrays.end
        )
        head = HEAD.substitute(
            shape._asdict(),
            outputs=len(step.log),
            functions="" if step.operations().isdisjoint(FORMS) else SOURCE,
            fixed=_fields("double {};", in_fixed.names),
            steady=_fields("LANE_ARRAY({});", in_steady.names),
            kept=_fields("LANE_ARRAY({});", [f"v{n}" for n in kept]),
            start_fixed=_lines(in_fixed.lines, 4),
            start_steady=_lines(in_steady.lines, 8),
        )
        slopes = ""
        if step.slopes:
            slopes = self._part(
                "slopes",
                step.steady_slopes,
                step.moving_slopes,
                step.slopes,
                step.log_slopes,
                [],
                arrays.slope_end,
            )
        return head + values + slopes + self._run(shape)

    def _before(
        self, numbers: Iterable[int], later: Sequence[int], part: str, lane: str
    ) -> _Before:
        """Return the values that a part stores before the first step.

        The part computes the nodes ``numbers``, and stores those that the nodes
        ``later`` or the moving ones read. ``lane`` is the index of a lane in C, if any.
        """
        writer, nodes = self.writer, self.step.graph.nodes
        read = {n for each in (*later, *self.moving) for n in nodes[each].operands}
        read.update(self.step.last)
        where = f"of->{{}}{lane}", f"{part}->{{}}{lane}"
        computed = [n for n in numbers if nodes[n].operation != INPUT]
        stored = [n for n in computed if n in read]
        inverse = [n for n in numbers if n in self.divisors]
        return _Before(
            [*(f"v{n}" for n in stored), *(f"r{n}" for n in inverse)],
            [
                *writer.statements(computed),
                *writer.invert(inverse, *where),
                *writer.store(stored, *where),
            ],
        )

    def _limits(self) -> set[int]:
        """Return the operands of maxima and minima.

        If all lanes share a limit, compilers test it for NaN lane by lane, in each
        step. If it is stored for each lane, they compare vectors.
        """
        nodes = (self.step.graph.nodes[n] for n in self.moving)
        return {
            n for node in nodes if node.operation in EXTREMES for n in node.operands
        }

    def _read_by_slopes(self) -> set[int]:
        """Return the nodes that the slopes read; of the inputs, only the carry."""
        step = self.step
        read = {
            n for each in step.moving_slopes for n in step.graph.nodes[each].operands
        }
        read.update(each.last for each in step.slopes)
        read.update(step.log_slopes)
        inputs = {n for n in read if (place := step.place(n)) and place.part != "carry"}
        return read - inputs

    def _part(
        self,
        part: str,
        steady: Sequence[int],
        moving: Sequence[int],
        elements: Sequence[Element],
        log: Sequence[int],
        kept: Sequence[int],
        end: Sequence[Place],
    ) -> str:
        """Return the source for the values of a group of lanes, or for the slopes."""
        writer, nodes = self.writer, self.step.graph.nodes
        names = [carried_name(each.place) for each in elements]
        start = [
            f"of->{name}[l] = start[{i}*STRIDE + l];" for i, name in enumerate(names)
        ]
        own = self._before(steady, [], "of", "[l]")
        lines = []
        for name, each in zip(names, elements, strict=True):
            kind = nodes[each.last]
            lines.append(f"const {writer.type_of(kind)} {name} = of->{name}[l];")
        lines += writer.statements(moving)
        lines += [f"log[{i}*STRIDE + l] = {writer.real(n)};" for i, n in enumerate(log)]
        lines += [
            f"of->{name}[l] = {writer.real(each.last)};"
            for name, each in zip(names, elements, strict=True)
        ]
        # Last, because later expressions would read the stored copies of these nodes.
        lines += writer.store(kept, "kept->{}[l]", "kept->{}[l]")
        return PART.substitute(
            part=part,
            kept="const struct kept" if part == "slopes" else "struct kept",
            fields=_fields("LANE_ARRAY({});", [*names, *own.names]),
            rows=self.pointers,
            ahead=_lines(self.ahead if part == "values" else [], 4),
            start=_lines(start + own.lines, 8),
            step=_lines(lines, 8),
            end=_lines(
                [
                    f"end[{i}*STRIDE + l] = of->{carried_name(x)}[l];"
                    for i, x in enumerate(end)
                ],
                8,
            ),
        )

    def _run(self, shape: Shape) -> str:
        step, arrays = self.step, self.arrays
        sizes = {
            "carried": len(step.carried),
            "own": len(arrays.own),
            "ends": len(arrays.end),
            "sloping": len(step.slopes),
            "slopes": len(arrays.slopes),
            "slope_ends": len(arrays.slope_end),
        }
        each = BACK if shape.segment else VALUES
        parts = {"begin": "", "finish": ""} | {
            name: "\n        ".join(
                self._call(text, sizes, g) for g in range(shape.groups)
            )
            for name, text in each.items()
        }
        if shape.segment:
            return REVERSE.substitute(parts, rows=self.pointers, own=sizes["own"])
        if step.slopes:
            for name, text in SLOPES.items():
                more = self._call(text, sizes, 0)
                parts[name] = f"{parts[name]}\n        {more}" if parts[name] else more
        return RUN.substitute(parts, rows=self.pointers, own=sizes["own"])

    def _call(self, text: str, sizes: dict[str, int], group: int) -> str:
        rows = self._row_values(group)
        return Template(text).substitute(sizes, g=group, row_values=rows)

    def _row_values(self, group: int) -> str:
        """Return the arguments for the inputs of a group of lanes."""
        return "".join(
            f", {name} + first + {group} * WIDTH" if leaf.by_lane else f", {name}"
            for name, leaf in zip(self.inputs, self.rows, strict=True)
        )


def _fields(form: str, names: Sequence[str]) -> str:
    """Return the declarations of fields; a structure of C has at least one."""
    return _lines([form.format(name) for name in names] or ["int none;"], 4)


def _lines(lines: Iterable[str], indent: int) -> str:
    return "\n".join(" " * indent + line.strip() for line in lines)
