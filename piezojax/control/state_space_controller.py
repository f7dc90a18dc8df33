"""Linear controller in state-space form, from the error to the command."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from ..core.arrays import Scalar
from ..core.feedback import Observation
from ..core.system import System
from ..dynamics.state_space import StateSpace


class LinearState(NamedTuple):
    """State x of the law, and the command at zero error, in the command's unit."""

    law: Float[Array, " n"]
    bias: Scalar


class StateSpaceController(System):
    """``u = bias + law(r - z)`` with any linear ``law`` of one input and one output.

    The law acts on the error in um. Its state starts at zero, and ``bias`` is the
    applied command at the start less the direct part of the law, so the command does
    not jump at the start, even with an integrator in the law. There is no anti-windup.
    Input an Observation, output in the unit of the law's output. Raises ValueError for
    a law of several inputs or outputs.
    """

    law: StateSpace

    def __check_init__(self):
        sizes = self.law.D.shape
        if sizes != (1, 1):
            raise ValueError(
                f"the law has {sizes[1]} inputs and {sizes[0]} outputs; it must have "
                "1 and 1"
            )

    def init(self, input: Observation) -> LinearState:
        error = input.reference - input.measured
        return LinearState(
            law=jnp.zeros(self.law.order),
            bias=input.applied - self.law.D[0, 0] * error,
        )

    def step(
        self, state: LinearState, input: Observation
    ) -> tuple[LinearState, Scalar]:
        error = input.reference - input.measured
        law, output = self.law.step(state.law, error[None])
        return LinearState(law, state.bias), state.bias + output[0]
