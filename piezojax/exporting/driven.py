"""Controller with its actuator, as on the hardware: from samples to voltages."""

from typing import Any, ClassVar, NamedTuple

from ..core.arrays import Signal, State
from ..core.feedback import Observation
from ..core.parameter import PartUnits
from ..core.system import System


class Seen(NamedTuple):
    """Input of an exported controller at sample k, in the units of the axes.

    ``reference`` is r(k), ``next_reference`` r(k+1) and ``measured`` z(k). Each is a
    scalar, or a tuple of one scalar per axis.
    """

    reference: Signal
    next_reference: Signal
    measured: Signal


class DrivenState(NamedTuple):
    """States of controller and actuator, and the last applied voltage (V)."""

    controller: State
    actuator: State
    applied: Signal


class Driven(System):
    """A ``controller`` with its ``actuator``, whose voltage is fed back to it.

    The controller receives the last applied voltage, as in a Feedback. The output is
    the voltage of the actuator (V), after its limits.
    """

    part_units: ClassVar[PartUnits] = {
        "controller": {"u": "V"},
        "actuator": {"input": "V"},
    }

    controller: System
    actuator: System

    def init(self, input: Any) -> DrivenState:
        """Return the state at rest under the Observation ``input``: a bumpless start.

        ``input.applied`` is the voltage (V) that is applied at the start.
        """
        controller = self.controller.init(input)
        return DrivenState(controller, self.actuator.init(input.applied), input.applied)

    def step(self, state: DrivenState, input: Seen) -> tuple[DrivenState, Signal]:
        seen = Observation(*input, applied=state.applied)
        controller, command = self.controller.step(state.controller, seen)
        actuator, voltage = self.actuator.step(state.actuator, command)
        return DrivenState(controller, actuator, voltage), voltage
