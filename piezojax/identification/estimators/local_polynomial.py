"""Local polynomial method: a frequency response without leakage, and its noise.

The discrete Fourier transforms of a finite record obey ``Y = G U + T + V`` with the
transient T, which is as smooth over frequency as the response G. Both are modelled by
polynomials in a window of neighbouring lines; the residual is the noise V. Sources:
Schoukens, Vandersteen, Barbe and Pintelon, Nonparametric preprocessing in system
identification, European Journal of Control 15 (2009); Pintelon and Schoukens, System
Identification, 2nd ed., sections 7.2 (arbitrary input) and 7.3 (periodic input).
"""

import numpy as np

from .frequency import EXCITED
from .robust import CLEAR, LineEstimates

ORDER = 2
"""Order of the polynomials."""

HALF = 5
"""Number of lines on each side of the centre of a window, for an arbitrary input."""

BETWEEN = 5
"""Number of lines on each side of a line of a periodic input that show the transient;
they lie between the lines of the input."""

CHUNK = 20_000
"""Windows that are solved at a time."""


def local_polynomial(
    input: np.ndarray, output: np.ndarray, dt: float, least: float = EXCITED
) -> LineEstimates:
    """Estimate the response to any ``input`` [samples], best with all lines excited.

    In each window of 2 HALF + 1 lines the response and the transient are parabolas. One
    line in HALF + 1 is returned, because closer estimates use mostly the same lines. A
    window is left out if its input power is less than the share ``least`` of that in
    the strongest window, or if it does not determine the response. ``dt`` in s. Raises
    ValueError if no line is left.
    """
    samples = input.size
    u, y = (np.fft.rfft(signal - signal.mean()) for signal in (input, output))
    last = (samples - 1) // 2
    centres = np.arange(1 + HALF, last - HALF + 1, HALF + 1)
    r = np.arange(-HALF, HALF + 1)
    if centres.size:
        power = np.convolve(np.abs(u) ** 2, np.ones(r.size), mode="same")
        centres = centres[power[centres] > least * power[centres].max()]
    powers = (r / HALF)[:, None] ** np.arange(ORDER + 1)
    unknowns = 2 * (ORDER + 1)
    found, variance, sure = [], [], []
    for start in range(0, centres.size, CHUNK):
        window = centres[start : start + CHUNK, None] + r
        inputs, outputs = u[window], y[window]
        size = np.linalg.norm(inputs, axis=1, keepdims=True)
        size = np.maximum(size, np.finfo(float).tiny)
        rows = np.concatenate(
            [
                (inputs / size)[..., None] * powers,
                np.broadcast_to(powers + 0j, (len(window), *powers.shape)),
            ],
            axis=2,
        )
        basis, triangle = np.linalg.qr(rows)
        steep = np.abs(np.diagonal(triangle, axis1=1, axis2=2))
        sure.append(steep.min(axis=1) > 1e-6 * steep.max(axis=1))
        right = np.einsum("kri,kr->ki", basis.conj(), outputs)
        inverse = np.linalg.inv(
            np.where(sure[-1][:, None, None], triangle, np.eye(unknowns))
        )
        found.append(np.einsum("ki,ki->k", inverse[:, 0], right) / size[:, 0])
        left = outputs - np.einsum("kri,ki->kr", basis, right)
        noise = np.sum(np.abs(left) ** 2, axis=1) / (r.size - unknowns)
        spread = np.sum(np.abs(inverse[:, 0]) ** 2, axis=1) / size[:, 0] ** 2
        variance.append(noise * spread)
    kept = np.concatenate(sure) if sure else np.zeros(0, bool)
    if not kept.any():
        raise ValueError(
            f"no line of {samples} samples determines the response: record longer, or "
            "give the --period of a periodic input"
        )
    return LineEstimates(
        centres[kept] / (samples * dt),
        np.concatenate(found)[kept],
        np.concatenate(variance)[kept],
        2.0 * (r.size - unknowns),
        r.size / (samples * dt),
    )


def periodic_local_polynomial(
    input: np.ndarray,
    output: np.ndarray,
    dt: float,
    period: int,
    least: float = EXCITED,
) -> LineEstimates:
    """Estimate the response to a periodic ``input`` [samples] of two periods or more.

    The ``period`` is in samples. Between the lines of the input, the spectra contain
    only transient and noise: a parabola over 2 BETWEEN of these lines gives the
    transient in each line of the input, and the noise. The response is not smoothed
    over frequency. All whole periods at the end of the record are used, including the
    transient; the variance includes the noise of the input. Lines in which the input
    has less than the share ``least`` of the power of its strongest line, or less than
    CLEAR times its variance, are left out. Raises ValueError for fewer than two
    periods, or a period too short.
    """
    count = input.size // period
    if count < 2:
        raise ValueError(
            f"the period is {period} samples; {input.size} samples must hold two"
        )
    if (period // 2) * (count - 1) < 2 * BETWEEN + 2:
        raise ValueError(
            f"the period is {period} samples; too few lines lie below half the rate "
            f"to separate transient and noise"
        )
    used = count * period
    signals = np.stack([input[-used:], output[-used:]])
    spectra = np.fft.rfft(signals - signals.mean(axis=1, keepdims=True)) / used
    last = (used - 1) // 2
    lines = np.arange(count, last + 1, count)
    power = np.abs(spectra[0, lines]) ** 2
    lines = lines[power > least * power.max()]
    between = np.flatnonzero(np.arange(last + 1) % count)
    place = np.searchsorted(between, lines)
    first = np.clip(place - BETWEEN, 0, between.size - 2 * BETWEEN)
    window = between[first[:, None] + np.arange(2 * BETWEEN)]
    width = (window[:, -1] - window[:, 0])[:, None]
    powers = ((window - lines[:, None]) / width)[..., None] ** np.arange(ORDER + 1)
    basis, triangle = np.linalg.qr(powers)
    # The transient in the line itself, at the distance 0, is the first coefficient.
    weight = np.einsum("kri,ki->kr", basis, np.linalg.inv(triangle)[:, 0])
    transient = np.einsum("kr,ckr->ck", weight, spectra[:, window])
    driven, answer = spectra[:, lines] - transient
    freedom = 2 * BETWEEN - ORDER - 1

    def left(around: np.ndarray) -> np.ndarray:
        return around - np.einsum("kri,ksi,ks->kr", basis, basis, around)

    noise = np.sum(np.abs(left(spectra[0, window])) ** 2, axis=1) / freedom
    clear = np.abs(driven) ** 2 > CLEAR * noise
    response = answer / driven
    error = spectra[1, window] - response[:, None] * spectra[0, window]
    noise = np.sum(np.abs(left(error)) ** 2, axis=1) / freedom
    spread = (1.0 + np.sum(weight**2, axis=1)) / np.abs(driven) ** 2
    return LineEstimates(
        lines[clear] / (used * dt),
        response[clear],
        (noise * spread)[clear],
        2.0 * freedom,
        0.0,
    )
