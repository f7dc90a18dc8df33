"""Initial states of a hysteresis from its loading curve."""

from typing import Any

import jax

from ..core.arrays import Scalar, State
from ..core.system import System

PARTS = 64


def load_to(system: System, state: Any, input: Scalar) -> State:
    """Return ``state`` after its input has moved to ``input`` in 64 equal steps.

    ``state`` has the field ``input``, the last input.
    """
    start = state.input

    def part(number, state):
        return system.step(state, start + number / PARTS * (input - start))[0]

    state = jax.lax.fori_loop(1, PARTS + 1, part, state)
    return state._replace(input=input)  # exact, so that a step at rest has no change
