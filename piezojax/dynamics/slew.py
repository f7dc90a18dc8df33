"""Slew limit of the amplifier in front of a stage, which can be fitted."""

from typing import ClassVar

import jax.numpy as jnp

from ..core.arrays import Scalar, ScalarLike, as_array
from ..core.parameter import parameter, sample_time
from ..core.recipe import Extent, Fittable, Part, Recipe
from ..core.space import Range

OFF = 0.8, 1.25
"""Bounds of a rate, as multiples of the one estimated from the record."""

SHORTEST = 2.0
"""If the record shows no limit, the fit starts from the rate at which the largest of
its few steps, or the range of the input, takes this number of samples."""

UNSEEN = 0.1, 10.0
"""Bounds of a rate, as multiples of that start. At the upper one this step takes a
twentieth of a sample, which no record shows."""


class AmplifierSlew(Fittable):
    """Mean over each sample of a voltage that follows its input at a limited rate.

    Within a sample the voltage v moves from its last value towards the input u, by at
    most ``rate`` dt, and then stays constant. The output is the mean of v over the
    sample, because the next part of the chain takes a voltage held over the sample.
    Small motions pass unchanged. ``hardware.SlewLimit`` returns the voltage at the end
    of each sample instead. Input and output in V. Raises ValueError for a rate that is
    not positive.
    """

    part: ClassVar[Part] = Part("slew", "drive", "Slew limit of the amplifier")

    rate: Scalar = parameter(
        "V/s", "slew rate", above=0.0, scale="log", typical=(1e2, 1e7)
    )
    dt: float = sample_time()

    @classmethod
    def recipe(cls, extent: Extent) -> Recipe:
        rate = extent.slew or (extent.jump or extent.width) / (SHORTEST * extent.dt)
        low, high = OFF if extent.slew else UNSEEN
        bounds = Range(low * rate, high * rate, "log")
        return Recipe(cls(rate, extent.dt), {"rate": bounds})

    def init(self, input: ScalarLike = 0.0) -> Scalar:
        return as_array(input)

    def step(self, state: Scalar, input: ScalarLike) -> tuple[Scalar, Scalar]:
        most = self.rate * self.dt
        change = jnp.clip(as_array(input) - state, -most, most)
        end = state + change
        # The ramp takes the share |change| / most of the sample.
        return end, end - 0.5 * change * jnp.abs(change) / most
