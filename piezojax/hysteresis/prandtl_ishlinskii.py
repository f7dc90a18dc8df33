"""Prandtl-Ishlinskii hysteresis of weighted play operators, and its exact inverse."""

from typing import ClassVar

from ..core.arrays import Scalar, ScalarLike, Scalars, as_array, as_scalars, check_order
from ..core.parameter import parameter
from ..core.recipe import Extent, Fittable, Part, Recipe, rest_starts
from .inverse import Inverse, check_rising
from .model import Hysteresis, Laws, turning_point_laws
from .plays import (
    FAR,
    Memory,
    advance_plays,
    check_invertible,
    check_plays,
    invert_plays,
    plays_recipe,
    polynomial_part,
    typical_distances,
    weighted_sum,
)


class PrandtlIshlinskii(Hysteresis, Fittable):
    """``y = P(x) + sum_i weights[i] play_i(x)``: rate-independent, symmetric loops.

    Input x in V, output y in um. Each play operator is a backlash of half-width
    ``thresholds[i]``. The memoryless part is P(x) = polynomial[0] x + polynomial[1] x^2
    + ...: with terms above the first this is the model of Gu, Zhu and Su (2014, IEEE
    Trans. Ind. Electron. 61(3)). The material starts without memory at ``rest_input``.
    With weights >= 0 loops run counter-clockwise, as for a piezo.

    Raises ValueError for parameters outside their limits, or a different number of
    thresholds and weights.
    """

    laws: ClassVar[Laws] = turning_point_laws()
    part: ClassVar[Part] = Part(
        "prandtl_ishlinskii",
        "hysteresis",
        "Prandtl-Ishlinskii: ten play operators and a cubic polynomial",
    )

    polynomial: Scalars = parameter(
        "um/V^(i+1)", "coefficient i of the memoryless part", converter=as_scalars
    )
    thresholds: Scalars = parameter(
        "V", "half-widths of the plays", above=0.0, converter=as_scalars
    )
    weights: Scalars = parameter("um/V", "slopes of the plays", converter=as_scalars)
    rest_input: Scalar = parameter("V", "input of the virgin state", default=0.0)

    def __check_init__(self):
        check_plays(self.thresholds, self.weights)

    def init(self, input: ScalarLike = 0.0) -> Memory:
        virgin = (self.rest_input,) * len(self.thresholds)
        return advance_plays(as_array(input), virgin, self.thresholds)

    def step(self, state: Memory, input: ScalarLike) -> tuple[Memory, Scalar]:
        input = as_array(input)
        state = advance_plays(input, state, self.thresholds)
        return state, polynomial_part(self.polynomial, input) + weighted_sum(
            self.weights, state
        )

    @classmethod
    def recipe(cls, extent: Extent) -> Recipe:
        fields, bounds = plays_recipe(extent)
        return Recipe(
            cls(**fields),
            bounds,
            rest_starts(extent),
            gain="polynomial.0",
            own=("rest_input",),
            vague=typical_distances(extent, bounds),
        )

    def inverse(self, lower: ScalarLike, upper: ScalarLike) -> Inverse:
        if len(self.polynomial) == 1:
            return InversePrandtlIshlinskii(self)
        check_rising(self, lower, upper)
        return InversePrandtlIshlinskii(self, lower, upper)


class InversePrandtlIshlinskii(Inverse):
    """Voltage that moves a Prandtl-Ishlinskii model to a wanted output.

    Input f(k) in um, output u(k) in V. For a given memory the next output of the model
    rises with its input and has a corner where each play begins to move; the plays move
    in the order of their thresholds. The outputs at the corners determine which plays
    move for f. The remaining equation is linear and solved in closed form; with terms
    above the first in P it is a polynomial that rises on a known interval, solved by a
    bracketed Newton method to 1e-9 um. For a linear P this is the inverse of Krejci and
    Kuhnen (2001, IEE Proc. Control Theory Appl. 148(3)), which ``operator`` returns as
    a Prandtl-Ishlinskii operator. The state is that of the model, so that a controller
    can advance it with the voltage applied after clipping.

    With terms above the first in P the output must rise from ``lower`` to ``upper``
    (V), by default for any input; otherwise the voltage is finite but wrong. For an
    output that the model does not reach between them, the voltage lies beyond them,
    where P continues along its tangent.

    Raises ValueError for thresholds that do not ascend, an empty polynomial, ``lower >=
    upper``, or, with a linear P, weights for which the output does not rise with the
    input.
    """

    model: PrandtlIshlinskii
    lower: Scalar = parameter("V", "lowest voltage at which P is used", default=-FAR)
    upper: Scalar = parameter("V", "highest voltage at which P is used", default=FAR)

    def __check_init__(self):
        check_order("lower", self.lower, "upper", self.upper)
        check_invertible(
            self.model.polynomial, self.model.thresholds, self.model.weights
        )

    def init(self, input: ScalarLike = 0.0) -> Memory:
        virgin = (self.model.rest_input,) * len(self.model.thresholds)
        return self.model.init(self.solve(virgin, input))

    def solve(self, state: Memory, wanted: ScalarLike) -> Scalar:
        """Return the voltage (V) for which the model's next output is ``wanted``."""
        model = self.model
        return invert_plays(
            model.polynomial,
            model.thresholds,
            model.weights,
            state,
            as_array(wanted),
            self.lower,
            self.upper,
        )

    def operator(self) -> PrandtlIshlinskii:
        """Return the inverse as a Prandtl-Ishlinskii operator from um to V.

        Its plays start from the virgin state and follow the wanted output, even where
        the applied voltage is clipped. Raises ValueError for a polynomial with terms
        above the first.
        """
        model = self.model
        first, *others = model.polynomial
        if others:
            raise ValueError(
                f"the polynomial has {len(model.polynomial)} terms; only with a linear "
                "one is the inverse a Prandtl-Ishlinskii operator"
            )
        slope, reach = first, as_array(0.0)
        thresholds, weights = [], []
        for r, w in zip(model.thresholds, model.weights, strict=True):
            thresholds.append(slope * r - reach)
            weights.append(-w / (slope * (slope + w)))
            slope, reach = slope + w, reach + w * r
        return PrandtlIshlinskii(
            (1.0 / first,), thresholds, weights, slope * model.rest_input
        )
