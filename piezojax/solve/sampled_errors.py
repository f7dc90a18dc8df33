"""Gauss-Newton model of a problem from a sample of its errors."""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .gauss_newton import Trials
from .local_model import LocalModel, Slack
from .problem import FAILED_LOSS, Errors

SAMPLES = 20_000
"""Number of errors, over all runs, from which the curvature is computed."""

LEAST_SPACING = 5
"""Least distance between two of these errors, in samples."""

_ADDED = np.sqrt(2.0)  # the squared terms of the Lagrangian have the factor 1, not 1/2


class Derivatives(NamedTuple):
    """Loss, ``terms`` of the augmented Lagrangian, and derivatives at a point.

    ``weights`` are those of the errors. ``gradient`` is that of the loss, ``jacobian``
    that of the errors and ``added`` that of the terms.
    """

    loss: Float[Array, ""]
    terms: Float[Array, " constraints"]
    weights: Float[Array, " runs"]
    gradient: Float[Array, " n"]
    jacobian: Float[Array, "n runs samples"]
    added: Float[Array, "n constraints"]


@partial(jax.jit, static_argnums=2)
def derivatives_at(problem, unit: Float[Array, " n"], every: int) -> Derivatives:
    """Return value and derivatives at ``unit``, all in one forward pass."""

    def values(unit):
        point = problem.errors(unit, every)
        return (point.loss, point.errors, point.added), point.weights

    (loss, _, terms), (gradient, jacobian, added), weights = jax.vmap(
        lambda direction: jax.jvp(values, (unit,), (direction,), has_aux=True),
        out_axes=(None, 0, None),
    )(jnp.eye(unit.shape[0]))
    return Derivatives(loss, terms, weights, gradient, jacobian, added)


def local_model(unit: np.ndarray, here: Derivatives) -> LocalModel | None:
    """Return the model of the weighted errors at ``unit``, or None if not finite."""
    slopes, weights = np.asarray(here.jacobian), np.asarray(here.weights)
    unknowns, _, samples = slopes.shape
    scale = np.sqrt(np.maximum(weights, 0.0) / samples)[:, None]
    errors = (slopes * scale).reshape(unknowns, -1)
    terms, added = _ADDED * np.asarray(here.terms), _ADDED * np.asarray(here.added)
    slack = ~(terms > 0.0)
    met = added[:, ~slack]
    # What has slack may have no derivative, such as a margin that nothing limits.
    added = np.where(slack & ~np.isfinite(added).all(axis=0), 0.0, added)
    model = LocalModel(
        unit,
        np.asarray(here.gradient),
        errors @ errors.T + met @ met.T,
        jacobian=np.concatenate([errors, added], axis=1),
        weights=np.append(np.repeat(scale, samples), np.full(terms.size, _ADDED)),
        slack=Slack(
            terms[slack], added[:, slack], errors.shape[1] + np.flatnonzero(slack)
        ),
    )
    return model if model.finite and here.loss < FAILED_LOSS else None


@partial(jax.jit, static_argnums=2)
def errors_at(problem, units: Float[Array, "points n"], every: int) -> Errors:
    """Return the Errors of ``problem`` at ``units`` [points, n], without weights."""
    at = lambda unit: problem.errors(unit, every)._replace(weights=None)  # noqa: E731
    return jax.vmap(at)(units)


def trials_of(points: Errors) -> Trials:
    """Return the Trials of points, whose residuals are the errors and added terms."""
    losses, verdicts, errors, added, _ = jax.tree.map(np.asarray, points)
    flat = errors.reshape(len(losses), -1)
    residuals = np.concatenate([flat, np.maximum(added, 0.0)], axis=1)
    return Trials(losses, verdicts, residuals)


def spacing(runs: int, counted: int) -> int:
    """Return the distance between sampled errors, a prime number to avoid aliasing."""
    most = max(2, counted // LEAST_SPACING)
    wanted = min(max(LEAST_SPACING, -(-runs * counted // SAMPLES)), most)
    return next(
        n for n in range(wanted, 2 * wanted + 1) if all(n % d for d in range(2, n))
    )
