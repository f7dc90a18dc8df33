"""Model of a frequency response: modes in parallel, a lag and a delay.

``exp(-s delay) / (1 + s lag) sum_i gain_i mode_i(s)`` at ``s = j omega``, its
derivatives, and the covariance of its parameters. A response that was measured through
converters is that of the sampled stage: the sum over the images of each frequency, each
with the response of the hold (Astrom and Wittenmark, Computer-Controlled Systems, 3rd
ed., section 7.4).
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ...core.error_bound import UNSEEN, ErrorBound, banded
from ..records.response import FrequencyResponse
from .line_noise import MOST_LINES

LEAST_DAMPING, MOST_DAMPING = 1e-4, 0.7
"""Bounds of the damping ratio of a mode."""

FOLDED = 0.9
"""Share of half the rate above which a mode cannot be simulated."""

BEYOND = 1.2
"""Factor by which the frequency of a mode may lie outside the measured band."""

DELAYS = 16
"""A quarter of the longest delay, in units of 1 / the highest angular frequency."""

IMAGES = 4
"""Images (aliases) of a frequency on either side that count: those left out are smaller
than the first by a factor of about 40. The search uses two."""

BLOCK = 4096
"""Lines evaluated at a time."""

CONFIDENCE = 3.03
"""Radius of the 99 % disc of complex noise, in standard deviations of one part."""


class ModalValue(NamedTuple):
    """A parameter and its standard error."""

    value: float
    error: float


class Shape(NamedTuple):
    """Number of modes, and whether there are a lag and a delay."""

    modes: int
    lag: bool
    delay: bool

    @property
    def size(self) -> int:
        """Number of unknowns."""
        return 3 * self.modes + self.lag + self.delay


class Lines(NamedTuple):
    """Data of a fit: angular frequencies (rad/s), values and deviations [lines].

    ``images`` [images, lines] are the angular frequencies that add up in a line, the
    first its own, and ``hold`` [images, lines] the response of the hold there.
    ``least`` is the least variance of weighted residuals that counts, ``folding`` half
    the rate of converters that hold the input (rad/s), infinite without them.
    """

    omega: np.ndarray
    values: np.ndarray
    deviation: np.ndarray
    images: np.ndarray
    hold: np.ndarray
    least: float
    folding: float = math.inf

    @property
    def highest(self) -> float:
        """Highest angular frequency, rad/s; its inverse is the unit of delays."""
        return float(self.omega[-1])


def lines_of(
    frequency: np.ndarray,
    values: np.ndarray,
    deviation: np.ndarray,
    held: float | None,
    least: float = 0.0,
    count: int = IMAGES,
) -> Lines:
    """Return the data of a fit at ``frequency`` (Hz); ``held`` as for ``modal_fit``.

    ``count`` images on either side are included.
    """
    omega = 2.0 * np.pi * frequency
    if held is None:
        alone = omega[None]
        return Lines(
            omega, values, deviation, alone, np.ones(alone.shape, complex), least
        )
    number = np.arange(count + 1)
    number = np.r_[number, -number[1:]]
    images = omega + (2.0 * np.pi / held) * number[:, None]
    turn = 0.5 * images * held
    hold = np.sinc(turn / np.pi) * np.exp(-1j * turn)
    return Lines(omega, values, deviation, images, hold, least, math.pi / held)


def chosen_lines(data: Lines, chosen: np.ndarray | slice) -> Lines:
    """Return the ``chosen`` lines of ``data``."""
    return data._replace(
        omega=data.omega[chosen],
        values=data.values[chosen],
        deviation=data.deviation[chosen],
        images=data.images[:, chosen],
        hold=data.hold[:, chosen],
    )


# Unknowns: the logarithms of frequency (rad/s) and damping of each mode, the gains, the
# logarithm of the lag (s), and the delay in units of 1 / the highest angular frequency.


def parts(point: np.ndarray, shape: Shape) -> tuple[np.ndarray, ...]:
    """Return frequencies (rad/s), dampings, gains, lag (s) and delay of a point."""
    n = shape.modes
    frequency, damping, gain = (point[i * n : (i + 1) * n] for i in range(3))
    rest = point[3 * n :]
    lag = rest[: int(shape.lag)]
    return np.exp(frequency), np.exp(damping), gain, np.exp(lag), rest[len(lag) :]


def _common(point: np.ndarray, shape: Shape, data: Lines, highest: float) -> np.ndarray:
    """Return the response [images, lines] of hold, lag and delay."""
    *_, lag, delay = parts(point, shape)
    common = data.hold
    if shape.lag:
        common = common / (1.0 + 1j * data.images * lag[0])
    if shape.delay:
        common = common * np.exp(-1j * data.images * delay[0] / highest)
    return common


def mode_columns(point: np.ndarray, shape: Shape, data: Lines) -> np.ndarray:
    """Return the responses [lines, modes] of modes of gain 1 with lag and delay."""
    w, zeta, *_ = parts(point, shape)
    omega = data.images[..., None]
    common = _common(point, shape, data, data.highest)[..., None]
    return np.sum(common * (w**2 / (w**2 - omega**2 + 2j * zeta * w * omega)), axis=0)


def response(
    point: np.ndarray, shape: Shape, data: Lines
) -> tuple[np.ndarray, np.ndarray]:
    """Return the response [lines] and its derivatives [lines, unknowns]."""
    blocks = [
        _response(point, shape, chosen_lines(data, slice(i, i + BLOCK)), data.highest)
        for i in range(0, data.omega.size, BLOCK)
    ]
    values, slopes = zip(*blocks, strict=True)
    return np.concatenate(values), np.concatenate(slopes)


def _response(
    point: np.ndarray, shape: Shape, data: Lines, highest: float
) -> tuple[np.ndarray, np.ndarray]:
    w, zeta, gain, lag, _ = parts(point, shape)
    omega = data.images[..., None]
    turn = 2j * zeta * w * omega
    below = w**2 - omega**2 + turn
    modes = _common(point, shape, data, highest)[..., None] * (w**2 / below)
    each = modes @ gain
    slopes = [
        modes * (2.0 - (2.0 * w**2 + turn) / below) * gain,
        -modes * turn / below * gain,
        modes,
    ]
    if shape.lag:
        late = 1j * data.images * lag[0]
        slopes.append((-late / (1.0 + late) * each)[..., None])
    if shape.delay:
        slopes.append((-1j * data.images / highest * each)[..., None])
    return each.sum(axis=0), np.concatenate(slopes, axis=-1).sum(axis=0)


def residuals(
    point: np.ndarray, shape: Shape, data: Lines
) -> tuple[np.ndarray, np.ndarray]:
    """Return the weighted residuals [2 lines] and their Jacobian."""
    value, slopes = response(point, shape, data)
    left = (value - data.values) / data.deviation
    rows = slopes / data.deviation[:, None]
    return stacked(left), stacked(rows)


def stacked(values: np.ndarray) -> np.ndarray:
    """Return the real parts, followed by the imaginary parts."""
    return np.concatenate([np.real(values), np.imag(values)])


def bounds(shape: Shape, data: Lines) -> tuple[np.ndarray, np.ndarray]:
    """Return the least and the greatest value of each unknown."""
    low, high = data.omega[0], data.highest
    most = min(high * BEYOND, FOLDED * data.folding)
    size = 100.0 * float(np.max(np.abs(data.values)))
    pairs = [(math.log(low / BEYOND), math.log(most))] * shape.modes
    pairs += [(math.log(LEAST_DAMPING), math.log(MOST_DAMPING))] * shape.modes
    pairs += [(-size, size)] * shape.modes
    pairs += [(math.log(0.03 / high), math.log(30.0 / low))] * shape.lag
    pairs += [(-1.0, 4.0 * DELAYS)] * shape.delay
    lower, upper = np.array(pairs).T
    return lower, upper


@dataclass(frozen=True)
class ModalFit:
    """Modes with the largest static gain first, their lag and delay, and the fit.

    ``frequency`` (Hz), ``damping`` (1) and ``gain`` (unit of the response, at rest) of
    each mode; ``share`` is the share of each mode but the first in the static gain.
    ``static_gain`` is that of all modes, in the unit of the response. ``lag`` is the
    time constant (s), None if the response shows none, and ``delay`` in s. The standard
    errors come from the covariance of all parameters.

    ``fitted`` [lines] is the response of the model, ``deviation`` [lines] the standard
    deviation of the noise of the real and of the imaginary part. ``excess`` is the mean
    square of the residual relative to the variance of the response, None if that is not
    known. ``searched`` is the number of lines in the search, below that of the response
    if lines were merged; ``held`` is the sample time (s) of converters, if any.
    """

    frequency: tuple[ModalValue, ...]
    damping: tuple[ModalValue, ...]
    gain: tuple[ModalValue, ...]
    share: tuple[ModalValue, ...]
    static_gain: ModalValue
    lag: ModalValue | None
    delay: ModalValue
    fitted: np.ndarray
    deviation: np.ndarray
    excess: float | None
    searched: int
    held: float | None

    def response_at(self, frequency: np.ndarray) -> np.ndarray:
        """Return the response of the model [lines] at ``frequency`` (Hz)."""
        shape = Shape(len(self.frequency), self.lag is not None, True)
        none = np.zeros(frequency.size)
        data = lines_of(frequency, none, none, self.held)
        point = np.r_[
            np.log([2.0 * np.pi * one.value for one in self.frequency]),
            np.log([one.value for one in self.damping]),
            [one.value for one in self.gain],
            [] if self.lag is None else np.log([self.lag.value]),
            self.delay.value * data.highest,
        ]
        return response(point, shape, data)[0]


def fit_of(
    point: np.ndarray,
    shape: Shape,
    data: Lines,
    *,
    scale: float,
    excess: float | None,
    searched: int,
    held: float | None,
) -> ModalFit:
    """Return the fit at ``point``, with noise of ``scale`` times the deviations."""
    w, zeta, gain, lag, delay = parts(point, shape)
    rows = residuals(point, shape, data)[1]
    size = np.linalg.norm(rows, axis=0)
    scatter = np.linalg.pinv((rows / size).T @ (rows / size)) / np.outer(size, size)
    scatter = scale**2 * scatter
    errors = np.sqrt(np.diag(scatter))
    n = shape.modes
    order = np.argsort(-np.abs(gain), kind="stable")

    def each(values: np.ndarray, deviations: np.ndarray) -> tuple[ModalValue, ...]:
        pairs = zip(values[order], deviations[order], strict=True)
        return tuple(ModalValue(float(v), float(e)) for v, e in pairs)

    total = float(gain.sum())
    of_gains = scatter[2 * n : 3 * n, 2 * n : 3 * n]
    share = gain / total
    # The slopes of share i by gain j are (1 if i = j, else 0, minus share i) / total.
    slopes = (np.eye(n) - share[:, None]) / total
    share_errors = np.sqrt(np.diag(slopes @ of_gains @ slopes.T).clip(0.0))
    unit = 1.0 / data.highest
    rest = errors[3 * n :]
    return ModalFit(
        frequency=each(w / (2.0 * np.pi), w / (2.0 * np.pi) * errors[:n]),
        damping=each(zeta, zeta * errors[n : 2 * n]),
        gain=each(gain, errors[2 * n : 3 * n]),
        share=each(share, share_errors)[1:],
        static_gain=ModalValue(total, float(np.sqrt(max(of_gains.sum(), 0.0)))),
        lag=ModalValue(float(lag[0]), float(lag[0] * rest[0])) if lag.size else None,
        delay=(
            ModalValue(float(delay[0]) * unit, float(rest[-1]) * unit)
            if delay.size
            else ModalValue(0.0, 0.0)
        ),
        fitted=response(point, shape, data)[0],
        deviation=scale * data.deviation,
        excess=excess,
        searched=searched,
        held=held,
    )


def error_bound(
    fit: ModalFit, measured: FrequencyResponse, deviation: np.ndarray, dt: float
) -> ErrorBound:
    """Return the bound of the relative error of ``fit`` up to half the rate.

    ``measured`` is a response with the standard ``deviation`` [lines] of real and
    imaginary part. At its lines the bound is the residual plus the 99 % radius of the
    noise, relative to the model; below the first line it is that of the first. Above
    the last line nothing was excited. With more than MOST_LINES lines, the largest
    value in each narrow band is used. Raises ValueError if no line lies below half the
    rate.
    """
    fitted = fit.response_at(measured.frequency)
    error = np.abs(measured.values - fitted) + CONFIDENCE * deviation
    nyquist = 0.5 / dt
    inside = measured.frequency < nyquist * (1.0 - 1e-5)
    if not inside.any():
        raise ValueError(
            f"no line lies below half the rate, {nyquist:g} Hz: choose a higher rate"
        )
    lines, bound = measured.frequency[inside], (error / np.abs(fitted))[inside]
    if lines.size > MOST_LINES:
        lines, bound, _ = banded(lines, bound, np.ones(lines.size, bool))
    beyond = [lines[-1] * (1.0 + 1e-6), nyquist]
    return ErrorBound(
        frequency=(*map(float, lines), *beyond),
        relative=(*map(float, bound), *(UNSEEN for _ in beyond)),
        excited=(*(True for _ in lines), *(False for _ in beyond)),
    )
