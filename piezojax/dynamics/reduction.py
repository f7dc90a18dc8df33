"""Fewer states for nearly the same inputs and outputs."""

from typing import NamedTuple

import numpy as np
from scipy import linalg

from .state_space import StateSpace


class Reduction(NamedTuple):
    """A ``model`` of fewer states, and what that costs.

    ``hankel_singular_values`` [n] of the whole model, largest first; ``error_bound``:
    nowhere in frequency is the largest singular value of the difference above it.
    """

    model: StateSpace
    hankel_singular_values: np.ndarray
    error_bound: float


def balanced_reduction(model: StateSpace, order: int) -> Reduction:
    """Return ``model`` with the ``order`` states that most connect input and output.

    In balanced coordinates each state is reached by inputs as well as it shows in
    outputs, its Hankel singular value; those with the smallest are left out. What
    remains is stable; its difference has at most twice the sum of the values left out.
    Scale inputs and outputs first where their units differ: the values depend on them.
    The gain at rest changes, by no more than the bound.

    Sources: B. C. Moore, IEEE Trans. Automatic Control 26, 1981, pp. 17-32 (balancing);
    U. M. Al-Saggaf and G. F. Franklin, IEEE Trans. Automatic Control 32, 1987, pp.
    815-819 (the bound for discrete time). Raises ValueError for a model that is not
    stable, or an ``order`` that is not between 1 and the number of states, or that
    reaches into states that are not connected at all.
    """
    A, B, C = (np.asarray(matrix) for matrix in (model.A, model.B, model.C))
    if not 1 <= order <= len(A):
        raise ValueError(f"order is {order}; it must be between 1 and {len(A)}")
    radius = np.abs(np.linalg.eigvals(A)).max()
    if radius >= 1.0:
        raise ValueError(
            f"the model has a pole at radius {radius:.6g}; only a stable one, below 1, "
            "can be balanced"
        )
    reached = _root(linalg.solve_discrete_lyapunov(A, B @ B.T))
    shown = _root(linalg.solve_discrete_lyapunov(A.T, C.T @ C))
    left, hankel, right = np.linalg.svd(shown.T @ reached)
    connected = int(np.sum(hankel > len(A) * np.finfo(float).eps * hankel[0]))
    if order > connected:
        raise ValueError(
            f"order is {order}; only {connected} states connect inputs and outputs"
        )
    scale = np.sqrt(hankel[:order])
    into = (shown @ left[:, :order] / scale).T
    out = reached @ right[:order].T / scale
    reduced = StateSpace(into @ A @ out, into @ B, C @ out, model.D, model.dt)
    return Reduction(reduced, hankel, 2.0 * float(np.sum(hankel[order:])))


def _root(gramian: np.ndarray) -> np.ndarray:
    """Return R with R R' = ``gramian``, which rounding may have made indefinite."""
    values, vectors = np.linalg.eigh(0.5 * (gramian + gramian.T))
    return vectors * np.sqrt(np.clip(values, 0.0, None))
