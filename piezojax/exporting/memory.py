"""Long arrays that stay arrays in C, such as stored periods and trials."""

import math
from typing import Any, NamedTuple

import numpy as np

from .graph import INPUT, Graph

Numbers = np.ndarray
"""Array of the numbers of nodes, with the shape of the traced array."""


class NotScalarError(ValueError):
    """The function has an operation that is not one of scalars."""


class Memory(NamedTuple):
    """A long array, of which single elements are read and written.

    ``place`` is that of its first element among the inputs. ``writes`` are the elements
    that have changed since, as pairs of the nodes of index and value. ``offset`` is the
    node of the index of the first element in the stored array, which is flat, if this
    is a part of it.
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

        Raises NotScalarError after a write, and for a part at a computed place.
        """
        if self.writes or self.offset is not None:
            raise NotScalarError("it uses a long array as a whole after a change")
        places = range(self.place, self.place + self.size)
        nodes = [graph.add(INPUT, (), "real", place) for place in places]
        return np.array(nodes, int).reshape(self.shape)

    def window(self, sizes: tuple[int, ...]) -> bool:
        """Return whether a slice of ``sizes`` is one stretch of the stored array."""
        ones = next((i for i, size in enumerate(sizes) if size != 1), len(sizes))
        return tuple(sizes[ones + 1 :]) == self.shape[ones + 1 :]


def whole_index(equation: Any, axes: int) -> bool:
    """Return whether a scatter writes one element by an index for each axis."""
    numbers = equation.params["dimension_numbers"]
    every = tuple(range(axes))
    return (
        tuple(numbers.inserted_window_dims) == every
        and tuple(numbers.scatter_dims_to_operand_dims) == every
    )
