"""Thermal drift of a stage."""

import jax.numpy as jnp

from ..core.arrays import Scalar, ScalarLike, as_array
from ..core.parameter import parameter, sample_time
from ..core.system import System


class ThermalDrift(System):
    """``y = expansion (T_stage - reference)``, where T_stage follows the room.

    The input is the room temperature T in degrees Celsius (or on another scale, shared
    with ``reference``), held between samples; the output is y in um. Combine stage and
    drift as ``(Select(0) >> stage) + (Select(1) >> drift)`` for an input (V, degrees).
    In a closed loop the drift is a disturbance in um. Raises ValueError for a time
    constant or sample time that is not positive.
    """

    expansion: Scalar = parameter("um/K", "thermal expansion")
    time_constant: Scalar = parameter(
        "s",
        "time constant with which the stage follows the room",
        above=0.0,
        scale="log",
        typical=(1.0, 1e5),
    )
    reference: Scalar = parameter("degC", "temperature without drift")
    dt: float = sample_time()

    def init(self, input: ScalarLike = 0.0) -> Scalar:
        """Return the state in which the stage has the temperature of the room."""
        return as_array(input)

    def step(self, state: Scalar, input: ScalarLike) -> tuple[Scalar, Scalar]:
        room = as_array(input)
        state = room + jnp.exp(-self.dt / self.time_constant) * (state - room)
        return state, self.expansion * (state - self.reference)
