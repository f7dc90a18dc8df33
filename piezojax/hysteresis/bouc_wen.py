"""Bouc-Wen hysteresis of a restoring force over a displacement."""

from typing import ClassVar, NamedTuple

import jax.numpy as jnp

from ..core.arrays import Scalar, ScalarLike, as_array
from ..core.parameter import parameter
from ..core.runge_kutta import parts_of_a_step, runge_kutta
from .inverse import Inverse, InverseHysteresis
from .model import Hysteresis, Laws, differential_laws


class BoucWenState(NamedTuple):
    """Last displacement (m) and the force there (N)."""

    displacement: Scalar
    force: Scalar


class BoucWen(Hysteresis):
    """Rate-independent force z of a displacement y, in any consistent units (m, N).

    ``z' = alpha y' - beta_gamma |y'| |z|^(nu - 1) z - beta_delta y' |z|^nu``

    Of the usual factors beta, gamma and delta, only the products beta gamma and beta
    delta act on the force. A step is integrated in ``substeps`` parts, of fourth order
    unless y' or z changes sign within the part. It is accurate if
    ``nu (|beta_gamma| + |beta_delta|) |z|^(nu - 1)`` times the displacement in a part
    is well below 1. Sources: Bouc 1967, Wen 1976.

    Loops close only in the limit of many cycles: there is no return-point memory, no
    wiping-out and no congruency, and the force drifts under repeated partial unloading.
    Its loops run clockwise, as for a dissipating force over a displacement; those of
    the displacement of a piezo over its voltage run counter-clockwise. The inverse is
    InverseHysteresis. It holds for forces below the one at which z' = 0; no
    displacement produces a larger force.

    Raises ValueError for parameters outside their limits.
    """

    laws: ClassVar[Laws] = differential_laws(without=("counter-clockwise",))

    alpha: Scalar = parameter("N/m", "slope from z = 0")
    beta_gamma: Scalar = parameter("N^(1 - nu)/m", "coefficient of |y'| |z|^(nu - 1) z")
    beta_delta: Scalar = parameter("N^(1 - nu)/m", "coefficient of y' |z|^nu")
    nu: Scalar = parameter("1", "sharpness of the bend", above=0.0, default=1.0)
    substeps: int = parts_of_a_step()

    def rate(self, force: Scalar, velocity: Scalar) -> Scalar:
        """Return z' at force z and velocity y', or dz for a step dy of a path."""
        # At z = 0, |z|^nu has no derivative with respect to nu, nor to z if nu < 1.
        loaded = force != 0.0
        power = jnp.where(
            loaded, jnp.abs(jnp.where(loaded, force, 1.0)) ** self.nu, 0.0
        )
        bend = self.beta_gamma * jnp.abs(velocity) * jnp.sign(force)
        return self.alpha * velocity - (bend + self.beta_delta * velocity) * power

    def init(self, input: ScalarLike = 0.0) -> BoucWenState:
        """Return the state without force at the displacement ``input`` (m)."""
        return BoucWenState(as_array(input), jnp.zeros(()))

    def inverse(self, lower: ScalarLike, upper: ScalarLike) -> Inverse:
        return InverseHysteresis(self, lower, upper)

    def step(
        self, state: BoucWenState, input: ScalarLike
    ) -> tuple[BoucWenState, Scalar]:
        input = as_array(input)
        change = input - state.displacement
        (force,) = runge_kutta(
            lambda point: (self.rate(point[0], change),),
            (state.force,),
            1.0,
            self.substeps,
        )
        return BoucWenState(input, force), force
