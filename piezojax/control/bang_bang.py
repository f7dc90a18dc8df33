"""Bang-bang switching: the law of nominal sliding mode control (4.5.4.1)."""

import equinox as eqx
import jax.numpy as jnp

from ..core.arrays import Scalar, ScalarLike, State, as_array, check
from ..core.system import System


class BangBang(System):
    """``-gain * sign(s)``, the baseline of the sliding mode controllers: it chatters.

    The law of the nominal DSMC of section 4.5.4.1 for a ``SwitchedSlidingMode``: input
    s in um/s, output in the unit of v, as ``gain`` K. Without an integral an offset
    remains. The slope of sign is taken as zero. Raises ValueError for K < 0.
    """

    gain: Scalar = eqx.field(converter=as_array)

    def __check_init__(self):
        check("gain K", self.gain, least=0.0)

    def init(self, input: ScalarLike = 0.0) -> State:
        return ()

    def step(self, state: State, input: ScalarLike) -> tuple[State, Scalar]:
        return state, -self.gain * jnp.sign(as_array(input))
