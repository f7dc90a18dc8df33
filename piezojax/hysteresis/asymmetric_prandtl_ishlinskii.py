"""Prandtl-Ishlinskii hysteresis with loops that are wider on one side."""

from typing import ClassVar

import jax.numpy as jnp

from ..core.arrays import Scalar, ScalarLike, Scalars, as_array, as_scalars
from ..core.parameter import parameter
from ..core.recipe import Extent, Fittable, Part, Recipe, rest_starts, scaled_range
from .inverse import Inverse, InverseHysteresis
from .model import Hysteresis, Laws, turning_point_laws
from .plays import (
    Memory,
    advance_plays,
    check_plays,
    plays_recipe,
    plays_within,
    polynomial_part,
    typical_distances,
    weighted_sum,
)


class AsymmetricPrandtlIshlinskii(Hysteresis, Fittable):
    """Prandtl-Ishlinskii model with loops that are wider on one side.

    ``y = P(x) + sum_i weights[i] play_i(x) + sum_i skew[i] play_i(q(x))``, where q is
    the one-sided square (x - origin)^2 / (2 scale) for x above ``origin`` and 0 below.
    The width in x of a play of q shrinks as x grows. The envelope functions of a
    generalised play skew a loop in the same way (Al Janaideh, Rakheja and Su 2009,
    Mechatronics 19(5)); the output is linear in ``skew``, but not in the parameters of
    those functions. Units, memory, remaining parameters and errors are those of
    PrandtlIshlinskii.
    """

    laws: ClassVar[Laws] = turning_point_laws()
    part: ClassVar[Part] = Part(
        "asymmetric_prandtl_ishlinskii",
        "hysteresis",
        "Prandtl-Ishlinskii with as many more plays that skew the loop",
    )

    polynomial: Scalars = parameter(
        "um/V^(i+1)", "coefficient i of the memoryless part", converter=as_scalars
    )
    thresholds: Scalars = parameter(
        "V", "half-widths of the plays", above=0.0, converter=as_scalars
    )
    weights: Scalars = parameter("um/V", "slopes of the plays", converter=as_scalars)
    skew: Scalars = parameter("um/V", "slopes of the plays of q", converter=as_scalars)
    origin: Scalar = parameter("V", "input at which the loop is widest")
    scale: Scalar = parameter(
        "V", "rise above origin at which q has slope 1", above=0.0
    )
    rest_input: Scalar = parameter("V", "input of the virgin state", default=0.0)

    def __check_init__(self):
        check_plays(self.thresholds, self.weights)
        check_plays(self.thresholds, self.skew, "skew weights")

    def _square(self, x: Scalar) -> Scalar:
        return 0.5 * jnp.maximum(x - self.origin, 0.0) ** 2 / self.scale

    def init(self, input: ScalarLike = 0.0) -> tuple[Memory, Memory]:
        input, virgin = as_array(input), self.rest_input
        count = len(self.thresholds)
        return (
            advance_plays(input, (virgin,) * count, self.thresholds),
            advance_plays(
                self._square(input), (self._square(virgin),) * count, self.thresholds
            ),
        )

    def step(
        self, state: tuple[Memory, Memory], input: ScalarLike
    ) -> tuple[tuple[Memory, Memory], Scalar]:
        input = as_array(input)
        plain = advance_plays(input, state[0], self.thresholds)
        skewed = advance_plays(self._square(input), state[1], self.thresholds)
        output = polynomial_part(self.polynomial, input)
        output = (
            output + weighted_sum(self.weights, plain) + weighted_sum(self.skew, skewed)
        )
        return (plain, skewed), output

    @classmethod
    def recipe(cls, extent: Extent) -> Recipe:
        fields, bounds = plays_recipe(extent)
        skews = {
            f"skew.{i}": scaled_range(extent.slope, -2.0, 2.0)
            for i in range(plays_within(extent))
        }
        # Plays that are wider than the cycles have no skew.
        none = (0.0,) * len(fields["thresholds"])
        # q has the range of x, so that each of its plays moves in a full cycle.
        half = 0.5 * extent.width
        return Recipe(
            cls(**fields, skew=none, origin=extent.low, scale=half),
            {**bounds, **skews},
            rest_starts(extent),
            gain="polynomial.0",
            own=("rest_input",),
            vague=typical_distances(extent, (*bounds, *skews)),
        )

    def inverse(self, lower: ScalarLike, upper: ScalarLike) -> Inverse:
        return InverseHysteresis(self, lower, upper)
