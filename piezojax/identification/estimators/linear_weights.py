"""Weights in which the output of a model is linear: nonnegative least squares."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ...core.arrays import as_array
from ...core.paths import get, replace
from ...core.recipe import LinearWeights
from ...core.space import squash
from ...core.system import Series
from ...engines import run_outputs
from ...solve.problem import linearised
from .approach import path_after, recorded
from .error_problem import Problem
from .linear_start import Start

ROWS = 20_000
"""Number of errors that are used: neighbouring ones of a long record tell the same."""

WIDTH = 60
"""Number of weights whose effects are computed together."""

LIGHT = 1e-3
"""Scale of a prior that hardly raises the errors, times that of the first ones."""

SCALES = np.geomspace(1e-2, 1e2, 81)
"""Scales of the prior among which one is chosen, times that of the errors."""


class WeightsFit(NamedTuple):
    """A problem whose weights are fitted, and again at every other point of the box.

    The changes of the residuals by each weight, [rows, k], are ``basis`` [rows, k], of
    orthonormal columns, times ``factor`` [k, k]. ``smoothing`` [pairs, k] are the
    differences between neighbours times ``scale`` (unit of the output). The weights are
    ``above`` their lower bounds; ``inverse`` is that of the curvature in those that are
    not at them.
    """

    problem: Problem
    linear: LinearWeights
    basis: np.ndarray
    factor: np.ndarray
    above: np.ndarray
    smoothing: np.ndarray = np.zeros((0, 0))
    scale: float = np.inf
    inverse: np.ndarray = np.zeros((0, 0))

    @property
    def freedom(self) -> float:
        """Number of weights that the errors determine, not the prior or the bounds."""
        factor = self.factor[:, self.above > 0.0]
        return float(np.sum(self.inverse * (factor.T @ factor)))

    def normal_equations(
        self, points: Float[Array, "points n"]
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return loss, gradient and curvature with the best weights at every point.

        Weights at their bounds stay there, and the effects of the others are those
        where they were fitted last (variable projection as in Kaufman, BIT 15, 1975,
        49-57). The loss is half the sum of the squares of residuals and differences.
        """
        active = self.above > 0.0
        factor, smoothing = self.factor[:, active], self.smoothing[:, active]
        rough = self.smoothing @ (self.linear.least + self.above)
        found = []
        for free in points:
            slopes, errors = self._linearised(free)
            slope = factor.T @ (self.basis.T @ errors) + smoothing.T @ rough
            change = -self.inverse @ slope
            left = errors + self.basis @ (factor @ change)
            bent = rough + smoothing @ change
            crossed = factor.T @ (self.basis.T @ slopes)
            found.append(
                (
                    0.5 * (left @ left + bent @ bent),
                    slopes.T @ left,
                    slopes.T @ slopes - crossed.T @ self.inverse @ crossed,
                )
            )
        loss, gradient, curvature = zip(*found, strict=True)
        return np.stack(loss), np.stack(gradient), np.stack(curvature)

    def best_at(self, free: Float[Array, " n"], scale: float) -> "WeightsFit":
        """Return the fit with the best weights at ``free`` for a ``scale``."""
        smoothing = scale * self.linear.differences
        least, (_, errors) = self.linear.least, self._linearised(free)
        wanted = self.factor @ self.above - self.basis.T @ errors
        rows = np.concatenate([self.factor, smoothing])
        above = nonnegative(rows, np.append(wanted, -smoothing @ least))
        weights = np.array(get(self.problem.system, self.linear.path))
        weights[self.linear.places] = least + above
        problem = _replaced(self.problem, self.linear.path, as_array(weights))
        active = rows[:, above > 0.0]
        return self._replace(
            problem=problem,
            above=above,
            smoothing=smoothing,
            scale=scale,
            inverse=np.linalg.pinv(active.T @ active, hermitian=True),
        )

    def likeliest_scale(self, free: Float[Array, " n"]) -> float:
        """Return the likeliest scale of the prior.

        The errors must be those under a light prior: a heavy one adds to them, and they
        would make it heavier.
        """
        rms, independent = self.problem.spread(squash(free))
        _, errors = self._linearised(free)
        seen = self.basis.T @ errors
        # One more row stands for all that no weight changes.
        unseen = np.sqrt(max(0.0, errors @ errors - seen @ seen))
        return likeliest_scale(
            np.append(self.factor, np.zeros((1, self.above.size)), axis=0),
            self.linear.differences,
            np.append(self.factor @ (self.linear.least + self.above) - seen, unseen),
            rms / np.sqrt(independent) * SCALES,
            independent,
        )

    def _linearised(self, free: Array) -> tuple[np.ndarray, np.ndarray]:
        found = _linearised(self.problem, free, _every(self.problem))
        slopes, errors = map(np.asarray, found)
        return slopes, errors


def likeliest_scale(
    effects: Float[np.ndarray, "rows k"],
    differences: Float[np.ndarray, "pairs k"],
    wanted: Float[np.ndarray, " rows"],
    scales: Float[np.ndarray, " scales"],
    independent: float,
) -> float:
    """Return the one of ``scales`` with the largest marginal likelihood.

    The best weights minimise the sum of the squares of ``effects @ weights - wanted``
    and of ``scale * differences @ weights``. Errors and differences are normal with
    unknown variances, and ``independent`` errors tell as much as all rows; bounds are
    ignored (MacKay, Neural Computation 4, 1992, 415-447).
    """
    import scipy.linalg  # takes long to import

    # In this basis the squares of differences and effects are both diagonal.
    heaviest = float(np.max(scales)) ** 2
    rough = differences.T @ differences
    rank = np.linalg.matrix_rank(rough, hermitian=True)
    both = effects.T @ effects + heaviest * rough
    both += np.finfo(float).eps * np.trace(both) * np.eye(len(both))
    share, basis = scipy.linalg.eigh(rough, both)
    share = np.clip(share, 0.0, 1.0 / heaviest)
    curvature = 1.0 - share * (heaviest - scales[:, None] ** 2)
    slope = basis.T @ (effects.T @ wanted)
    left = wanted @ wanted - np.sum(slope**2 / curvature, axis=1)
    unlikely = (
        independent * np.log(left)
        - 2.0 * rank * np.log(scales)
        + np.sum(np.log(curvature), axis=1)
    )
    return float(scales[np.argmin(unlikely)])


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
    problem: Problem, linear: LinearWeights, free: Float[Array, " n"]
) -> WeightsFit:
    """Return ``problem`` with the weights that fit best at ``free``.

    The errors do not determine each weight. Neighbours are alike: their differences
    have a normal prior, with the likeliest scale against the errors.
    """
    effects = np.asarray(_effects(problem, linear, free, _every(problem))).T
    basis, factor = np.linalg.qr(effects)
    above = np.array(get(problem.system, linear.path))[linear.places] - linear.least
    rms, independent = problem.spread(squash(free))
    first = WeightsFit(problem, linear, basis, factor, above)
    light = first.best_at(free, LIGHT * rms / np.sqrt(independent))
    return light.best_at(free, light.likeliest_scale(free))


def _every(problem: Problem) -> int:
    return -(-problem.outputs.size // ROWS)


def _replaced(problem: Problem, path: str, weights: Any) -> Problem:
    changed = replace(problem.system, {path: weights})
    return eqx.tree_at(lambda p: p.system, problem, changed)


@eqx.filter_jit
def _effects(problem: Problem, linear: LinearWeights, free: Array, every: int) -> Array:
    """Return the change [k, rows] of the residuals by each weight."""
    unit = squash(free)
    system = problem.space.put(problem.system, unit)
    assert isinstance(system, Series)
    assert problem.starts is not None
    at = system.names.index(linear.path.rpartition(".")[0])
    first, own, last = system.parts[:at], system.parts[at], system.parts[at + 1 :]

    def moved(input: Array, start: Start) -> Array:
        path = path_after(input, start.levels)
        return run_outputs(Series(first), path, Series(first).init(path[0]))

    def behind(motion: Array) -> Array:
        return recorded(run_outputs(Series(last), motion, Series(last).init(motion[0])))

    motions = jax.vmap(moved)(problem.inputs, problem.starts)
    # The parts behind are linear, with an offset.
    passed = jax.linearize(behind, jnp.zeros_like(motions[0]))[1]
    effect = problem.effect_of(unit, every)

    def some(places: list[Array]) -> Array:
        added = jax.vmap(lambda motion: linear.responses(own, motion, places))(motions)
        return jax.vmap(lambda each: effect(jax.vmap(passed)(each)), 1)(added)

    count = len(linear.least)
    batches = np.minimum(np.arange(-(-count // WIDTH) * WIDTH), count - 1)
    batches = batches.reshape(-1, WIDTH)
    found = jax.lax.map(some, [axis[batches] for axis in linear.places])
    return found.reshape(-1, found.shape[-1])[:count]


@eqx.filter_jit
def _linearised(problem: Problem, free: Array, every: int) -> tuple[Array, Array]:
    """Return the Jacobian [rows, n] and the residuals [rows]."""
    return linearised(lambda at: problem.residuals(squash(at), every))(free)
