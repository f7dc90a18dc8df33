"""Modes, lag and delay from a measured frequency response.

The response of a stage for small motions is fitted by resonances in parallel, a lag and
a delay in series (``modal_model``), by weighted least squares (Pintelon and Schoukens,
System Identification, 2012, chapter 9). Modes are added one by one, each where it
explains most of the residual, until a further one would fit noise (Bayesian information
criterion).
"""

import itertools
import math
import operator
from typing import NamedTuple

import numpy as np

from ...core.arrays import as_array
from ...core.space import INSIDE
from ...solve.gauss_newton import TRUST_REGION, Descent, GaussNewton, trials_with_models
from ...solve.local_model import UNIT_BOX
from ...solve.multi_start import Patience, descend
from ..records.response import FrequencyResponse
from .line_noise import merged, noise_deviation
from .modal_model import (
    BEYOND,
    DELAYS,
    LEAST_DAMPING,
    MOST_DAMPING,
    Lines,
    ModalFit,
    Shape,
    bounds,
    chosen_lines,
    fit_of,
    lines_of,
    mode_columns,
    parts,
    residuals,
    stacked,
)

MOST_MODES = 6
STEPS = 100

DAMPINGS = (0.003, 0.01, 0.03, 0.1, 0.5)
"""Damping ratios at which a new mode is tried."""

PLACES = 100
"""Frequencies at which a new mode is tried."""

LEAST_VARIANCE = 1e-6
"""Least variance of weighted residuals if the noise is not known; smaller values are
rounding errors."""

KNOWN_VARIANCE = 0.5
"""Variance of weighted residuals, real or imaginary, if the noise is known."""

SCANNED = 1000
"""Lines used to search for the start of a mode; all are used to refine it."""

PENALTY = 2.0
"""Factor on the penalty of the Bayesian information criterion, because a mode is the
best of many trial frequencies."""

EDGE = 1e-3
"""Distance from a bound, as a share of the range, within which a value is at it."""

STARTS = 2
"""Largest number of descents for each added mode from the grid search, and from
rational functions."""

ITERATIONS = 6
"""Sanathanan-Koerner iterations of a rational function."""


class _Found(NamedTuple):
    shape: Shape
    point: np.ndarray
    cost: float


_COST = operator.attrgetter("cost")


def modal_fit(
    response: FrequencyResponse, *, held: float | None = None, most: int = MOST_MODES
) -> ModalFit:
    """Return the modes, the lag and the delay that ``response`` shows.

    ``held`` is the sample time (s) if the response was measured through converters that
    hold the input, such as those of the controller, and ``response.held`` is not set.
    There are at most ``most`` modes. The lines are weighted by their variance, if it is
    known, else by the noise estimated from neighbouring lines. If there are very many
    lines, the search merges neighbouring ones; the last descent uses all. Raises
    ValueError if no mode explains the response.
    """
    if not np.any(response.values):
        raise ValueError(f"{response.source}: the response is 0 at every line")
    known = response.variance is not None
    held = response.held or held
    least = KNOWN_VARIANCE if known else LEAST_VARIANCE
    every = response.frequency, response.values, noise_deviation(response)
    data = lines_of(*merged(*every), held, least, count=2)
    searched = data.omega.size
    # At least half of the numbers remain to distinguish noise from modes.
    most = min(most, max(1, (searched - 2) // 3))
    found: list[_Found] = []
    chosen = best = _Found(Shape(0, False, True), np.zeros(1), np.inf)
    for _ in range(most):
        best = _with_another_mode(best, data)
        change = _without_lag if best.shape.lag else _with_lag
        tried = [best, change(best, data)]
        found += tried
        best = min(tried, key=lambda one: _criterion(one, found, data))
        chosen = min(found, key=lambda one: _criterion(one, found, data))
        if best.shape.modes > chosen.shape.modes + 1:
            break
    if chosen.point[-1] < 0.0:  # the delay
        chosen = _without_delay(chosen, data)
    if not np.isfinite(_criterion(chosen, found, data)):
        raise ValueError(
            f"{response.source}: no mode explains the response: measure up to a "
            "resonance, with more lines around it"
        )
    if held is not None or searched < response.frequency.size:
        merged_lines, data = data, lines_of(*every, held, least)
        fewer = [
            min(alike, key=lambda one: _criterion(one, found, merged_lines))
            for modes in range(chosen.shape.modes - 1, 0, -1)
            if (alike := [one for one in found if one.shape.modes == modes])
        ]
        chosen = _on_all([chosen, *fewer], merged_lines, data)
    variance = 2.0 * chosen.cost / _freedom(chosen, data)
    return fit_of(
        chosen.point,
        chosen.shape,
        data,
        scale=math.sqrt(max(variance, KNOWN_VARIANCE if known else 1e-12)),
        excess=variance / KNOWN_VARIANCE if known else None,
        searched=searched,
        held=held,
    )


def _on_all(found: list[_Found], data: Lines, every: Lines) -> _Found:
    """Return the best of the fits ``found`` to merged ``data``, refined on all lines.

    The first fit is the chosen one; each of the others has one mode less. This removes
    a lag or a mode that only imitates the error of merging.
    """
    tried: list[_Found] = []
    best = None
    for one in found:
        point, shape = one.point.copy(), one.shape
        point[3 * shape.modes + shape.lag :] *= every.highest / data.highest
        own = [_refined(point, shape, every)]
        if shape.lag and shape.delay:
            own.append(_without_lag(own[0], every))
        tried += own
        before, best = best, min(tried, key=lambda one: _criterion(one, tried, every))
        if before is not None and best.shape.modes == before.shape.modes:
            break
    return best or found[0]


def _refined(point: np.ndarray, shape: Shape, data: Lines) -> _Found:
    """Return the best fit that a descent from ``point`` reaches within the bounds."""
    lower, upper = bounds(shape, data)
    width = upper - lower

    def normal_equations(points):
        unit = np.asarray(points)[0]
        left, rows = residuals(lower + unit * width, shape, data)
        rows = rows * width
        loss, slope, bend = 0.5 * left @ left, rows.T @ left, rows.T @ rows
        return as_array([loss]), as_array(slope[None]), as_array(bend[None])

    def metric(curvature):
        size = np.diag(curvature)
        return np.where(size > 0.0, size, 1.0)

    patience = Patience(6, share=1e-9)
    start = np.clip((point - lower) / width, INSIDE, 1.0 - INSIDE)
    descents = GaussNewton(
        [Descent(start, TRUST_REGION, UNIT_BOX, patience)],
        trials_with_models(normal_equations, 1, metric),
    )
    standing, _ = descend(descents, STEPS, lambda standing: None)
    return _Found(shape, lower + standing.units[0] * width, float(standing.losses[0]))


def _with_another_mode(found: _Found, data: Lines) -> _Found:
    """Return the fit with one mode more, started where it explains most.

    The places that explain most are tried with several delays, because the phase of a
    delay repeats.
    """
    shape = found.shape._replace(modes=found.shape.modes + 1)
    *_, delay = parts(found.point, found.shape)
    whole, data = data, _thinned(data)
    delays = np.arange(float(DELAYS)) if shape.modes == 1 else delay
    tried = [one for late in delays for one in _tries(found, late, data)]
    gained = [_with_gains(one.point, shape, data) for one in _best(tried)]
    starts = [*gained, *_best(_rational(shape, data))]
    return min((_refined(start.point, shape, whole) for start in starts), key=_COST)


def _tries(found: _Found, late: float, data: Lines) -> list[_Found]:
    """Return points with one mode more, without gains, and costs with the best gains.

    They are those of a grid of frequencies and damping ratios with the delay ``late``.
    What a mode explains follows from the part of its response that is orthogonal to
    the responses of the other modes.
    """
    w, zeta, _, lag, _ = parts(found.point, found.shape)
    rest = np.append(np.log(lag), late)
    ends = data.omega[0], data.highest
    half = PLACES // 2
    places = np.unique([np.geomspace(*ends, half), np.linspace(*ends, half)])
    grid = np.array(list(itertools.product(DAMPINGS, places))).T

    def weighted(zeta: np.ndarray, w: np.ndarray) -> np.ndarray:
        shape, point = _point(w, zeta, rest, found.shape)
        return stacked(mode_columns(point, shape, data) / data.deviation[:, None])

    known = np.linalg.qr(weighted(zeta, w))[0]
    columns, left = weighted(*grid), stacked(data.values / data.deviation)
    columns = columns - known @ (known.T @ columns)
    left = left - known @ (known.T @ left)
    sizes = np.sum(columns**2, axis=0)
    explained = (left @ columns) ** 2 / np.where(sizes > 0.0, sizes, np.inf)
    return [
        _Found(
            *_point(np.append(w, place), np.append(zeta, damping), rest, found.shape),
            0.5 * float(left @ left - gain),
        )
        for (damping, place), gain in zip(grid.T, explained, strict=True)
    ]


def _point(
    w: np.ndarray, zeta: np.ndarray, rest: np.ndarray, shape: Shape
) -> tuple[Shape, np.ndarray]:
    """Return the shape with these modes instead of its own, and a point without gains.

    ``rest`` are the other unknowns of the point.
    """
    modes = np.concatenate([np.log(w), np.log(zeta), np.zeros(w.size)])
    return shape._replace(modes=w.size), np.concatenate([modes, rest])


def _thinned(data: Lines) -> Lines:
    """Return SCANNED lines at most, the first and the last included, without images."""
    count = data.omega.size
    chosen = np.linspace(0, count - 1, min(count, SCANNED)).round().astype(int)
    data = chosen_lines(data, np.unique(chosen))
    return data._replace(images=data.images[:1], hold=data.hold[:1])


def _best(tried: list[_Found]) -> list[_Found]:
    """Return the best STARTS of the fits ``tried`` that differ from each other."""
    starts: list[_Found] = []
    for one in sorted(tried, key=_COST):
        if all(_apart(one, other) for other in starts):
            starts.append(one)
        if len(starts) == STARTS:
            break
    return starts


def _rational(shape: Shape, data: Lines) -> list[_Found]:
    """Return points with the poles of rational functions, and their costs.

    For each of several delays the rational function is fitted by iterated linear least
    squares (Sanathanan and Koerner, IEEE Trans. Autom. Control 8, 1963).
    """
    middle = math.sqrt(data.omega[0] * data.highest)
    x = 1j * data.omega / middle
    order = 2 * shape.modes
    powers = x[:, None] ** np.arange(order + 1)
    found, solution = [], np.zeros(2 * order - 1)
    for late in np.arange(0.0, DELAYS, 0.5):
        turn = np.exp(1j * data.omega * late / data.highest)
        values = data.values / data.hold[0] * turn
        below = np.ones(x.size, complex)
        for _ in range(ITERATIONS):
            weight = (1.0 / (data.deviation * below))[:, None]
            rows = weight * np.hstack(
                [powers[:, : order - 1], -values[:, None] * powers[:, 1:]]
            )
            right = weight[:, 0] * values
            size = np.linalg.norm(rows, axis=0)
            rows, right = stacked(rows / size), stacked(right)
            solution = np.linalg.lstsq(rows, right, rcond=None)[0] / size
            below = 1.0 + powers[:, 1:] @ solution[order - 1 :]
        coefficients = np.r_[solution[: order - 2 : -1], 1.0]
        poles = np.asarray(np.roots(coefficients), complex) * middle
        one = _from_poles(poles, late, shape, data)
        if one is not None:
            found.append(one)
    return found


def _from_poles(
    poles: np.ndarray, late: float, shape: Shape, data: Lines
) -> _Found | None:
    """Return the fit by the modes of these poles (rad/s), None if there are fewer."""
    pairs = poles[np.imag(poles) > 0.0]
    real = np.sort(np.abs(np.real(poles[np.imag(poles) == 0.0])))
    w = np.r_[np.abs(pairs), np.sqrt(real[0::2][: real.size // 2] * real[1::2])]
    zeta = np.r_[
        np.abs(np.real(pairs)) / np.abs(pairs), np.full(real.size // 2, MOST_DAMPING)
    ]
    if w.size != shape.modes or not np.all(np.isfinite(w)) or np.any(w <= 0.0):
        return None
    w = np.clip(w, data.omega[0] / BEYOND, data.highest * BEYOND)
    zeta = np.clip(zeta, 2.0 * LEAST_DAMPING, MOST_DAMPING)
    lag = [-math.log(10.0 * data.highest)] if shape.lag else []
    return _with_gains(_point(w, zeta, np.append(lag, late), shape)[1], shape, data)


def _with_gains(point: np.ndarray, shape: Shape, data: Lines) -> _Found:
    """Return ``point`` with the best gains, and its cost."""
    modes = stacked(mode_columns(point, shape, data) / data.deviation[:, None])
    wanted = stacked(data.values / data.deviation)
    square, right = modes.T @ modes, modes.T @ wanted
    gains = np.linalg.lstsq(square, right, rcond=None)[0]
    point = point.copy()
    point[2 * shape.modes : 3 * shape.modes] = gains
    return _Found(shape, point, 0.5 * float(wanted @ wanted - right @ gains))


def _apart(one: _Found, other: _Found) -> bool:
    """Return whether the last modes or the delays of two starts differ."""
    n = one.shape.modes
    distance = np.abs(one.point - other.point)
    return bool(distance[n - 1] > 0.1 or np.any(distance[3 * n :] > 0.5))


def _with_lag(found: _Found, data: Lines) -> _Found:
    """Return the best fit with a lag, started at three time constants."""
    shape = found.shape._replace(lag=True)
    n = 3 * shape.modes
    tried = [
        _refined(np.insert(found.point, n, -math.log(corner)), shape, data)
        for corner in np.geomspace(data.omega[0] * 3.0, data.highest, 3)
    ]
    return min(tried, key=_COST)


def _without_lag(found: _Found, data: Lines) -> _Found:
    """Return the fit with a longer delay in place of the lag."""
    n = 3 * found.shape.modes
    point = np.delete(found.point, n)
    point[n:] += math.exp(found.point[n]) * data.highest
    return _refined(point, found.shape._replace(lag=False), data)


def _without_delay(found: _Found, data: Lines) -> _Found:
    return _refined(found.point[:-1], found.shape._replace(delay=False), data)


def _freedom(found: _Found, data: Lines) -> int:
    return max(2 * data.omega.size - found.shape.size, 1)


def _criterion(one: _Found, found: list[_Found], data: Lines) -> float:
    """Return the information criterion, with the noise of the best fit.

    It is infinite if a frequency or damping lies at a bound, far outside the measured
    band or without a peak: such modes imitate a lag or the noise.
    """
    lower, upper = bounds(one.shape, data)
    place = ((one.point - lower) / (upper - lower))[: 2 * one.shape.modes]
    if np.any((place < EDGE) | (place > 1.0 - EDGE)):
        return math.inf
    variance = min(2.0 * other.cost / _freedom(other, data) for other in found)
    variance = max(variance, data.least)
    penalty = PENALTY * one.shape.size * math.log(2 * data.omega.size)
    return 2.0 * one.cost / variance + penalty
