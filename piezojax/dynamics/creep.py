"""Creep: the slow drift of a piezo after a step, as linear dynamics."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from ..core.arrays import Scalar, ScalarLike, as_array, as_scalars, check, check_order
from ..core.system import System

Lags = tuple[Scalar, ...]


def _relaxed(input: Scalar, lags: Lags, time_constants: tuple, dt: float) -> Lags:
    """Advance first-order lags of the input, held between samples."""
    return tuple(
        input + jnp.exp(-dt / tau) * (lag - input)
        for tau, lag in zip(time_constants, lags, strict=True)
    )


class ExponentialCreep(System):
    """``y = x + sum_i gains[i] lag_i(x)``: creep as a sum of exponentials.

    After a step of x, y goes on by ``gains[i]`` (a share of the step) with the time
    constant ``time_constants[i]`` (s); ``dt`` in s, y in the unit of x. The linear
    creep model of section 2.4.1 (springs and dampers in series). At rest all of it has
    crept: the gain is 1 + sum of gains. ``direct`` is the share of x that passes at
    once: 0 leaves what creeps, to be added to a hysteresis of the same input, as in
    ``hysteresis + creep >> dynamics``; the gains are then in um/V. Raises ValueError
    for time constants that are not positive, gains that are not finite, or a different
    count of both.
    """

    gains: tuple[Scalar, ...] = eqx.field(converter=as_scalars)
    time_constants: tuple[Scalar, ...] = eqx.field(converter=as_scalars)
    dt: float = eqx.field(static=True)
    direct: float = eqx.field(static=True, default=1.0)

    def __check_init__(self):
        check("gains", self.gains)
        check("share that passes at once", self.direct)
        check("time constants in s", self.time_constants, above=0.0)
        check("sample time in s", self.dt, above=0.0)
        if len(self.gains) != len(self.time_constants):
            raise ValueError(
                f"{len(self.gains)} gains and {len(self.time_constants)} time "
                "constants; each exponential needs one of both"
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


class LogarithmicCreep(System):
    """Creep by ``gain_per_decade`` of a step with each decade of time.

    After a step of x at t = 0, y grows in proportion to log10(t) from t = ``shortest``
    to ``longest``: the logarithmic law of section 2.4.1, carried over to any input by
    equally strong exponentials, two a decade from a decade before to a decade after,
    which follow it within 3 % of a decade's creep. ``shortest``, ``longest``, ``dt``
    in s, y in the unit of x; ``direct`` as in ``ExponentialCreep``. Raises ValueError
    unless dt > 0, 0 < shortest < longest.
    """

    gain_per_decade: Scalar = eqx.field(converter=as_array)
    shortest: float = eqx.field(static=True)
    longest: float = eqx.field(static=True)
    dt: float = eqx.field(static=True)
    direct: float = eqx.field(static=True, default=1.0)

    def __check_init__(self):
        check("gain per decade", self.gain_per_decade)
        check("share that passes at once", self.direct)
        check("shortest time in s", self.shortest, above=0.0)
        check_order("shortest", self.shortest, "longest", self.longest)
        check("sample time in s", self.dt, above=0.0)

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


class SpringDamperCreep(System):
    """A spring and damped springs in series under one force: creep of section 2.4.1.

    ``y = F / spring + sum_i y_i`` with ``damping[i] y_i' + stiffness[i] y_i = F`` and
    ``F = force_per_volt u``: the cascade of Croft, Shed and Devasia (2001, reference
    [6]). Input u in V, output y in um; ``stiffness`` and ``spring`` in N/um,
    ``damping`` in N s/um, ``force_per_volt`` in N/V, ``dt`` in s. The force is held
    between samples, for which the discretisation is exact. A ``spring`` of infinite
    stiffness leaves what creeps, to be added to a hysteresis of the same input. Raises
    ValueError for a stiffness, damping or sample time that is not positive, or a
    different count of damped springs and dampers.
    """

    stiffness: tuple[Scalar, ...] = eqx.field(converter=as_scalars)
    damping: tuple[Scalar, ...] = eqx.field(converter=as_scalars)
    spring: Scalar = eqx.field(converter=as_array)
    force_per_volt: Scalar = eqx.field(converter=as_array)
    dt: float = eqx.field(static=True)

    def __check_init__(self):
        check("stiffness in N/um", self.stiffness, above=0.0)
        check("damping in N s/um", self.damping, above=0.0)
        check("compliance of the spring in um/N", 1.0 / self.spring, least=0.0)
        check("force in N/V", self.force_per_volt)
        check("sample time in s", self.dt, above=0.0)
        if len(self.stiffness) != len(self.damping):
            raise ValueError(
                f"{len(self.stiffness)} springs and {len(self.damping)} dampers; each "
                "element of the cascade needs one of both"
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
