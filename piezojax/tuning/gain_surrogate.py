"""Surrogate of a tuned loop: the figures that gains near the tuned ones would give.

It interpolates signals and not their rms, which has a kink where an error vanishes:
tracking errors and a step response are written in their principal components, whose
coefficients are smooth functions of the gains, and the rms of a signal is the norm of
its coefficients. Coefficients and margins are interpolated by radial basis functions:
r^5 and a linear polynomial.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from .near_gains import BATCH, LARGEST_PEAK, MARGINS, NearGains, simulate_near
from .outcome import Outcome
from .traces import traces_of

MOST_GAINS = 12
"""Largest number of gains with a surrogate."""

COMPONENTS = 16
"""Largest number of principal components of a signal."""

LEFT_OUT = 1e-4
"""Rms that the components of a signal may leave out, as a share of its least rms."""

QUANTILE = 0.95
"""Share of the unseen gain sets that do not exceed the stated errors."""


class Figures(NamedTuple):
    """Figures of a gain set: rms ``errors`` (um) by reference, ``margins``, ``step``.

    ``step`` [samples] is the displacement in um.
    """

    errors: np.ndarray
    margins: np.ndarray
    step: np.ndarray


class Doubt(NamedTuple):
    """Relative errors that ``QUANTILE`` of the unseen gain sets do not exceed.

    They are given for the rms ``errors`` [references], for their geometric ``mean``,
    and for the ``margins`` [margins].
    """

    errors: np.ndarray
    mean: float
    margins: np.ndarray


@dataclass(frozen=True)
class Interpolant:
    """Interpolant of figures between the ``centres`` [points, gains].

    ``weights`` [points + 1 + gains, outputs] are those of the radial basis functions,
    of 1 and of the gains. The outputs are the coefficients of each signal, whose
    numbers are ``components``, then the margins. The last signal is the step, whose
    principal components are ``basis`` [components, samples].
    """

    centres: np.ndarray
    weights: np.ndarray
    components: tuple[int, ...]
    basis: np.ndarray

    def __call__(self, place: np.ndarray) -> Figures:
        """Return the figures of the gains at ``place``."""
        outputs = _functions(place[None], self.centres)[0] @ self.weights
        *errors, step, margins = np.split(outputs, np.cumsum(self.components))
        rms = np.array([np.linalg.norm(each) for each in errors])
        return Figures(rms, margins, step @ self.basis)


@dataclass(frozen=True)
class GainSurrogate:
    """Figures of a loop as functions of its gains, near the tuned ones.

    Gains are points of the Space of the study, from ``lower`` to ``upper``; places run
    from 0 to 1 in this range, and ``tuned`` is that of the tuned gains. All
    ``simulated`` gain sets in the range are stable. The errors are those under the
    ``references``; the step is given at ``times`` (s) after it.
    """

    lower: np.ndarray
    upper: np.ndarray
    tuned: np.ndarray
    simulated: int
    at: Interpolant
    references: tuple[str, ...]
    margins: tuple[str, ...]
    times: np.ndarray
    doubt: Doubt


def gain_surrogate(outcome: Outcome) -> GainSurrogate | str:
    """Return the surrogate of the tuned loop of ``outcome``, or why there is none.

    It interpolates the gain sets of ``simulate_near``, except the first ``BATCH``: they
    test it.
    """
    if outcome.case.study.axes is not None:
        return "they are for one axis only"
    count = len(outcome.case.space.paths)
    if count > MOST_GAINS:
        return f"{count} gains are tuned, and they are for {MOST_GAINS} at most"
    near = simulate_near(outcome)
    if near is None:
        return (
            "gains very near the tuned ones diverge, stay at a voltage limit, or have "
            f"a sensitivity peak above {LARGEST_PEAK:g}"
        )
    return fitted(near, tuple(trace.name for trace in traces_of(outcome.case.study)))


def fitted(near: NearGains, references: tuple[str, ...]) -> GainSurrogate:
    """Return the surrogate that interpolates ``near``, tested on its first sets.

    A margin that is unlimited for some of the sets is left out.
    """
    places, found = near.places, near.simulated
    limited = [
        index
        for index, margin in enumerate(MARGINS.values())
        if np.all(found.margins[:, index] < margin.unlimited)
    ]
    margins = found.margins[:, limited]
    at = _interpolant(
        places[BATCH:],
        [*np.moveaxis(found.errors[BATCH:], 1, 0), found.step[BATCH:]],
        margins[BATCH:],
    )
    unseen = [at(place) for place in places[:BATCH]]
    true = np.linalg.norm(found.errors[:BATCH], axis=2)
    errors = np.stack([figures.errors for figures in unseen]), true
    means = [np.exp(np.mean(np.log(each), axis=1)) for each in errors]
    return GainSurrogate(
        near.lower,
        near.upper,
        places[BATCH],
        len(places),
        at,
        references,
        tuple(np.array([*MARGINS])[limited]),
        near.times,
        Doubt(
            _doubt(*errors),
            float(_doubt(*means)),
            _doubt(np.stack([each.margins for each in unseen]), margins[:BATCH]),
        ),
    )


def _interpolant(
    centres: np.ndarray, signals: list[np.ndarray], margins: np.ndarray
) -> Interpolant:
    """Return the interpolant of ``signals`` [points, samples] and ``margins``."""
    bases = [_principal_components(signal) for signal in signals]
    pairs = zip(signals, bases, strict=True)
    outputs = np.hstack([*(signal @ basis.T for signal, basis in pairs), margins])
    rows = _functions(centres, centres)
    polynomial = rows[:, len(centres) :].T
    zeros = np.zeros((len(polynomial), len(polynomial)))
    weights = np.linalg.solve(
        np.block([[rows], [polynomial, zeros]]),
        np.vstack([outputs, np.zeros((len(polynomial), outputs.shape[1]))]),
    )
    # The page stores float32 numbers; the errors on unseen sets include that rounding.
    weights, basis = weights.astype(np.float32), bases[-1].astype(np.float32)
    return Interpolant(centres, weights, tuple(map(len, bases)), basis)


def _principal_components(signals: np.ndarray) -> np.ndarray:
    """Return the principal components [components, samples] of ``signals``.

    The signals are not centred: each has the norm of its coefficients.
    """
    _, sizes, components = np.linalg.svd(signals, full_matrices=False)
    least = np.min(np.linalg.norm(signals, axis=1))
    left = np.sqrt(np.cumsum(sizes[::-1] ** 2)[::-1] / len(signals))
    count = int(np.count_nonzero(left > LEFT_OUT * least))
    return components[: min(max(count, 1), COMPONENTS)]


def _functions(places: np.ndarray, centres: np.ndarray) -> np.ndarray:
    """Return radial basis functions, 1 and the gains [places, points + 1 + gains]."""
    radius = np.linalg.norm(places[:, None] - centres, axis=2)
    return np.hstack([radius**5, np.ones((len(places), 1)), places])


def _doubt(found: np.ndarray, true: np.ndarray) -> np.ndarray:
    """Return the relative errors that ``QUANTILE`` of the sets do not exceed."""
    return np.quantile(np.abs(found / true - 1.0), QUANTILE, axis=0)
