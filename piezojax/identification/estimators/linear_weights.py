"""Weights in which the output of a model is linear: nonnegative least squares."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Float

from ...core.arrays import as_array
from ...core.paths import get, replace
from ...core.recipe import LinearWeights
from ...core.space import squash
from ...solve.multi_start import in_batches
from ...solve.problem import linearised
from .error_problem import Problem

ROWS = 20_000
"""Number of errors that are used: neighbouring ones of a long record tell the same."""

WIDTH = 60
"""Number of weights whose effects are computed together."""

ROUNDS = 2
"""Number of solutions, each as smooth as the errors of the one before demand."""


class WeightsFit(NamedTuple):
    """A problem whose weights are fitted, and again at every other point of the box.

    ``effects`` [rows, k] are the changes of the residuals by each weight, and
    ``smoothing`` [pairs, k] the differences between neighbours times ``scale`` (unit of
    the output). The weights are ``above`` their lower bounds.
    """

    problem: Problem
    linear: LinearWeights
    effects: np.ndarray
    smoothing: np.ndarray
    above: np.ndarray
    scale: float

    def normal_equations(
        self, points: Float[Array, "points n"]
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return loss, gradient and curvature with the best weights at every point.

        Weights at their bounds stay there, and the effects of the others are those
        where they were fitted last (variable projection as in Kaufman, BIT 15, 1975,
        49-57). The loss is half the sum of the squares of residuals and differences.
        """
        active = self.above > 0.0
        effects, smoothing = self.effects[:, active], self.smoothing[:, active]
        inverse = np.linalg.pinv(
            effects.T @ effects + smoothing.T @ smoothing, hermitian=True
        )
        rough = self.smoothing @ (self.linear.least + self.above)
        found = []
        for free in points:
            slopes, errors = self._linearised(free)
            change = -inverse @ (effects.T @ errors + smoothing.T @ rough)
            left, bent = errors + effects @ change, rough + smoothing @ change
            crossed = effects.T @ slopes
            found.append(
                (
                    0.5 * (left @ left + bent @ bent),
                    slopes.T @ left,
                    slopes.T @ slopes - crossed.T @ inverse @ crossed,
                )
            )
        loss, gradient, curvature = zip(*found, strict=True)
        return np.stack(loss), np.stack(gradient), np.stack(curvature)

    def best_at(self, free: Float[Array, " n"], scale: float) -> "WeightsFit":
        """Return the fit with the best weights at ``free`` for a ``scale``."""
        smoothing = scale * self.linear.differences
        least, (_, errors) = self.linear.least, self._linearised(free)
        rows = np.concatenate([self.effects, smoothing])
        right = np.append(self.effects @ self.above - errors, -smoothing @ least)
        above = nonnegative(rows, right)
        weights = np.array(get(self.problem.system, self.linear.path))
        weights[self.linear.places] = least + above
        problem = _replaced(self.problem, self.linear.path, as_array(weights))
        return self._replace(
            problem=problem, smoothing=smoothing, above=above, scale=scale
        )

    def _linearised(self, free: Array) -> tuple[np.ndarray, np.ndarray]:
        found = _linearised(self.problem, free, _every(self.problem))
        slopes, errors = map(np.asarray, found)
        return slopes, errors


def nonnegative(
    matrix: Float[np.ndarray, "rows k"], right: Float[np.ndarray, " rows"]
) -> Float[np.ndarray, " k"]:
    """Return the least squares solution of at least 0 for many rows."""
    import scipy.optimize  # takes long to import

    # The triangular factor gives the same solution with fewer rows.
    both = np.column_stack([matrix, right])
    small = np.asarray(np.linalg.qr(both, mode="r"))
    unknowns = matrix.shape[1]
    return scipy.optimize.nnls(small[:, :-1], small[:, -1], maxiter=100 * unknowns)[0]


def with_weights(
    problem: Problem,
    linear: LinearWeights,
    free: Float[Array, " n"],
    scale: float = np.inf,
) -> WeightsFit:
    """Return ``problem`` with the weights that fit best at ``free``.

    The errors do not determine each weight. Neighbours are alike: their differences
    have a normal prior, whose scale against the errors is that of one independent
    sample of these, and at most ``scale``: a prior that is too heavy raises the errors,
    and these must not make it heavier.
    """
    every, count = _every(problem), len(linear.least)
    first = np.array(get(problem.system, linear.path))
    changes = np.zeros((count, *first.shape))
    changes[np.arange(count), *linear.places] = 1.0
    effects = in_batches(
        lambda some: _effects(problem, linear.path, free, some, every), changes, WIDTH
    ).T
    above = first[linear.places] - linear.least
    fit = WeightsFit(problem, linear, effects, linear.differences, above, scale)
    for _ in range(ROUNDS):
        rms, independent = fit.problem.spread(squash(free))
        fit = fit.best_at(free, min(fit.scale, rms / np.sqrt(independent)))
    return fit


def _every(problem: Problem) -> int:
    return -(-problem.outputs.size // ROWS)


def _replaced(problem: Problem, path: str, weights: Any) -> Problem:
    changed = replace(problem.system, {path: weights})
    return eqx.tree_at(lambda p: p.system, problem, changed)


@eqx.filter_jit
def _effects(
    problem: Problem, path: str, free: Array, changes: Array, every: int
) -> Array:
    """Return the change [changes, rows] of the residuals for each of ``changes``."""

    def residuals(weights: Array) -> Array:
        return _replaced(problem, path, weights).residuals(squash(free), every)

    weights = get(problem.system, path)
    return jax.vmap(lambda d: jax.jvp(residuals, (weights,), (d,))[1])(changes)


@eqx.filter_jit
def _linearised(problem: Problem, free: Array, every: int) -> tuple[Array, Array]:
    """Return the Jacobian [rows, n] and the residuals [rows]."""
    return linearised(lambda at: problem.residuals(squash(at), every))(free)
