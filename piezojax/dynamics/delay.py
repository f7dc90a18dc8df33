"""Fractional delay that can be fitted."""

from typing import ClassVar

import jax.numpy as jnp

from ..core.arrays import Scalar, ScalarLike, as_array, check
from ..core.parameter import parameter, sample_time
from ..core.recipe import LAG_DOUBT, Extent, Fittable, Part, Recipe
from ..core.space import Range

NEAR = 0.25
"""Largest change, in samples, that a fit makes to a delay estimated from the record."""

RAMP = 2.0
"""The same, if the delay may contain the ramp of a step at an unknown slew rate."""


class FractionalDelay(Fittable):
    """``y(t) = x(t - delay)``, interpolated linearly between samples.

    ``delay`` lies between 0 and ``longest`` (1 to 64) samples; y has the unit of x. The
    output is differentiable with respect to the delay, through the weights of the two
    adjacent samples. For a whole number of samples it equals Delay. Raises ValueError
    for a delay outside 0 to longest * dt.
    """

    part: ClassVar[Part] = Part("delay", "delay", "Delay of up to five samples")

    delay: Scalar = parameter("s", "delay", least=0.0, typical=(0.0, 1e-2))
    dt: float = sample_time()
    longest: int = parameter(
        "samples", "longest delay", least=1.0, most=64.0, whole=True, static=True
    )

    def __check_init__(self):
        check("delay in s", self.delay, most=self.longest * self.dt)

    @classmethod
    def recipe(cls, extent: Extent) -> Recipe:
        dt = extent.dt
        found = extent.delay
        starts = [0.5 * dt, 2.5 * dt]
        if found is not None:
            starts = [min(max(found, 0.0), 4.5 * dt)]
        bounds = Range(0.0, 5.0 * dt)
        if found is not None and extent.modes:
            # Errors of the hysteresis would bias the delay, as they would bias a mode.
            off = (RAMP if extent.jump else NEAR) * dt
            if extent.several:  # they show best the sum of the delay and all lags
                off += LAG_DOUBT * sum(extent.lags)
            bounds = Range(max(0.0, starts[0] - off), min(starts[0] + off, 5.0 * dt))
        return Recipe(
            cls(0.5 * dt, dt, 5),
            {"delay": bounds},
            [{"delay": delay} for delay in starts],
        )

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
