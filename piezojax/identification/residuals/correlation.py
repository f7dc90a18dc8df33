"""Tests of a residual: whiteness, and correlation with the input.

Source: Ljung, System Identification, 2nd ed., section 16.6.
"""

import numpy as np
from pydantic import BaseModel

LAGS = 25
"""Largest lag of the tests, samples."""

NORMAL = 3.54
"""Half-width, in standard deviations, of the interval that holds all LAGS normal
estimates at once with a probability of 99 % (Bonferroni)."""


class Correlation(BaseModel):
    """Largest correlation over the lags of a test.

    ``value`` (-1 to 1) at ``lag`` (samples); a residual without any correlation stays
    within ``bound`` at all lags with a probability of 99 %.
    """

    value: float
    lag: int
    bound: float

    @property
    def significant(self) -> bool:
        """Whether the correlation lies outside its bound."""
        return abs(self.value) > self.bound


def autocorrelation(residual: np.ndarray) -> Correlation:
    """Return the largest autocorrelation of ``residual`` [samples] at lags above 0."""
    own = _covariance(residual, residual)
    return _largest(
        own[1 : LAGS + 1] / (own[0] or 1.0), NORMAL / np.sqrt(residual.size), 1
    )


def cross_correlation(residual: np.ndarray, input: np.ndarray) -> Correlation:
    """Return the largest correlation of ``residual`` with earlier values of ``input``.

    Both [samples]. The variance of the estimate is the sum of the products of both
    autocorrelations over the number of samples (Ljung, 16.61): coloured signals
    correlate by chance.
    """
    both = _covariance(residual, input)
    of_residual, of_input = (_covariance(x, x) for x in (residual, input))
    # A residual of zero has no correlation.
    scale = np.sqrt(of_residual[0] * of_input[0]) or 1.0
    # Far lags are noise: taper them.
    lags = min(residual.size, residual.size // 4 + 1)
    products = of_residual[:lags] * of_input[:lags] / scale**2
    products *= 1.0 - np.arange(lags) / lags
    variance = max(1.0, products[0] + 2.0 * np.sum(products[1:])) / residual.size
    return _largest(both[: LAGS + 1] / scale, NORMAL * np.sqrt(variance), 0)


def _covariance(left: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Return the mean of left(k + lag) right(k) at lags from 0, without the means."""
    size = 2 ** int(np.ceil(np.log2(2 * left.size)))
    spectra = [np.fft.rfft(x - np.mean(x), size) for x in (left, right)]
    return np.fft.irfft(spectra[0] * spectra[1].conj(), size)[: left.size] / left.size


def _largest(values: np.ndarray, bound: float, first: int) -> Correlation:
    place = int(np.argmax(np.abs(values)))
    return Correlation(
        value=float(values[place]), lag=place + first, bound=float(bound)
    )
