"""Least squares within a box of few sides, exact and without iteration.

The solution is the least-squares solution on one of the 3^n faces of the box, the whole
of it and its corners among them, and on each of them it is a fixed matrix times what is
wanted. All are tried; the best of those that keep within the box is the answer.
"""

import itertools
from functools import lru_cache
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

MOST_ACTUATORS = 6
"""The faces number 81 with 4 actuators, 729 with 6."""

TOLERANCE = 1e-13
"""What counts as equal, relative to the commands and poses at hand."""

Numbers = tuple[float, ...]
Bounds = tuple[Float[Array, " actuators"], Float[Array, " actuators"]]
OnFaces = Float[Array, "actuators faces"]


class Problem(NamedTuple):
    """``geometry`` [axes, actuators], in rows, and the weights of both sides."""

    geometry: tuple[Numbers, ...]
    axis_weights: Numbers
    weights: Numbers


def clipped(
    problem: Problem, bounds: Bounds, pose: Float[Array, " axes"]
) -> Float[Array, " actuators"]:
    """Return the pseudo-inverse of the actuators that are not locked, cut off."""
    lower, upper = bounds
    locked = lower == upper
    fixed = jnp.where(locked, lower, 0.0)
    free = jnp.where(locked, 0, 2 ** np.arange(lower.size))
    inverse = jnp.array(_inverses(problem))[jnp.sum(free)]
    commands = fixed + inverse @ (pose - jnp.array(problem.geometry) @ fixed)
    # Not clip: on a bound its slope is a half, and stages rest on their bounds.
    commands = jnp.where(commands < lower, lower, commands)
    return jnp.where(commands > upper, upper, commands)


def within(
    problem: Problem, bounds: Bounds, pose: Float[Array, " axes"]
) -> Float[Array, " actuators"]:
    """Return the commands within bounds with the least error, then the least effort."""
    sides, inverses = (jnp.array(table) for table in _faces(problem))
    # Which face it is has no slope; the commands on it do.
    still = jax.lax.stop_gradient((bounds, pose))
    each = _on(sides, inverses, problem, *still)
    face = _best(each, sides == 0, problem, *still)
    one = (sides[:, face, None], inverses[:, :, face, None])
    commands = _on(*one, problem, bounds, pose)[:, 0]
    # Off by rounding, if at all; on a bound the slope of a clip would be a half.
    rounding = jnp.clip(commands, *bounds) - commands
    return commands + jax.lax.stop_gradient(rounding)


def _on(
    sides: Int[Array, "actuators faces"],
    inverses: Float[Array, "actuators axes faces"],
    problem: Problem,
    bounds: Bounds,
    pose: Float[Array, " axes"],
) -> OnFaces:
    """Return the least-squares commands on each face, whether within bounds or not."""
    lower, upper = bounds
    fixed = jnp.where(sides < 0, lower[:, None], 0.0)
    fixed = jnp.where(sides > 0, upper[:, None], fixed)
    left = pose[:, None] - _made(problem, fixed)
    return fixed + jnp.sum(inverses * left, axis=1)


def _made(problem: Problem, commands: OnFaces) -> Float[Array, "axes faces"]:
    # Sums over short axes, faces innermost: a fifth of the time of matrix products.
    return jnp.sum(jnp.array(problem.geometry)[:, :, None] * commands, axis=1)


def _best(
    commands: OnFaces,
    free: Bool[Array, "actuators faces"],
    problem: Problem,
    bounds: Bounds,
    pose: Float[Array, " axes"],
) -> Int[Array, ""]:
    """Return the face with the least error, and among such the least effort."""
    lower, upper = (bound[:, None] for bound in bounds)
    largest = jnp.maximum(*(jnp.abs(bound) for bound in bounds))
    slack = TOLERANCE * (jnp.max(largest) + jnp.max(jnp.abs(commands[:, 0])))
    allowed = (commands >= lower - slack) & (commands <= upper + slack)
    # A locked actuator is free on no face, though one may leave it where it is.
    allowed = jnp.all(allowed & ~(free & (lower == upper)), axis=0)

    made = _made(problem, commands)
    error = jnp.array(problem.axis_weights) @ (pose[:, None] - made) ** 2
    best = jnp.argmin(jnp.where(allowed, error, jnp.inf))
    # The best pose is one, but several faces may make it, some with more effort.
    apart = jnp.max(jnp.abs(made - made[:, best, None]), axis=0)
    reach = jnp.max(jnp.abs(jnp.array(problem.geometry)) @ largest + jnp.abs(pose))
    alike = allowed & (apart <= TOLERANCE * reach)
    effort = jnp.array(problem.weights) @ commands**2
    return jnp.argmin(jnp.where(alike, effort, jnp.inf))


@lru_cache
def _inverses(problem: Problem) -> Float[np.ndarray, "sets actuators axes"]:
    """Return the weighted pseudo-inverse for each set of actuators that are free.

    Actuator i is in set number s if bit i of s is 1; the rows of others are zero.
    """
    by_axis, by_command = np.sqrt(problem.axis_weights), np.sqrt(problem.weights)
    scaled = by_axis[:, None] * np.array(problem.geometry) / by_command
    sets = np.arange(2**by_command.size)[:, None] >> np.arange(by_command.size) & 1
    inverses = np.linalg.pinv(sets[:, None, :] * scaled, rcond=1e-12)
    # Rounding leaves traces in rows that are zero.
    return sets[:, :, None] * inverses / by_command[:, None] * by_axis


@lru_cache
def _faces(
    problem: Problem,
) -> tuple[
    Int[np.ndarray, "actuators faces"], Float[np.ndarray, "actuators axes faces"]
]:
    """Return the faces of the box, the whole of it first, and their inverses.

    A side is 0 where an actuator is free, -1 on its lower bound and 1 on its upper.
    """
    actuators = len(problem.weights)
    sides = np.array(list(itertools.product((0, -1, 1), repeat=actuators)))
    sides = sides[np.argsort(np.count_nonzero(sides, axis=1), kind="stable")]
    sets = (sides == 0) @ (2 ** np.arange(actuators))
    return sides.T, np.moveaxis(_inverses(problem)[sets], 0, -1)


@lru_cache
def null_space(
    geometry: tuple[Numbers, ...],
) -> Float[np.ndarray, "redundancy actuators"]:
    """Return an orthonormal basis of what moves nothing, first entries positive."""
    matrix = np.array(geometry)
    basis = np.linalg.svd(matrix)[2][min(matrix.shape) :]
    first = basis[np.arange(len(basis)), np.argmax(np.abs(basis) > 1e-9, axis=1)]
    return basis * np.sign(first)[:, None]
