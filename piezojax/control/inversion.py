"""Inversion-based control: an inverse hysteresis behind any controller."""

from typing import Any, NamedTuple

from ..core.arrays import Scalar, ScalarLike, State, as_array, check_not_zero
from ..core.system import Affine, Observation, System, rest_output
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


class InverseGain(Inverse):
    """Voltage of a plant without hysteresis: the inverse of a gain.

    ``model`` maps V to um. Raises ValueError for a gain of 0.
    """

    model: Affine

    def __check_init__(self):
        check_not_zero("gain in um/V", self.model.gain)

    def init(self, input: ScalarLike = 0.0) -> State:
        return self.model.init(input)

    def solve(self, state: Any, wanted: ScalarLike) -> Scalar:
        """Return the voltage (V) for which the model's output is ``wanted``."""
        del state
        return (as_array(wanted) - self.model.offset) / self.model.gain
