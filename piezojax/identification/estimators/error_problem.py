"""The errors of free runs of several records as a problem of least squares."""

from collections.abc import Callable, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ...core.arrays import as_array
from ...core.space import Space, squash
from ...core.system import System
from ...solve.local_model import normal_equations
from ...solve.problem import linearised
from ..records.record import Record
from .approach import run_after
from .free_runs import from_rest
from .linear_start import Start, most_likely, start_columns
from .noise_model import NOISE_ORDER, independent, whitening_filter
from .structure import Prior, Structure


class Problem(eqx.Module):
    """Fit of one System to several records, padded to one length with zero weights.

    Without ``starts`` every record begins at rest; ``starts`` stacks a start for each
    record. ``plain`` (0 or 1) is the weight of the errors, ``share`` that of the
    errors filtered by ``whitening``, if it has coefficients.
    """

    system: System
    space: Space
    inputs: Float[Array, "records samples *m"]
    outputs: Float[Array, "records samples"]
    weights: Float[Array, "records samples"]
    starts: Start | None
    plain: Float[Array, ""]
    whitening: Float[Array, " taps"]
    share: Float[Array, ""]
    prior: Prior | None = None

    def errors(self, unit: Float[Array, " n"]) -> Float[Array, "records samples"]:
        """Return the errors of the free run of every record."""
        return self._errors_and_starts(unit)[0]

    def _errors_and_starts(self, unit: Array) -> tuple[Array, Array]:
        system = self.space.put(self.system, unit)
        return self._corrected(self._runs(system), system)

    def _runs(self, system: System) -> Array:
        """Return the run [records, samples] of every record, without corrections."""
        if self.starts is None:
            return jax.vmap(lambda input: from_rest(system, input))(self.inputs)

        def run(input: Array, start: Start) -> Array:
            return run_after(system, input, start.levels).reshape(-1)

        return jax.vmap(run)(self.inputs, self.starts)

    def _corrected(self, runs: Array, system: System) -> tuple[Array, Array]:
        """Return the errors, and the prior residuals of the state before each record.

        The columns of the starts are not differentiated: at the most likely amounts the
        gradient of the squares does not depend on them (variable projection as in
        Kaufman, BIT 15, 1975, 49-57).
        """
        if self.starts is None:
            return runs - self.outputs, jnp.zeros((len(self.inputs), 0))
        held = jax.lax.stop_gradient(system)

        def one(run, input, output, weights, start):
            error = _bounded(output - run)[:, None]
            columns = start_columns(held, input, start)
            counted = (weights > 0.0).astype(error.dtype)
            amounts = most_likely(columns, error, counted, start.variance)
            error = jnp.einsum("ksp,k->s", columns, amounts) - error[:, 0]
            spread = jnp.sqrt(start.variance) * jnp.max(weights)
            return error, spread * amounts[1:]

        return jax.vmap(one)(runs, self.inputs, self.outputs, self.weights, self.starts)

    def spread(self, unit: Float[Array, " n"]) -> tuple[float, float]:
        """Return the rms error, and the number of independent errors.

        The errors are mostly those of the model, not white noise.
        """
        errors = np.asarray(_errors(self, unit))
        counted = np.asarray(self.weights) > 0.0
        each = [error[used] for error, used in zip(errors, counted, strict=True)]
        rms = np.sqrt(np.mean(np.concatenate(each) ** 2))
        return float(rms), sum(independent(error) for error in each)

    def residuals(
        self, unit: Float[Array, " n"], every: int = 1
    ) -> Float[Array, " all"]:
        """Return the weighted errors; their sum of squares is the mean square.

        One in ``every`` of them stands for the others.
        """
        return self._counted(*self._errors_and_starts(unit), unit, every)

    def _counted(self, error: Array, unlikely: Array, unit: Array, every: int) -> Array:
        error = _bounded(error)
        weights = every**0.5 * self.weights
        counted = [(self.plain * weights * error)[:, ::every], unlikely]
        if self.whitening.size:
            counted.append((self.share * weights * self.whitened(error))[:, ::every])
        if self.prior is not None:
            counted.append(self.prior.weights * (unit - self.prior.known))
        return jnp.concatenate([part.ravel() for part in counted])

    def effect_of(
        self, unit: Float[Array, " n"], every: int = 1
    ) -> Callable[[Array], Array]:
        """Return the change of the ``residuals`` as a function of one of the runs.

        It takes the change [records, samples] of the outputs of the System.
        """
        system = self.space.put(self.system, unit)

        def residuals(runs: Array) -> Array:
            return self._counted(*self._corrected(runs, system), unit, every)

        return jax.linearize(residuals, self._runs(system))[1]

    def whitened(
        self, error: Float[Array, "records samples"]
    ) -> Float[Array, "records samples"]:
        """Return the errors behind the filter ``whitening``."""
        padded = jnp.pad(error, ((0, 0), (self.whitening.size - 1, 0)))
        white, last = jnp.zeros_like(error), padded.shape[1]
        for i, tap in enumerate(self.whitening):
            white = white + tap * padded[:, last - error.shape[1] - i : last - i]
        return white

    def weighted(self, weights: Float[Array, "records samples"]) -> "Problem":
        """Return the problem with other weights of the errors."""
        return eqx.tree_at(lambda problem: problem.weights, self, weights)

    def with_prior(self, prior: Prior) -> "Problem":
        """Return the problem with another prior."""
        arrays = jax.tree.map(as_array, prior)
        none = {"is_leaf": lambda leaf: leaf is None}
        return eqx.tree_at(lambda problem: problem.prior, self, arrays, **none)

    def only(self, parts: Sequence[slice]) -> "Problem":
        """Return the problem in which a part of the samples of each record counts."""
        weights = np.zeros(self.weights.shape)
        for row, (part, own) in enumerate(zip(parts, self.weights, strict=True)):
            weights[row, part] = own[part]
        return self.weighted(as_array(weights / np.sqrt(np.sum(weights**2))))

    def balanced(self, unit: Float[Array, " n"]) -> "Problem":
        """Return the problem with equal norms of both kinds of errors at ``unit``."""
        error = self.errors(unit)
        plain = jnp.linalg.norm(self.weights * error)
        white = jnp.linalg.norm(self.weights * self.whitened(error))
        return eqx.tree_at(lambda problem: problem.share, self, plain / white)

    def predicting(self, unit: Float[Array, " n"]) -> "Problem":
        """Return the problem of prediction errors, with the noise model at ``unit``.

        The first samples, for which the filter lacks earlier errors, do not count.
        """
        errors, weights = map(np.asarray, (_errors(self, unit), self.weights))
        counted = [each[used > 0.0] for each, used in zip(errors, weights, strict=True)]
        weights = weights.copy()
        weights[:, :NOISE_ORDER] = 0.0
        weights /= np.sqrt(np.sum(weights**2))
        return eqx.tree_at(
            lambda problem: (
                problem.whitening,
                problem.weights,
                problem.plain,
                problem.share,
            ),
            self,
            (*map(as_array, (whitening_filter(counted), weights, 0.0, 1.0)),),
        )


@eqx.filter_jit
def _errors(problem: Problem, unit: Array) -> Array:
    return problem.errors(unit)


@eqx.filter_jit
def equations_at(
    problem: Problem, free: Float[Array, "points unknowns"]
) -> tuple[Array, Array, Array]:
    """Return the normal equations of ``problem`` at each of ``free``.

    These are points of the unit box without its bounds (``unsquash``).
    """
    residuals = linearised(lambda free: problem.residuals(squash(free)))
    return normal_equations(residuals, free)


def _bounded(error: Array) -> Array:
    """Limit ``error``, so that a start that diverges does not affect its batch."""
    return jnp.where(jnp.isfinite(error), jnp.clip(error, -1e6, 1e6), 1e6)


def problem_of(
    structure: Structure,
    records: Sequence[Record],
    train: slice,
    drives: Sequence[np.ndarray] | None = None,
) -> Problem:
    """Return the fit of ``structure`` to ``records``.

    Errors count over the samples ``train`` of each record. ``drives`` [samples, m] take
    the place of the inputs of the records.
    """
    drives = [record.input for record in records] if drives is None else drives
    count = len(records)
    samples = min(train.stop, max(record.samples for record in records))
    inputs = np.zeros((count, samples, *drives[0].shape[1:]))
    outputs, weights = np.zeros((2, count, samples))
    for row, (record, drive) in enumerate(zip(records, drives, strict=True)):
        size = min(record.samples, samples)
        inputs[row, :size], inputs[row, size:] = drive[:size], drive[size - 1]
        outputs[row, :size] = record.output[:size]
        weights[row, train.start : size] = structure.weight(row)
    weights /= np.sqrt(np.sum(weights**2))
    return Problem(
        structure.system,
        structure.space,
        as_array(inputs),
        as_array(outputs),
        as_array(weights),
        None,
        as_array(1.0),
        as_array(structure.whitening),
        as_array(0.0),
        jax.tree.map(as_array, structure.prior),
    )


def at_starts(problem: Problem, starts: Sequence[Start]) -> Problem:
    """Return the problem whose records begin at the ``starts``."""
    return at_stacked(problem, jax.tree.map(lambda *each: jnp.stack(each), *starts))


def at_stacked(problem: Problem, starts: Start) -> Problem:
    """Return the problem whose records begin at ``starts``, stacked into one."""
    return eqx.tree_at(
        lambda p: p.starts, problem, starts, is_leaf=lambda leaf: leaf is None
    )
