"""Noise of the lines of a frequency response, and lines merged into fewer."""

import numpy as np
import scipy.optimize

from ..records.response import FrequencyResponse

WINDOW = 7
"""Lines of the local parabola whose residual is the noise."""

SCANNED = 1000
"""Approximate number of such parabolas."""

STEADY = 40.0
"""Degrees of freedom to which a variance is smoothed before it gives weights."""

MERGED = 2e-3
"""Largest relative width of the band whose lines are merged: a fifth of the width of a
resonance of 0.5 % damping."""

MOST_LINES = 1500
"""Number of lines up to which none are merged."""


def noise_deviation(response: FrequencyResponse) -> np.ndarray:
    """Return the standard deviation [lines] of the noise of a complex response.

    Real and imaginary part together have this deviation. If the variance of the
    response is known, it is smoothed over the lines, because weights from few degrees
    of freedom would scatter. Otherwise it is estimated from the residuals of parabolas
    over WINDOW lines: it is then a + b |values|^2 with a, b >= 0, and lines at sharp
    resonances, which no parabola follows, are excluded.
    """
    gain = np.abs(response.values) ** 2
    floor = 1e-12 * np.max(gain)
    if response.variance is None:
        level = _level(*_scatter(response.frequency, response.values), 4.0)
        return np.sqrt(np.maximum(level(gain), floor))
    level = _level(response.variance, gain, np.inf)(gain)
    level = np.maximum(level, floor)
    ratio = smoothed(response.variance / level, response.freedom)
    return np.sqrt(np.maximum(level * ratio, floor))


def smoothed(variance: np.ndarray, freedom: float) -> np.ndarray:
    """Return running means of ``variance`` [lines] with STEADY degrees of freedom."""
    count = min(1 + 2 * int(0.5 * STEADY / freedom), variance.size)
    if count < 3:
        return variance
    window = np.ones(count)
    total = np.convolve(variance, window, mode="same")
    return total / np.convolve(np.ones(variance.size), window, mode="same")


def _scatter(frequency: np.ndarray, values: np.ndarray):
    """Return the variance about parabolas, and the squared gain in their middle."""
    half, lines = WINDOW // 2, np.arange(WINDOW, frequency.size + 1)
    lines = lines[:: max(1, lines.size // SCANNED)]
    power = np.empty(lines.size)
    for i, end in enumerate(lines):
        part = slice(end - WINDOW, end)
        x = frequency[part] - frequency[end - 1 - half]
        rows = np.stack([np.ones(WINDOW), x, x**2], axis=1)
        rows /= np.linalg.norm(rows, axis=0)
        left = values[part] - rows @ np.linalg.lstsq(rows, values[part], rcond=None)[0]
        power[i] = np.sum(np.abs(left) ** 2) / (WINDOW - 3)
    return power, np.abs(values[lines - 1 - half]) ** 2


def _level(power: np.ndarray, gain: np.ndarray, most: float):
    """Return the function a + b gain, with a, b >= 0, that fits ``power``.

    Values above ``most`` times the fit are left out. The search for them begins with
    the medians of the quarter with the smallest gain, for a, and of the half with the
    largest, for b.
    """
    columns = np.stack([np.ones(gain.size), gain], axis=1)
    small, middle = np.quantile(gain, [0.25, 0.5])
    parts = np.array(
        [
            np.median(power[gain <= small]),
            np.median((power / np.maximum(gain, 1e-300))[gain >= middle]),
        ]
    )
    for _ in range(10):
        expected = np.maximum(columns @ parts, 1e-300)
        near = power < most * expected
        if not near.any():
            break
        rows = (columns / expected[:, None])[near]
        parts = scipy.optimize.nnls(rows, (power / expected)[near])[0]
    return lambda gain: parts[0] + parts[1] * gain


def merged(
    frequency: np.ndarray, values: np.ndarray, deviation: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the lines, averaged in narrow bands if there are more than MOST_LINES.

    Lines within a band of the relative width MERGED become their mean, weighted by 1 /
    deviation^2.
    """
    if frequency.size <= MOST_LINES:
        return frequency, values, deviation
    band = np.floor(np.log(frequency / frequency[0]) / np.log1p(MERGED))
    first = np.flatnonzero(np.diff(band, prepend=-1.0))
    weight = deviation**-2.0
    total = np.add.reduceat(weight, first)
    means = [
        np.add.reduceat(weight * each, first) / total for each in (frequency, values)
    ]
    return means[0], means[1], total**-0.5
