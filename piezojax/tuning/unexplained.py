"""Residual of a fitted plant as disturbances of the loop."""

from typing import Literal

import numpy as np
from jaxtyping import Float

from ..identification import Fit

STRETCHES = 2
"""Number of stretches of the residual that disturb each reference."""

OVERLAP, LEAST, MOST = 4, 12, 64
"""Beginnings tried in the length of a reference, and the fewest and most in all."""

FAST = 100
"""Samples of the moving mean without which fast changes are compared: most loops
suppress what is slower than a hundredth of the sampling rate."""

Samples = Float[np.ndarray, " samples"]


def residual_disturbances(
    fit: Fit, reference: Samples, time_s: Samples, part: Literal["train", "validate"]
) -> Float[np.ndarray, "stretches samples"]:
    """Return the worst stretches of the residual of ``fit`` under ``reference``, um.

    Without them, a controller that contains the fitted model would be tuned and
    evaluated as if the stage were that model. The errors of a hysteresis follow the
    path of the stage: the residual is played as far as the reference (um) has
    travelled, or as time has passed, whichever is farther; forwards and backwards until
    the reference ends. ``time_s`` are the times of its samples, ``part`` names that of
    the record. Of many beginnings, evenly spaced over that part, two are chosen: one
    with the largest deviation, for loops that follow slowly, and one with the largest
    fast changes.
    """
    where = getattr(fit, part)
    simulated = fit.simulated[where]
    # Initial loading is a single event.
    first = 0 if part == "validate" else _end_of_loading(simulated)
    residual = (fit.record.output[where] - simulated)[first:]
    moved = np.abs(np.diff(simulated[first:]))
    moved = np.maximum(moved, 1e-9 * moved.max())  # where it rests
    travelled = np.concatenate([[0.0], np.cumsum(moved)])
    way = np.cumsum(np.abs(np.diff(reference, prepend=reference[0])))
    places, passed = np.arange(float(residual.size)), time_s / fit.record.dt
    count = int(np.clip(OVERLAP * residual.size / passed[-1], LEAST, MOST))
    stretches = []
    for begin in np.linspace(0.0, places[-1], count, endpoint=False):
        by_way = _place(way + np.interp(begin, places, travelled), travelled)
        place = np.maximum(begin + passed, by_way)
        stretches.append(np.interp(_folded(place, places[-1]), places, residual))
    return np.stack([max(stretches, key=np.std), max(stretches, key=_fast_rms)])


def _end_of_loading(simulated: Samples) -> int:
    """Return where the stage is first as far as it gets, half of the part at most."""
    half = simulated[: simulated.size // 2]
    return int(np.argmax(np.abs(half - half[0])))


def _place(way: Samples, travelled: Float[np.ndarray, " places"]) -> Samples:
    """Return the samples at which the record has ``travelled`` the ``way``.

    Every second round goes backwards.
    """
    places = np.arange(float(travelled.size))
    rounds, rest = np.divmod(way, travelled[-1])
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
