"""What a loop only remembers: modes at z = 1 that nothing moves."""

from typing import NamedTuple, TypeVar

import numpy as np
from scipy import linalg

TOLERANCE = 1e-9
"""A direction counts as conserved if rows scaled to length 1 cancel this well."""


class LinearLoop(NamedTuple):
    """L as NumPy matrices: A [n, n], B [n], C [n]; ``dt`` in s.

    ``conserved`` modes have been taken out.
    """

    A: np.ndarray
    B: np.ndarray
    C: np.ndarray
    dt: float
    conserved: int = 0

    def closed(self) -> np.ndarray:
        """Return the state matrix of the closed loop."""
        return self.A - np.outer(self.B, self.C)

    def integrates(self) -> bool:
        """Return whether L has a pole at z = 1, as far as rounding lets one see."""
        rows = self.A - np.eye(len(self.A))
        length = np.linalg.norm(rows, axis=1, keepdims=True)
        singular = np.linalg.svd(rows / length, compute_uv=False)
        return bool(np.any(singular < TOLERANCE))

    def response(self, angle: np.ndarray) -> np.ndarray:
        """Return L at z = exp(i angle), angle [m] in rad a sample."""
        z = np.exp(1j * np.atleast_1d(angle))
        resolvent = z[:, None, None] * np.eye(len(self.A)) - self.A
        states = np.linalg.solve(resolvent, self.B[:, None] + 0j)
        return states[..., 0] @ self.C

    def closed_responses(self, angle: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return S = 1/(1+L) and T = L/(1+L) at exp(i angle), both [m, 1, 1]."""
        L = self.response(angle)[:, None, None]
        return 1.0 / (1.0 + L), L / (1.0 + L)


class LinearAxes(NamedTuple):
    """L of several axes as NumPy matrices: A [n, n], B [n, q], C [q, n]; ``dt`` in s.

    ``conserved`` modes have been taken out.
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
        """Return S = (I + L)^-1 [m, q, q] at z = exp(i angle), angle [m] in rad."""
        z = np.exp(1j * np.atleast_1d(angle))
        resolvent = z[:, None, None] * np.eye(len(self.A)) - self.closed()
        return np.eye(len(self.C)) - self.C @ np.linalg.solve(resolvent, self.B + 0j)

    def closed_responses(self, angle: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return S and T = I - S at exp(i angle), both [m, q, q]."""
        S = self.sensitivity(angle)
        return S, np.eye(len(self.C)) - S

    def one_cut(self, axis: int) -> LinearLoop:
        """Return the loop of one axis, all others closed."""
        others = np.arange(len(self.C)) != axis
        A = self.A - self.B[:, others] @ self.C[others]
        return LinearLoop(A, self.B[:, axis], self.C[axis], self.dt, self.conserved)


Matrices = TypeVar("Matrices", LinearLoop, LinearAxes)


def without_conserved(loop: Matrices) -> Matrices:
    """Return the loop without the combinations of states that never change.

    Hysteresis linearises to ``y(k) - y(k-1) = slope (x(k) - x(k-1))``: it remembers
    ``y - slope x`` for ever, a pole at z = 1 that no input moves. The same holds for
    the frozen bias of a start at rest, or an integral with zero gain. They say where
    the operating point is, not whether it is stable, and are exactly the left
    null space of [A - I, B]. Other modes stay, hidden ones too.
    """
    A, B, C, dt, _ = loop
    rows = np.hstack([A - np.eye(len(A)), B.reshape(len(A), -1)])
    length = np.linalg.norm(rows, axis=1)
    length[length == 0.0] = 1.0
    left, singular, _ = np.linalg.svd(rows / length[:, None], full_matrices=True)
    count = len(A) - int(np.sum(singular > TOLERANCE))
    if count == 0:
        return loop
    kept_sum = left[:, len(A) - count :] / length[:, None]  # w' x is conserved
    # Solve w' x = 0 for the states with the largest share in it.
    order = linalg.qr(kept_sum.T, mode="economic", pivoting=True)[-1]
    out, stay = np.sort(order[:count]), np.sort(order[count:])
    back = -np.linalg.solve(kept_sum[out].T, kept_sum[stay].T)
    return type(loop)(
        A[np.ix_(stay, stay)] + A[np.ix_(stay, out)] @ back,
        B[stay],
        C[..., stay] + C[..., out] @ back,
        dt,
        count,
    )


def balanced(loop: Matrices) -> Matrices:
    """Return the same loop with its states in units that suit each other."""
    if len(loop.A) == 0:
        return loop
    A, change = linalg.matrix_balance(loop.A, permute=False)
    scale = np.diagonal(change)
    return loop._replace(A=A, B=(loop.B.T / scale).T, C=loop.C * scale)
