"""Successive halving: every few steps the worse half of the descents is dropped."""

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

import jax
import numpy as np
from jaxtyping import Array

from ..core.arrays import as_array
from ..core.progress import Progress
from .augmented_lagrangian import with_zero_multipliers
from .clock import Clock
from .gauss_newton import PARALLEL, Descent, GaussNewton
from .local_model import UNIT_BOX
from .multi_start import Patience, in_batches
from .problem import Problem, Verdict
from .sampled_errors import derivatives_at, errors_at, local_model, trials_of

R = TypeVar("R")

HALVING_STEPS = 3
"""Number of steps after which the worse half of the descents is dropped."""

PATIENCE = 5
"""Number of steps in which a descent must gain its tolerance."""

POINTS = len(PARALLEL.multiples)
"""Points evaluated at once."""


def better_half(step: int, running: int) -> int | None:
    """Return the number of descents kept: half, rounded up, every HALVING_STEPS."""
    return (running + 1) // 2 if step % HALVING_STEPS == 0 else None


def in_threads(function: Callable[[np.ndarray], R]) -> Callable[[np.ndarray], list[R]]:
    """Return a function that calls ``function`` with each row, in parallel threads.

    An evaluation uses one processor and releases the interpreter lock.
    """

    def of_all(rows: np.ndarray) -> list[R]:
        with ThreadPoolExecutor(os.cpu_count() or 1) as pool:
            return list(pool.map(function, rows))

    return of_all


class SuccessiveHalving:
    """Gauss-Newton descents on ``problem``; every few steps the worse half is dropped.

    The curvature is computed from every ``every``-th error. A descent ends when it
    gains less than ``tolerance`` in PATIENCE steps. ``size`` is the number of unknowns.
    After the first round of an augmented Lagrangian only the best descent continues.
    """

    cut = staticmethod(better_half)
    patience = None
    finalists = 1

    def __init__(
        self, problem: Problem, size: int, clock: Clock, *, tolerance: float, every: int
    ):
        self._problem = problem = with_zero_multipliers(problem)
        self._clock, self._patience = clock, Patience(PATIENCE, gain=tolerance)
        units = as_array(np.zeros((POINTS, size)))
        # The derivatives compile in the background, while the box is screened.
        self._pool = ThreadPoolExecutor(1)
        self._derivatives = self._pool.submit(
            lambda: derivatives_at.lower(problem, units[0], every).compile()
        )
        self._errors = clock.compiled(errors_at, problem, units, every)

    @property
    def constraints(self) -> int:
        """Number of constraints, each with a multiplier."""
        return self._problem.multipliers.size

    def screen(self, problem: Problem, units: np.ndarray) -> tuple[np.ndarray, Verdict]:
        """Return loss, without multipliers, and verdict of any number of points."""
        problem = problem.with_multipliers(self._problem.multipliers)
        return self._screened(problem, units)

    def _screened(
        self, problem: Problem, units: np.ndarray
    ) -> tuple[np.ndarray, Verdict]:
        points = in_batches(lambda batch: self._errors(problem, batch), units, POINTS)
        return points.loss, points.verdict

    def wait(self) -> None:
        """Wait until the derivatives are compiled."""
        self._clock.wait_for(self._derivatives)
        self._pool.shutdown()

    def prepare(self, starts: int, progress: Progress) -> None:
        """Do nothing: no program depends on the number of starts."""
        del starts, progress

    def begin(
        self, problem: Problem, units: np.ndarray, multipliers: Array
    ) -> tuple[GaussNewton, int]:
        """Return descents from ``units``, and the number of evaluations used."""
        # Multipliers are 0 in the first round; later there is only one descent.
        problem = problem.with_multipliers(multipliers[0])
        losses, verdicts = self._screened(problem, units)

        def linearise(unit):
            derivatives = self._derivatives.result()
            return local_model(unit, derivatives(problem, as_array(unit)))

        def evaluate(units):
            return trials_of(self._errors(problem, as_array(units)))

        descents = [
            Descent(
                unit,
                PARALLEL,
                UNIT_BOX,
                self._patience,
                loss=float(losses[i]),
                verdict=jax.tree.map(lambda x, i=i: x[i], verdicts),
            )
            for i, unit in enumerate(units)
        ]
        group = GaussNewton(descents, in_threads(evaluate), in_threads(linearise))
        return group, len(descents)
