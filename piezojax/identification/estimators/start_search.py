"""Search for the state of a stage before a record.

The levels of the motion before it are estimated from its first part: the free run from
them has the least mean-square error, after the contribution of the states of linear
parts is removed.
"""

import itertools
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ...core.system import System
from ...solve.multi_start import in_batches
from .approach import TURNS, run_after, runs_after
from .linear_start import FEW, Start, most_likely, start_columns
from .noise_model import independent

LEVELS = 9
"""Number of values tried for each level, in all combinations."""

REFINED = 3
"""Number of candidates of the grid that are refined: the local optimum near the best
one may be poor."""

FINE = 5 * 3**TURNS
"""Number of values tried afterwards for each level by itself."""

BEYOND = 0.2
"""Share of the input's range by which the levels may lie outside it: a stage was at 0 V
when it was switched on, and its record may not include 0 V."""

FINEST = 1.0 / 1024.0
"""Share of the input's range to which the levels are refined."""

ROUNDS = 20
"""Largest number of rounds of a refinement."""

WIDTH = REFINED * 3**TURNS
"""Candidates that are simulated together."""

REFINEMENTS = 3
"""Number of estimates of the linear states, each with the residual variance of the
estimate before."""


def levels_before(
    system: System,
    inputs: np.ndarray,
    outputs: np.ndarray,
    part: slice,
    ranges: np.ndarray,
    samples: float = 1.0,
) -> np.ndarray:
    """Return the levels [TURNS, m] of the inputs whose free run fits best.

    ``inputs`` [samples, m] or [samples], ``outputs`` [samples, p] or [samples]. Errors
    count over ``part``, after the contribution of the zeros of the sensor and of the
    states of the linear parts is removed (``most_likely``); so many ``samples`` count
    as one. ``ranges`` [2, m] or [2] are the ends of the range of the inputs; the levels
    may lie outside it by up to BEYOND times its width.

    The search is made twice: with and without treating a hysteresis of few states as
    linear. The former has fewer local optima; the error of the latter decides. If
    levels fit equally well, those at which the stage rests at the first input are
    preferred.
    """
    width = ranges[1] - ranges[0]
    low, high = ranges[0] - BEYOND * width, ranges[1] + BEYOND * width
    u, y = inputs[: part.stop], outputs[part].reshape(part.stop - part.start, -1)
    search = _LevelSearch(system, jnp.asarray(u), y, part, low, high, samples)
    columns, every = (search.columns(jnp.asarray(ranges), few) for few in (0, FEW))
    found, variance = search.levels(columns)
    if every.shape == columns.shape:
        return found
    smooth, _ = search.levels(every)
    smooth, least = search.refined(smooth[None], columns, np.array([variance]))
    return smooth[0] if least[0] < variance else found


class _LevelSearch(NamedTuple):
    """Search for the levels, from ``low`` to ``high`` [m] or scalars.

    The free runs of ``system`` under ``inputs`` are compared with the ``outputs``
    [samples, p] of ``part``. The methods take ``columns`` [samples p, k], the effects
    of the zeros and of the states before the record; their coefficients are those of
    ``most_likely``, where so many ``samples`` count as one.
    """

    system: System
    inputs: Array
    outputs: np.ndarray
    part: slice
    low: np.ndarray
    high: np.ndarray
    samples: float

    def columns(self, ends: Array, few: int) -> np.ndarray:
        """Return the columns for a stage at rest, ``few`` as in ``start_columns``."""
        start = Start(jnp.asarray(self._rest()), ends, jnp.zeros(()))
        found = np.asarray(_columns(self.system, self.inputs, start, few))
        return found[:, self.part].reshape(-1, self.outputs.size).T

    def levels(self, columns: np.ndarray) -> tuple[np.ndarray, float]:
        """Return the levels that fit best, and their mean square error.

        All levels together are searched on a grid, and the best points are refined.
        Then each level alone is searched on a fine grid, and the result refined again:
        the optimum is narrow where an element of a hysteresis moves only once in the
        record, and by little.
        """
        grid = np.linspace(0.0, 1.0, LEVELS)
        every = self._between([*itertools.product(grid, repeat=TURNS)])
        candidates = np.concatenate([self._rest()[None], every])
        variance = float(np.mean(np.var(self.outputs, axis=0)))
        errors = self._errors(candidates, columns, variance)
        best = np.argsort(errors, kind="stable")[:REFINED]
        refined, errors = self.refined(
            candidates[best], columns, errors[best], finest=1.0 / FINE
        )
        found, variance = refined[np.argmin(errors)], float(np.min(errors))
        fine = self._between(np.linspace(0.0, 1.0, FINE))
        for turn in range(TURNS):
            scanned = np.repeat(found[None], 1 + FINE, axis=0)
            scanned[1:, turn] = fine
            errors = self._errors(scanned, columns, variance)
            found, variance = scanned[np.argmin(errors)], float(np.min(errors))
        refined, errors = self.refined(
            found[None], columns, np.array([variance]), 1.0 / FINE
        )
        return refined[0], float(errors[0])

    def refined(
        self,
        levels: np.ndarray,
        columns: np.ndarray,
        variances: np.ndarray,
        step: float = 0.5 / (LEVELS - 1),
        finest: float = FINEST,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the best levels around each of ``levels``, and their variances.

        ``variances`` are the mean square errors of ``levels`` [candidates, ...]. The
        first ``step`` and the ``finest`` one are shares of their range.
        """
        shifts = sorted(
            itertools.product((-1.0, 0.0, 1.0), repeat=TURNS), key=np.linalg.norm
        )
        around = self._spread(shifts) * (self.high - self.low)
        levels, variances = levels.copy(), variances.copy()
        steps = np.full(len(levels), step)
        for _ in range(ROUNDS):
            moving = np.flatnonzero(steps >= finest)
            if not len(moving):
                break
            moved = [levels[i] + steps[i] * around for i in moving]
            moved = np.clip(np.stack(moved), self.low, self.high)
            runs = self._runs(moved.reshape(-1, *levels.shape[1:]))
            runs = runs.reshape(*moved.shape[:2], *runs.shape[1:])
            for i, near, outputs in zip(moving, moved, runs, strict=True):
                errors = self._left(outputs, columns, variances[i])
                place = np.argmin(errors)
                if np.array_equal(near[place], levels[i]):
                    steps[i] *= 0.5
                levels[i], variances[i] = near[place], errors[place]
        return levels, variances

    def _errors(
        self, candidates: np.ndarray, columns: np.ndarray, variance: float
    ) -> np.ndarray:
        """Return the mean square error of each candidate."""
        return self._left(self._runs(candidates), columns, variance)

    def _runs(self, candidates: np.ndarray) -> np.ndarray:
        runs = in_batches(
            lambda some: runs_after(self.system, self.inputs, some), candidates, WIDTH
        )
        return runs[:, self.part].reshape(len(candidates), *self.outputs.shape)

    def _left(
        self, runs: np.ndarray, columns: np.ndarray, variance: float
    ) -> np.ndarray:
        """Return the mean square error that ``columns`` leave of each run."""
        error = np.clip(np.nan_to_num(self.outputs - runs, nan=1e15), -1e15, 1e15)
        scale = np.sqrt(self.samples * variance)
        prior = scale * np.eye(columns.shape[1])[self.outputs.shape[1] :]
        base, _ = np.linalg.qr(np.concatenate([columns, prior]))
        # The prior's own rows have no error.
        error, size = error.reshape(len(runs), -1), self.outputs.size
        left = np.sum(error**2, axis=1) - np.sum((error @ base[:size]) ** 2, axis=1)
        return np.maximum(left, 0.0) / size

    def _rest(self) -> np.ndarray:
        first = np.asarray(self.inputs[0])
        return np.broadcast_to(first, (TURNS, *np.shape(self.low))).astype(float)

    def _spread(self, shares: Any) -> np.ndarray:
        """Return ``shares`` with a further axis for the channels, if there is one."""
        shares = np.asarray(shares)
        return shares.reshape(*shares.shape, *[1] * np.ndim(self.low))

    def _between(self, shares: Any) -> np.ndarray:
        return self.low + self._spread(shares) * (self.high - self.low)


@eqx.filter_jit
def _columns(system: System, inputs: Array, start: Start, few: int) -> Array:
    return start_columns(system, inputs, start, few)


@eqx.filter_jit
def _fitted_run(
    system: System, inputs: Array, outputs: Array, counted: Array, start: Start
) -> tuple[Array, Array, Array]:
    """Return the run [samples, p] from ``start``, the zeros, and the variance left."""
    run = run_after(system, inputs, start.levels).reshape(outputs.shape)
    columns = start_columns(system, inputs, start)
    amounts = most_likely(columns, outputs - run, counted, start.variance)
    run = run + jnp.einsum("ksp,k->sp", columns, amounts)
    left = counted[:, None] * (outputs - run)
    variance = jnp.sum(left**2) / (jnp.sum(counted) * outputs.shape[1])
    return run, amounts[: outputs.shape[1]], variance


def start_of(
    system: System,
    inputs: np.ndarray,
    outputs: np.ndarray,
    part: slice,
    ranges: np.ndarray,
    estimates: int = 0,
) -> tuple[Start, np.ndarray, np.ndarray]:
    """Return the start of a record, the run from it [samples, p], and the zeros [p].

    The start is estimated on the samples ``part``. The arguments are those of
    ``levels_before``.

    The errors of a model are slow. If each sample counts, the linear states take up
    those of ``part``, and the zero is wrong for the rest of the record. So further
    ``estimates`` count as many errors as were independent after the one before.
    """
    of = system, inputs, outputs, part, ranges
    found = start_after(*of, levels_before(*of))
    for _ in range(estimates):
        errors = (outputs.reshape(found[1].shape) - found[1])[part]
        samples = errors.size / independent(errors)
        found = start_after(*of, levels_before(*of, samples), samples)
    return found


def start_after(
    system: System,
    inputs: np.ndarray,
    outputs: np.ndarray,
    part: slice,
    ranges: np.ndarray,
    levels: np.ndarray,
    samples: float = 1.0,
) -> tuple[Start, np.ndarray, np.ndarray]:
    """Return what ``start_of`` does, for known ``levels`` [TURNS, m]."""
    y = outputs.reshape(len(outputs), -1)
    counted = np.zeros(len(y))
    counted[part] = 1.0
    u, z, of = (jnp.asarray(each) for each in (inputs, y, counted))

    def started(variance: Any) -> Start:
        variance = jnp.asarray(samples * variance)
        return Start(jnp.asarray(levels), jnp.asarray(ranges), variance)

    start = started(np.mean(np.var(y[part], axis=0)))
    for _ in range(REFINEMENTS):
        *_, variance = _fitted_run(system, u, z, of, start)
        start = started(variance)
    run, zero, _ = _fitted_run(system, u, z, of, start)
    return start, np.asarray(run), np.asarray(zero)
