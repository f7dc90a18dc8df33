"""Lags of first and second order: an amplifier, a filter, a reference model."""

from typing import ClassVar

import jax.numpy as jnp

from ..core.arrays import Scalar, ScalarLike, Scalars, as_array
from ..core.parameter import parameter, sample_time
from ..core.recipe import Extent, Fittable, Part, Recipe
from ..core.space import Range
from ..core.system import Designed, System
from .arma import ARMA


class FirstOrderLag(Fittable):
    """``tau dy/dt + y = x`` for an input held between samples, unit DC gain.

    y has the unit of x. Raises ValueError unless both parameters are positive.
    """

    part: ClassVar[Part] = Part(
        "lag", "lag", "First-order lag: amplifier, sensor filter"
    )

    time_constant: Scalar = parameter(
        "s", "time constant", above=0.0, scale="log", typical=(1e-5, 1.0)
    )
    dt: float = sample_time()

    @classmethod
    def recipe(cls, extent: Extent) -> Recipe:
        bounds = Range(0.05 * extent.dt, 50.0 * extent.dt, "log")
        found = [lag for lag in extent.lags if bounds.lower < lag < bounds.upper]
        starts = found or [extent.dt]
        return Recipe(
            cls(starts[0], extent.dt),
            {"time_constant": bounds},
            [{"time_constant": lag} for lag in starts],
        )

    @property
    def lags(self) -> Scalars:
        """Time constant, s."""
        return (self.time_constant,)

    def pole(self) -> Scalar:
        """Return the pole in the z plane."""
        return jnp.exp(-self.dt / self.time_constant)

    def as_arma(self) -> ARMA:
        """Return the same lag as a second-order ARMA, padded with zero coefficients."""
        pole = self.pole()
        return ARMA((pole, 0.0), (1.0 - pole, 0.0, 0.0))

    def init(self, input: ScalarLike = 0.0) -> Scalar:
        return as_array(input)

    def step(self, state: Scalar, input: ScalarLike) -> tuple[Scalar, Scalar]:
        input = as_array(input)
        output = input + self.pole() * (state - input)
        return output, output


class SecondOrderLag(Designed):
    """``y'' + 2 zeta w y' + w^2 y = w^2 x``, unit DC gain: the reference model (4.47).

    y has the unit of x; zeta may be above 1. The step is exact for an input held
    between samples, and its output is y at the end of the sample. The state is y and
    dy/dt. Raises ValueError for parameters outside their limits.
    """

    frequency: Scalar = parameter(
        "rad/s",
        "undamped natural frequency w",
        above=0.0,
        scale="log",
        typical=(1e1, 1e5),
    )
    damping: Scalar = parameter(
        "1", "damping ratio zeta", least=0.0, typical=(0.0, 2.0)
    )
    dt: float = sample_time()

    def resolved(self) -> "LinearOscillator":
        """Return the LinearOscillator with the coefficients of one sample."""
        decay = self.damping * self.frequency
        even, odd = _cosine_and_sinc((self.frequency**2 - decay**2) * self.dt**2)
        odd = odd * self.dt
        fade = jnp.exp(-decay * self.dt)
        return LinearOscillator(
            keep=fade * (even + decay * odd),
            carry=fade * odd,
            slow=fade * (even - decay * odd),
            pull=fade * self.frequency**2 * odd,
        )


class LinearOscillator(System):
    """Recursion of position and velocity over one sample, the resolved SecondOrderLag.

    With d = y - x: y <- x + ``keep`` d + ``carry`` dy/dt (s) and
    dy/dt <- ``slow`` dy/dt - ``pull`` d (1/s).
    """

    keep: Scalar
    carry: Scalar
    slow: Scalar
    pull: Scalar

    def init(self, input: ScalarLike = 0.0) -> tuple[Scalar, Scalar]:
        position = as_array(input)
        return position, jnp.zeros_like(position)

    def step(
        self, state: tuple[Scalar, Scalar], input: ScalarLike
    ) -> tuple[tuple[Scalar, Scalar], Scalar]:
        distance, velocity = state[0] - input, state[1]
        position = input + self.keep * distance + self.carry * velocity
        velocity = self.slow * velocity - self.pull * distance
        return (position, velocity), position


def _cosine_and_sinc(square: Scalar) -> tuple[Scalar, Scalar]:
    """Return cos x and sin(x)/x for x^2 = ``square`` of either sign, smooth at zero."""
    small = jnp.abs(square) < 1e-3  # the series is exact to rounding there
    x = jnp.sqrt(jnp.where(small, 1.0, jnp.abs(square)))
    real = square > 0.0
    cosine = jnp.where(real, jnp.cos(x), jnp.cosh(x))
    sinc = jnp.where(real, jnp.sin(x), jnp.sinh(x)) / x
    near = 1.0 + square * (-1 / 2 + square * (1 / 24 - square / 720))
    near_sinc = 1.0 + square * (-1 / 6 + square * (1 / 120 - square / 5040))
    return jnp.where(small, near, cosine), jnp.where(small, near_sinc, sinc)
