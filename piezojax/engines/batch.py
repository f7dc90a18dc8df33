"""Batch axes of the operands of a run, grouped by the operands that have them."""

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

Positions = tuple[int | None, ...]
"""Position of each batch axis in the shape of an operand; None if that lacks it."""


def sizes_of(
    operands: Sequence[Any], positions: Sequence[Positions]
) -> tuple[int, ...]:
    """Return the size of each batch axis; ``operands`` are arrays or their shapes."""
    sizes = [1] * len(positions[0])
    for x, where in zip(operands, positions, strict=True):
        for axis, position in enumerate(where):
            if position is not None:
                sizes[axis] = x.shape[position]
    return tuple(sizes)


def batched(positions: Positions, axis: int | None) -> Positions:
    """Return the positions with a further batch axis, which comes first."""
    if axis is None:
        return None, *positions
    moved = (p if p is None or p < axis else p + 1 for p in positions)
    return axis, *moved


def axes_with_lanes(
    sizes: tuple[int, ...], positions: Sequence[Positions]
) -> list[int]:
    """Return the batch axes of several lanes that any of the operands has."""
    return [
        axis
        for axis, size in enumerate(sizes)
        if size > 1 and any(where[axis] is not None for where in positions)
    ]


class Batch(NamedTuple):
    """Batch axes of a run in three groups.

    ``directions`` are the axes that only tangents have, ``inner`` the axes of several
    lanes that inputs have, and ``outer`` the others. If inputs have none, the others
    are inner.
    """

    sizes: tuple[int, ...]
    directions: list[int]
    outer: list[int]
    inner: list[int]

    @classmethod
    def sorted(
        cls,
        sizes: tuple[int, ...],
        values: Sequence[Positions],
        inputs: Sequence[Positions],
    ) -> "Batch":
        """Return the groups of the axes, which have ``sizes``.

        ``values`` are the positions of all operands except tangents, ``inputs`` those
        of the inputs.
        """
        axes = range(len(sizes))
        lanes = [
            axis for axis in axes if any(where[axis] is not None for where in values)
        ]
        inner = axes_with_lanes(sizes, inputs) or lanes
        return cls(
            sizes,
            [axis for axis in axes if axis not in lanes],
            [axis for axis in lanes if axis not in inner],
            inner,
        )

    @property
    def counts(self) -> tuple[int, int, int]:
        """Number of directions, of outer and of inner lanes."""
        count = (math.prod(self.sizes[axis] for axis in group) for group in self[1:])
        directions, outer, inner = count
        return directions, outer, inner

    def spread(self) -> "Batch":
        """Return the groups with every direction as an inner lane."""
        return self._replace(directions=[], inner=[*self.inner, *self.directions])

    def grouped(self, x: Any, where: Positions, *, last: bool = False) -> Array:
        """Return an operand with three batch axes, one for each group.

        The axis of a group has the size 1 if the lanes of this group share the operand:
        it has no axis of them, or only axes of a single lane. The batch axes come
        first, or ``last``.
        """
        own = [axis for axis in range(x.ndim) if axis not in where]
        order = [axis for group in self[1:] for axis in group]
        present = [p for axis in order if (p := where[axis]) is not None]
        shape, whole, counts = [], [], []
        for group, count in zip(self[1:], self.counts, strict=True):
            mine = any(where[a] is not None and self.sizes[a] > 1 for a in group)
            for axis in group:
                size = self.sizes[axis]
                shape.append(1 if where[axis] is None else size)
                whole.append(size if mine else 1)
            counts.append(count if mine else 1)
        rest = [x.shape[axis] for axis in own]
        if last:
            found = x.transpose(*own, *present).reshape(*rest, *shape)
            return jnp.broadcast_to(found, (*rest, *whole)).reshape(*rest, *counts)
        found = x.transpose(*present, *own).reshape(*shape, *rest)
        return jnp.broadcast_to(found, (*whole, *rest)).reshape(*counts, *rest)

    def restored(self, x: Array) -> Array:
        """Replace the three batch axes of an array by those of the run, in order."""
        order = [axis for group in self[1:] for axis in group]
        rest = x.shape[3:]
        split = x.reshape(*(self.sizes[axis] for axis in order), *rest)
        places = [int(i) for i in np.argsort(order)]
        return split.transpose(*places, *range(len(order), split.ndim))


def mapped(
    function: Callable[..., Any],
    operands: Sequence[Any],
    positions: Sequence[Positions],
) -> Any:
    """Return the results of ``function`` for all lanes, with the batch axes first."""
    sizes, left = sizes_of(operands, positions), [list(where) for where in positions]
    axes = []
    # Positions inside a map do not count the axes that the maps around it removed.
    for axis in range(len(sizes)):
        axes.append(tuple(where[axis] for where in left))
        for where, mapped in zip(left, axes[-1], strict=True):
            if mapped is not None:
                where[axis] = None
                where[:] = [p - 1 if p is not None and p > mapped else p for p in where]
    for in_axes, size in reversed(list(zip(axes, sizes, strict=True))):
        function = jax.vmap(function, in_axes=in_axes, axis_size=size)
    return function(*operands)
