"""Tracing of a JAX function into a graph of scalar operations.

JAX traces the function. Every array of the trace becomes a NumPy array of node numbers.
Operations that only move elements act on these numbers.
"""

import functools
import math
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import equinox.internal as eqxi
import jax
import numpy as np
from jax.extend import core as jex

from .graph import CARRY, INPUT, Block, Graph, Loop
from .memory import Memory, NotScalarError, Numbers
from .node_arrays import NodeArrays, kind_of
from .rolled import ROLLED

ELEMENTWISE = {
    "abs", "acos", "add", "and", "asin", "atan", "atan2", "ceil", "clamp",
    "convert_element_type", "cos", "cosh", "div", "eq", "exp", "expm1", "floor",
    "ge", "gt", "integer_pow", "is_finite", "le", "log", "log1p", "logistic", "lt",
    "max", "min", "mul", "ne", "neg", "not", "or", "pow", "rem", "round", "rsqrt",
    "select_n", "sign", "sin", "sinh", "sqrt", "square", "sub", "tan", "tanh", "xor",
}  # fmt: skip
"""Elementwise operations that C can compute."""

MOVES = {
    **dict.fromkeys(("broadcast_in_dim", "concatenate", "expand_dims", "pad"), ()),
    **dict.fromkeys(("reshape", "rev", "slice", "split", "squeeze", "stack"), ()),
    **dict.fromkeys(("transpose", "unstack"), ()),
    "dynamic_slice": range(1, 32),
    "dynamic_update_slice": range(2, 32),
    "gather": (1,),
    "scatter": (1,),
    "scatter-add": (),
}
"""Operations that move elements, with the positions of their index operands."""

CALLS = ("jaxpr", "call_jaxpr", "fun_jaxpr")
"""Parameters of an equation that hold the jaxpr of a call."""

FOLDS = {
    "reduce_sum": "add",
    "reduce_prod": "mul",
    "reduce_max": "max",
    "reduce_min": "min",
    "reduce_and": "and",
    "reduce_or": "or",
    "unvmap_any": "or",
    "unvmap_all": "and",
}
"""Reductions, and the operation that they repeat."""

SAME = (
    *("copy", "copy_p", "nonbatchable", "nontraceable"),
    *("optimization_barrier", "stop_gradient"),
)
"""Operations that return their operands."""

ALIASES = {"add_any": "add"}
"""Operations under a second name."""

TRACERS = frozenset({"exporting", "engines", "scalar"})
"""Subpackages whose functions are not the source of an operation."""

LONG = 256
"""Smallest size of a real input that remains an array in C."""

MOST = 15_000
"""Largest number of nodes of a graph; C compilers take minutes for more."""


def trace(
    function: Callable, *arguments: Any, rolled: float = ROLLED
) -> tuple[Graph, list[Any]]:
    """Return the graph of ``function`` and the nodes of its outputs, leaf by leaf.

    The place of an input is its index among all elements of the leaves of
    ``arguments``. A scan without rows and of at least ``rolled`` repetitions remains a
    loop; other scans are unrolled. Raises NotScalarError for an operation without a
    scalar form, and for more than ``MOST`` nodes.
    """
    closed: Any = jax.make_jaxpr(function)(*arguments)
    # Solvers use primitives of Equinox that exist only as Python implementations.
    # Equinox replaces them here, but raises TypeError for some inside a derivative.
    with suppress(TypeError):
        closed = eqxi.finalise_jaxpr(closed)
    tracer = _Tracer(rolled)
    place = 0
    inputs = []
    for variable in closed.jaxpr.invars:
        shape = variable.aval.shape
        size = math.prod(shape)
        kind = kind_of(variable.aval.dtype)
        if size >= LONG and kind == "real":
            inputs.append(Memory(place, shape))
            place += size
            continue
        numbers = [
            tracer.graph.add(INPUT, (), kind, place + i, "") for i in range(size)
        ]
        inputs.append(np.array(numbers, int).reshape(shape))
        place += size
    return tracer.graph, tracer.evaluate(closed, inputs)


class _Tracer:
    def __init__(self, rolled: float):
        self.rolled = rolled
        self.graph = Graph()
        self.arrays = NodeArrays(self.graph)

    def evaluate(self, closed: Any, inputs: Sequence[Any]) -> list[Any]:
        """Return the outputs of a closed jaxpr."""
        jaxpr = closed.jaxpr
        values: dict[Any, Numbers] = dict(zip(jaxpr.invars, inputs, strict=True))
        for variable, constant in zip(jaxpr.constvars, closed.consts, strict=True):
            values[variable] = self.arrays.constants(np.asarray(constant))

        def read(atom: Any) -> Any:
            if isinstance(atom, jex.Literal):
                kind: Any = atom.aval
                return self.arrays.constants(np.asarray(atom.val, kind.dtype))
            return values[atom]

        for equation in jaxpr.eqns:
            outer, self.arrays.source = (
                self.arrays.source,
                _source_of(equation) or self.arrays.source,
            )
            results = self.equation(equation, [read(atom) for atom in equation.invars])
            self.arrays.source = outer
            values.update(zip(equation.outvars, results, strict=True))
            if len(self.graph.nodes) > MOST:
                raise NotScalarError(f"it has more than {MOST} scalar operations")
        return [read(atom) for atom in jaxpr.outvars]

    def equation(self, equation: Any, operands: list[Any]) -> list[Any]:
        """Return the results of an equation of a jaxpr."""
        name, params = equation.primitive.name, equation.params
        name = ALIASES.get(name, name)
        if name in SAME:
            return operands
        inner = next((params[key] for key in CALLS if key in params), None)
        if any(isinstance(operand, Memory) for operand in operands):
            found = self.arrays.in_memory(equation, operands)
            if found is not None:
                return [found]
            if inner is None or name in ("scan", "while"):
                operands = [
                    each.elements(self.graph) if isinstance(each, Memory) else each
                    for each in operands
                ]
        if name == "scan":
            return self.scan(params, operands)
        if name == "while":
            return self.while_loop(params, operands)
        if name == "cond":
            return self.cond(params["branches"], operands)
        if inner is not None:
            closed = inner if hasattr(inner, "consts") else jex.ClosedJaxpr(inner, ())
            return self.evaluate(closed, operands)
        folded = self._folded(equation, operands)
        if folded is not None:
            return folded
        if name in MOVES:
            return self.moved(equation, operands)
        if name in FOLDS:
            axes = params.get("axes", range(operands[0].ndim))
            return [self.arrays.reduced(FOLDS[name], operands[0], axes)]
        if name == "custom_linear_solve":
            return self.linear_solve(params, operands)
        if name == "triangular_solve":
            matrix, right = operands
            return [self.arrays.triangular(matrix, right, params)]
        if name == "dot_general":
            left, right = operands
            return [self.arrays.product(left, right, params["dimension_numbers"])]
        if name in ELEMENTWISE:
            kind = kind_of(equation.outvars[0].aval.dtype)
            value = params.get("y", params.get("rounding_method"))
            return [self.arrays.elementwise(name, operands, kind, value)]
        raise NotScalarError(f"its operation {name} has no scalar form")

    def _folded(self, equation: Any, operands: list[Numbers]) -> list[Numbers] | None:
        """Return the constant results of an equation whose operands are constants."""
        arrays = [
            self.arrays.values(numbers, atom.aval.dtype)
            for numbers, atom in zip(operands, equation.invars, strict=True)
        ]
        known = [array for array in arrays if array is not None]
        if len(known) < len(arrays):
            return None
        return [self.arrays.constants(each) for each in _bound(equation, known)]

    def moved(self, equation: Any, operands: list[Numbers]) -> list[Numbers]:
        """Return the node numbers after an operation that only moves elements."""
        name, arrays = equation.primitive.name, []
        if name == "scatter-add":
            return [self.added(equation, operands)]
        for place, (numbers, atom) in enumerate(
            zip(operands, equation.invars, strict=True)
        ):
            index = place in MOVES[name]
            array = self.arrays.values(numbers, atom.aval.dtype) if index else numbers
            if array is None:
                return [self.arrays.at_computed_place(name, operands)]
            arrays.append(array)
        found = _bound(equation, arrays)
        if any(((each < 0) | (each >= len(self.graph.nodes))).any() for each in found):
            raise NotScalarError(f"its {name} reads outside the array")
        return found

    def added(self, equation: Any, operands: list[Numbers]) -> Numbers:
        """Return the nodes of an array to which elements are added at some places."""
        array, index, more = operands
        places = self.arrays.values(index, equation.invars[1].aval.dtype)
        if places is None:
            return self.arrays.at_computed_place("scatter-add", operands)
        # Add each element, as 1, to zeros: the places that become 1 are its own.
        units, zeros = np.eye(more.size), np.zeros(array.shape)
        found = [
            _bound(equation, [zeros, places, unit.reshape(more.shape)])[0]
            for unit in units
        ]
        total = array.copy()
        for number, where in zip(more.ravel(), found, strict=True):
            for place in np.argwhere(where):
                pair = [total[*place], np.asarray(number)]
                total[*place] = self.arrays.elementwise("add", pair, "real")
        return total

    def linear_solve(self, params: Any, operands: list[Numbers]) -> list[Numbers]:
        """Return the solution of linear equations whose matrix is factorised."""
        lengths, jaxprs = params["const_lengths"], params["jaxprs"]
        before = lengths.matvec + lengths.vecmat
        consts = operands[before : before + lengths.solve]
        return self.evaluate(jaxprs.solve, [*consts, *operands[sum(lengths) :]])

    def cond(self, branches: Any, operands: list[Numbers]) -> list[Numbers]:
        """Return the results of the branch that the first operand selects."""
        index, *rest = operands
        known = self.arrays.values(index, int)
        if known is not None:
            return self.evaluate(
                branches[int(np.clip(known, 0, len(branches) - 1))], rest
            )
        found = self.evaluate(branches[0], rest)
        for number, branch in enumerate(branches[1:], 1):
            others = self.evaluate(branch, rest)
            least = self.arrays.constants(np.asarray(number))
            if self.graph.nodes[int(index)].kind == "boolean":
                chosen = index
            else:
                chosen = self.arrays.elementwise("ge", [index, least], "boolean")
            found = [
                self.arrays.elementwise("select_n", [chosen, a, b], self.arrays.kind(a))
                for a, b in zip(found, others, strict=True)
            ]
        return found

    def scan(self, params: Any, operands: list[Numbers]) -> list[Numbers]:
        """Return the results of a scan, unrolled or as a loop."""
        consts, count = params["num_consts"], params["num_carry"]
        shared, carry = operands[:consts], operands[consts : consts + count]
        rows = operands[consts + count :]
        closed, length = params["jaxpr"], params["length"]
        if not rows and len(closed.jaxpr.outvars) == count and length >= self.rolled:
            return self._repeated(closed, shared, carry, length)
        order = range(length)
        collected: list[list[Numbers]] = []
        for i in reversed(order) if params["reverse"] else order:
            found = self.evaluate(closed, [*shared, *carry, *(x[i] for x in rows)])
            carry = found[:count]
            collected.append(found[count:])
        if params["reverse"]:
            collected.reverse()
        return [*carry, *(np.stack(each) for each in zip(*collected, strict=True))]

    def _repeated(
        self, closed: Any, shared: list[Numbers], carry: list[Numbers], length: int
    ) -> list[Numbers]:
        """Return the carry after ``length`` evaluations in a loop in C."""
        one, end = (self.arrays.constants(np.asarray(n)) for n in (1, length))

        def condition(inside: list[Numbers]) -> Numbers:
            return self.arrays.elementwise("lt", [inside[0], end], "boolean")

        def body(inside: list[Numbers]) -> list[Numbers]:
            following = self.arrays.elementwise("add", [inside[0], one], "integer")
            return [following, *self.evaluate(closed, [*shared, *inside[1:]])]

        start = self.arrays.constants(np.asarray(0))
        return self._looped(condition, body, [start, *carry])[1:]

    def while_loop(self, params: Any, operands: list[Numbers]) -> list[Numbers]:
        """Return the results of a while loop, which remains a loop in C."""
        heads, bodies = params["cond_nconsts"], params["body_nconsts"]
        of_head, of_body = operands[:heads], operands[heads : heads + bodies]

        def condition(inside: list[Numbers]) -> Numbers:
            return self.evaluate(params["cond_jaxpr"], [*of_head, *inside])[0]

        def body(inside: list[Numbers]) -> list[Numbers]:
            return self.evaluate(params["body_jaxpr"], [*of_body, *inside])

        return self._looped(condition, body, operands[heads + bodies :])

    def _looped(
        self,
        condition: Callable[[list[Numbers]], Numbers],
        body: Callable[[list[Numbers]], list[Numbers]],
        first: list[Numbers],
    ) -> list[Numbers]:
        """Return the values after a loop that starts with the values ``first``.

        ``condition`` and ``body`` receive the values at the start of an iteration.
        """
        graph = self.graph
        before, mark = _flat(first), len(graph.nodes)
        level = graph.level + 1
        inner, outer = Block(level), Block(level)
        with graph.inside(outer):
            carried = [
                graph.add(CARRY, (), graph.nodes[number].kind, (mark, place))
                for place, number in enumerate(before)
            ]
            inside = _like(first, carried)
            holds = int(condition(inside))
            with graph.inside(inner):
                last = _flat(body(inside))
        loop = Loop(tuple(before), tuple(carried), outer, holds, inner, tuple(last))
        return _like(first, graph.add_loop(loop))


def _flat(arrays: Sequence[Numbers]) -> list[int]:
    return [int(n) for array in arrays for n in array.ravel()]


def _like(arrays: Sequence[Numbers], flat: Sequence[int]) -> list[Numbers]:
    """Return the numbers ``flat`` as arrays with the shapes of ``arrays``."""
    rest = iter(flat)
    return [
        np.array([next(rest) for _ in range(array.size)], int).reshape(array.shape)
        for array in arrays
    ]


def _bound(equation: Any, arrays: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Return the results of an equation on ``arrays`` of values or node numbers."""
    results = equation.primitive.bind(
        *(jax.numpy.asarray(array) for array in arrays), **equation.params
    )
    several = equation.primitive.multiple_results
    return [np.asarray(each) for each in (results if several else [results])]


def _source_of(equation: Any) -> str:
    """Return the function of the package that an equation comes from, or ""."""
    traceback = equation.source_info.traceback
    for frame in traceback.frames if traceback is not None else ():
        # A nested function or lambda has the name of the function that encloses it.
        name = frame.function_name.partition(".<")[0]
        if name[0] != "<" and _is_own(frame.file_name):
            return name
    return ""


@functools.cache
def _is_own(file: str) -> bool:
    """Return whether a file is one of the package that describes a step."""
    parts = Path(file).parts
    return "piezojax" in parts and TRACERS.isdisjoint(parts)
