"""Mode that a transfer function lacks, from its errors.

Least squares in the coefficients of a higher order are biased by noise, most of all at
a high sampling rate, and the refinement from there may fail. The mode that explains
most of the errors is a start beside the poles that are known already.
"""

import numpy as np

from ...core.recipe import Resonance
from .refined import TransferFunction

CYCLES = tuple(np.geomspace(4e-3, 0.4, 60))
"""Frequencies that are tried, cycles per sample."""

DAMPINGS = (0.01, 0.04)
"""Damping ratios that are tried."""


def with_further_mode(
    model: TransferFunction, x: np.ndarray, y: np.ndarray
) -> TransferFunction:
    """Return ``model`` plus the mode that explains most of its errors.

    ``x`` and ``y`` [samples] are the signals to which ``model`` was fitted. Each mode
    of a grid acts on ``x`` with two coefficients, which are fitted to the white errors.
    """
    import scipy.signal  # takes long to import

    driven = scipy.signal.lfilter(model.noise, [1.0], x)
    errors = model.whitened(y - model.applied(x))
    delay, settled = model.delay, x.size - errors.size

    def explained(poles: np.ndarray) -> tuple[float, np.ndarray]:
        moved = scipy.signal.lfilter([1.0], poles, driven)
        late = (np.r_[np.zeros(n), moved[: x.size - n]] for n in (delay, delay + 1))
        columns = np.stack([*late], axis=1)[settled:]
        amounts, *_ = np.linalg.lstsq(columns, errors, rcond=None)
        return float(np.sum((errors - columns @ amounts) ** 2)), amounts

    pairs = [
        np.real(np.poly(np.exp(Resonance(cycles, damping).poles)))
        for cycles in CYCLES
        for damping in DAMPINGS
    ]
    left, fitted = zip(*map(explained, pairs), strict=True)
    best = int(np.argmin(left))
    poles, amounts = pairs[best], fitted[best]
    own = np.convolve(model.numerator, poles)
    added = np.convolve(amounts, model.denominator)
    numerator = own + np.r_[added, np.zeros(own.size - added.size)]
    return model._replace(
        numerator=numerator, denominator=np.convolve(model.denominator, poles)
    )
