"""Hysteresis that a stage may have and its model has not, as a disturbance."""

import numpy as np
from jaxtyping import Float

TYPICAL_WIDTH = 0.15
"""Width of the loop of piezo ceramics under large voltages, relative to its height.

Source: PI Ceramic, Fundamentals of Piezo Technology, displacement behaviour: 10 to 15 %
of the displacement.
"""

PLAYS = 50
"""Number of plays that approximate Rayleigh's law, to 0.1 % of the loop's height."""


def steepest(width: float) -> float:
    """Return the largest gain on the loop, relative to that for small motions.

    The loop is that of ``missing_hysteresis``; the gain is largest before a turn.
    """
    return (1.0 + 2.0 * width) / (1.0 - 2.0 * width)


def missing_hysteresis(
    references: Float[np.ndarray, "references samples *axes"], width: float
) -> Float[np.ndarray, "references samples *axes"]:
    """Return by how much a stage that follows ``references`` leaves its linear model.

    The model has the gain for small motions. By Rayleigh's law the gain rises with the
    distance since the last turn, and the loop over the span of all references has the
    ``width``, relative to its height. The deviation is a sum of plays whose radii are
    evenly spaced up to half the span. The stage has come from the end of the span that
    is farther from the first value, and the deviation begins at 0, because the loop
    begins at rest.

    Source: Damjanovic, The Rayleigh law in piezoelectric ceramics, J. Phys. D 29 (1996)
    2057.
    """
    paths = references.reshape(*references.shape[:2], -1)
    low, high = (f(paths, axis=(0, 1)) for f in (np.min, np.max))
    half = np.where(high > low, 0.5 * (high - low), 1.0)
    places = ((paths - low) / half - 1.0)[..., None]
    farther = np.where(places[:, 0] > 0.0, -1.0, 1.0)
    radii = (np.arange(PLAYS) + 0.5) / PLAYS
    plays = np.clip(-farther, farther - radii, farther + radii)
    means = np.empty(paths.shape)
    for k in range(paths.shape[1]):
        plays = np.clip(plays, places[:, k] - radii, places[:, k] + radii)
        means[:, k] = plays.mean(axis=-1)
    deviations = 4.0 * width * half * (means - means[:, :1])
    return deviations.reshape(references.shape)
