"""Inversion-based control: an inverse hysteresis in series with a controller."""

from typing import Any, ClassVar, NamedTuple

from ..core.arrays import Scalar, ScalarLike, State, as_array, check_not_zero
from ..core.feedback import Observation
from ..core.parameter import PartUnits
from ..core.system import Affine, System, rest_output
from ..hysteresis.inverse import Inverse


class InversionState(NamedTuple):
    """States of the controller and of the hysteresis model."""

    feedback: State
    hysteresis: State


class InversionControl(System):
    """``feedback`` commands a hysteresis output f, which ``inverse`` turns into volts.

    Figure 5.1, (5.24)-(5.25). ``inverse`` is an InverseColemanHodgdon, or any other
    ``Inverse``. Its hysteresis model is advanced with the applied voltage, and
    ``feedback`` sees the output of the model, in um, in place of the voltage, so limits
    and anti-windup stay correct. Input an Observation, output in V.
    """

    part_units: ClassVar[PartUnits] = {"feedback": {"u": "um"}}

    feedback: System
    inverse: Inverse

    def init(self, input: Observation) -> InversionState:
        hysteresis = self.inverse.model.init(input.applied)
        applied_f = rest_output(self.inverse.model, input.applied)
        observation = input._replace(applied=applied_f)
        return InversionState(self.feedback.init(observation), hysteresis)

    def step(
        self, state: InversionState, input: Observation
    ) -> tuple[InversionState, Scalar]:
        hysteresis, applied_f = self.inverse.model.step(state.hysteresis, input.applied)
        observation = input._replace(applied=applied_f)
        feedback, wanted = self.feedback.step(state.feedback, observation)
        voltage = self.inverse.solve(hysteresis, wanted)
        return InversionState(feedback, hysteresis), voltage


class InverseGain(Inverse):
    """Inverse of a gain, for a plant without hysteresis.

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
