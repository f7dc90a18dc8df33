"""A delay that need not be a whole number of samples, and can be fitted."""

import equinox as eqx
import jax.numpy as jnp

from ..core.arrays import Scalar, ScalarLike, as_array, check
from ..core.system import System


class FractionalDelay(System):
    """``y(t) = x(t - delay)``, interpolated linearly between samples.

    ``delay`` in s from 0 to ``longest`` samples of ``dt`` (s); y in the unit of x. The
    output depends on the delay through the weights of the samples it lies between, so
    its gradient exists. For a whole number of samples it is Delay. Raises ValueError
    for a delay outside 0 to longest * dt.
    """

    delay: Scalar = eqx.field(converter=as_array)
    dt: float = eqx.field(static=True)
    longest: int = eqx.field(static=True)

    def __check_init__(self):
        check("sample time in s", self.dt, above=0.0)
        check("longest delay in samples", self.longest, least=1.0)
        check("delay in s", self.delay, least=0.0, most=self.longest * self.dt)

    def init(self, input: ScalarLike = 0.0) -> tuple[Scalar, ...]:
        return (as_array(input),) * self.longest

    def step(
        self, state: tuple[Scalar, ...], input: ScalarLike
    ) -> tuple[tuple[Scalar, ...], Scalar]:
        input = as_array(input)
        samples = self.delay / self.dt
        output = jnp.zeros_like(input)
        for age, value in enumerate((input, *state)):
            weight = jnp.maximum(1.0 - jnp.abs(samples - age), 0.0)
            output = output + weight * value
        return (input, *state[:-1]), output
