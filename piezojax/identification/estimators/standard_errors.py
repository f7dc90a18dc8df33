"""Standard errors of the parameters of a fit."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ...core.arrays import as_array
from ...core.space import squash, unsquash
from .error_problem import Problem, equations_at
from .output_error import Optimum

UNDETERMINED = 1e-14
"""Relative eigenvalue of J'J, scaled to a unit diagonal, below which a direction is
undetermined: rounding errors are a hundredth of it."""


@eqx.filter_jit
def _parameters(problem: Problem, free: Array) -> tuple[Array, Array]:
    """Return the parameters at ``free``, and their derivatives."""

    def values(free: Array) -> Array:
        return problem.space.from_unit(squash(free))

    return jax.jvp(values, (free,), (jnp.ones_like(free),))


def values_and_errors(optimum: Optimum) -> tuple[np.ndarray, list[float | None]]:
    """Return the parameters of the best point and their standard errors.

    The errors are those of Gauss-Newton: the covariance is s^2 (J'J)^-1, for white
    residuals. A prior that is not switched off adds its own information, that of its
    deviations. A parameter in a direction that neither the record nor a prior
    determines has the error None.
    """
    problem, free = optimum.problem, unsquash(as_array(optimum.units))
    prior, loss = problem.prior, optimum.losses[0]
    if prior is not None and not float(prior.scale):
        prior = None
    if prior is not None:
        # Its rows have the scale of the errors of the model, not of white noise.
        off = prior.weights * (optimum.units[0] - prior.known)
        loss -= float(np.sum(np.asarray(off) ** 2))
        problem = problem.with_prior(prior._replace(scale=0.0))
    best = as_array(np.asarray(free)[0])
    values, slopes = map(np.asarray, _parameters(problem, best))
    if optimum.weights:
        curvature = optimum.weights.normal_equations(best[None])[2][0]
    else:
        # All points, because the program of the descents is compiled for their number.
        curvature = np.asarray(equations_at(problem, free)[2])[0]
    slopes = np.where(slopes == 0.0, 1.0, slopes)
    kinds = 2 if problem.whitening.size and float(problem.plain) else 1
    counted = kinds * int(np.sum(np.asarray(problem.weights) > 0))
    variance = loss / max(counted - values.size, 1)
    if prior is not None:
        _, tilt = jax.jvp(squash, (best,), (jnp.ones_like(best),))
        own = np.asarray(tilt / prior.deviations) ** 2
        curvature = curvature + variance * np.diag(own)
    return values, standard_errors(curvature / np.outer(slopes, slopes), variance)


def standard_errors(curvature: np.ndarray, variance: float) -> list[float | None]:
    """Return the square roots of the diagonal of ``variance`` (J'J)^-1.

    ``curvature`` is J'J. None for a parameter in a direction that it does not
    determine.
    """
    scale = np.sqrt(np.diag(curvature))
    scale = np.where(scale > 0.0, scale, 1.0)
    strength, directions = np.linalg.eigh(curvature / np.outer(scale, scale))
    weak = strength < UNDETERMINED * strength[-1]
    known = np.sum(directions[:, weak] ** 2, axis=1) < 1e-6
    inverse = np.where(weak, 0.0, 1.0 / np.where(weak, 1.0, strength))
    spread = np.sqrt(variance * (directions**2 @ inverse)) / scale
    return [float(d) if k else None for d, k in zip(spread, known, strict=True)]
