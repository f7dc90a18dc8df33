"""Model reduction: balanced truncation, and removal of slow modes."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy import linalg

from .state_space import StateSpace

NEGLIGIBLE = 1e-7
"""Hankel singular values below this share of the largest may be rounding errors: they
are computed from roots of the Gramians, which have half the digits."""


class Reduction(NamedTuple):
    """Reduced ``model`` and its error bound.

    ``hankel_singular_values`` [n] are those of the full model, largest first.
    ``error_bound`` is an upper bound, at all frequencies, of the largest singular value
    of the difference between both responses.
    """

    model: StateSpace
    hankel_singular_values: np.ndarray
    error_bound: float


def balanced_reduction(model: StateSpace, order: int) -> Reduction:
    """Return ``model`` reduced to ``order`` states by balanced truncation.

    In balanced coordinates each state is equally controllable and observable, as
    measured by its Hankel singular value. The states with the smallest values are
    removed. The reduced model is stable, and its error is at most twice the sum of the
    removed values. The values depend on the units: scale inputs and outputs first if
    their units differ. The gain at rest changes by no more than the bound.

    Sources: B. C. Moore, IEEE Trans. Automatic Control 26, 1981, pp. 17-32 (balancing);
    U. M. Al-Saggaf and G. F. Franklin, IEEE Trans. Automatic Control 32, 1987, pp.
    815-819 (the bound for discrete time). Raises ValueError for a model that is not
    stable or has no states, and for an ``order`` below 1 or above the number of states
    that are controllable and observable.
    """
    if not model.order:
        raise ValueError("the model has no states; a reduction keeps at least 1")
    if not 1 <= order <= model.order:
        raise ValueError(f"order is {order}; it must be between 1 and {model.order}")
    balance = _balance(model)
    if order > balance.connected:
        raise ValueError(
            f"order is {order}; only {balance.connected} states are controllable and "
            "observable"
        )
    return balance.truncated(model, order)


def reduced(model: StateSpace, most: int) -> StateSpace:
    """Return ``model`` with at most ``most`` states, by balanced reduction.

    A model with at most ``most`` states is returned unchanged. Otherwise states that
    are not controllable or not observable are removed too. Raises ValueError if a model
    with more states is not stable.
    """
    if model.order <= most:
        return model
    balance = _balance(model)
    connected = int(np.sum(balance.hankel > NEGLIGIBLE * balance.hankel[0]))
    return balance.truncated(model, min(most, connected)).model


def fast_part(model: StateSpace, angle: float, share: float = 0.1) -> StateSpace:
    """Return ``model`` without the slow modes that contribute little at ``angle``.

    A mode is slow if its natural frequency abs(log z) is below a tenth of ``angle``
    (rad per sample): a mode of creep, or an integrator with its pole at z = 1. The
    slowest modes are removed, as many as possible while the response at ``angle``
    changes by at most ``share``, relative to its largest entry. The gain at rest of the
    result differs from that of ``model``.
    """
    A, B, C = (np.asarray(matrix) for matrix in (model.A, model.B, model.C))
    rates = natural_frequencies(np.linalg.eigvals(A))
    whole = _response(A, B, C, angle) + np.asarray(model.D)
    for rate in np.unique(rates[rates < 0.1 * angle])[::-1]:
        fast, slow = _split(A, B, C, float(rate))
        if np.abs(_response(*slow, angle)).max() <= share * np.abs(whole).max():
            return StateSpace(*fast, model.D, model.dt)
    return model


def natural_frequencies(poles: Sequence[complex] | np.ndarray) -> np.ndarray:
    """Return the natural frequencies abs(log z) (rad per sample) of ``poles`` z.

    The natural frequency of a pole at 0, a pure delay, is infinite.
    """
    with np.errstate(divide="ignore"):
        return np.abs(np.log(np.asarray(poles, dtype=complex)))


class _Balance(NamedTuple):
    """Transformations to and from balanced coordinates, largest Hankel value first."""

    hankel: np.ndarray
    into: np.ndarray
    out: np.ndarray
    connected: int

    def truncated(self, model: StateSpace, order: int) -> Reduction:
        A, B, C = (np.asarray(matrix) for matrix in (model.A, model.B, model.C))
        scale = np.sqrt(self.hankel[:order])
        into, out = self.into[:, :order].T / scale[:, None], self.out[:, :order] / scale
        kept = StateSpace(into @ A @ out, into @ B, C @ out, model.D, model.dt)
        return Reduction(kept, self.hankel, 2.0 * float(np.sum(self.hankel[order:])))


def _balance(model: StateSpace) -> _Balance:
    A, B, C = (np.asarray(matrix) for matrix in (model.A, model.B, model.C))
    radius = np.abs(np.linalg.eigvals(A)).max()
    if radius >= 1.0:
        raise ValueError(
            f"the model has a pole at radius {radius:.6g}; only a stable model, with "
            "all poles inside the unit circle, can be balanced"
        )
    # The default of scipy for few states solves one large, ill-conditioned equation.
    controllable, observable = (
        _root(linalg.solve_discrete_lyapunov(a, q, method="bilinear"))
        for a, q in ((A, B @ B.T), (A.T, C.T @ C))
    )
    left, hankel, right = np.linalg.svd(observable.T @ controllable)
    connected = int(np.sum(hankel > len(A) * np.finfo(float).eps * hankel[0]))
    return _Balance(hankel, observable @ left, controllable @ right.T, connected)


def _root(gramian: np.ndarray) -> np.ndarray:
    """Return R with R R' = ``gramian``; negative eigenvalues from rounding become 0."""
    values, vectors = np.linalg.eigh(0.5 * (gramian + gramian.T))
    return vectors * np.sqrt(np.clip(values, 0.0, None))


Matrices = tuple[np.ndarray, np.ndarray, np.ndarray]


def _split(
    A: np.ndarray, B: np.ndarray, C: np.ndarray, rate: float
) -> tuple[Matrices, Matrices]:
    """Return two models in parallel: the modes faster than ``rate``, and the others."""

    above = 1.000001 * rate + 1e-9  # rounding moves poles, also those at z = 1
    # A lambda: SciPy counts the arguments, which a decorator would hide.
    ordered: Any = linalg.schur(
        A,
        output="real",
        sort=lambda x, y: bool(natural_frequencies([complex(x, y)])[0] > above),
    )
    schur, basis, count = ordered
    fast, slow = slice(0, count), slice(count, None)
    B, C = basis.T @ B, C @ basis
    # The Sylvester equation removes the coupling from the triangular form.
    X = linalg.solve_sylvester(
        schur[fast, fast], -schur[slow, slow], -schur[fast, slow]
    )
    return (
        (schur[fast, fast], B[fast] - X @ B[slow], C[:, fast]),
        (schur[slow, slow], B[slow], C[:, fast] @ X + C[:, slow]),
    )


def _response(A: np.ndarray, B: np.ndarray, C: np.ndarray, angle: float) -> np.ndarray:
    """Return ``C (z I - A)^-1 B`` at z = exp(i ``angle``)."""
    z = np.exp(1j * angle)
    return C @ np.linalg.solve(z * np.eye(len(A)) - A, B + 0j)
