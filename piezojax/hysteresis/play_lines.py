"""Relays on lines of constant width, each of which is a play operator."""

from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array, Float

from ..core.arrays import Matrix, Scalar, ScalarLike, as_array
from ..core.system import System

Levels = Float[Array, " cells"]
Rows = tuple[Float[Array, " cells"], ...]

ROUNDING = 1e-13
"""Change of the output, um, below which the inverse does not change its voltage."""


@jax.jit
def rows_of(weights: Matrix) -> Rows:
    """Return one row for each cell of beta: the weights of all lines in that cell.

    Element k of a row belongs to line k, the cells whose alpha lies k cells above their
    beta. It is 0 beyond the end of the line.
    """
    cells = weights.shape[0]
    column = np.arange(cells)
    alpha = column + column[:, None]
    lines = jnp.where(alpha < cells, weights[alpha % cells, column[:, None]], 0.0)
    return tuple(lines)


def line_by_line(cells: int) -> list[tuple[int, int]]:
    """Return the cells in the order of PlayLines: along one line after another."""
    return [(j + k, j) for k in range(cells) for j in range(cells - k)]


class Traverse(NamedTuple):
    """Outputs of the lines while the input traverses all cells in one direction.

    Rows are cells, columns are lines. ``reached`` (um) is the output of a line before
    the cell, ``slopes`` (um) the change of its output in the cell.
    """

    reached: Matrix
    slopes: Matrix


@jax.jit
def upwards(rows: Rows) -> Traverse:
    """Return the Traverse of a rising input, which passes the alphas of the lines."""
    alpha, line = np.arange(len(rows))[:, None], np.arange(len(rows))
    slopes = jnp.where(line <= alpha, jnp.stack(rows)[alpha - line, line], 0.0)
    return Traverse(jnp.cumsum(slopes, axis=0) - slopes, slopes)


@jax.jit
def downwards(rows: Rows) -> Traverse:
    """Return the Traverse of a falling input: cells from the top, outputs negated."""
    slopes = jnp.stack(rows)[::-1]
    reached = jnp.cumsum(slopes, axis=0) - slopes - jnp.sum(slopes, axis=0)
    return Traverse(reached, slopes)


@partial(jax.checkpoint, prevent_cse=False)
def outputs(levels: Levels, *densities: Rows) -> tuple[Levels, ...]:
    """Return the output (um) of each line of relays, for each density.

    Reverse mode recomputes it, which is four times faster than storing it.
    """
    return tuple(_raised(levels, rows) for rows in densities)


@jax.custom_jvp
def _raised(levels: Levels, rows: Rows) -> Levels:
    total = jnp.zeros_like(levels)
    for beta, own in enumerate(rows):
        along = levels - beta
        up = jnp.where(along < 0.0, 0.0, jnp.where(along < 1.0, along, 1.0))
        total = total + own * up
    return total


def _steepness(levels: Levels, rows: Rows) -> Levels:
    """Return the slope of the lines, at an edge that of the upper cell."""
    total = jnp.zeros_like(levels)
    for beta, own in enumerate(rows):
        along = levels - beta
        total = total + jnp.where((along >= 0.0) & (along < 1.0), own, 0.0)
    return total


@partial(_raised.defjvp, symbolic_zeros=True)
def _raised_jvp(primals: Any, tangents: Any) -> tuple[Levels, Levels]:
    """All directions share one slope: without this rule each passes all cells."""
    (levels, rows), (moved, changed) = primals, tangents
    tangent = jnp.zeros_like(levels)
    if not isinstance(moved, SymbolicZero):
        tangent = tangent + _steepness(levels, rows) * moved
    if not all(isinstance(row, SymbolicZero) for row in changed):
        rows_moved = tuple(
            jnp.zeros(row.shape) if isinstance(row, SymbolicZero) else row
            for row in changed
        )
        tangent = tangent + _raised(levels, rows_moved)
    return _raised(levels, rows), tangent


class PlayLines(System):
    """Resolved Preisach model: a play operator for each width.

    ``rows`` are those of ``rows_of``; ``size`` (V) is that of a cell. The state holds,
    for each line, the beta up to which its relays are up, in cells from ``low``; that
    of line 0 is the input.
    """

    rows: Rows
    upwards: Traverse
    downwards: Traverse
    low: Scalar
    size: Scalar
    lowest: Scalar
    rest_input: Scalar
    start: str = eqx.field(static=True)

    def resolved(self) -> "PlayLines":
        """Return itself, which is already resolved."""
        return self

    @property
    def widths(self) -> Float[np.ndarray, " cells"]:
        """Widths alpha - beta of the lines, in cells."""
        return np.arange(float(len(self.rows)))

    def rest(self) -> Levels:
        """Return the state before the first input."""
        if self.start == "saturated":
            return jnp.zeros_like(self.rows[0])
        # A relay is up if the mean of alpha and beta lies below the rest input.
        return self.position(self.rest_input) - 0.5 * self.widths

    def position(self, input: ScalarLike) -> Scalar:
        """Return ``input`` (V) in cells from ``low``."""
        return (as_array(input) - self.low) / self.size

    def advance(self, levels: Levels, input: ScalarLike) -> Levels:
        """Return the ``levels`` after a step to ``input``."""
        x = self.position(input)
        # Relays with beta above x are down, those with alpha below it are up. A level
        # at either end moves with the input: the slope at rest is that of the last
        # movement.
        lower = x - self.widths
        raised = jnp.where(levels <= lower, lower, levels)
        return jnp.where(levels >= x, x, raised)

    def init(self, input: ScalarLike = 0.0) -> Levels:
        return self.advance(self.rest(), input)

    def step(self, state: Levels, input: ScalarLike) -> tuple[Levels, Scalar]:
        state = self.advance(state, input)
        (lines,) = outputs(state, self.rows)
        return state, self.lowest + jnp.sum(lines)

    def solve(self, state: Levels, wanted: ScalarLike) -> Scalar:
        """Return the input (V) for which the next output is ``wanted`` (um).

        The output is monotone in the input, so that its values at the edges of the
        cells determine the cell of the input. Within the cell the output of a line is
        constant until the input reaches its level, then it grows linearly, and narrow
        lines are reached first. The sum is therefore convex, the maximum of n linear
        functions, and the least of their n solutions is the solution. For a falling
        input everything is reflected: cells are counted from the top, and outputs
        change their sign.
        """
        (held,) = outputs(state, self.rows)
        rise = as_array(wanted) - self.lowest - jnp.sum(held)
        up = rise >= 0.0
        sign = jnp.where(up, 1.0, -1.0)
        held, target = sign * held, sign * (as_array(wanted) - self.lowest)
        traverse = jax.tree.map(partial(jnp.where, up), self.upwards, self.downwards)

        # Loops, because XLA would recompute ``held`` in a single array operation.
        def edge(last, row):
            _, here = row
            passed = jnp.sum(jnp.maximum(here.reached, held)) <= target
            return jax.tree.map(partial(jnp.where, passed), row, last), None

        cells = len(self.rows)
        rows = (jnp.arange(float(cells)), traverse)
        first = jax.tree.map(lambda column: column[0], rows)
        others = jax.tree.map(lambda column: column[1:], rows)
        (cell, here), _ = jax.lax.scan(edge, first, others)

        def line(before, own):
            missing, steepness, share = before
            put_out, reached, slope = own
            missing, steepness = missing + put_out - reached, steepness + slope
            steep = steepness > 0.0
            solution = jnp.where(steep, missing / jnp.where(steep, steepness, 1.0), 1.0)
            return (missing, steepness, jnp.minimum(share, solution)), None

        none = jnp.zeros_like(target)
        start = (target - jnp.sum(held), none, none + 1.0)
        (_, _, share), _ = jax.lax.scan(line, start, (held, *here))
        x = cell + jnp.maximum(share, 0.0)
        # At rest the voltage stays, and rounding does not reverse it where the output
        # is flat. The correction has no gradient: elsewhere it is zero up to rounding.
        last = jnp.clip(jnp.where(up, state[0], cells - state[0]), 0.0, cells)
        still = jnp.abs(rise) <= ROUNDING
        back = jnp.where(still, last - x, jnp.maximum(last - x, 0.0))
        x = x + jax.lax.stop_gradient(back)
        return self.low + self.size * jnp.where(up, x, cells - x)
