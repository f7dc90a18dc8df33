"""Dahl frictions: loops whose memory fades along the path of the input."""

from typing import ClassVar, NamedTuple

import jax.numpy as jnp

from ..core.arrays import Scalar, ScalarLike, Scalars, as_array, as_scalars
from ..core.parameter import parameter
from ..core.recipe import (
    Extent,
    Fittable,
    Part,
    Recipe,
    rest_bounds,
    rest_starts,
    scaled_range,
)
from ..core.space import Range
from .inverse import Inverse, InverseHysteresis
from .model import Hysteresis, Laws, differential_laws
from .plays import polynomial_part

SERIES = 1e-3
"""Size of (n - 1) times the path below which log1p is replaced by its series: at n = 1
the closed form is 0/0."""

SPENT = 1e-12
"""Least remaining share of a force: with an exponent below 1 its end is reached."""

RATES, SHARES = (2.0, 5.0, 12.0), (0.03, 0.02, 0.005)
"""Starting values of a fit: rates times the range of the input, heights divided by it.
The output rises on every branch, so that these values have an inverse."""


class Forces(NamedTuple):
    """Last input (V), and the force of each friction as a share of its largest."""

    input: Scalar
    forces: tuple[Scalar, ...]


class DahlFrictions(Hysteresis, Fittable):
    """``y = P(x - sum_i heights[i] f_i)``: the input less several Dahl frictions.

    ``df_i/dx = rates[i] |1 - f_i sign(x')|^exponents[i]`` (Dahl 1976, AIAA Journal
    14(12), with f the friction as a share of its largest value; Xu and Li 2010, IEEE
    Trans. Industrial Electronics 57(9), for piezo stages). x is the input in V, f
    between -1 and 1, and the polynomial P, without a constant, turns volts into the
    output in um. Frictions of different rates and exponents add up to loops of any
    bend. With an exponent of 1 a friction is the Bouc-Wen model with n = sigma = 1.
    Below 1 it reaches its largest value after a finite path, above 1 it approaches it
    the more slowly, the larger the exponent.

    Each step is exact for an input that moves in one direction between samples. The
    material starts on its virgin curve from ``rest_input`` (V), where all f are 0. The
    memory fades along the path of the input: there is no return-point memory.

    The inverse is InverseHysteresis. It exists if P rises and, as the input has just
    turned where all f are 1 or -1, the sum of ``heights[i] rates[i] 2^exponents[i]`` is
    below 1.

    Raises ValueError for parameters outside their limits or different numbers of
    heights, rates and exponents.
    """

    laws: ClassVar[Laws] = differential_laws()
    part: ClassVar[Part] = Part(
        "dahl_frictions",
        "hysteresis",
        "Dahl: the input less three frictions of any bend",
    )

    polynomial: Scalars = parameter(
        "um/V^(i+1)", "coefficient i of the output", converter=as_scalars
    )
    heights: Scalars = parameter(
        "V", "largest value of each friction", converter=as_scalars
    )
    rates: Scalars = parameter(
        "1/V", "slope of each friction at 0", above=0.0, converter=as_scalars
    )
    exponents: Scalars = parameter(
        "1", "bend of each friction", least=0.5, most=5.0, converter=as_scalars
    )
    rest_input: Scalar = parameter("V", "input of the virgin state", default=0.0)

    def __check_init__(self):
        counts = len(self.heights), len(self.rates), len(self.exponents)
        if len(set(counts)) > 1:
            raise ValueError(
                f"{counts[0]} heights, {counts[1]} rates and {counts[2]} exponents; "
                "each friction needs one of each"
            )

    def init(self, input: ScalarLike = 0.0) -> Forces:
        virgin = (jnp.zeros(()),) * len(self.heights)
        return self._moved(Forces(self.rest_input, virgin), as_array(input))

    def step(self, state: Forces, input: ScalarLike) -> tuple[Forces, Scalar]:
        state = self._moved(state, as_array(input))
        left = state.input
        for height, force in zip(self.heights, state.forces, strict=True):
            left = left - height * force
        return state, polynomial_part(self.polynomial, left)

    def _moved(self, state: Forces, input: Scalar) -> Forces:
        change = input - state.input
        way = jnp.where(change >= 0.0, 1.0, -1.0)
        forces = tuple(
            way * (1.0 - _remaining(1.0 - way * force, rate * way * change, exponent))
            for force, rate, exponent in zip(
                state.forces, self.rates, self.exponents, strict=True
            )
        )
        return Forces(input, forces)

    @classmethod
    def recipe(cls, extent: Extent) -> Recipe:
        width, slope = extent.width, extent.slope
        return Recipe(
            cls(
                polynomial=(1.1 * slope, 0.0),
                heights=[share * width for share in SHARES],
                rates=[rate / width for rate in RATES],
                exponents=(1.2,) * len(RATES),
                rest_input=extent.first[0],
            ),
            {
                "polynomial.0": scaled_range(slope, 0.0, 3.0),
                "polynomial.1": scaled_range(slope / width, -1.0, 1.0),
                **{f"heights.{i}": Range(0.0, 0.5 * width) for i in range(len(RATES))},
                **{
                    f"rates.{i}": Range(0.3 / width, 100.0 / width, "log")
                    for i in range(len(RATES))
                },
                **{f"exponents.{i}": Range(0.6, 3.0) for i in range(len(RATES))},
                **rest_bounds(extent),
            },
            rest_starts(extent),
            gain="polynomial.0",
            own=("rest_input",),
        )

    def inverse(self, lower: ScalarLike, upper: ScalarLike) -> Inverse:
        return InverseHysteresis(self, lower, upper)


def _remaining(left: Scalar, path: Scalar, exponent: Scalar) -> Scalar:
    """Return q after ``path``, q' = -q^exponent from ``left``, for q = 1 -+ f.

    q^(1 - n) grows in proportion to the path, which gives the closed form for any n; at
    n = 1 its limit is an exponential.
    """
    bend = exponent - 1.0
    some = jnp.maximum(left, SPENT)
    gone = path * some**bend
    size = bend * gone
    small = jnp.abs(size) < SERIES
    ends = size <= SPENT - 1.0
    log = jnp.log1p(jnp.where(small | ends, 1.0, size)) / jnp.where(small, 1.0, bend)
    series = gone * (1.0 - size * (0.5 - size * (1.0 / 3.0 - 0.25 * size)))
    found = some * jnp.exp(-jnp.where(small, series, log))
    return jnp.where(ends | (left <= SPENT), 0.0, found)
