"""Arithmetic of arrays of graph nodes."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from .graph import CONSTANT, READ, Graph, Kind
from .memory import Memory, NotScalarError, Numbers, whole_index
from .simplify import Simplifier


def kind_of(dtype: Any) -> Kind:
    """Return the kind of the scalars of ``dtype``.

    Raises NotScalarError for complex numbers and other types without a scalar form.
    """
    if np.issubdtype(dtype, np.bool_):
        return "boolean"
    if np.issubdtype(dtype, np.integer):
        return "integer"
    if np.issubdtype(dtype, np.floating):
        return "real"
    raise NotScalarError(f"it computes with {dtype}; the export has real numbers only")


class NodeArrays:
    """Arithmetic of arrays of nodes, which adds nodes to ``graph``.

    ``source`` is the Python function that the next nodes come from.
    """

    def __init__(self, graph: Graph):
        self.graph = graph
        self.source = ""
        self._simplifier = Simplifier(graph)

    def constants(self, array: np.ndarray) -> Numbers:
        """Return the nodes of the elements of ``array``."""
        kind = kind_of(array.dtype)
        plain = [self.graph.constant(value, kind) for value in array.ravel().tolist()]
        return np.array(plain, int).reshape(array.shape)

    def values(self, numbers: Numbers, dtype: Any) -> np.ndarray | None:
        """Return the values of the nodes, or None unless all are constants."""
        nodes = [self.graph.nodes[number] for number in numbers.ravel()]
        if any(node.operation != CONSTANT for node in nodes):
            return None
        return np.array([node.value for node in nodes], dtype).reshape(numbers.shape)

    def elementwise(
        self, name: str, operands: Sequence[Numbers], kind: Kind, value: Any = None
    ) -> Numbers:
        """Return the nodes of an elementwise operation; operands are broadcast."""
        arrays = np.broadcast_arrays(*operands)
        flat = zip(*(array.ravel() for array in arrays), strict=True)
        numbers = [
            self.scalar(name, [int(n) for n in each], kind, value) for each in flat
        ]
        return np.array(numbers, int).reshape(arrays[0].shape)

    def scalar(self, name: str, operands: list[int], kind: Kind, value: Any) -> int:
        """Return the node of a scalar operation."""
        return self._simplifier.add(name, operands, kind, value, self.source)

    def in_memory(self, equation: Any, operands: list[Any]) -> Numbers | Memory | None:
        """Return the result of an equation on a long array, or None.

        The equation may read or write one element, reshape the array, or take a
        contiguous slice of it. The result of every other equation is None.
        """
        name, (memory, *others) = equation.primitive.name, operands
        shape = equation.outvars[0].aval.shape
        if not isinstance(memory, Memory):
            return None
        if name in ("broadcast_in_dim", "reshape", "squeeze", "expand_dims"):
            same = math.prod(shape) == memory.size
            return memory._replace(shape=shape) if same else None
        if name == "slice" and not equation.params["strides"]:
            starts = equation.params["start_indices"]
            others = [np.asarray(self._integer(i)) for i in starts]
        if name in ("slice", "dynamic_slice") and memory.window(shape) and others:
            last = np.subtract(memory.shape, shape)
            index = self._flat_index(memory, [int(each) for each in others], last)
            if math.prod(shape) > 1:
                return memory._replace(shape=shape, offset=index)
            return np.full(shape, self._read(memory, index))
        axes = len(memory.shape)
        if name not in ("scatter", "scatter-add") or memory.offset is not None:
            return None
        if others[1].size != 1 or not whole_index(equation, axes):
            return None
        index = self._flat_index(memory, others[0].ravel().tolist())
        value = int(others[1].ravel()[0])
        if name == "scatter-add":
            value = self.scalar("add", [self._read(memory, index), value], "real", None)
        return memory._replace(writes=(*memory.writes, (index, value)))

    def _flat_index(
        self, memory: Memory, indices: Sequence[int], last: Any = None
    ) -> int:
        """Return the node of the flat index; ``last`` limits the index of each axis."""
        parts = [] if memory.offset is None else [memory.offset]
        for axis, index in enumerate(indices):
            if last is not None:
                ends = (self._integer(0), self._integer(int(last[axis])))
                limited = [np.asarray(n) for n in (ends[0], index, ends[1])]
                index = int(self.elementwise("clamp", limited, "integer"))
            stride = self._integer(math.prod(memory.shape[axis + 1 :]))
            parts.append(self.scalar("mul", [index, stride], "integer", None))
        total = parts[0]
        for part in parts[1:]:
            total = self.scalar("add", [total, part], "integer", None)
        return total

    def _integer(self, value: int) -> int:
        return self.graph.constant(value, "integer")

    def _read(self, memory: Memory, index: int) -> int:
        found = self.graph.add(READ, (index,), "real", memory.place, self.source)
        for place, value in memory.writes:
            same = self.scalar("eq", [place, index], "boolean", None)
            found = self.scalar("select_n", [same, found, value], "real", None)
        return found

    def at_computed_place(self, name: str, operands: list[Numbers]) -> Numbers:
        """Return one element at a computed index, or the array with it written.

        The index is compared with that of every element, which suits short arrays.
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
                    new = self.elementwise("add", [old, value], self.kind(old))
                rows.append(self._chosen(index.ravel(), k, old, new))
            return np.concatenate(rows)
        raise NotScalarError(f"it uses an array at a computed index ({name})")

    def _chosen(
        self, place: Numbers, k: int, other: Numbers, value: Numbers
    ) -> Numbers:
        here = self.elementwise("eq", [place, self.constants(np.asarray(k))], "boolean")
        return self.elementwise("select_n", [here, other, value], self.kind(value))

    def reduced(self, name: str, operand: Numbers, axes: Sequence[int]) -> Numbers:
        """Return the nodes of a reduction along ``axes``, taken in element order."""
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

    def triangular(self, matrix: Numbers, right: Numbers, params: Any) -> Numbers:
        """Return X of A X = B, or of X A = B, for a triangular ``matrix`` A."""
        if matrix.ndim != 2:
            raise NotScalarError("it solves several systems of equations at once")
        lower, left = params["lower"], params["left_side"]
        # A' X = B needs the transpose of A, and so does X A = B, as A' X' = B'.
        if params["transpose_a"] == left:
            matrix, lower = matrix.T, not lower
        rows = right if left else right.T
        found: dict[int, Numbers] = {}
        for i in range(len(matrix)) if lower else reversed(range(len(matrix))):
            total = rows[i]
            for j, known in found.items():
                product = self.elementwise("mul", [matrix[i, j], known], "real")
                total = self.elementwise("sub", [total, product], "real")
            if not params["unit_diagonal"]:
                total = self.elementwise("div", [total, matrix[i, i]], "real")
            found[i] = total
        solved = np.stack([found[i] for i in range(len(matrix))])
        return solved if left else solved.T

    def kind(self, numbers: Numbers) -> Kind:
        """Return the kind of the first of ``numbers``, "real" if there are none."""
        return (
            self.graph.nodes[int(numbers.ravel()[0])].kind if numbers.size else "real"
        )
