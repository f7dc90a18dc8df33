"""Controller with its actuator: what runs on the hardware, from samples to voltages."""

from typing import Any, ClassVar, NamedTuple

from ..core.arrays import Signal, State
from ..core.feedback import Observation
from ..core.parameter import PartUnits
from ..core.system import System


class Seen(NamedTuple):
    """Input of a controller on its hardware at sample k, um.

    ``reference`` is r(k), ``next_reference`` r(k+1) and ``measured`` z(k).
    """

    reference: Signal
    next_reference: Signal
    measured: Signal


class DrivenState(NamedTuple):
    """States of controller and actuator, and the voltage applied last (V)."""

    controller: State
    actuator: State
    applied: Signal


class Driven(System):
    """A ``controller`` that receives the voltage of its ``actuator``, as in a Feedback.

    Its output is the voltage after the limits of the actuator, V.
    """

    part_units: ClassVar[PartUnits] = {"controller": {"u": "V"}}

    controller: System
    actuator: System

    def init(self, input: Any) -> DrivenState:
        """Return the state at rest under the Observation ``input``: a bumpless start.

        ``input.applied`` is the voltage that is applied at that moment.
        """
        controller = self.controller.init(input)
        return DrivenState(controller, self.actuator.init(input.applied), input.applied)

    def step(self, state: DrivenState, input: Seen) -> tuple[DrivenState, Signal]:
        seen = Observation(*input, applied=state.applied)
        controller, command = self.controller.step(state.controller, seen)
        actuator, voltage = self.actuator.step(state.actuator, command)
        return DrivenState(controller, actuator, voltage), voltage
