"""Drift of a stage with its temperature."""

import jax.numpy as jnp

from ..core.arrays import Scalar, ScalarLike, as_array
from ..core.parameter import parameter, sample_time
from ..core.system import System


class ThermalDrift(System):
    """``y = expansion (T_stage - reference)``, where T_stage follows the room's T.

    Input T in degrees Celsius (or any other scale of which ``reference`` is part),
    output y in um; T is held between samples. Beside a stage the two read their own of
    a pair (V, degrees), ``Select(0) >> stage`` plus ``Select(1) >> drift``; in a closed
    loop the drift is a disturbance in um. Raises ValueError for a time constant or
    sample time that is not positive.
    """

    expansion: Scalar = parameter("um/K", "thermal expansion")
    time_constant: Scalar = parameter(
        "s",
        "time the stage takes to follow the room",
        above=0.0,
        scale="log",
        typical=(1.0, 1e5),
    )
    reference: Scalar = parameter("degC", "temperature without drift")
    dt: float = sample_time()

    def init(self, input: ScalarLike = 0.0) -> Scalar:
        """Return the stage as warm as the room."""
        return as_array(input)

    def step(self, state: Scalar, input: ScalarLike) -> tuple[Scalar, Scalar]:
        room = as_array(input)
        state = room + jnp.exp(-self.dt / self.time_constant) * (state - room)
        return state, self.expansion * (state - self.reference)
