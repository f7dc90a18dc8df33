"""Preisach hysteresis with a density on a triangle of cells, and its exact inverse."""

from functools import partial
from typing import ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..core.arrays import (
    Matrix,
    Scalar,
    ScalarLike,
    as_array,
    as_matrix,
    check,
    check_order,
)
from ..core.parameter import parameter
from ..core.system import Designed, System
from .inverse import Inverse
from .model import Hysteresis, Laws, remembers

Levels = Float[Array, " cells"]
Rows = tuple[Float[Array, " cells"], ...]

STARTS = ("virgin", "saturated")
"""What the material remembers before its first input."""


ROUNDING = 1e-13
"""Change of the output, um, below which the inverse stays where it is."""


class Preisach(Hysteresis, Designed):
    """A weighted sum of relays, (2.1)-(2.2): the weights of those that are up.

    A relay goes up where the input rises through its alpha and down where it falls
    through its beta. Both run from ``low`` to ``high`` (V) in n equal cells;
    ``weights[i, j]`` (um) belongs to alpha in cell i and beta in cell j, n x n, zero
    where beta is above alpha (j > i), and nowhere negative. ``lowest`` (um) is the
    output with all relays down. Input in V, output in um; beyond ``low`` and ``high``
    the output is flat.

    Within a cell the weight is spread over relays along the cell's diagonal, where
    alpha - beta is that of its corners. So the relays lie on n lines of one width
    alpha - beta = k (high - low)/n, k = 0 ... n-1, and those of one line are up exactly
    as far as a play operator of that width stands: n scalars are the whole memory, with
    neither turning points to store nor relays to step (Brokate and Sprekels, Hysteresis
    and Phase Transitions, 1996, section 2.2). The laws of Preisach's model hold to
    rounding; where turning points fall on edges of cells the output is that of relays
    spread in any other way within their cells; and it is continuous and piecewise
    linear in the input, with its slope everywhere finite. Weights on the diagonal
    (k = 0) have no width: they are what follows the input back without hysteresis.

    ``start``: ``"virgin"``, demagnetised about ``rest_input`` (V), or ``"saturated"``,
    after an input at or below ``low``.

    Raises ValueError for parameters outside their limits, weights that are not square
    or lie above the diagonal, ``low >= high`` or an unknown start.
    """

    before: ClassVar[str | None] = "rest_input"
    laws: ClassVar[Laws] = remembers()

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

    def inverse(self, lower: ScalarLike, upper: ScalarLike) -> Inverse:
        del lower, upper  # the inverse holds over the triangle, and saturates beyond it
        return InversePreisach(self)


def check_weights(name: str, weights: Matrix) -> None:
    """Raise ValueError unless ``weights`` are those of a Preisach model."""
    rows, columns = weights.shape
    if rows != columns or not rows:
        raise ValueError(f"{name} are {rows} x {columns}; they must be n x n, n >= 1")
    above = weights[np.triu_indices(rows, 1)]
    check(f"{name} where beta is above alpha", above, least=0.0, most=0.0)


def rows_of(weights: Matrix) -> Rows:
    """Return, for each cell of beta, the weights of all lines there.

    Line k, of the cells with alpha k above beta, is element k; 0 where it has ended.
    """
    cells = weights.shape[0]
    column = np.arange(cells)
    alpha = column + column[:, None]
    lines = jnp.where(alpha < cells, weights[alpha % cells, column[:, None]], 0.0)
    return tuple(lines)


class Way(NamedTuple):
    """Lines on their way from one end of the input: a row a cell, a column a line.

    ``reached`` (um) is what a line has put out before the cell, ``slopes`` (um) what it
    adds there.
    """

    reached: Matrix
    slopes: Matrix


def _upwards(rows: Rows) -> Way:
    """Return the lines on the way up, on which their alphas are passed."""
    alpha, line = np.arange(len(rows))[:, None], np.arange(len(rows))
    slopes = jnp.where(line <= alpha, jnp.stack(rows)[alpha - line, line], 0.0)
    return Way(jnp.cumsum(slopes, axis=0) - slopes, slopes)


def _downwards(rows: Rows) -> Way:
    """Return the lines on the way down, from the top and with the sign turned round."""
    slopes = jnp.stack(rows)[::-1]
    reached = jnp.cumsum(slopes, axis=0) - slopes - jnp.sum(slopes, axis=0)
    return Way(reached, slopes)


@partial(jax.checkpoint, prevent_cse=False)
def outputs(levels: Levels, *densities: Rows) -> tuple[Levels, ...]:
    """Return, for each density, what each line of its relays puts out, um.

    In reverse mode it is worked out again: that is four times faster than storing it.
    """
    totals = [jnp.zeros_like(levels) for _ in densities]
    for beta, weights in enumerate(zip(*densities, strict=True)):
        along = levels - beta
        # Not jnp.clip: at an edge this has the slope of the cell above it.
        up = jnp.where(along < 0.0, 0.0, jnp.where(along < 1.0, along, 1.0))
        totals = [t + own * up for t, own in zip(totals, weights, strict=True)]
    return tuple(totals)


class PlayLines(System):
    """What a Preisach model steps with: a play operator for each width.

    ``rows`` as ``rows_of`` gives them; ``size`` (V) of a cell. The state holds, for
    each line, the beta up to which its relays are up, counted in cells from ``low``;
    that of line 0 is the input.
    """

    rows: Rows
    upwards: Way
    downwards: Way
    low: Scalar
    size: Scalar
    lowest: Scalar
    rest_input: Scalar
    start: str = eqx.field(static=True)

    def resolved(self) -> "PlayLines":
        """Return itself: there is nothing more to work out."""
        return self

    @property
    def widths(self) -> Float[np.ndarray, " cells"]:
        """alpha - beta of the lines, in cells."""
        return np.arange(float(len(self.rows)))

    def rest(self) -> Levels:
        """Return the state before the first input."""
        if self.start == "saturated":
            return jnp.zeros_like(self.rows[0])
        # Up where the middle between beta and alpha lies below the rest input.
        return self.position(self.rest_input) - 0.5 * self.widths

    def position(self, input: ScalarLike) -> Scalar:
        """Return ``input`` (V) in cells from ``low``."""
        return (as_array(input) - self.low) / self.size

    def played(self, levels: Levels, input: ScalarLike) -> Levels:
        """Return ``levels`` after ``input``."""
        x = self.position(input)
        # Relays with beta above x are down, those with alpha below it are up. A level
        # at either end goes with the input: the slope at rest is that of the way there.
        lower = x - self.widths
        raised = jnp.where(levels <= lower, lower, levels)
        return jnp.where(levels >= x, x, raised)

    def init(self, input: ScalarLike = 0.0) -> Levels:
        return self.played(self.rest(), input)

    def step(self, state: Levels, input: ScalarLike) -> tuple[Levels, Scalar]:
        state = self.played(state, input)
        (lines,) = outputs(state, self.rows)
        return state, self.lowest + jnp.sum(lines)

    def solve(self, state: Levels, wanted: ScalarLike) -> Scalar:
        """Return the input (V) for which the next output is ``wanted`` (um).

        The output is monotone in the input, so its values at the edges of the cells
        tell the cell in which the input lies. There the output of a line stays where it
        is until the input reaches it, then grows on a straight line, and narrow lines
        are reached first: the sum is convex, the largest of n straight lines, and the
        smallest of their n solutions is the solution. Downwards everything is
        reflected: what remains of a line is counted from the top.
        """
        (held,) = outputs(state, self.rows)
        rise = as_array(wanted) - self.lowest - jnp.sum(held)
        up = rise >= 0.0
        sign = jnp.where(up, 1.0, -1.0)
        held, target = sign * held, sign * (as_array(wanted) - self.lowest)
        way = jax.tree.map(partial(jnp.where, up), self.upwards, self.downwards)

        # Loops, not one array operation: XLA would work out ``held`` over and over.
        def edge(found, row):
            _, here = row
            passed = jnp.sum(jnp.maximum(here.reached, held)) <= target
            return jax.tree.map(partial(jnp.where, passed), row, found), None

        cells = len(self.rows)
        rows = (jnp.arange(float(cells)), way)
        first = jax.tree.map(lambda column: column[0], rows)
        others = jax.tree.map(lambda column: column[1:], rows)
        (cell, here), _ = jax.lax.scan(edge, first, others)

        def line(before, own):
            missing, steepness, share = before
            put_out, reached, slope = own
            missing, steepness = missing + put_out - reached, steepness + slope
            steep = steepness > 0.0
            found = jnp.where(steep, missing / jnp.where(steep, steepness, 1.0), 1.0)
            return (missing, steepness, jnp.minimum(share, found)), None

        none = jnp.zeros_like(target)
        start = (target - jnp.sum(held), none, none + 1.0)
        (_, _, share), _ = jax.lax.scan(line, start, (held, *here))
        x = cell + jnp.maximum(share, 0.0)
        # At rest it stays, and rounding does not turn it round where the output is
        # flat. What this adds has no gradient: elsewhere it is zero up to rounding.
        last = jnp.clip(jnp.where(up, state[0], cells - state[0]), 0.0, cells)
        still = jnp.abs(rise) <= ROUNDING
        back = jnp.where(still, last - x, jnp.maximum(last - x, 0.0))
        x = x + jax.lax.stop_gradient(back)
        return self.low + self.size * jnp.where(up, x, cells - x)


class InversePreisach(Inverse):
    """Voltage that moves a Preisach model to a wanted output, in closed form.

    Input in um, output in V, exact to rounding with the exact gradient. The state is
    that of the model itself. An output that no input between ``low`` and ``high``
    reaches gives the nearer of the two. The voltage is continuous in what is wanted
    where the weights on the model's diagonal are positive; without them the output is
    flat after each turn and the voltage jumps across.
    """

    model: Preisach

    def init(self, input: ScalarLike = 0.0) -> Levels:
        law = self.model.resolved()
        return law.init(law.solve(law.rest(), input))

    def solve(self, state: Levels, wanted: ScalarLike) -> Scalar:
        return self.model.resolved().solve(state, wanted)
