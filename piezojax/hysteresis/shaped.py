"""Coleman-Hodgdon hysteresis with nonlinear shape functions."""

from collections.abc import Sequence
from typing import ClassVar, NamedTuple

import jax.numpy as jnp

from ..core.arrays import Scalar, ScalarLike, Scalars, as_array, as_scalars
from ..core.parameter import parameter
from ..core.recipe import Extent, Fittable, Part, Recipe, rest_bounds, rest_starts
from ..core.space import Range
from .inverse import Inverse, InverseHysteresis
from .model import Hysteresis, Laws, differential_laws


class LastPoint(NamedTuple):
    """Last input (V) and output (um)."""

    input: Scalar
    output: Scalar


class ShapedColemanHodgdon(Hysteresis, Fittable):
    """``y' = |x'| (p(x) + c y) + g(x) x'`` with polynomials p and g.

    This is the general model of Coleman and Hodgdon, alpha |x'| (f(x) - y) + g(x) x',
    with c = -alpha and p = alpha f; the thesis takes f linear and g constant, (3.2) and
    (3.3), and names this its first limitation (section 9.2). Input x in V, output y in
    um; p(x) = pull[0] + pull[1] x + ..., g(x) = slope[0] + slope[1] x + .... A step
    integrates the polynomials exactly and y by the trapezoid rule. With ``pull``
    (0, a) and ``slope`` (b,) it is ColemanHodgdon. As there, the virgin curve starts at
    ``rest_input``, and there is no return-point memory, no wiping-out and no
    congruency. The inverse is InverseHysteresis, if y rises on every branch. Loops run
    counter-clockwise, as for a piezo, where p'(x) > |c| g(x), and clockwise where
    p'(x) < |c| g(x).

    Raises ValueError for parameters outside their limits or empty polynomials.
    """

    laws: ClassVar[Laws] = differential_laws()
    part: ClassVar[Part] = Part(
        "shaped_coleman_hodgdon",
        "hysteresis",
        "Coleman-Hodgdon, cubic p and quadratic g: y' = |x'| (p(x) + c y) + g(x) x'",
    )

    pull: Scalars = parameter(
        "um/V^(i+1)", "coefficient i of the polynomial p", converter=as_scalars
    )
    slope: Scalars = parameter(
        "um/V^(i+1)", "coefficient i of the polynomial g", converter=as_scalars
    )
    c: Scalar = parameter("1/V", "decay along the path of the input", below=0.0)
    rest_input: Scalar = parameter("V", "input of the virgin state", default=0.0)
    rest_output: Scalar = parameter("um", "output of the virgin state", default=0.0)

    def __check_init__(self):
        for name in ("pull", "slope"):
            if not getattr(self, name):
                raise ValueError(f"{name} is empty; it must hold a coefficient")

    def init(self, input: ScalarLike = 0.0) -> LastPoint:
        # Closed form, because one trapezoid over the range is inaccurate: y = q(x) + K
        # exp(s c x), where the polynomial q solves the equation.
        input, start = as_array(input), self.rest_input
        rate = jnp.where(input >= start, 1.0, -1.0) * self.c
        sign = rate / self.c
        order = max(len(self.pull), len(self.slope))
        pull = self.pull + (0.0,) * (order - len(self.pull))
        slope = self.slope + (0.0,) * (order - len(self.slope))
        q: list[Scalar] = []
        for i in reversed(range(order)):
            above = (i + 1) * q[0] if q else 0.0
            q.insert(0, (above - sign * pull[i] - slope[i]) / rate)
        change = jnp.exp(rate * (input - start))
        output = _value(q, input) + (self.rest_output - _value(q, start)) * change
        return LastPoint(input, output)

    def step(self, state: LastPoint, input: ScalarLike) -> tuple[LastPoint, Scalar]:
        x, last = as_array(input), state.input
        dx = x - last
        sign = jnp.where(dx >= 0.0, 1.0, -1.0)
        half = 0.5 * sign * self.c * dx
        force = sign * _integral(self.pull, last, x) + _integral(self.slope, last, x)
        output = (force + (1.0 + half) * state.output) / (1.0 - half)
        return LastPoint(x, output), output

    @classmethod
    def recipe(cls, extent: Extent) -> Recipe:
        width, slope = extent.width, extent.slope
        rest = extent.first[1] - extent.centre
        reach = 2.0 * extent.span
        scales = [abs(slope) / width**i for i in range(4)]
        return Recipe(
            cls(
                pull=(0.0, slope / width, 0.0, 0.0),
                slope=(0.7 * slope, 0.0, 0.0),
                c=-1.0 / width,
                rest_input=extent.first[0],
                rest_output=rest,
            ),
            {
                # A constant pull is equivalent to an offset of the output.
                **{
                    f"pull.{i}": Range(-50 * s, 50 * s)
                    for i, s in enumerate(scales)
                    if i > 0
                },
                **{
                    f"slope.{i}": Range(-10 * s, 10 * s)
                    for i, s in enumerate(scales[:3])
                },
                "c": Range(-50.0 / width, -0.01 / width),
                **rest_bounds(extent),
                "rest_output": Range(rest - reach, rest + reach),
            },
            [
                {"c": -steep / width, "pull.1": steep * slope / width, **before}
                for steep in (1.0, 3.0, 10.0)
                for before in rest_starts(extent)
            ],
            gain="slope.0",
            own=("rest_input", "rest_output"),
        )

    def inverse(self, lower: ScalarLike, upper: ScalarLike) -> Inverse:
        return InverseHysteresis(self, lower, upper)


def _value(polynomial: Sequence[Scalar], x: Scalar) -> Scalar:
    total = jnp.zeros_like(x)
    for coefficient in reversed(polynomial):
        total = total * x + coefficient
    return total


def _integral(polynomial: Sequence[Scalar], low: Scalar, high: Scalar) -> Scalar:
    primitive = [as_array(0.0), *(c / i for i, c in enumerate(polynomial, 1))]
    return _value(primitive, high) - _value(primitive, low)
