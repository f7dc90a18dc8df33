"""Resonance of a stage, alone or behind a slow sensor, which can be fitted."""

import math
from typing import ClassVar

import jax.numpy as jnp
import jax.scipy.linalg
from jaxtyping import Array, Float

from ..core.arrays import Scalar, ScalarLike, as_array
from ..core.parameter import parameter, sample_time
from ..core.paths import get
from ..core.recipe import Extent, Fittable, Part, Recipe, Resonance, scaled_range
from ..core.space import Range
from ..core.system import Designed, System
from .lag import FirstOrderLag, LinearOscillator, SecondOrderLag

GUESSES = (Resonance(0.05, 0.1), Resonance(0.2, 0.1))
"""Starting values for a record in which no resonance was found; frequencies in cycles
per sample."""

NEAR, NEAR_DAMPED, FADED = 0.002, 0.05, 0.1
"""Largest relative change by a fit of a frequency that the record shows, the same as a
multiple of its damping, and that of the damping."""

LAG_SHARES = (0.5, 1.2)
"""Bounds of the time constant of a sensor, as shares of the lag in the record."""


class Mode(Designed, Fittable):
    """``y'' + 2 damping w y' + w^2 y = w^2 x`` with w = 2 pi frequency, unit DC gain.

    The first resonance of a stage; y has the unit of x. It is the SecondOrderLag with
    the frequency in Hz: exact for an input held between samples, and the output is that
    at the end of the sample. Raises ValueError for parameters outside their limits.
    """

    part: ClassVar[Part] = Part(
        "mode", "dynamics", "Resonance: frequency in Hz and damping ratio"
    )

    frequency: Scalar = parameter(
        "Hz",
        "undamped natural frequency",
        above=0.0,
        scale="log",
        typical=(1e1, 1e4),
    )
    damping: Scalar = parameter(
        "1", "damping ratio", above=0.0, scale="log", typical=(1e-3, 1.0)
    )
    dt: float = sample_time()

    @classmethod
    def recipe(cls, extent: Extent) -> Recipe:
        starts = _starts(extent)
        return Recipe(
            cls(*starts[0], extent.dt),
            _bounds(extent),
            [resonance._asdict() for resonance in starts],
        )

    def resolved(self) -> LinearOscillator:
        """Return the LinearOscillator with the coefficients of one sample."""
        pulsation = 2.0 * math.pi * self.frequency
        return SecondOrderLag(pulsation, self.damping, self.dt).resolved()


class SensedMode(Designed, Fittable):
    """A resonance x -> y and a first-order sensor ``time_constant z' + z = y``.

    The resonance is that of ``Mode``; z is the output, in the unit of x, with unit DC
    gain. Both are discretised together, exactly for an input x held between samples. A
    Mode followed by a FirstOrderLag holds y between samples too, and is half a sample
    early. Raises ValueError for parameters outside their limits.
    """

    part: ClassVar[Part] = Part(
        "sensed_mode", "dynamics", "Resonance seen by a sensor with a first-order lag"
    )

    frequency: Scalar = parameter(
        "Hz",
        "undamped natural frequency",
        above=0.0,
        scale="log",
        typical=(1e1, 1e4),
    )
    damping: Scalar = parameter(
        "1", "damping ratio", above=0.0, scale="log", typical=(1e-3, 1.0)
    )
    time_constant: Scalar = parameter(
        "s", "time constant of the sensor", above=0.0, scale="log", typical=(1e-5, 1.0)
    )
    dt: float = sample_time()

    @classmethod
    def recipe(cls, extent: Extent) -> Recipe:
        lag = FirstOrderLag.recipe(extent)
        starts = _starts(extent)
        return Recipe(
            cls(*starts[0], get(lag.system, "time_constant"), extent.dt),
            {**_bounds(extent), **lag.bounds, **_sensor_bounds(extent)},
            [resonance._asdict() for resonance in starts],
        )

    def resolved(self) -> "HeldLinear":
        """Return the System with the transition matrix of one sample."""
        w = 2.0 * math.pi * self.frequency * self.dt
        sensor, zero = self.dt / self.time_constant, jnp.zeros(())
        # The states are y, y' / w and z.
        rates = (
            (zero, w, zero),
            (-w, -2.0 * self.damping * w, zero),
            (sensor, zero, -sensor),
        )
        matrix = jnp.stack([jnp.stack(row) for row in rates])
        return HeldLinear(jax.scipy.linalg.expm(matrix))


class HeldLinear(System):
    """Distance of the states y, y' / w, z from rest, times ``transition`` a sample."""

    transition: Float[Array, "3 3"]

    def init(self, input: ScalarLike = 0.0) -> Float[Array, " 3"]:
        return _rest(as_array(input))

    def step(
        self, state: Float[Array, " 3"], input: ScalarLike
    ) -> tuple[Float[Array, " 3"], Scalar]:
        rest = _rest(as_array(input))
        state = rest + self.transition @ (state - rest)
        return state, state[2]


def _rest(input: Scalar) -> Float[Array, " 3"]:
    return jnp.stack([input, jnp.zeros_like(input), input])


def _starts(extent: Extent) -> list[Resonance]:
    """Return the strongest resonance of the record, or guesses if it shows none."""
    guesses = [Resonance(cycles / extent.dt, damping) for cycles, damping in GUESSES]
    return list(extent.modes[:1]) or guesses


def _sensor_bounds(extent: Extent) -> dict[str, Range]:
    """Return the bounds near the lag of the record, none if it shows no lag.

    Hysteresis and creep make the lag that a record shows longer, rarely shorter.
    """
    if not (extent.modes and extent.lags):
        return {}
    return {"time_constant": scaled_range(extent.lags[0], *LAG_SHARES)}


def _bounds(extent: Extent) -> dict[str, Range]:
    """Return the bounds, close to the resonance if the record shows one.

    Its values come from the errors at all frequencies. In a fit of a free run the
    errors of the hysteresis, which are much larger, would pull it away.
    """
    if extent.modes:
        frequency, damping = extent.modes[0]
        off = max(NEAR, NEAR_DAMPED * damping)
        return {
            "frequency": scaled_range(frequency, 1.0 - off, 1.0 + off),
            "damping": scaled_range(damping, 1.0 - FADED, 1.0 + FADED),
        }
    return {
        "frequency": Range(0.5 / extent.duration, 0.499 / extent.dt, "log"),
        "damping": Range(1e-4, 2.0, "log"),
    }
