"""First-order lag: an amplifier, a low-pass, a sensor's own filter."""

import equinox as eqx
import jax.numpy as jnp

from .._types import Scalar, ScalarLike, as_array, check
from ..system import System
from .arma import ARMA


class FirstOrderLag(System):
    """``tau dy/dt + y = x`` for an input held between samples, unit DC gain.

    ``time_constant`` tau in s, ``dt`` in s; y in the unit of x. Raises ValueError
    unless both are positive.
    """

    time_constant: Scalar = eqx.field(converter=as_array)
    dt: float = eqx.field(static=True)

    def __check_init__(self):
        check("time constant in s", self.time_constant, above=0.0)
        check("sample time in s", self.dt, above=0.0)

    def pole(self) -> Scalar:
        """Return the pole in the z plane."""
        return jnp.exp(-self.dt / self.time_constant)

    def as_arma(self) -> ARMA:
        """Return the same lag as a second-order ARMA with two zero coefficients."""
        pole = self.pole()
        return ARMA((pole, 0.0), (1.0 - pole, 0.0, 0.0))

    def init(self, input: ScalarLike = 0.0) -> Scalar:
        return as_array(input)

    def step(self, state: Scalar, input: ScalarLike) -> tuple[Scalar, Scalar]:
        input = as_array(input)
        output = input + self.pole() * (state - input)
        return output, output
