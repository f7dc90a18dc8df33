"""Prandtl-Ishlinskii hysteresis: weighted play operators, symmetric and asymmetric."""

import equinox as eqx
import jax.numpy as jnp

from ..core.arrays import Scalar, ScalarLike, as_array, as_scalars, check
from ..core.system import System
from .plays import Memory, check_plays, memoryless, played, weighted


class PrandtlIshlinskii(System):
    """``y = P(x) + sum_i weights[i] play_i(x)``: rate-independent, symmetric loops.

    Input x in V, output y in um. Each play operator is a backlash of half-width
    ``thresholds[i]`` (V) with the slope ``weights[i]`` (um/V). ``polynomial`` holds the
    memoryless part P(x) = polynomial[0] x + polynomial[1] x^2 + ... (um/V, um/V^2,
    ...): with terms above the first this is the model of Gu, Zhu and Su (2014, IEEE
    Trans. Ind. Electron. 61(3)). The material starts without memory at ``rest_input``
    (V). Loops close for weights >= 0.

    Raises ValueError for thresholds that are not positive, numbers that are not finite,
    or a different count of thresholds and weights.
    """

    polynomial: tuple[Scalar, ...] = eqx.field(converter=as_scalars)
    thresholds: tuple[Scalar, ...] = eqx.field(converter=as_scalars)
    weights: tuple[Scalar, ...] = eqx.field(converter=as_scalars)
    rest_input: Scalar = eqx.field(converter=as_array, default=0.0)

    def __check_init__(self):
        check("polynomial", self.polynomial)
        check_plays(self.thresholds, self.weights)

    def init(self, input: ScalarLike = 0.0) -> Memory:
        virgin = (self.rest_input,) * len(self.thresholds)
        return played(as_array(input), virgin, self.thresholds)

    def step(self, state: Memory, input: ScalarLike) -> tuple[Memory, Scalar]:
        input = as_array(input)
        state = played(input, state, self.thresholds)
        return state, memoryless(self.polynomial, input) + weighted(self.weights, state)


class AsymmetricPrandtlIshlinskii(System):
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
