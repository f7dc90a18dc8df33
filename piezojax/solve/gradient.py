"""Replace non-finite gradients; return them together with the value."""

import jax
import jax.numpy as jnp
from jaxtyping import Array

from ..engines import reverse_mode
from .problem import FAILED_LOSS


@jax.custom_vjp
def _guarded(value: Array, gradient: Array, unit: Array) -> Array:
    return value


def _guarded_forward(value, gradient, unit):
    return value, gradient


def _guarded_backward(gradient, cotangent):
    return jnp.zeros_like(cotangent), jnp.zeros_like(gradient), cotangent * gradient


_guarded.defvjp(_guarded_forward, _guarded_backward)


def with_finite_gradient(loss, *, forward: bool):
    """Return ``loss``, a function of a vector, with a finite gradient.

    The gradient is computed together with the value. That of a diverged run is NaN and
    would spoil the memory of the optimiser; it is replaced by zero. ``forward`` selects
    forward mode, which is faster for few parameters and few lanes; otherwise the
    gradient comes from reverse mode.
    """

    def guarded(unit):
        fixed = jax.lax.stop_gradient(unit)
        if forward:
            # jax.linearize would store intermediate values of every sample.
            value, gradient = jax.vmap(
                lambda direction: jax.jvp(loss, (fixed,), (direction,)),
                out_axes=(None, 0),
            )(jnp.eye(fixed.shape[0]))
        else:
            with reverse_mode(True):
                value, gradient = jax.value_and_grad(loss)(fixed)
        usable = jnp.all(jnp.isfinite(gradient)) & (value < FAILED_LOSS)
        gradient = jnp.where(usable, jnp.nan_to_num(gradient), 0.0)
        return _guarded(value, gradient, unit)

    return guarded
