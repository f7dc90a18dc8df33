"""Fit of amplitude-scheduled models to records at several drive levels."""

from collections.abc import Sequence

import numpy as np

from ...dynamics import AmplitudeScheduled, StateSpace
from ..records.record import Record
from .frequency import empirical_response
from .response_fit import STEPS, refined


def fit_scheduled(
    levels: Sequence[Sequence[Record]],
    start: StateSpace,
    *,
    time_constant: float = 0.1,
    steps: int = STEPS,
) -> AmplitudeScheduled:
    """Fit dynamics scheduled by drive level to periodic records, grouped by level.

    The model of each level is ``refined`` from the common ``start``, so that modes
    correspond and can be interpolated between two levels. The level is the rms of the
    inputs of its records; ``time_constant`` (s) is that of the level's measurement in
    the model. Levels may come in any order. Raises ValueError as ``empirical_response``
    and AmplitudeScheduled do.
    """
    drive = [
        np.sqrt(np.mean([np.mean(record.inputs**2) for record in records]))
        for records in levels
    ]
    rising = np.argsort(drive)
    models = [refined(start, empirical_response(levels[i]), steps)[0] for i in rising]
    return AmplitudeScheduled(
        tuple(models), tuple(drive[i] for i in rising), time_constant
    )
