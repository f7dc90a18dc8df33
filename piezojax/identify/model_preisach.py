"""A Preisach model behind a lag, as fine as the record can tell its cells apart."""

from typing import NamedTuple

import equinox as eqx
import numpy as np
from scipy.optimize import minimize_scalar

from .._types import as_array
from ..dynamics import FirstOrderLag
from ..hysteresis import Preisach
from ..hysteresis.preisach import STARTS
from ..system import Series, series
from .output_error import from_rest, standard_errors
from .preisach import fit_preisach, responses
from .record import Record

CELLS = range(3, 11)
"""Cells a side that a fit may have."""

TOLD_APART = 1e-3
"""Least rms that the output changes by with weights moved by 1 um in all, shared out in
whatever way shows least: below that, nanometres decide about tenths of a micrometre."""

TOO_FEW = (
    "the turning points of the training part do not tell even the cells of a Preisach "
    f"triangle with {CELLS[0]} a side apart"
)
"""Why a record supports no Preisach model."""

LAGS = (0.05, 50.0)
"""Bounds of the lag, samples."""

STEP = 1e-4
"""Share by which the lag is changed for the slope of the output by it."""

OPTIONS = {"xatol": 1e-3}
"""Accuracy of the lag's logarithm: far below its standard error."""


class PreisachFit(NamedTuple):
    """The plant, and values and standard errors of its parameters by name."""

    system: Series
    values: dict[str, float]
    deviations: list[float | None]


def cells_told_apart(record: Record, train: slice) -> int:
    """Return how many cells a side the samples ``train`` can tell apart, 0 for none."""
    seen = record.until(train.stop)
    input = _a_sample_later(seen.input)
    limits = float(seen.input.min()), float(seen.input.max())
    for cells in reversed(CELLS):
        shape = Preisach(np.zeros((cells, cells)), *limits, 0.0, input[0])
        rows = responses(shape, input, None, train)
        strength = np.linalg.svd(rows - rows.mean(axis=0), compute_uv=False)
        if len(rows) >= rows.shape[1] and (
            strength[-1] >= TOLD_APART * np.sqrt(len(rows))
        ):
            return cells
    return 0


def preisach_with_lag(record: Record, train: slice) -> PreisachFit:
    """Return the Preisach model and lag whose free run fits ``record`` best.

    For each lag the weights are those of ``fit_preisach``, and the best lag is searched
    for; of both histories before the record, virgin and saturated, the better is taken.
    Raises ValueError as ``fit_preisach``, and where the record tells too few cells
    apart.
    """
    cells = cells_told_apart(record, train)
    if not cells:
        raise ValueError(TOO_FEW)
    seen = record.until(train.stop)
    shifted = Record(_a_sample_later(seen.input), seen.output, seen.dt)
    limits = float(seen.input.min()), float(seen.input.max())
    run = eqx.filter_jit(from_rest)

    def fitted(log_lag: float, start: str) -> tuple[Preisach, FirstOrderLag]:
        lag = FirstOrderLag(float(np.exp(log_lag)), record.dt)
        hysteresis = fit_preisach(
            shifted,
            cells,
            train=train,
            limits=limits,
            dynamics=lag.as_arma(),
            start=start,
        )
        return hysteresis, lag

    def errors(hysteresis: Preisach, lag: FirstOrderLag) -> np.ndarray:
        system = series(hysteresis=hysteresis, lag=lag)
        return (np.asarray(run(system, as_array(seen.input))) - seen.output)[train]

    def misfit(log_lag: float, start: str) -> float:
        return float(np.mean(errors(*fitted(log_lag, start)) ** 2))

    bounds = tuple(np.log(np.array(LAGS) * record.dt))
    found = {
        start: minimize_scalar(
            misfit, args=(start,), bounds=bounds, method="bounded", options=OPTIONS
        )
        for start in STARTS
    }
    start = min(found, key=lambda name: found[name].fun)
    best = float(found[start].x)
    hysteresis, lag = fitted(best, start)
    left = errors(hysteresis, lag)
    tau = float(np.exp(best))
    slower = FirstOrderLag(tau * (1.0 + STEP), record.dt)
    jacobian = np.column_stack(
        [
            responses(hysteresis, shifted.input, lag.as_arma(), train),
            np.ones(left.size),
            (errors(hysteresis, slower) - left) / (tau * STEP),
        ]
    )
    variance = float(np.sum(left**2)) / max(left.size - jacobian.shape[1], 1)
    weights = np.asarray(hysteresis.weights)
    values = {
        # Line by line, as the columns of the responses are.
        f"hysteresis.weights.{j + k}.{j}": float(weights[j + k, j])
        for k in range(cells)
        for j in range(cells - k)
    }
    values["hysteresis.lowest"] = float(hysteresis.lowest)
    values["lag.time_constant"] = tau
    return PreisachFit(
        series(hysteresis=hysteresis, lag=lag),
        values,
        standard_errors(jacobian, variance),
    )


def _a_sample_later(input: np.ndarray) -> np.ndarray:
    # A plant maps u(k) to y(k+1).
    return np.concatenate([input[:1], input[:-1]])
