"""Inversion-based control: an inverse hysteresis behind any controller."""

from typing import NamedTuple

from ..core.arrays import Scalar, State
from ..core.system import Observation, System, rest_output
from ..hysteresis.inverse import Inverse


class InversionState(NamedTuple):
    """State of the controller, and of the hysteresis model up to the last voltage."""

    feedback: State
    hysteresis: State


class InversionControl(System):
    """``feedback`` asks for a hysteresis output f, the inverse turns it into volts.

    Figure 5.1, (5.24)-(5.25). ``inverse`` is an InverseColemanHodgdon, or any other
    ``Inverse``. The model is advanced with the voltage that the actuator
    really applied, and ``feedback`` sees the model output for it in place of the
    voltage, so limits and anti-windup stay right. Input an Observation, output in V.
    """

    feedback: System
    inverse: Inverse

    def init(self, input: Observation) -> InversionState:
        hysteresis = self.inverse.model.init(input.applied)
        force = rest_output(self.inverse.model, input.applied)
        seen = input._replace(applied=force)
        return InversionState(self.feedback.init(seen), hysteresis)

    def step(
        self, state: InversionState, input: Observation
    ) -> tuple[InversionState, Scalar]:
        hysteresis, force = self.inverse.model.step(state.hysteresis, input.applied)
        seen = input._replace(applied=force)
        feedback, wanted = self.feedback.step(state.feedback, seen)
        voltage = self.inverse.solve(hysteresis, wanted)
        return InversionState(feedback, hysteresis), voltage
