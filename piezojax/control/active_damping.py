"""Active damping: a filtered measurement is added to the command of a controller."""

from typing import NamedTuple

from ..core.arrays import Scalar, State, as_array
from ..core.feedback import Observation
from ..core.parameter import parameter
from ..core.system import System


class ActiveDampingState(NamedTuple):
    """States of the controller and the filter, and the last damping command, [u]."""

    controller: State
    filter: State
    damping: Scalar


class ActiveDamping(System):
    """``u = controller + gain filter(z)``: an inner loop that damps a resonance.

    The filter and the sign of the gain determine the scheme:

    - positive position feedback: ``SecondOrderLowPass`` near the resonance and a gain
      above 0 (Fanson and Caughey, AIAA J. 28, 1990);
    - integral resonant control: ``LowPass`` of order 1 and a gain above 0, the form
      without feedthrough (Fleming, Aphale and Moheimani, IEEE Trans. Nanotechnol.
      9, 2010);
    - resonant shift: ``Affine(1.0)`` and a gain below 0, which stiffens the stage.

    With a gain above 0 and a filter of unit DC gain, the damped stage is stable only if
    the product of this gain and the static gain of the stage is below 1. The controller
    receives the applied voltage less the damping command, so that its anti-windup
    responds to the limits. Input an Observation, output in the unit of the controller's
    command.
    """

    controller: System
    filter: System
    gain: Scalar = parameter("[u]/um", "gain of the damping", typical=(-10.0, 10.0))

    def init(self, input: Observation) -> ActiveDampingState:
        filter_state = self.filter.init(input.measured)
        damping = self.gain * self.filter.step(filter_state, input.measured)[1]
        own = input._replace(applied=input.applied - damping)
        return ActiveDampingState(
            self.controller.init(own), filter_state, as_array(damping)
        )

    def step(
        self, state: ActiveDampingState, input: Observation
    ) -> tuple[ActiveDampingState, Scalar]:
        own = input._replace(applied=input.applied - state.damping)
        controller, command = self.controller.step(state.controller, own)
        filter_state, filtered = self.filter.step(state.filter, input.measured)
        damping = self.gain * filtered
        return ActiveDampingState(controller, filter_state, damping), command + damping
