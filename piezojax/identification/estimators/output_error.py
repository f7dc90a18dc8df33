"""Fit of any System to records by its free-run simulation error."""

from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ...core.arrays import as_array
from ...core.progress import Progress, Silent
from ...core.recipe import LinearWeights
from ...core.space import INSIDE, squash, unsquash
from ...core.system import System
from ...solve.gauss_newton import (
    TRUST_REGION,
    Descent,
    GaussNewton,
    trials_with_models,
)
from ...solve.multi_start import Patience, descend
from ..records.record import Record
from .error_problem import (
    Problem,
    at_stacked,
    at_starts,
    equations_at,
    problem_of,
)
from .free_runs import settled_part, settled_starts, starts_of
from .linear_start import Start
from .linear_weights import WeightsFit, with_weights
from .noise_model import NOISE_ORDER
from .structure import Prior, Structure

PARALLEL_STARTS = 4
"""Number of starts that descend together in one program."""

TRIAL_STEPS = 12
"""Number of steps after which only the best starts continue."""

ROUGH_STEPS = 24
"""Number of steps of a fit from which another one starts."""

PASSES = 8
"""Most searches for the starts of several records, each followed by a fit."""

PASSED = 0.95
"""Ratio of the mean squares after two of these fits above which one more is enough."""

SETTLED = 0.05
"""Relative change of the mean square that ends the fits with whitened errors."""

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

LEADING = 50_000
"""Number of samples to which a long record is fitted first."""

RANGE = 0.95
"""Share of the range of the input that these samples must contain."""


class Optimum(NamedTuple):
    """Results of all starts, best first.

    ``units`` [starts, n] are points in the unit box, ``losses`` their mean squares.
    ``finished`` is True if the best descent ended by itself. ``weights`` are those
    outside the box, if there are any.
    """

    problem: Problem
    units: np.ndarray
    losses: np.ndarray
    finished: bool
    weights: WeightsFit | None = None

    @property
    def starts(self) -> Start:
        """The states before the records, stacked; ValueError if each is at rest."""
        if self.problem.starts is None:
            raise ValueError("the fit began at rest")
        return self.problem.starts

    @property
    def system(self) -> System:
        """The best System; with several records, its zero is that of the structure."""
        problem = self.problem
        return problem.space.put(problem.system, as_array(self.units[0]))


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
    passes: int = PASSES,
    begun: "Optimum | None" = None,
) -> Optimum:
    """Fit ``structure`` to ``records`` by the mean square of the free-run error.

    Levenberg-Marquardt with the forward Jacobian descends from all starts of the
    structure; after a few steps only the best continue, up to ``steps`` steps. A single
    long record is fitted from the optimum of its first samples (``leading``), except
    for the ``own`` and ``slow`` parameters, which these do not determine. The error
    counts over the samples ``train`` of each record; the model sees the input alone,
    from the first sample on, and the input before a single record is fitted with a
    chain. With several records, with ``own_starts`` or with ``linear`` weights, the
    state before each record and its zero are estimated in place of the structure's
    ``own`` parameters, and the ``vague`` parameters have a weak prior at the first
    start; its scale follows from the errors of a first fit without it, then of each fit
    with it. ``passes`` is the largest number of searches for the states, each followed
    by a fit. The first search is left out after another fit to the records, ``begun``,
    whose states are taken. Otherwise, with ``linear`` weights, the first fit uses the
    samples that depend little on the states (``settled_part``).

    With a ``noise_model`` the error is that of the prediction by the model and an
    autoregressive model of its errors, which are fitted alternately (Ljung, System
    Identification, 2nd ed., 3.2 and 13.4): feedback from the output to the input then
    leaves the fit unbiased, as long as the noise model whitens the errors. ``drives``
    are as in ``problem_of``. Raises ValueError when no start leads to a finite
    simulation.
    """
    progress = progress or Silent()
    several = own_starts or len(records) > 1 or structure.linear is not None
    first = train if several else leading(records[0].input, train)
    if several:
        structure = structure.without(structure.own)
    else:
        structure = structure.with_before(records[0].input)
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
    cautious = several and bool(structure.vague) and not noise_model
    nothing = np.zeros(starts.shape[1]), np.full(starts.shape[1], np.inf)
    none = prior = Prior(*nothing, 0.0)
    if cautious:
        problem = problem.with_prior(none)  # of the final size, to compile once
    if noise_model:
        idle = jnp.zeros(NOISE_ORDER + 1)  # of the final size, to compile once
        problem = eqx.tree_at(lambda p: p.whitening, problem, idle)
    # One start is added below: all passes have the same width, to compile once.
    width = min(PARALLEL_STARTS, len(starts) + int(whitened and not known))
    progress.stage(f"compiling the fit of {starts.shape[1]} parameters")
    rough = min(steps, ROUGH_STEPS) if whitened or several else steps
    units, losses, finished = _inside(starts), np.zeros(len(starts)), False
    parts = [settled_part(record.input, train) for record in records]
    whole, settled, weights = problem.weights, not several, None
    alone = cautious or structure.linear is not None

    def searched(problem: Problem, unit: np.ndarray) -> Problem:
        """Return ``problem`` with the states before the records found anew."""
        system = problem.space.put(problem.system, as_array(unit))
        found, *_ = starts_of(system, records, train)
        return at_starts(problem.weighted(whole), found)

    def weighed(
        problem: Problem, unit: np.ndarray, prior: Prior
    ) -> tuple[Problem, Prior]:
        """Return ``problem`` with the prior for its errors, and this prior."""
        prior = _lighter(prior, _first_guess(structure, problem, unit))
        return problem.with_prior(prior), prior

    for turn in range(passes):
        if several and begun is not None and not turn:
            problem = at_stacked(problem, begun.starts)
        elif several and (turn or structure.linear is None):
            problem = searched(problem, units[0])
        elif several:
            # With the first guess of the weights no state would be right.
            system = problem.space.put(problem.system, as_array(units[0]))
            found = settled_starts(system, records, parts)
            problem = at_starts(problem.only(parts), found)
        if cautious and turn:
            problem, prior = weighed(problem, units[0], prior)
        last, past = settled or turn == passes - 1, losses[0]
        limit = steps if last and not whitened else rough
        problem, units, losses, finished, weights = _descended(
            problem, structure.linear, _inside(units), width, limit, progress
        )
        if last:
            break
        # The first fit may have no prior or fewer samples: it compares with no other.
        settled = turn > int(alone) and losses[0] > PASSED * past
    past, rounds = np.inf, NOISE_PASSES if noise_model else passes if several else 1
    for turn in range(rounds if whitened else 0):
        if noise_model:
            problem = problem.predicting(as_array(units[0]))
        elif not turn:
            problem = _balanced(problem, as_array(units[0]))
            past = problem.spread(as_array(units[0]))[0] ** 2 if several else np.inf
        else:
            problem = searched(problem, units[0])
            if cautious:
                problem, prior = weighed(problem, units[0], prior)
        if not turn and not known:
            # Errors of the hysteresis may have hidden a resonance from the first fit.
            dynamics = [problem.space.paths.index(path) for path in structure.dynamics]
            again = units.copy()
            again[:, dynamics] = starts[0, dynamics]
            # The best point first: linear weights are fitted there.
            units = np.concatenate([units[:1], again])
        problem, units, losses, finished, weights = _descended(
            problem, structure.linear, _inside(units), width, steps, progress
        )
        if turn == rounds - 1:
            break
        left = losses[0]
        if not noise_model:
            left = problem.spread(as_array(units[0]))[0] ** 2
        if abs(past - left) <= (NOISE_SETTLED if noise_model else SETTLED) * left:
            break
        past = left
    if cautious:
        problem = problem.with_prior(none)  # errors are those of the records alone
        weights = weights and weights._replace(problem=problem)
    return Optimum(problem, units, losses, finished, weights)


def _lighter(prior: Prior, later: Prior) -> Prior:
    """Return ``later``, with at most the scale of ``prior`` if this has any.

    A prior that is too heavy raises the errors, and these must not make it heavier.
    """
    return later._replace(scale=min(prior.scale or np.inf, later.scale))


def _first_guess(structure: Structure, problem: Problem, unit: np.ndarray) -> Prior:
    """Return the prior of the vague parameters around the first guess.

    Two records may not determine each weight of a hysteresis: without the prior, a
    third record, with another history, has errors many times as large.
    """
    rms, independent = problem.spread(as_array(unit))
    spread = [structure.vague.get(path, np.inf) for path in structure.space.paths]
    known = structure.starts[0] if structure.guess is None else structure.guess
    return Prior(known, np.array(spread), rms / float(np.sqrt(independent)))


def _inside(units: np.ndarray) -> np.ndarray:
    return np.clip(units, INSIDE, 1.0 - INSIDE)


def _descended(
    problem: Problem,
    linear: LinearWeights | None,
    starts: np.ndarray,
    width: int,
    steps: int,
    progress: Progress,
) -> Optimum:
    """Return the optimum from ``starts``, that of the ``linear`` weights included.

    ``width`` starts descend together, and at most as many points are returned. Raises
    ValueError if no start leads to a finite simulation.
    """
    firsts = np.asarray(unsquash(as_array(starts)))
    weights = linear and with_weights(problem, linear, as_array(firsts[0]))
    equations = partial(equations_at, problem)
    evaluate = trials_with_models(
        weights.normal_equations if weights else equations, width
    )
    descents = [Descent(start, TRUST_REGION, tolerance=TOLERANCE) for start in firsts]
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
    if weights:
        weights = weights.best_at(unsquash(as_array(units[0])), weights.scale)
        problem = weights.problem
    return Optimum(problem, units, losses, finished, weights)


@eqx.filter_jit
def _balanced(problem: Problem, unknown: Array) -> Problem:
    return problem.balanced(unknown)
