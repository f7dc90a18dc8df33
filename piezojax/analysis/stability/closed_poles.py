"""Stability and slowest oscillations of many loops, from poles.

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
    matrices: Float[np.ndarray, "*systems n n"],
) -> Complex[np.ndarray, "*systems n"]:
    """Return the poles of systems; 0 for those whose matrix is not finite."""
    finite = np.isfinite(matrices).all((-2, -1), keepdims=True)
    return np.linalg.eigvals(np.where(finite, matrices, 0.0)).astype(complex)


def stable(
    poles: Complex[np.ndarray, "*loops branches n"],
) -> Bool[np.ndarray, "*loops"]:
    """Return whether each loop is stable on every branch.

    A branch whose matrix is not finite counts as stable: nothing is known about it.
    """
    return np.all(np.abs(poles) <= 1.0 + ROUNDING, axis=(-2, -1))


def slowest_oscillation(
    poles: Complex[np.ndarray, "*systems n"],
) -> Float[np.ndarray, "*systems"]:
    """Return the longest time constant of a decaying oscillation, in samples.

    It is 0 for a system without one.
    """
    size = np.abs(poles)
    counts = (np.abs(np.angle(poles)) > OSCILLATES) & (size < 1.0) & (size > 0.0)
    decay = -np.log(np.where(counts, size, 0.5))
    return np.max(np.where(counts, 1.0 / decay, 0.0), axis=-1, initial=0.0)
