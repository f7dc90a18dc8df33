"""Discrete PID with a filtered derivative and back-calculation anti-windup."""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp

from .._types import Scalar, as_array, check
from ..system import Observation, System


class PIDState(NamedTuple):
    """Integral part in V, error rate in um/s, last error in um, last command in V."""

    integral: Scalar
    rate: Scalar
    error: Scalar
    command: Scalar


class PID(System):
    """``u = P e + I int e dt + D de/dt`` of the tracking error e = r - z.

    ``proportional`` in V/um, ``integral`` in V/(um s), ``derivative`` in V s/um,
    ``derivative_filter``, the time constant of the first-order filter on de/dt, in s,
    ``anti_windup`` in 1/s: the rate at which the integral gives back what the actuator
    could not deliver (0 switches it off), ``dt`` in s. The integral is rectangular and
    holds volts, so that a new gain does not jump. Raises ValueError for a negative
    filter or anti-windup rate and for ``dt <= 0``.
    """

    proportional: Scalar = eqx.field(converter=as_array)
    integral: Scalar = eqx.field(converter=as_array)
    derivative: Scalar = eqx.field(converter=as_array, default=0.0)
    derivative_filter: Scalar = eqx.field(converter=as_array, default=0.0)
    anti_windup: Scalar = eqx.field(converter=as_array, default=0.0)
    dt: float = eqx.field(static=True, kw_only=True)

    def __check_init__(self):
        check("sample time in s", self.dt, above=0.0)
        check("proportional in V/um", self.proportional)
        check("integral in V/(um s)", self.integral)
        check("derivative in V s/um", self.derivative)
        check("derivative filter in s", self.derivative_filter, least=0.0)
        check("anti-windup rate in 1/s", self.anti_windup, least=0.0)

    def init(self, input: Observation) -> PIDState:
        error = input.reference - input.measured
        return PIDState(
            integral=input.applied - self.proportional * error,
            rate=jnp.zeros_like(error),
            error=error,
            command=input.applied,
        )

    def step(self, state: PIDState, input: Observation) -> tuple[PIDState, Scalar]:
        error = input.reference - input.measured
        shortfall = input.applied - state.command
        integral = state.integral + self.dt * (
            self.anti_windup * shortfall + self.integral * error
        )
        smoothing = self.dt / (self.dt + self.derivative_filter)
        slope = (error - state.error) / self.dt
        rate = state.rate + smoothing * (slope - state.rate)
        command = self.proportional * error + integral + self.derivative * rate
        return PIDState(integral, rate, error, command), command
