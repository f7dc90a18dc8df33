"""PID-based sliding mode control on the state of a nominal model (chapter 8)."""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp

from ..core.arrays import Scalar, State, as_array, check
from ..core.system import Observation, System
from ..dynamics.arma import ARMA
from .output_tracking import check_second_order

READINGS = ("nominal_state", "measured_state")


class NominalState(NamedTuple):
    """Model state; past measurement, reference and disturbance in the output's unit."""

    model: State
    integral: Scalar
    sliding: Scalar
    measured: Scalar
    reference: Scalar
    disturbance: Scalar


class NominalSlidingModePID(System):
    """PID-based sliding mode control of one axis, its model run along (8.17)-(8.39).

    The printed equivalent control is unstable on the measured state in every form
    tried. ``reading`` says what takes its place:

    - ``"nominal_state"``: it acts on the state of ``model`` run along with what was
      applied, y_n(k) and y_n(k+1); the PID acts on the measured error, with
      s(k) = ``surface`` e(k) + e(k+1), e(k+1) as the model predicts it. r(k+2) is
      extrapolated.
    - ``"measured_state"``: there is none, and s(k) = ``surface`` e(k-1) + e(k).

    ``correction`` weighs epsilon of (8.22), what d = y - y_n adds to the next states: 1
    as printed with a disturbance observer, 0 for the nominal controller. ``model`` is a
    second-order ARMA (a_1, a_2 | b_0, b_1, b_2) from commands to outputs of one unit;
    its numerator, whose zero may lie outside the unit circle, is inverted by its sum,
    with Q/(Q+R) of (8.39) from ``error_weight`` Q and ``control_weight`` R.
    ``proportional``, ``integral`` in 1/s and ``derivative`` in s act on s, ``dt`` in s.

    Input an Observation, output the command. Raises ValueError for a model of another
    order, Q <= 0, R < 0, ``dt <= 0`` or an unknown reading.
    """

    proportional: Scalar = eqx.field(converter=as_array)
    integral: Scalar = eqx.field(converter=as_array)
    derivative: Scalar = eqx.field(converter=as_array)
    surface: Scalar = eqx.field(converter=as_array)
    error_weight: Scalar = eqx.field(converter=as_array)
    control_weight: Scalar = eqx.field(converter=as_array)
    model: ARMA
    dt: float = eqx.field(static=True)
    correction: Scalar = eqx.field(converter=as_array, default=0.0)
    reading: str = eqx.field(static=True, default="nominal_state")

    def __check_init__(self):
        check_second_order(self.model)
        for name in ("proportional", "integral", "derivative", "surface", "correction"):
            check(name, getattr(self, name))
        check("error_weight Q", self.error_weight, above=0.0)
        check("control_weight R", self.control_weight, least=0.0)
        check("sample time in s", self.dt, above=0.0)
        if self.reading not in READINGS:
            raise ValueError(
                f"reading {self.reading!r}; it must be one of {list(READINGS)}"
            )

    def _inverse(self) -> Scalar:
        share = self.error_weight / (self.error_weight + self.control_weight)
        return share / sum(self.model.moving)

    def _law(
        self, state: NominalState, input: Observation
    ) -> tuple[Scalar, Scalar, NominalState]:
        """Return v without the PID of s, s, and the next state but for the PID."""
        a1, a2 = (-a for a in self.model.autoregressive)
        y, r, r_next = input.measured, input.reference, input.next_reference
        model, modelled = self.model.step(state.model, input.applied)
        disturbance = y - modelled
        if self.reading == "nominal_state":
            # As if the last command were held: the next one is what is looked for.
            _, ahead = self.model.step(model, input.applied)
            held = sum(self.model.moving) * input.applied
            predicted = -a1 * y - a2 * state.measured + held
            sliding = self.surface * (y - r) + (predicted - r_next)
            beyond = 2.0 * r_next - r
            forward = beyond + a1 * r_next + a2 * r
            epsilon = (2.0 + a1) * disturbance + (a2 - 1.0) * state.disturbance
            equivalent = (
                a2 * (modelled - r)
                - (self.surface - a1) * (ahead - r_next)
                - self.correction * epsilon
            )
        else:
            sliding = self.surface * (state.measured - state.reference) + (y - r)
            forward = r_next + a1 * r + a2 * state.reference
            equivalent = jnp.zeros_like(forward)
        following = state._replace(
            model=model, measured=y, reference=r, disturbance=disturbance
        )
        return forward + equivalent, sliding, following

    def init(self, input: Observation) -> NominalState:
        zero = jnp.zeros_like(as_array(input.measured))
        rest = self.model.init(input.applied)
        modelled = self.model.dc_gain() * input.applied
        state = NominalState(
            model=rest,
            integral=zero,
            sliding=zero,
            measured=as_array(input.measured),
            reference=as_array(input.reference),
            disturbance=input.measured - modelled,
        )
        # The integral holds what the command needs at rest.
        v, sliding, _ = self._law(state, input)
        total = sum(self.model.moving)
        needed = (input.applied / self._inverse() - v) / total
        return state._replace(
            integral=needed + self.proportional * sliding, sliding=sliding
        )

    def step(
        self, state: NominalState, input: Observation
    ) -> tuple[NominalState, Scalar]:
        v, sliding, following = self._law(state, input)
        integral = state.integral - self.integral * self.dt * sliding
        switching = (
            integral
            - self.proportional * sliding
            - self.derivative * (sliding - state.sliding) / self.dt
        )
        command = self._inverse() * (v + sum(self.model.moving) * switching)
        return following._replace(integral=integral, sliding=sliding), command
