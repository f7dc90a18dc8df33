"""Declarations of models that can be fitted: place in a chain, first guess, bounds."""

import abc
from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar, NamedTuple

import numpy as np

from .space import Range
from .system import System

PLACES = ("hysteresis", "creep", "dynamics", "lag", "delay", "drive")
"""Places of the parts of a chain, in the order in which parts are listed. A drive is
listed last and acts first."""

LAG_DOUBT = 0.1
"""Largest relative change that a fit makes to a lag that a record shows."""


class Resonance(NamedTuple):
    """Natural frequency (Hz) and damping ratio (1) of a resonance.

    ``share`` is its share (1) of the static gain of all resonances of the stage.
    """

    frequency: float
    damping: float
    share: float = 1.0

    @property
    def poles(self) -> tuple[complex, complex]:
        """Poles in the s plane, in the unit of the frequency."""
        turning = 1j * np.sqrt(1.0 - self.damping**2)
        pole = 2.0 * np.pi * self.frequency * (turning - self.damping)
        return pole, np.conj(pole)


class Extent(NamedTuple):
    """Ranges of the signals of a record, from which a recipe computes bounds.

    ``modes``, ``lags`` and ``delay`` are the linear dynamics that the record shows,
    from which a recipe takes its starting values, the strongest resonance first.
    ``slew`` is the slew rate of the amplifier. ``modes`` and ``lags`` are empty,
    ``delay`` and ``slew`` None, if none were found or no search was made. ``jump`` is
    the largest step of the input if its few steps may hide a slew rate in ``delay``,
    else 0. ``reach`` multiplies the distance of the bounds from the modes that were
    found. ``before`` is the range of the input before the records, if the motions there
    are estimated, as a multiple of its range within them.
    """

    low: float  # V
    high: float  # V
    first: tuple[float, float]  # V, um: the first sample
    slope: float  # um/V, mean
    centre: float  # um, the output at zero input
    span: float  # um
    dt: float  # s
    duration: float  # s
    modes: tuple[Resonance, ...] = ()
    lags: tuple[float, ...] = ()  # s, time constants
    delay: float | None = None  # s
    slew: float | None = None  # V/s
    jump: float = 0.0  # V
    reach: float = 1.0
    before: float = 1.0

    def mirrored(self) -> "Extent":
        """Return the extent of the same record with the sign of its output changed."""
        first = self.first[0], -self.first[1]
        return self._replace(slope=-self.slope, centre=-self.centre, first=first)

    @property
    def several(self) -> bool:
        """Whether several records are fitted, from an unknown state each."""
        return self.before > 1.0

    @property
    def width(self) -> float:
        """Range of the input, V."""
        return self.high - self.low


class LinearWeights(NamedTuple):
    """Weights of at least 0 in which the output is linear, and which vary smoothly.

    ``path`` is that of an array, ``places`` the positions of its k free elements, an
    index array for each axis. ``least`` [k] are their lower bounds. Each row of
    ``differences`` [pairs, k] is that between two neighbours, as a multiple of its
    typical size. ``responses`` takes the System, inputs [samples] that begin at rest,
    and some of the places; it returns the outputs [places, samples] that a weight of 1
    at each adds.
    """

    path: str
    places: tuple[np.ndarray, ...]
    least: np.ndarray
    differences: np.ndarray
    responses: Callable[[Any, Any, Sequence[Any]], Any]


class Recipe(NamedTuple):
    """First guess, bounds and starting values for fitting a System.

    ``system`` holds the first guess, ``bounds`` the Range of each fitted parameter by
    its path in ``system``. ``alternatives`` holds an entry for each start: the values
    that differ from ``system``, by path. ``gain`` is the path of a parameter that only
    scales the output. ``own`` holds the paths of parameters with a separate value for
    each record: the state before it began. ``vague`` holds those of the terms of a sum,
    which only records of every kind of motion determine one by one, each with its
    typical distance from the first guess. ``linear`` declares weights that are too many
    for a descent: they follow from least squares, given all other parameters.
    """

    system: System
    bounds: Mapping[str, Range]
    alternatives: Sequence[Mapping[str, float]] = ({},)
    gain: str | None = None
    own: tuple[str, ...] = ()
    vague: Mapping[str, float] = {}
    linear: LinearWeights | None = None


class Part(NamedTuple):
    """Declaration of a part of a chain: its name in ``--model``, place and summary."""

    name: str
    place: str
    summary: str


class Fittable(System):
    """A System that ``identify`` fits as a part of a chain.

    ``--model help`` lists it once it is registered; ``--model all`` tries it if it is a
    hysteresis or a creep.
    """

    part: ClassVar[Part]
    rising: ClassVar[bool] = False
    """Whether the output can only rise with the input. For a record in which it falls,
    the recipe is that of the mirrored output, and the chain inverts the sign."""

    @classmethod
    @abc.abstractmethod
    def recipe(cls, extent: Extent) -> Recipe:
        """Return the first guess and the bounds for a record of this extent.

        Raises ValueError if the model cannot describe such a record.
        """


def scaled_range(value: float, below: float, above: float) -> Range:
    """Return the Range from ``below`` to ``above`` times ``value``, lower end first."""
    low, high = sorted((below * value, above * value))
    return Range(low, high)


def rest_bounds(extent: Extent) -> dict[str, Range]:
    """Return the Range of ``rest_input``, the input (V) before the record."""
    margin = 0.5 * extent.width
    return {"rest_input": Range(extent.low - margin, extent.high + margin)}


def rest_starts(extent: Extent) -> list[dict[str, float]]:
    """Return starting values of ``rest_input``: the first and the lowest input (V)."""
    return [{"rest_input": extent.first[0]}, {"rest_input": extent.low}]
