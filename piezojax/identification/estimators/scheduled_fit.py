"""Models that change with the drive level, from records at several levels."""

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
    """Fit dynamics that follow the drive level to periodic records, grouped by level.

    Each level's model is ``refined`` from ``start``, one model for all of them, so that
    their modes correspond and what lies between two levels is interpolated mode by
    mode. A level is the rms of its records' inputs; ``time_constant`` (s) is that of
    its measurement in the model. Levels may come in any order. Raises ValueError as
    ``empirical_response`` and AmplitudeScheduled do.
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
