"""Prandtl-Ishlinskii hysteresis with loops that are wider on one side."""

from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp

from ..core.arrays import Scalar, ScalarLike, as_array, as_scalars, check
from .inverse import Inverse, InverseHysteresis
from .model import Hysteresis
from .plays import Memory, check_plays, memoryless, played, weighted


class AsymmetricPrandtlIshlinskii(Hysteresis):
    """A Prandtl-Ishlinskii model with loops that are wider on one side.

    ``y = P(x) + sum_i weights[i] play_i(x) + sum_i skew[i] play_i(q(x))``, where q is
    the one-sided square (x - origin)^2 / (2 scale) for x above ``origin`` and 0 below:
    plays of q have a width in x that shrinks as x grows, which is how the envelope
    functions of a generalised play skew a loop (Al Janaideh, Rakheja and Su 2009,
    Mechatronics 19(5)), here with the weights still linear. ``origin`` and ``scale`` in
    V: where the loop is widest, and the span of the input. Everything else as in
    PrandtlIshlinskii; ``skew`` in um/V. Raises ValueError as there, and for
    ``scale <= 0``.
    """

    before: ClassVar[str | None] = "rest_input"

    polynomial: tuple[Scalar, ...] = eqx.field(converter=as_scalars)
    thresholds: tuple[Scalar, ...] = eqx.field(converter=as_scalars)
    weights: tuple[Scalar, ...] = eqx.field(converter=as_scalars)
    skew: tuple[Scalar, ...] = eqx.field(converter=as_scalars)
    origin: Scalar = eqx.field(converter=as_array)
    scale: Scalar = eqx.field(converter=as_array)
    rest_input: Scalar = eqx.field(converter=as_array, default=0.0)

    def __check_init__(self):
        check("polynomial", self.polynomial)
        check_plays(self.thresholds, self.weights)
        check_plays(self.thresholds, self.skew, "skew weights")
        check("scale in V", self.scale, above=0.0)

    def _square(self, x: Scalar) -> Scalar:
        return 0.5 * jnp.maximum(x - self.origin, 0.0) ** 2 / self.scale

    def init(self, input: ScalarLike = 0.0) -> tuple[Memory, Memory]:
        input, virgin = as_array(input), self.rest_input
        count = len(self.thresholds)
        return (
            played(input, (virgin,) * count, self.thresholds),
            played(
                self._square(input), (self._square(virgin),) * count, self.thresholds
            ),
        )

    def step(
        self, state: tuple[Memory, Memory], input: ScalarLike
    ) -> tuple[tuple[Memory, Memory], Scalar]:
        input = as_array(input)
        plain = played(input, state[0], self.thresholds)
        skewed = played(self._square(input), state[1], self.thresholds)
        output = memoryless(self.polynomial, input)
        output = output + weighted(self.weights, plain) + weighted(self.skew, skewed)
        return (plain, skewed), output

    def inverse(self, lower: ScalarLike, upper: ScalarLike) -> Inverse:
        return InverseHysteresis(self, lower, upper)
