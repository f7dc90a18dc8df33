"""Resonances that a model lacks, from its relative error by frequency."""

import numpy as np
from pydantic import BaseModel

from .bound import RelativeError

LEAST = 1.0
"""Least relative error of a peak: the error equals the gain of the model."""

SHARP = 3.0
"""Height of a peak over its surroundings, as a factor."""

VISIBLE = 0.01
"""Least amplitude of a peak, as a share of the model's gain at the lowest line."""

MOST = 3
"""Largest number of peaks in a report."""


class Peak(BaseModel):
    """A resonance that the model lacks: frequency (Hz), error over the model's gain."""

    frequency_Hz: float  # noqa: N815
    times_gain: float


def unmodelled_peaks(found: RelativeError) -> list[Peak]:
    """Return the resonances that the model lacks, the highest first.

    A peak counts if the lower end of its interval is above ``LEAST``, a line on its
    flanks is sure (at the top leakage widens the interval), and it exceeds the median
    within an octave by the factor ``SHARP``.
    """
    frequency, error = found.frequency, found.error
    amplitude = found.lower * found.gain / max(found.gain[0], np.finfo(float).tiny)
    sure = found.sure & (found.lower > LEAST)
    kept: list[int] = []
    for i in np.argsort(error)[::-1]:
        ratio = frequency / frequency[i]
        around = (ratio > 0.5) & (ratio < 2.0)
        near = (ratio > 0.8) & (ratio < 1.25)
        outside = error[around & ~near]
        large = found.lower[i] > LEAST and amplitude[i] > VISIBLE
        if not large or not sure[near].any() or outside.size < 4:
            continue
        taken = any(0.8 < frequency[i] / frequency[j] < 1.25 for j in kept)
        if not taken and error[i] > SHARP * np.median(outside):
            kept.append(int(i))
    return [
        Peak(frequency_Hz=float(frequency[i]), times_gain=float(error[i]))
        for i in kept[:MOST]
    ]
