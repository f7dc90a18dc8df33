"""Parts of which models to fit are made, with starts and bounds from the record."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from ..dynamics import (
    ARMA,
    ExponentialCreep,
    FirstOrderLag,
    FractionalDelay,
    LogarithmicCreep,
)
from ..hysteresis import (
    AsymmetricPrandtlIshlinskii,
    ColemanHodgdon,
    PrandtlIshlinskii,
    ShapedColemanHodgdon,
)
from ..space import Transform
from ..system import System
from .record import Record

PLAYS = 10
"""Play operators of a fitted Prandtl-Ishlinskii model."""

Bounds = Mapping[str, tuple[float, float, Transform]]


class Part(NamedTuple):
    """One part of a chain: its System, bounds by path in it, other starts to try.

    ``gain`` is the path of a parameter that only scales its output, ``own`` holds the
    paths of what each record has its own value of: the state before it began.
    """

    system: System
    bounds: Bounds
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


def _rest_bounds(extent: Extent) -> Bounds:
    margin = 0.5 * extent.width
    return {"rest_input": (extent.low - margin, extent.high + margin, "linear")}


def _rests(extent: Extent) -> list[dict[str, float]]:
    return [{"rest_input": extent.first[0]}, {"rest_input": extent.low}]


def _around(value: float, below: float, above: float) -> tuple[float, float, Transform]:
    """Bounds at multiples of ``value``, which may be negative."""
    low, high = sorted((below * value, above * value))
    return low, high, "linear"


def _coleman_hodgdon(extent: Extent) -> Part:
    """Coleman-Hodgdon: y' = |x'| (a x + c y) + b x'"""
    width, slope = extent.width, extent.slope
    rest = extent.first[1] - extent.centre
    reach = 2.0 * extent.span
    return Part(
        ColemanHodgdon(
            a=slope / width,
            b=0.7 * slope,
            c=-1.0 / width,
            rest_input=extent.first[0],
            rest_output=rest,
        ),
        {
            "a": _around(slope / width, 0.0, 20.0),
            "b": _around(slope, 0.0, 3.0),
            "c": (-20.0 / width, -0.01 / width, "linear"),
            **_rest_bounds(extent),
            "rest_output": (rest - reach, rest + reach, "linear"),
        },
        # Keep the slope -a/c of the loop's axis while its decay c changes.
        [
            {"c": -steep / width, "a": steep * slope / width, **before}
            for steep in (0.3, 1.0, 3.0, 8.0)
            for before in _rests(extent)
        ],
        gain="b",
        own=("rest_input", "rest_output"),
    )


def _shaped_coleman_hodgdon(extent: Extent) -> Part:
    """Coleman-Hodgdon with cubic shape functions: y' = |x'| (p(x) + c y) + g(x) x'"""
    width, slope = extent.width, extent.slope
    rest = extent.first[1] - extent.centre
    reach = 2.0 * extent.span
    scales = [abs(slope) / width**i for i in range(4)]
    return Part(
        ShapedColemanHodgdon(
            pull=(0.0, slope / width, 0.0, 0.0),
            slope=(0.7 * slope, 0.0, 0.0),
            c=-1.0 / width,
            rest_input=extent.first[0],
            rest_output=rest,
        ),
        {
            # A constant pull and an offset of the output are the same thing.
            **{
                f"pull.{i}": (-50 * s, 50 * s, "linear")
                for i, s in enumerate(scales)
                if i > 0
            },
            **{
                f"slope.{i}": (-10 * s, 10 * s, "linear")
                for i, s in enumerate(scales[:3])
            },
            "c": (-50.0 / width, -0.01 / width, "linear"),
            **_rest_bounds(extent),
            "rest_output": (rest - reach, rest + reach, "linear"),
        },
        [
            {"c": -steep / width, "pull.1": steep * slope / width, **before}
            for steep in (1.0, 3.0, 10.0)
            for before in _rests(extent)
        ],
        gain="slope.0",
        own=("rest_input", "rest_output"),
    )


def _plays(extent: Extent) -> tuple[dict[str, Any], Bounds]:
    """Fields and bounds that both Prandtl-Ishlinskii models share."""
    width, slope = extent.width, extent.slope
    # A play wider than half the range of the input never moves.
    thresholds = 0.5 * width * np.arange(1, PLAYS + 1) / (PLAYS + 1)
    scales = [slope / width**i for i in range(3)]
    return (
        {
            "polynomial": (0.7 * slope, 0.0, 0.0),
            "thresholds": thresholds,
            "weights": (0.3 * slope / PLAYS,) * PLAYS,
            "rest_input": extent.first[0],
        },
        {
            **{
                f"polynomial.{i}": _around(s, -10.0, 10.0) for i, s in enumerate(scales)
            },
            **{f"weights.{i}": _around(slope, 0.0, 1.0) for i in range(PLAYS)},
            **_rest_bounds(extent),
        },
    )


def _prandtl_ishlinskii(extent: Extent) -> Part:
    """Prandtl-Ishlinskii: ten play operators and a cubic polynomial"""
    fields, bounds = _plays(extent)
    return Part(
        PrandtlIshlinskii(**fields),
        bounds,
        _rests(extent),
        gain="polynomial.0",
        own=("rest_input",),
    )


def _asymmetric_prandtl_ishlinskii(extent: Extent) -> Part:
    """Prandtl-Ishlinskii with ten more plays that skew the loop"""
    fields, bounds = _plays(extent)
    return Part(
        AsymmetricPrandtlIshlinskii(
            **fields, skew=(0.0,) * PLAYS, origin=extent.low, scale=extent.width
        ),
        {
            **bounds,
            **{f"skew.{i}": _around(extent.slope, -2.0, 2.0) for i in range(PLAYS)},
        },
        _rests(extent),
        gain="polynomial.0",
        own=("rest_input",),
    )


def _lag(extent: Extent) -> Part:
    """First-order lag: amplifier, sensor filter"""
    dt = extent.dt
    return Part(FirstOrderLag(dt, dt), {"time_constant": (0.05 * dt, 50.0 * dt, "log")})


def _arma(extent: Extent) -> Part:
    """Second-order dynamics (3.30) with two zeros"""
    del extent
    return Part(
        ARMA((0.9, -0.2), (0.3, 0.0, 0.0)),
        {
            "autoregressive.0": (-2.0, 2.0, "linear"),
            "autoregressive.1": (-1.0, 1.0, "linear"),
            **{f"moving.{i}": (-3.0, 3.0, "linear") for i in range(3)},
        },
        [
            {"autoregressive.0": 2.0 * p, "autoregressive.1": -p * p, "moving.0": q}
            for p, q in ((0.3, 0.49), (0.8, 0.04))
        ],
        gain="moving.0",
    )


def _delay(extent: Extent) -> Part:
    """Delay of up to five samples"""
    return Part(
        FractionalDelay(0.5 * extent.dt, extent.dt, 5),
        {"delay": (0.0, 5.0 * extent.dt, "linear")},
        [{"delay": n * extent.dt} for n in (0.5, 2.5)],
    )


def _creep_times(extent: Extent) -> tuple[float, float]:
    """Fastest and slowest creep that a record can show."""
    longest = 2.0 * extent.duration
    return max(10.0 * extent.dt, 1e-3 * longest), longest


def _exponential_creep(extent: Extent) -> Part:
    """Creep as four exponentials"""
    times = np.geomspace(*_creep_times(extent), 4)
    return Part(
        ExponentialCreep((0.01,) * 4, times, extent.dt),
        {f"gains.{i}": (-0.5, 0.5, "linear") for i in range(4)},
    )


def _logarithmic_creep(extent: Extent) -> Part:
    """Creep with the logarithm of time"""
    return Part(
        LogarithmicCreep(0.01, *_creep_times(extent), extent.dt),
        {"gain_per_decade": (-0.2, 0.2, "linear")},
    )


PARTS: dict[str, tuple[str, Callable[[Extent], Part]]] = {
    "coleman_hodgdon": ("hysteresis", _coleman_hodgdon),
    "shaped_coleman_hodgdon": ("hysteresis", _shaped_coleman_hodgdon),
    "prandtl_ishlinskii": ("hysteresis", _prandtl_ishlinskii),
    "asymmetric_prandtl_ishlinskii": ("hysteresis", _asymmetric_prandtl_ishlinskii),
    "exponential_creep": ("creep", _exponential_creep),
    "logarithmic_creep": ("creep", _logarithmic_creep),
    "arma": ("dynamics", _arma),
    "lag": ("lag", _lag),
    "delay": ("delay", _delay),
}
"""Parts of a chain by name: the name they have in the fitted plant, their builder."""
