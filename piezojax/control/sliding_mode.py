"""PID-based discrete sliding mode control with optimal inversion (chapters 4 and 5)."""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp

from ..core.arrays import Scalar, State, as_array, check
from ..core.system import Observation, System
from ..dynamics.arma import ARMA
from .observer import Observer
from .output_tracking import (
    INVERSIONS,
    check_inversion,
    check_second_order,
    equivalent_control,
    feedforward,
    inverted,
    tracking_error,
)


class SlidingModeState(NamedTuple):
    """Filter state, PID memory of s, past references and past outputs."""

    filter: State
    integral: Scalar
    surface: Scalar
    older_reference: Scalar
    outputs: tuple[Scalar, Scalar]


class SlidingModePID(System):
    """PID-based sliding mode control of a second-order model, output tracking.

    The state is x = [y, dy/dt] from ``filter``, an observer, and the sliding variable
    ``s = surface * e1 + e2`` (5.15): ``surface`` m in 1/s. The equivalent control and
    the reference part v1 come from ``model`` (a_1, a_2 | b_0, b_1, b_2, b_0 not zero),
    a PID of s with ``proportional``, ``integral``, ``derivative`` replaces the
    switching term (5.18), and the zeros of the model, which may lie outside the unit
    circle, are inverted in the least-squares sense with the weights ``error_weight`` Q
    and ``control_weight`` R: f = Q/(Q+R) [v - (b1/b0) f' - (b2/b0) f''] (5.23), or in
    another form ``inversion`` of ``INVERSIONS``. ``correction`` weighs the equivalent
    control, 1 as printed: with less of it the feedback is weaker, the reference part
    is not.

    Input an Observation; output f in the unit of the model's input: volts if the model
    was identified from voltage (the nominal controller), um behind an inverse
    hysteresis, um for a disturbance observer with its own gain. Of the PID, P acts per
    um/s of s in that unit, I per um, D per um/s^2; ``dt`` in s.

    Raises ValueError for a model of another order, b_0 = 0, Q <= 0, R < 0 or an unknown
    inversion.
    """

    proportional: Scalar = eqx.field(converter=as_array)
    integral: Scalar = eqx.field(converter=as_array)
    derivative: Scalar = eqx.field(converter=as_array)
    surface: Scalar = eqx.field(converter=as_array)
    error_weight: Scalar = eqx.field(converter=as_array)
    control_weight: Scalar = eqx.field(converter=as_array)
    model: ARMA
    filter: Observer
    inversion: str = eqx.field(static=True, default="printed")
    correction: Scalar = eqx.field(converter=as_array, default=1.0)

    def __check_init__(self):
        check_second_order(self.model)
        check_inversion(
            self.inversion, self.model, self.error_weight, self.control_weight
        )
        check("proportional", self.proportional)
        check("integral", self.integral)
        check("derivative", self.derivative)
        check("surface in 1/s", self.surface)
        check("correction", self.correction)

    @property
    def dt(self) -> float:
        """Sample time, s."""
        return self.filter.dt

    def _inversion_gain(self) -> Scalar:
        return INVERSIONS[self.inversion](
            self.model.moving[0], self.error_weight, self.control_weight
        )

    def init(self, input: Observation) -> SlidingModeState:
        reference = input.reference
        b0, b1, b2 = self.model.moving
        # At rest s = 0: the integral alone must hold the output.
        needed = input.applied * (1.0 / self._inversion_gain() + b1 + b2) / b0
        integral = needed - feedforward(self.model, reference, reference, reference)
        zero = jnp.zeros_like(integral)
        return SlidingModeState(
            filter=self.filter.init(input),
            integral=integral,
            surface=zero,
            older_reference=reference + zero,
            outputs=(input.applied + zero, input.applied + zero),
        )

    def step(
        self, state: SlidingModeState, input: Observation
    ) -> tuple[SlidingModeState, Scalar]:
        dt = self.dt
        filter_state, motion = self.filter.step(state.filter, input)
        reference, older = input.reference, state.older_reference
        error = tracking_error(motion, reference, older, dt)
        s = self.surface * error.position + error.velocity

        integral = state.integral - self.integral * dt * s
        switching = (
            integral
            - self.proportional * s
            - self.derivative * (s - state.surface) / dt
        )
        v = (
            feedforward(self.model, input.next_reference, reference, older)
            + self.correction * equivalent_control(self.model, self.surface, error, dt)
            + switching
        )
        f = inverted(self.model, self._inversion_gain(), v, state.outputs)
        state = SlidingModeState(
            filter_state, integral, s, reference, (f, state.outputs[0])
        )
        return state, f
