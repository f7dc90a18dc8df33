"""Descents raced against each other: all set out, the better half goes on."""

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import jax
import numpy as np

from ..core.arrays import as_array
from ..core.progress import Progress
from ..solve.clock import Clock
from ..study import Case
from .constraints import updated
from .gauss_newton import LANES, Descent, lanes_of, slopes_of, spacing
from .lagrangian import prepared, rounds
from .objective import Objective, Verdict
from .search_state import Search

LAP = 3
"""Steps after which the worse half of the descents is dropped."""


class Race:
    """Descends by Gauss and Newton's method; starts that lag are dropped."""

    def __init__(self, objective: Objective, case: Case, clock: Clock):
        self.objective = objective = prepared(objective)
        self._clock, self._tolerance = clock, case.study.optimiser.tolerance
        counted = objective.signals.references.shape[1] - objective.start
        every = spacing(objective.lanes, counted)
        points = as_array(np.zeros((LANES, len(objective.space.paths))))
        # The derivatives take longer: meanwhile the box is screened.
        self._pool = ThreadPoolExecutor(1)
        self._slopes = self._pool.submit(
            lambda: (
                jax.jit(lambda o, unit: slopes_of(o, unit, every))
                .lower(objective, points[0])
                .compile()
            )
        )
        self._lanes = clock.compiled(
            lambda o, units: lanes_of(o, units, every), objective, points
        )
        # Without limits there is one round, and nothing is asked.
        self._violated: Callable = (
            clock.compiled(lambda o, unit: o.violated(unit), objective, points[0])
            if objective.limits
            else objective.violated
        )

    def losses(self, points: np.ndarray) -> tuple[np.ndarray, Verdict]:
        """Return loss and verdict of any number of points."""
        return self._looked(self.objective, points)

    def _looked(
        self, objective: Objective, points: np.ndarray
    ) -> tuple[np.ndarray, Verdict]:
        filler = np.repeat(points[-1:], -len(points) % LANES, axis=0)
        batches = np.concatenate([points, filler]).reshape(-1, LANES, points.shape[1])
        found = [self._lanes(objective, as_array(batch))[:2] for batch in batches]
        return jax.tree.map(lambda *parts: np.concatenate(parts)[: len(points)], *found)

    def wait(self) -> None:
        """Wait until all is compiled."""
        self._clock.waited(self._slopes)
        self._pool.shutdown()

    def descend(
        self,
        objective: Objective,
        starts: np.ndarray,
        search: Search,
        steps: int,
        progress: Progress,
    ) -> None:
        """Improve ``search`` from ``starts`` by up to ``steps`` steps.

        With limits the first round of the augmented Lagrangian is the race; the others
        go on from where that was won.
        """
        progress.stage(f"tuning from {len(starts)} starts", steps)
        multipliers = self.objective.multipliers
        units, places = starts, np.arange(len(starts))
        for penalty, share, last in rounds(objective, steps):
            objective = objective.with_penalty(penalty).with_multipliers(multipliers)
            descents = self._descents(objective, units)
            search.evaluations += len(descents)
            ended = self._run(descents, places, search, share, progress)
            if ended and last:
                search.status = "converged"
            if not last:
                best = min(range(len(descents)), key=lambda i: descents[i].loss)
                units, places = descents[best].unit[None], places[best : best + 1]
                found = self._violated(objective, as_array(units[0]))
                multipliers = updated(found, multipliers, as_array(penalty))

    def _descents(self, objective: Objective, units: np.ndarray) -> list[Descent]:
        def slopes(unit):
            return self._slopes.result()(objective, as_array(unit))

        def lanes(units):
            return self._lanes(objective, as_array(units))

        losses, verdicts = self._looked(objective, units)
        return [
            Descent(
                unit,
                float(losses[i]),
                jax.tree.map(lambda x, i=i: x[i], verdicts),
                slopes,
                lanes,
                self._tolerance,
            )
            for i, unit in enumerate(units)
        ]

    def _run(
        self,
        descents: list[Descent],
        places: np.ndarray,
        search: Search,
        steps: int,
        progress: Progress,
    ) -> bool:
        """Race ``descents`` and return whether the last came to its end."""
        running = descents
        # A simulation keeps one processor busy and lets go of Python's lock.
        with ThreadPoolExecutor(min(len(running), os.cpu_count() or 1)) as pool:
            for step in range(1, steps + 1):
                moving = [descent for descent in running if not descent.done]
                taken = sum(pool.map(Descent.step, moving))
                verdict = jax.tree.map(
                    lambda *parts: np.stack(parts), *(d.verdict for d in descents)
                )
                search.record(verdict, places)
                units = np.array([descent.unit for descent in descents])
                search.offer(units, verdict, taken)
                progress.advance(search.loss)
                if all(descent.done for descent in running):
                    return True
                if step % LAP == 0:
                    running = halved(running)
        return False


def halved(descents: list[Descent]) -> list[Descent]:
    """Return the better half of ``descents``, rounded up."""
    ordered = sorted(descents, key=lambda descent: descent.loss)
    return ordered[: (len(ordered) + 1) // 2]
