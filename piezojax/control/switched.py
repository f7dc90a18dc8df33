"""Discrete sliding mode control with any law that drives s to zero (2.20)."""

from typing import NamedTuple

import equinox as eqx

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


class SwitchedState(NamedTuple):
    """Filter and law, last reference, past outputs, what holds a start at rest."""

    filter: State
    law: State
    older_reference: Scalar
    outputs: tuple[Scalar, Scalar]
    bias: Scalar


class SwitchedSlidingMode(System):
    """Output-tracking sliding mode control whose switching part is ``law``.

    (2.20) with the equivalent control and reference part of chapter 4: ``law`` maps the
    sliding variable s in um/s to the switching part of v, 0 at s = 0, and is at rest
    there: ``BangBang``, ``BoundaryLayer``, ``SuperTwisting``. All else is as in
    ``SlidingModePID``. Not every law has an integral, so what a start at rest away from
    zero needs beyond the model's own feed-forward is frozen as the constant ``bias`` of
    the state; from rest at zero it is zero.

    Input an Observation, output in the unit of the model's input. Raises ValueError for
    a model of another order, b_0 = 0, Q <= 0, R < 0 or an unknown inversion.
    """

    law: System
    surface: Scalar = eqx.field(converter=as_array)
    error_weight: Scalar = eqx.field(converter=as_array)
    control_weight: Scalar = eqx.field(converter=as_array)
    model: ARMA
    filter: Observer
    inversion: str = eqx.field(static=True, default="printed")

    def __check_init__(self):
        check_second_order(self.model)
        check_inversion(
            self.inversion, self.model, self.error_weight, self.control_weight
        )
        check("surface in 1/s", self.surface)

    def _inverse(self, v: Scalar, outputs: tuple[Scalar, Scalar]) -> Scalar:
        gain = INVERSIONS[self.inversion](
            self.model.moving[0], self.error_weight, self.control_weight
        )
        return inverted(self.model, gain, v, outputs)

    def init(self, input: Observation) -> SwitchedState:
        reference = as_array(input.reference)
        outputs = (as_array(input.applied), as_array(input.applied))
        v = feedforward(self.model, reference, reference, reference)
        return SwitchedState(
            filter=self.filter.init(input),
            law=self.law.init(0.0),
            older_reference=reference,
            outputs=outputs,
            bias=input.applied - self._inverse(v, outputs),
        )

    def step(
        self, state: SwitchedState, input: Observation
    ) -> tuple[SwitchedState, Scalar]:
        dt = self.filter.dt
        filter_state, motion = self.filter.step(state.filter, input)
        reference, older = input.reference, state.older_reference
        error = tracking_error(motion, reference, older, dt)
        law, switching = self.law.step(
            state.law, self.surface * error.position + error.velocity
        )
        v = (
            feedforward(self.model, input.next_reference, reference, older)
            + equivalent_control(self.model, self.surface, error, dt)
            + switching
        )
        f = self._inverse(v, state.outputs) + state.bias
        state = SwitchedState(
            filter_state, law, reference, (f, state.outputs[0]), state.bias
        )
        return state, f
