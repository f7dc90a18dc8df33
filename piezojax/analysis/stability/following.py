"""Closed-loop frequency response of the displacement to the reference."""

import math
from dataclasses import dataclass

import numpy as np

from .conserved import FollowedReference
from .crossings import angle_grid, peak, roots

PER_DECADE = 100
"""Grid points of the frequency response per decade, without those at the poles."""


@dataclass(frozen=True)
class Following:
    """Bandwidth and peak of the response to small motions of the reference, one axis.

    y/r is that of the loop linearised on one branch of its hysteresis, with its
    feedforward. A step leaves the branch and is simulated instead (``step_response``).

    - ``bandwidth_Hz``, ``bandwidth_1dB_Hz``: lowest frequencies at which |y/r| falls
      below -3 dB and -1 dB; infinite if it stays above up to the Nyquist frequency;
    - ``closed_loop_peak``: largest |y/r|, at ``closed_loop_peak_Hz``.
    """

    bandwidth_Hz: float  # noqa: N815
    bandwidth_1dB_Hz: float  # noqa: N815
    closed_loop_peak: float
    closed_loop_peak_Hz: float  # noqa: N815


def following_of(loop: FollowedReference) -> Following | None:
    """Return the figures of ``loop``, None if one of its modes does not decay."""
    if np.abs(np.linalg.eigvals(loop.A)).max(initial=0.0) >= 1.0:
        return None

    def gain(angle: np.ndarray) -> np.ndarray:
        return np.abs(loop.response(angle))

    grid = angle_grid(loop, PER_DECADE)
    gains = gain(grid)
    largest, place = peak(gain, grid, gains)

    def falls_below(decibel: float) -> float:
        level = 10.0 ** (decibel / 20.0)
        below = np.flatnonzero(gains < level)
        if not below.size:
            return math.inf
        if below[0] == 0:
            return 0.0
        around = slice(below[0] - 1, below[0] + 1)
        at = roots(lambda x: gain(x) - level, grid[around], gains[around] - level)
        return float(at[0]) / (2.0 * math.pi * loop.dt)

    return Following(
        bandwidth_Hz=falls_below(-3.0),
        bandwidth_1dB_Hz=falls_below(-1.0),
        closed_loop_peak=largest,
        closed_loop_peak_Hz=place / (2.0 * math.pi * loop.dt),
    )
