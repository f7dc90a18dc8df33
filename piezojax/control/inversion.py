"""Inversion-based control: an inverse hysteresis behind any controller."""

from typing import NamedTuple

from .._types import Scalar, State
from ..hysteresis.inverse import InverseHysteresis
from ..system import Observation, System, rest_output


class InversionState(NamedTuple):
    """State of the controller, and of the hysteresis model up to the last voltage."""

    feedback: State
    hysteresis: State


class InversionControl(System):
    """``feedback`` asks for a hysteresis output f, the inverse turns it into volts.

    Figure 5.1, (5.24)-(5.25). The model is advanced with the voltage that the actuator
    really applied, and ``feedback`` sees the model output for it in place of the
    voltage, so limits and anti-windup stay right. Input an Observation, output in V.
    """

    feedback: System
    inverse: InverseHysteresis

    def init(self, input: Observation) -> InversionState:
        model = self.inverse.model
        seen = input._replace(applied=rest_output(model, input.applied))
        hysteresis = model.init(input.applied)
        return InversionState(self.feedback.init(seen), hysteresis)

    def step(
        self, state: InversionState, input: Observation
    ) -> tuple[InversionState, Scalar]:
        hysteresis, force = self.inverse.model.step(state.hysteresis, input.applied)
        seen = input._replace(applied=force)
        feedback, wanted = self.feedback.step(state.feedback, seen)
        voltage = self.inverse.solve(hysteresis, wanted)
        return InversionState(feedback, hysteresis), voltage
