"""Robust method for multisines: separation of noise and nonlinear distortion.

A stage with a weak nonlinearity, driven by a multisine of random phases, responds as a
linear system, the best linear approximation, plus a disturbance that repeats with the
period and changes with the phases. The scatter between periods is due to noise; the
scatter between realisations of the phases is due to noise and nonlinear distortion.
Source: Pintelon and Schoukens, System Identification, 2nd ed., section 4.3.1.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from .frequency import EXCITED, period_spectra

CLEAR = 100.0
"""Least ratio of the power of the input in a line to its variance: 20 dB."""


class LineEstimates(NamedTuple):
    """A response from one record, line by line.

    ``frequency`` [lines] in Hz; ``response`` [lines]; ``variance`` [lines], the
    expected square of the modulus of its error; ``freedom``, the real degrees of
    freedom of the variance; ``resolution`` (Hz), the width of the band from which a
    line is estimated.
    """

    frequency: np.ndarray
    response: np.ndarray
    variance: np.ndarray
    freedom: float
    resolution: float


class RobustResponse(NamedTuple):
    """Mean response of several realisations, with variances of two origins.

    ``response`` [lines] at ``frequency`` [lines] in Hz; ``total`` [lines] is the
    variance of its error due to noise and nonlinear distortion, with ``freedom`` real
    degrees of freedom; ``noise`` [lines] is the part due to noise.
    """

    frequency: np.ndarray
    response: np.ndarray
    total: np.ndarray
    noise: np.ndarray
    freedom: float


def steady_response(
    input: np.ndarray,
    output: np.ndarray,
    dt: float,
    period: int,
    skip: int = 1,
    least: float = EXCITED,
) -> LineEstimates:
    """Estimate the response to a periodic ``input`` [samples] in steady state.

    It is the ratio of the mean spectra over the whole periods (``period`` samples) at
    the end of the record, without the first ``skip`` of them, which hold the transient.
    The scatter between the periods gives the noise of output and input. Lines in which
    the input has less than the share ``least`` of the power of its strongest line, or
    less than CLEAR times its variance, are left out. Raises ValueError if fewer than
    two periods are left.
    """
    count = input.size // period - skip
    if skip < 0 or count < 2:
        raise ValueError(
            f"{input.size} samples hold {input.size // period} periods of {period}; "
            f"without the first {skip}, two or more are needed: record longer, or use "
            "the method local_polynomial, which needs no steady state"
        )
    columns = np.stack([input, output], axis=1)
    spectra = period_spectra(columns, period)[skip:, 1 : (period + 1) // 2]
    driven, answer = spectra.mean(axis=0).T
    power = np.abs(driven) ** 2
    noise = np.var(spectra[..., 0], axis=0, ddof=1) / count
    kept = np.flatnonzero((power > least * power.max()) & (power > CLEAR * noise))
    driven, power, response = driven[kept], power[kept], answer[kept] / driven[kept]
    error = spectra[:, kept, 1] - response * spectra[:, kept, 0]
    variance = np.sum(np.abs(error) ** 2, axis=0) / (count - 1) / count / power
    return LineEstimates(
        (kept + 1) / (period * dt), response, variance, 2.0 * (count - 1), 0.0
    )


def robust_response(realisations: Sequence[LineEstimates]) -> RobustResponse:
    """Return the mean response of two or more ``realisations``, and its variances.

    Only lines common to all realisations are used. Raises ValueError for a single
    realisation, or if less than half of the lines of the first are common to all.
    """
    count, first = len(realisations), realisations[0]
    if count < 2:
        raise ValueError("one realisation cannot separate distortion and response")
    step = (
        first.frequency[0]
        if first.frequency.size == 1
        else np.diff(first.frequency).min()
    )
    places = [np.round(2.0 * one.frequency / step).astype(int) for one in realisations]
    common = places[0]
    for other in places[1:]:
        common = np.intersect1d(common, other)
    if 2 * common.size < places[0].size:
        raise ValueError(
            f"only {common.size} of {places[0].size} lines are excited in all of the "
            f"{count} realisations; they must have the same lines"
        )
    chosen = [np.searchsorted(own, common) for own in places]
    responses, variances = (
        np.stack([part[rows] for part, rows in zip(parts, chosen, strict=True)])
        for parts in (
            [one.response for one in realisations],
            [one.variance for one in realisations],
        )
    )
    return RobustResponse(
        first.frequency[chosen[0]],
        responses.mean(axis=0),
        np.var(responses, axis=0, ddof=1) / count,
        variances.mean(axis=0) / count,
        2.0 * (count - 1),
    )
