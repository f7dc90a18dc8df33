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
    """Band (Hz) that the records excite, and the range of their input.

    The band is None if no line can be distinguished from noise.
    """

    band_Hz: tuple[float, float] | None  # noqa: N815
    input_range: tuple[float, float]
    input_unit: str


class Unseen(BaseModel):
    """Frequencies (Hz) and inputs of the validation part that training does not cover.

    ``band_Hz`` goes from the lowest to the highest new line, ``input_range`` is that of
    the validation part. Each is None if training covers it.
    """

    band_Hz: tuple[float, float] | None  # noqa: N815
    input_range: tuple[float, float] | None


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


def unseen_in(input: np.ndarray, dt: float, train: slice, validate: slice) -> Unseen:
    """Return the frequencies and inputs in ``validate`` that ``train`` lacks."""
    import scipy.signal  # takes long to import

    parts = [input[train], input[validate]]
    size = 2 ** int(np.log2(max(8, min(part.size for part in parts) // 4)))
    frequency = np.fft.rfftfreq(size, dt)
    powers = [
        scipy.signal.welch(part, nperseg=size, detrend="linear")[1] for part in parts
    ]
    strong = powers[1] > STRONG * powers[1].max()
    # A line next to one that was trained on is leakage of the window.
    trained = np.convolve(powers[0], np.ones(5), mode="same")
    new = np.flatnonzero(strong & (trained < NEW * powers[1]))
    low, high = parts[0].min(), parts[0].max()
    beyond = BEYOND * (high - low)
    outside = (parts[1] < low - beyond) | (parts[1] > high + beyond)
    return Unseen(
        band_Hz=(float(frequency[new[0]]), float(frequency[new[-1]]))
        if new.size
        else None,
        input_range=(float(parts[1].min()), float(parts[1].max()))
        if outside.mean() > OFTEN
        else None,
    )
