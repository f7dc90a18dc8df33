"""What lies between a controller and its stage: limits, converters, the sensor."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from ._types import Scalar, ScalarLike, State, as_array, check, check_order
from .system import System


class Saturation(System):
    """Clips its input to ``[lower, upper]``, V."""

    lower: Scalar = eqx.field(converter=as_array)
    upper: Scalar = eqx.field(converter=as_array)

    def __check_init__(self):
        check_order("lower limit", self.lower, "upper limit", self.upper)

    def init(self, input: ScalarLike = 0.0) -> State:
        return ()

    def step(self, state: State, input: ScalarLike) -> tuple[State, Scalar]:
        return state, jnp.clip(input, self.lower, self.upper)


class SlewLimit(System):
    """Limits how fast its output follows its input.

    ``rate`` in V/s, ``dt`` in s. Raises ValueError unless both are positive.
    """

    rate: Scalar = eqx.field(converter=as_array)
    dt: float = eqx.field(static=True)

    def __check_init__(self):
        check("slew rate in V/s", self.rate, above=0.0)
        check("sample time in s", self.dt, above=0.0)

    def init(self, input: ScalarLike = 0.0) -> State:
        return as_array(input)

    def step(self, state: State, input: ScalarLike) -> tuple[State, Scalar]:
        most = self.rate * self.dt
        output = state + jnp.clip(input - state, -most, most)
        return output, output


class Quantiser(System):
    """Rounds its input to whole multiples of ``resolution`` (a DAC or ADC step).

    Its gradient is that of the identity, so that a loop with converters can still be
    tuned; the value is the rounded one.
    """

    resolution: Scalar = eqx.field(converter=as_array)

    def __check_init__(self):
        check("resolution", self.resolution, above=0.0)

    def init(self, input: ScalarLike = 0.0) -> State:
        return ()

    def step(self, state: State, input: ScalarLike) -> tuple[State, Scalar]:
        input = as_array(input)
        rounded = self.resolution * jnp.round(input / self.resolution)
        return state, input + jax.lax.stop_gradient(rounded - input)


class Sensor(System):
    """Adds noise to the displacement.

    Input ``(displacement, draw)`` in um and unit variance; output the measurement in
    um: displacement + ``noise_rms`` * draw. Follow it with a Quantiser for a converter.
    """

    noise_rms: Scalar = eqx.field(converter=as_array)

    def __check_init__(self):
        check("sensor noise in um rms", self.noise_rms, least=0.0)

    def init(self, input: Any = (0.0, 0.0)) -> State:
        return ()

    def step(self, state: State, input: Any) -> tuple[State, Scalar]:
        displacement, draw = input
        return state, displacement + self.noise_rms * draw
