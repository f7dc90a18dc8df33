"""Coloured errors: how many are independent, and the filter that makes them white."""

from collections.abc import Sequence

import numpy as np

from .refined import NOISE_ORDER


def independent(errors: np.ndarray) -> float:
    """Return the number of independent ``errors``, [samples] or [samples, p].

    It is twice the participation ratio of their spectrum, at least 1. White noise has
    half as many as samples, because its lines differ by chance.
    """
    powers = np.abs(np.fft.rfft(errors, axis=0)) ** 2
    largest = np.maximum(np.sum(powers**2), np.finfo(float).tiny)
    return max(2.0 * float(np.sum(powers) ** 2 / largest), 1.0)


def whitening_filter(errors: Sequence[np.ndarray]) -> np.ndarray:
    """Return the filter [NOISE_ORDER + 1] that makes ``errors`` white.

    ``errors`` are stretches [samples] of one process. The filter is found by least
    squares, because the Yule-Walker equations include the edges of a stretch, and leave
    strongly coloured errors correlated. The first coefficient is 1. A stretch of too
    few samples is not used; if all are too short, the filter passes the errors
    unchanged.
    """
    windows = [
        np.lib.stride_tricks.sliding_window_view(each, NOISE_ORDER + 1)[:, ::-1]
        for each in errors
        if each.size > 2 * NOISE_ORDER
    ]
    past = np.zeros(NOISE_ORDER)
    if windows:
        rows = np.concatenate(windows)
        past = np.linalg.lstsq(rows[:, 1:], rows[:, 0], rcond=None)[0]
    return np.r_[1.0, -past]
