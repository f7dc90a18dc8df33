"""Differentiable solution of discrete Riccati equations by doubling."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

DOUBLINGS = 20
"""Doublings of the iteration, which reach 2^20 samples."""


def riccati(
    A: Float[Array, "n n"], G: Float[Array, "n n"], H: Float[Array, "n n"]
) -> tuple[Float[Array, "n n"], Float[Array, ""]]:
    """Return the stabilising solution of X = H + A' X (I + G X)^-1 A, and a residual.

    ``G`` = B R^-1 B' and ``H`` are symmetric. The residual is 0 if the doubling
    algorithm (Chu, Fan and Lin, 2005) has converged; it is not small if there is no
    stabilising solution.
    """
    identity, size = jnp.eye(len(A)), len(A)

    def double(carry, _):
        A, G, H = carry
        left = jnp.linalg.solve(identity + G @ H, jnp.hstack([A, G]))
        moved, gain = left[:, :size], left[:, size:]
        return (A @ moved, G + A @ gain @ A.T, H + A.T @ H @ moved), None

    (rest, _, X), _ = jax.lax.scan(double, (A, G, H), length=DOUBLINGS)
    # The iterated A tends to zero only if the closed loop is stable.
    return 0.5 * (X + X.T), jnp.max(jnp.abs(jax.lax.stop_gradient(rest)))
