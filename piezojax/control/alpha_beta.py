"""Alpha-beta filter: displacement and velocity from a noisy measurement."""

import equinox as eqx
import jax.numpy as jnp

from ..core.arrays import Scalar, as_array, check
from ..core.system import Observation
from .observer import Motion, Observer


class AlphaBeta(Observer):
    """Fixed-gain observer of position and velocity (section 4.5.4.1).

    Of an Observation only z(k) in um is looked at; output a Motion. ``alpha`` in (0, 1]
    corrects the position, ``beta`` in (0, 2) the velocity, both without unit; ``dt`` in
    s. A ramp is followed without lag only as fast as ``beta`` lets the velocity in;
    until then the position lags by (1 - alpha) / alpha samples.
    """

    alpha: Scalar = eqx.field(converter=as_array)
    beta: Scalar = eqx.field(converter=as_array)
    dt: float = eqx.field(static=True)

    def __check_init__(self):
        check("alpha", self.alpha, above=0.0, most=1.0)
        check("beta", self.beta, least=0.0, below=2.0)
        check("sample time in s", self.dt, above=0.0)

    def init(self, input: Observation) -> Motion:
        position = as_array(input.measured)
        return Motion(position, jnp.zeros_like(position))

    def step(self, state: Motion, input: Observation) -> tuple[Motion, Motion]:
        predicted = state.position + self.dt * state.velocity
        residual = input.measured - predicted
        motion = Motion(
            predicted + self.alpha * residual,
            state.velocity + (self.beta / self.dt) * residual,
        )
        return motion, motion
