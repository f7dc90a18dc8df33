"""Training of a neural state space on one steady period of a record."""

import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from ...core.arrays import as_array
from ...dynamics import NeuralStateSpace
from ..records.record import Record
from .steady_state import fit_steady_state

LAGS = 12
"""Number of past and of future samples in the regression for the linear start."""

RADIUS = 0.995
"""Largest modulus of a pole of the linear start."""

WEAK = 1e-4
"""Relative excitation below which a direction is left out."""


def fit_neural_state_space(
    record: Record,
    order: int = 3,
    neurons: int = 8,
    *,
    starts: int = 1,
    seed: int = 0,
    settle: int | None = None,
    steps: int = 200,
) -> NeuralStateSpace:
    """Fit a state space of ``order`` with ``neurons`` to ``record``, one steady period.

    ``fit_steady_state`` fits all numbers to the simulated output, from each
    ``neural_start`` with the seeds ``seed``, ``seed + 1``, ..., and the best fit is
    returned. The fit uses no prior knowledge of the stage. The record may have any
    number of inputs and outputs. Raises ValueError as these two functions do, or if
    ``starts`` is below 1.
    """
    if starts < 1:
        raise ValueError(f"starts is {starts}; it must be at least 1")
    drawn = [
        ravel_pytree(neural_start(record, order, neurons, seed=seed + k))
        for k in range(starts)
    ]
    numbers, put = jnp.stack([flat for flat, _ in drawn]), drawn[0][1]
    best, _ = fit_steady_state(put, numbers, record, settle=settle, steps=steps)
    return put(best)


def neural_start(
    record: Record, order: int, neurons: int, *, seed: int = 0
) -> NeuralStateSpace:
    """Return a stable linear model of one steady period, with unconnected neurons.

    The linear model is found by subspace identification (Van Overschee & De Moor 1996).
    Least squares predicts the future outputs from ``LAGS`` past inputs and outputs and
    as many future inputs. The principal components of the past's contribution are the
    states, with unit deviation. A second least squares gives A, B, C. ``seed`` draws
    the input weights of the neurons; their output weights start at zero. The record is
    treated as periodic. Raises ValueError unless ``neurons`` is at least 1 and
    ``order`` lies between 1 and ``LAGS`` times the number of outputs.
    """
    inputs, outputs = record.inputs.shape[1], record.outputs.shape[1]
    if neurons < 1:
        raise ValueError(f"neurons is {neurons}; it must be at least 1")
    if not 1 <= order <= LAGS * outputs:
        raise ValueError(f"order is {order}; it must lie in 1..{LAGS * outputs}")
    input_offset, output_offset = (
        record.inputs.mean(axis=0),
        record.outputs.mean(axis=0),
    )
    input_scale, output_scale = record.inputs.std(axis=0), record.outputs.std(axis=0)
    A, B, C = _subspace(
        (record.inputs - input_offset) / input_scale,
        (record.outputs - output_offset) / output_scale,
        order,
    )
    draw = np.random.default_rng(seed)
    return NeuralStateSpace(
        state_matrix=as_array(A),
        input_matrix=B / input_scale,
        output_matrix=output_scale[:, None] * C,
        neuron_output=as_array(np.zeros((order, neurons))),
        neuron_state=as_array(draw.standard_normal((neurons, order))),
        neuron_input=draw.standard_normal((neurons, inputs)) / input_scale,
        neuron_bias=as_array(draw.standard_normal(neurons)),
        input_offset=input_offset,
        output_offset=output_offset,
    )


def _subspace(
    u: np.ndarray, y: np.ndarray, order: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    def shifted(columns: np.ndarray, by: range) -> np.ndarray:
        return np.hstack([np.roll(columns, k, axis=0) for k in by])

    # y(k) belongs to the past of the state at k: the model has no direct feedthrough.
    past = np.hstack([shifted(u, range(1, LAGS + 1)), shifted(y, range(LAGS))])
    future = range(0, -LAGS, -1)
    to_future = _least_squares(
        np.hstack([past, shifted(u, future)]), shifted(y, future)
    )
    memory = past @ to_future[: past.shape[1]]
    x = np.linalg.svd(memory, full_matrices=False)[0][:, :order] * np.sqrt(len(u))
    forward = _least_squares(np.hstack([x, u]), np.roll(x, -1, axis=0)).T
    A, B = forward[:, :order], forward[:, order:]
    radius = np.max(np.abs(np.linalg.eigvals(A)))
    return A * min(1.0, RADIUS / radius), B, _least_squares(x, y).T


def _least_squares(columns: np.ndarray, target: np.ndarray) -> np.ndarray:
    return np.linalg.lstsq(columns, target, rcond=WEAK)[0]
