"""Fit of any System to records by its free-run simulation error."""

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ...core.arrays import ScalarLike, as_array
from ...core.progress import Progress, Silent
from ...core.rollout import simulate
from ...core.space import INSIDE, Space, squash, unsquash
from ...core.system import System, rest_output
from ...hysteresis.model import input_before
from ...solve.gauss_newton import (
    TRUST_REGION,
    Descent,
    GaussNewton,
    trials_with_models,
)
from ...solve.local_model import normal_equations
from ...solve.multi_start import Patience, descend
from ...solve.problem import linearised
from ..records.record import Record
from .structure import Structure

PARALLEL_STARTS = 4
"""Number of starts that descend together in one program."""

TRIAL_STEPS = 12
"""Number of steps after which only the best starts continue."""

ROUGH_STEPS = 24
"""Number of steps of a fit from which another one starts."""

TOLERANCE = 1e-10
"""Relative change of loss and point below which a descent ends."""

STALLED = Patience(14, share=3e-4)
"""Steps within which the best mean square must fall by this share; otherwise the fit
ends. A point with a parameter that tends to its bound does not converge by itself."""

FAILED_LOSS = 1e11
"""Least mean square of a simulation that counts as not finite."""

UNDETERMINED = 1e-12
"""Relative singular value of the Jacobian below which a direction is undetermined."""


class Optimum(NamedTuple):
    """Results of all starts, best first.

    ``units`` [starts, n] are points in the unit box, ``losses`` their mean squares.
    ``finished`` tells whether the best descent ended by itself.
    """

    problem: "Problem"
    names: tuple[str, ...]
    units: np.ndarray
    losses: np.ndarray
    finished: bool


class Problem(eqx.Module):
    """Fit of one System to several records, padded to one length with zero weights.

    ``which`` [records, n] holds the indices of each record's parameters among the
    unknowns. All records share them, except for the initial conditions of each. The
    errors behind the filter ``whitening``, if it has coefficients, count ``share``
    times.
    """

    system: System
    space: Space
    which: Int[Array, "records n"]
    inputs: Float[Array, "records samples"]
    outputs: Float[Array, "records samples"]
    weights: Float[Array, "records samples"]
    whitening: Float[Array, " taps"]
    share: Float[Array, ""]

    def simulated(self, unknown: Float[Array, " unknowns"]) -> Float[Array, "..."]:
        """Return the free run of every record, [records, samples]."""

        def one(unit, input):
            return from_rest(self.space.put(self.system, unit), input)

        return jax.vmap(one)(unknown[self.which], self.inputs)

    def residuals(self, unknown: Float[Array, " unknowns"]) -> Float[Array, " all"]:
        """Return the weighted errors; their sum of squares is the mean square."""
        error = self.simulated(unknown) - self.outputs
        # A start that diverges must not affect the others of its batch.
        error = jnp.where(jnp.isfinite(error), jnp.clip(error, -1e6, 1e6), 1e6)
        counted = [self.weights * error]
        if self.whitening.size:
            counted.append(self.share * self.weights * self.whitened(error))
        return jnp.concatenate(counted, axis=None)

    def whitened(
        self, error: Float[Array, "records samples"]
    ) -> Float[Array, "records samples"]:
        """Return the errors behind the filter ``whitening``."""
        padded = jnp.pad(error, ((0, 0), (self.whitening.size - 1, 0)))
        white, last = jnp.zeros_like(error), padded.shape[1]
        for i, tap in enumerate(self.whitening):
            white = white + tap * padded[:, last - error.shape[1] - i : last - i]
        return white

    def balanced(self, unknown: Float[Array, " unknowns"]) -> "Problem":
        """Return the problem in which both kinds of errors at ``unknown`` weigh the
        same."""
        error = self.simulated(unknown) - self.outputs
        plain = jnp.linalg.norm(self.weights * error)
        white = jnp.linalg.norm(self.weights * self.whitened(error))
        return eqx.tree_at(lambda problem: problem.share, self, plain / white)


def free_run(
    system: System, input: Float[Array, "n ..."], before: ScalarLike | Array
) -> Float[Array, "n ..."]:
    """Return the output samples that ``system`` predicts from ``input`` alone.

    A plant maps u(k) to y(k+1), as in the loop; the first output is that at rest under
    ``before``, the input in force when the record begins.
    """
    _, outputs = simulate(system, input, system.init(before))
    first = rest_output(system, before)
    return jnp.concatenate([first[None], outputs[:-1]])


def from_rest(system: System, input: Float[Array, "n ..."]) -> Float[Array, "n ..."]:
    """Return the free run from the rest input of the model, or from the first input."""
    return free_run(system, input, input_before(system, input[0]))


def problem_of(
    structure: Structure, records: Sequence[Record], train: slice
) -> tuple[Problem, tuple[str, ...]]:
    """Return the fit of ``structure`` to ``records``, and the names of its unknowns.

    Errors count over the samples ``train`` of each record.
    """
    space, count = structure.space, len(records)

    def name(path: str, row: int) -> str:
        alone = path not in structure.own or count == 1
        return path if alone else f"{path} of record {row}"

    used = [[name(path, row) for path in space.paths] for row in range(count)]
    names = list(dict.fromkeys(itertools.chain(*used)))
    which = [[names.index(name) for name in row] for row in used]
    samples = min(train.stop, max(record.samples for record in records))
    inputs, outputs, weights = np.zeros((3, count, samples))
    for row, record in enumerate(records):
        size = min(record.samples, samples)
        inputs[row] = np.pad(record.input[:size], (0, samples - size), mode="edge")
        outputs[row, :size] = record.output[:size]
        weights[row, train.start : size] = 1.0
    weights /= np.sqrt(np.sum(weights))
    problem = Problem(
        structure.system,
        space,
        jnp.asarray(which),
        as_array(inputs),
        as_array(outputs),
        as_array(weights),
        as_array(structure.whitening),
        as_array(0.0),
    )
    return problem, tuple(names)


def output_error(
    structure: Structure,
    records: Sequence[Record],
    train: slice,
    *,
    steps: int = 200,
    progress: Progress | None = None,
) -> Optimum:
    """Fit ``structure`` to ``records`` by the mean square of the free-run error.

    Levenberg-Marquardt with the forward Jacobian, from all starts of the structure;
    after a few steps only the best continue, to at most ``steps``. The error counts
    over the samples ``train`` of each record; the model sees the input alone, from the
    first sample on. Raises ValueError when no start leads to a finite simulation.
    """
    progress = progress or Silent()
    problem, names = problem_of(structure, records, train)
    starts = _starts_for_records(structure, problem)
    progress.stage(f"compiling the fit of {len(names)} parameters")
    rough = min(steps, ROUGH_STEPS) if structure.whitening else steps
    units, losses, finished = _descended(problem, starts, rough, progress)
    if structure.whitening:
        # Errors of the hysteresis may have hidden a resonance from the first fit.
        problem = _balanced(problem, as_array(units[0]))
        dynamics = [names.index(path) for path in structure.dynamics]
        again = units.copy()
        again[:, dynamics] = starts[0, dynamics]
        starts = np.concatenate([again, units])[: len(units) + 1]
        starts = np.clip(starts, INSIDE, 1.0 - INSIDE)
        units, losses, finished = _descended(problem, starts, steps, progress)
    return Optimum(problem, names, units, losses, finished)


def _descended(
    problem: Problem, starts: np.ndarray, steps: int, progress: Progress
) -> tuple[np.ndarray, np.ndarray, bool]:
    """Return the best points, their losses, and whether the best ended by itself.

    Raises ValueError when no start leads to a finite simulation.
    """
    width = min(PARALLEL_STARTS, len(starts))
    evaluate = trials_with_models(lambda free: _normal_equations(problem, free), width)
    descents = [
        Descent(start, TRUST_REGION, tolerance=TOLERANCE)
        for start in np.asarray(unsquash(as_array(starts)))
    ]
    progress.stage(f"fitting from {len(starts)} starts", steps)
    standing, finished = descend(
        GaussNewton(descents, evaluate),
        steps,
        lambda standing: progress.advance(
            float(np.sqrt(2.0 * np.min(standing.losses)))
        ),
        cut=lambda step, running: width if step == TRIAL_STEPS else None,
        patience=STALLED,
    )
    order = np.argsort(standing.losses)[:width]
    losses = 2.0 * standing.losses[order]
    units = np.asarray(squash(as_array(standing.units[order])))
    if losses[0] >= FAILED_LOSS:
        raise ValueError("no start led to a finite simulation of the record")
    return units, losses, finished


@eqx.filter_jit
def _balanced(problem: Problem, unknown: Array) -> Problem:
    return problem.balanced(unknown)


def _starts_for_records(structure: Structure, problem: Problem) -> np.ndarray:
    """Return the starts, with the parameters in ``own`` repeated for every record."""
    unknowns = int(np.max(problem.which)) + 1
    starts = np.empty((len(structure.starts), unknowns))
    for row in np.asarray(problem.which):
        starts[:, row] = structure.starts
    return starts


@eqx.filter_jit
def _normal_equations(
    problem: Problem, free: Float[Array, "points unknowns"]
) -> tuple[Array, Array, Array]:
    residuals = linearised(lambda free: problem.residuals(squash(free)))
    return normal_equations(residuals, free)


@eqx.filter_jit
def _sensitivity(problem: Problem, unit: Array) -> tuple[Array, Array, Array]:
    """Return the unknowns' values and slopes, and the residuals' weighted Jacobian."""
    jacobian = jax.jacfwd(lambda unknown: problem.residuals(unknown))(unit)
    slopes = jax.jacfwd(lambda u: _values(problem, u))(unit).diagonal()
    return _values(problem, unit), slopes, jacobian


def _values(problem: Problem, unit: Array) -> Array:
    """Return the values of all unknowns at ``unit``."""
    values = jnp.zeros_like(unit)
    for row in problem.which:
        values = values.at[row].set(problem.space.from_unit(unit[row]))
    return values


def values_and_errors(optimum: Optimum) -> tuple[np.ndarray, list[float | None]]:
    """Return the parameters of the best point and their standard errors.

    The errors are those of Gauss-Newton: the covariance is s^2 (J'J)^-1, for white
    residuals. A parameter in a direction that the record does not determine has the
    error None.
    """
    problem, unit = optimum.problem, as_array(optimum.units[0])
    values, slopes, jacobian = map(np.asarray, _sensitivity(problem, unit))
    jacobian = jacobian / np.where(slopes == 0.0, 1.0, slopes)
    kinds = 2 if problem.whitening.size else 1
    counted = kinds * int(np.sum(np.asarray(problem.weights) > 0))
    variance = optimum.losses[0] / max(counted - unit.size, 1)
    return values, standard_errors(jacobian, variance)


def standard_errors(jacobian: np.ndarray, variance: float) -> list[float | None]:
    """Return the square roots of the diagonal of ``variance`` (J'J)^-1.

    None for a parameter in a direction that the ``jacobian`` does not determine.
    """
    scale = np.linalg.norm(jacobian, axis=0)
    scale = np.where(scale > 0.0, scale, 1.0)
    _, strength, directions = np.linalg.svd(jacobian / scale, full_matrices=False)
    weak = strength < UNDETERMINED * strength[0]
    known = np.sum(directions[weak] ** 2, axis=0) < 1e-6
    inverse = np.where(weak, 0.0, 1.0 / np.where(weak, 1.0, strength))
    spread = np.sqrt(variance * np.sum((directions.T * inverse) ** 2, axis=1)) / scale
    return [float(d) if k else None for d, k in zip(spread, known, strict=True)]
