"""Prandtl-Ishlinskii hysteresis that widens with the rate, and its inverse."""

from typing import ClassVar, NamedTuple

import jax.numpy as jnp

from ..core.arrays import Scalar, ScalarLike, Scalars, as_array, as_scalars, check_order
from ..core.parameter import parameter, sample_time
from ..core.recipe import Extent, Fittable, Part, Recipe, rest_starts
from ..core.space import Range
from .inverse import Inverse, check_rising
from .model import STEP, Hysteresis, Laws
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
from .prandtl_ishlinskii import PrandtlIshlinskii


class RateState(NamedTuple):
    """Plays (V), last input (V) and its rate over the last sample (V/s)."""

    plays: Memory
    input: Scalar
    rate: Scalar


class RateDependentPrandtlIshlinskii(Hysteresis, Fittable):
    """Prandtl-Ishlinskii model whose thresholds grow with the rate of the input.

    ``y = P(x) + sum_i weights[i] play_i(x)`` with plays of the half-width
    ``thresholds[i] + growth |dx/dt|`` (V). All else is as in ``PrandtlIshlinskii``.
    Source: Al Janaideh and Krejci, Inverse rate-dependent Prandtl-Ishlinskii model for
    feedforward compensation of hysteresis in a piezomicropositioning actuator, 2013
    (IEEE/ASME Trans. Mechatronics 18(5)), with one growth for all plays, so that they
    keep their order and distance at every rate. The rate is that between the two
    previous samples. The rate of the present step would depend on the input that the
    inverse seeks, and a play could widen faster than a fast step moves it.

    Raises ValueError in the same cases as ``PrandtlIshlinskii``.
    """

    laws: ClassVar[Laws] = {"counter-clockwise": STEP}
    part: ClassVar[Part] = Part(
        "rate_dependent_prandtl_ishlinskii",
        "hysteresis",
        "Prandtl-Ishlinskii with plays that widen with the rate of the input",
    )

    polynomial: Scalars = parameter(
        "um/V^(i+1)", "coefficient i of the memoryless part", converter=as_scalars
    )
    thresholds: Scalars = parameter(
        "V", "half-widths of the plays", above=0.0, converter=as_scalars
    )
    weights: Scalars = parameter("um/V", "slopes of the plays", converter=as_scalars)
    growth: Scalar = parameter("s", "growth of half-widths with the rate", least=0.0)
    dt: float = sample_time()
    rest_input: Scalar = parameter("V", "input of the virgin state", default=0.0)

    def __check_init__(self):
        check_plays(self.thresholds, self.weights)

    def init(self, input: ScalarLike = 0.0) -> RateState:
        input = as_array(input)
        virgin = (self.rest_input,) * len(self.thresholds)
        plays = advance_plays(input, virgin, self.thresholds)
        return RateState(plays, input, jnp.zeros_like(input))

    def step(self, state: RateState, input: ScalarLike) -> tuple[RateState, Scalar]:
        input = as_array(input)
        plays = advance_plays(input, state.plays, self.widths(state))
        output = polynomial_part(self.polynomial, input) + weighted_sum(
            self.weights, plays
        )
        rate = (input - state.input) / self.dt
        return RateState(plays, input, rate), output

    def widths(self, state: RateState) -> Memory:
        """Return the half-widths (V) of the plays in the next step."""
        wider = self.growth * jnp.abs(state.rate)
        return tuple(r + wider for r in self.thresholds)

    @classmethod
    def recipe(cls, extent: Extent) -> Recipe:
        fields, bounds = plays_recipe(extent)
        # A sine over the whole range needs several periods in the record. If the growth
        # is a sixth of the period, the fastest motion widens the plays by about the
        # amplitude of the sine.
        most = 0.05 * extent.duration
        return Recipe(
            cls(**fields, growth=0.01 * most, dt=extent.dt),
            {**bounds, "growth": Range(0.0, most)},
            rest_starts(extent),
            gain="polynomial.0",
            own=("rest_input",),
            vague=typical_distances(extent, bounds),
        )

    def inverse(self, lower: ScalarLike, upper: ScalarLike) -> Inverse:
        if len(self.polynomial) == 1:
            return InverseRateDependentPrandtlIshlinskii(self)
        # The slopes are those at rest; the rate only moves the corners between them.
        at_rest = PrandtlIshlinskii(
            self.polynomial, self.thresholds, self.weights, self.rest_input
        )
        check_rising(at_rest, lower, upper)
        return InverseRateDependentPrandtlIshlinskii(self, lower, upper)


class InverseRateDependentPrandtlIshlinskii(Inverse):
    """Voltage that moves a rate-dependent model to a wanted output.

    Input f(k) in um, output u(k) in V. The thresholds of the next step are known, so
    the step is inverted as in ``InversePrandtlIshlinskii``, exactly at every rate. The
    state is that of the model; ``lower``, ``upper`` and the errors are those of that
    class.
    """

    model: RateDependentPrandtlIshlinskii
    lower: Scalar = parameter("V", "lowest voltage at which P is used", default=-FAR)
    upper: Scalar = parameter("V", "highest voltage at which P is used", default=FAR)

    def __check_init__(self):
        check_order("lower", self.lower, "upper", self.upper)
        check_invertible(
            self.model.polynomial, self.model.thresholds, self.model.weights
        )

    def init(self, input: ScalarLike = 0.0) -> RateState:
        virgin = self.model.init(self.model.rest_input)
        return self.model.init(self.solve(virgin, input))

    def solve(self, state: RateState, wanted: ScalarLike) -> Scalar:
        """Return the voltage (V) for which the model's next output is ``wanted``."""
        model = self.model
        return invert_plays(
            model.polynomial,
            model.widths(state),
            model.weights,
            state.plays,
            as_array(wanted),
            self.lower,
            self.upper,
        )
