"""Alarms for voltages of a study that the record of its plant does not cover."""

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np

from ..study import Case
from .data import Data, holding_inputs, own_stage

if TYPE_CHECKING:
    from .outcome import Outcome

COVERED = 0.25
"""Least ratio of the smaller to the larger of the ranges of record and actuator."""

SLACK = 0.1
"""Share of the recorded range by which the references may leave it: hysteresis changes
the input that holds a displacement by as much. Also the share by which the slew rate
may exceed that of the record."""


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


def recorded_slew_alarms(case: Case, outcome: "Outcome") -> Iterator[str]:
    """Yield an alarm for each axis whose voltage moves faster than in the record.

    An amplifier that cannot follow is not in the model then. A study that gives a slew
    rate or a current limit of the amplifier simulates it, and has no alarm.
    """
    study, slews = case.study, case.plant_about.input_slews
    limits = study.actuator.slew_rate, study.actuator.current_limit
    if len(slews) != study.axis_count or limits != (None, None):
        return
    _, tuned = outcome.drive
    for (name, drive), recorded in zip(tuned.items(), slews, strict=True):
        peak = drive.slew_peak_V_per_s
        if peak is None or peak <= (1.0 + SLACK) * recorded:
            continue
        of_axis = f" of axis {name}" if study.axes else ""
        yield (
            f"the tuned loop moves the voltage{of_axis} at up to {peak:.4g} V/s, but "
            f"the record of the plant at most at {recorded:.4g} V/s: an amplifier that "
            "cannot follow can make the loop unstable; set actuator.slew_rate to what "
            "yours reaches, record faster motions (python -m piezojax.excite), or "
            "limit constraints.peak_slew"
        )
