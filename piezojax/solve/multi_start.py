"""Multi-start: descents from many starts; a Cut may drop the worse ones.

One loop, ``descend``, serves every search. Descents advance in one compiled program
(``BatchedDescents``) or in threads (``ThreadedDescents``). ``minimise`` adds the rounds
of the augmented Lagrangian; its strategies are ``successive_halving`` and ``lockstep``.
"""

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..core.arrays import as_array
from ..core.progress import Progress
from .augmented_lagrangian import rounds, updated
from .descent import Descent, Patience
from .optimisers import View
from .problem import Problem, Verdict
from .search_state import SearchState

Cut = Callable[[int, int], int | None]
"""``cut(step, running)`` returns the number of descents kept after a step, or None to
keep all."""


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

    The loop ends when all are done or ``patience`` with the best is exhausted, which
    restarts after each cut. ``watch`` receives the DescentStatus of every step. Returns
    the last DescentStatus, and whether the descents ended before the step limit.
    """
    step, bests = 0, []
    while True:
        step += 1
        standing = descents.advance()
        watch(standing)
        bests.append(float(np.min(standing.losses)))
        if np.all(standing.done) or (patience and patience.exhausted(bests)):
            return standing, True
        if step >= steps:
            return standing, False
        count = cut(step, len(standing.losses)) if cut else None
        if count is not None:
            descents.keep(np.argsort(standing.losses, kind="stable")[:count])
            bests = []


class BatchedDescents:
    """Descents of an Optimiser, up to ``width`` of them in one compiled program.

    ``begin(units)`` returns a carry, ``advance(carry)`` the next carry, Views and
    Verdicts, all of ``width`` descents.
    """

    def __init__(
        self,
        begin: Callable[[Any], Any],
        advance: Callable[[Any], tuple[Any, View, Verdict]],
        starts: np.ndarray,
        width: int,
    ):
        self._advance, self._width = advance, width
        self._places = _filled(np.arange(len(starts)), width)
        self._carries = [begin(as_array(starts[part])) for part in self._parts()]

    def _parts(self) -> np.ndarray:
        return self._places.reshape(-1, self._width)

    def advance(self) -> DescentStatus:
        """Move every descent by one step; return their status."""
        advanced = [self._advance(carry) for carry in self._carries]
        self._carries = [carry for carry, _, _ in advanced]
        view, verdict = jax.tree.map(
            lambda *parts: np.concatenate(parts), *(rest for _, *rest in advanced)
        )
        return DescentStatus(
            view.unit, view.loss, verdict, view.done, self._places, len(view.loss)
        )

    def keep(self, rows: np.ndarray) -> None:
        """Keep only the descents at ``rows`` of the last DescentStatus."""
        rows = _filled(rows, self._width)
        self._places = self._places[rows]
        every = jax.tree.map(lambda *parts: jnp.concatenate(parts), *self._carries)
        self._carries = [
            jax.tree.map(lambda leaf, part=part: leaf[part], every)
            for part in rows.reshape(-1, self._width)
        ]


def _filled(places: np.ndarray, width: int) -> np.ndarray:
    """Return ``places``, the first repeated up to a multiple of ``width``."""
    return np.resize(places, -(-len(places) // width) * width)


class ThreadedDescents:
    """Descents stepped from Python, each in its own thread.

    Threads run in parallel, because an evaluation uses one processor and releases the
    interpreter lock.
    """

    def __init__(self, descents: Sequence[Descent]):
        self._descents = list(descents)
        self._places = np.arange(len(descents))

    def advance(self) -> DescentStatus:
        """Move every descent by one step; return their status."""
        moving = [descent for descent in self._descents if not descent.done]
        with ThreadPoolExecutor(os.cpu_count() or 1) as pool:
            taken = sum(pool.map(Descent.step, moving))
        every = self._descents
        return DescentStatus(
            np.array([descent.unit for descent in every]),
            np.array([descent.loss for descent in every]),
            jax.tree.map(lambda *parts: np.stack(parts), *(d.verdict for d in every)),
            np.array([descent.done for descent in every]),
            self._places,
            taken,
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

    def screen(self, units: np.ndarray) -> tuple[np.ndarray, Verdict]:
        """Return loss and verdict of any number of points."""
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

    def violations(self, problem: Problem, units: np.ndarray) -> Array:
        """Return the violations [starts, constraints] at ``units``."""
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
    round starts from the end of the previous one.
    """
    strategy.prepare(len(starts), progress)
    progress.stage(f"tuning from {len(starts)} starts", steps)
    units, places = starts, np.arange(len(starts))
    multipliers = jnp.zeros((len(starts), strategy.constraints))
    for penalty, share, last in rounds(problem, steps):

        def watch(standing: DescentStatus, places: np.ndarray = places) -> None:
            state.add_step(standing.verdict, places[standing.places])
            state.update_best(standing.units, standing.verdict, standing.evaluations)
            progress.advance(state.loss)

        problem = problem.with_penalty(penalty)
        descents, evaluations = strategy.begin(problem, units, multipliers)
        state.evaluations += evaluations
        standing, ended = descend(
            descents, share, watch, cut=strategy.cut, patience=strategy.patience
        )
        if ended and last:
            state.status = "converged"
        if not last:
            best = np.argsort(standing.losses, kind="stable")[: strategy.finalists]
            units, best = standing.units[best], standing.places[best]
            places = places[best]
            multipliers = updated(
                strategy.violations(problem, units),
                multipliers[best],
                as_array(penalty),
            )
