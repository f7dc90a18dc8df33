"""Training a neural state space on one steady period of a record."""

import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from ..dynamics import NeuralStateSpace
from .record import Record
from .steady_state import fit_steady_state


def fit_neural_state_space(
    record: Record,
    order: int,
    neurons: int,
    *,
    seed: int = 0,
    settle: int | None = None,
    steps: int = 150,
) -> NeuralStateSpace:
    """Fit a state space of ``order`` with ``neurons`` to ``record``, one steady period.

    Starts from the linear model of ``linear_state_space`` with neurons drawn by
    ``seed`` and not yet connected, then ``fit_steady_state`` moves all numbers, by the
    simulated output alone. It knows nothing of what made the record; any number of
    inputs and outputs. Raises ValueError for an order or a number of neurons below 1,
    and as ``fit_steady_state`` does.
    """
    if neurons < 1:
        raise ValueError(f"neurons is {neurons}; it must be at least 1")
    start = _with_neurons(linear_state_space(record, order), neurons, record, seed)
    numbers, put = ravel_pytree(start)
    best, _ = fit_steady_state(put, numbers[None], record, settle=settle, steps=steps)
    return put(best)


def linear_state_space(record: Record, order: int) -> NeuralStateSpace:
    """Return a stable linear state space of ``order`` for one steady period.

    Subspace identification: least squares from ``LAGS`` past inputs and outputs and as
    many future inputs to the future outputs; the principal directions of what the past
    adds are the states, of unit deviation, and a second least squares gives the
    matrices (Van Overschee & De Moor 1996, chapter 4). The record is taken as periodic.
    Raises ValueError unless ``order`` lies between 1 and the ``LAGS`` past outputs.
    """
    u0, y0 = record.inputs.mean(axis=0), record.outputs.mean(axis=0)
    us, ys = record.inputs.std(axis=0), record.outputs.std(axis=0)
    u, y = (record.inputs - u0) / us, (record.outputs - y0) / ys
    if not 1 <= order <= LAGS * y.shape[1]:
        raise ValueError(f"order is {order}; it must lie in 1..{LAGS * y.shape[1]}")
    ahead = range(LAGS)
    past = np.hstack(
        [np.roll(u, k + 1, axis=0) for k in ahead]
        + [np.roll(y, k, axis=0) for k in ahead]
    )
    future_u = np.hstack([np.roll(u, -k, axis=0) for k in ahead])
    future_y = np.hstack([np.roll(y, -k, axis=0) for k in ahead])
    weights = _least_squares(np.hstack([past, future_u]), future_y)
    directions = np.linalg.svd(past @ weights[: past.shape[1]], full_matrices=False)[0]
    x = directions[:, :order] * np.sqrt(len(u))
    forward = _least_squares(np.hstack([x, u]), np.roll(x, -1, axis=0)).T
    A, B = forward[:, :order], forward[:, order:]
    A = A * min(1.0, RADIUS / np.max(np.abs(np.linalg.eigvals(A))))
    C = _least_squares(x, y).T
    return NeuralStateSpace(
        state_matrix=A,
        input_matrix=B / us,
        output_matrix=ys[:, None] * C,
        neuron_output=np.zeros((order, 0)),
        neuron_state=np.zeros((0, order)),
        neuron_input=np.zeros((0, u.shape[1])),
        neuron_bias=np.zeros(0),
        input_offset=u0,
        output_offset=y0,
    )


LAGS = 12
"""Samples of past and future that the linear start looks at."""

RADIUS = 0.995
"""Largest modulus of a pole of the linear start."""

WEAK = 1e-4
"""Directions that the record excites less than this, as a share, are left out."""


def _least_squares(columns: np.ndarray, target: np.ndarray) -> np.ndarray:
    return np.linalg.lstsq(columns, target, rcond=WEAK)[0]


def _with_neurons(
    linear: NeuralStateSpace, neurons: int, record: Record, seed: int
) -> NeuralStateSpace:
    draw = np.random.default_rng(seed)
    order, inputs = linear.input_matrix.shape
    return NeuralStateSpace(
        state_matrix=linear.state_matrix,
        input_matrix=linear.input_matrix,
        output_matrix=linear.output_matrix,
        neuron_output=np.zeros((order, neurons)),
        neuron_state=draw.standard_normal((neurons, order)),
        neuron_input=draw.standard_normal((neurons, inputs))
        / record.inputs.std(axis=0),
        neuron_bias=draw.standard_normal(neurons),
        input_offset=linear.input_offset,
        output_offset=linear.output_offset,
    )
