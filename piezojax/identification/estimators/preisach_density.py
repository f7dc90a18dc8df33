"""Fit of Preisach densities to a record by non-negative least squares."""

import equinox as eqx
import numpy as np
import scipy
from jaxtyping import Array

from ...core.arrays import as_array
from ...dynamics import ARMA
from ...hysteresis import Preisach, RateDependentPreisach
from ...hysteresis.play_lines import line_by_line
from ...hysteresis.preisach import LEAST_SLOPE, neighbours
from ...hysteresis.rate_dependent_preisach import fast_share
from ..records.record import Record
from .linear_weights import nonnegative


def fit_preisach(
    record: Record,
    cells: int = 20,
    *,
    train: slice | None = None,
    limits: tuple[float, float] | None = None,
    dynamics: ARMA | None = None,
    smoothing: float = 0.0,
    start: str = "virgin",
) -> Preisach:
    """Return the Preisach model, ``cells`` per side, that fits ``record`` best.

    For a given input the output (2.1) is linear in the weights. They are found by least
    squares over the samples ``train`` (all by default; a slice with a step takes only
    some), subject to weights of at least 0. ``limits`` (V) are the lowest and highest
    input of the model, by default those of the record. ``dynamics`` are those between
    hysteresis and output, by default none. The record must begin at rest; ``start`` is
    the memory of the model there, ``"virgin"`` about the first input or
    ``"saturated"``.

    Cells that no turn of the input reaches are determined only by ``smoothing``. Its
    square is the weight of the squared differences between neighbours relative to the
    mean squared error; 0 means no smoothing. Weights on the diagonal give at least 1 %
    of the mean slope of the record, so that the model has a continuous inverse.

    Raises ValueError for an empty ``train``, limits that do not hold the record's
    input, ``cells`` or ``smoothing`` out of range, or an output that falls while the
    input rises.
    """
    shape = empty(record, cells, limits, start)
    (weights,), lowest = _densities(record, shape, train, dynamics, smoothing)
    return _filled(shape, weights, lowest)


def fit_rate_dependent_preisach(
    record: Record,
    rate: float,
    cells: int = 20,
    *,
    train: slice | None = None,
    limits: tuple[float, float] | None = None,
    dynamics: ARMA | None = None,
    smoothing: float = 0.0,
    start: str = "virgin",
) -> RateDependentPreisach:
    """Return the model with densities of equal share at ``rate`` (V/s) that fits best.

    For a given rate the output (2.10) is linear in both densities. Each is fitted as in
    fit_preisach. A record with a single speed does not determine both. Raises
    ValueError as fit_preisach does, and for ``rate <= 0``.
    """
    slow = empty(record, cells, limits, start)
    shape = RateDependentPreisach(slow, slow.weights, rate, record.dt)
    (weights, fast), lowest = _densities(record, shape, train, dynamics, smoothing)
    slow = _filled(slow, weights, lowest)
    return RateDependentPreisach(slow, fast, rate, record.dt)


def _filled(shape: Preisach, weights: np.ndarray, lowest: float) -> Preisach:
    return Preisach(
        weights, shape.low, shape.high, lowest, shape.rest_input, shape.start
    )


def empty(
    record: Record, cells: int, limits: tuple[float, float] | None, start: str
) -> Preisach:
    """Return a model with zero weights, with the limits and start for ``record``.

    Raises ValueError for less than one cell or limits that do not hold the input.
    """
    if cells < 1:
        raise ValueError(f"cells is {cells}; it must be at least 1")
    extremes = float(record.input.min()), float(record.input.max())
    low, high = limits or extremes
    if not (low <= extremes[0] and extremes[1] <= high):
        raise ValueError(
            f"limits are {low:g} to {high:g} V; the input runs from {extremes[0]:g} "
            f"to {extremes[1]:g} V"
        )
    return Preisach(np.zeros((cells, cells)), low, high, 0.0, record.input[0], start)


def _densities(
    record: Record,
    shape: Preisach | RateDependentPreisach,
    train: slice | None,
    dynamics: ARMA | None,
    smoothing: float,
) -> tuple[list[np.ndarray], float]:
    """Return the weights of each density of ``shape``, and the lowest output, um."""
    if not smoothing >= 0.0:
        raise ValueError(f"smoothing is {smoothing:g}; it must be at least 0")
    part = train or slice(None)
    wanted = record.output[part]
    if not wanted.size:
        raise ValueError(
            f"train is {part.start}:{part.stop}; it must hold some of "
            f"{record.samples} samples"
        )
    slope = float(np.cov(record.input, record.output)[0, 1] / np.var(record.input))
    if slope <= 0.0:
        raise ValueError("the output falls while the input rises; reverse its sign")
    slow = _slow(shape)
    cells = slow.cells
    places = line_by_line(cells)
    rows = responses(shape, record.input, dynamics, part)
    count = rows.shape[1] // len(places)
    least = np.zeros(len(places))
    least[:cells] = LEAST_SLOPE * slope * float(slow.high - slow.low) / cells
    least = np.tile(least, count)
    centre = rows.mean(axis=0)
    rough = smoothing * np.sqrt(wanted.size) * neighbours(places)
    rough = np.kron(np.eye(count), rough)
    matrix = np.vstack([rows - centre, rough])
    right = np.append(wanted - wanted.mean(), np.zeros(len(rough))) - matrix @ least
    found = least + nonnegative(matrix, right)
    densities = []
    for own in np.split(found, count):
        weights = np.zeros((cells, cells))
        weights[tuple(np.transpose(places))] = own
        densities.append(weights)
    gain = 1.0 if dynamics is None else float(dynamics.dc_gain())
    return densities, float(wanted.mean() - centre @ found) / gain


def _slow(shape: Preisach | RateDependentPreisach) -> Preisach:
    return shape.slow if isinstance(shape, RateDependentPreisach) else shape


@eqx.filter_jit
def _responses(shape: Preisach, input: Array, places: tuple[Array, ...]) -> Array:
    return shape.responses(input, places)


def responses(
    shape: Preisach | RateDependentPreisach,
    input: np.ndarray,
    dynamics: ARMA | None,
    part: slice,
) -> np.ndarray:
    """Return the output over ``part`` of 1 um in each cell, one column per cell.

    The cells are ordered as in ``line_by_line``; those of a fast density follow those
    of the slow one.
    """
    slow = _slow(shape)
    places = tuple(np.transpose(line_by_line(slow.cells)))
    up = np.asarray(_responses(slow, as_array(input), places)).T
    if isinstance(shape, RateDependentPreisach):
        rate = np.diff(input, prepend=input[0]) / shape.dt
        fast = np.asarray(fast_share(as_array(rate) / shape.rate))[:, None]
        up = np.hstack([(1.0 - fast) * up, fast * up])
    return _passed(up, dynamics)[part]


def _passed(signals: np.ndarray, dynamics: ARMA | None) -> np.ndarray:
    """Return ``signals`` behind ``dynamics``, at rest under their first samples."""
    if dynamics is None:
        return signals
    moving = [float(b) for b in dynamics.moving]
    past = [1.0, *(-float(a) for a in dynamics.autoregressive)]
    rest = float(dynamics.dc_gain()) * signals[0]
    return scipy.signal.lfilter(moving, past, signals - signals[0], axis=0) + rest
