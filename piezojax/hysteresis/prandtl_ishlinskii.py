"""Prandtl-Ishlinskii hysteresis: weighted play operators, symmetric and asymmetric."""

import equinox as eqx
import jax.numpy as jnp

from .._types import Scalar, ScalarLike, as_array, as_scalars, check
from ..system import System

Memory = tuple[Scalar, ...]


def _played(input: Scalar, memory: Memory, thresholds: Memory) -> Memory:
    """Advance play operators (backlashes) of half-width ``thresholds`` by one sample.

    w <- max(x - r, min(x + r, w)), Kuhnen 2003, eq. (3).
    """
    return tuple(
        jnp.maximum(input - r, jnp.minimum(input + r, w))
        for r, w in zip(thresholds, memory, strict=True)
    )


def _check_plays(thresholds: Memory, weights: Memory, name: str = "weights") -> None:
    check("thresholds", thresholds, above=0.0)
    check(name, weights)
    if len(thresholds) != len(weights):
        raise ValueError(
            f"{len(thresholds)} thresholds and {len(weights)} {name}; "
            "each play operator needs one of both"
        )


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
        _check_plays(self.thresholds, self.weights)

    def init(self, input: ScalarLike = 0.0) -> Memory:
        virgin = (self.rest_input,) * len(self.thresholds)
        return _played(as_array(input), virgin, self.thresholds)

    def step(self, state: Memory, input: ScalarLike) -> tuple[Memory, Scalar]:
        input = as_array(input)
        state = _played(input, state, self.thresholds)
        return state, _memoryless(self.polynomial, input) + _sum(self.weights, state)


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
        _check_plays(self.thresholds, self.weights)
        _check_plays(self.thresholds, self.skew, "skew weights")
        check("scale in V", self.scale, above=0.0)

    def _square(self, x: Scalar) -> Scalar:
        return 0.5 * jnp.maximum(x - self.origin, 0.0) ** 2 / self.scale

    def init(self, input: ScalarLike = 0.0) -> tuple[Memory, Memory]:
        input, virgin = as_array(input), self.rest_input
        count = len(self.thresholds)
        return (
            _played(input, (virgin,) * count, self.thresholds),
            _played(
                self._square(input), (self._square(virgin),) * count, self.thresholds
            ),
        )

    def step(
        self, state: tuple[Memory, Memory], input: ScalarLike
    ) -> tuple[tuple[Memory, Memory], Scalar]:
        input = as_array(input)
        plain = _played(input, state[0], self.thresholds)
        skewed = _played(self._square(input), state[1], self.thresholds)
        output = _memoryless(self.polynomial, input)
        output = output + _sum(self.weights, plain) + _sum(self.skew, skewed)
        return (plain, skewed), output


def _memoryless(polynomial: Memory, x: Scalar) -> Scalar:
    total = jnp.zeros_like(x)
    for coefficient in reversed(polynomial):
        total = (total + coefficient) * x
    return total


def _sum(weights: Memory, plays: Memory) -> Scalar:
    return sum((w * p for w, p in zip(weights, plays, strict=True)), as_array(0.0))
