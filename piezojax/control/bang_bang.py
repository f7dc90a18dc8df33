"""Nominal discrete sliding mode control: the switching is bang-bang (4.5.4.1)."""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp

from .._types import Scalar, State, as_array, check
from ..dynamics.arma import ARMA
from ..system import Observation, System
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


class BangBangState(NamedTuple):
    """Filter state, last reference, past outputs, and what holds a start at rest."""

    filter: State
    older_reference: Scalar
    outputs: tuple[Scalar, Scalar]
    bias: Scalar


class BangBangSlidingMode(System):
    """The traditional design with ``-gain * sign(s)`` in place of the PID of s.

    ``gain`` K in the unit of the output; all else as in ``SlidingModePID``, whose
    baseline this is: it chatters, and without an integral it keeps an offset. A start
    at rest away from zero therefore freezes, as a constant ``bias`` of the state, what
    that rest needs beyond the model's own feed-forward; from rest at zero it is zero.
    The slope of sign is taken as zero.

    Input an Observation, output in the unit of the model's input. Raises ValueError for
    K < 0, a model of another order, b_0 = 0, Q <= 0, R < 0 or an unknown inversion.
    """

    gain: Scalar = eqx.field(converter=as_array)
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
        check("gain K", self.gain, least=0.0)
        check("surface in 1/s", self.surface)

    def _inverse(self, v: Scalar, outputs: tuple[Scalar, Scalar]) -> Scalar:
        gain = INVERSIONS[self.inversion](
            self.model.moving[0], self.error_weight, self.control_weight
        )
        return inverted(self.model, gain, v, outputs)

    def init(self, input: Observation) -> BangBangState:
        reference = as_array(input.reference)
        outputs = (input.applied, input.applied)
        v = feedforward(self.model, reference, reference, reference)
        return BangBangState(
            filter=self.filter.init(input),
            older_reference=reference,
            outputs=outputs,
            bias=input.applied - self._inverse(v, outputs),
        )

    def step(
        self, state: BangBangState, input: Observation
    ) -> tuple[BangBangState, Scalar]:
        dt = self.filter.dt
        filter_state, motion = self.filter.step(state.filter, input)
        reference, older = input.reference, state.older_reference
        error = tracking_error(motion, reference, older, dt)
        s = self.surface * error.position + error.velocity
        v = (
            feedforward(self.model, input.next_reference, reference, older)
            + equivalent_control(self.model, self.surface, error, dt)
            - self.gain * jnp.sign(s)
        )
        f = self._inverse(v, state.outputs) + state.bias
        state = BangBangState(
            filter_state, reference, (f, state.outputs[0]), state.bias
        )
        return state, f
