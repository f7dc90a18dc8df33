"""Hysteresis to fit: starts and bounds of each model."""

from typing import Any

import numpy as np

from ..hysteresis import (
    AsymmetricPrandtlIshlinskii,
    ColemanHodgdon,
    LearnedOperator,
    PrandtlIshlinskii,
    RateDependentPrandtlIshlinskii,
    ShapedColemanHodgdon,
    StopPrandtlIshlinskii,
)
from .part import Bounds, Extent, Part, around

PLAYS = 10
"""Play operators of a fitted Prandtl-Ishlinskii model."""

LEARNED_PLAYS, NEURONS = 5, 4
"""Play operators and neurons of a learned operator."""

SEEDS = 4
"""Draws of a learned operator's first weights, the same in every run."""


def _rest_bounds(extent: Extent) -> Bounds:
    margin = 0.5 * extent.width
    return {"rest_input": (extent.low - margin, extent.high + margin, "linear")}


def _rests(extent: Extent) -> list[dict[str, float]]:
    return [{"rest_input": extent.first[0]}, {"rest_input": extent.low}]


def coleman_hodgdon(extent: Extent) -> Part:
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
            "a": around(slope / width, 0.0, 20.0),
            "b": around(slope, 0.0, 3.0),
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


def shaped_coleman_hodgdon(extent: Extent) -> Part:
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
            **{f"polynomial.{i}": around(s, -10.0, 10.0) for i, s in enumerate(scales)},
            **{f"weights.{i}": around(slope, 0.0, 1.0) for i in range(PLAYS)},
            **_rest_bounds(extent),
        },
    )


def prandtl_ishlinskii(extent: Extent) -> Part:
    """Prandtl-Ishlinskii: ten play operators and a cubic polynomial"""
    fields, bounds = _plays(extent)
    return Part(
        PrandtlIshlinskii(**fields),
        bounds,
        _rests(extent),
        gain="polynomial.0",
        own=("rest_input",),
    )


def asymmetric_prandtl_ishlinskii(extent: Extent) -> Part:
    """Prandtl-Ishlinskii with ten more plays that skew the loop"""
    fields, bounds = _plays(extent)
    return Part(
        AsymmetricPrandtlIshlinskii(
            **fields, skew=(0.0,) * PLAYS, origin=extent.low, scale=extent.width
        ),
        {
            **bounds,
            **{f"skew.{i}": around(extent.slope, -2.0, 2.0) for i in range(PLAYS)},
        },
        _rests(extent),
        gain="polynomial.0",
        own=("rest_input",),
    )


def stop_prandtl_ishlinskii(extent: Extent) -> Part:
    """Prandtl-Ishlinskii by ten stop operators and a cubic polynomial"""
    fields, bounds = _plays(extent)
    # The polynomial is the axis of the loop, above the slope at its turning points.
    fields["polynomial"] = (1.3 * extent.slope, 0.0, 0.0)
    return Part(
        StopPrandtlIshlinskii(**fields),
        bounds,
        _rests(extent),
        gain="polynomial.0",
        own=("rest_input",),
    )


def rate_dependent_prandtl_ishlinskii(extent: Extent) -> Part:
    """Prandtl-Ishlinskii with plays that widen with the rate of the input"""
    fields, bounds = _plays(extent)
    # A sine over the whole range needs some periods in the record; at the growth of a
    # sixth of its period no play moves any more.
    most = 0.05 * extent.duration
    return Part(
        RateDependentPrandtlIshlinskii(**fields, growth=0.01 * most, dt=extent.dt),
        {**bounds, "growth": (0.0, most, "linear")},
        _rests(extent),
        gain="polynomial.0",
        own=("rest_input",),
    )


def learned_operator(extent: Extent) -> Part:
    """Learned: neurons over play operators, with past outputs (NARX)"""
    count = LEARNED_PLAYS + 2
    height = 0.5 * extent.slope * extent.width  # um for half the range of the input
    reach = 3.0 * abs(height)
    starts = [_drawn(seed, count, height) for seed in range(SEEDS)]
    first = starts[0]
    return Part(
        LearnedOperator(
            autoregressive=(0.1, 0.0),
            linear=(0.5 * height, *(0.08 * height,) * LEARNED_PLAYS, 0.0),
            mixing=[
                [first[f"mixing.{i}.{j}"] for j in range(count)] for i in range(NEURONS)
            ],
            bias=[first[f"bias.{i}"] for i in range(NEURONS)],
            output=[first[f"output.{i}"] for i in range(NEURONS)],
            # A play wider than half the range of the input never moves.
            thresholds=np.arange(1, LEARNED_PLAYS + 1) / (LEARNED_PLAYS + 1),
            centre=0.5 * (extent.low + extent.high),
            scale=0.5 * extent.width,
            # Ten times there and back in the record.
            pace=20.0 * extent.width * extent.dt / extent.duration,
            rest_input=extent.first[0],
        ),
        {
            "autoregressive.0": (-1.9, 1.9, "linear"),
            "autoregressive.1": (-0.95, 0.95, "linear"),
            **{f"linear.{j}": (-reach, reach, "linear") for j in range(count)},
            **{
                f"mixing.{i}.{j}": (-6.0, 6.0, "linear")
                for i in range(NEURONS)
                for j in range(count)
            },
            **{f"bias.{i}": (-4.0, 4.0, "linear") for i in range(NEURONS)},
            **{f"output.{i}": (-reach, reach, "linear") for i in range(NEURONS)},
            **_rest_bounds(extent),
        },
        starts,
        gain="linear.0",
        own=("rest_input",),
    )


def _drawn(seed: int, count: int, height: float) -> dict[str, float]:
    """Return first weights of the neurons: small, so that each works where it bends."""
    draw = np.random.default_rng(seed).normal
    return {
        **{
            f"mixing.{i}.{j}": float(draw(scale=0.7))
            for i in range(NEURONS)
            for j in range(count)
        },
        **{f"bias.{i}": float(draw(scale=0.5)) for i in range(NEURONS)},
        **{
            f"output.{i}": float(draw(scale=0.05 * abs(height))) for i in range(NEURONS)
        },
    }
