"""Spectra of short records, and prediction of records from the reference.

A hysteresis under a periodic reference makes a periodic disturbance, which is
predictable without error given its frequencies and unlimited time. A spectrum is
therefore meaningful only together with its resolution. Spectra are computed by Welch's
method (IEEE Trans. Audio Electroacoustics 15 (1967) 70-73) with Hann windows of a tenth
of a second by default, which overlap by half. Whatever a window cannot resolve counts
as unpredictable. Longer windows lower the limit; their length is part of every figure
computed with them.
"""

import numpy as np

TAPS = 100
"""Approximate number of taps of the reference's filter: 1 ms apart for windows of a
tenth of a second."""

LEAST_SHARE = 1e-10
"""Smallest eigenvalue, relative to the largest, whose eigenvector the fit of the taps
uses."""


class ReferencePredictor:
    """Prediction of signals by one linear, non-causal filter of the reference.

    ``references`` [references, samples] in um are taken as constant before their first
    sample. The filter reaches ``reach`` samples back and ahead. Signals are therefore
    predicted on ``count`` samples: from ``start`` to ``reach`` samples before the end.
    The filter is fitted to all references at once, by least squares of the differences
    between consecutive samples: slow parts weigh less, because feedback removes them.
    """

    def __init__(self, references: np.ndarray, start: int, reach: int):
        padded = np.pad(references, ((0, 0), (reach, 0)), mode="edge")
        ahead_and_back = np.lib.stride_tricks.sliding_window_view(
            padded, 2 * reach + 1, axis=1
        )
        self._whole = ahead_and_back[:, :, :: max(2 * reach // TAPS, 1)]
        self._counted = self._whole[:, start:]
        self._start, self.count = start, self._counted.shape[1]
        steps = self._steps()
        power, directions = np.linalg.eigh(sum(step.T @ step for step in steps))
        strong = power > LEAST_SHARE * max(power[-1], np.finfo(float).tiny)
        self._directions = directions[:, strong]
        self._power = power[strong]

    def _steps(self) -> list[np.ndarray]:
        return [np.diff(rows, axis=0) for rows in self._counted]

    def centred(self, signals: np.ndarray) -> np.ndarray:
        """Return ``signals`` [..., samples] on the predicted samples, means removed."""
        part = self.window(signals)
        return part - part.mean(axis=-1, keepdims=True)

    def window(self, signals: np.ndarray) -> np.ndarray:
        """Return ``signals`` [..., samples] on the predicted samples [..., count]."""
        return signals[..., self._start : self._start + self.count]

    def weights(self, signals: np.ndarray) -> np.ndarray:
        """Return the taps of the filter, the earliest sample of the reference first.

        ``signals`` are [references, draws, samples]. The filter is fitted to the mean
        over the draws of each reference.
        """
        moved = np.diff(self.centred(signals).mean(axis=1), axis=1)
        product = sum(s.T @ m for s, m in zip(self._steps(), moved, strict=True))
        return self._directions @ (self._directions.T @ product / self._power)

    def unpredicted(self, signals: np.ndarray) -> np.ndarray:
        """Return the unpredicted part [references, draws, count], means removed.

        ``signals`` are [references, draws, samples].
        """
        weights = self.weights(signals)
        predicted = np.stack([rows @ weights for rows in self._counted])
        predicted -= predicted.mean(axis=1, keepdims=True)
        return self.centred(signals) - predicted[:, None]

    def predicted(self, signals: np.ndarray) -> np.ndarray:
        """Return the predicted part [references, samples] on whole records.

        It has the mean of ``signals`` [references, draws, samples]. The last value is
        held where the filter would reach beyond the end of the record.
        """
        weights = self.weights(signals)
        predicted = np.stack([rows @ weights for rows in self._whole])
        mean = self.window(signals).mean(axis=(1, 2))
        predicted += (mean - self.window(predicted).mean(axis=1))[:, None]
        missing = signals.shape[-1] - predicted.shape[1]
        return np.pad(predicted, ((0, 0), (0, missing)), mode="edge")


def grid_size(segment: int) -> int:
    """Return the number of points around the circle for windows of ``segment`` samples.

    The impulse response of a spectral factor is longer than the autocovariance. The
    circle therefore has at least 32 times as many points as a window has samples, and
    at least 2^14 because of the impulse response of the plant.
    """
    return max(2**14, 2 ** int(np.ceil(np.log2(32 * segment))))


def windowed(records: np.ndarray, segment: int, points: int) -> np.ndarray:
    """Return the transforms [..., segments, lines] of ``records`` [..., samples].

    Lines are those of the upper half of a circle of ``points``, both ends included. The
    mean squared magnitude is the spectrum, whose mean over the circle is the variance.
    """
    # A periodic Hann window: without the last zero of a symmetric one.
    window = 0.5 - 0.5 * np.cos(2.0 * np.pi * np.arange(segment) / segment)
    window /= np.sqrt(np.sum(window**2))
    starts = range(0, records.shape[-1] - segment + 1, max(segment // 2, 1))
    cut = np.stack([records[..., k : k + segment] for k in starts], axis=-2)
    return np.fft.rfft(cut * window, points)


def spectra(transforms: np.ndarray) -> np.ndarray:
    """Return the mean spectra [references, points] of transforms [references, ...].

    ``points`` covers the whole circle.
    """
    middle = tuple(range(1, transforms.ndim - 1))
    upper = np.mean(np.abs(transforms) ** 2, axis=middle)
    return np.concatenate([upper, upper[:, -2:0:-1]], axis=1)
