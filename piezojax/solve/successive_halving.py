"""Successive halving: every few steps the worse half of the descents is dropped."""

from concurrent.futures import ThreadPoolExecutor

import jax
import numpy as np
from jaxtyping import Array

from ..core.arrays import as_array
from ..core.progress import Progress
from .augmented_lagrangian import with_zero_multipliers
from .clock import Clock, compiled
from .gauss_newton import PARALLEL, Descent, GaussNewton, Trials
from .local_model import UNIT_BOX, LocalModel
from .multi_start import Abreast, Patience, in_batches, in_threads
from .problem import Errors, Problem, Verdict
from .sampled_errors import derivatives_at, errors_at, local_model, trials_of

HALVING_STEPS = 10
"""Number of steps after which the worse half of the descents is dropped. After
fewer steps the loss does not tell which valley has the lowest constrained minimum."""

FINALISTS = 2
"""Number of descents that are never dropped. The constraints are loose in the first
round of an augmented Lagrangian; its best valley may not be the best with them."""

PATIENCE = 5
"""Number of steps in which a descent must gain its tolerance."""

LANES = 32
"""Wanted number of runs in one program, because fewer take as long."""


def better_half(step: int, running: int) -> int | None:
    """Return the number of descents kept, None for all.

    Every HALVING_STEPS it is half, rounded up, but at least FINALISTS.
    """
    halved = max((running + 1) // 2, FINALISTS)
    return halved if step % HALVING_STEPS == 0 and halved < running else None


class SuccessiveHalving:
    """Gauss-Newton descents on ``problem``; every few steps the worse half is dropped.

    The curvature is computed from every ``every``-th error. A descent ends when it
    gains less than ``tolerance`` in PATIENCE steps. ``size`` is the number of unknowns,
    ``lanes`` the number of runs at a point. A program evaluates the points that give
    LANES runs, but at most the points of one attempt; several programs run in parallel.
    After the first round of an augmented Lagrangian the best FINALISTS continue.
    """

    cut = staticmethod(better_half)
    patience = None
    finalists = FINALISTS

    def __init__(
        self,
        problem: Problem,
        size: int,
        clock: Clock,
        *,
        lanes: int,
        tolerance: float,
        every: int,
    ):
        self._problem = problem = with_zero_multipliers(problem)
        self._clock, self._patience = clock, Patience(PATIENCE, gain=tolerance)
        self._width = min(-(-LANES // lanes), len(PARALLEL.multiples))
        units = as_array(np.zeros((self._width, size)))
        # The derivatives compile in the background, while the box is screened.
        self._pool = ThreadPoolExecutor(1)
        self._derivatives = self._pool.submit(
            compiled, derivatives_at, problem, units[0], every
        )
        self._errors = clock.compiled(errors_at, problem, units, every)

    @property
    def constraints(self) -> int:
        """Number of constraints, each with a multiplier."""
        return self._problem.multipliers.size

    def screen(self, problem: Problem, units: np.ndarray) -> tuple[np.ndarray, Verdict]:
        """Return loss, without multipliers, and verdict of any number of points."""
        problem = problem.with_multipliers(self._problem.multipliers)
        points = self._errors_at(problem, units)
        return np.asarray(points.loss), points.verdict

    def _errors_at(self, problem: Problem, units: np.ndarray) -> Errors:
        def program(batch: Array) -> Errors:
            return self._errors(problem, batch)

        return in_batches(program, units, self._width, in_threads)

    def wait(self) -> None:
        """Wait until the derivatives are compiled."""
        self._clock.wait_for(self._derivatives)
        self._pool.shutdown()

    def prepare(self, starts: int, progress: Progress) -> None:
        """Do nothing: no program depends on the number of starts."""
        del starts, progress

    def begin(
        self, problem: Problem, units: np.ndarray, multipliers: Array
    ) -> tuple[Abreast, int]:
        """Return descents from ``units``, and the number of evaluations used."""
        pairs = zip(units, multipliers, strict=True)
        every = in_threads(lambda pair: self._descent(problem, *pair), pairs)
        return Abreast(every), len(every)

    def _descent(
        self, problem: Problem, unit: np.ndarray, multipliers: Array
    ) -> GaussNewton:
        """Return the descent from ``unit`` with its own ``multipliers``."""
        problem = problem.with_multipliers(multipliers)
        here = trials_of(self._errors_at(problem, unit[None]))

        def linearise(units: np.ndarray) -> list[LocalModel | None]:
            derivatives = self._derivatives.result()
            return [local_model(u, derivatives(problem, as_array(u))) for u in units]

        def evaluate(points: np.ndarray) -> list[Trials]:
            return [trials_of(self._errors_at(problem, each)) for each in points]

        descent = Descent(
            unit,
            PARALLEL,
            UNIT_BOX,
            self._patience,
            loss=float(here.losses[0]),
            verdict=jax.tree.map(lambda x: x[0], here.verdicts),
        )
        return GaussNewton([descent], evaluate, linearise)
