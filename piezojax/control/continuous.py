"""Continuous PID-based sliding mode control, sampled: no model of the stage."""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp

from ..core.arrays import Scalar, State, as_array, check
from ..core.system import Observation, System
from .observer import Observer
from .output_tracking import tracking_error


class ContinuousSlidingModeState(NamedTuple):
    """Filter state, integral part in V, last s in um/s, last reference in um."""

    filter: State
    integral: Scalar
    sliding: Scalar
    older_reference: Scalar


class ContinuousSlidingModePID(System):
    """``u = -(P s + I int s dt + D ds/dt)`` of s = ``surface`` e + de/dt, sampled.

    The comparison of section 4.5.4.3, reference [98] there, of which the thesis prints
    the gains but no equation: the continuous design needs no model, so none is used
    here. e = y - r with y and dy/dt from ``filter``; ``surface`` in 1/s; of the PID, P
    in V s/um, I in V/um, D in V s^2/um. Input an Observation (the next reference is not
    looked at), output in V. Raises ValueError for values that are not finite.
    """

    proportional: Scalar = eqx.field(converter=as_array)
    integral: Scalar = eqx.field(converter=as_array)
    derivative: Scalar = eqx.field(converter=as_array)
    surface: Scalar = eqx.field(converter=as_array)
    filter: Observer

    def __check_init__(self):
        check("proportional in V s/um", self.proportional)
        check("integral in V/um", self.integral)
        check("derivative in V s^2/um", self.derivative)
        check("surface in 1/s", self.surface)

    def init(self, input: Observation) -> ContinuousSlidingModeState:
        reference = as_array(input.reference)
        return ContinuousSlidingModeState(
            filter=self.filter.init(input),
            integral=as_array(input.applied),
            sliding=jnp.zeros_like(reference),
            older_reference=reference,
        )

    def step(
        self, state: ContinuousSlidingModeState, input: Observation
    ) -> tuple[ContinuousSlidingModeState, Scalar]:
        dt = self.filter.dt
        filter_state, motion = self.filter.step(state.filter, input)
        error = tracking_error(motion, input.reference, state.older_reference, dt)
        s = self.surface * error.position + error.velocity
        integral = state.integral - self.integral * dt * s
        voltage = (
            integral
            - self.proportional * s
            - self.derivative * (s - state.sliding) / dt
        )
        return ContinuousSlidingModeState(
            filter_state, integral, s, input.reference
        ), voltage
