"""Discrete PID with two degrees of freedom, filtered derivative and anti-windup."""

from typing import NamedTuple

import jax.numpy as jnp

from ..core.arrays import Scalar
from ..core.feedback import Observation
from ..core.parameter import parameter, sample_time
from ..core.system import System
from .anti_windup import anti_windup


class PIDState(NamedTuple):
    """Integral part and last command in the unit of u, filtered rate in um/s, last
    error of the derivative in um."""

    integral: Scalar
    rate: Scalar
    error: Scalar
    command: Scalar


class PID(System):
    """``u = P (b r - z) + I int (r - z) dt + D d(c r - z)/dt`` for reference r.

    The command u is a voltage (V), or a displacement (um) ahead of an inverse of the
    plant. The derivative acts through a first-order filter. ``anti_windup`` drives the
    integral by the difference of the applied and the last commanded u. The integral
    uses the rectangular rule and has the unit of u, so a change of I causes no jump.

    ``proportional_weight`` b and ``derivative_weight`` c are the set-point weights of
    Astrom and Hagglund (Advanced PID Control, 2006). With 1 the PID acts on the error
    alone. Below 1 a jump of r is softened; above 1, P (b - 1) r and D (c - 1) dr/dt
    feed the reference and its rate forward. Feedback, noise and stability do not depend
    on them. The reference is used up to r(k), without r(k+1).

    Raises ValueError for a parameter outside its limits.
    """

    proportional: Scalar = parameter(
        "[u]/um", "proportional gain P", scale="log", typical=(1e-3, 1e2)
    )
    integral: Scalar = parameter(
        "[u]/(um s)", "integral gain I", scale="log", typical=(1e-1, 1e5)
    )
    derivative: Scalar = parameter(
        "[u] s/um", "derivative gain D", scale="log", typical=(1e-8, 1e-1), default=0.0
    )
    derivative_filter: Scalar = parameter(
        "s",
        "time constant of the derivative's filter",
        least=0.0,
        scale="log",
        typical=(1e-6, 1e-1),
        default=0.0,
    )
    anti_windup: Scalar = anti_windup()
    proportional_weight: Scalar = parameter(
        "1", "set-point weight b of P", typical=(0.0, 2.0), default=1.0
    )
    derivative_weight: Scalar = parameter(
        "1", "set-point weight c of D", typical=(0.0, 2.0), default=1.0
    )
    dt: float = sample_time(kw_only=True)

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
