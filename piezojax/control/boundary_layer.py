"""Boundary layer: a saturation in place of the sign of sliding mode control."""

import equinox as eqx
import jax.numpy as jnp

from ..core.arrays import Scalar, ScalarLike, State, as_array, check
from ..core.system import System


class BoundaryLayer(System):
    """``-gain * sat(s / width)``: proportional within the layer, ``gain`` outside.

    The law of section 2.6.1.2, reference [94] there, for a ``SwitchedSlidingMode``:
    input s in um/s, output in the unit of v. ``gain`` K in that unit, ``width`` of the
    layer in um/s; a width near zero is bang-bang switching. There is no integral, so an
    offset remains that is the smaller the steeper the layer. Its slope is
    -gain / width inside, zero outside and between the two on the edge. Raises
    ValueError for K < 0 or a width that is not positive.
    """

    gain: Scalar = eqx.field(converter=as_array)
    width: Scalar = eqx.field(converter=as_array)

    def __check_init__(self):
        check("gain K", self.gain, least=0.0)
        check("width of the layer in um/s", self.width, above=0.0)

    def init(self, input: ScalarLike = 0.0) -> State:
        return ()

    def step(self, state: State, input: ScalarLike) -> tuple[State, Scalar]:
        return state, -self.gain * jnp.clip(input / self.width, -1.0, 1.0)
