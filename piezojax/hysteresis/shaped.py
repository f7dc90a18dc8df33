"""Coleman-Hodgdon hysteresis with nonlinear shape functions."""

from collections.abc import Sequence
from typing import ClassVar, NamedTuple

import equinox as eqx
import jax.numpy as jnp

from ..core.arrays import Scalar, ScalarLike, as_array, as_scalars, check
from .inverse import Inverse, InverseHysteresis
from .model import Hysteresis


class LastPoint(NamedTuple):
    """Last input (V) and output (um)."""

    input: Scalar
    output: Scalar


class ShapedColemanHodgdon(Hysteresis):
    """``y' = |x'| (p(x) + c y) + g(x) x'`` with polynomials p and g.

    The general model of Coleman and Hodgdon, alpha |x'| (f(x) - y) + g(x) x', with
    c = -alpha and p = alpha f, of which the thesis takes f and g linear (section
    3.1, its first limitation). Input x in V, output y in um; ``pull`` holds p(x) =
    pull[0] + pull[1] x + ... (um/V, um/V^2, ...), ``slope`` g(x) = slope[0] + slope[1]
    x + ... (um/V, ...), ``c`` in 1/V is negative. Trapezoid step: the polynomials are
    integrated exactly, y by the trapezoid rule. ``pull = (0, a)``, ``slope = (b,)`` is
    ColemanHodgdon. The virgin curve starts at ``rest_input`` (V), ``rest_output`` (um).
    As there no return-point memory, no wiping-out and no congruency. Inverse:
    InverseHysteresis, where y rises on every branch. Loops run
    counter-clockwise, as a piezo's, where p'(x) > |c| g(x), and clockwise below that.

    Raises ValueError for numbers that are not finite, empty polynomials or ``c >= 0``.
    """

    before: ClassVar[str | None] = "rest_input"

    pull: tuple[Scalar, ...] = eqx.field(converter=as_scalars)
    slope: tuple[Scalar, ...] = eqx.field(converter=as_scalars)
    c: Scalar = eqx.field(converter=as_array)
    rest_input: Scalar = eqx.field(converter=as_array, default=0.0)
    rest_output: Scalar = eqx.field(converter=as_array, default=0.0)

    def __check_init__(self):
        for name, polynomial in (("pull", self.pull), ("slope", self.slope)):
            if not polynomial:
                raise ValueError(f"{name} is empty; it must hold a coefficient")
            check(name, polynomial)
        check("c in 1/V", self.c, below=0.0)

    def init(self, input: ScalarLike = 0.0) -> LastPoint:
        # In closed form, because a single trapezoid over the range is a poor one:
        # y = q(x) + K exp(s c x), where the polynomial q solves the equation.
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
