"""Alpha-beta filter: displacement and velocity from a noisy measurement."""

import jax.numpy as jnp

from ..core.arrays import Scalar, as_array
from ..core.feedback import Observation
from ..core.parameter import parameter, sample_time
from .observer import Motion, Observer


class AlphaBeta(Observer):
    """Fixed-gain observer of position and velocity (section 4.5.4.1).

    Input an Observation, of which only z(k) in um is used; output a Motion. The
    position follows a ramp without lag once ``beta`` has corrected the velocity; until
    then it lags by (1 - alpha) / alpha samples.
    """

    alpha: Scalar = parameter(
        "1",
        "share of the residual that corrects the position",
        above=0.0,
        most=1.0,
        scale="logit",
        typical=(0.02, 0.999),
    )
    beta: Scalar = parameter(
        "1",
        "share of the residual that corrects the velocity",
        least=0.0,
        below=2.0,
        scale="log",
        typical=(1e-9, 0.9),
    )
    dt: float = sample_time()

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
