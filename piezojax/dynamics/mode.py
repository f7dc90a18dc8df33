"""Resonance of a stage, which can be fitted."""

import math
from typing import ClassVar

from ..core.arrays import Scalar
from ..core.parameter import parameter, sample_time
from ..core.recipe import Extent, Fittable, Part, Recipe, Resonance
from ..core.space import Range
from ..core.system import Designed
from .lag import LinearOscillator, SecondOrderLag

GUESSES = (Resonance(0.05, 0.1), Resonance(0.2, 0.1))
"""Starting values for a record in which no resonance was found; frequencies in cycles
per sample."""


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
        dt = extent.dt
        found = extent.modes or [
            Resonance(g.frequency / dt, g.damping) for g in GUESSES
        ]
        return Recipe(
            cls(*found[0], dt),
            {
                "frequency": Range(0.5 / extent.duration, 0.499 / dt, "log"),
                "damping": Range(1e-4, 2.0, "log"),
            },
            [resonance._asdict() for resonance in found],
        )

    def resolved(self) -> LinearOscillator:
        """Return the LinearOscillator with the coefficients of one sample."""
        pulsation = 2.0 * math.pi * self.frequency
        return SecondOrderLag(pulsation, self.damping, self.dt).resolved()
