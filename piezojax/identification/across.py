"""Errors of a model on records that its fit left out, one record at a time.

A part of the same record holds the same excitation as the part that was fitted, so its
errors may rank models wrongly. Another record has its own excitation.
"""

from collections.abc import Callable, Sequence

import numpy as np

from .fit import Fit
from .records.record import Record
from .validation import validate

FitTo = Callable[[tuple[Record, ...], slice], Fit]
"""``fit_to(records, part)`` fits a model to the samples ``part`` of ``records``."""


def errors_across(
    records: Sequence[Record], fit_to: FitTo
) -> tuple[np.ndarray, ...] | None:
    """Return the errors [samples, p] on each of ``records``, after a fit to the others.

    Each fit takes all samples of the other records. As in ``validate``, the initial
    state and the zero of the left-out record are estimated on its first part, and the
    errors are those over the rest. Returns None if a fit fails or a free run diverges:
    such a model does not hold on another record.
    """
    found = []
    for left_out, record in enumerate(records):
        others = tuple(r for i, r in enumerate(records) if i != left_out)
        try:
            fit = fit_to(others, slice(0, max(other.samples for other in others)))
            judged = validate(fit.system, fit.about, record)
        # The failure of one model must not end a comparison.
        except Exception:
            return None
        (check,) = judged.report.records
        if check.rmse is None:
            return None
        error = judged.runs[0] - judged.records[0].outputs
        found.append(error[slice(*check.judged)])
    return tuple(found)
