"""Square linear models in observability form: an ARMA model with matrices."""

import jax
import jax.numpy as jnp
import numpy as np

from ..core.axes import (
    Axes,
    Rows,
    as_matrices,
    check_square,
    packed_matrices,
    packed_matrix,
    plus,
    product,
)
from ..core.parameter import parameter, sample_time
from ..core.system import System
from .state_space import StateSpace


class MatrixARMA(System):
    """``y(k+1) = sum_i autoregressive[i] y(k-i) + sum_i moving[i] u(k-i)``.

    Both hold p matrices [q, q], newest first. In (7.5)-(7.6) of the thesis,
    ``autoregressive`` is A_(p-1), ..., A_0 and ``moving`` is B_(p-1), ..., B_0 (the
    last q rows of B_c1, Gamma_1, Gamma_0). A step maps u(k) to y(k+1). Inputs and
    outputs are tuples of q scalars; the state is the contribution of past samples to
    the outputs 1, 2, ... samples ahead. Raises ValueError for different numbers of
    matrices, or matrices that are not [q, q].
    """

    autoregressive: tuple[Rows, ...] = parameter(
        "1", "matrices of past outputs", converter=as_matrices
    )
    moving: tuple[Rows, ...] = parameter(
        "1", "matrices of the inputs", converter=as_matrices
    )
    dt: float = sample_time()

    def __check_init__(self):
        if not self.moving or len(self.autoregressive) != len(self.moving):
            raise ValueError(
                f"{len(self.autoregressive)} autoregressive and {len(self.moving)} "
                "moving matrices; the numbers must be equal and at least 1"
            )
        for name in ("autoregressive", "moving"):
            for index, matrix in enumerate(getattr(self, name)):
                check_square(f"{name}[{index}]", matrix, self.axes)

    @property
    def axes(self) -> int:
        """Number of inputs and of outputs q."""
        return len(self.moving[0])

    def packed(self) -> tuple[jax.Array, jax.Array]:
        """Return ``autoregressive`` and ``moving`` as packed arrays [p, q, q]."""
        return packed_matrices(self.autoregressive), packed_matrices(self.moving)

    def responses(self) -> jax.Array:
        """Return the Markov parameters h_0 = C B, h_1 = C A B, ..., (7.6) [p, q, q]."""
        A, B = self.packed()
        responses: list[jax.Array] = []
        for moved in B:
            for a, h in zip(A, reversed(responses), strict=False):
                moved = moved + a @ h
            responses.append(moved)
        return jnp.stack(responses)

    def dc_gain(self) -> jax.Array:
        """Return outputs over inputs at rest [q, q]."""
        fed_back = packed_matrix(plus(*self.autoregressive))
        fed_forward = packed_matrix(plus(*self.moving))
        return jnp.linalg.solve(jnp.eye(self.axes) - fed_back, fed_forward)

    def init(self, input: Axes) -> tuple[Axes, ...]:
        output = self.dc_gain() @ jnp.stack(input)
        held = tuple(output[i] for i in range(self.axes))
        memory: list[Axes] = []
        for j in reversed(range(len(self.moving))):
            terms = [product(self.autoregressive[j], held), *memory[-1:]]
            if j + 1 < len(self.moving):
                terms.append(product(self.moving[j + 1], input))
            memory.append(plus(*terms))
        return tuple(reversed(memory))

    def step(
        self, state: tuple[Axes, ...], input: Axes
    ) -> tuple[tuple[Axes, ...], Axes]:
        output = plus(state[0], product(self.moving[0], input))
        memory = [
            plus(product(self.autoregressive[j], output), *terms)
            for j, terms in enumerate(self._older(state, input))
        ]
        return tuple(memory), output

    def _older(self, state: tuple[Axes, ...], input: Axes) -> list[list[Axes]]:
        """Return the terms of the new state that do not depend on the new output."""
        kept = zip(state[1:], self.moving[1:], strict=True)
        return [[memory, product(b, input)] for memory, b in kept] + [[]]


def observability_form(model: StateSpace, lags: int | None = None) -> MatrixARMA:
    """Return a square ``model`` with n states and q outputs as a MatrixARMA.

    p is ``lags``, by default the least with p q >= n. F = [C; CA; ...; CA^(p-1)] (7.4)
    gives [A_0 ... A_(p-1)] F = C A^p, and B_(p-1-j) = h_j - sum_i A_(p-i) h_(j-i) for
    the Markov parameters h (7.5). For n = p q the A are those of the thesis, the last
    rows of F A F^-1. Otherwise F has more rows than columns, and the A are the solution
    of least norm. The result is still exact: it has p q - n additional modes that no
    input excites. More lags than needed improve the conditioning of F.

    Raises ValueError for a model that is not square, has D other than zero or is not
    observable in p samples, and for a stable model whose additional modes would lie on
    or outside the unit circle, where rounding would excite them.
    """
    (n, inputs), q = model.B.shape, len(model.C)
    if inputs != q:
        raise ValueError(
            f"the model has {inputs} inputs and {q} outputs; the numbers must be equal"
        )
    if np.any(np.asarray(model.D)):
        raise ValueError("D is not zero; y(k) must not depend on u(k)")
    p = -(-n // q) if lags is None else lags
    if p * q < n:
        raise ValueError(f"lags is {p}; {n} states and {q} outputs need {-(-n // q)}")
    A, C = np.asarray(model.A), np.asarray(model.C)
    F = np.vstack([C @ np.linalg.matrix_power(A, i) for i in range(p)])
    last, _, rank, _ = np.linalg.lstsq(
        F.T, (C @ np.linalg.matrix_power(A, p)).T, rcond=None
    )
    if rank < n:
        raise ValueError(
            f"the model cannot be observed in {p} samples: (7.4) is singular"
        )
    newest_first = [last.T[:, i * q : (i + 1) * q] for i in reversed(range(p))]
    _check_added(model, newest_first)
    h = np.asarray(model.markov(p))
    moving = [
        h[j] - sum((newest_first[i] @ h[j - 1 - i] for i in range(j)), np.zeros((q, q)))
        for j in range(p)
    ]
    return MatrixARMA(as_matrices(newest_first), as_matrices(moving), model.dt)


def _check_added(model: StateSpace, autoregressive: list[np.ndarray]) -> None:
    q = len(autoregressive[0])
    companion = np.eye(q * len(autoregressive), k=-q)
    companion[:q] = np.hstack(autoregressive)
    own, added = np.asarray(model.poles()), np.linalg.eigvals(companion)
    for pole in own:
        added = np.delete(added, np.argmin(np.abs(added - pole)))
    radius = np.abs(added).max(initial=0.0)
    if np.abs(own).max() < 1.0 <= radius:
        raise ValueError(
            f"a mode added to fill {len(autoregressive)} lags has radius {radius:.6g}; "
            "it must be below 1: reduce the model, or give other lags"
        )
