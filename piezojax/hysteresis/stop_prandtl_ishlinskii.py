"""Prandtl-Ishlinskii hysteresis of weighted stop operators, the dual of plays."""

from typing import ClassVar, NamedTuple

import jax.numpy as jnp

from ..core.arrays import Scalar, ScalarLike, Scalars, as_array, as_scalars
from ..core.parameter import parameter
from ..core.recipe import Extent, Fittable, Part, Recipe, rest_starts
from .inverse import Inverse
from .model import Hysteresis, Laws, turning_point_laws
from .plays import (
    Memory,
    advance_stops,
    check_plays,
    plays_recipe,
    polynomial_part,
    weighted_sum,
)
from .prandtl_ishlinskii import PrandtlIshlinskii


class StopState(NamedTuple):
    """Last input (V) and the output of each stop (V)."""

    input: Scalar
    stops: Memory


class StopPrandtlIshlinskii(Hysteresis, Fittable):
    """``y = P(x) - sum_i weights[i] stop_i(x)``: rate-independent, symmetric loops.

    Input x in V, output y in um. A stop of half-width ``thresholds[i]`` follows x until
    it yields. ``polynomial`` and ``rest_input`` as in ``PrandtlIshlinskii``, but P has
    the slope of the axis of the loop, whereas with plays it has the slope right after a
    turning point. Because play and stop add up to x, ``as_plays`` returns the same
    model with plays, whose inverse is used. Source: Brokate and Sprekels, Hysteresis
    and Phase Transitions, 1996, section 2.1.

    Raises ValueError for parameters outside their limits, or a different number of
    thresholds and weights.
    """

    laws: ClassVar[Laws] = turning_point_laws()
    part: ClassVar[Part] = Part(
        "stop_prandtl_ishlinskii",
        "hysteresis",
        "Prandtl-Ishlinskii: ten stop operators and a cubic polynomial",
    )

    polynomial: Scalars = parameter(
        "um/V^(i+1)", "coefficient i of the loop's axis", converter=as_scalars
    )
    thresholds: Scalars = parameter(
        "V", "half-widths of the stops", above=0.0, converter=as_scalars
    )
    weights: Scalars = parameter("um/V", "slopes of the stops", converter=as_scalars)
    rest_input: Scalar = parameter("V", "input of the virgin state", default=0.0)

    def __check_init__(self):
        check_plays(self.thresholds, self.weights)

    def init(self, input: ScalarLike = 0.0) -> StopState:
        input = as_array(input)
        virgin = (jnp.zeros_like(input),) * len(self.thresholds)
        return StopState(
            input, advance_stops(input - self.rest_input, virgin, self.thresholds)
        )

    def step(self, state: StopState, input: ScalarLike) -> tuple[StopState, Scalar]:
        input = as_array(input)
        stops = advance_stops(input - state.input, state.stops, self.thresholds)
        output = polynomial_part(self.polynomial, input) - weighted_sum(
            self.weights, stops
        )
        return StopState(input, stops), output

    def as_plays(self) -> PrandtlIshlinskii:
        """Return the same model as a sum of plays: -w stop = w play - w x."""
        first, *others = self.polynomial or (as_array(0.0),)
        first = first - sum(self.weights, as_array(0.0))
        return PrandtlIshlinskii(
            (first, *others), self.thresholds, self.weights, self.rest_input
        )

    @classmethod
    def recipe(cls, extent: Extent) -> Recipe:
        fields, bounds = plays_recipe(extent)
        # The polynomial is the axis of the loop, steeper than a branch after a turn.
        fields["polynomial"] = (1.3 * extent.slope, 0.0, 0.0)
        return Recipe(
            cls(**fields),
            bounds,
            rest_starts(extent),
            gain="polynomial.0",
            own=("rest_input",),
        )

    def inverse(self, lower: ScalarLike, upper: ScalarLike) -> Inverse:
        return self.as_plays().inverse(lower, upper)
