"""Residual of a fitted plant as disturbances of the loop."""

from typing import Literal

import numpy as np
from jaxtyping import Float

from ..identification import Fit

STRETCHES = 2
"""Number of stretches of the residual that disturb each reference."""

OVERLAP, LEAST, MOST = 4, 12, 64
"""Number of beginnings tried for each length of a reference that the residual holds;
fewest and most beginnings in all."""

FAST = 100
"""Samples of the moving mean that is subtracted to compare fast changes: most loops
suppress changes slower than a hundredth of the sampling rate."""

Samples = Float[np.ndarray, " samples"]


def residual_disturbances(
    fit: Fit, reference: Samples, time_s: Samples, part: Literal["train", "validate"]
) -> Float[np.ndarray, "stretches samples"]:
    """Return the worst stretches of the residual of ``fit`` under ``reference``, um.

    Without them, a controller that contains the fitted model would be tuned and
    evaluated as if the stage were that model. The errors of a hysteresis follow the
    path of the stage: the residual is played as far as the reference (um) has
    travelled, or as time has passed, whichever is farther; forwards and backwards until
    the reference ends. ``time_s`` are the times of the reference's samples, ``part``
    names the part of the record. Of many beginnings, evenly spaced over that part, two
    are chosen: one with the largest deviation, for loops that follow slowly, and one
    with the largest fast changes.
    """
    where = getattr(fit, part)
    simulated = fit.simulated[where]
    # Initial loading is a single event.
    first = 0 if part == "validate" else _end_of_loading(simulated)
    residual = (fit.record.output[where] - simulated)[first:]
    moved = np.abs(np.diff(simulated[first:]))
    moved = np.maximum(moved, 1e-9 * moved.max())  # a stage at rest
    travelled = np.concatenate([[0.0], np.cumsum(moved)])
    distance = np.cumsum(np.abs(np.diff(reference, prepend=reference[0])))
    places, passed = np.arange(float(residual.size)), time_s / fit.record.dt
    count = int(np.clip(OVERLAP * residual.size / passed[-1], LEAST, MOST))
    stretches = []
    for begin in np.linspace(0.0, places[-1], count, endpoint=False):
        start = np.interp(begin, places, travelled)
        by_distance = _place(start + distance, travelled)
        place = np.maximum(begin + passed, by_distance)
        stretches.append(np.interp(_folded(place, places[-1]), places, residual))
    return np.stack([max(stretches, key=np.std), max(stretches, key=_fast_rms)])


def _end_of_loading(simulated: Samples) -> int:
    """Return the sample of the first half that is farthest from the first sample."""
    half = simulated[: simulated.size // 2]
    return int(np.argmax(np.abs(half - half[0])))


def _place(distance: Samples, travelled: Float[np.ndarray, " places"]) -> Samples:
    """Return the samples at which the record has ``travelled`` each ``distance``.

    Every second round goes backwards.
    """
    places = np.arange(float(travelled.size))
    rounds, rest = np.divmod(distance, travelled[-1])
    there = np.interp(rest, travelled, places)
    back = places[-1] - np.interp(travelled[-1] - rest, travelled, places)
    return rounds * places[-1] + np.where(rounds % 2 == 0, there, back)


def _folded(place: Samples, last: float) -> Samples:
    """Return ``place`` folded into 0 to ``last``."""
    phase = np.mod(place, 2.0 * last)
    return np.minimum(phase, 2.0 * last - phase)


def _fast_rms(stretch: Samples) -> float:
    """Return the rms (um) of ``stretch`` about its moving mean of ``FAST`` samples."""
    total = np.concatenate([[0.0], np.cumsum(stretch)])
    size = min(FAST, stretch.size)
    mean = (total[size:] - total[:-size]) / size
    middle = stretch[size // 2 :][: mean.size]
    return float(np.sqrt(np.mean((middle - mean) ** 2)))
