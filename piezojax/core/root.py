"""Roots by Newton's method."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

STEPS, CHANGE = 64, 1e-12
"""Largest number of steps, and the change, relative to 1 plus the size of the root, up
to which they end."""


def root(
    function: Callable[[Any, Array], Array], arguments: Any, start: Float[Array, " n"]
) -> Float[Array, " n"]:
    """Return the x [n] at which ``function(arguments, x)`` [n] is zero.

    The iteration begins at ``start``. If it does not converge, the last iterate is
    returned, which may not be finite. The root has derivatives with respect to
    ``arguments``, a pytree of arrays; ``function`` must use no other traced values.
    """

    @jax.jit
    def improved(arguments: Any, x: Array) -> Array:
        def missed(x: Array) -> Array:
            return function(arguments, x)

        if x.size == 1:  # faster to compile
            value, slope = jax.jvp(missed, (x,), (jnp.ones_like(x),))
            return x - value / slope
        return x - jnp.linalg.solve(jax.jacfwd(missed)(x), missed(x))

    def advance(carry: tuple) -> tuple:
        count, x, _ = carry
        better = improved(fixed, x)
        moves = jnp.any(jnp.abs(better - x) > CHANGE * (1.0 + jnp.abs(x)))
        return count + 1, better, moves

    fixed, start = jax.lax.stop_gradient((arguments, start))
    goes_on = lambda carry: (carry[0] < STEPS) & carry[2]  # noqa: E731
    found = jax.lax.while_loop(goes_on, advance, (0, start, jnp.array(True)))[1]
    # One more step, outside the loop, gives the root its derivative.
    return improved(arguments, found)
