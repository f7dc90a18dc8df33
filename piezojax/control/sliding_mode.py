"""Output-tracking sliding mode control with any switching law (chapters 4 and 5)."""

from typing import ClassVar, NamedTuple

import equinox as eqx
import jax.numpy as jnp

from ..core.arrays import Scalar, State, as_array, check_not_zero
from ..core.feedback import Observation
from ..core.parameter import PartUnits, parameter
from ..core.system import System
from ..dynamics.arma import ARMA
from .observer import Observer
from .output_tracking import (
    Row,
    check_has_poles,
    check_inversion,
    derivatives,
    equivalent_control,
    feedforward,
    inversion_gain,
    inverted,
    sliding,
)
from .switching import SwitchingLaw


class SlidingModeState(NamedTuple):
    """States of filter and law, and histories, newest first.

    ``references`` r(k-1), r(k-2), ... in um, ``velocities`` de/dt at k-1, k-2, ... in
    um/s and ``outputs`` f(k-1), f(k-2), ...
    """

    filter: State
    law: State
    references: Row
    velocities: Row
    outputs: Row


class SlidingMode(System):
    """Output-tracking sliding mode control on a model of any order n.

    The observer ``filter`` estimates y and dy/dt; higher derivatives of the error
    e = y - r are backward differences of de/dt (5.3)-(5.6). The sliding variable is
    ``s = surface^(2-n) (surface + d/dt)^(n-1) e`` in um/s (5.15), for n = 2
    ``surface e + de/dt``. The equivalent control and the reference part v1 come from
    ``model`` (a_1, ..., a_n | b_0, ..., b_0 not zero), the switching part from ``law``:
    a ``SwitchingPID`` (5.18), ``BangBang``, ``BoundaryLayer`` or ``SuperTwisting``. The
    zeros of the model, which may lie outside the unit circle, are inverted in the
    least-squares sense: f = Q/(Q+R) [v - (b_1/b_0) f(k-1) - ...] (5.23), or in another
    form ``inversion`` of ``INVERSIONS``. ``correction`` weighs the equivalent control:
    a smaller one weakens the feedback, not the reference part.

    Input an Observation; output f in the unit of the model's input: V if the model was
    identified from voltage, um ahead of an inverse hysteresis or in a disturbance
    observer with its own gain. The switching part v has that unit.

    Raises ValueError for a model without a_1, b_0 = 0, a surface of 0 unless n = 2, or
    an unknown inversion.
    """

    part_units: ClassVar[PartUnits] = {"law": {"s": "um/s", "v": "[u]"}}

    law: SwitchingLaw
    model: ARMA
    filter: Observer
    surface: Scalar = parameter(
        "1/s", "slope m of the sliding surface", scale="log", typical=(10.0, 1e5)
    )
    error_weight: Scalar = parameter(
        "1", "weight Q of the inversion; only Q / R counts", above=0.0, scale="log"
    )
    control_weight: Scalar = parameter(
        "1", "weight R of the inversion", least=0.0, scale="log", typical=(1e-4, 1e3)
    )
    inversion: str = eqx.field(static=True, default="printed")
    correction: Scalar = parameter(
        "1", "weight of the equivalent control", typical=(0.0, 1.2), default=1.0
    )

    def __check_init__(self):
        check_has_poles(self.model)
        if len(self.model.autoregressive) != 2:
            check_not_zero("surface", self.surface)
        check_inversion(self.inversion, self.model)

    @property
    def dt(self) -> float:
        """Sample time, s."""
        return self.filter.dt

    def _inversion_gain(self) -> Scalar:
        return inversion_gain(
            self.inversion, self.model, self.error_weight, self.control_weight
        )

    def init(self, input: Observation) -> SlidingModeState:
        reference, applied = as_array(input.reference), as_array(input.applied)
        order, (b0, *later) = len(self.model.autoregressive), self.model.moving
        # At rest s = 0: the law holds the part that the feedforward does not give.
        needed = applied * (1.0 / self._inversion_gain() + sum(later)) / b0
        held = needed - feedforward(self.model, reference, (reference,) * order)
        return SlidingModeState(
            filter=self.filter.init(input),
            law=self.law.start(as_array(0.0), held),
            references=(reference,) * max(order - 1, 1),
            velocities=(jnp.zeros_like(reference),) * max(order - 2, 0),
            outputs=(applied,) * max(len(later), 1),
        )

    def step(
        self, state: SlidingModeState, input: Observation
    ) -> tuple[SlidingModeState, Scalar]:
        order, dt = len(self.model.autoregressive), self.dt
        gain = self._inversion_gain()
        filter_state, motion = self.filter.step(state.filter, input)
        references = (as_array(input.reference), *state.references)
        error = motion.position - references[0]
        slope = motion.velocity - (references[0] - references[1]) / dt
        velocities = (slope, *state.velocities)[: order - 1]
        s = sliding(self.surface, derivatives(error, velocities, dt))
        shortfall = input.applied - state.outputs[0]
        per_output = 1.0 / (gain * self.model.moving[0])
        driven = self.law.driven(state.law, per_output * shortfall)
        law, switching = self.law.step(driven, s)
        v = (
            feedforward(self.model, input.next_reference, references)
            + self.correction
            * equivalent_control(self.model, self.surface, error, velocities, dt)
            + switching
        )
        f = inverted(self.model, gain, v, state.outputs)
        return SlidingModeState(
            filter_state,
            law,
            references[: len(state.references)],
            velocities[: len(state.velocities)],
            (f, *state.outputs[:-1]),
        ), f


class ContinuousSlidingModeState(NamedTuple):
    """States of filter and law, the last reference in um and voltage in V."""

    filter: State
    law: State
    older_reference: Scalar
    voltage: Scalar


class ContinuousSlidingMode(System):
    """Sampled continuous design without a model: ``u = law(s)``.

    The sliding variable is s = ``surface`` e + de/dt in um/s with e = y - r, where y
    and dy/dt come from ``filter``. Section 4.5.4.3 compares with this controller
    (reference [98] there); the thesis prints its gains but no equation. Input an
    Observation, output in V.
    """

    part_units: ClassVar[PartUnits] = {"law": {"s": "um/s", "v": "[u]"}}

    law: SwitchingLaw
    filter: Observer
    surface: Scalar = parameter(
        "1/s", "slope m of the sliding surface", scale="log", typical=(10.0, 1e5)
    )

    def init(self, input: Observation) -> ContinuousSlidingModeState:
        return ContinuousSlidingModeState(
            filter=self.filter.init(input),
            law=self.law.start(as_array(0.0), as_array(input.applied)),
            older_reference=as_array(input.reference),
            voltage=as_array(input.applied),
        )

    def step(
        self, state: ContinuousSlidingModeState, input: Observation
    ) -> tuple[ContinuousSlidingModeState, Scalar]:
        filter_state, motion = self.filter.step(state.filter, input)
        reference = as_array(input.reference)
        moved = (reference - state.older_reference) / self.filter.dt
        s = self.surface * (motion.position - reference) + motion.velocity - moved
        driven = self.law.driven(state.law, input.applied - state.voltage)
        law, voltage = self.law.step(driven, s)
        state = ContinuousSlidingModeState(filter_state, law, reference, voltage)
        return state, voltage
