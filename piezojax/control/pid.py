"""Discrete PID of two degrees of freedom, filtered derivative, and anti-windup."""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp

from .._types import Scalar, as_array, check
from ..system import Observation, System


class PIDState(NamedTuple):
    """Integral part in V; the derivative's error in um and its filtered rate in um/s;
    last command in V."""

    integral: Scalar
    rate: Scalar
    error: Scalar
    command: Scalar


class PID(System):
    """``u = P (b r - z) + I int (r - z) dt + D d(c r - z)/dt``, r to be followed by z.

    ``proportional`` in V/um, ``integral`` in V/(um s), ``derivative`` in V s/um,
    ``derivative_filter``, the time constant of the first-order filter on the rate, in
    s, ``anti_windup`` in 1/s: the rate at which the integral gives back what the
    actuator could not deliver (0 switches it off), ``dt`` in s. The integral is
    rectangular and holds volts, so that a new gain does not jump.

    ``proportional_weight`` b and ``derivative_weight`` c, without unit, are the
    set-point weights of Astrom and Hagglund (Advanced PID Control, 2006): 1 is the PID
    of the error alone, below it a jump of r is softened, and above it P (b - 1) r and
    D (c - 1) dr/dt feed the reference and its rate forward, while what feeds back, and
    with it the noise and the stability, stays as it is. The rate is that up to r(k);
    r(k+1) is not looked at.

    Raises ValueError for a negative filter or anti-windup rate and for ``dt <= 0``.
    """

    proportional: Scalar = eqx.field(converter=as_array)
    integral: Scalar = eqx.field(converter=as_array)
    derivative: Scalar = eqx.field(converter=as_array, default=0.0)
    derivative_filter: Scalar = eqx.field(converter=as_array, default=0.0)
    anti_windup: Scalar = eqx.field(converter=as_array, default=0.0)
    proportional_weight: Scalar = eqx.field(converter=as_array, default=1.0)
    derivative_weight: Scalar = eqx.field(converter=as_array, default=1.0)
    dt: float = eqx.field(static=True, kw_only=True)

    def __check_init__(self):
        check("sample time in s", self.dt, above=0.0)
        check("proportional in V/um", self.proportional)
        check("integral in V/(um s)", self.integral)
        check("derivative in V s/um", self.derivative)
        check("derivative filter in s", self.derivative_filter, least=0.0)
        check("anti-windup rate in 1/s", self.anti_windup, least=0.0)
        check("proportional weight", self.proportional_weight)
        check("derivative weight", self.derivative_weight)

    def _weighted(self, input: Observation) -> tuple[Scalar, Scalar]:
        """Return the errors of the proportional and the derivative part, um."""
        return (
            self.proportional_weight * input.reference - input.measured,
            self.derivative_weight * input.reference - input.measured,
        )

    def init(self, input: Observation) -> PIDState:
        position, error = self._weighted(input)
        return PIDState(
            integral=input.applied - self.proportional * position,
            rate=jnp.zeros_like(error),
            error=error,
            command=input.applied,
        )

    def step(self, state: PIDState, input: Observation) -> tuple[PIDState, Scalar]:
        position, error = self._weighted(input)
        shortfall = input.applied - state.command
        integral = state.integral + self.dt * (
            self.anti_windup * shortfall
            + self.integral * (input.reference - input.measured)
        )
        smoothing = self.dt / (self.dt + self.derivative_filter)
        slope = (error - state.error) / self.dt
        rate = state.rate + smoothing * (slope - state.rate)
        command = self.proportional * position + integral + self.derivative * rate
        return PIDState(integral, rate, error, command), command
