"""Controller with a limited slew and acceleration of its reference."""

from typing import NamedTuple

import jax.numpy as jnp

from ..core.arrays import Scalar, State, as_array
from ..core.feedback import Observation
from ..core.parameter import parameter, sample_time
from ..core.system import System

UNLIMITED = 1e12
"""Acceleration (um/s^2) that no reference needs."""


class LimitedReferenceState(NamedTuple):
    """State of the controller, and the limited reference r(k) and r(k) - r(k-1), um."""

    controller: State
    reference: Scalar
    change: Scalar


class LimitedReference(System):
    """A ``controller`` whose reference has at most ``slew`` and ``acceleration``.

    If a reference jumps, a feedforward excites the modes of the stage. The controller
    therefore sees the motion that reaches the reference, with its slew, in the fewest
    samples within the two limits, and without overshoot (compare Zanasi, Guarino Lo
    Bianco and Tonielli, Automatica 36, 2000). It starts at rest at the reference. A
    reference within the limits then passes unchanged. The tracking error of a loop
    still refers to the reference without these limits. For one axis. The input is an
    Observation, the output that of ``controller``.
    """

    controller: System
    slew: Scalar = parameter(
        "um/s", "limit of the slew of the reference", above=0.0, scale="log"
    )
    dt: float = sample_time()
    acceleration: Scalar = parameter(
        "um/s^2",
        "limit of the acceleration of the reference, by default none",
        above=0.0,
        scale="log",
        default=UNLIMITED,
    )

    def init(self, input: Observation) -> LimitedReferenceState:
        reference = as_array(input.reference)
        return LimitedReferenceState(
            self.controller.init(input), reference, jnp.zeros_like(reference)
        )

    def step(
        self, state: LimitedReferenceState, input: Observation
    ) -> tuple[LimitedReferenceState, Scalar]:
        fastest = self.slew * self.dt
        # A change of 2 fastest in one sample turns the fastest motion around.
        most = jnp.minimum(self.acceleration * self.dt**2, 2.0 * fastest)
        target = input.next_reference
        speed = jnp.clip(target - input.reference, -fastest, fastest)
        left = target - speed - state.reference
        # Changes of c, c - most, c - 2 most, ... cover the distance in this many steps.
        distance = jnp.abs(left)
        steps = jnp.maximum(
            jnp.ceil(0.5 * (jnp.sqrt(1.0 + 8.0 * distance / most) - 1.0)), 1.0
        )
        closing = distance / steps + 0.5 * most * (steps - 1.0)
        wanted = jnp.clip(speed + jnp.sign(left) * closing, -fastest, fastest)
        change = jnp.clip(wanted, state.change - most, state.change + most)
        following = state.reference + change
        seen = input._replace(reference=state.reference, next_reference=following)
        controller, command = self.controller.step(state.controller, seen)
        return LimitedReferenceState(controller, following, change), command
