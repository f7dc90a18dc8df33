"""The limit of linear control for a loop and its references, and how near it comes.

The plant is the stage linearised (``linear_plant``) with the gain with which it answers
what noise makes of the voltage in the loop's own runs (``felt_gain``). The disturbance
is all that this leaves of those runs, d = y - P u: what hysteresis, creep, drift and
the study's own disturbance do. It is taken from the runs that are judged, noise
included, because noise that reaches the voltage shakes a hysteresis and makes another
disturbance than a quiet run does. A controller that shakes it otherwise meets another
one; ``attained`` says how much that matters.

What one linear filter of the reference makes of all references is foretold, and with
full preview costs nothing. The rest, known by its spectrum at a stated resolution, is
what feedback is for, and ``wiener`` has the least that it can leave: for each reference
alone, a controller made for it, and for all of them, the one controller with the least
geometric mean. The first is the limit; the second is no lower bound for one reference,
but what a loop with one set of gains can be held against.

Not in the limit: a price on voltage, limits of the actuator, plants other than this
one. A controller that is no linear one, or that knows the reference's period, may do
better.
"""

from typing import Any

import numpy as np

from ...core.arrays import as_array
from ...core.system import Feedback
from ..stability.operating_point import loop_sample_time
from .linear_problem import problem_of
from .loop_runs import quiet_error, simulated
from .reached import Curves, LimitReport, Reached, Shares
from .spectra import spectra
from .wiener import (
    best_response,
    common_response,
    error_shares,
    inner_response,
    slow_delay,
)

SEGMENT = 0.1
"""Length of the windows of the spectra, s: what their resolution is the inverse of."""

_LINEAR = 1.2  # the most that shares of a linear loop may come to, over its error


def performance_limit(
    loop: Feedback,
    names: tuple[str, ...],
    references: Any,
    noise: Any,
    disturbance: Any = None,
    *,
    start: int = 0,
    segment: float = SEGMENT,
    dt: float | None = None,
) -> LimitReport:
    """Return the limit for ``loop`` and how near its runs come to it.

    ``references`` [names, samples] in um; ``noise`` [names, draws, samples], draws of
    unit variance; ``disturbance`` in um, if any, of a shape that goes with that: as the
    tuner's Signals hold them. Samples before ``start`` do not count. ``segment`` (s) is
    the window of the spectra, no longer than what counts; ``dt`` (s) is looked for in
    the loop.

    Raises ValueError for several axes, a sensor without noise, runs that diverge, and
    a plant that is unstable or does not move as its linear model does.
    """
    references, noise = as_array(references), as_array(noise)
    if references.ndim != 2:
        raise ValueError("the limit is known for one axis only")
    dt = loop_sample_time(loop) if dt is None else dt
    runs, rest = simulated(loop, references, noise, disturbance)
    posed = problem_of(loop, runs, rest, np.asarray(references), start, segment, dt)
    known, variance, points = posed.known, posed.variance, posed.points
    obstacles = posed.plant.obstacles()
    inner = inner_response(*obstacles, points)
    shared = common_response(posed.spectra, variance, inner)
    best = [best_response(spectrum, variance, inner) for spectrum in posed.spectra]

    error = (runs.displacement - runs.reference).reshape(noise.shape)
    quiet = quiet_error(loop, posed.plant, references, posed.left)
    tuned = _mean_square(error[..., start:])
    noisy = _mean_square((error - quiet)[..., start:])
    kept = _mean_square(known.unforeseen(quiet))
    whole = _mean_square(known.cut(posed.left))
    line = 1.0 / (points * dt)
    rows = {}
    for i, name in enumerate(names):
        spectrum = posed.spectra[i]
        least = error_shares(best[i], spectrum, variance)
        rows[name] = Reached(
            tuned=_root(tuned[i]),
            limit=_root(sum(least)),
            one_controller=_root(sum(error_shares(shared, spectrum, variance))),
            disturbance=_root(whole[i]),
            unforeseen=_root(np.mean(spectrum)),
            bandwidth=_last_above(spectrum, variance) * line,
            tuned_shares=_shares(tuned[i], noisy[i], kept[i]),
            limit_shares=Shares(noise=_root(least[1]), unforeseen=_root(least[0])),
        )
    T, half = np.array(best), slice(1, points // 2)
    lowest = np.abs(1.0 - T) ** 2 * posed.spectra + np.abs(T) ** 2 * variance
    curves = Curves(
        frequency=line * np.arange(points)[half],
        unforeseen=posed.spectra[:, half],
        noise=variance,
        tuned=spectra(posed.lines(known.cut(error)))[:, half],
        limit=lowest[:, half],
    )
    return LimitReport(
        references=rows,
        dt=dt,
        noise_rms=_root(variance),
        resolution=1.0 / (posed.window * dt),
        gain=float(posed.plant.response(2)[0].real),
        delay=slow_delay(*obstacles),
        sensitivity_peak=float(np.max(np.abs(1.0 - shared))),
        curves=curves,
    )


def _mean_square(signals: np.ndarray) -> np.ndarray:
    return np.mean(signals**2, axis=(1, 2))


def _shares(whole: float, noise: float, unforeseen: float) -> Shares | None:
    if noise + unforeseen > _LINEAR**2 * whole:
        return None
    foreseen = _root(whole - noise - unforeseen)
    return Shares(_root(noise), _root(unforeseen), foreseen)


def _root(square: float) -> float:
    # What is missing to the whole may be less than nothing; a share is not.
    return float(np.sqrt(max(square, 0.0)))


def _last_above(spectrum: np.ndarray, level: float) -> int:
    """Return the highest line at which ``spectrum`` is above ``level``, or 0."""
    above = np.flatnonzero(spectrum[: len(spectrum) // 2] > level)
    return int(above[-1]) if above.size else 0
