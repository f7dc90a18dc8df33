"""Least error of linear feedback under a disturbance and measurement noise.

A stable plant P responds to the voltage u with a displacement. A disturbance d of
spectrum S is added to it, and the sum is measured with white noise of variance s^2:

    y = P u + d,    z = y + n.

The reference is known for all time. With no price on effort, following it then costs
nothing: u may begin before the reference moves, so that even a plant with delay and
with zeros outside the unit circle has a stable inverse. The part of d that is a linear
filter of the reference is cancelled in the same way. Feedback acts on the rest. Every
stabilising linear controller is u = -Q (z - P u) with a stable causal Q (Youla, Jabr
and Bongiorno, IEEE Trans. Automatic Control 21 (1976) 3-13), and with T = P Q

    y = (1 - T) d - T n,    E y^2 = mean over frequency of |1 - T|^2 S + |T|^2 s^2.

Write S + s^2 = |V|^2 with V and 1/V stable and causal, P = P_i P_o with |P_i| = 1 (the
delay and the zeros outside the circle) and P_o free of both. The minimum over Q
(Wiener-Hopf; cheap-control LQG has the same) is reached by

    T = P_i [conj(P_i) S / conj(V)]_causal / V.

The minimum is the sum of two terms. The first is the error of the smoother, which uses
past and future: the mean of S s^2 / (S + s^2). The second is the mean square of the
part that is not causal, the price of delay and zeros. For s = 0 the minimum is that of
minimum-variance control (Astrom, Introduction to Stochastic Control Theory, 1970,
chapter 6), with which Harris' index compares loops (Can. J. Chem. Eng. 67 (1989)
856-861).

All functions work on a grid of N points around the unit circle, z = exp(2 pi i k / N),
N even, where multiplying by 1/z delays by a sample. V comes from the cepstrum. No model
of the disturbance is fitted, and no Riccati equation is solved: vanishing effort would
make it ill-conditioned.
"""

import numpy as np

FLOOR = 1e-12
"""Smallest magnitude relative to the largest; it replaces zeros on the circle."""


def outer_factor(magnitude: np.ndarray) -> np.ndarray:
    """Return the minimum-phase response [N] of the given ``magnitude`` [N].

    Raises ValueError for magnitudes that are not finite, or all zero.
    """
    largest = np.max(magnitude)
    if not np.isfinite(largest) or largest <= 0.0:
        raise ValueError("a magnitude must be finite and not zero everywhere")
    half = len(magnitude) // 2
    cepstrum = np.fft.ifft(np.log(np.maximum(magnitude, FLOOR * largest))).real
    cepstrum[1:half] *= 2.0
    cepstrum[half + 1 :] = 0.0
    return np.exp(np.fft.fft(cepstrum))


def inner_response(delay: int, zeros: np.ndarray, points: int) -> np.ndarray:
    """Return P_i [points] of a stable plant from its ``delay`` and ``zeros``.

    The delay is in samples and includes the loop's own. The zeros are those in z
    outside the unit circle. The sign of P_i is arbitrary and does not matter.
    """
    w = np.exp(-2j * np.pi * np.arange(points) / points)
    response = w**delay
    for place in 1.0 / np.asarray(zeros, complex):
        response = response * (w - place) / (1.0 - np.conj(place) * w)
    return response


def slow_delay(delay: int, zeros: np.ndarray) -> float:
    """Return the delay (samples) of P_i at low frequency."""
    place = 1.0 / np.asarray(zeros, complex)
    return delay + float(np.sum((1.0 - np.abs(place) ** 2) / np.abs(1.0 - place) ** 2))


def best_response(
    spectrum: np.ndarray, variance: float, inner: np.ndarray
) -> np.ndarray:
    """Return the optimal T = P Q [N]; 1 - T is the sensitivity of the optimal loop.

    ``spectrum`` [N] is that of the disturbance, with its variance as mean;
    ``variance`` is that of the noise, and ``inner`` [N] the P_i of the plant.
    """
    factor = outer_factor(np.sqrt(spectrum + variance))
    wanted = np.fft.ifft(np.conj(inner) * spectrum / np.conj(factor))
    wanted[len(wanted) // 2 :] = 0.0
    return inner * np.fft.fft(wanted) / factor


def error_shares(
    response: np.ndarray, spectrum: np.ndarray, variance: float
) -> tuple[float, float]:
    """Return the mean square errors due to disturbance and noise for T = ``response``.

    ``spectrum`` need not be the one for which T is optimal.
    """
    left = float(np.mean(np.abs(1.0 - response) ** 2 * spectrum))
    return left, float(variance * np.mean(np.abs(response) ** 2))


def common_response(
    spectra: np.ndarray,
    variance: float,
    inner: np.ndarray,
    tolerance: float = 1e-4,
    rounds: int = 100,
) -> np.ndarray:
    """Return T of the one controller of least geometric-mean error over ``spectra``.

    ``spectra`` is [references, N]. The mean of logarithms is concave and lies below its
    tangent. The T that is optimal for the spectra weighted by 1 / (mean square error)
    therefore lowers it in each round, until no error changes by more than the relative
    ``tolerance``. The result is a stationary point and may not be the global minimum.
    """
    weights, last = np.ones(len(spectra)), np.zeros(len(spectra))
    response = np.zeros_like(inner)
    for _ in range(rounds):
        pooled = weights @ spectra / np.sum(weights)
        response = best_response(pooled, variance, inner)
        errors = np.array([sum(error_shares(response, s, variance)) for s in spectra])
        if np.all(np.abs(errors - last) <= tolerance * errors):
            break
        weights, last = 1.0 / errors, errors
    return response
