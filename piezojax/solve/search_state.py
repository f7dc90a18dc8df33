"""State of a search: its best point so far, and the rank of points."""

from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from .history import History
from .problem import FAILED_LOSS, TOLERANCE, Verdict

Status = Literal["converged", "step limit", "interrupted"]

VIOLATED = 0.5 * FAILED_LOSS
"""Least rank of a point that violates a constraint."""


@dataclass
class SearchState:
    """Best point of a search so far, in [0, 1]^n, and its history.

    ``loss`` is its objective, ``violation`` its largest violation of a constraint.
    ``losses_by_start`` holds the lowest loss of each of the ``starts`` after each step,
    None before its first point that is finite and satisfies the constraints;
    ``history`` holds the best loss of all starts against time.
    """

    unit: np.ndarray
    loss: float = np.inf
    violation: float = 0.0
    status: Status = "step limit"
    evaluations: int = 0
    losses_by_start: list[list[float | None]] = field(default_factory=list)
    history: History = field(default_factory=History)
    starts: np.ndarray = field(default_factory=lambda: np.empty((0, 0)))
    warnings: list[str] = field(default_factory=list)

    @property
    def times_s(self) -> list[float]:
        """Seconds from the start of the search to the end of each step."""
        times = self.history.times_s
        return times[len(times) - len(self.losses_by_start) :]

    @property
    def rank(self) -> float:
        """Rank of the best point: its loss, or a larger number if it violates."""
        return float(_rank(self.loss, self.violation))

    def update_best(
        self, units: np.ndarray, verdict: Verdict, evaluations: int | None = None
    ) -> None:
        """Take the best of ``units`` if it is better than the best point so far.

        A point that satisfies the constraints is better than any point that violates
        one; among the latter, the least violation is best. ``evaluations`` is the
        number of evaluations used, by default one per point.
        """
        ranks = rank(verdict)
        leader = int(np.argmin(ranks))
        taken = len(ranks) if evaluations is None else evaluations
        self.evaluations += taken
        best = float(ranks[leader])
        self.history.add(taken, best if best < VIOLATED else np.inf)
        if best < self.rank:
            self.loss = float(verdict.loss[leader])
            self.violation = float(verdict.violation[leader])
            self.unit = units[leader]

    def add_step(self, verdict: Verdict, places: np.ndarray) -> None:
        """Append a step to ``losses_by_start``, for the starts at ``places``."""
        last = self.losses_by_start[-1:] or [[None] * len(self.starts)]
        row = list(last[0])
        for place, value in zip(places, rank(verdict), strict=True):
            before = row[place]
            if value < VIOLATED and (before is None or value < before):
                row[place] = float(value)
        self.losses_by_start.append(row)


def rank(verdict: Verdict) -> np.ndarray:
    """Return the loss, or a larger number if a constraint is violated."""
    return _rank(np.asarray(verdict.loss), verdict.violation)


def _rank(loss: np.ndarray | float, violation: np.ndarray | float) -> np.ndarray:
    loss = np.where(np.isfinite(loss), loss, np.inf)
    violated = VIOLATED + np.minimum(violation, VIOLATED - 1.0)
    return np.where((violation <= TOLERANCE) | (loss >= FAILED_LOSS), loss, violated)
