"""How much a fit is worth for its parameters: AIC, BIC, and which one to take.

The errors of a free run are strongly autocorrelated: n samples are not n pieces of
evidence. Counted as such, any parameter that takes a little off them would be "worth"
it. The criteria therefore stand on an effective number of samples, as AIC does with a
variance inflation factor (Lebreton et al. 1992, Ecol. Monogr. 62(1); Burnham and
Anderson 2002, Model Selection, 2.5), one for all models: that of the best fit.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

MARGIN = 2.0
"""Standard errors by which a validation error must differ to count as worse."""

BARE_MENTION = 2.0
"""Difference of BIC that is not worth more (Kass and Raftery 1995, JASA 90(430))."""

SAME_RUN = 0.1
"""Share of the rms error by which the free runs of one model may differ."""

Errors = Sequence[np.ndarray]
"""Errors of a free run, [samples, p] for each record."""


class Criteria(NamedTuple):
    """AIC and BIC of one fit, both smaller for a better one."""

    aic: float
    bic: float


def correlation_time(signal: np.ndarray) -> float:
    """Return in how many samples of ``signal`` [n] there is one independent of others.

    1 + 2 sum of the autocorrelation (Bayley and Hammersley 1946, J. R. Stat. Soc.
    Suppl. 8(2)), summed as long as two neighbours in a row are above zero together
    (Geyer 1992, Stat. Sci. 7(4), initial positive sequence): beyond, it is all noise.
    Never below 1, for white noise 1.
    """
    centred = np.asarray(signal, dtype=float) - np.mean(signal)
    n = centred.size
    size = 2 ** int(np.ceil(np.log2(2 * n)))
    spectrum = np.abs(np.fft.rfft(centred, size)) ** 2
    covariance = np.fft.irfft(spectrum, size)[:n]
    if covariance[0] <= 0.0:
        return 1.0
    correlation = covariance / covariance[0]
    pairs = correlation[: n - n % 2].reshape(-1, 2).sum(axis=1)
    stop = int(np.argmax(pairs <= 0.0)) if np.any(pairs <= 0.0) else pairs.size
    return float(np.clip(2.0 * np.sum(pairs[:stop]) - 1.0, 1.0, n))


def effective_samples(errors: Errors) -> np.ndarray:
    """Return how many independent samples the ``errors`` are worth, [p]."""
    return np.sum(
        [
            [column.size / correlation_time(column) for column in record.T]
            for record in errors
        ],
        axis=0,
    )


def criteria(mean_squares: np.ndarray, samples: np.ndarray, count: int) -> Criteria:
    """Return AIC and BIC of Gaussian errors for a fit of ``count`` parameters.

    ``mean_squares`` [p] over the training part, ``samples`` [p] the effective numbers:
    ``sum(samples ln mean_squares)`` plus 2 (Akaike 1974) or ln(mean of samples)
    (Schwarz 1978) for each parameter.
    """
    squares = np.maximum(mean_squares, np.finfo(float).tiny)
    misfit = float(np.sum(samples * np.log(squares)))
    each = np.log(max(float(np.mean(samples)), 1.0))
    return Criteria(misfit + 2.0 * count, misfit + each * count)


def as_good(errors: Errors, best: Errors) -> bool:
    """Return whether ``errors`` are no larger than the ``best`` beyond chance.

    The mean of the difference of their squares, sample by sample, is at most MARGIN of
    its own standard errors, its correlation counted: what both models miss alike, such
    as the noise, does not blur the comparison.
    """
    difference = np.concatenate(
        [
            np.sum(one**2, axis=1) - np.sum(other**2, axis=1)
            for one, other in zip(errors, best, strict=True)
        ]
    )
    spread = np.std(difference) * np.sqrt(
        correlation_time(difference) / difference.size
    )
    return bool(np.mean(difference) <= MARGIN * spread)


def ranking(
    bics: Sequence[float], validation: Sequence[Errors]
) -> tuple[list[int], list[bool]]:
    """Return the order of the fits, best first, and which of them validate as well.

    First those whose ``validation`` errors are no worse than the smallest, beyond
    chance; among them, and among the others, the lowest BIC.
    """
    squares = [float(np.mean(np.concatenate(errors) ** 2)) for errors in validation]
    best = validation[int(np.argmin(squares))]
    well = [as_good(errors, best) for errors in validation]
    order = sorted(range(len(bics)), key=lambda i: (not well[i], bics[i]))
    return order, well


def first_alike(
    bics: Sequence[float], counts: Sequence[int], errors: Sequence[Errors]
) -> list[int]:
    """Return, for each fit, the first of the fits that is the same model.

    Two ways to write one model, stops and plays say, have as many parameters and the
    same free run, up to where their descents ended: runs less than SAME_RUN of the
    smaller rms error apart, BIC less than BARE_MENTION. No record tells them apart, so
    which one it is must not hang on rounding.
    """
    joined = [np.concatenate(one) for one in errors]
    found: list[int] = []
    for i, own in enumerate(joined):
        alike = i
        for j in dict.fromkeys(found):
            least = min(np.mean(own**2), np.mean(joined[j] ** 2))
            if (
                counts[i] == counts[j]
                and abs(bics[i] - bics[j]) < BARE_MENTION
                and np.mean((own - joined[j]) ** 2) < SAME_RUN**2 * least
            ):
                alike = j
                break
        found.append(alike)
    return found
