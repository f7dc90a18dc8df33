"""Controller whose reference has a limited slew, so that a jump becomes a ramp."""

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
    """``controller`` with a reference that changes by at most ``slew`` per second.

    A feedforward excites the modes of a stage if the reference jumps. The controller
    sees jumps as ramps, and references slower than ``slew`` as they are. Errors of a
    loop count from the reference before this limit. One axis; input an Observation,
    output that of ``controller``.
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
