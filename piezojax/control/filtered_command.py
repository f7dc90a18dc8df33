"""Controller whose command passes a filter, such as a notch."""

from typing import NamedTuple

from ..core.arrays import Scalar, State, as_array
from ..core.feedback import Observation
from ..core.system import System


class FilteredCommandState(NamedTuple):
    """States of the controller and the filter, and their last outputs."""

    controller: State
    filter: State
    command: Scalar
    filtered: Scalar


class FilteredCommand(System):
    """``controller`` with its command filtered by ``filter``, of unit DC gain.

    ``filter`` may be a series of filters. As its applied voltage the controller sees
    its own last command plus the amount by which the actuator changed the filtered
    command, so that its anti-windup responds to the limits and not to the filter. In
    ``InversionControl`` or ``FeedforwardFeedback`` the filter acts on the feedback
    alone. Input an Observation, output in the unit of the controller's command.
    """

    controller: System
    filter: System

    def init(self, input: Observation) -> FilteredCommandState:
        applied = as_array(input.applied)
        return FilteredCommandState(
            self.controller.init(input), self.filter.init(applied), applied, applied
        )

    def step(
        self, state: FilteredCommandState, input: Observation
    ) -> tuple[FilteredCommandState, Scalar]:
        applied = state.command + (input.applied - state.filtered)
        controller, command = self.controller.step(
            state.controller, input._replace(applied=applied)
        )
        filter_state, filtered = self.filter.step(state.filter, command)
        return (
            FilteredCommandState(controller, filter_state, command, filtered),
            filtered,
        )
