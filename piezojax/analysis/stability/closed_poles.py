"""Stability of many loops, from the poles of their closed loops.

NumPy computes the poles, because LAPACK calls of XLA may deadlock on a CPU.
"""

import dataclasses

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Complex, Float

from ...core.feedback import Feedback
from .broken_loop import open_loop
from .operating_point import BRANCHES, OperatingPoint

ROUNDING = 1e-6
"""Distance from 1 within which the modulus of a pole counts as 1: the poles of a
hysteresis lie at 1, up to rounding, and are stable."""

OSCILLATES = 1e-4
"""Angle of a pole, rad per sample, above which it belongs to an oscillation."""


def closed_matrices(
    loop: Feedback, point: OperatingPoint
) -> Float[Array, "branches n n"]:
    """Return the state matrix of the loop, closed and linearised, on every branch."""
    models = [
        open_loop(loop, dataclasses.replace(point, branch=name)) for name in BRANCHES
    ]
    return jnp.stack([model.A - model.B @ model.C for model in models])


def poles_of(
    closed: Float[np.ndarray, "*loops branches n n"],
) -> Complex[np.ndarray, "*loops branches n"]:
    """Return the poles of each loop on every branch; 0 where a matrix is not finite."""
    finite = np.isfinite(closed).all((-2, -1), keepdims=True)
    return np.linalg.eigvals(np.where(finite, closed, 0.0)).astype(complex)


def stable(
    poles: Complex[np.ndarray, "*loops branches n"],
) -> Bool[np.ndarray, "*loops"]:
    """Return whether each loop is stable on every branch.

    A branch whose matrix is not finite counts as stable: nothing is known about it.
    """
    return np.all(np.abs(poles) <= 1.0 + ROUNDING, axis=(-2, -1))


def slowest_oscillation(
    poles: Complex[np.ndarray, "*loops branches n"],
) -> Float[np.ndarray, "*loops"]:
    """Return the longest time constant of a decaying oscillation, in samples.

    It is 0 for a loop without one.
    """
    size = np.abs(poles)
    counts = (np.abs(np.angle(poles)) > OSCILLATES) & (size < 1.0) & (size > 0.0)
    decay = -np.log(np.where(counts, size, 0.5))
    return np.max(np.where(counts, 1.0 / decay, 0.0), axis=(-2, -1))
