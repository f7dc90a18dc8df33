"""Modes, lag and delay from a measured frequency response.

The response of a stage for small motions is fitted by resonances in parallel, a lag and
a delay in series, ``exp(-s delay) / (1 + s lag) sum_i gain_i mode_i(s)``, by weighted
least squares (Pintelon and Schoukens, System Identification, 2012, chapter 9). Modes
are added one by one, each where it explains most of what is left, until a further one
would fit noise (Bayesian information criterion).
"""

import itertools
import math
import operator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import scipy.optimize

from ...core.arrays import as_array
from ...core.error_bound import UNSEEN, ErrorBound
from ...core.space import INSIDE
from ...solve.gauss_newton import TRUST_REGION, Descent, GaussNewton, trials_with_models
from ...solve.local_model import UNIT_BOX
from ...solve.multi_start import Patience, descend
from ..records.response_file import FrequencyResponse

MOST_MODES = 6
STEPS = 100

DAMPINGS = (0.003, 0.01, 0.03, 0.1, 0.5)
"""Damping ratios at which a new mode is tried."""

PLACES = 100
"""Frequencies at which a new mode is tried."""

LEAST_VARIANCE = 1e-6
"""Least variance of weighted residuals that counts: below it is rounding."""

SCANNED = 1000
"""Lines used to search for the start of a mode; all are used to refine it."""

PENALTY = 2.0
"""Factor on the penalty of the Bayesian information criterion, because a mode is the
best of many trial frequencies."""

LEAST_DAMPING, MOST_DAMPING = 1e-4, 0.7
"""Bounds of the damping ratio of a mode."""

EDGE = 1e-3
"""Distance from a bound, as a share of the range, that counts as on it."""

BEYOND = 1.2
"""Factor by which the frequency of a mode may lie outside the measured band."""

DELAYS = 16
"""Delays tried with the first mode, in units of 1 / the highest angular frequency."""

STARTS = 2
"""Descents for each added mode, from the grid search and from rational functions."""

ITERATIONS = 6
"""Sanathanan-Koerner iterations of a rational function."""

WINDOW = 7
"""Lines of the local parabola whose residual is the noise."""

CONFIDENCE = 3.03
"""Radius of the 99 % disc of complex noise, in standard deviations of one part."""


class ModalValue(NamedTuple):
    """A parameter and its standard error."""

    value: float
    error: float


@dataclass(frozen=True)
class ModalFit:
    """Modes with the largest static gain first, their lag and delay, and the fit.

    ``frequency`` (Hz), ``damping`` (1) and ``gain`` (unit of the response, at rest) of
    each mode; ``lag`` is the time constant (s), None if the response shows none, and
    ``delay`` in s. ``fitted`` [lines] is the response of the model, ``deviation``
    [lines] the standard deviation of the noise of the real and of the imaginary part.
    """

    frequency: tuple[ModalValue, ...]
    damping: tuple[ModalValue, ...]
    gain: tuple[ModalValue, ...]
    lag: ModalValue | None
    delay: ModalValue
    fitted: np.ndarray
    deviation: np.ndarray

    @property
    def static_gain(self) -> float:
        """Gain at rest, in the unit of the response."""
        return sum(gain.value for gain in self.gain)


class _Shape(NamedTuple):
    """Number of modes, and whether there are a lag and a delay."""

    modes: int
    lag: bool
    delay: bool

    @property
    def size(self) -> int:
        return 3 * self.modes + self.lag + self.delay


class _Data(NamedTuple):
    """Angular frequencies (rad/s), values and deviations [lines], ``hold`` [lines]."""

    omega: np.ndarray
    values: np.ndarray
    deviation: np.ndarray
    hold: np.ndarray


class _Found(NamedTuple):
    shape: _Shape
    point: np.ndarray
    cost: float


_COST = operator.attrgetter("cost")


def modal_fit(
    response: FrequencyResponse, *, held: float | None = None, most: int = MOST_MODES
) -> ModalFit:
    """Return the modes, the lag and the delay that ``response`` shows.

    ``held`` is the sample time (s) if the response was measured through converters that
    hold the input, as by the controller of the loop; None for an analogue analyser.
    There are at most ``most`` modes. Raises ValueError if no mode explains the
    response.
    """
    omega = 2.0 * np.pi * response.frequency
    hold = np.ones(omega.size, complex)
    if held is not None:
        turn = 0.5 * omega * held
        hold = np.sinc(turn / np.pi) * np.exp(-1j * turn)
    if not np.any(response.values):
        raise ValueError(f"{response.source}: the response is 0 at every line")
    # Half of the numbers at least are left to tell noise from modes.
    most = min(most, max(1, (omega.size - 2) // 3))
    deviation = noise_deviation(response.frequency, response.values)
    data = _Data(omega, response.values, deviation, hold)
    found: list[_Found] = []
    chosen = best = _Found(_Shape(0, False, True), np.zeros(1), np.inf)
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
    scale = math.sqrt(max(2.0 * chosen.cost / _freedom(chosen, data), 1e-12))
    if not np.isfinite(_criterion(chosen, found, data)):
        raise ValueError(
            f"{response.source}: no mode explains the response: measure up to a "
            "resonance, with more lines around it"
        )
    return _fit_of(chosen, data, scale)


def error_bound(fit: ModalFit, response: FrequencyResponse, dt: float) -> ErrorBound:
    """Return the bound of the relative error of ``fit`` up to half the rate.

    At a measured line it is the residual plus the 99 % radius of the noise, relative to
    the model; below the first line it is that of the first. Above the last line nothing
    was excited. Raises ValueError if no line lies below half the rate.
    """
    size = np.abs(fit.fitted)
    relative = (
        np.abs(response.values - fit.fitted) + CONFIDENCE * fit.deviation
    ) / size
    nyquist = 0.5 / dt
    inside = response.frequency < nyquist * (1.0 - 1e-5)
    if not inside.any():
        raise ValueError(
            f"no line lies below half the rate, {nyquist:g} Hz: choose a higher rate"
        )
    lines, bound = response.frequency[inside], relative[inside]
    beyond = [lines[-1] * (1.0 + 1e-6), nyquist]
    return ErrorBound(
        frequency=(*map(float, lines), *beyond),
        relative=(*map(float, bound), *(UNSEEN for _ in beyond)),
        excited=(*(True for _ in lines), *(False for _ in beyond)),
    )


def noise_deviation(frequency: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return the standard deviation [lines] of the noise of complex ``values``.

    It is estimated from the residuals of parabolas over WINDOW lines. The variance is
    a + b |values|^2 with a, b >= 0; lines at sharp resonances, which no parabola
    follows, are excluded. Real and imaginary part together have this deviation.
    """
    half, lines = WINDOW // 2, np.arange(WINDOW, frequency.size + 1)
    lines = lines[:: max(1, lines.size // SCANNED)]
    power = np.empty(lines.size)
    for i, end in enumerate(lines):
        part = slice(end - WINDOW, end)
        x = frequency[part] - frequency[end - 1 - half]
        rows = np.stack([np.ones(WINDOW), x, x**2], axis=1)
        rows /= np.linalg.norm(rows, axis=0)
        left = values[part] - rows @ np.linalg.lstsq(rows, values[part], rcond=None)[0]
        power[i] = np.sum(np.abs(left) ** 2) / (WINDOW - 3)
    gain = np.abs(values[lines - 1 - half]) ** 2
    columns = np.stack([np.ones(gain.size), gain], axis=1)
    parts = np.array([0.0, float(np.median(power / gain))])
    for _ in range(10):
        expected = np.maximum(columns @ parts, 1e-300)
        near = power < 4.0 * expected
        rows = (columns / expected[:, None])[near]
        parts = scipy.optimize.nnls(rows, (power / expected)[near])[0]
    floor = 1e-12 * np.max(np.abs(values)) ** 2
    return np.sqrt(np.maximum(parts[0] + parts[1] * np.abs(values) ** 2, floor))


# The model and its derivatives. Unknowns: the logarithms of frequency (rad/s) and
# damping of each mode, the gains, the logarithm of the lag (s), and the delay in units
# of 1 / the highest angular frequency.


def _parts(point: np.ndarray, shape: _Shape) -> tuple[np.ndarray, ...]:
    n = shape.modes
    frequency, damping, gain = (point[i * n : (i + 1) * n] for i in range(3))
    rest = point[3 * n :]
    lag = rest[: int(shape.lag)]
    return np.exp(frequency), np.exp(damping), gain, np.exp(lag), rest[len(lag) :]


def _common(point: np.ndarray, shape: _Shape, data: _Data) -> np.ndarray:
    """Return the response [lines] of hold, lag and delay."""
    *_, lag, delay = _parts(point, shape)
    common = data.hold
    if shape.lag:
        common = common / (1.0 + 1j * data.omega * lag[0])
    if shape.delay:
        common = common * np.exp(-1j * data.omega * delay[0] / data.omega[-1])
    return common


def _response(
    point: np.ndarray, shape: _Shape, data: _Data
) -> tuple[np.ndarray, np.ndarray]:
    """Return the response [lines] and its derivatives [lines, unknowns]."""
    w, zeta, gain, lag, _ = _parts(point, shape)
    omega = data.omega[:, None]
    below = w**2 - omega**2 + 2j * zeta * w * omega
    mode = w**2 / below
    by_frequency = mode * (2.0 - (2.0 * w**2 + 2j * zeta * w * omega) / below)
    by_damping = -mode * (2j * zeta * w * omega) / below
    common = _common(point, shape, data)[:, None]
    modes = common * mode
    value = modes @ gain
    slopes = [
        common * by_frequency * gain,
        common * by_damping * gain,
        modes,
    ]
    if shape.lag:
        turn = 1j * data.omega * lag[0]
        slopes.append((-turn / (1.0 + turn) * value)[:, None])
    if shape.delay:
        slopes.append((-1j * data.omega / data.omega[-1] * value)[:, None])
    return value, np.concatenate(slopes, axis=1)


def _residuals(
    point: np.ndarray, shape: _Shape, data: _Data
) -> tuple[np.ndarray, np.ndarray]:
    """Return the weighted residuals [2 lines] and their Jacobian."""
    value, slopes = _response(point, shape, data)
    left = (value - data.values) / data.deviation
    rows = slopes / data.deviation[:, None]
    return np.r_[left.real, left.imag], np.r_[rows.real, rows.imag]


def _bounds(shape: _Shape, data: _Data) -> tuple[np.ndarray, np.ndarray]:
    """Return the least and the greatest value of each unknown."""
    low, high = data.omega[0], data.omega[-1]
    size = 100.0 * float(np.max(np.abs(data.values)))
    pairs = [(math.log(low / BEYOND), math.log(high * BEYOND))] * shape.modes
    pairs += [(math.log(LEAST_DAMPING), math.log(MOST_DAMPING))] * shape.modes
    pairs += [(-size, size)] * shape.modes
    pairs += [(math.log(0.03 / high), math.log(30.0 / low))] * shape.lag
    pairs += [(-1.0, 4.0 * DELAYS)] * shape.delay
    lower, upper = np.array(pairs).T
    return lower, upper


def _refined(point: np.ndarray, shape: _Shape, data: _Data) -> _Found:
    """Return the best fit that a descent from ``point`` reaches within the bounds."""
    lower, upper = _bounds(shape, data)
    width = upper - lower

    def normal_equations(points):
        unit = np.asarray(points)[0]
        left, rows = _residuals(lower + unit * width, shape, data)
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


def _with_another_mode(found: _Found, data: _Data) -> _Found:
    """Return the fit with one mode more, begun where it explains most.

    The places that explain most are tried with several delays, because the phase of a
    delay repeats.
    """
    shape = found.shape._replace(modes=found.shape.modes + 1)
    w, zeta, _, lag, delay = _parts(found.point, found.shape)
    whole, data = data, _thinned(data)
    ends = data.omega[0], data.omega[-1]
    places = np.unique(
        np.r_[np.geomspace(*ends, PLACES // 2), np.linspace(*ends, PLACES // 2)]
    )
    delays = np.arange(DELAYS) if shape.modes == 1 else delay
    tried = [
        _with_gains(
            np.r_[w, place], np.r_[zeta, damping], np.r_[np.log(lag), late], shape, data
        )
        for late, damping, place in itertools.product(delays, DAMPINGS, places)
    ]
    starts = [*_best(tried), *_best(_rational(shape, data))]
    return min((_refined(start.point, shape, whole) for start in starts), key=_COST)


def _thinned(data: _Data) -> _Data:
    """Return SCANNED lines at most, the first and the last included."""
    count = data.omega.size
    chosen = np.unique(
        np.linspace(0, count - 1, min(count, SCANNED)).round().astype(int)
    )
    return _Data(*(part[chosen] for part in data))


def _best(tried: list[_Found]) -> list[_Found]:
    """Return the best of what was ``tried``, each apart from the others."""
    starts: list[_Found] = []
    for one in sorted(tried, key=_COST):
        if all(_apart(one, other) for other in starts):
            starts.append(one)
        if len(starts) == STARTS:
            break
    return starts


def _rational(shape: _Shape, data: _Data) -> list[_Found]:
    """Return points with the poles of rational functions, and their costs.

    For each of several delays the rational function is fitted by iterated linear least
    squares (Sanathanan and Koerner, IEEE Trans. Autom. Control 8, 1963).
    """
    middle = math.sqrt(data.omega[0] * data.omega[-1])
    x = 1j * data.omega / middle
    order = 2 * shape.modes
    powers = x[:, None] ** np.arange(order + 1)
    found, solution = [], np.zeros(2 * order - 1)
    for late in np.arange(0.0, DELAYS, 0.5):
        turn = np.exp(1j * data.omega * late / data.omega[-1])
        values = data.values / data.hold * turn
        below = np.ones(x.size, complex)
        for _ in range(ITERATIONS):
            weight = (1.0 / (data.deviation * below))[:, None]
            rows = weight * np.hstack(
                [powers[:, : order - 1], -values[:, None] * powers[:, 1:]]
            )
            right = weight[:, 0] * values
            size = np.linalg.norm(rows, axis=0)
            rows, right = (np.r_[part.real, part.imag] for part in (rows / size, right))
            solution = np.linalg.lstsq(rows, right, rcond=None)[0] / size
            below = 1.0 + powers[:, 1:] @ solution[order - 1 :]
        coefficients = np.r_[solution[: order - 2 : -1], 1.0]
        poles = np.asarray(np.roots(coefficients), complex) * middle
        one = _from_poles(poles, late, shape, data)
        if one is not None:
            found.append(one)
    return found


def _from_poles(
    poles: np.ndarray, late: float, shape: _Shape, data: _Data
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
    w = np.clip(w, data.omega[0] / BEYOND, data.omega[-1] * BEYOND)
    zeta = np.clip(zeta, 2.0 * LEAST_DAMPING, MOST_DAMPING)
    lag = [-math.log(10.0 * data.omega[-1])] if shape.lag else []
    return _with_gains(w, zeta, np.r_[lag, late], shape, data)


def _with_gains(
    w: np.ndarray,
    zeta: np.ndarray,
    rest: np.ndarray,
    shape: _Shape,
    data: _Data,
) -> _Found:
    """Return the point of these modes with the best gains, and its cost.

    ``rest`` are the other unknowns of a point.
    """
    n = shape.modes
    point = np.concatenate([np.log(w), np.log(zeta), np.zeros(n), rest])
    omega = data.omega[:, None]
    common = _common(point, shape, data) / data.deviation
    modes = common[:, None] * (w**2 / (w**2 - omega**2 + 2j * zeta * w * omega))
    wanted = data.values / data.deviation
    rows, wanted = (np.r_[part.real, part.imag] for part in (modes, wanted))
    square, right = rows.T @ rows, rows.T @ wanted
    gains = np.linalg.lstsq(square, right, rcond=None)[0]
    point[2 * n : 3 * n] = gains
    return _Found(shape, point, 0.5 * float(wanted @ wanted - right @ gains))


def _apart(one: _Found, other: _Found) -> bool:
    """Return whether the last modes or the delays of two starts differ."""
    n = one.shape.modes
    distance = np.abs(one.point - other.point)
    return bool(distance[n - 1] > 0.1 or np.any(distance[3 * n :] > 0.5))


def _with_lag(found: _Found, data: _Data) -> _Found:
    """Return the best fit with a lag, begun at three time constants."""
    shape = found.shape._replace(lag=True)
    n = 3 * shape.modes
    tried = [
        _refined(np.insert(found.point, n, -math.log(corner)), shape, data)
        for corner in np.geomspace(data.omega[0] * 3.0, data.omega[-1], 3)
    ]
    return min(tried, key=_COST)


def _without_lag(found: _Found, data: _Data) -> _Found:
    """Return the fit with a longer delay in place of the lag."""
    n = 3 * found.shape.modes
    point = np.delete(found.point, n)
    point[n:] += math.exp(found.point[n]) * data.omega[-1]
    return _refined(point, found.shape._replace(lag=False), data)


def _without_delay(found: _Found, data: _Data) -> _Found:
    return _refined(found.point[:-1], found.shape._replace(delay=False), data)


def _freedom(found: _Found, data: _Data) -> int:
    return max(2 * data.omega.size - found.shape.size, 1)


def _criterion(one: _Found, found: list[_Found], data: _Data) -> float:
    """Return the information criterion; the best fit of all gives the noise.

    It is infinite if a frequency or damping lies at a bound, far outside the measured
    band or without a peak: such modes imitate a lag or the noise.
    """
    lower, upper = _bounds(one.shape, data)
    place = ((one.point - lower) / (upper - lower))[: 2 * one.shape.modes]
    if np.any((place < EDGE) | (place > 1.0 - EDGE)):
        return math.inf
    variance = min(2.0 * other.cost / _freedom(other, data) for other in found)
    variance = max(variance, LEAST_VARIANCE)
    penalty = PENALTY * one.shape.size * math.log(2 * data.omega.size)
    return 2.0 * one.cost / variance + penalty


def _fit_of(found: _Found, data: _Data, scale: float) -> ModalFit:
    w, zeta, gain, lag, delay = _parts(found.point, found.shape)
    rows = _residuals(found.point, found.shape, data)[1]
    size = np.linalg.norm(rows, axis=0)
    scatter = np.linalg.pinv((rows / size).T @ (rows / size)) / np.outer(size, size)
    errors = scale * np.sqrt(np.diag(scatter))
    n = found.shape.modes
    order = np.argsort(-np.abs(gain), kind="stable")

    def each(values: np.ndarray, deviations: np.ndarray) -> tuple[ModalValue, ...]:
        pairs = zip(values[order], deviations[order], strict=True)
        return tuple(ModalValue(float(v), float(e)) for v, e in pairs)

    unit = 1.0 / data.omega[-1]
    rest = errors[3 * n :]
    return ModalFit(
        frequency=each(w / (2.0 * np.pi), w / (2.0 * np.pi) * errors[:n]),
        damping=each(zeta, zeta * errors[n : 2 * n]),
        gain=each(gain, errors[2 * n : 3 * n]),
        lag=ModalValue(float(lag[0]), float(lag[0] * rest[0])) if lag.size else None,
        delay=(
            ModalValue(float(delay[0]) * unit, float(rest[-1]) * unit)
            if delay.size
            else ModalValue(0.0, 0.0)
        ),
        fitted=_response(found.point, found.shape, data)[0],
        deviation=scale * data.deviation,
    )
