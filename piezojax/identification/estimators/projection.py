"""Part of a signal that responds to the excitation of a loop, without noise.

The first stage of the two-stage method (Van den Hof and Schrama, Automatica 29, 1993):
the signal is modelled as the output of a linear system under the excitation, and that
output replaces it. The model is autoregressive with exogenous input (ARX) and of high
order, so that it represents the loop and its noise alike.
"""

from dataclasses import replace
from functools import lru_cache

import numpy as np

from ..records.record import Record

ORDERS = (10, 20, 40, 80)
"""Numbers of past samples of each signal that are tried."""

LEAST_ROWS = 10
"""Least number of samples for each coefficient of the regression."""

RIDGE = 1e-12
"""Penalty on the coefficients, as a share of the power of each signal, because a smooth
excitation does not determine them all."""

STABLE = 0.9999
"""Largest modulus of a pole of the model; if one is larger, all poles are scaled."""


def projected(signal: np.ndarray, excitation: np.ndarray) -> np.ndarray:
    """Return the part of ``signal`` [samples] due to ``excitation`` [samples, k].

    The model is linear, of the order with the least Akaike information criterion. The
    share of the noise that remains is about the number of coefficients over the number
    of samples. Raises ValueError for an excitation that never changes, and for too few
    samples.
    """
    check_excitation(excitation)
    both = np.column_stack([signal, excitation])
    return _projected(both.tobytes(), both.shape[1])


def check_excitation(excitation: np.ndarray) -> None:
    """Raise ValueError unless all columns of ``excitation`` [samples, k] change."""
    if excitation.shape[1] == 0 or np.any(np.ptp(excitation, axis=0) == 0.0):
        raise ValueError("reference and dither never change: they excite nothing")


@lru_cache(maxsize=8)
def _projected(content: bytes, columns: int) -> np.ndarray:
    """Return ``projected`` of the first column; cached, as reports need it again."""
    both = np.frombuffer(content).reshape(-1, columns)
    signal, excitation = both[:, 0], both[:, 1:]
    samples, signals = excitation.shape
    sizes = {order: order * (signals + 1) + signals + 1 for order in ORDERS}
    orders = [n for n, size in sizes.items() if LEAST_ROWS * size <= samples]
    if not orders:
        raise ValueError(
            f"{samples} samples; the response to the excitation needs "
            f"{LEAST_ROWS * min(sizes.values())}"
        )
    # All orders are compared on the same samples.
    first = max(orders)
    centre = signal.mean()
    moved = np.column_stack([signal - centre, excitation - excitation.mean(axis=0)])
    best, least = np.zeros(0), np.inf
    for order in orders:
        solution, left = _regressed(moved, order, first)
        criterion = (samples - first) * np.log(max(left, 1e-300)) + 2.0 * sizes[order]
        if criterion < least:
            best, least = solution, criterion
    return centre + _response(best, moved[:, 1:])


def excited_columns(record: Record, columns: np.ndarray) -> np.ndarray:
    """Return the part of ``columns`` [samples, p] that the excitation of a loop causes.

    They are returned unchanged for a record of an open loop or of too few samples, and
    if they are not finite.
    """
    if not record.excitation.size or not np.all(np.isfinite(columns)):
        return columns
    try:
        parts = [projected(column, record.excitation) for column in columns.T]
    except ValueError:
        return columns
    return np.stack(parts, axis=1)


def motion(record: Record, columns: np.ndarray, part: slice) -> np.ndarray:
    """Return the motion in ``part`` of ``columns`` [samples, p], without its mean.

    In a closed loop it is the response to the excitation: noise and drift are left out.
    A record that ends before the part has no samples in it.
    """
    found = excited_columns(record, columns)[part]
    return found - found.mean(axis=0) if len(found) else found


def excited_part(record: Record) -> Record:
    """Return ``record`` with the part of its signals that the excitation causes."""
    if not record.excitation.size:
        return record
    inputs, outputs = (
        excited_columns(record, each) for each in (record.inputs, record.outputs)
    )
    return replace(record, inputs=inputs, outputs=outputs)


def _regressed(signals: np.ndarray, order: int, first: int) -> tuple[np.ndarray, float]:
    """Return the coefficients for the first signal, and the residual sum of squares.

    They are those of its own past, then those of the present and past of each
    excitation, then the constant.
    """
    windows = np.lib.stride_tricks.sliding_window_view(signals, order + 1, axis=0)
    windows = windows[first - order :, :, ::-1]
    rows = np.column_stack(
        [
            windows[:, 0, 1:],
            *(windows[:, i] for i in range(1, signals.shape[1])),
            np.ones(len(windows)),
        ]
    )
    wanted = windows[:, 0, 0]
    matrix = rows.T @ rows
    matrix += RIDGE * np.diag(np.diag(matrix) + np.finfo(float).tiny)
    solution = np.linalg.lstsq(matrix, rows.T @ wanted, rcond=None)[0]
    return solution, float(np.sum((wanted - rows @ solution) ** 2))


def _response(solution: np.ndarray, excitation: np.ndarray) -> np.ndarray:
    """Return the output [samples] of the model under the excitation, without its mean.

    The mean is removed, because the static gain of the model is uncertain if a pole is
    close to 1.
    """
    import scipy.signal  # takes long to import

    signals = excitation.shape[1]
    order = (solution.size - signals - 1) // (signals + 1)
    below = np.r_[1.0, -solution[:order]]
    largest = np.max(np.abs(np.roots(below)), initial=0.0)
    # All poles move inwards by one factor: roots of high order are not exact enough to
    # move one.
    below *= min(1.0, STABLE / max(largest, STABLE)) ** np.arange(order + 1)
    response = np.zeros(len(excitation))
    above = solution[order:-1].reshape(signals, order + 1)
    for numerator, column in zip(above, excitation.T, strict=True):
        # Before the record the excitation had its first value.
        response += scipy.signal.lfilter(numerator, below, column - column[0])
    return response - response.mean()
