"""Descents raced against each other: all set out, the better half goes on."""

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
import numpy as np

from .._types import as_array
from ..progress import Progress
from .clock import Clock
from .gauss_newton import LANES, Descent, lanes_of, slopes_of, spacing

LAP = 3
"""Steps after which the worse half of the descents is dropped."""


class Programs:
    """What the race runs, compiled side by side: points, and a point's derivatives."""

    def __init__(self, objective: Any, size: int, every: int, clock: Clock):
        self._objective, self._clock = objective, clock
        points = as_array(np.zeros((LANES, size)))
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

    def losses(self, points: np.ndarray) -> np.ndarray:
        """Return the loss of any number of points."""
        filler = np.repeat(points[-1:], -len(points) % LANES, axis=0)
        batches = np.concatenate([points, filler]).reshape(-1, LANES, points.shape[1])
        found = [np.asarray(self.lanes(batch).losses) for batch in batches]
        return np.concatenate(found)[: len(points)]

    def lanes(self, units: np.ndarray):
        """Return losses and errors of ``LANES`` points."""
        return self._lanes(self._objective, as_array(units))

    def slopes(self, unit: np.ndarray):
        """Return the derivatives at a point."""
        return self._slopes.result()(self._objective, as_array(unit))

    def wait(self) -> None:
        """Wait until all is compiled."""
        self._clock.waited(self._slopes)
        self._pool.shutdown()


def programs_for(objective: Any, size: int, clock: Clock) -> Programs:
    """Return the programs of an Objective with ``size`` parameters."""
    signals = objective.signals
    runs = len(signals.traces) or signals.references.shape[0]
    plants = (
        1 if objective.plants is None else jax.tree.leaves(objective.plants)[0].shape[0]
    )
    counted = signals.references.shape[1] - objective.start
    every = spacing(runs * signals.noise.shape[1] * plants, counted)
    return Programs(objective, size, every, clock)


def race(
    programs: Programs,
    points: np.ndarray,
    losses: np.ndarray,
    *,
    steps: int,
    tolerance: float,
    progress: Progress,
    after: Callable[[list[Descent], int], None],
) -> bool:
    """Descend from ``points`` and return whether the last descent came to its end.

    ``after(descents, evaluations)`` is called after each step of those still in the
    race, with all of them.
    """
    every_one = [
        Descent(point, float(loss), programs.slopes, programs.lanes, tolerance)
        for point, loss in zip(points, losses, strict=True)
    ]
    running = every_one
    # A simulation keeps one processor busy and lets go of Python's lock.
    with ThreadPoolExecutor(min(len(running), os.cpu_count() or 1)) as pool:
        for step in range(1, steps + 1):
            moving = [descent for descent in running if not descent.done]
            after(every_one, sum(pool.map(Descent.step, moving)))
            progress.advance(min(descent.loss for descent in every_one))
            if all(descent.done for descent in running):
                return True
            if step % LAP == 0:
                running = halved(running)
    return False


def halved(descents: list[Descent]) -> list[Descent]:
    """Return the better half of ``descents``, rounded up."""
    ranked = sorted(descents, key=lambda descent: descent.loss)
    return ranked[: (len(ranked) + 1) // 2]
