"""Resonances of a stage in parallel, followed by the lags of its sensor."""

import math
from typing import ClassVar

import jax.numpy as jnp
import jax.scipy.linalg
from jaxtyping import Array, Float

from ..core.arrays import Scalar, ScalarLike, Scalars, as_array, as_scalars
from ..core.parameter import parameter, sample_time
from ..core.recipe import (
    LAG_DOUBT,
    Extent,
    Fittable,
    Part,
    Recipe,
    scaled_range,
)
from ..core.space import Range
from ..core.system import Designed, System
from .mode import mode_bounds, mode_starts

SHARE_OFF = 0.05
"""Largest change that a fit makes to the share of a mode estimated from the record."""


class Modes(Designed, Fittable):
    """Resonances in parallel, ``sum_i share_i mode_i(x)``, then first-order lags.

    Each mode is that of ``Mode``. ``share`` holds the share of each mode but the first
    in the static gain; the first has the rest. The static gain is 1, and the output has
    the unit of x. ``time_constant`` holds the time constants of lags in series behind
    the modes, if any. All are discretised together, exactly for an input x held between
    samples; a Mode followed by a FirstOrderLag also holds the output of the mode
    between samples, so that its response is half a sample early. Raises ValueError for
    parameters outside their limits, and for lists of different length.
    """

    part: ClassVar[Part] = Part(
        "modes", "dynamics", "Resonances in parallel, followed by the lag of a sensor"
    )

    frequency: Scalars = parameter(
        "Hz",
        "undamped natural frequencies",
        above=0.0,
        scale="log",
        typical=(1e1, 1e4),
        converter=as_scalars,
    )
    damping: Scalars = parameter(
        "1",
        "damping ratios",
        above=0.0,
        scale="log",
        typical=(1e-3, 1.0),
        converter=as_scalars,
    )
    dt: float = sample_time()
    share: Scalars = parameter(
        "1",
        "shares of the static gain of all modes but the first",
        converter=as_scalars,
        default=(),
    )
    time_constant: Scalars = parameter(
        "s",
        "time constants of the lags",
        above=0.0,
        scale="log",
        typical=(1e-5, 1.0),
        converter=as_scalars,
        default=(),
    )

    def __check_init__(self):
        lengths = len(self.frequency), len(self.damping), len(self.share) + 1
        if len(set(lengths)) > 1:
            raise ValueError(
                f"there are {lengths[0]} values of frequency, {lengths[1]} of damping "
                f"and {lengths[2] - 1} of share; for n modes there must be n, n and "
                "n - 1"
            )

    @property
    def lags(self) -> Scalars:
        """Time constants of the lags, s."""
        return self.time_constant

    @classmethod
    def recipe(cls, extent: Extent) -> Recipe:
        first = mode_starts(extent)[0]
        modes = sorted(extent.modes, key=lambda mode: -abs(mode.share)) or [first]
        system = cls(
            [mode.frequency for mode in modes],
            [mode.damping for mode in modes],
            extent.dt,
            [mode.share for mode in modes[1:]],
            extent.lags,
        )
        bounds: dict[str, Range] = {}
        for i, mode in enumerate(modes):
            near = mode_bounds(extent, mode)
            bounds |= {f"{path}.{i}": bound for path, bound in near.items()}
        for i, mode in enumerate(modes[1:]):
            bounds[f"share.{i}"] = Range(mode.share - SHARE_OFF, mode.share + SHARE_OFF)
        near = 1.0 - LAG_DOUBT, 1.0 + LAG_DOUBT
        for i, lag in enumerate(extent.lags):
            bounds[f"time_constant.{i}"] = scaled_range(lag, *near)
        return Recipe(system, bounds)

    def resolved(self) -> "HeldLinear":
        """Return the System with the transition matrix of one sample."""
        modes, lags = len(self.frequency), len(self.time_constant)
        size = 2 * modes + lags
        # The states are y and y' / w of each mode, then the output of each lag.
        output, rest = jnp.zeros(size), jnp.zeros(size).at[: 2 * modes : 2].set(1.0)
        rest = rest.at[2 * modes :].set(1.0)
        rates = jnp.zeros((size, size))
        shares = (1.0 - sum(self.share, jnp.zeros(())), *self.share)
        for i, (frequency, damping) in enumerate(
            zip(self.frequency, self.damping, strict=True)
        ):
            w, y = 2.0 * math.pi * frequency * self.dt, 2 * i
            rates = rates.at[y, y + 1].set(w)
            rates = rates.at[y + 1, y : y + 2].set(jnp.stack([-w, -2.0 * damping * w]))
            output = output.at[y].set(shares[i])
        for i, time_constant in enumerate(self.time_constant, 2 * modes):
            rate = self.dt / time_constant
            rates = rates.at[i].set(rate * output).at[i, i].add(-rate)
            output = jnp.zeros(size).at[i].set(1.0)
        return HeldLinear(jax.scipy.linalg.expm(rates), output, rest)


class HeldLinear(System):
    """Linear System of unit static gain for an input held between samples.

    The distance of its states from ``rest`` times the input is multiplied by
    ``transition`` in each sample; the output is ``output`` times the states.
    """

    transition: Float[Array, "n n"]
    output: Float[Array, " n"]
    rest: Float[Array, " n"]

    def init(self, input: ScalarLike = 0.0) -> Float[Array, " n"]:
        return self.rest * as_array(input)

    def step(
        self, state: Float[Array, " n"], input: ScalarLike
    ) -> tuple[Float[Array, " n"], Scalar]:
        rest = self.rest * as_array(input)
        # Sums, because XLA calls a kernel for each product of matrices in a loop.
        state = rest + jnp.sum(self.transition * (state - rest), axis=1)
        return state, jnp.sum(self.output * state)
