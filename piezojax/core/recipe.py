"""What a model declares of itself to be fitted: its place in a chain and its recipe."""

import abc
from collections.abc import Mapping, Sequence
from typing import ClassVar, NamedTuple

from .space import Range
from .system import System

PLACES = ("hysteresis", "creep", "dynamics", "lag", "delay")
"""Places of the parts of a chain, in the order in which parts are listed."""


class Extent(NamedTuple):
    """Ranges of a record's signals, from which a recipe takes its bounds."""

    low: float  # V
    high: float  # V
    first: tuple[float, float]  # V, um: the first sample
    slope: float  # um/V, mean
    centre: float  # um, the output for no input
    span: float  # um
    dt: float  # s
    duration: float  # s

    @property
    def width(self) -> float:
        """Range of the input, V."""
        return self.high - self.low


class Recipe(NamedTuple):
    """A System to fit: its first guess, bounds by path in it, other starts to try.

    ``gain`` is the path of a parameter that only scales the output, ``own`` holds the
    paths of which each record has its own value: the state before it began.
    """

    system: System
    bounds: Mapping[str, Range]
    alternatives: Sequence[Mapping[str, float]] = ({},)
    gain: str | None = None
    own: tuple[str, ...] = ()


class Part(NamedTuple):
    """Declaration of a part of a chain: its name in ``--model``, place and summary."""

    name: str
    place: str
    summary: str


class Fittable(System):
    """A System that ``identify`` fits as a part of a chain.

    Once registered, it is listed by ``--model help`` and, if a hysteresis or a creep,
    tried by ``--model all``.
    """

    part: ClassVar[Part]

    @classmethod
    @abc.abstractmethod
    def recipe(cls, extent: Extent) -> Recipe:
        """Return the first guess and the bounds for a record of this extent.

        Raises ValueError where the model cannot describe such a record.
        """


def around(value: float, below: float, above: float) -> Range:
    """Return the range between multiples of ``value``, which may be negative."""
    low, high = sorted((below * value, above * value))
    return Range(low, high)


def rest_bounds(extent: Extent) -> dict[str, Range]:
    """Return the range of ``rest_input``, the input in force before the record."""
    margin = 0.5 * extent.width
    return {"rest_input": Range(extent.low - margin, extent.high + margin)}


def rests(extent: Extent) -> list[dict[str, float]]:
    """Return starts of ``rest_input``: the record's first input and its lowest."""
    return [{"rest_input": extent.first[0]}, {"rest_input": extent.low}]
