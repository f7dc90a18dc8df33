"""Oscillator of a mass, a spring, a damper and a hysteretic element."""

from typing import ClassVar, NamedTuple

import jax.numpy as jnp

from ..core.arrays import Scalar, ScalarLike, as_array
from ..core.parameter import parameter, sample_time
from ..core.runge_kutta import Point, runge_kutta
from .bouc_wen import BoucWen
from .inverse import Inverse
from .model import Hysteresis


class OscillatorState(NamedTuple):
    """Displacement (m), velocity (m/s) and force of the hysteretic element (N)."""

    displacement: Scalar
    velocity: Scalar
    force: Scalar


class HystereticOscillator(Hysteresis):
    """``mass y'' + damping y' + stiffness y + z = u``, z the Bouc-Wen force of y.

    The input u in N is held during the step; the output is y in m at its end. The
    Runge-Kutta method uses the ``substeps`` of ``hysteresis``. Source: Noel &
    Schoukens, Hysteretic benchmark with a dynamic nonlinearity, 2016.

    Raises ValueError for parameters outside their limits.
    """

    dynamic: ClassVar[bool] = True

    mass: Scalar = parameter("kg", "mass", above=0.0, scale="log")
    damping: Scalar = parameter("N s/m", "damping")
    stiffness: Scalar = parameter("N/m", "stiffness of the spring", above=0.0)
    hysteresis: BoucWen  # pyright: ignore[reportGeneralTypeIssues]
    dt: float = sample_time()

    def init(self, input: ScalarLike = 0.0) -> OscillatorState:
        """Return the state at rest under ``input`` (N), the element without force."""
        still = jnp.zeros(())
        return OscillatorState(as_array(input) / self.stiffness, still, still)

    def step(
        self, state: OscillatorState, input: ScalarLike
    ) -> tuple[OscillatorState, Scalar]:
        input = as_array(input)

        def rate(point: Point) -> Point:
            displacement, velocity, force = point
            spring = self.damping * velocity + self.stiffness * displacement
            acceleration = (input - spring - force) / self.mass
            return velocity, acceleration, self.hysteresis.rate(force, velocity)

        parts = self.hysteresis.substeps
        state = OscillatorState(*runge_kutta(rate, state, self.dt, parts))
        return state, state.displacement

    def inverse(self, lower: ScalarLike, upper: ScalarLike) -> Inverse:
        """Raise ValueError: the model contains dynamics."""
        del lower, upper
        raise ValueError("a HystereticOscillator contains dynamics and has no inverse")
