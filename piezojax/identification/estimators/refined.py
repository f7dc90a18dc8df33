"""Refined instrumental variables: a transfer function between two signals.

Source: Young, Recursive Estimation and Time-Series Analysis, 2nd ed., 2011, chapter 7.
"""

from typing import NamedTuple

import numpy as np
import scipy.linalg

ITERATIONS = 12
"""Largest number of refinements of one fit."""

CONVERGED = 1e-7
"""Relative change of the coefficients below which the refinement ends."""

NOISE_ORDER = 20
"""Number of coefficients of the autoregressive model of the errors."""

SETTLE = 50
"""Number of samples that are left out at the beginning, where filters settle."""

INSIDE = 0.9999
"""Largest modulus of a pole; others are reflected into the unit circle."""


class TransferFunction(NamedTuple):
    """``A(q) y(k) = B(q) x(k - delay)`` with errors that the filter ``noise`` whitens.

    ``numerator`` B and ``denominator`` A (its first coefficient is 1) hold the
    coefficients of q^0, q^-1, ...; ``delay`` in samples; ``noise`` is the
    autoregressive filter of the errors; ``cost`` the mean square of the white errors.
    """

    numerator: np.ndarray
    denominator: np.ndarray
    delay: int
    noise: np.ndarray
    cost: float

    def applied(self, signal: np.ndarray) -> np.ndarray:
        """Return the output for the input ``signal`` [samples]."""
        return _filtered(self.delayed_numerator(), self.denominator, signal)

    def whitened(self, signal: np.ndarray) -> np.ndarray:
        """Return ``signal`` behind the filter of the errors, without its beginning."""
        return _filtered(self.noise, [1.0], signal)[SETTLE:]

    def delayed_numerator(self) -> np.ndarray:
        """Return the numerator with the delay as leading zeros."""
        return np.r_[np.zeros(self.delay), self.numerator]

    def poles(self) -> np.ndarray:
        """Return the poles in the z plane."""
        return np.roots(self.denominator).astype(complex)

    def response(self, cycles: np.ndarray) -> np.ndarray:
        """Return the response at frequencies in cycles per sample."""
        z = np.exp(-2j * np.pi * np.asarray(cycles))
        return np.polyval(self.delayed_numerator()[::-1], z) / np.polyval(
            self.denominator[::-1], z
        )


def refined_instrumental_variables(
    x: np.ndarray,
    y: np.ndarray,
    poles: int,
    zeros: int,
    delay: int = 1,
    start: TransferFunction | None = None,
    *,
    differences: bool = False,
) -> TransferFunction:
    """Fit a transfer function from ``x`` to ``y`` [samples], both of zero mean.

    All signals are filtered by the inverse of the denominator and by the noise model of
    the last fit. The instruments are the outputs of that fit. At convergence the
    estimate is that of least variance under the errors' own spectrum, and sensor noise
    leaves it unbiased. It starts from least squares, or from ``start`` of the same
    order. The best of all iterations is returned.

    At a high rate past samples are nearly equal. With ``differences`` the equations are
    those of their differences, which determine more coefficients; without, the rounding
    errors rule out orders that the errors of ``x`` would make up.

    Raises ValueError if the signals do not determine the coefficients.
    """
    if start is None:
        rows = _rows(x, y, poles, zeros, delay)
        solution = np.linalg.lstsq(rows, y[SETTLE:], rcond=None)[0]
        a, b = _split(solution, poles)
    else:
        a, b = start.denominator, start.numerator
    found: list[TransferFunction] = []
    basis = np.eye(poles + zeros + 1)
    if differences:
        basis = scipy.linalg.block_diag(_differences(poles), _differences(zeros + 1))
    for _ in range(ITERATIONS):
        model = _with_noise(x, y, a, b, delay)
        found.append(model)
        prefilter = (model.noise, a)
        measured, modelled, driven = (
            _filtered(*prefilter, signal) for signal in (y, model.applied(x), x)
        )
        rows = _rows(driven, measured, poles, zeros, delay) @ basis
        instruments = _rows(driven, modelled, poles, zeros, delay) @ basis
        solution = _solved(instruments.T @ rows, instruments.T @ measured[SETTLE:])
        last, (a, b) = a, _split(basis @ solution, poles)
        if np.max(np.abs(a - last)) < CONVERGED:
            break
    return min(found, key=lambda model: model.cost)


def _rows(
    x: np.ndarray, y: np.ndarray, poles: int, zeros: int, delay: int
) -> np.ndarray:
    """Return the regressors of y(k): negated past outputs, and past inputs."""
    past = [-_shifted(y, i) for i in range(1, poles + 1)]
    driven = [_shifted(x, delay + i) for i in range(zeros + 1)]
    return np.stack([*past, *driven], axis=1)[SETTLE:]


def _differences(count: int) -> np.ndarray:
    """Return the matrix whose columns turn ``count`` past samples into differences.

    Their orders are 0, 1, ... in turn.
    """
    signs = (-1.0) ** np.arange(count)[:, None]
    return signs * scipy.linalg.pascal(count, kind="upper") if count else np.eye(0)


def _shifted(signal: np.ndarray, samples: int) -> np.ndarray:
    return np.concatenate([np.zeros(samples), signal[: signal.size - samples]])


def _solved(matrix: np.ndarray, right: np.ndarray) -> np.ndarray:
    scale = np.sqrt(np.abs(np.diag(matrix)))
    scale = np.where(scale > 0.0, scale, 1.0)
    scaled = matrix / np.outer(scale, scale)
    if not np.all(np.isfinite(scaled)) or np.linalg.cond(scaled) > 1e14:
        raise ValueError("the signals do not determine the coefficients")
    return np.linalg.solve(scaled, right / scale) / scale


def _split(solution: np.ndarray, poles: int) -> tuple[np.ndarray, np.ndarray]:
    """Return a stable denominator and the numerator."""
    roots = np.roots(np.r_[1.0, solution[:poles]]).astype(complex)
    modulus = np.abs(roots)
    outside = modulus > INSIDE
    if np.any(outside):
        roots = np.where(
            outside, roots / modulus * np.minimum(INSIDE, 1.0 / modulus), roots
        )
    return np.atleast_1d(np.real(np.poly(roots))), solution[poles:]


def _with_noise(
    x: np.ndarray, y: np.ndarray, a: np.ndarray, b: np.ndarray, delay: int
) -> TransferFunction:
    """Return the model with the noise model of its errors."""
    model = TransferFunction(b, a, delay, np.ones(1), np.inf)
    errors = y - model.applied(x)
    spectrum = np.abs(np.fft.rfft(errors, 2 * errors.size)) ** 2
    covariance = np.fft.irfft(spectrum)[: NOISE_ORDER + 1] / errors.size
    covariance[0] = covariance[0] * (1.0 + 1e-9) + np.finfo(float).tiny
    noise = scipy.linalg.solve_toeplitz(covariance[:-1], covariance[1:])
    model = model._replace(noise=np.r_[1.0, -noise])
    return model._replace(cost=float(np.mean(model.whitened(errors) ** 2)))


def _filtered(numerator, denominator, signal: np.ndarray) -> np.ndarray:
    import scipy.signal  # takes long to import

    return np.asarray(scipy.signal.lfilter(numerator, denominator, signal))
