"""Resonance of a stage."""

import math
from typing import ClassVar

from ..core.arrays import Scalar
from ..core.parameter import parameter, sample_time
from ..core.recipe import Extent, Fittable, Part, Recipe, Resonance, scaled_range
from ..core.space import Range
from ..core.system import Designed
from .lag import LinearOscillator, SecondOrderLag

GUESSES = (Resonance(0.05, 0.1), Resonance(0.2, 0.1))
"""Starting values for a record in which no resonance was found; frequencies in cycles
per sample."""

NEAR, NEAR_DAMPED, FADED = 0.002, 0.05, 0.1
"""Largest relative changes that a fit makes to a resonance estimated from the record.
The frequency changes by at most NEAR, or by NEAR_DAMPED times the damping ratio if that
is larger; the damping ratio changes by at most FADED."""


class Mode(Designed, Fittable):
    """``y'' + 2 damping w y' + w^2 y = w^2 x`` with w = 2 pi frequency, unit DC gain.

    A resonance of a stage; y has the unit of x. It is the SecondOrderLag with the
    frequency in Hz: exact for an input held between samples, and the output is y at the
    end of the sample. Raises ValueError for parameters outside their limits.
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
        starts = mode_starts(extent)
        return Recipe(
            cls(starts[0].frequency, starts[0].damping, extent.dt),
            mode_bounds(extent, starts[0]),
            [{"frequency": m.frequency, "damping": m.damping} for m in starts],
        )

    def resolved(self) -> LinearOscillator:
        """Return the LinearOscillator with the coefficients of one sample."""
        angular_frequency = 2.0 * math.pi * self.frequency
        return SecondOrderLag(angular_frequency, self.damping, self.dt).resolved()


def mode_starts(extent: Extent) -> list[Resonance]:
    """Return the strongest resonance of the record, or guesses if it shows none."""
    guesses = [m._replace(frequency=m.frequency / extent.dt) for m in GUESSES]
    return list(extent.modes[:1]) or guesses


def mode_bounds(extent: Extent, mode: Resonance) -> dict[str, Range]:
    """Return the bounds of frequency and damping, near ``mode`` if the record shows it.

    Frequency and damping of ``mode`` were estimated from whitened errors, in which all
    frequencies count alike. A fit of a free run would bias them, because the errors of
    the hysteresis dominate a free run.
    """
    if mode in extent.modes:
        off = extent.reach * max(NEAR, NEAR_DAMPED * mode.damping)
        faded = extent.reach * FADED
        return {
            "frequency": scaled_range(mode.frequency, 1.0 - off, 1.0 + off),
            "damping": scaled_range(mode.damping, 1.0 - faded, 1.0 + faded),
        }
    return {
        "frequency": Range(0.5 / extent.duration, 0.499 / extent.dt, "log"),
        "damping": Range(1e-4, 2.0, "log"),
    }
