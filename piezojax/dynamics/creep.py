"""Linear models of creep, the slow drift of a piezo after a step."""

from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from ..core.arrays import (
    Scalar,
    ScalarLike,
    Scalars,
    as_array,
    as_scalars,
    check,
    check_order,
)
from ..core.parameter import parameter, sample_time
from ..core.recipe import Extent, Fittable, Part, Recipe
from ..core.space import Range

Lags = tuple[Scalar, ...]


LARGEST = 0.1
"""Largest creep of one exponential in a fit. Piezos creep by a few per cent a decade; a
larger gain would describe a part of the hysteresis, and fail on another record."""


def _relaxed(input: Scalar, lags: Lags, time_constants: tuple, dt: float) -> Lags:
    """Advance first-order lags of an input that is held between samples."""
    return tuple(
        input + jnp.exp(-dt / tau) * (lag - input)
        for tau, lag in zip(time_constants, lags, strict=True)
    )


def _creep_times(extent: Extent) -> tuple[float, float]:
    """Return the shortest and longest time constant (s) that a record can show."""
    longest = 2.0 * extent.duration
    return max(10.0 * extent.dt, 1e-3 * longest), longest


class ExponentialCreep(Fittable):
    """``y = x + sum_i gains[i] lag_i(x)``: creep as a sum of exponentials.

    After a step of x, y grows further by ``gains[i]`` (a share of the step) with the
    time constant ``time_constants[i]``; y has the unit of x. This is the linear creep
    model of section 2.4.1 (springs and dampers in series). ``direct`` is the share of x
    that passes at once; the gain at rest, when the creep is complete, is ``direct``
    plus the sum of ``gains``. With ``direct`` 0 the output is the creep alone, to be
    added to a hysteresis of the same input, as in ``hysteresis + creep >> dynamics``;
    the gains are then in um/V. Raises ValueError for time constants that are not
    positive, gains that are not finite, or different numbers of gains and time
    constants.
    """

    part: ClassVar[Part] = Part(
        "exponential_creep", "creep", "Creep as four exponentials"
    )

    gains: Scalars = parameter("1", "creep of each exponential", converter=as_scalars)
    time_constants: Scalars = parameter(
        "s", "time constant of each exponential", above=0.0, converter=as_scalars
    )
    dt: float = sample_time()
    direct: float = parameter(
        "1", "share of the input that passes at once", static=True, default=1.0
    )

    def __check_init__(self):
        if len(self.gains) != len(self.time_constants):
            raise ValueError(
                f"{len(self.gains)} gains and {len(self.time_constants)} time "
                "constants; each exponential needs one of each"
            )

    @classmethod
    def recipe(cls, extent: Extent) -> Recipe:
        times = np.geomspace(*_creep_times(extent), 4)
        gains = tuple(f"gains.{i}" for i in range(4))
        return Recipe(
            cls((0.01,) * 4, times, extent.dt),
            dict.fromkeys(gains, Range(-LARGEST, LARGEST)),
            vague=dict.fromkeys(gains, 0.01),
        )

    def init(self, input: ScalarLike = 0.0) -> Lags:
        return (as_array(input),) * len(self.gains)

    def step(self, state: Lags, input: ScalarLike) -> tuple[Lags, Scalar]:
        input = as_array(input)
        state = _relaxed(input, state, self.time_constants, self.dt)
        output = self.direct * input
        for gain, lag in zip(self.gains, state, strict=True):
            output = output + gain * lag
        return state, output


class LogarithmicCreep(Fittable):
    """Creep that grows by ``gain_per_decade`` of a step in each decade of time.

    After a step of x at t = 0, y grows in proportion to log10(t) from t = ``shortest``
    to ``longest``: the logarithmic law of section 2.4.1. A sum of exponentials of equal
    gain extends the law to any input: two per decade, from a decade before ``shortest``
    to a decade after ``longest``. The sum follows the law within 3 % of the creep in a
    decade. y has the unit of x; ``direct`` as in ``ExponentialCreep``. Raises
    ValueError unless 0 < shortest < longest.
    """

    part: ClassVar[Part] = Part(
        "logarithmic_creep", "creep", "Creep that grows with the logarithm of time"
    )

    gain_per_decade: Scalar = parameter(
        "1", "creep in each decade of time", typical=(0.0, 0.1)
    )
    shortest: float = parameter("s", "start of the creep", above=0.0, static=True)
    longest: float = parameter("s", "end of the creep", above=0.0, static=True)
    dt: float = sample_time()
    direct: float = parameter(
        "1", "share of the input that passes at once", static=True, default=1.0
    )

    def __check_init__(self):
        check_order("shortest", self.shortest, "longest", self.longest)

    @classmethod
    def recipe(cls, extent: Extent) -> Recipe:
        return Recipe(
            cls(0.01, *_creep_times(extent), extent.dt),
            {"gain_per_decade": Range(-0.2, 0.2)},
        )

    def _time_constants(self) -> np.ndarray:
        ends = self.shortest / 10.0, self.longest * 10.0
        return np.geomspace(*ends, int(np.ceil(2.0 * np.log10(ends[1] / ends[0]))) + 1)

    def init(self, input: ScalarLike = 0.0) -> Lags:
        return (as_array(input),) * self._time_constants().size

    def step(self, state: Lags, input: ScalarLike) -> tuple[Lags, Scalar]:
        input = as_array(input)
        times = self._time_constants()
        state = _relaxed(input, state, tuple(times), self.dt)
        gain = self.gain_per_decade * np.log10(times[1] / times[0])
        output = self.direct * input
        for lag in state:
            output = output + gain * lag
        return state, output


class SpringDamperCreep(Fittable):
    """Creep of section 2.4.1: a spring and damped springs (Kelvin-Voigt) in series.

    ``y = F / spring + sum_i y_i`` with ``damping[i] y_i' + stiffness[i] y_i = F`` and
    ``F = force_per_volt u``: the cascade of Croft, Shed and Devasia (2001, reference
    [6]). Input u in V, output y in um; ``spring`` in N/um. The force is held between
    samples, for which the discretisation is exact. With a ``spring`` of infinite
    stiffness the output is the creep alone, to be added to a hysteresis of the same
    input. Raises ValueError for a stiffness, damping or sample time that is not
    positive, or a different number of damped springs and dampers.
    """

    part: ClassVar[Part] = Part(
        "spring_damper_creep", "creep", "Creep of a spring and three damped springs"
    )

    stiffness: Scalars = parameter(
        "N/um", "stiffness of each damped spring", above=0.0, converter=as_scalars
    )
    damping: Scalars = parameter(
        "N s/um", "damping of each damped spring", above=0.0, converter=as_scalars
    )
    # Not a declared parameter, because it may be infinite.
    spring: Scalar = eqx.field(  # pyright: ignore[reportGeneralTypeIssues]
        converter=as_array
    )
    force_per_volt: Scalar = parameter("N/V", "force of the actuator")
    dt: float = sample_time()

    def __check_init__(self):
        check("compliance of the spring in um/N", 1.0 / self.spring, least=0.0)
        if len(self.stiffness) != len(self.damping):
            raise ValueError(
                f"{len(self.stiffness)} springs and {len(self.damping)} dampers; each "
                "element of the cascade needs one of each"
            )

    @classmethod
    def recipe(cls, extent: Extent) -> Recipe:
        times = np.geomspace(*_creep_times(extent), 3)
        # A record determines only ratios. Force and spring are therefore set for a unit
        # gain, and the stiffness is relative to that of the spring.
        stiffness = 50.0
        return Recipe(
            cls((stiffness,) * 3, stiffness * times, 1.0, 1.0, extent.dt),
            {
                **{f"stiffness.{i}": Range(2.0, 1e4, "log") for i in range(3)},
                **{
                    f"damping.{i}": Range(
                        0.02 * stiffness * t, 50.0 * stiffness * t, "log"
                    )
                    for i, t in enumerate(times)
                },
            },
        )

    def init(self, input: ScalarLike = 0.0) -> Lags:
        force = self.force_per_volt * as_array(input)
        return tuple(force / k for k in self.stiffness)

    def step(self, state: Lags, input: ScalarLike) -> tuple[Lags, Scalar]:
        force = self.force_per_volt * as_array(input)
        state = tuple(
            force / k + jnp.exp(-self.dt * k / c) * (y - force / k)
            for k, c, y in zip(self.stiffness, self.damping, state, strict=True)
        )
        return state, sum(state, force / self.spring)
