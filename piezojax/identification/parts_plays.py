"""Hysteresis of plays to fit, weighted or learned: starts and bounds of each model."""

from typing import Any

import numpy as np

from ..core.space import Range
from ..hysteresis import (
    AsymmetricPrandtlIshlinskii,
    LearnedOperator,
    PrandtlIshlinskii,
    RateDependentPrandtlIshlinskii,
    StopPrandtlIshlinskii,
)
from .part import Extent, Part, around, rest_bounds, rests

PLAYS = 10
"""Play operators of a fitted Prandtl-Ishlinskii model."""

LEARNED_PLAYS, NEURONS = 5, 4
"""Play operators and neurons of a learned operator."""

SEEDS = 16
"""Draws of a learned operator's first weights, the same in every run.

On records that a learned operator made (tests/benchmarks/choice.py) all of twelve ended
in a worse place than the true one for two of three draws of the noise, of sixteen not.
"""


def _plays(extent: Extent) -> tuple[dict[str, Any], dict[str, Range]]:
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
            **rest_bounds(extent),
        },
    )


def prandtl_ishlinskii(extent: Extent) -> Part:
    """Prandtl-Ishlinskii: ten play operators and a cubic polynomial"""
    fields, bounds = _plays(extent)
    return Part(
        PrandtlIshlinskii(**fields),
        bounds,
        rests(extent),
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
        rests(extent),
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
        rests(extent),
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
        {**bounds, "growth": Range(0.0, most)},
        rests(extent),
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
            "autoregressive.0": Range(-1.9, 1.9),
            "autoregressive.1": Range(-0.95, 0.95),
            **{f"linear.{j}": Range(-reach, reach) for j in range(count)},
            **{
                f"mixing.{i}.{j}": Range(-6.0, 6.0)
                for i in range(NEURONS)
                for j in range(count)
            },
            **{f"bias.{i}": Range(-4.0, 4.0) for i in range(NEURONS)},
            **{f"output.{i}": Range(-reach, reach) for i in range(NEURONS)},
            **rest_bounds(extent),
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
