"""Limit of linear control for a loop and its references.

The plant P is the linearised stage (``linear_plant``). Its gain is that with which the
stage answers voltage caused by sensor noise in the loop's own runs (``felt_gain``). The
disturbance is the residual of the plant in those runs, d = y - P u: the effect of
hysteresis, creep, drift and the study's own disturbance. It is taken from the assessed
runs with their noise, because noise that reaches the voltage changes the state of a
hysteresis: a run without noise has another disturbance. So does another controller;
``attained`` measures how much that matters.

One linear filter of the reference predicts part of the disturbance on all references.
With full preview that part costs nothing. Feedback acts on the rest, known by its
spectrum at a stated resolution, and ``wiener`` computes the least error that it can
leave: for each reference with a controller designed for it, and for all references with
the one controller of least geometric mean. The first is the limit. The second is not a
lower bound for one reference, but a fair comparison for a loop with one set of gains.

The limit leaves out a price on voltage, the limits of the actuator, and plants other
than this one. A nonlinear controller, or one that uses the period of the reference, may
do better.
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
"""Length of the windows of the spectra, s; its inverse is their resolution."""

_LINEAR = 1.2  # largest RMS sum of the shares of a linear loop, over its error


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
    """Return the limit for ``loop`` and the comparison of its runs with it.

    ``references`` [names, samples] in um; ``noise`` [names, draws, samples], draws of
    unit variance; ``disturbance`` in um, if any, broadcasts to the shape of the noise:
    the fields of the tuner's Signals. Samples before ``start`` do not count.
    ``segment`` (s) is the length of the windows of the spectra, at most that of the
    counted samples; ``dt`` (s) is by default that of the loop.

    Raises ValueError for several axes, a sensor without noise, runs that diverge, and
    a plant that is unstable or does not move as its linear model does.
    """
    references, noise = as_array(references), as_array(noise)
    if references.ndim != 2:
        raise ValueError("the limit is known for one axis only")
    dt = loop_sample_time(loop) if dt is None else dt
    runs, rest = simulated(loop, references, noise, disturbance)
    problem = problem_of(loop, runs, rest, np.asarray(references), start, segment, dt)
    known, variance, points = problem.known, problem.variance, problem.points
    obstacles = problem.plant.obstacles()
    inner = inner_response(*obstacles, points)
    shared = common_response(problem.spectra, variance, inner)
    best = [best_response(spectrum, variance, inner) for spectrum in problem.spectra]

    error = (runs.displacement - runs.reference).reshape(noise.shape)
    quiet = quiet_error(loop, problem.plant, references, problem.left)
    tuned = _mean_square(error[..., start:])
    noisy = _mean_square((error - quiet)[..., start:])
    kept = _mean_square(known.unforeseen(quiet))
    whole = _mean_square(known.cut(problem.left))
    line = 1.0 / (points * dt)
    rows = {}
    for i, name in enumerate(names):
        spectrum = problem.spectra[i]
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
    lowest = np.abs(1.0 - T) ** 2 * problem.spectra + np.abs(T) ** 2 * variance
    curves = Curves(
        frequency=line * np.arange(points)[half],
        unforeseen=problem.spectra[:, half],
        noise=variance,
        tuned=spectra(problem.lines(known.cut(error)))[:, half],
        limit=lowest[:, half],
    )
    return LimitReport(
        references=rows,
        dt=dt,
        noise_rms=_root(variance),
        resolution=1.0 / (problem.window * dt),
        gain=float(problem.plant.response(2)[0].real),
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
    # The remainder of a total may be negative; a share may not.
    return float(np.sqrt(max(square, 0.0)))


def _last_above(spectrum: np.ndarray, level: float) -> int:
    """Return the highest line on which ``spectrum`` lies above ``level``, else 0."""
    above = np.flatnonzero(spectrum[: len(spectrum) // 2] > level)
    return int(above[-1]) if above.size else 0
