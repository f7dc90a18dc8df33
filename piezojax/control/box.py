"""Box-constrained least squares with few unknowns, exact and without iteration.

A box with n unknowns has 3^n faces, which include its interior and its corners. On each
face the least-squares solution is linear in the wanted pose and the bounds, with fixed
matrices. The solution of the constrained problem is the best of those within the box.
"""

import itertools
from functools import lru_cache
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

MOST_ACTUATORS = 6
"""Largest number of actuators: 4 have 81 faces, 6 have 729."""

TOLERANCE = 1e-13
"""Tolerance of equality, relative to the size of commands and poses."""

Numbers = tuple[float, ...]
Bounds = tuple[Float[Array, " actuators"], Float[Array, " actuators"]]
OnFaces = Float[Array, "actuators faces"]


class Problem(NamedTuple):
    """``geometry`` [axes, actuators] as rows, weights of axes and of commands."""

    geometry: tuple[Numbers, ...]
    axis_weights: Numbers
    weights: Numbers


def clipped_commands(
    problem: Problem, bounds: Bounds, pose: Float[Array, " axes"]
) -> Float[Array, " actuators"]:
    """Return the pseudo-inverse commands, clipped, with locked actuators held."""
    lower, upper = bounds
    locked = lower == upper
    fixed = jnp.where(locked, lower, 0.0)
    free = jnp.where(locked, 0, 2 ** np.arange(lower.size))
    inverse = jnp.array(_inverses(problem))[jnp.sum(free)]
    commands = fixed + inverse @ (pose - jnp.array(problem.geometry) @ fixed)
    # Stages rest on their bounds, where jnp.clip has the derivative 1/2.
    commands = jnp.where(commands < lower, lower, commands)
    return jnp.where(commands > upper, upper, commands)


def bounded_commands(
    problem: Problem, bounds: Bounds, pose: Float[Array, " axes"]
) -> Float[Array, " actuators"]:
    """Return the commands within bounds with the least error, then the least effort."""
    sides, inverses = (jnp.array(table) for table in _faces(problem))
    # The index of the face has no derivative; the commands on the face have one.
    still = jax.lax.stop_gradient((bounds, pose))
    candidates = _face_commands(sides, inverses, problem, *still)
    face = _best(candidates, sides == 0, problem, *still)
    chosen = (sides[:, face, None], inverses[:, :, face, None])
    commands = _face_commands(*chosen, problem, bounds, pose)[:, 0]
    # Rounding may exceed a bound. A clip there would have the derivative 1/2.
    rounding = jnp.clip(commands, *bounds) - commands
    return commands + jax.lax.stop_gradient(rounding)


def _face_commands(
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
    remaining = pose[:, None] - _poses(problem, fixed)
    return fixed + jnp.sum(inverses * remaining, axis=1)


def _poses(problem: Problem, commands: OnFaces) -> Float[Array, "axes faces"]:
    # Sums over the short axes take a fifth of the time of matrix products.
    return jnp.sum(jnp.array(problem.geometry)[:, :, None] * commands, axis=1)


def _best(
    commands: OnFaces,
    free: Bool[Array, "actuators faces"],
    problem: Problem,
    bounds: Bounds,
    pose: Float[Array, " axes"],
) -> Int[Array, ""]:
    """Return the index of the face with the least error, then the least effort."""
    lower, upper = (bound[:, None] for bound in bounds)
    largest = jnp.maximum(*(jnp.abs(bound) for bound in bounds))
    slack = TOLERANCE * (jnp.max(largest) + jnp.max(jnp.abs(commands[:, 0])))
    allowed = (commands >= lower - slack) & (commands <= upper + slack)
    # A face on which a locked actuator is free is excluded.
    allowed = jnp.all(allowed & ~(free & (lower == upper)), axis=0)

    poses = _poses(problem, commands)
    error = jnp.array(problem.axis_weights) @ (pose[:, None] - poses) ** 2
    best = jnp.argmin(jnp.where(allowed, error, jnp.inf))
    # The best pose is unique, but several faces reach it with different effort.
    distance = jnp.max(jnp.abs(poses - poses[:, best, None]), axis=0)
    reach = jnp.max(jnp.abs(jnp.array(problem.geometry)) @ largest + jnp.abs(pose))
    equal = allowed & (distance <= TOLERANCE * reach)
    effort = jnp.array(problem.weights) @ commands**2
    return jnp.argmin(jnp.where(equal, effort, jnp.inf))


@lru_cache
def _inverses(problem: Problem) -> Float[np.ndarray, "sets actuators axes"]:
    """Return the weighted pseudo-inverse for each set of free actuators.

    Actuator i is in set number s if bit i of s is 1; the rows of the other actuators
    are zero.
    """
    by_axis, by_command = np.sqrt(problem.axis_weights), np.sqrt(problem.weights)
    scaled = by_axis[:, None] * np.array(problem.geometry) / by_command
    sets = np.arange(2**by_command.size)[:, None] >> np.arange(by_command.size) & 1
    inverses = np.linalg.pinv(sets[:, None, :] * scaled, rcond=1e-12)
    # Rounding leaves small numbers in the rows of locked actuators.
    return sets[:, :, None] * inverses / by_command[:, None] * by_axis


@lru_cache
def _faces(
    problem: Problem,
) -> tuple[
    Int[np.ndarray, "actuators faces"], Float[np.ndarray, "actuators axes faces"]
]:
    """Return the faces of the box, its interior first, and their inverses.

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
    """Return an orthonormal basis of the null space.

    The first nonzero entry of each vector is positive.
    """
    matrix = np.array(geometry)
    basis = np.linalg.svd(matrix)[2][min(matrix.shape) :]
    first = basis[np.arange(len(basis)), np.argmax(np.abs(basis) > 1e-9, axis=1)]
    return basis * np.sign(first)[:, None]
