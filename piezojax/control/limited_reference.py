"""Controller with a limited slew of its reference: a jump becomes a ramp."""

from typing import NamedTuple

import jax.numpy as jnp

from ..core.arrays import Scalar, State, as_array
from ..core.feedback import Observation
from ..core.parameter import parameter, sample_time
from ..core.system import System


class LimitedReferenceState(NamedTuple):
    """State of the controller, and the limited reference r(k) in um."""

    controller: State
    reference: Scalar


class LimitedReference(System):
    """A ``controller`` whose reference changes by at most ``slew`` per second.

    If a reference jumps, a feedforward excites the modes of the stage. The controller
    therefore sees a jump as a ramp; references slower than ``slew`` pass unchanged. The
    tracking error of a loop still refers to the reference without this limit. For one
    axis. The input is an Observation, the output that of ``controller``.
    """

    controller: System
    slew: Scalar = parameter(
        "um/s", "limit of the slew of the reference", above=0.0, scale="log"
    )
    dt: float = sample_time()

    def init(self, input: Observation) -> LimitedReferenceState:
        return LimitedReferenceState(
            self.controller.init(input), as_array(input.reference)
        )

    def step(
        self, state: LimitedReferenceState, input: Observation
    ) -> tuple[LimitedReferenceState, Scalar]:
        most = self.slew * self.dt
        change = jnp.clip(input.next_reference - state.reference, -most, most)
        following = state.reference + change
        seen = input._replace(reference=state.reference, next_reference=following)
        controller, command = self.controller.step(state.controller, seen)
        return LimitedReferenceState(controller, following), command
