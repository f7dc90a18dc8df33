"""Model selection: AIC and BIC, equivalent models, and the ranking of fits.

The errors of a free run are strongly autocorrelated: n samples hold less
information than n independent observations. If the criteria counted all n, any
parameter that lowers the error a little would lower them. They therefore count an
effective number of samples, as AIC does with a variance inflation factor (Lebreton et
al. 1992, Ecol. Monogr. 62(1); Burnham and Anderson 2002, Model Selection, 2.5). The
effective number of the best fit applies to all models.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

MARGIN = 2.0
"""Difference above which a validation error counts as worse, in standard errors."""

EQUIVALENT_BIC = 2.0
"""BIC difference "not worth more than a bare mention" (Kass and Raftery 1995, JASA
90(430))."""

EQUIVALENT_RUN = 0.1
"""Largest difference of equivalent free runs, as a share of the rms error."""

Errors = Sequence[np.ndarray]
"""Errors of a free run, [samples, p] for each record."""


class Criteria(NamedTuple):
    """AIC and BIC of a fit; smaller is better."""

    aic: float
    bic: float


def correlation_time(signal: np.ndarray) -> float:
    """Return the number of samples of ``signal`` [n] per independent sample.

    It is the integrated autocorrelation 1 + 2 sum rho_k (Bayley and Hammersley 1946, J.
    R. Stat. Soc. Suppl. 8(2)), at least 1, the value of white noise. The sum ends at
    the first pair of neighbouring lags whose sum is not positive (Geyer 1992, Stat.
    Sci. 7(4), initial positive sequence), beyond which the estimate is noise.
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
    """Return the effective number of independent samples of the ``errors``, [p]."""
    return np.sum(
        [
            [column.size / correlation_time(column) for column in record.T]
            for record in errors
        ],
        axis=0,
    )


def criteria(mean_squares: np.ndarray, samples: np.ndarray, count: int) -> Criteria:
    """Return AIC and BIC of Gaussian errors for a fit of ``count`` parameters.

    ``mean_squares`` [p] are those of the errors over the training part, ``samples`` [p]
    the effective numbers of samples. Each criterion is ``sum(samples ln mean_squares)``
    plus a penalty for each parameter: 2 (Akaike 1974) or ln(mean of samples) (Schwarz
    1978).
    """
    squares = np.maximum(mean_squares, np.finfo(float).tiny)
    misfit = float(np.sum(samples * np.log(squares)))
    each = np.log(max(float(np.mean(samples)), 1.0))
    return Criteria(misfit + 2.0 * count, misfit + each * count)


def validates_as_well(errors: Errors, best: Errors) -> bool:
    """Return whether ``errors`` are not significantly larger than the ``best``.

    The squared errors are subtracted sample by sample. The mean difference must be at
    most MARGIN of its standard errors, which account for autocorrelation. Errors common
    to both models, such as noise, cancel in the difference.
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
    bics: Sequence[float], validation: Sequence[Errors | None]
) -> tuple[list[int], list[bool]]:
    """Return the order of the fits, best first, and which validate as well as the best.

    First come the fits whose ``validation`` errors are not significantly above the
    smallest, then those with larger errors, then those without errors. Each group is
    sorted by BIC, lowest first.
    """
    known = [errors for errors in validation if errors is not None]
    best = min(known, key=lambda errors: float(np.mean(np.concatenate(errors) ** 2)))
    well = [
        errors is not None and validates_as_well(errors, best) for errors in validation
    ]
    order = sorted(
        range(len(bics)), key=lambda i: (not well[i], validation[i] is None, bics[i])
    )
    return order, well


def first_equivalent(
    bics: Sequence[float], counts: Sequence[int], errors: Sequence[Errors]
) -> list[int]:
    """Return for each fit the index of the first fit that is equivalent to it.

    Two forms of one model, such as stops and plays, have the same number of parameters
    and the same free run, up to small differences of their optima. Fits are
    equivalent if their runs differ by less than EQUIVALENT_RUN of the smaller rms error
    and their BIC by less than EQUIVALENT_BIC. No record distinguishes such fits, so the
    choice between them must not depend on rounding.
    """
    joined = [np.concatenate(one) for one in errors]
    found: list[int] = []
    for i, own in enumerate(joined):
        alike = i
        for j in dict.fromkeys(found):
            least = min(np.mean(own**2), np.mean(joined[j] ** 2))
            if (
                counts[i] == counts[j]
                and abs(bics[i] - bics[j]) < EQUIVALENT_BIC
                and np.mean((own - joined[j]) ** 2) < EQUIVALENT_RUN**2 * least
            ):
                alike = j
                break
        found.append(alike)
    return found
