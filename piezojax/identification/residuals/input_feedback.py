"""Detection of feedback from the output to the input of a record.

Without feedback the past output does not help to predict the input from its own past
(Caines and Chan, IEEE Trans. Automatic Control 20, 1975; Ljung, System Identification,
2nd ed., 13.4).
"""

import numpy as np
import scipy

OWN, LAGS = 80, 3
"""Number of past samples of the input, and of the output, in a prediction. The input
has more, because the output of a stage contains information on much older inputs."""

STRETCH = 1000
"""Samples predicted with one set of coefficients; for a chirp, coefficients vary."""

SHARE = 0.01
"""Share of the unpredictable part of the input, explained by past outputs, from which
the input counts as made by feedback."""

PROBABILITY = 1e-4
"""Largest probability of such a share by chance."""

MOST = 40
"""Most stretches that are used."""

PREDICTABLE = 1e-10
"""Power of the prediction error, as a share of the power of the input, below which an
input counts as predictable from its own past."""

LONGER = 2 * OWN
"""Number of past samples of the input that may show that it is predictable. OWN samples
do not determine a multisine of more than OWN / 2 lines, and the output, which contains
information on older inputs, explains part of the error without feedback."""


def feedback_share(input: np.ndarray, output: np.ndarray) -> float:
    """Return the share of the input's prediction error that past outputs explain.

    Both [samples]. The share expected by chance is subtracted. The result is 0 if the
    rest may be due to chance, for a record shorter than STRETCH, and for an input that
    its own past determines.
    """
    likelihood, more, count = 0.0, 0, 0
    for start in range(0, min(input.size, MOST * STRETCH) - STRETCH + 1, STRETCH):
        part = slice(start, start + STRETCH)
        own, both, rows = _left(input[part], output[part])
        least = PREDICTABLE * np.var(input[part])
        if own <= least * rows or _longer_error(input[part]) <= least:
            continue
        # Each stretch counts relative to its own variance: none outweighs the others.
        likelihood += rows * np.log(own / max(both, np.finfo(float).tiny))
        more, count = more + LAGS, count + rows
    if not more or scipy.stats.chi2.sf(likelihood, more) > PROBABILITY:
        return 0.0
    return float(1.0 - np.exp((more - likelihood) / count))


def _left(input: np.ndarray, output: np.ndarray) -> tuple[float, float, int]:
    """Return the residual sums of squares of two predictions, and the number of rows.

    The first predicts the input from its own past, the second from the past outputs
    too. y(k) is left out, because an input that acts within its sample changes it.
    """
    u, y = input - input.mean(), output - output.mean()
    own = _windows(u[:-1], OWN)
    columns = (own, np.ones(len(own)), _windows(y[OWN - LAGS : -1], LAGS), u[OWN:])
    triangle = np.asarray(np.linalg.qr(np.column_stack(columns), mode="r"))
    rest = triangle[OWN + 1 :, -1]
    return float(rest @ rest), float(rest[-1] ** 2), len(own)


def _longer_error(input: np.ndarray) -> float:
    """Return the power of the error of a prediction from LONGER past samples."""
    u = input - input.mean()
    own = _windows(u[:-1], LONGER)
    columns = np.column_stack((own, np.ones(len(own)), u[LONGER:]))
    triangle = np.asarray(np.linalg.qr(columns, mode="r"))
    return float(triangle[-1, -1] ** 2) / len(own)


_windows = np.lib.stride_tricks.sliding_window_view
