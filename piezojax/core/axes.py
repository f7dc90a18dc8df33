"""Signals of several axes: tuples with one scalar per axis.

In batches a packed array would be two to seven times slower: XLA keeps scalars in
registers, with the lanes side by side. Matrices are therefore rows of scalars, and
their products are written out.
"""

from collections.abc import Iterable
from typing import Any, TypeAlias, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp

from .arrays import Scalar, State, as_array, as_scalars, check
from .rollout import Metric
from .system import System

Axes: TypeAlias = tuple[Scalar, ...]
Rows: TypeAlias = tuple[tuple[Scalar, ...], ...]
Matrix: TypeAlias = Rows | Axes
"""A matrix as its rows, or a diagonal matrix as the numbers on its diagonal."""
Plain: TypeAlias = tuple[Any, ...]
"""Type of the vectors and matrices in a product. It is plain, because the tests check
annotated types at run time: checking every scalar of every product would take most of
the time of tracing."""

T = TypeVar("T")


def as_rows(values: Any) -> Rows:
    """Return a matrix, given as an array or nested sequence, as rows of scalars.

    Raises ValueError unless all rows have one length.
    """
    rows = tuple(as_scalars(row) for row in values)
    if len({len(row) for row in rows}) != 1:
        lengths = ", ".join(str(len(row)) for row in rows) or "none"
        raise ValueError(f"a matrix has rows of lengths {lengths}; they must be equal")
    return rows


def as_matrix(values: Any) -> Matrix:
    """Return a matrix as rows of scalars, or a diagonal [n] as a tuple of scalars.

    A product with a diagonal takes n multiplications instead of n^2. Raises ValueError
    unless all rows have one length.
    """
    values = tuple(values)
    if values and not any(_is_row(value) for value in values):
        return as_scalars(values)
    return as_rows(values)


def _is_row(value: Any) -> bool:
    return isinstance(value, tuple | list) or jnp.ndim(value) > 0


def as_matrices(values: Iterable[Any]) -> tuple[Rows, ...]:
    """Return several matrices as rows of scalars."""
    return tuple(as_rows(value) for value in values)


def diagonal(values: Iterable[Any]) -> Rows:
    """Return the diagonal matrix of ``values``."""
    values = as_scalars(values)
    zero = as_array(0.0)
    return tuple(
        tuple(value if i == j else zero for j in range(len(values)))
        for i, value in enumerate(values)
    )


def as_full(matrix: Matrix) -> Rows:
    """Return the rows of ``matrix``, which may be a diagonal."""
    return matrix if _is_row(matrix[0]) else diagonal(matrix)


def packed_matrix(rows: Rows) -> jax.Array:
    """Return rows of scalars as a packed matrix [rows, columns]."""
    return jnp.stack([jnp.stack(row) for row in rows])


def packed_matrices(matrices: Iterable[Rows]) -> jax.Array:
    """Return matrices of one size as a packed array [matrices, rows, columns]."""
    return jnp.stack([packed_matrix(rows) for rows in matrices])


def product(matrix: Plain, vector: Plain) -> Plain:
    """Return ``matrix @ vector``; a Matrix may be a diagonal."""
    if not isinstance(matrix[0], tuple):
        return tuple(m * v for m, v in zip(matrix, vector, strict=True))
    return tuple(
        sum(
            (m * v for m, v in zip(row[1:], vector[1:], strict=True)),
            row[0] * vector[0],
        )
        for row in matrix
    )


def plus(*terms: T) -> T:
    """Return the sum of vectors, or, row by row, of matrices."""
    return jax.tree.map(lambda *values: sum(values[1:], values[0]), *terms)


def minus(left: T, right: T) -> T:
    """Return the difference of two vectors or matrices."""
    return jax.tree.map(lambda a, b: a - b, left, right)


def _is_axes(node: Any) -> bool:
    """Return whether ``node`` is a signal of several axes: an innermost plain tuple."""
    return type(node) is tuple and not any(isinstance(part, tuple) for part in node)


def axis_of(signals: Any, axis: int) -> Any:
    """Return the component of ``signals``, such as an Observation, on one axis."""
    return jax.tree.map(lambda node: node[axis], signals, is_leaf=_is_axes)


class PerAxis(System):
    """Independent systems, one per axis.

    ``parts[i]`` receives component i of every signal in the input; the outputs form a
    tuple with one component per axis. ``names`` are the names of the axes in paths
    (``controller.Rx.integral``); without names, paths contain the index of the axis.
    Raises ValueError if ``names`` and ``parts`` differ in length.
    """

    parts: tuple[System, ...]
    names: tuple[str, ...] = eqx.field(static=True, default=())

    def __check_init__(self):
        if self.names and len(self.names) != len(self.parts):
            raise ValueError(f"{len(self.parts)} parts but names {self.names}")

    def init(self, input: Any) -> State:
        return tuple(part.init(axis_of(input, i)) for i, part in enumerate(self.parts))

    def step(self, state: State, input: Any) -> tuple[State, tuple[Any, ...]]:
        stepped = [
            part.step(s, axis_of(input, i))
            for i, (part, s) in enumerate(zip(self.parts, state, strict=True))
        ]
        return tuple(s for s, _ in stepped), tuple(output for _, output in stepped)


class Packed(System):
    """Adapter from a ``system`` of vectors to signals that are tuples of scalars.

    Input and output are tuples with one scalar per axis or actuator. It suits a few
    parts of a loop, such as an allocation or a geometry.
    """

    system: System

    def init(self, input: Axes) -> State:
        return self.system.init(jnp.stack(as_scalars(input)))

    def step(self, state: State, input: Axes) -> tuple[State, Axes]:
        state, output = self.system.step(state, jnp.stack(as_scalars(input)))
        return state, tuple(output[i] for i in range(output.shape[0]))


class PerAxisMetric(Metric):
    """``metric`` on each axis; its figures have the shape [axes]."""

    metric: Metric
    axes: int = eqx.field(static=True)

    def init(self) -> State:
        return (self.metric.init(),) * self.axes

    def update(self, total: State, index: jax.Array, output: Any) -> State:
        return tuple(
            self.metric.update(part, index, axis_of(output, axis))
            for axis, part in enumerate(total)
        )

    def result(self, total: State) -> Any:
        figures = [self.metric.result(part) for part in total]
        return jax.tree.map(lambda *values: jnp.stack(values), *figures)


def packed(signals: Any) -> Any:
    """Return ``signals``, such as a log, with an array [..., axes] for each tuple."""
    return jax.tree.map(
        lambda node: jnp.stack(node, axis=-1) if _is_axes(node) else node,
        signals,
        is_leaf=_is_axes,
    )


def check_square(name: str, matrix: Matrix, size: int) -> None:
    """Raise ValueError unless ``matrix`` has ``size`` rows and columns, all finite."""
    matrix = as_full(matrix)
    shape = len(matrix), len(matrix[0])
    if shape != (size, size):
        raise ValueError(
            f"{name} is {shape[0]} x {shape[1]}; it must be {size} x {size}"
        )
    for row in matrix:
        check(name, row)
