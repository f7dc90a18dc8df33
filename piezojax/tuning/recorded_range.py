"""Alarms for voltages of a study that the record of its plant does not cover."""

from collections.abc import Iterator

import numpy as np

from ..study import Case
from .data import Data, holding_inputs, own_stage

COVERED = 0.25
"""Least ratio of the smaller to the larger of the ranges of record and actuator."""

SLACK = 0.1
"""Share of the recorded range by which the references may leave it: hysteresis changes
the input that holds a displacement by as much."""


def recorded_range_alarms(case: Case, data: Data) -> Iterator[str]:
    """Yield alarms for references outside the record, and for ranges that differ.

    The ranges of record and actuator differ if the smaller is at most COVERED times the
    larger. Only a fitted plant has a recorded range.
    """
    study, ranges = case.study, case.plant_about.input_ranges
    if len(ranges) != study.axis_count:
        return
    names = study.axes.names if study.axes else ("",)
    references = np.asarray(data.holdout.references)
    ends = np.stack([f(references, axis=(0, 1)) for f in (np.min, np.max)])
    needed = np.sort(np.asarray(holding_inputs(own_stage(case.loop), ends))[0], axis=0)
    actuator = (study.by_axis(x) for x in (study.actuator.lower, study.actuator.upper))
    axes = zip(names, ranges, needed.reshape(2, -1).T, *actuator, strict=True)
    for name, (low, high), (least, most), lower, upper in axes:
        of_axis = f" of axis {name}" if name else ""
        slack = SLACK * (high - low)
        if least < low - slack or most > high + slack:
            yield (
                f"the references{of_axis} need {least:.4g} to {most:.4g} V, but the "
                f"record of the plant covers {low:.4g} to {high:.4g} V: outside it "
                "the model extrapolates; record the whole range, or reduce "
                "references.amplitude"
            )
        ratio = (high - low) / (upper - lower)
        if not COVERED < ratio < 1.0 / COVERED:
            yield (
                f"the record of the plant{of_axis} covers {low:.4g} to {high:.4g} V, "
                f"the actuator {lower:g} to {upper:g} V: if one of them is the voltage "
                "before an amplifier, multiply it by the gain; if not, record the "
                "range that is used, or set actuator.lower and actuator.upper to the "
                "recorded range"
            )
