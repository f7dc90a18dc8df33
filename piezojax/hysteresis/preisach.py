"""Preisach hysteresis with a density on a triangle of cells, and its exact inverse."""

from collections.abc import Sequence
from functools import partial
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array, Float

from ..core.arrays import (
    Matrix,
    Scalar,
    ScalarLike,
    as_array,
    as_matrix,
    check,
    check_order,
    concrete,
)
from ..core.parameter import parameter
from ..core.recipe import (
    Extent,
    Fittable,
    LinearWeights,
    Part,
    Recipe,
    rest_bounds,
    rest_starts,
)
from ..core.system import Designed, System
from .inverse import Inverse
from .model import Hysteresis, Laws, turning_point_laws

Levels = Float[Array, " cells"]
Rows = tuple[Float[Array, " cells"], ...]

STARTS = ("virgin", "saturated")
"""Initial states of the material."""


CELLS, SHARE = 36, 0.3
"""Cells per side of a fit, and the share of the output that they add to the diagonal
in the first guess."""

LEAST_SLOPE = 0.01
"""Least slope after a turn, as a share of the mean slope of a record: the inverse is
continuous."""

ROUNDING = 1e-13
"""Change of the output, um, below which the inverse does not change its voltage."""


class Preisach(Hysteresis, Fittable, Designed):
    """Weighted sum of relays, (2.1)-(2.2), which are up (1) or down (0).

    A relay goes up when the input rises through its alpha and down when it falls
    through its beta. Both range from ``low`` to ``high`` (V) in n equal cells.
    ``weights`` [n, n] (um) are not negative: element [i, j] belongs to alpha in cell i
    and beta in cell j and is zero where beta is above alpha (j > i). ``lowest`` (um) is
    the output with all relays down. Input in V, output in um; beyond ``low`` and
    ``high`` the output is flat.

    Within a cell the weight is distributed over relays on the diagonal of the cell
    along which alpha - beta is constant. The relays therefore lie on n lines of
    constant width alpha - beta = k (high - low)/n, k = 0 ... n-1. On each line the
    relays are up exactly as far as the position of a play operator of that width. The
    memory thus consists of n scalars, without turning points or relays (Brokate and
    Sprekels, Hysteresis and Phase Transitions, 1996, section 2.2). The laws of the
    Preisach model hold to rounding. If turning points fall on edges of cells, the
    output equals that of any other distribution of the relays within their cells. The
    output is continuous and piecewise linear in the input, with finite slope. Weights
    on the diagonal (k = 0) have no width: they follow the input without hysteresis.

    ``start`` is ``"virgin"``, demagnetised about ``rest_input`` (V), or
    ``"saturated"``, after an input at or below ``low``.

    Raises ValueError for parameters outside their limits, weights that are not square
    or lie above the diagonal, ``low >= high`` or an unknown start.
    """

    laws: ClassVar[Laws] = turning_point_laws()
    part: ClassVar[Part] = Part(
        "preisach", "hysteresis", "Preisach: a smooth density on a triangle of 36 cells"
    )
    rising: ClassVar[bool] = True

    weights: Matrix = parameter("um", "weights", least=0.0, converter=as_matrix)
    low: Scalar = parameter("V", "lowest input")
    high: Scalar = parameter("V", "highest input")
    lowest: Scalar = parameter("um", "output with all relays down", default=0.0)
    rest_input: Scalar = parameter("V", "input of the virgin state", default=0.0)
    start: str = eqx.field(static=True, default="virgin")

    def __check_init__(self):
        check_order("low", self.low, "high", self.high)
        check_weights("weights", self.weights)
        if self.start not in STARTS:
            raise ValueError(f"start {self.start!r}; it must be one of {list(STARTS)}")

    @property
    def cells(self) -> int:
        """Cells along one side of the triangle."""
        return self.weights.shape[0]

    def responses(
        self,
        inputs: Float[Array, " samples"],
        places: Sequence[Array | np.ndarray],
    ) -> Float[Array, "k samples"]:
        """Return the outputs under ``inputs`` (V) of 1 um in each of k cells.

        ``places`` are the indices of alpha and of beta. The model rests under the first
        input. Its own weights do not matter.
        """
        law = self.resolved()

        def advanced(levels: Levels, input: Scalar) -> tuple[Levels, Levels]:
            levels = law.advance(levels, input)
            return levels, levels

        _, levels = jax.lax.scan(advanced, law.init(inputs[0]), inputs)
        alpha, beta = places
        return jnp.clip(levels.T[alpha - beta] - beta[:, None], 0.0, 1.0)

    def resolved(self) -> "PlayLines":
        rows = rows_of(self.weights)
        return PlayLines(
            rows,
            _upwards(rows),
            _downwards(rows),
            self.low,
            (self.high - self.low) / self.cells,
            self.lowest,
            self.rest_input,
            self.start,
        )

    @classmethod
    def recipe(cls, extent: Extent) -> Recipe:
        beyond = 0.5 * (extent.before - 1.0) * extent.width
        low, high = extent.low - beyond, extent.high + beyond
        places = tuple(np.transpose(line_by_line(CELLS)))
        rise = extent.slope * (high - low)
        diagonal = places[0] == places[1]
        weights = np.zeros((CELLS, CELLS))
        weights[places] = np.where(
            diagonal,
            (1.0 - SHARE) * rise / CELLS,
            SHARE * rise / np.count_nonzero(~diagonal),
        )
        differences = neighbours(line_by_line(CELLS))
        return Recipe(
            cls(weights, low, high, extent.slope * low, extent.first[0]),
            rest_bounds(extent),
            rest_starts(extent),
            own=("rest_input",),
            linear=LinearWeights(
                "weights",
                places,
                np.where(diagonal, LEAST_SLOPE * rise / CELLS, 0.0),
                differences / (0.5 * np.abs(differences) @ weights[places])[:, None],
                cls.responses,
            ),
        )

    def inverse(self, lower: ScalarLike, upper: ScalarLike) -> Inverse:
        del lower, upper  # the inverse holds over the triangle, and saturates beyond it
        return InversePreisach(self)


def check_weights(name: str, weights: Matrix) -> None:
    """Raise ValueError unless ``weights`` are those of a Preisach model."""
    rows, columns = weights.shape
    if rows != columns or not rows:
        raise ValueError(f"{name} are {rows} x {columns}; they must be n x n, n >= 1")
    numbers = concrete(weights)
    if numbers is not None:
        above = np.triu(numbers, 1)
        check(f"{name} where beta is above alpha", above, least=0.0, most=0.0)


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


def neighbours(places: list[tuple[int, int]]) -> np.ndarray:
    """Return the matrix of differences between neighbours off the diagonal.

    The diagonal, which has no hysteresis, is smoothed only along itself.
    """
    index = {place: at for at, place in enumerate(places)}
    rows = []
    for (i, j), at in index.items():
        for other in ((i + 1, j), (i, j + 1), (i + 1, j + 1)):
            within = (i == j) == (other[0] == other[1])
            if other in index and within:
                row = np.zeros(len(places))
                row[[at, index[other]]] = -1.0, 1.0
                rows.append(row)
    return np.array(rows).reshape(-1, len(places))


class Traverse(NamedTuple):
    """Outputs of the lines while the input traverses all cells in one direction.

    Rows are cells, columns are lines. ``reached`` (um) is the output of a line before
    the cell, ``slopes`` (um) the change of its output in the cell.
    """

    reached: Matrix
    slopes: Matrix


@jax.jit
def _upwards(rows: Rows) -> Traverse:
    """Return the Traverse of a rising input, which passes the alphas of the lines."""
    alpha, line = np.arange(len(rows))[:, None], np.arange(len(rows))
    slopes = jnp.where(line <= alpha, jnp.stack(rows)[alpha - line, line], 0.0)
    return Traverse(jnp.cumsum(slopes, axis=0) - slopes, slopes)


@jax.jit
def _downwards(rows: Rows) -> Traverse:
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


class InversePreisach(Inverse):
    """Voltage that moves a Preisach model to a wanted output, in closed form.

    Input in um, output in V, exact to rounding, with the exact gradient. The state is
    that of the model. If no input between ``low`` and ``high`` reaches the wanted
    output, the nearer limit is returned. The voltage is continuous in the wanted output
    if the weights on the diagonal of the model are positive; without them the output is
    flat after each turn, and the voltage jumps over the flat part.
    """

    model: Preisach

    def init(self, input: ScalarLike = 0.0) -> Levels:
        law = self.model.resolved()
        return law.init(law.solve(law.rest(), input))

    def solve(self, state: Levels, wanted: ScalarLike) -> Scalar:
        return self.model.resolved().solve(state, wanted)
