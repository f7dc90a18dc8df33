"""Linear loops as matrices, without their conserved modes.

A conserved mode has its pole at z = 1, and no input moves it.
"""

from typing import Any, NamedTuple, TypeVar

import numpy as np
from scipy import linalg

FEW = 50
"""Number of lines below which a transfer function is solved one line at a time."""

TOLERANCE = 1e-9
"""Largest singular value of a conserved direction, with rows of [A - I, B] scaled to
length 1."""


class LinearLoop(NamedTuple):
    """L of one axis as NumPy matrices: A [n, n], B [n], C [n]; ``dt`` in s.

    ``conserved`` is the number of conserved modes that have been removed. ``followed``
    is the closed loop from reference to displacement, None if it is not known.
    """

    A: np.ndarray
    B: np.ndarray
    C: np.ndarray
    dt: float
    conserved: int = 0
    followed: "FollowedReference | None" = None

    def closed(self) -> np.ndarray:
        """Return the state matrix of the closed loop."""
        return self.A - np.outer(self.B, self.C)

    def integrates(self) -> bool:
        """Return whether L has a pole at z = 1, to within ``TOLERANCE``."""
        rows = self.A - np.eye(len(self.A))
        singular = np.linalg.svd(rows / _lengths(rows)[:, None], compute_uv=False)
        return bool(np.any(singular < TOLERANCE))

    def response(self, angle: np.ndarray) -> np.ndarray:
        """Return L [m] at z = exp(i angle), angle [m] in rad/sample."""
        return _transfer(self.A, self.B[:, None], self.C[None], angle)[:, 0, 0]

    def closed_responses(self, angle: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return S = 1/(1+L) and T = L/(1+L), both [m, 1, 1], at z = exp(i angle)."""
        L = self.response(angle)[:, None, None]
        return 1.0 / (1.0 + L), L / (1.0 + L)


class FollowedReference(NamedTuple):
    """Closed loop of one axis from its reference to the displacement, as matrices.

    A [n, n], B [n] for r(k), C [n] and D for y(k); ``dt`` in s. ``conserved`` is the
    number of conserved modes that have been removed.
    """

    A: np.ndarray
    B: np.ndarray
    C: np.ndarray
    D: float
    dt: float
    conserved: int = 0

    @classmethod
    def seen_ahead(
        cls, A: np.ndarray, B: np.ndarray, C: np.ndarray, dt: float
    ) -> "FollowedReference":
        """Return the loop of a controller that sees r(k) and r(k+1), B [n, 2].

        With the states less B r(k), r(k) alone moves the loop. A state that sums up
        the changes of the reference (``LimitedReference``) is then conserved.
        """
        now, following = B.T
        return cls(A, now + A @ following, C, float(C @ following), dt)

    def closed(self) -> np.ndarray:
        """Return the state matrix, which is that of the closed loop."""
        return self.A

    def response(self, angle: np.ndarray) -> np.ndarray:
        """Return y/r [m] at z = exp(i angle), angle [m] in rad/sample."""
        found = _transfer(self.A, self.B[:, None], self.C[None], angle)
        return found[:, 0, 0] + self.D


class LinearAxes(NamedTuple):
    """L of several axes as NumPy matrices: A [n, n], B [n, q], C [q, n]; ``dt`` in s.

    ``conserved`` is the number of conserved modes that have been removed.
    """

    A: np.ndarray
    B: np.ndarray
    C: np.ndarray
    dt: float
    conserved: int = 0

    def closed(self) -> np.ndarray:
        """Return the state matrix of the closed loop."""
        return self.A - self.B @ self.C

    def sensitivity(self, angle: np.ndarray) -> np.ndarray:
        """Return S = (I+L)^-1 [m, q, q] at exp(i angle), angle [m] in rad/sample."""
        return np.eye(len(self.C)) - _transfer(self.closed(), self.B, self.C, angle)

    def closed_responses(self, angle: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return S and T = I - S, both [m, q, q], at z = exp(i angle)."""
        S = self.sensitivity(angle)
        return S, np.eye(len(self.C)) - S

    def one_cut(self, axis: int) -> LinearLoop:
        """Return the loop cut in one axis, with all others closed."""
        others = np.arange(len(self.C)) != axis
        A = self.A - self.B[:, others] @ self.C[others]
        return LinearLoop(A, self.B[:, axis], self.C[axis], self.dt, self.conserved)


def _transfer(
    A: np.ndarray, B: np.ndarray, C: np.ndarray, angle: np.ndarray
) -> np.ndarray:
    """Return C (zI - A)^-1 B [m, p, q] at z = exp(i angle), angle [m] in rad/sample."""
    z = np.exp(1j * np.atleast_1d(angle))
    if len(z) < FEW or len(A) == 0:
        resolvent = z[:, None, None] * np.eye(len(A)) - A
        return C @ np.linalg.solve(resolvent, B + 0j)
    # A triangular matrix is solved for all lines at once, row by row.
    found: Any = linalg.schur(A, output="complex")
    T, change = found
    driven = change.conj().T @ B
    states = np.zeros((len(A), len(z), B.shape[1]), complex)
    for i in reversed(range(len(A))):
        coupled = np.tensordot(T[i, i + 1 :], states[i + 1 :], axes=1)
        states[i] = (driven[i] + coupled) / (z - T[i, i])[:, None]
    return np.moveaxis(np.tensordot(C @ change, states, axes=1), 0, 1)


Matrices = TypeVar("Matrices", LinearLoop, LinearAxes, FollowedReference)


def without_conserved(loop: Matrices) -> Matrices:
    """Return the loop without its conserved modes.

    A conserved mode is a combination of states that never changes. Hysteresis
    linearises to ``y(k) - y(k-1) = slope (x(k) - x(k-1))`` and conserves
    ``y - slope x``: a pole at z = 1 that no input moves. The frozen bias of a start at
    rest and an integral with zero gain are conserved too. Conserved modes determine the
    operating point and not its stability. They span the left null space of [A - I, B].
    All other modes stay, including uncontrollable and unobservable ones.
    """
    A, B, C = loop.A, loop.B, loop.C
    rows = np.hstack([A - np.eye(len(A)), B.reshape(len(A), -1)])
    length = _lengths(rows)
    left, singular, _ = np.linalg.svd(rows / length[:, None], full_matrices=True)
    count = len(A) - int(np.sum(singular > TOLERANCE))
    if count == 0:
        return loop
    kept_sum = left[:, len(A) - count :] / length[:, None]  # w' x is conserved
    # Solve w' x = 0 for the states with the largest weights in w.
    order = linalg.qr(kept_sum.T, mode="economic", pivoting=True)[-1]
    out, stay = np.sort(order[:count]), np.sort(order[count:])
    back = -np.linalg.solve(kept_sum[out].T, kept_sum[stay].T)
    return loop._replace(
        A=A[np.ix_(stay, stay)] + A[np.ix_(stay, out)] @ back,
        B=B[stay],
        C=C[..., stay] + C[..., out] @ back,
        conserved=count,
    )


def _lengths(rows: np.ndarray) -> np.ndarray:
    """Return the lengths of ``rows``, 1 for a row of zeros."""
    length = np.linalg.norm(rows, axis=1)
    return np.where(length > 0.0, length, 1.0)


def balanced(loop: Matrices) -> Matrices:
    """Return the loop with its states scaled to balance the rows and columns of A."""
    if len(loop.A) == 0:
        return loop
    A, change = linalg.matrix_balance(loop.A, permute=False)
    scale = np.diagonal(change)
    return loop._replace(A=A, B=(loop.B.T / scale).T, C=loop.C * scale)
