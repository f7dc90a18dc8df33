"""Autoregressive model of errors, whose inverse makes them white."""

from collections.abc import Sequence

import numpy as np

from .refined import NOISE_ORDER


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
