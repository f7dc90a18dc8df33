"""Fit of any System to records by its free-run simulation error."""

from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ...core.arrays import ScalarLike, as_array
from ...core.progress import Progress, Silent
from ...core.rollout import simulate
from ...core.space import INSIDE, Space, squash, unsquash
from ...core.system import System, at_rest, resolve
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
from .approach import Start, most_likely, run_after, start_columns, start_of
from .noise_model import NOISE_ORDER, whitening_filter
from .structure import Structure

PARALLEL_STARTS = 4
"""Number of starts that descend together in one program."""

TRIAL_STEPS = 12
"""Number of steps after which only the best starts continue."""

ROUGH_STEPS = 24
"""Number of steps of a fit from which another one starts."""

PASSES = 3
"""Number of searches for the starts of several records, each followed by a fit."""

NOISE_PASSES = 4
"""Largest number of alternate fits of a noise model and the parameters."""

NOISE_SETTLED = 1e-3
"""Relative change of the mean square of the prediction error that ends these passes."""

TOLERANCE = 1e-10
"""Relative change of loss and point below which a descent ends."""

STALLED = Patience(14, share=3e-4)
"""Steps within which the best mean square must fall by this share; otherwise the fit
ends. A point with a parameter that tends to its bound does not converge by itself."""

FAILED_LOSS = 1e11
"""Least mean square of a simulation that counts as not finite."""

UNDETERMINED = 1e-14
"""Relative eigenvalue of J'J, scaled to a unit diagonal, below which a direction is
undetermined: rounding errors are a hundredth of it."""


LEADING = 50_000
"""Number of samples to which a long record is fitted first."""

RANGE = 0.95
"""Share of the range of the input that these samples must contain."""


class Optimum(NamedTuple):
    """Results of all starts, best first.

    ``units`` [starts, n] are points in the unit box, ``losses`` their mean squares.
    ``finished`` is True if the best descent ended by itself.
    """

    problem: "Problem"
    units: np.ndarray
    losses: np.ndarray
    finished: bool

    @property
    def system(self) -> System:
        """The best System; with several records, its zero is that of the structure."""
        problem = self.problem
        return problem.space.put(problem.system, as_array(self.units[0]))


class Problem(eqx.Module):
    """Fit of one System to several records, padded to one length with zero weights.

    A single record begins at rest. Each of several records has its own start, stacked
    in ``starts``. ``plain`` (0 or 1) is the weight of the errors, ``share`` that of the
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
    prior: Float[Array, "2 known"]

    def errors(self, unit: Float[Array, " n"]) -> Float[Array, "records samples"]:
        """Return the errors of the free run of every record."""
        return self._errors_and_starts(unit)[0]

    def _errors_and_starts(self, unit: Array) -> tuple[Array, Array]:
        """Return the errors, and the prior residuals of the state before each record.

        The columns of the starts are not differentiated: at the most likely amounts the
        gradient of the squares does not depend on them (variable projection as in
        Kaufman, BIT 15, 1975, 49-57).
        """
        system = self.space.put(self.system, unit)
        if self.starts is None:
            runs = jax.vmap(lambda input: from_rest(system, input))(self.inputs)
            return runs - self.outputs, jnp.zeros((len(self.inputs), 0))
        held = self.space.put(self.system, jax.lax.stop_gradient(unit))

        def one(input, output, weights, start):
            run = run_after(system, input, start.levels).reshape(-1, 1)
            error = _bounded(output[:, None] - run)
            columns = start_columns(held, input, start)
            counted = (weights > 0.0).astype(error.dtype)
            amounts = most_likely(columns, error, counted, start.variance)
            error = jnp.einsum("ksp,k->s", columns, amounts) - error[:, 0]
            spread = jnp.sqrt(start.variance) * jnp.max(weights)
            return error, spread * amounts[1:]

        return jax.vmap(one)(self.inputs, self.outputs, self.weights, self.starts)

    def residuals(self, unit: Float[Array, " n"]) -> Float[Array, " all"]:
        """Return the weighted errors; their sum of squares is the mean square."""
        error, unlikely = self._errors_and_starts(unit)
        error = _bounded(error)
        counted = [self.plain * self.weights * error, unlikely]
        if self.whitening.size:
            counted.append(self.share * self.weights * self.whitened(error))
        if self.prior.size:
            known, weights = self.prior
            counted.append(weights * (unit - known))
        return jnp.concatenate([part.ravel() for part in counted])

    def whitened(
        self, error: Float[Array, "records samples"]
    ) -> Float[Array, "records samples"]:
        """Return the errors behind the filter ``whitening``."""
        padded = jnp.pad(error, ((0, 0), (self.whitening.size - 1, 0)))
        white, last = jnp.zeros_like(error), padded.shape[1]
        for i, tap in enumerate(self.whitening):
            white = white + tap * padded[:, last - error.shape[1] - i : last - i]
        return white

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
        errors, weights = map(np.asarray, (self.errors(unit), self.weights))
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


def _bounded(error: Array) -> Array:
    """Limit ``error``, so that a start that diverges does not affect its batch."""
    return jnp.where(jnp.isfinite(error), jnp.clip(error, -1e6, 1e6), 1e6)


def free_run(
    system: System, input: Float[Array, "n ..."], before: ScalarLike | Array
) -> Float[Array, "n ..."]:
    """Return the output samples that ``system`` predicts from ``input`` alone.

    A plant maps u(k) to y(k+1), as in the loop; the first output is that at rest under
    ``before``, the input in force when the record begins.
    """
    system = resolve(system)  # once for the start and the run
    state, first = at_rest(system, before)
    _, outputs = simulate(system, input, state)
    return jnp.concatenate([first[None], outputs[:-1]])


def from_rest(system: System, input: Float[Array, "n ..."]) -> Float[Array, "n ..."]:
    """Return the free run from the rest input of the model, or from the first input.

    A System of several inputs starts from the first of these.
    """
    before = input_before(system, input[0]) if input.ndim == 1 else input[0]
    return free_run(system, input, before)


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
        as_array(np.stack(structure.prior) if structure.prior else np.zeros((2, 0))),
    )


def starts_of(
    system: System, records: Sequence[Record], train: slice
) -> tuple[list[Start], list[np.ndarray], list[float]]:
    """Return starts, runs [samples, 1] and zeros of the sensor, one for each record.

    The starts are estimated for ``system`` on the samples ``train``.
    """
    ends = np.array([f([f(r.input) for r in records]) for f in (np.min, np.max)])
    found, runs, zeros = [], [], []
    for record in records:
        part = slice(train.start, min(train.stop, record.samples))
        start, run, zero = start_of(system, record.input, record.output, part, ends)
        found.append(start)
        runs.append(run)
        zeros.append(float(zero[0]))
    return found, runs, zeros


def free_runs(
    system: System,
    records: Sequence[Record],
    train: slice,
    *,
    own_starts: bool = False,
) -> tuple[tuple[np.ndarray, ...], list[float]]:
    """Return the free run [samples, 1] of each of ``records``, and their zeros.

    A single record begins at rest and has no zero of its own; the starts of several
    records, or with ``own_starts``, are estimated on their samples ``train``.
    """
    if own_starts or len(records) > 1:
        _, runs, zeros = starts_of(system, records, train)
        return tuple(runs), zeros
    run = eqx.filter_jit(from_rest)
    return tuple(
        np.asarray(run(system, as_array(r.input)))[:, None] for r in records
    ), [0.0]


def leading(input: np.ndarray, train: slice) -> slice:
    """Return the first samples of ``train``, from which a long fit may start.

    They are ``LEADING`` samples, or more if these do not show the range of the input
    [samples], or all of ``train`` if that is less than twice as long.
    """
    size, whole = LEADING, np.ptp(input[train])
    while 2 * size <= train.stop - train.start:
        part = slice(train.start, train.start + size)
        if np.ptp(input[part]) >= RANGE * whole:
            return part
        size *= 2
    return train


def at_starts(problem: Problem, starts: Sequence[Start]) -> Problem:
    """Return the problem whose records begin at the ``starts``."""
    stacked = jax.tree.map(lambda *each: jnp.stack(each), *starts)
    return eqx.tree_at(
        lambda p: p.starts, problem, stacked, is_leaf=lambda leaf: leaf is None
    )


def output_error(
    structure: Structure,
    records: Sequence[Record],
    train: slice,
    *,
    steps: int = 200,
    progress: Progress | None = None,
    noise_model: bool = False,
    drives: Sequence[np.ndarray] | None = None,
    own_starts: bool = False,
) -> Optimum:
    """Fit ``structure`` to ``records`` by the mean square of the free-run error.

    Levenberg-Marquardt with the forward Jacobian descends from all starts of the
    structure; after a few steps only the best continue, up to ``steps`` steps. A single
    long record is fitted from the optimum of its first samples (``leading``), except
    for the ``own`` and ``slow`` parameters, which these do not determine. The error
    counts over the samples ``train`` of each record; the model sees the input alone,
    from the first sample on. With several records the state before each and the zero of
    each take the place of the structure's ``own`` parameters; so does that of a single
    one with ``own_starts``.

    With a ``noise_model`` the error is that of the prediction by the model and an
    autoregressive model of its errors, which are fitted alternately (Ljung, System
    Identification, 2nd ed., 3.2 and 13.4): feedback from the output to the input then
    leaves the fit unbiased, as long as the noise model whitens the errors. ``drives``
    are as in ``problem_of``. Raises ValueError when no start leads to a finite
    simulation.
    """
    progress = progress or Silent()
    several = own_starts or len(records) > 1
    first = train if several else leading(records[0].input, train)
    if several:
        structure = structure.without(structure.own)
    starts, whitened = structure.starts, bool(structure.whitening or noise_model)
    known = first != train  # the optimum of the first samples
    if known:
        best = output_error(
            structure,
            records,
            first,
            steps=steps,
            progress=progress,
            noise_model=noise_model,
            drives=drives,
        ).units[0]
        slow = {*structure.own, *structure.slow}
        restarted = [path in slow for path in structure.space.paths]
        starts = np.where(restarted, starts[:1], best)
    problem = problem_of(structure, records, train, drives)
    if noise_model:
        idle = jnp.zeros(NOISE_ORDER + 1)  # of the final size, to compile once
        problem = eqx.tree_at(lambda p: p.whitening, problem, idle)
    # One start is added below: all passes have the same width, to compile once.
    width = min(PARALLEL_STARTS, len(starts) + int(whitened and not known))
    progress.stage(f"compiling the fit of {starts.shape[1]} parameters")
    rough = min(steps, ROUGH_STEPS) if whitened or several else steps
    units, losses, finished = _inside(starts), np.zeros(len(starts)), False
    rounds = PASSES if several else 1
    for left in reversed(range(rounds)):
        if several:
            system = problem.space.put(problem.system, as_array(units[0]))
            found, *_ = starts_of(system, records, train)
            problem = at_starts(problem, found)
        last = not left and not whitened
        units, losses, finished = _descended(
            problem, _inside(units), width, steps if last else rough, progress
        )
    before = np.inf
    for _ in range(NOISE_PASSES if noise_model else int(whitened)):
        point = as_array(units[0])
        if noise_model:
            problem = problem.predicting(point)
        else:
            problem = _balanced(problem, point)
        if np.isinf(before) and not known:
            # Errors of the hysteresis may have hidden a resonance from the first fit.
            dynamics = [problem.space.paths.index(path) for path in structure.dynamics]
            again = units.copy()
            again[:, dynamics] = starts[0, dynamics]
            units = np.concatenate([again, units])[: len(units) + 1]
        units, losses, finished = _descended(
            problem, _inside(units), width, steps, progress
        )
        if abs(before - losses[0]) <= NOISE_SETTLED * losses[0]:
            break
        before = losses[0]
    return Optimum(problem, units, losses, finished)


def _inside(units: np.ndarray) -> np.ndarray:
    return np.clip(units, INSIDE, 1.0 - INSIDE)


def _descended(
    problem: Problem, starts: np.ndarray, width: int, steps: int, progress: Progress
) -> tuple[np.ndarray, np.ndarray, bool]:
    """Return at most ``width`` best points, their losses, and if the best has ended.

    ``width`` starts descend together. Raises ValueError when no start leads to a finite
    simulation.
    """
    evaluate = trials_with_models(lambda free: _normal_equations(problem, free), width)
    descents = [
        Descent(start, TRUST_REGION, tolerance=TOLERANCE)
        for start in np.asarray(unsquash(as_array(starts)))
    ]
    progress.stage(f"fitting from {len(starts)} starts", steps)
    status, finished = descend(
        GaussNewton(descents, evaluate),
        steps,
        lambda status: progress.advance(float(np.sqrt(2.0 * np.min(status.losses)))),
        cut=lambda step, running: width if step == TRIAL_STEPS else None,
        patience=STALLED,
    )
    order = np.argsort(status.losses)[:width]
    losses = 2.0 * status.losses[order]
    units = np.asarray(squash(as_array(status.units[order])))
    if losses[0] >= FAILED_LOSS:
        raise ValueError(
            "no start led to a finite simulation of the record: check its columns and "
            "units, or fit another model"
        )
    return units, losses, finished


@eqx.filter_jit
def _balanced(problem: Problem, unknown: Array) -> Problem:
    return problem.balanced(unknown)


@eqx.filter_jit
def _normal_equations(
    problem: Problem, free: Float[Array, "points unknowns"]
) -> tuple[Array, Array, Array]:
    residuals = linearised(lambda free: problem.residuals(squash(free)))
    return normal_equations(residuals, free)


@eqx.filter_jit
def _parameters(problem: Problem, free: Array) -> tuple[Array, Array]:
    """Return the parameters at ``free``, and their derivatives."""

    def values(free: Array) -> Array:
        return problem.space.from_unit(squash(free))

    return jax.jvp(values, (free,), (jnp.ones_like(free),))


def values_and_errors(optimum: Optimum) -> tuple[np.ndarray, list[float | None]]:
    """Return the parameters of the best point and their standard errors.

    The errors are those of Gauss-Newton: the covariance is s^2 (J'J)^-1, for white
    residuals. A parameter in a direction that the record does not determine has the
    error None.
    """
    problem, free = optimum.problem, unsquash(as_array(optimum.units))
    values, slopes = map(np.asarray, _parameters(problem, free[0]))
    # All points, because the program of the descents is compiled for their number.
    curvature = np.asarray(_normal_equations(problem, free)[2][0])
    slopes = np.where(slopes == 0.0, 1.0, slopes)
    kinds = 2 if problem.whitening.size and float(problem.plain) else 1
    counted = kinds * int(np.sum(np.asarray(problem.weights) > 0))
    variance = optimum.losses[0] / max(counted - values.size, 1)
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
