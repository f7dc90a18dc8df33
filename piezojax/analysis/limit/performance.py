"""Limit of linear control for a loop and its references.

The plant P is the linearised stage (``linear_plant``). Its gain is fitted to the
response of the stage to sensor noise in the loop's own runs (``gain_from_noise``). The
disturbance is the residual of the plant in those runs, d = y - P u: the effect of
hysteresis, creep, drift and the study's own disturbance. It is taken from the assessed
runs with their noise, because noise that reaches the voltage changes the state of a
hysteresis: a run without noise has another disturbance. The disturbance depends on the
controller too; ``verify_limit`` measures how much that matters.

One linear filter of the reference predicts part of the disturbance on all references.
With full preview that part costs nothing. Feedback acts on the rest, whose spectrum is
known at a stated resolution. ``wiener`` computes the least error that feedback can
leave: for each reference with a controller designed for it, and for all references with
the one controller of least geometric-mean error. The first is the limit. The second is
not a lower bound for one reference, but a fair comparison for a loop with one set of
gains.

The limit ignores the cost of voltage, the limits of the actuator, and plants other than
this one. A nonlinear controller, or one that uses the period of the reference, may do
better.
"""

from typing import Any

import numpy as np

from ...core.arrays import as_array
from ...core.feedback import Feedback
from ..stability.operating_point import loop_sample_time
from .limit_report import Curves, LimitComparison, LimitReport, Shares
from .linear_problem import problem_of
from .loop_runs import noise_free_error, simulate_runs
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

# Largest ratio of the shares' root sum square to the error of a nearly linear loop.
_LINEAR = 1.2


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
    unit variance; ``disturbance`` in um, if any, broadcasts to the shape of the noise.
    They are the fields of the tuner's Signals. Samples before ``start`` do not count.
    ``segment`` (s) is the length of the windows of the spectra. A window is never
    longer than the samples on which a ReferencePredictor predicts. ``dt`` (s) is by
    default that of the loop.

    Raises ValueError for several axes, a sensor without noise, runs that diverge, and
    a plant that is unstable or does not move as its linear model does.
    """
    references, noise = as_array(references), as_array(noise)
    if references.ndim != 2:
        raise ValueError("the limit is known for one axis only")
    dt = loop_sample_time(loop) if dt is None else dt
    runs, rest = simulate_runs(loop, references, noise, disturbance)
    problem = problem_of(loop, runs, rest, np.asarray(references), start, segment, dt)
    predictor, variance, points = problem.predictor, problem.variance, problem.points
    delay_and_zeros = problem.plant.delay_and_zeros()
    inner = inner_response(*delay_and_zeros, points)
    shared = common_response(problem.spectra, variance, inner)
    best = [best_response(spectrum, variance, inner) for spectrum in problem.spectra]

    error = (runs.displacement - runs.reference).reshape(noise.shape)
    noise_free = noise_free_error(loop, problem.plant, references, problem.residual)
    tuned = _mean_square(error[..., start:])
    by_noise = _mean_square((error - noise_free)[..., start:])
    unpredicted = _mean_square(predictor.unpredicted(noise_free))
    whole = _mean_square(predictor.centred(problem.residual))
    line = 1.0 / (points * dt)
    rows = {}
    for i, name in enumerate(names):
        spectrum = problem.spectra[i]
        least = error_shares(best[i], spectrum, variance)
        rows[name] = LimitComparison(
            tuned=_root(tuned[i]),
            limit=_root(sum(least)),
            one_controller=_root(sum(error_shares(shared, spectrum, variance))),
            disturbance=_root(whole[i]),
            unpredicted=_root(np.mean(spectrum)),
            bandwidth=_last_above(spectrum, variance) * line,
            tuned_shares=_shares(tuned[i], by_noise[i], unpredicted[i]),
            limit_shares=Shares(noise=_root(least[1]), unpredicted=_root(least[0])),
        )
    T, half = np.array(best), slice(1, points // 2)
    lowest = np.abs(1.0 - T) ** 2 * problem.spectra + np.abs(T) ** 2 * variance
    curves = Curves(
        frequency=line * np.arange(points)[half],
        unpredicted=problem.spectra[:, half],
        noise=variance,
        tuned=spectra(problem.lines(predictor.centred(error)))[:, half],
        limit=lowest[:, half],
    )
    return LimitReport(
        references=rows,
        dt=dt,
        noise_rms=_root(variance),
        resolution=1.0 / (problem.window * dt),
        gain=float(problem.plant.response(2)[0].real),
        delay=slow_delay(*delay_and_zeros),
        sensitivity_peak=float(np.max(np.abs(1.0 - shared))),
        curves=curves,
    )


def _mean_square(signals: np.ndarray) -> np.ndarray:
    return np.mean(signals**2, axis=(1, 2))


def _shares(whole: float, noise: float, unpredicted: float) -> Shares | None:
    if noise + unpredicted > _LINEAR**2 * whole:
        return None
    predicted = _root(whole - noise - unpredicted)
    return Shares(_root(noise), _root(unpredicted), predicted)


def _root(square: float) -> float:
    # The remainder of a total may be negative; a share may not.
    return float(np.sqrt(max(square, 0.0)))


def _last_above(spectrum: np.ndarray, level: float) -> int:
    """Return the highest line on which ``spectrum`` lies above ``level``, else 0."""
    above = np.flatnonzero(spectrum[: len(spectrum) // 2] > level)
    return int(above[-1]) if above.size else 0
