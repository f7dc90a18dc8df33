"""Alarms of a study that leaves the inputs of the record its plant was fitted to."""

from collections.abc import Iterator

import numpy as np

from ..study import Case
from .data import Data, holding_inputs, own_stage

COVERED = 0.25
"""Least share of the range of the actuator that a record should cover."""

SLACK = 0.1
"""Share of the recorded range by which the references may leave it: the input that
holds a displacement depends on the history of the stage by this order."""


def recorded_range_alarms(case: Case, data: Data) -> Iterator[str]:
    """Yield an alarm for each axis whose model is used far outside of its record.

    Each names the ranges and the next step. Only a fitted plant has a recorded range.
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
                f"record of the plant ends at {low:.4g} and {high:.4g} V: beyond it "
                "the model is a guess; record the whole range, or reduce "
                "references.amplitude"
            )
        if high - low < COVERED * (upper - lower):
            yield (
                f"the record of the plant{of_axis} goes from {low:.4g} to {high:.4g} V "
                f"only, the actuator from {lower:g} to {upper:g} V: if the record has "
                "the voltage before an amplifier, multiply it by the gain; if not, "
                "record a larger range, or set actuator.lower and actuator.upper to "
                "what was recorded"
            )
