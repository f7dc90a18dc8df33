"""A part of a model to fit, and what its starts and bounds are taken from."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from ..core.space import Range
from ..core.system import System
from .records.record import Record


class Part(NamedTuple):
    """One part of a chain: its System, bounds by path in it, other starts to try.

    ``gain`` is the path of a parameter that only scales its output, ``own`` holds the
    paths of what each record has its own value of: the state before it began.
    """

    system: System
    bounds: Mapping[str, Range]
    alternatives: Sequence[Mapping[str, float]] = ({},)
    gain: str | None = None
    own: tuple[str, ...] = ()


class Extent(NamedTuple):
    """What the bounds are taken from: ranges of a record's signals."""

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


def extent_of(record: Record) -> Extent:
    """Return the ranges of a record with one input and one output."""
    x, y = record.input, record.output
    slope = record.span / float(np.ptp(x)) * float(np.sign(np.cov(x, y)[0, 1]) or 1.0)
    return Extent(
        low=float(x.min()),
        high=float(x.max()),
        first=(float(x[0]), float(y[0])),
        slope=slope,
        centre=float(np.mean(y) - slope * np.mean(x)),
        span=record.span,
        dt=record.dt,
        duration=record.dt * record.samples,
    )


def around(value: float, below: float, above: float) -> Range:
    """Return the range between multiples of ``value``, which may be negative."""
    low, high = sorted((below * value, above * value))
    return Range(low, high)


def rest_bounds(extent: Extent) -> dict[str, Range]:
    """Return the range of the input in force before the record."""
    margin = 0.5 * extent.width
    return {"rest_input": Range(extent.low - margin, extent.high + margin)}


def rests(extent: Extent) -> list[dict[str, float]]:
    """Where the input may have been before the record: where it begins, at its low."""
    return [{"rest_input": extent.first[0]}, {"rest_input": extent.low}]
