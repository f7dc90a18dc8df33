"""Multi-start: descents from many starts; a Cut may drop the worse ones.

One loop, ``descend``, advances all Descents: those of ``GaussNewton`` and those of an
Optimiser (``BatchedDescents``). ``minimise`` adds the rounds of the augmented
Lagrangian; its strategies are ``successive_halving`` and ``lockstep``.
"""

import os
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any, NamedTuple, Protocol, TypeVar, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..core.arrays import as_array
from ..core.progress import Progress
from .augmented_lagrangian import rounds, update_multipliers
from .optimisers import View
from .problem import TOLERANCE, Problem, Verdict
from .search_state import SearchState

T = TypeVar("T")
R = TypeVar("R")

Cut = Callable[[int, int], int | None]
"""``cut(step, running)`` returns the number of descents kept after a step, or None to
keep all."""


class Patience(NamedTuple):
    """Stopping rule: a descent ends if it gains too little in ``steps`` steps.

    The gain is too small if it is below ``gain`` plus ``share`` times the loss before
    these steps.
    """

    steps: int
    gain: float = 0.0
    share: float = 0.0

    def exhausted(self, losses: Sequence[float]) -> bool:
        """Return whether ``losses``, one per step, have improved too little."""
        if len(losses) <= self.steps:
            return False
        before = losses[-1 - self.steps]
        return before - losses[-1] < self.gain + self.share * abs(before)


class DescentStatus(NamedTuple):
    """State of the running descents, one entry each, and the evaluations of a step.

    ``places`` are their indices among the starts.
    """

    units: np.ndarray
    losses: np.ndarray
    verdict: Verdict
    done: np.ndarray
    places: np.ndarray
    evaluations: int


@runtime_checkable
class Descents(Protocol):
    """Descents from several starts that advance side by side."""

    def advance(self) -> DescentStatus:
        """Move every descent by one step; return their status."""
        ...

    def keep(self, rows: np.ndarray) -> None:
        """Keep only the descents at ``rows`` of the last DescentStatus."""
        ...


def descend(
    descents: Descents,
    steps: int,
    watch: Callable[[DescentStatus], None],
    *,
    cut: Cut | None = None,
    patience: Patience | None = None,
) -> tuple[DescentStatus, bool]:
    """Advance ``descents`` by at least one and at most ``steps`` steps.

    The loop ends when all descents are done, or when ``patience`` with the best loss is
    exhausted; patience starts anew after each cut. ``watch`` receives the DescentStatus
    of every step. Returns the last DescentStatus, and whether the descents ended before
    the step limit.
    """
    step, bests = 0, []
    while True:
        step += 1
        status = descents.advance()
        watch(status)
        bests.append(float(np.min(status.losses)))
        if np.all(status.done) or (patience and patience.exhausted(bests)):
            return status, True
        if step >= steps:
            return status, False
        count = cut(step, len(status.losses)) if cut else None
        if count is not None:
            descents.keep(np.argsort(status.losses, kind="stable")[:count])
            bests = []


def in_threads(function: Callable[[T], R], items: Iterable[T]) -> list[R]:
    """Return ``function`` of each of ``items``, computed in parallel threads.

    A compiled program uses one processor and releases the interpreter lock.
    """
    with ThreadPoolExecutor(os.cpu_count() or 1) as pool:
        return list(pool.map(function, items))


def in_batches(
    program: Callable[[Any], Any],
    points: Any,
    width: int,
    each: Callable[[Callable, Iterable], Iterable] = map,
) -> Any:
    """Call ``program``, which takes ``width`` points, on any number of points.

    Leaves of the points and of the result have a leading axis for the points. Copies of
    the last point fill the last batch. ``each`` calls a function with every batch:
    ``map``, or ``in_threads`` if the memory suffices for several at once.
    """
    count = len(jax.tree.leaves(points)[0])
    rows = np.minimum(np.arange(-(-count // width) * width), count - 1)
    results = each(partial(_on_batch, program, points), rows.reshape(-1, width))
    return jax.tree.map(lambda *parts: np.concatenate(parts)[:count], *results)


def rows_of(points: Any, rows: np.ndarray) -> Any:
    """Return the ``rows`` of every leaf. (Rows of a JAX array would be a program.)"""
    return jax.tree.map(lambda x: as_array(np.asarray(x)[rows]), points)


def _on_batch(program: Callable[[Any], Any], points: Any, batch: np.ndarray) -> Any:
    return program(rows_of(points, batch))


class BatchedDescents:
    """Descents of an Optimiser that advance in one compiled program.

    ``advance(carry)`` returns the next carry, Views and Verdicts of all descents;
    ``carry`` is the carry before the first step.
    """

    def __init__(
        self,
        advance: Callable[[Any], tuple[Any, View, Verdict]],
        carry: Any,
        starts: int,
    ):
        self._advance, self._carry, self._places = advance, carry, np.arange(starts)

    def advance(self) -> DescentStatus:
        """Move every descent by one step; return their status."""
        self._carry, *rest = self._advance(self._carry)
        view, verdict = jax.tree.map(np.asarray, rest)
        return DescentStatus(
            view.unit, view.loss, verdict, view.done, self._places, len(view.loss)
        )

    def keep(self, rows: np.ndarray) -> None:
        """Keep only the descents at ``rows`` of the last DescentStatus.

        The program has a fixed number of descents, so the first of ``rows`` are
        repeated.
        """
        rows = np.resize(rows, len(self._places))
        self._places = self._places[rows]
        self._carry = jax.tree.map(lambda leaf: leaf[rows], self._carry)


class Abreast:
    """Descents, each with its own problem, that advance in parallel threads.

    Each of ``descents`` has one start.
    """

    def __init__(self, descents: Sequence[Descents]):
        self._descents, self._places = list(descents), np.arange(len(descents))

    def advance(self) -> DescentStatus:
        """Move every descent by one step; return their status."""
        every = in_threads(lambda descent: descent.advance(), self._descents)
        units, losses, verdict, done, _, taken = zip(*every, strict=True)
        return DescentStatus(
            np.concatenate(units),
            np.concatenate(losses),
            jax.tree.map(lambda *parts: np.concatenate(parts), *verdict),
            np.concatenate(done),
            self._places,
            sum(taken),
        )

    def keep(self, rows: np.ndarray) -> None:
        """Keep only the descents at ``rows`` of the last DescentStatus."""
        self._descents = [self._descents[row] for row in rows]
        self._places = self._places[rows]


@runtime_checkable
class Strategy(Protocol):
    """Strategy to minimise a Problem from many starts, with its compiled programs.

    Rounds are those of the augmented Lagrangian.
    """

    @property
    def cut(self) -> Cut | None:
        """Cut of the descents within a round."""
        ...

    @property
    def patience(self) -> Patience | None:
        """Patience with the best descent."""
        ...

    @property
    def finalists(self) -> int | None:
        """Number of descents kept from round to round, or None for all."""
        ...

    @property
    def constraints(self) -> int:
        """Number of constraints, each with a multiplier."""
        ...

    def screen(self, problem: Problem, units: np.ndarray) -> tuple[np.ndarray, Verdict]:
        """Return loss, without multipliers, and verdict of any number of points."""
        ...

    def wait(self) -> None:
        """Wait for the programs that compile in the background."""
        ...

    def prepare(self, starts: int, progress: Progress) -> None:
        """Compile the programs for descents from ``starts`` starts."""
        ...

    def begin(
        self, problem: Problem, units: np.ndarray, multipliers: Array
    ) -> tuple[Descents, int]:
        """Return descents from ``units``, and the number of evaluations used.

        ``multipliers`` [starts, constraints] are those of each descent.
        """
        ...


def minimise(
    strategy: Strategy,
    problem: Problem,
    starts: np.ndarray,
    state: SearchState,
    steps: int,
    progress: Progress,
) -> None:
    """Improve ``state`` from ``starts`` by up to ``steps`` steps.

    With constraints the rounds of the augmented Lagrangian share these steps; each
    round starts from the end of the previous one. A last point that violates a
    constraint is pulled back towards the best point.
    """
    strategy.prepare(len(starts), progress)
    progress.stage(f"tuning from {len(starts)} starts", steps)
    units, places = starts, np.arange(len(starts))
    multipliers = jnp.zeros((len(starts), strategy.constraints))
    for penalty, share, last in rounds(problem, steps):

        def watch(status: DescentStatus, places: np.ndarray = places) -> None:
            state.add_step(status.verdict, places[status.places])
            state.update_best(status.units, status.verdict, status.evaluations)
            progress.advance(state.loss)

        problem = problem.with_penalty(penalty)
        descents, evaluations = strategy.begin(problem, units, multipliers)
        state.evaluations += evaluations
        status, ended = descend(
            descents, share, watch, cut=strategy.cut, patience=strategy.patience
        )
        if last:
            state.status = "converged" if ended else state.status
            for end in status.units[status.verdict.violation > TOLERANCE]:
                _pull_back(strategy, problem, end, state)
        else:
            best = np.argsort(status.losses, kind="stable")[: strategy.finalists]
            multipliers = update_multipliers(
                as_array(status.verdict.violations[best]),
                multipliers[status.places[best]],
                as_array(penalty),
            )
            units, places = status.units[best], places[status.places[best]]


PULLS, SHARES = 2, np.linspace(0.125, 1.0, 8)
"""Number of passes over a segment, and the points tried, as shares of its length."""


def _pull_back(
    strategy: Strategy, problem: Problem, end: np.ndarray, state: SearchState
) -> None:
    """Search the segment from the best point to ``end``, which violates a constraint.

    The augmented Lagrangian approaches an active constraint from both sides, and its
    last points may miss it by more than the tolerance.
    """
    for _ in range(PULLS):
        points = state.unit + SHARES[:, None] * (end - state.unit)
        state.update_best(points, strategy.screen(problem, points)[1])
