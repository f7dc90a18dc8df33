"""Super-twisting law: second-order sliding mode, its output continuous."""

import equinox as eqx
import jax.numpy as jnp

from ..core.arrays import Scalar, ScalarLike, as_array, check
from ..core.system import System


class SuperTwisting(System):
    """``v = w - root_gain |s|^(1/2) sign(s)``, ``dw/dt = -sign_gain sign(s)``, smooth.

    The second-order sliding mode that needs s alone (A. Levant, Int. J. Control 58,
    1993; the high-order designs of section 2.6.1.2), for a ``SwitchedSlidingMode``:
    input s in um/s, output in the unit of v, here V. ``root_gain`` in V/(um/s)^(1/2),
    ``sign_gain`` in V/s, ``dt`` in s.

    Sampled, the sign chatters by ``sign_gain * dt`` about s = 0, and the root's slope
    is infinite there. Both are therefore smoothed over the ``layer`` d in um/s:
    s / (s^2 + d^2)^(1/4) and s / (s^2 + d^2)^(1/2), which far outside are the root and
    the sign, and inside a proportional-integral law of s. At rest, s = 0, the law stays
    where it is. Raises ValueError for a negative gain, d <= 0 or ``dt <= 0``.
    """

    root_gain: Scalar = eqx.field(converter=as_array)
    sign_gain: Scalar = eqx.field(converter=as_array)
    layer: Scalar = eqx.field(converter=as_array)
    dt: float = eqx.field(static=True)

    def __check_init__(self):
        check("sample time in s", self.dt, above=0.0)
        check("root gain in V/(um/s)^(1/2)", self.root_gain, least=0.0)
        check("sign gain in V/s", self.sign_gain, least=0.0)
        check("layer in um/s", self.layer, above=0.0)

    def init(self, input: ScalarLike = 0.0) -> Scalar:
        """Return w = 0 V; only s = 0 is a rest, whatever ``input`` is."""
        return jnp.zeros_like(as_array(input))

    def step(self, state: Scalar, input: ScalarLike) -> tuple[Scalar, Scalar]:
        distance = jnp.sqrt(input**2 + self.layer**2)
        integral = state - self.sign_gain * self.dt * input / distance
        return integral, integral - self.root_gain * input / jnp.sqrt(distance)
