"""Worst margins of a loop under the model error bound of its plant.

The stage is ``G (1 + D)``, where G is the model and ``|D| <= l`` at every frequency.
Then S becomes ``S / (1 + D T)`` with ``T = 1 - S``, and its magnitude is at most
``|S| / (1 - l |T|)``. The loop can be unstable where ``l |T| >= 1`` (Skogestad and
Postlethwaite, Multivariable Feedback Control, 2nd ed., 7.5).
"""

import jax.numpy as jnp
from jaxtyping import Array, Complex, Float

from .sampled_margins import UNLIMITED_DELAY

NEAR_ONE = 0.99
"""``l |T|`` above which the worst sensitivity continues along its tangent."""

_SMALLEST = 1e-12


def worst_sensitivity(
    sensitivity: Complex[Array, "*batch lines"], bound: Float[Array, " lines"]
) -> Float[Array, "*batch lines"]:
    """Return the largest ``|S|`` of a loop under a relative error of its plant.

    It is ``|S| / (1 - l |T|)``, which some error attains. From ``l |T| = NEAR_ONE`` it
    continues along the tangent of ``1 / (1 - x)``: the loop can be unstable there, and
    the value keeps growing, finite and with a slope. Differentiable.
    """
    share = bound * jnp.abs(1.0 - sensitivity)
    inside = 1.0 / (1.0 - jnp.minimum(share, NEAR_ONE))
    steep = 1.0 / (1.0 - NEAR_ONE) ** 2
    beyond = steep * jnp.maximum(share - NEAR_ONE, 0.0)
    # Where the loop can be unstable, a small |S| proves nothing.
    size = jnp.abs(sensitivity)
    size = jnp.where(share > NEAR_ONE, jnp.maximum(size, 1.0), size)
    return size * (inside + beyond)


def worst_delay_margin(
    sensitivity: Complex[Array, "*batch lines"],
    bound: Float[Array, " lines"],
    angle: Float[Array, " lines"],
) -> Float[Array, "*batch lines"]:
    """Return the smallest delay (samples) at which the loop can be unstable, by line.

    ``bound`` is the relative error of the plant, ``angle`` the frequency in rad/sample.
    Let ``rho exp(j phi) = -1/L``. A delay of tau samples makes ``1 + L (1 + D) exp(-j w
    tau) = 0`` for an error ``|D| <= l`` if ``rho exp(j (phi + w tau))`` lies within l
    of 1, which means ``cos(phi + w tau) >= (rho^2 + 1 - l^2) / (2 rho)``. The value is
    0 where the loop can be unstable without delay, and ``UNLIMITED_DELAY`` where no
    delay suffices. Differentiable.
    """
    complementary = 1.0 - sensitivity
    known = (jnp.abs(sensitivity) > _SMALLEST) & (jnp.abs(complementary) > _SMALLEST)
    # -1/L = -S/T: infinite without a loop gain, 0 with an infinite one.
    S, T = (jnp.where(known, x, _SMALLEST) for x in (sensitivity, complementary))
    start = jnp.angle(-S * jnp.conj(T))
    size, gain = jnp.abs(S), jnp.abs(T)
    cosine = (size**2 + (1.0 - bound**2) * gain**2) / (2.0 * size * gain)
    # Keep off the ends, where the slope of the arc cosine is infinite.
    inside = jnp.abs(cosine) < 1.0 - 1e-9
    half = jnp.arccos(jnp.where(inside, cosine, 0.0))
    half = jnp.where(inside, half, jnp.where(cosine < 0.0, jnp.pi, 0.0))
    unstable = jnp.where(
        known,
        (jnp.abs(start) <= half) & (cosine <= 1.0),
        bound * jnp.abs(complementary) >= 1.0,
    )
    turn = jnp.mod(-half - start, 2.0 * jnp.pi)
    moving = (angle > 0.0) & known & (cosine < 1.0)
    delay = turn / jnp.where(moving, angle, 1.0)
    return jnp.where(unstable, 0.0, jnp.where(moving, delay, UNLIMITED_DELAY))
