"""Drift of a stage with its temperature."""

import equinox as eqx
import jax.numpy as jnp

from ..core.arrays import Scalar, ScalarLike, as_array, check
from ..core.system import System


class ThermalDrift(System):
    """``y = expansion (T_stage - reference)``, where T_stage follows the room's T.

    Input T in degrees Celsius (or any other scale of which ``reference`` is part),
    output y in um; ``expansion`` in um/K, ``time_constant`` in s: how slowly the stage
    takes the temperature of the room; ``dt`` in s, T held between samples. Beside a
    stage the two read their own of a pair (V, degrees), ``Select(0) >> stage`` plus
    ``Select(1) >> drift``; in a closed loop what it gives is a disturbance in um.
    Raises ValueError for a time constant or sample time that is not positive.
    """

    expansion: Scalar = eqx.field(converter=as_array)
    time_constant: Scalar = eqx.field(converter=as_array)
    reference: Scalar = eqx.field(converter=as_array)
    dt: float = eqx.field(static=True)

    def __check_init__(self):
        check("expansion in um/K", self.expansion)
        check("time constant in s", self.time_constant, above=0.0)
        check("reference temperature", self.reference)
        check("sample time in s", self.dt, above=0.0)

    def init(self, input: ScalarLike = 0.0) -> Scalar:
        """Return the stage as warm as the room."""
        return as_array(input)

    def step(self, state: Scalar, input: ScalarLike) -> tuple[Scalar, Scalar]:
        room = as_array(input)
        state = room + jnp.exp(-self.dt / self.time_constant) * (state - room)
        return state, self.expansion * (state - self.reference)
