"""Empirical frequency response between two measured signals, and its variance."""

from typing import NamedTuple

import numpy as np

EXCITED = 1e-6
"""Least input power of a returned line, as a share of the strongest line."""

AVERAGES = 8
"""Number of segments without overlap into which a record is divided by default."""

SHORTEST = 32
"""Least number of samples in a segment."""

OVERLAP = 1.0 / (1.0 + 2.0 / 36.0)
"""Independent averages for each half-overlapping segment under a Hann window: the
windows have the correlation 1/6 (Welch 1967, IEEE Trans. Audio Electroacoustics 15)."""


class SpectralResponse(NamedTuple):
    """A measured frequency response of one input and one output, line by line.

    ``frequency`` [lines] in Hz; ``response`` [lines], complex, output over input;
    ``variance`` [lines], the expected square of the modulus of its error; ``coherence``
    [lines], the share of the output power that the input explains linearly, 0 to 1;
    ``power`` [lines], the power of the input in each line, in its unit squared;
    ``averages``, the number of independent averages.
    """

    frequency: np.ndarray
    response: np.ndarray
    variance: np.ndarray
    coherence: np.ndarray
    power: np.ndarray
    averages: float


def spectral_response(
    input: np.ndarray,
    output: np.ndarray,
    dt: float,
    *,
    period: int | None = None,
    segment: int | None = None,
    least: float = EXCITED,
) -> SpectralResponse:
    """Estimate the frequency response from ``input`` to ``output`` [samples].

    With a ``period`` (samples) it is the ratio of the discrete Fourier transforms,
    averaged over the whole periods at the end of the record: exact in steady state.
    Without one it is the estimate of Welch, from half-overlapping segments of
    ``segment`` samples under a Hann window, with means and slopes removed. Lines in
    which the input has less than the share ``least`` of the power of its strongest line
    are left out. ``dt`` in s. Source of the variance: Bendat and Piersol, Random Data,
    4th ed., section 9.2.

    Raises ValueError for signals of different length, fewer than two whole periods or
    segments, or an input that never changes.
    """
    input, output = np.asarray(input, float), np.asarray(output, float)
    if input.ndim != 1 or input.shape != output.shape:
        raise ValueError(
            f"input has the shape {input.shape} and output {output.shape}; "
            "both must be [samples]"
        )
    if np.ptp(input) == 0.0:
        raise ValueError("the input never changes; it excites no frequency")
    if period is not None:
        return _periodic(input, output, dt, period, least)
    return _welch(input, output, dt, segment, least)


def _periodic(
    input: np.ndarray, output: np.ndarray, dt: float, period: int, least: float
) -> SpectralResponse:
    whole = input.size // period if period > 1 else 0
    if whole < 2:
        raise ValueError(
            f"the period is {period} samples; {input.size} samples must hold two"
        )
    inputs, outputs = (
        np.fft.rfft(signal[-whole * period :].reshape(whole, period), axis=1) / period
        for signal in (input, output)
    )
    frequency = np.fft.rfftfreq(period, dt)
    mean, total = outputs.mean(axis=0), np.mean(np.abs(outputs) ** 2, axis=0)
    noise = np.var(outputs, axis=0, ddof=1) / whole
    driven = inputs.mean(axis=0)
    power = np.abs(driven) ** 2
    kept = _excited(power, least)
    return SpectralResponse(
        frequency[kept],
        mean[kept] / driven[kept],
        noise[kept] / power[kept],
        np.abs(mean[kept]) ** 2 / np.maximum(total[kept], np.finfo(float).tiny),
        power[kept],
        whole,
    )


def _welch(
    input: np.ndarray,
    output: np.ndarray,
    dt: float,
    segment: int | None,
    least: float,
) -> SpectralResponse:
    import scipy.signal  # takes long to import

    size, count = segment_size(input.size, segment)
    settings = {"fs": 1.0 / dt, "nperseg": size, "detrend": "linear"}
    settings["scaling"] = "spectrum"
    frequency, power = scipy.signal.welch(input, **settings)
    _, total = scipy.signal.welch(output, **settings)
    _, cross = scipy.signal.csd(input, output, **settings)
    kept = _excited(power, least)
    frequency, power, total, cross = (
        values[kept] for values in (frequency, power, total, cross)
    )
    explained = np.abs(cross) ** 2 / power
    coherence = np.clip(explained / np.maximum(total, np.finfo(float).tiny), 0.0, 1.0)
    averages = OVERLAP * count
    return SpectralResponse(
        frequency,
        cross / power,
        (total - explained).clip(0.0) / power / averages,
        coherence,
        power,
        averages,
    )


def segment_length(samples: int) -> int:
    """Return the default number of samples in a segment, a power of 2.

    AVERAGES segments fit into ``samples``, unless they would be shorter than SHORTEST.
    """
    return max(SHORTEST, 2 ** int(np.log2(max(1, samples // AVERAGES))))


def segment_size(samples: int, segment: int | None) -> tuple[int, int]:
    """Return the size of half-overlapping segments, and their number in ``samples``.

    Without a ``segment`` it is ``segment_length``. Raises ValueError for a segment that
    is too short, or of which two do not fit.
    """
    size = segment or segment_length(samples)
    count = (2 * samples) // size - 1
    if size < SHORTEST or count < 2:
        raise ValueError(
            f"the segment is {size} samples; it must be at least {SHORTEST} and "
            f"{samples} samples must hold two that overlap by half"
        )
    return size, count


def _excited(power: np.ndarray, least: float) -> np.ndarray:
    """Return the lines that the input excites, without the line at 0 Hz."""
    alternating = np.r_[0.0, power[1:]]
    return np.flatnonzero(alternating > least * alternating.max())
