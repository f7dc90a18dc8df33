"""PID-based discrete sliding mode control with optimal inversion (chapter 5)."""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp

from .._types import Scalar, as_array, check, check_not_zero
from ..dynamics.arma import ARMA
from ..system import Observation, System
from .alpha_beta import AlphaBeta, Motion


class SlidingModeState(NamedTuple):
    """Filter state, PID memory of s, past references and past outputs."""

    filter: Motion
    integral: Scalar
    surface: Scalar
    older_reference: Scalar
    outputs: tuple[Scalar, Scalar]


class SlidingModePID(System):
    """PID-based sliding mode control of a second-order model, output tracking.

    The state is x = [y, dy/dt] from the alpha-beta filter and the sliding variable
    ``s = surface * e1 + e2`` (5.15): ``surface`` m in 1/s. The equivalent control and
    the reference part v1 come from ``model`` (a_1, a_2 | b_0, b_1, b_2, b_0 not zero),
    a PID of s with ``proportional``, ``integral``, ``derivative`` replaces the
    switching term (5.18), and the zeros of the model, which may lie outside the unit
    circle, are inverted in the least-squares sense with the weights ``error_weight`` Q
    and ``control_weight`` R (5.23): f = Q/(Q+R) [v - (b1/b0) f' - (b2/b0) f''].

    Input an Observation; output f in the unit of the model's input: volts if the model
    was identified from voltage (the nominal controller), um behind an inverse
    hysteresis, um for a disturbance observer with its own gain. Of the PID, P acts per
    um/s of s in that unit, I per um, D per um/s^2; ``dt`` in s.

    Raises ValueError for a model of another order, Q <= 0, R < 0 or ``dt <= 0``.
    """

    proportional: Scalar = eqx.field(converter=as_array)
    integral: Scalar = eqx.field(converter=as_array)
    derivative: Scalar = eqx.field(converter=as_array)
    surface: Scalar = eqx.field(converter=as_array)
    error_weight: Scalar = eqx.field(converter=as_array)
    control_weight: Scalar = eqx.field(converter=as_array)
    model: ARMA
    filter: AlphaBeta

    def __check_init__(self):
        orders = len(self.model.autoregressive), len(self.model.moving)
        if orders != (2, 3):
            raise ValueError(
                f"the model has {orders[0]} a and {orders[1]} b coefficients; "
                "it must have 2 and 3"
            )
        check_not_zero("b_0 of the model", self.model.moving[0])
        check("proportional", self.proportional)
        check("integral", self.integral)
        check("derivative", self.derivative)
        check("surface in 1/s", self.surface)
        check("error_weight Q", self.error_weight, above=0.0)
        check("control_weight R", self.control_weight, least=0.0)

    @property
    def dt(self) -> float:
        """Sample time, s."""
        return self.filter.dt

    def _inversion_gain(self) -> Scalar:
        return self.error_weight / (self.error_weight + self.control_weight)

    def _feedforward(
        self, next_reference: Scalar, reference: Scalar, older: Scalar
    ) -> Scalar:
        """v1: the model input that moves x from the reference state to the next."""
        a1, a2 = self.model.autoregressive
        return (next_reference - a1 * reference - a2 * older) / self.model.moving[0]

    def init(self, input: Observation) -> SlidingModeState:
        reference = input.reference
        b0, b1, b2 = self.model.moving
        # At rest s = 0: the integral alone must hold the output.
        needed = input.applied * (1.0 / self._inversion_gain() + (b1 + b2) / b0)
        integral = needed - self._feedforward(reference, reference, reference)
        zero = jnp.zeros_like(integral)
        return SlidingModeState(
            filter=self.filter.init(input.measured),
            integral=integral,
            surface=zero,
            older_reference=reference + zero,
            outputs=(input.applied + zero, input.applied + zero),
        )

    def step(
        self, state: SlidingModeState, input: Observation
    ) -> tuple[SlidingModeState, Scalar]:
        dt = self.dt
        filter_state, motion = self.filter.step(state.filter, input.measured)
        reference, older = input.reference, state.older_reference
        e1 = motion.position - reference
        e2 = motion.velocity - (reference - older) / dt
        m = self.surface
        s = m * e1 + e2

        a1, a2 = self.model.autoregressive
        b0, b1, b2 = self.model.moving
        # x(k+1) = A x + B v with x = [y, (y - y')/T], B = [b0, b0/T].
        next_e1 = (a1 + a2) * e1 - a2 * dt * e2
        next_e2 = ((a1 + a2 - 1.0) * e1 / dt) - a2 * e2
        equivalent = -(1.0 / (m * b0 + b0 / dt)) * (m * next_e1 + next_e2)

        integral = state.integral - self.integral * dt * s
        switching = (
            integral
            - self.proportional * s
            - self.derivative * (s - state.surface) / dt
        )
        forward = self._feedforward(input.next_reference, reference, older)
        v = forward + equivalent + switching

        f1, f2 = state.outputs
        f = self._inversion_gain() * (v - (b1 / b0) * f1 - (b2 / b0) * f2)
        state = SlidingModeState(filter_state, integral, s, reference, (f, f1))
        return state, f
