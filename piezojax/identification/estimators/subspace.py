"""State-space models of one input channel by the Hankel-Toeplitz regression.

Chapter 6 of Y. Cao's thesis, with its errata: rows k = p .. N-p of

    [y(k) .. y(k+p-1)] = theta [u(k-p) .. u(k-1), y(k-p) .. y(k-1), u(k) .. u(k+p-1)],

theta = [Gamma Phi D_p] (6.9); H0 = Gamma + Phi D_p (6.10); H1 = Phi H0 (6.11).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy import linalg

from ...core.recursive_update import update
from ...core.rollout import simulate
from ...dynamics import StateSpace, stabilised
from ..records.record import Record

Theta = Float[np.ndarray, "outputs regressors"]
Rows = Float[np.ndarray, "rows regressors"]
Targets = Float[np.ndarray, "rows outputs"]
Estimator = Callable[[Rows, Targets], Theta]


def least_squares(X: Rows, Y: Targets, tolerance: float = 1e-15) -> Theta:
    """Return the least-squares theta of least norm for ``Y = X theta^T``, (6.16).

    Directions of X below ``tolerance`` times the strongest one are left out.
    """
    return np.linalg.lstsq(X, Y, rcond=tolerance)[0].T


def maximum_a_posteriori(X: Rows, Y: Targets, variance: float, prior: float) -> Theta:
    """Return the most probable theta given all rows.

    ``variance`` is that of the errors (sigma), ``prior`` the variance of the entries of
    theta around zero (P_0). The result equals that of ``recursive`` over the same rows:
    both are ridge regression with the penalty ``variance / prior``.
    """
    penalty = variance / prior * np.eye(X.shape[1])
    return linalg.solve(X.T @ X + penalty, X.T @ Y, assume_a="pos").T


def recursive(
    X: Rows, Y: Targets, variance: float, prior: float
) -> tuple[Theta, Float[np.ndarray, "regressors regressors"]]:
    """Return theta and its covariance P, updated row by row, (6.17)-(6.18).

    The recursion starts at theta_0 = 0 and P_0 = ``prior`` I.
    """
    theta = np.zeros((Y.shape[1], X.shape[1]))
    P = prior * np.eye(X.shape[1])
    for x, y in zip(X, Y, strict=True):
        theta, P = update(theta, P, x, y, variance)
    return theta, P


def regression(
    input: Float[np.ndarray, " n"], outputs: Float[np.ndarray, "n q"], p: int
) -> tuple[Rows, Targets]:
    """Return the rows X(k) and Yp(k) of the Hankel-Toeplitz model."""
    columns = np.column_stack([input, outputs])
    windows = np.lib.stride_tricks.sliding_window_view(columns, 2 * p, axis=0)
    past, future = windows[..., :p], windows[..., p:]  # [rows, 1 + q, p]

    def flat(block):
        return block.swapaxes(1, 2).reshape(len(windows), -1)

    X = np.hstack([past[:, 0], flat(past[:, 1:]), future[:, 0]])
    return X, flat(future[:, 1:])


def markov_parameters(theta: Theta, p: int) -> Float[np.ndarray, "count q"]:
    """Return h(s) = C A^s B for s = 0 .. 3p-2 from H0 and H1.

    Block (i, j) of H0 estimates h(i+p-1-j), that of H1 h(p+i+p-1-j); all estimates of
    one h(s) are averaged.
    """
    q = len(theta) // p
    gamma, phi, toeplitz = np.split(theta, [p, p + q * p], axis=1)
    H0 = gamma + phi @ toeplitz
    blocks = np.vstack([H0, phi @ H0]).reshape(2 * p, q, p)
    lag = np.arange(2 * p)[:, None] + p - 1 - np.arange(p)
    total = np.zeros((3 * p - 1, q))
    np.add.at(total, lag, blocks.swapaxes(1, 2))
    return total / np.bincount(lag.ravel())[:, None]


def _largest_order(count: int) -> int:
    """Return the largest order that ``count`` Markov parameters of one input allow."""
    return count // 2


def _hankel(markov: Float[np.ndarray, "count q"], shift: int) -> np.ndarray:
    """Return Hbar(shift), block (a, b) = h(a + b + shift), as square as possible."""
    size = _largest_order(len(markov))
    lag = np.arange(size)[:, None] + np.arange(size) + shift
    return markov[lag].swapaxes(1, 2).reshape(size * markov.shape[1], size)


def hankel_singular_values(
    markov: Float[np.ndarray, "count q"],
) -> Float[np.ndarray, " values"]:
    """Return the singular values of Hbar(0), largest first."""
    return np.linalg.svdvals(_hankel(markov, 0))


def order_at_gap(singular_values: Float[np.ndarray, " values"], most: int) -> int:
    """Return the order up to ``most`` after which the singular values drop most."""
    head = np.asarray(singular_values)[: most + 1]
    return int(np.argmin(head[1:] / head[:-1])) + 1


def realised(
    markov: Float[np.ndarray, "count q"], order: int, dt: float
) -> tuple[StateSpace, int]:
    """Return the model with ``order`` states and D = 0, and the number of moved poles.

    The eigensystem realisation of Lemma 6.1, from the singular value decomposition of
    Hbar(0); poles outside the unit circle are reflected. Raises ValueError for an order
    that the parameters do not allow.
    """
    first = _hankel(markov, 0)
    if not 1 <= order <= _largest_order(len(markov)):
        raise ValueError(
            f"order is {order}; {len(markov)} Markov parameters allow "
            f"1..{_largest_order(len(markov))}"
        )
    left, values, right = np.linalg.svd(first, full_matrices=False)
    root = np.sqrt(values[:order])
    left, right = left[:, :order], right[:order]
    A = left.T @ _hankel(markov, 1) @ right.T / np.outer(root, root)
    outputs = markov.shape[1]
    return stabilised(
        StateSpace(
            A,
            (root[:, None] * right)[:, :1],
            left[:outputs] * root,
            np.zeros((outputs, 1)),
            dt,
        )
    )


PRIOR = partial(maximum_a_posteriori, variance=1.0, prior=10.0)
"""Default estimate of ``identify_channel``. Least squares without a prior fails on a
chirp, because the record holds only noise above its last frequency."""

UNEXCITED = 1e-3
"""Strength of an input direction, as a share of the strongest, below which it counts as
unexcited."""

TOLERATED = 1.1
"""Factor of the best error within which ``choose`` prefers the smallest model."""


@dataclass(frozen=True)
class ChannelFit:
    """A model of one input channel.

    ``markov`` [3p-1, q] are the estimates of C A^s B, s = 0, 1, ..., from which the
    model is realised; ``singular_values`` are those of their Hankel matrix. ``notes``
    are one-line warnings about reflected poles and unexcited input directions.
    """

    model: StateSpace
    markov: np.ndarray
    singular_values: np.ndarray
    notes: tuple[str, ...]


def identify_channel(
    record: Record,
    p: int,
    order: int,
    estimate: Estimator = PRIOR,
) -> ChannelFit:
    """Fit a model with ``order`` states to a record with one input.

    Input and outputs are first divided by the rms of the input, so that a gain of order
    one suits the prior of ``estimate``. Stack the models of all channels with
    ``stacked``. Raises ValueError for a record with several inputs, a p below 1 or too
    long for the record, or an order that p does not allow.
    """
    if not 1 <= p <= record.samples // 4:
        raise ValueError(
            f"p is {p}; {record.samples} samples allow 1..{record.samples // 4}"
        )
    scale = np.sqrt(np.mean(record.input**2))
    X, Y = regression(record.input / scale, record.outputs / scale, p)
    markov = markov_parameters(estimate(X, Y), p)
    model, moved = realised(markov, order, record.dt)
    notes = []
    if moved:
        notes.append(
            f"{moved} of {order} poles lay outside the unit circle and were reflected"
        )
    inputs = np.hstack([X[:, :p], X[:, -p:]])
    strength = np.linalg.svdvals(inputs)
    excited = int(np.sum(strength > UNEXCITED * strength[0]))
    if excited < 2 * p:
        notes.append(
            f"the input excites {excited} of the {2 * p} directions of {2 * p} "
            "samples: in the others noise and prior alone determine the response"
        )
    return ChannelFit(model, markov, hankel_singular_values(markov), tuple(notes))


def simulation_errors(
    model: StateSpace, record: Record, start: int = 0
) -> Float[np.ndarray, " q"]:
    """Return the rms error of each output in a free run from rest, in its unit.

    The run begins with the record; samples from ``start`` on enter the error.
    """
    simulated = np.asarray(_free_run(model, jnp.asarray(record.inputs)))
    error = (simulated - record.outputs)[start:]
    return np.sqrt(np.mean(error**2, axis=0))


@eqx.filter_jit
def _free_run(model: StateSpace, inputs: Float[Array, "n m"]) -> Float[Array, "n q"]:
    return simulate(model, inputs, model.init(inputs[0]))[1]


@dataclass(frozen=True)
class Choice:
    """Choice of p and order, the result of ``choose``.

    ``errors`` [len(ps), len(orders)] is the norm of the outputs' rms errors as a share
    of the largest span, infinite where p does not allow the order.
    """

    p: int
    order: int
    errors: np.ndarray


def choose(
    train: Record,
    validate: Record,
    ps: Sequence[int],
    orders: Sequence[int],
    estimate: Estimator = PRIOR,
) -> Choice:
    """Choose p and the order by the free-run error on the record ``validate``.

    Of the pairs within the factor TOLERATED of the best error, the smallest order is
    taken, then the smallest p. Errors in different units are added without scaling.
    """
    most = max(orders)
    errors = np.full((len(ps), len(orders)), np.inf)
    for i, p in enumerate(ps):
        for j, order in enumerate(orders):
            if order <= _largest_order(3 * p - 1):
                model = identify_channel(train, p, order, estimate).model
                error = simulation_errors(_padded(model, most), validate)
                errors[i, j] = np.linalg.norm(error) / validate.spans.max()
    close = errors <= TOLERATED * errors.min()
    order, p = min((orders[j], ps[i]) for i, j in np.argwhere(close))
    return Choice(p, order, errors)


def _padded(model: StateSpace, order: int) -> StateSpace:
    """Return the model with idle states added, so that all orders compile once."""
    more = order - model.order
    return StateSpace(
        np.pad(model.A, (0, more)),
        np.pad(model.B, ((0, more), (0, 0))),
        np.pad(model.C, ((0, 0), (0, more))),
        model.D,
        model.dt,
    )
