"""Preisach hysteresis with a density on a triangle of cells, and its exact inverse."""

from collections.abc import Sequence
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..core.arrays import (
    Matrix,
    Scalar,
    ScalarLike,
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
from ..core.system import Designed
from .inverse import Inverse
from .model import Hysteresis, Laws, turning_point_laws
from .play_lines import Levels, PlayLines, downwards, line_by_line, rows_of, upwards

STARTS = ("virgin", "saturated")
"""Initial states of the material."""

CELLS, SHARE = 36, 0.3
"""Cells per side of a fit, and the share of the output that they add to the diagonal
in the first guess."""

LEAST_SLOPE = 0.01
"""Least slope after a turn, as a share of the mean slope of a record: the inverse is
continuous."""


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

    def resolved(self) -> PlayLines:
        rows = rows_of(self.weights)
        return PlayLines(
            rows,
            upwards(rows),
            downwards(rows),
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
