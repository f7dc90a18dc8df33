"""Frequencies and amplitudes that a record excites, and those new in validation."""

from collections.abc import Sequence

import numpy as np
from pydantic import BaseModel

from ...core.error_bound import ErrorBound
from ..records.record import Record

STRONG = 1e-3
"""Least power of a line of the validation part, as a share of its strongest line."""

NEW = 1e-3
"""Largest power of a line in training, as a share of that in validation, at which the
line counts as new."""

BEYOND = 0.15
"""Share of the input's training range by which a sample must leave it to count."""

OFTEN = 0.01
"""Share of such samples in the validation part above which its range is new."""


class Coverage(BaseModel):
    """Band (Hz) that the records excite, and the range of their first input.

    The band is None if no line can be distinguished from noise.
    """

    band_Hz: tuple[float, float] | None  # noqa: N815
    input_range: tuple[float, float]
    input_unit: str


class Unseen(BaseModel):
    """Frequencies (Hz) and inputs of the validation part that training does not cover.

    ``band_Hz`` goes from the lowest to the highest new line of all inputs. ``input`` is
    the number, from 0, of the first input that leaves its training range, and
    ``input_range`` its range in the validation parts that leave it. ``band_Hz`` and
    ``input_range`` are None if there is nothing new.
    """

    band_Hz: tuple[float, float] | None  # noqa: N815
    input_range: tuple[float, float] | None
    input: int = 0


def coverage_of(records: Sequence[Record], bound: ErrorBound | None) -> Coverage:
    """Return the band and the range that ``records`` excite, from their ``bound``."""
    inputs = np.concatenate([record.inputs[:, 0] for record in records])
    band = None
    if bound is not None and any(bound.excited):
        lines = np.asarray(bound.frequency)[np.asarray(bound.excited)]
        band = (float(lines[0]), float(lines[-1]))
    return Coverage(
        band_Hz=band,
        input_range=(float(inputs.min()), float(inputs.max())),
        input_unit=records[0].input_unit,
    )


def unseen_in(records: Sequence[Record], train: slice, validate: slice) -> Unseen:
    """Return the frequencies and inputs in ``validate`` that ``train`` lacks.

    A line or a range counts as covered if ``train`` of any record covers it.
    """
    bands, ranges = [], {}
    for number in range(records[0].inputs.shape[1]):
        trained, validated = (
            [x for record in records if (x := record.inputs[part, number]).size]
            for part in (train, validate)
        )
        bands += _new_lines(trained, validated, records[0].dt)
        if (beyond := _new_range(trained, validated)) is not None:
            ranges[number] = beyond
    first = min(ranges, default=0)
    return Unseen(
        band_Hz=(float(min(bands)), float(max(bands))) if bands else None,
        input_range=ranges.get(first),
        input=first,
    )


def _new_lines(
    trained: Sequence[np.ndarray], validated: Sequence[np.ndarray], dt: float
) -> list[float]:
    """Return the frequencies (Hz) of strong lines that no training part has."""
    import scipy.signal  # takes long to import

    longest = min(max(x.size for x in parts) for parts in (trained, validated))
    size = 2 ** int(np.log2(max(8, longest // 4)))
    known, powers = (
        [
            scipy.signal.welch(x, nperseg=size, detrend="linear")[1]
            for x in parts
            if x.size >= size
        ]
        for parts in (trained, validated)
    )
    frequency = np.fft.rfftfreq(size, dt)
    # A line next to one that was trained on is leakage of the window.
    known = [np.convolve(power, np.ones(5), mode="same") for power in known]
    covered = np.max([np.zeros(frequency.size), *known], axis=0)
    new = [(x > STRONG * x.max()) & (covered < NEW * x) for x in powers]
    return [x for each in new for x in frequency[each]]


def _new_range(
    trained: Sequence[np.ndarray], validated: Sequence[np.ndarray]
) -> tuple[float, float] | None:
    """Return the range of the validation parts that leave that of training, if any."""
    low, high = min(x.min() for x in trained), max(x.max() for x in trained)
    margin = BEYOND * (high - low)
    outside = [
        x
        for x in validated
        if np.mean((x < low - margin) | (x > high + margin)) > OFTEN
    ]
    if not outside:
        return None
    return float(min(x.min() for x in outside)), float(max(x.max() for x in outside))
