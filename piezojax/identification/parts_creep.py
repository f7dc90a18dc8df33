"""Creep to fit: starts and bounds of each model."""

import numpy as np

from ..core.space import Range
from ..dynamics import ExponentialCreep, LogarithmicCreep, SpringDamperCreep
from .part import Extent, Part


def _creep_times(extent: Extent) -> tuple[float, float]:
    """Fastest and slowest creep that a record can show."""
    longest = 2.0 * extent.duration
    return max(10.0 * extent.dt, 1e-3 * longest), longest


def exponential_creep(extent: Extent) -> Part:
    """Creep as four exponentials"""
    times = np.geomspace(*_creep_times(extent), 4)
    return Part(
        ExponentialCreep((0.01,) * 4, times, extent.dt),
        {f"gains.{i}": Range(-0.5, 0.5) for i in range(4)},
    )


def logarithmic_creep(extent: Extent) -> Part:
    """Creep with the logarithm of time"""
    return Part(
        LogarithmicCreep(0.01, *_creep_times(extent), extent.dt),
        {"gain_per_decade": Range(-0.2, 0.2)},
    )


def spring_damper_creep(extent: Extent) -> Part:
    """Creep of three damped springs behind a spring"""
    times = np.geomspace(*_creep_times(extent), 3)
    # Only ratios show in a record: force and spring are those of a unit gain, and the
    # stiffness is counted in that spring's.
    stiffness = 50.0
    return Part(
        SpringDamperCreep((stiffness,) * 3, stiffness * times, 1.0, 1.0, extent.dt),
        {
            **{f"stiffness.{i}": Range(2.0, 1e4, "log") for i in range(3)},
            **{
                f"damping.{i}": Range(0.02 * stiffness * t, 50.0 * stiffness * t, "log")
                for i, t in enumerate(times)
            },
        },
    )
