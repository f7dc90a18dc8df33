"""Spectra of short records, and what in them the reference foretells.

The disturbance that hysteresis makes of a periodic reference is periodic, and lines can
be predicted without error by who knows their frequencies and may wait for ever. So a
spectrum is only meaningful with its resolution: Welch's method (IEEE Trans. Audio
Electroacoustics 15 (1967) 70-73) over Hann windows of a tenth of a second that overlap
by half takes as unforeseeable what a tenth of a second does not tell. Longer windows
lower the limit; their length is part of every figure made with them.
"""

import numpy as np

TAPS = 100
"""Of the filter that foretells: a millisecond apart in a tenth of a second."""

LEAST_SHARE = 1e-10
"""Power of a direction in the taps, over the largest's, that tells something."""


class Foretelling:
    """What one linear filter of the reference, which may look ahead, makes of signals.

    ``references`` [references, samples] in um, at rest before they begin. The filter
    reaches ``reach`` samples back and as far ahead, so signals are told apart from
    sample ``start`` to that far from the end: ``count`` samples. It is fitted to
    all references at once, by least squares of differences from sample to sample:
    what is slow weighs less, since feedback sees to that.
    """

    def __init__(self, references: np.ndarray, start: int, reach: int):
        padded = np.pad(references, ((0, 0), (reach, 0)), mode="edge")
        ahead_and_back = np.lib.stride_tricks.sliding_window_view(
            padded, 2 * reach + 1, axis=1
        )
        self._whole = ahead_and_back[:, :, :: max(2 * reach // TAPS, 1)]
        self._seen = self._whole[:, start:]
        self._start, self.count = start, self._seen.shape[1]
        steps = self._steps()
        power, directions = np.linalg.eigh(sum(step.T @ step for step in steps))
        telling = power > LEAST_SHARE * max(power[-1], np.finfo(float).tiny)
        self._directions = directions[:, telling]
        self._power = power[telling]

    def _steps(self) -> list[np.ndarray]:
        return [np.diff(seen, axis=0) for seen in self._seen]

    def cut(self, signals: np.ndarray) -> np.ndarray:
        """Return ``signals`` [..., samples] where they are told apart, less means."""
        part = self.told_apart(signals)
        return part - part.mean(axis=-1, keepdims=True)

    def told_apart(self, signals: np.ndarray) -> np.ndarray:
        """Return ``signals`` [..., samples] where they are told apart."""
        return signals[..., self._start : self._start + self.count]

    def weights(self, signals: np.ndarray) -> np.ndarray:
        """Return the filter's taps, the earliest reference first.

        ``signals`` are [references, draws, samples]. All draws of a reference are
        foretold alike: their mean says how.
        """
        moved = np.diff(self.cut(signals).mean(axis=1), axis=1)
        product = sum(s.T @ m for s, m in zip(self._steps(), moved, strict=True))
        return self._directions @ (self._directions.T @ product / self._power)

    def unforeseen(self, signals: np.ndarray) -> np.ndarray:
        """Return what is left [references, draws, count] of signals, means removed.

        ``signals`` are [references, draws, samples].
        """
        weights = self.weights(signals)
        told = np.stack([seen @ weights for seen in self._seen])
        told -= told.mean(axis=1, keepdims=True)
        return self.cut(signals) - told[:, None]

    def foretold(self, signals: np.ndarray) -> np.ndarray:
        """Return the filter's work [references, samples] on whole records.

        With the mean that ``signals`` have; held where the record does not say what
        comes next.
        """
        weights = self.weights(signals)
        told = np.stack([seen @ weights for seen in self._whole])
        mean = self.told_apart(signals).mean(axis=(1, 2))
        told += (mean - self.told_apart(told).mean(axis=1))[:, None]
        missing = signals.shape[-1] - told.shape[1]
        return np.pad(told, ((0, 0), (0, missing)), mode="edge")


def grid_size(segment: int) -> int:
    """Return how many points the circle needs for spectra of ``segment`` samples.

    Factors of a spectrum have longer memories than it: 32 times, and no fewer than
    2^14 points for the plant's own.
    """
    return max(2**14, 2 ** int(np.ceil(np.log2(32 * segment))))


def windowed(records: np.ndarray, segment: int, points: int) -> np.ndarray:
    """Return the transforms [..., segments, lines] of ``records`` [..., samples].

    Lines are those of the upper half of a circle of ``points``, both ends included. The
    mean squared magnitude is the spectrum whose mean over the circle is the variance.
    """
    # A window that fits its period: without the zero that ends a symmetric one.
    window = 0.5 - 0.5 * np.cos(2.0 * np.pi * np.arange(segment) / segment)
    window /= np.sqrt(np.sum(window**2))
    starts = range(0, records.shape[-1] - segment + 1, max(segment // 2, 1))
    cut = np.stack([records[..., k : k + segment] for k in starts], axis=-2)
    return np.fft.rfft(cut * window, points)


def spectra(transforms: np.ndarray) -> np.ndarray:
    """Return the mean spectra [references, points] of transforms [references, ...].

    They go all around the circle.
    """
    middle = tuple(range(1, transforms.ndim - 1))
    upper = np.mean(np.abs(transforms) ** 2, axis=middle)
    return np.concatenate([upper, upper[:, -2:0:-1]], axis=1)
