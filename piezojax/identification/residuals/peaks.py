"""Resonances that a model lacks, from its relative error by frequency."""

from collections.abc import Sequence

import numpy as np
from pydantic import BaseModel

from .bound import RelativeError

LEAST = 1.0
"""Least relative error of a peak: the error equals the gain of the model."""

SHARP = 3.0
"""Height of a peak over its surroundings, as a factor."""

VISIBLE = 0.01
"""Least amplitude of a peak, as a share of the model's gain at the lowest line."""

FLANK = 0.5
"""Least error of a sure line near a peak, as a share of that of the peak."""

TOP = 0.9
"""Ratio of the lower ends of two lines above which either may be the top of a peak."""

CLEAR = 3.0
"""Largest noise of a line that counts as having little, as a multiple of the least
noise on its side of the peak."""

ENOUGH = 4
"""Least number of lines on a side of a peak."""

NEAR = 0.8, 1.25
"""Bounds on the ratio of two frequencies of the same peak."""

MOST = 3
"""Largest number of peaks in a report."""


class Peak(BaseModel):
    """A resonance that the model lacks: frequency (Hz), error over the model's gain."""

    frequency_Hz: float  # noqa: N815
    times_gain: float


def unmodelled_peaks(found: RelativeError) -> list[Peak]:
    """Return the resonances that the model lacks, the surest first.

    A peak counts if the lower end of its interval is above ``LEAST``, a line on its
    flanks is sure and has a similar error (at the top leakage widens the interval), and
    its error exceeds the median errors on both sides within an octave by the factor
    ``SHARP``.
    """
    frequency, error = found.frequency, found.error
    amplitude = found.lower * found.gain / max(found.gain[0], np.finfo(float).tiny)
    sure = found.sure & (found.lower > LEAST)
    kept: list[int] = []
    peaks: list[Peak] = []
    large = np.flatnonzero((found.lower > LEAST) & (amplitude > VISIBLE))
    for i in large[np.argsort(found.lower[large], kind="stable")[::-1]]:
        ratio = frequency / frequency[i]
        near = (ratio > NEAR[0]) & (ratio < NEAR[1])
        flank = sure[near] & (error[near] >= FLANK * error[i])
        if near[kept].any() or not flank.any():
            continue
        sides = (
            (ratio > 0.5) & (ratio <= NEAR[0]),
            (ratio >= NEAR[1]) & (ratio < 2.0),
        )
        levels = [_level(found, side) for side in sides if side.sum() >= ENOUGH]
        if levels and error[i] > SHARP * max(levels):
            kept.append(int(i))
            highest = near & (found.lower > TOP * found.lower[i])
            top = int(np.argmax(np.where(highest, error, 0.0)))
            peaks.append(
                Peak(frequency_Hz=float(frequency[top]), times_gain=float(error[top]))
            )
    return peaks[:MOST]


def joined_peaks(each: Sequence[Sequence[Peak]]) -> list[Peak]:
    """Return the peaks of several records, the largest of those ``NEAR`` each other."""
    if len(each) == 1:
        return list(each[0])
    kept: list[Peak] = []
    for peak in sorted((p for one in each for p in one), key=lambda p: -p.times_gain):
        ratios = [peak.frequency_Hz / other.frequency_Hz for other in kept]
        if not any(NEAR[0] < ratio < NEAR[1] for ratio in ratios):
            kept.append(peak)
    return kept[:MOST]


def _level(found: RelativeError, side: np.ndarray) -> float:
    """Return the median error of the lines of ``side`` with little noise.

    Between the lines of a multisine the error is noise, which would hide a peak. The
    mean power of the noise is subtracted.
    """
    clear = side & (found.margin <= CLEAR * found.margin[side].min())
    noise = 2.0 * found.deviation[clear] ** 2
    return float(np.median(np.sqrt(np.maximum(found.error[clear] ** 2 - noise, 0.0))))
