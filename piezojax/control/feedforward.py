"""Inverse feedforward, alone and beside a feedback controller (section 2.5.3)."""

from typing import NamedTuple

from ..core.arrays import Scalar, State, as_array
from ..core.feedback import Observation
from ..core.system import System, rest_output


class FeedforwardState(NamedTuple):
    """State of the inverse, and the constant bias of its voltage in V."""

    inverse: State
    bias: Scalar


class InverseFeedforward(System):
    """``u(k) = inverse(r(k+1))``: open loop, Figure 2.8.

    ``inverse`` maps the wanted displacement in um to a voltage in V: an
    ``InverseColemanHodgdon``, or inverse dynamics in series with one. u(k) moves the
    stage to y(k+1), hence the next reference. The measurement is not used, so errors of
    the inverse remain. If the inverse at the start differs from the applied voltage,
    the difference is kept as a constant bias.
    """

    inverse: System

    def init(self, input: Observation) -> FeedforwardState:
        reference = as_array(input.reference)
        return FeedforwardState(
            self.inverse.init(reference),
            input.applied - rest_output(self.inverse, reference),
        )

    def step(
        self, state: FeedforwardState, input: Observation
    ) -> tuple[FeedforwardState, Scalar]:
        inverse, voltage = self.inverse.step(
            state.inverse, as_array(input.next_reference)
        )
        return FeedforwardState(inverse, state.bias), voltage + state.bias


class FeedforwardFeedbackState(NamedTuple):
    """States of both parts, and the last feedforward voltage."""

    inverse: State
    feedback: State
    forward: Scalar


class FeedforwardFeedback(System):
    """``u(k) = inverse(r(k+1)) + feedback``, Figure 2.9.

    ``inverse`` as in ``InverseFeedforward``; ``feedback`` is any controller from an
    Observation to V. It sees the applied voltage less the feedforward, so its start and
    its anti-windup stay correct. The inverse depends on the reference alone. Unlike in
    ``InversionControl`` the feedback does not act on it, so the gain of the stage's
    hysteresis stays in the feedback loop.
    """

    inverse: System
    feedback: System

    def init(self, input: Observation) -> FeedforwardFeedbackState:
        reference = as_array(input.reference)
        forward = rest_output(self.inverse, reference)
        observation = input._replace(applied=input.applied - forward)
        return FeedforwardFeedbackState(
            self.inverse.init(reference), self.feedback.init(observation), forward
        )

    def step(
        self, state: FeedforwardFeedbackState, input: Observation
    ) -> tuple[FeedforwardFeedbackState, Scalar]:
        inverse, forward = self.inverse.step(
            state.inverse, as_array(input.next_reference)
        )
        observation = input._replace(applied=input.applied - state.forward)
        feedback, voltage = self.feedback.step(state.feedback, observation)
        return FeedforwardFeedbackState(inverse, feedback, forward), forward + voltage
