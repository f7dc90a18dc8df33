"""What a search has found so far, and how points are ranked."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ..solve.history import Course
from .constraints import TOLERANCE
from .objective import HOPELESS, Verdict
from .result import Status

MISSED = 0.5 * HOPELESS
"""Rank from which on a point misses a limit."""


@dataclass
class Search:
    """The best point found so far, in [0, 1]^n, and how it was found.

    ``loss`` is its objective, ``violation`` by how much it misses the limit it misses
    most. ``history`` holds the lowest loss of each start after each step, None while it
    diverges or misses a limit; ``course`` the best of all with its time; ``starts`` the
    points descended from.
    """

    unit: np.ndarray
    loss: float = np.inf
    violation: float = 0.0
    status: Status = "step limit"
    evaluations: int = 0
    history: list[list[float | None]] = field(default_factory=list)
    course: Course = field(default_factory=Course)
    starts: np.ndarray = field(default_factory=lambda: np.empty((0, 0)))
    warnings: list[str] = field(default_factory=list)

    @property
    def times_s(self) -> list[float]:
        """Seconds from the begin of the search to each step of the history."""
        return self.course.times_s[len(self.course.times_s) - len(self.history) :]

    def offer(
        self, units: np.ndarray, verdict: Verdict, evaluations: int | None = None
    ) -> None:
        """Take the best of ``units`` if it beats what is there.

        A point that keeps the limits beats any that does not; of those that do not,
        the one that misses them least is the best. It took so many evaluations; one
        each, if not said.
        """
        rank = ranked(verdict.loss, verdict.violation)
        leader = int(np.argmin(rank))
        taken = len(rank) if evaluations is None else evaluations
        self.evaluations += taken
        best = float(rank[leader])
        self.course.add(taken, best if best < MISSED else np.inf)
        if best < ranked(self.loss, self.violation):
            self.loss = float(verdict.loss[leader])
            self.violation = float(verdict.violation[leader])
            self.unit = units[leader]

    def record(self, verdict: Verdict, places: np.ndarray) -> None:
        """Add a step to the history: points at ``places`` among the starts."""
        last = self.history[-1] if self.history else [None] * len(self.starts)
        row = list(last)
        rank = ranked(verdict.loss, verdict.violation)
        for place, value in zip(places, rank, strict=True):
            before = row[place]
            if value < MISSED and (before is None or value < before):
                row[place] = float(value)
        self.history.append(row)


def ranked(loss: Any, violation: Any) -> np.ndarray:
    """Return the loss where limits are kept, else a number above every such loss."""
    loss, violation = np.asarray(loss), np.asarray(violation)
    loss = np.where(np.isfinite(loss), loss, np.inf)
    missed = MISSED + np.minimum(violation, MISSED - 1.0)
    return np.where((violation <= TOLERANCE) | (loss >= HOPELESS), loss, missed)
