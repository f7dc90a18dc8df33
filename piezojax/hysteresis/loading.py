"""Moving a hysteresis along its loading curve, before the loop over time begins."""

from typing import Any

import jax
import jax.numpy as jnp

from ..core.arrays import Scalar, State
from ..core.system import System

PARTS = 64


def loaded(system: System, state: Any, input: Scalar) -> State:
    """Return ``state`` after its input moved steadily to ``input``, in 64 steps.

    ``state`` has the field ``input``, the last one.
    """
    start = state.input

    def part(state, share):
        return system.step(state, start + share * (input - start))[0], None

    shares = jnp.arange(1, PARTS + 1) / PARTS
    state, _ = jax.lax.scan(part, state, shares)
    return state._replace(input=input)  # not off by rounding: a rest moves nothing
