"""Tracing: the scalar operations of a function of JAX.

JAX traces the function; every array of the trace becomes a NumPy array with the numbers
of its nodes. Operations that only move elements act on these numbers.
"""

import math
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import equinox.internal as eqxi
import jax
import numpy as np
from jax.extend import core as jex

from .graph import CARRY, INPUT, READ, Block, Graph, Kind, Loop

Numbers = np.ndarray
"""Array of the numbers of nodes, with the shape of the traced array."""

ELEMENTWISE = {
    "abs", "acos", "add", "and", "asin", "atan", "atan2", "ceil", "clamp",
    "convert_element_type", "cos", "cosh", "div", "eq", "exp", "expm1", "floor",
    "ge", "gt", "integer_pow", "is_finite", "le", "log", "log1p", "logistic", "lt",
    "max", "min", "mul", "ne", "neg", "not", "or", "pow", "rem", "round", "rsqrt",
    "select_n", "sign", "sin", "sinh", "sqrt", "square", "sub", "tan", "tanh", "xor",
}  # fmt: skip
"""Operations of C, element by element."""

MOVES = {
    **dict.fromkeys(("broadcast_in_dim", "concatenate", "expand_dims", "pad"), ()),
    **dict.fromkeys(("reshape", "rev", "slice", "split", "squeeze", "stack"), ()),
    "transpose": (),
    "dynamic_slice": range(1, 32),
    "dynamic_update_slice": range(2, 32),
    "gather": (1,),
    "scatter": (1,),
    "scatter-add": (1,),
}
"""Operations that move elements, with the places of those operands that are indices."""

CALLS = ("jaxpr", "call_jaxpr", "fun_jaxpr")
"""Parameters that hold the function of a call."""

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
"""Operations that change nothing."""

ALIASES = {"add_any": "add"}
"""Operations under a second name."""

LONG = 256
"""Least length of an array that stays an array."""

MOST = 15_000
"""Largest number of operations of a graph: compilers of C take minutes for more."""


class NotScalarError(ValueError):
    """The function has an operation that is not one of scalars."""


class Memory(NamedTuple):
    """A long array that stays an array, such as a stored period.

    ``place`` is that of its first element among the inputs. ``writes`` are the elements
    that have changed since, as pairs of the nodes of index and value.
    """

    place: int
    size: int
    writes: tuple[tuple[int, int], ...] = ()

    def elements(self, graph: Graph) -> Numbers:
        """Return the nodes of the elements. Raises NotScalarError after a write."""
        if self.writes:
            raise NotScalarError("it uses a long array as a whole after a change")
        places = range(self.place, self.place + self.size)
        return np.array([graph.add(INPUT, (), "real", place) for place in places], int)


def trace(function: Callable, *arguments: Any) -> tuple[Graph, list[Any]]:
    """Return the graph of ``function`` and the nodes of its outputs, leaf by leaf.

    Inputs are numbered through all elements of the leaves of ``arguments``. Raises
    NotScalarError for an operation that has no scalar form.
    """
    closed: Any = jax.make_jaxpr(function)(*arguments)
    # Solvers bind operations of Equinox that have no form but their implementation, by
    # which it cannot replace those within a derivative.
    with suppress(TypeError):
        closed = eqxi.finalise_jaxpr(closed)
    tracer = _Tracer()
    place = 0
    inputs = []
    for variable in closed.jaxpr.invars:
        size = math.prod(variable.aval.shape)
        kind = _kind(variable.aval.dtype)
        if len(variable.aval.shape) == 1 and size >= LONG and kind == "real":
            inputs.append(Memory(place, size))
            place += size
            continue
        numbers = [
            tracer.graph.add(INPUT, (), kind, place + i, "") for i in range(size)
        ]
        inputs.append(np.array(numbers, int).reshape(variable.aval.shape))
        place += size
    return tracer.graph, tracer.evaluate(closed, inputs)


def _kind(dtype: Any) -> Kind:
    if np.issubdtype(dtype, np.bool_):
        return "boolean"
    if np.issubdtype(dtype, np.integer):
        return "integer"
    if np.issubdtype(dtype, np.floating):
        return "real"
    raise NotScalarError(f"it computes with {dtype}; the export has real numbers only")


class _Tracer:
    def __init__(self):
        self.graph = Graph()
        self._source = ""

    def evaluate(self, closed: Any, inputs: Sequence[Any]) -> list[Any]:
        """Return the outputs of a closed jaxpr."""
        jaxpr = closed.jaxpr
        values: dict[Any, Numbers] = dict(zip(jaxpr.invars, inputs, strict=True))
        for variable, constant in zip(jaxpr.constvars, closed.consts, strict=True):
            values[variable] = self.constants(np.asarray(constant))

        def read(atom: Any) -> Any:
            if isinstance(atom, jex.Literal):
                kind: Any = atom.aval
                return self.constants(np.asarray(atom.val, kind.dtype))
            return values[atom]

        for equation in jaxpr.eqns:
            outer, self._source = self._source, _source_of(equation) or self._source
            results = self.equation(equation, [read(atom) for atom in equation.invars])
            self._source = outer
            values.update(zip(equation.outvars, results, strict=True))
            if len(self.graph.nodes) > MOST:
                raise NotScalarError(f"it has more than {MOST} scalar operations")
        return [read(atom) for atom in jaxpr.outvars]

    def constants(self, array: np.ndarray) -> Numbers:
        kind = _kind(array.dtype)
        plain = [self.graph.constant(value, kind) for value in array.ravel().tolist()]
        return np.array(plain, int).reshape(array.shape)

    def values(self, numbers: Numbers, dtype: Any) -> np.ndarray | None:
        """Return the values of constants, or None if one is computed."""
        nodes = [self.graph.nodes[number] for number in numbers.ravel()]
        if any(node.operation != "constant" for node in nodes):
            return None
        return np.array([node.value for node in nodes], dtype).reshape(numbers.shape)

    def equation(self, equation: Any, operands: list[Any]) -> list[Any]:
        """Return the results of an equation of a jaxpr."""
        name, params = equation.primitive.name, equation.params
        name = ALIASES.get(name, name)
        if name in SAME:
            return operands
        inner = next((params[key] for key in CALLS if key in params), None)
        if any(isinstance(operand, Memory) for operand in operands):
            found = self.in_memory(equation, operands)
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
            return [self.reduced(FOLDS[name], operands[0], axes)]
        if name == "dot_general":
            left, right = operands
            return [self.product(left, right, params["dimension_numbers"])]
        if name in ELEMENTWISE:
            kind = _kind(equation.outvars[0].aval.dtype)
            value = params.get("y", params.get("rounding_method"))
            return [self.elementwise(name, operands, kind, value)]
        raise NotScalarError(f"its operation {name} has no scalar form")

    def _folded(self, equation: Any, operands: list[Numbers]) -> list[Numbers] | None:
        """Return the constant results of an equation whose operands are constants."""
        arrays = [
            self.values(numbers, atom.aval.dtype)
            for numbers, atom in zip(operands, equation.invars, strict=True)
        ]
        known = [array for array in arrays if array is not None]
        if len(known) < len(arrays):
            return None
        return [self.constants(each) for each in _bound(equation, known)]

    def elementwise(
        self, name: str, operands: Sequence[Numbers], kind: Kind, value: Any = None
    ) -> Numbers:
        arrays = np.broadcast_arrays(*operands)
        flat = zip(*(array.ravel() for array in arrays), strict=True)
        numbers = [
            self.scalar(name, [int(n) for n in each], kind, value) for each in flat
        ]
        return np.array(numbers, int).reshape(arrays[0].shape)

    def scalar(self, name: str, operands: list[int], kind: Kind, value: Any) -> int:
        """Return the node of an operation; neutral operands need none."""
        nodes = [self.graph.nodes[number] for number in operands]
        known = [node.value if node.operation == "constant" else None for node in nodes]
        if name == "convert_element_type" and nodes[0].kind == kind:
            return operands[0]
        if name == "select_n" and known[0] is not None:
            return operands[1 + int(known[0])]
        if name == "select_n" and len(set(operands[1:])) == 1:
            return operands[1]
        if name in ("mul", "div") and known[1] == 1.0:
            return operands[0]
        if name == "mul" and known[0] == 1.0:
            return operands[1]
        return self.graph.add(name, operands, kind, value, self._source)

    def moved(self, equation: Any, operands: list[Numbers]) -> list[Numbers]:
        """Return the numbers that an operation without arithmetic moves."""
        name, arrays = equation.primitive.name, []
        for place, (numbers, atom) in enumerate(
            zip(operands, equation.invars, strict=True)
        ):
            index = place in MOVES[name]
            array = self.values(numbers, atom.aval.dtype) if index else numbers
            if array is None:
                return [self.at_computed_place(name, operands)]
            arrays.append(array)
        found = _bound(equation, arrays)
        if any(((each < 0) | (each >= len(self.graph.nodes))).any() for each in found):
            raise NotScalarError(f"its {name} leaves the array")
        return found

    def in_memory(self, equation: Any, operands: list[Any]) -> Numbers | Memory | None:
        """Return the result of an equation that reads or writes one element.

        None for every other equation.
        """
        name, (memory, *others) = equation.primitive.name, operands
        shape = equation.outvars[0].aval.shape
        if not isinstance(memory, Memory):
            return None
        if name in ("broadcast_in_dim", "reshape") and shape == (memory.size,):
            return memory
        if name == "dynamic_slice" and shape == (1,):
            first, last = (self.constants(np.asarray(k)) for k in (0, memory.size - 1))
            index = self.elementwise("clamp", [first, others[0], last], "integer")
            return np.array([self._read(memory, int(index))])
        if name not in ("scatter", "scatter-add") or others[1].size != 1:
            return None
        index, value = int(others[0].ravel()[0]), int(others[1].ravel()[0])
        if name == "scatter-add":
            value = self.scalar("add", [self._read(memory, index), value], "real", None)
        return memory._replace(writes=(*memory.writes, (index, value)))

    def _read(self, memory: Memory, index: int) -> int:
        found = self.graph.add(READ, (index,), "real", memory.place, self._source)
        for place, value in memory.writes:
            same = self.scalar("eq", [place, index], "boolean", None)
            found = self.scalar("select_n", [same, found, value], "real", None)
        return found

    def at_computed_place(self, name: str, operands: list[Numbers]) -> Numbers:
        """Return one element read, or the array with one element written.

        Every element is compared with the place, which suits short arrays.
        """
        array, index, *written = operands
        single = array.ndim == 1 and index.size == 1
        if name == "dynamic_slice" and single:
            last = self.constants(np.asarray(array.size - 1))
            zero = self.constants(np.asarray(0))
            place = self.elementwise("clamp", [zero, index, last], "integer")
            found = array[:1]
            for k in range(1, array.size):
                found = self._chosen(place, k, found, array[k : k + 1])
            return found
        if name in ("scatter", "scatter-add") and single and written[0].size == 1:
            value, rows = written[0].ravel(), []
            for k, old in enumerate(array[:, None]):
                new = value
                if name == "scatter-add":
                    new = self.elementwise("add", [old, value], self._kind_of(old))
                rows.append(self._chosen(index.ravel(), k, old, new))
            return np.concatenate(rows)
        raise NotScalarError(f"it uses an array at a computed place ({name})")

    def _chosen(
        self, place: Numbers, k: int, other: Numbers, value: Numbers
    ) -> Numbers:
        here = self.elementwise("eq", [place, self.constants(np.asarray(k))], "boolean")
        return self.elementwise("select_n", [here, other, value], self._kind_of(value))

    def reduced(self, name: str, operand: Numbers, axes: Sequence[int]) -> Numbers:
        kept = [axis for axis in range(operand.ndim) if axis not in axes]
        shape = [operand.shape[axis] for axis in kept]
        rows = operand.transpose([*axes, *kept]).reshape(-1, *shape)
        kind = self.graph.nodes[int(operand.ravel()[0])].kind
        total = rows[0]
        for row in rows[1:]:
            total = self.elementwise(name, [total, row], kind)
        return total

    def product(self, left: Numbers, right: Numbers, dimensions: Any) -> Numbers:
        """Return the sum of products over the contracted axes."""
        (left_sum, right_sum), (left_batch, right_batch) = dimensions

        def ordered(array: Numbers, batch: Any, summed: Any) -> tuple[Numbers, list]:
            free = [a for a in range(array.ndim) if a not in batch and a not in summed]
            shape = [array.shape[a] for a in free]
            batches = [array.shape[a] for a in batch]
            moved = array.transpose([*batch, *free, *summed])
            return moved.reshape(math.prod(batches), math.prod(shape), -1), shape

        a, rows = ordered(left, left_batch, left_sum)
        b, columns = ordered(right, right_batch, right_sum)
        products = self.elementwise("mul", [a[:, :, None, :], b[:, None, :, :]], "real")
        batches = [left.shape[axis] for axis in left_batch]
        return self.reduced("add", products, [3]).reshape([*batches, *rows, *columns])

    def cond(self, branches: Any, operands: list[Numbers]) -> list[Numbers]:
        """Return the results of the branch that the first operand selects."""
        index, *rest = operands
        known = self.values(index, int)
        if known is not None:
            return self.evaluate(
                branches[int(np.clip(known, 0, len(branches) - 1))], rest
            )
        found = self.evaluate(branches[0], rest)
        for number, branch in enumerate(branches[1:], 1):
            others = self.evaluate(branch, rest)
            least = self.constants(np.asarray(number))
            if self.graph.nodes[int(index)].kind == "boolean":
                chosen = index
            else:
                chosen = self.elementwise("ge", [index, least], "boolean")
            found = [
                self.elementwise("select_n", [chosen, a, b], self._kind_of(a))
                for a, b in zip(found, others, strict=True)
            ]
        return found

    def _kind_of(self, numbers: Numbers) -> Kind:
        return (
            self.graph.nodes[int(numbers.ravel()[0])].kind if numbers.size else "real"
        )

    def scan(self, params: Any, operands: list[Numbers]) -> list[Numbers]:
        """Return the results of a loop of known length, which is unrolled."""
        consts, count = params["num_consts"], params["num_carry"]
        shared, carry = operands[:consts], operands[consts : consts + count]
        rows = operands[consts + count :]
        order = range(params["length"])
        collected: list[list[Numbers]] = []
        for i in reversed(order) if params["reverse"] else order:
            found = self.evaluate(
                params["jaxpr"], [*shared, *carry, *(x[i] for x in rows)]
            )
            carry = found[:count]
            collected.append(found[count:])
        if params["reverse"]:
            collected.reverse()
        return [*carry, *(np.stack(each) for each in zip(*collected, strict=True))]

    def while_loop(self, params: Any, operands: list[Numbers]) -> list[Numbers]:
        """Return the results of a loop that stays a loop."""
        heads, bodies = params["cond_nconsts"], params["body_nconsts"]
        of_head, of_body = operands[:heads], operands[heads : heads + bodies]
        first = operands[heads + bodies :]
        graph = self.graph
        flat = [int(n) for array in first for n in array.ravel()]
        mark = len(graph.nodes)
        carried, place = [], 0
        head, body = Block(), Block()
        with graph.inside(head):
            for array in first:
                ids = []
                for n in array.ravel():
                    ids.append(
                        graph.add(CARRY, (), graph.nodes[int(n)].kind, (mark, place))
                    )
                    place += 1
                carried.append(np.array(ids, int).reshape(array.shape))
            (condition,) = self.evaluate(params["cond_jaxpr"], [*of_head, *carried])
            with graph.inside(body):
                last = self.evaluate(params["body_jaxpr"], [*of_body, *carried])
        results = graph.add_loop(
            Loop(
                tuple(flat),
                tuple(int(n) for array in carried for n in array.ravel()),
                head,
                int(condition),
                body,
                tuple(int(n) for array in last for n in array.ravel()),
            )
        )
        found, place = [], 0
        for array in first:
            found.append(
                np.array(results[place : place + array.size], int).reshape(array.shape)
            )
            place += array.size
        return found


def _bound(equation: Any, arrays: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Return the results of an equation for the values or numbers ``arrays``."""
    results = equation.primitive.bind(
        *(jax.numpy.asarray(array) for array in arrays), **equation.params
    )
    several = equation.primitive.multiple_results
    return [np.asarray(each) for each in (results if several else [results])]


def _source_of(equation: Any) -> str:
    """Return the function of the package that an equation comes from, or ""."""
    traceback = equation.source_info.traceback
    if traceback is None:
        return ""
    for frame in traceback.frames:
        path = Path(frame.file_name)
        # Functions without a name are part of the one that holds them.
        name = frame.function_name.partition(".<")[0]
        own = "piezojax" in path.parts and "exporting" not in path.parts
        if own and name[0] != "<":
            return name
    return ""
