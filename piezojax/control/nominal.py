"""Nominal-model sliding mode control of one axis (chapter 8)."""

from typing import ClassVar, NamedTuple

import equinox as eqx
import jax.numpy as jnp

from ..core.arrays import Scalar, State, as_array
from ..core.feedback import Observation
from ..core.parameter import PartUnits, parameter
from ..core.system import System
from ..dynamics.arma import ARMA
from .switching import SwitchingLaw

READINGS = ("nominal_state", "measured_state")


class NominalState(NamedTuple):
    """States of model and law; the last measurement, reference, disturbance and command
    in the unit of the axis."""

    model: State
    law: State
    measured: Scalar
    reference: Scalar
    disturbance: Scalar
    command: Scalar


class NominalSlidingMode(System):
    """Sliding mode control of one axis on the state of a nominal model, (8.17)-(8.39).

    The printed equivalent control acts on the measured state, and no tested form of it
    is stable. ``reading`` selects a replacement:

    - ``"nominal_state"``: the equivalent control acts on the state of ``model``, which
      runs on the applied input: y_n(k) and y_n(k+1). The law acts on the measured
      error, s(k) = ``surface`` e(k) + e(k+1), with e(k+1) predicted by the model.
      r(k+2) is extrapolated.
    - ``"measured_state"``: there is no equivalent control, and
      s(k) = ``surface`` e(k-1) + e(k).

    ``correction`` weighs epsilon of (8.22), the effect of d = y - y_n on the next
    states: 1 as printed with a disturbance observer, 0 for the nominal controller.
    ``model`` is a second-order ARMA (a_1, a_2 | b_0, b_1, b_2) with one unit for input
    and output. The zeros of its numerator may lie outside the unit circle, so the sum
    of its coefficients is inverted instead, with Q/(Q+R) of (8.39). ``law``, a
    ``SwitchingPID`` in the thesis, computes the switching part from s.

    Input an Observation, output the command. Raises ValueError for a model of another
    order or an unknown reading.
    """

    part_units: ClassVar[PartUnits] = {"law": {"s": "um", "v": "um"}}

    law: SwitchingLaw
    model: ARMA
    surface: Scalar = parameter(
        "1", "weight m of the older error in s", typical=(-0.98, 0.98)
    )
    error_weight: Scalar = parameter(
        "1", "weight Q of the inversion; only Q / R counts", above=0.0, scale="log"
    )
    control_weight: Scalar = parameter(
        "1", "weight R of the inversion", least=0.0, scale="log", typical=(1e-4, 1e3)
    )
    correction: Scalar = parameter(
        "1", "weight of the disturbance epsilon", typical=(-1.0, 2.0), default=0.0
    )
    reading: str = eqx.field(static=True, default="nominal_state")

    def __check_init__(self):
        _check_second_order(self.model)
        if self.reading not in READINGS:
            raise ValueError(
                f"reading {self.reading!r}; it must be one of {list(READINGS)}"
            )

    def _inverse(self) -> Scalar:
        share = self.error_weight / (self.error_weight + self.control_weight)
        return share / sum(self.model.moving)

    def _advance(
        self, state: NominalState, input: Observation
    ) -> tuple[Scalar, Scalar, NominalState]:
        """Return v without switching part, s, and the next state except the law's."""
        a1, a2 = (-a for a in self.model.autoregressive)
        y, r, r_next = input.measured, input.reference, input.next_reference
        model, modelled = self.model.step(state.model, input.applied)
        disturbance = y - modelled
        if self.reading == "nominal_state":
            # The next command is not known yet: assume that the last one is held.
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
        modelled = self.model.dc_gain() * input.applied
        state = NominalState(
            model=self.model.init(input.applied),
            law=(),
            measured=as_array(input.measured),
            reference=as_array(input.reference),
            disturbance=input.measured - modelled,
            command=as_array(input.applied),
        )
        # The law holds the part of the command at rest that v does not give.
        v, sliding, _ = self._advance(state, input)
        needed = (input.applied / self._inverse() - v) / sum(self.model.moving)
        return state._replace(law=self.law.start(sliding, needed))

    def step(
        self, state: NominalState, input: Observation
    ) -> tuple[NominalState, Scalar]:
        v, sliding, following = self._advance(state, input)
        gain = sum(self.model.moving)
        shortfall = (input.applied - state.command) / (self._inverse() * gain)
        driven = self.law.driven(state.law, shortfall)
        law, switching = self.law.step(driven, sliding)
        command = self._inverse() * (v + gain * switching)
        return following._replace(law=law, command=command), command


def _check_second_order(model: ARMA) -> None:
    """Raise ValueError unless ``model`` has a_1, a_2 and b_0, b_1, b_2."""
    orders = len(model.autoregressive), len(model.moving)
    if orders != (2, 3):
        raise ValueError(
            f"the model has {orders[0]} a and {orders[1]} b coefficients; "
            "it must have 2 and 3"
        )
