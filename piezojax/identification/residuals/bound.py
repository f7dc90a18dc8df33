"""Error bound of a model, from the residual of its free run.

The residual ``e = y - y_model`` and the output of the model respond to the same input.
The relative error is the ratio ``|G_eu| / |G_mu|`` of their empirical frequency
responses, so that the model need not be linearised. The part of the residual that is
not a linear response (noise, and hysteresis that the model does not follow) widens the
confidence interval. In a closed loop noise reaches the input too; if the record holds
a reference or a dither, the ratio is that of the responses to it.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ...core.error_bound import UNSEEN, ErrorBound, banded
from ..estimators.loop_response import joint_response
from ..estimators.welch import SHORTEST, SpectralResponse, spectral_response
from ..records.record import Record

OUTSIDE = 0.01
"""Probability that the error of a line lies outside its interval."""


LEAST = 1e-10
"""Least input power of a line, as a share of the strongest line. The confidence
interval tells whether the power suffices."""

LEAKAGE = 4.0
"""Share of the power of a line that leaks through a Hann window into the line at a
distance of d lines, times d^6, with a safety factor of ten."""

CERTAIN = 1.0
"""Half-width of the interval of the relative error above which a line counts as not
excited, unless the error itself is certain."""

CHANCE = 0.01
"""Probability that noise alone makes a line of a closed loop count as excited."""

AVERAGES = 8
"""Segments without overlap into which a record is divided."""


ABSORBED = 0.05
"""Least error at an excited line in the limit on a missing mode, because the fitted
parameters may absorb as much of the smooth error of the mode."""


class RelativeError(NamedTuple):
    """Relative error of a model [lines] at the ``frequency`` (Hz) of excited lines.

    ``error`` is the estimate, ``margin`` the half-width of its 99 % interval, and
    ``gain`` the gain of the model, output over input. ``resolution`` (Hz) is the
    spacing of all lines, excited or not, and ``averages`` the number of averages.
    """

    frequency: np.ndarray
    error: np.ndarray
    margin: np.ndarray
    gain: np.ndarray
    resolution: float
    averages: float

    @property
    def deviation(self) -> np.ndarray:
        """Estimated standard deviation of the error [lines]."""
        return self.margin / deviations(self.averages, OUTSIDE)

    @property
    def upper(self) -> np.ndarray:
        """Upper end of the interval [lines]."""
        return self.error + self.margin

    @property
    def sure(self) -> np.ndarray:
        """Whether the error [lines] is above 0 with certainty, at all lines at once.

        It exceeds twice its interval, which leaves room for leakage, and the interval
        that holds at all lines at once, which is wider after few averages.
        """
        chance = OUTSIDE / max(self.error.size, 1)
        at_once = deviations(self.averages, chance) * self.deviation
        return self.error > np.maximum(2.0 * self.margin, at_once)

    @property
    def lower(self) -> np.ndarray:
        """Lower end of the interval [lines], at least 0."""
        return np.maximum(self.error - self.margin, 0.0)


def deviations(averages: float, chance: float) -> float:
    """Return how many of its deviations an error exceeds with probability ``chance``.

    The deviation of a complex response is itself estimated, from the scatter of n
    ``averages``: the squared ratio follows the F distribution with 2 and 2 (n - 1)
    degrees of freedom (Bendat and Piersol, Random Data, 4th ed., 9.2).
    """
    freedom = max(averages - 1.0, 0.5)
    return math.sqrt(freedom * (chance ** (-1.0 / freedom) - 1.0))


def _unbiased(averages: float) -> float:
    """Return the factor of a deviation from the spectra of a fit to ``averages``.

    The response is fitted to the same averages as its variance.
    """
    return math.sqrt(averages / max(averages - 1.0, 0.5))


def relative_error(record: Record, run: np.ndarray, part: slice) -> RelativeError:
    """Return the relative error of the free ``run`` [samples] over ``part``.

    Raises ValueError as ``spectral_response`` does.
    """
    part = slice(part.start, min(part.stop, record.samples))
    samples, period = part.stop - part.start, record.period
    if period is not None and samples < 2 * period:
        period = None
    segment = max(SHORTEST, 2 ** int(np.log2(max(1, samples // AVERAGES))))
    if record.excitation.size and period is None:
        return _closed_loop_error(record, run, part, segment)
    residual, own = (
        spectral_response(
            record.input[part],
            signal,
            record.dt,
            period=period,
            segment=segment,
            least=LEAST,
        )
        for signal in ((record.output - run)[part], run[part])
    )
    size = np.maximum(np.abs(own.response), np.finfo(float).tiny)
    resolution = 1.0 / ((period or segment) * record.dt)
    lines = _places(own, resolution)
    kept = slice(None) if period else _stands_out(own.power, lines)
    factor = deviations(own.averages, OUTSIDE)
    if period is None:
        factor *= _unbiased(own.averages)
    return RelativeError(
        residual.frequency[kept],
        (np.abs(residual.response) / size)[kept],
        (factor * np.sqrt(residual.variance) / size)[kept],
        size[kept],
        resolution,
        own.averages,
    )


def _closed_loop_error(
    record: Record, run: np.ndarray, part: slice, segment: int
) -> RelativeError:
    """Return the relative error, from responses to the excitation of a loop."""
    signals, input, error = (
        each[part] for each in (record.excitation, record.input, record.output - run)
    )
    model = run[part]
    ratio, own = (
        joint_response(one, other, signals, record.dt, segment=segment, least=least)
        for one, other, least in ((model, error, 0.0), (input, model, LEAST))
    )
    resolution = 1.0 / (segment * record.dt)
    # With few averages, the excitation explains a share of pure noise by chance.
    chance = 1.0 - CHANCE ** (1.0 / max(own.averages - 1.0, 1.0))
    places = _places(own, resolution)
    excited = _stands_out(own.power, places)
    # Where the excitation is leakage from its other lines, so is the response to it.
    excited &= _stands_out(_power(signals, segment)[places], places)
    if np.any(excited & (own.coherence > chance)):
        excited &= own.coherence > chance
    kept = np.isin(ratio.frequency, own.frequency[excited])
    lines = np.isin(own.frequency, ratio.frequency[kept])
    size = np.maximum(np.abs(own.response[lines]), np.finfo(float).tiny)
    deviation = np.sqrt(ratio.variance[kept] + own.variance[lines] / size**2)
    return RelativeError(
        ratio.frequency[kept],
        np.abs(ratio.response[kept]),
        _unbiased(own.averages) * deviations(own.averages, OUTSIDE) * deviation,
        size,
        resolution,
        own.averages,
    )


def _places(found: SpectralResponse, resolution: float) -> np.ndarray:
    """Return the numbers of the lines of ``found``."""
    return np.round(found.frequency / resolution).astype(int)


def _power(signals: np.ndarray, segment: int) -> np.ndarray:
    """Return the power by line of ``signals`` [samples, k], each of variance 1."""
    import scipy.signal  # takes long to import

    settings = {"nperseg": segment, "detrend": "linear", "axis": 0}
    _, power = scipy.signal.welch(signals / signals.std(axis=0), **settings)
    return np.sum(power, axis=1)


def _stands_out(power: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Return whether the ``power`` of each line exceeds the leakage of the others.

    ``places`` are the numbers of the lines.
    """
    import scipy.signal  # takes long to import

    every = np.zeros(places.max() + 1)
    every[places] = power
    distance = np.arange(1, every.size)
    kernel = np.where(distance > 2, LEAKAGE / distance.astype(float) ** 6, 0.0)
    leaked = scipy.signal.fftconvolve(every, np.r_[kernel[::-1], 0.0, kernel])
    return power > leaked[places + every.size - 1]


def error_bound(
    records: Sequence[Record], runs: Sequence[np.ndarray], part: slice
) -> ErrorBound:
    """Return the error bound of a model from its free ``runs`` over ``records``.

    Every record has one input and one output, and so has its run. Raises ValueError as
    ``relative_error`` does.
    """
    return joined(
        [
            _completed(relative_error(record, run, part), record)
            for record, run in zip(records, runs, strict=True)
        ]
    )


def joined(bounds: Sequence[ErrorBound]) -> ErrorBound:
    """Return one bound from those of several records.

    The bound at a line of any of them is the largest of the records that excite it, or,
    if none does, the smallest of all. A line next to an excited one of a record has at
    least the bound of that line.
    """
    if len(bounds) == 1:
        return bounds[0]
    lines = np.unique(np.concatenate([bound.frequency for bound in bounds]))
    anywhere = np.any([bound.excited_at(lines) for bound in bounds], axis=0)
    known = np.max([_excited_only(bound).at(lines) for bound in bounds], axis=0)
    least = np.min([bound.at(lines) for bound in bounds], axis=0)
    return _bound(lines, np.where(anywhere, known, least), np.asarray(anywhere))


def _excited_only(bound: ErrorBound) -> ErrorBound:
    """Return ``bound`` with 0 at the lines that its record does not excite."""
    relative = np.where(bound.excited, bound.relative, 0.0)
    return bound.model_copy(update={"relative": tuple(relative.tolist())})


def _completed(found: RelativeError, record: Record) -> ErrorBound:
    """Return the bound on all lines up to the Nyquist frequency.

    A mode that the model lacks, of frequency f and with the share k of the static gain,
    causes the relative error ``k / (1 - (f_i / f)^2) - k`` at an excited line f_i off
    its resonance. The bounds at all excited lines limit k, which is 1 at most. At its
    resonance a lightly damped mode causes the error ``UNSEEN k``. No mode is assumed
    below the lowest excited line. A weakly excited line limits the bound too.
    """
    kept = (found.margin < CERTAIN) | found.sure
    known, upper = found.frequency[kept], found.upper[kept]
    lines = round(0.5 / (record.dt * found.resolution)) + 1
    frequency = found.resolution * np.arange(1, lines)
    places = np.round(found.frequency / found.resolution).astype(int) - 1
    excited = np.zeros(frequency.size, bool)
    excited[places[kept]] = True
    relative = np.full(frequency.size, UNSEEN)
    if known.size:
        after = np.searchsorted(known, frequency)
        below, above = np.maximum(after - 1, 0), np.minimum(after, known.size - 1)
        hidden = UNSEEN * np.array([_share(f, known, upper) for f in frequency])
        relative = np.maximum(np.maximum(upper[below], upper[above]), hidden)
        relative[places[kept]] = upper
        weak = places[~kept]
        relative[weak] = np.clip(relative[weak], found.lower[~kept], found.upper[~kept])
    return _bound(frequency, relative, excited)


def _share(frequency: float, known: np.ndarray, upper: np.ndarray) -> float:
    """Return the largest share of a mode at ``frequency`` that no line contradicts."""
    if frequency < known[0]:
        return 0.0
    share_per_error = np.abs((frequency / known) ** 2 - 1.0)
    return float(min(1.0, np.min(np.maximum(upper, ABSORBED) * share_per_error)))


def _bound(
    frequency: np.ndarray, relative: np.ndarray, excited: np.ndarray
) -> ErrorBound:
    """Return the ErrorBound on narrow bands, with the largest value of each."""
    lines, largest, all_excited = banded(frequency, relative, excited)
    return ErrorBound(
        frequency=tuple(float(f"{f:.8g}") for f in lines),
        relative=tuple(float(f"{x:.4g}") for x in largest),
        excited=tuple(all_excited.tolist()),
    )
