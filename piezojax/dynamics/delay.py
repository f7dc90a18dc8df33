"""Fractional delay that can be fitted."""

from typing import ClassVar

import jax.numpy as jnp

from ..core.arrays import Scalar, check
from ..core.parameter import parameter, sample_time
from ..core.recipe import LAG_DOUBT, Extent, Fittable, Part, Recipe
from ..core.space import Range
from ..core.system import Designed
from .arma import ARMA

NEAR = 0.25
"""Largest change, in samples, that a fit makes to a delay estimated from the record."""

RAMP = 2.0
"""The same, if the delay may contain the ramp of a step at an unknown slew rate."""

ORDERS = 1, 3
"""Orders of the polynomials between samples."""


class FractionalDelay(Fittable, Designed):
    """``y(t) = x(t - delay)``, interpolated between samples.

    ``delay`` lies between 0 and ``longest`` (1 to 64) samples; y has the unit of x. The
    output is differentiable with respect to the delay, through the weights of the
    adjacent samples. For a whole number of samples it equals Delay.

    ``order`` is that of the polynomial through the adjacent samples (Lagrange's, as in
    Laakso et al., IEEE Signal Processing Magazine 13(1), 1996, 30-60). Order 1 stays
    between two samples, as a delayed voltage must, and attenuates fast motions: one at
    a tenth of the sampling rate by up to 5 %. Order 3 changes it by at most 0.6 % and
    suits a displacement; after a jump it overshoots.

    Raises ValueError for a delay outside 0 to longest * dt and for another order.
    """

    part: ClassVar[Part] = Part("delay", "delay", "Delay of up to five samples")

    delay: Scalar = parameter("s", "delay", least=0.0, typical=(0.0, 1e-2))
    dt: float = sample_time()
    longest: int = parameter(
        "samples", "longest delay", least=1.0, most=64.0, whole=True, static=True
    )
    order: int = parameter(
        "1",
        "order between samples",
        least=1.0,
        most=3.0,
        whole=True,
        static=True,
        default=1,
    )

    def __check_init__(self):
        check("delay in s", self.delay, most=self.longest * self.dt)
        if self.order not in ORDERS:
            raise ValueError(f"order is {self.order!r}; it must be one of {ORDERS}")

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
            cls(0.5 * dt, dt, 5, order=3),
            {"delay": bounds},
            [{"delay": delay} for delay in starts],
        )

    def resolved(self) -> ARMA:
        """Return the moving average with the weights of the samples."""
        samples = self.delay / self.dt
        past = self.longest if self.order == 1 else max(self.longest + 1, 3)
        weights = [_lagrange(samples - age, self.order) for age in range(past + 1)]
        if self.order == 3:
            # The cubic through the four last samples goes on to one that is to come.
            ahead = _lagrange(samples + 1.0, self.order)
            for age, factor in enumerate((4.0, -6.0, 4.0, -1.0)):
                weights[age] = weights[age] + factor * ahead
        return ARMA((), weights)


def _lagrange(apart: Scalar, order: int) -> Scalar:
    """Return the weight of a sample ``apart`` samples from the delay."""
    apart = jnp.abs(apart)
    near = jnp.maximum(1.0 - apart, 0.0)
    if order == 1:
        return near
    far = jnp.where(apart < 2.0, (1.0 - apart) * (3.0 - apart) / 3.0, 0.0)
    return 0.5 * (2.0 - apart) * jnp.where(apart < 1.0, near * (1.0 + apart), far)
