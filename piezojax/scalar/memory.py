"""Long arrays that remain arrays in C, such as stored periods and trials."""

import math
from typing import Any, NamedTuple

import numpy as np

from .graph import INPUT, Graph

Numbers = np.ndarray
"""Array of node numbers, with the shape of the traced array."""


class NotScalarError(ValueError):
    """The traced function has an operation without a scalar form."""


class Memory(NamedTuple):
    """A long array, or a slice of one, with access to single elements.

    ``place`` is the place of the first element of the stored array among the inputs.
    ``writes`` are the changed elements, as pairs of index node and value node.
    For a slice, ``offset`` is the node of the flat index of its first element.
    """

    place: int
    shape: tuple[int, ...]
    writes: tuple[tuple[int, int], ...] = ()
    offset: int | None = None

    @property
    def size(self) -> int:
        """Number of elements."""
        return math.prod(self.shape)

    def elements(self, graph: Graph) -> Numbers:
        """Return the nodes of the elements.

        Raises NotScalarError after a write, and for a slice.
        """
        if self.writes or self.offset is not None:
            raise NotScalarError("it uses a whole long array after a write or slice")
        places = range(self.place, self.place + self.size)
        nodes = [graph.add(INPUT, (), "real", place) for place in places]
        return np.array(nodes, int).reshape(self.shape)

    def window(self, sizes: tuple[int, ...]) -> bool:
        """Return whether a slice of ``sizes`` is contiguous in the stored array."""
        ones = next((i for i, size in enumerate(sizes) if size != 1), len(sizes))
        return tuple(sizes[ones + 1 :]) == self.shape[ones + 1 :]


def whole_index(equation: Any, axes: int) -> bool:
    """Return whether a scatter writes one element, with one index per axis."""
    numbers = equation.params["dimension_numbers"]
    every = tuple(range(axes))
    return (
        tuple(numbers.inserted_window_dims) == every
        and tuple(numbers.scatter_dims_to_operand_dims) == every
    )
