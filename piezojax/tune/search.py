"""The search: screen the box, then descend from the best starts, all at once."""

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.stats import qmc

from .._types import as_array
from ..optimisers import METHODS, View
from ..progress import Progress
from ..rollout import BLOCK, in_blocks
from ..study import Case
from .constraints import TOLERANCE, updated
from .objective import HOPELESS, PENALTY, Objective, Verdict, with_finite_gradient
from .result import Status

STALL_STEPS, STALL_GAIN = 20, 1e-3
"""Stop when the best start gained less than this in so many steps."""

ROUNDS, GROWTH = 5, 3.0
"""Rounds of the augmented Lagrangian, and how the penalty grows from one to the
next."""

FORWARD_BELOW, FORWARD_BELOW_WITH_AXES = 5, 64
"""Fewer parameters than this are differentiated in forward mode: with several axes the
reverse pass takes minutes to compile, three times as long."""


class Clock:
    """Wall time since it was made, and how much of it went into compiling (s)."""

    def __init__(self):
        self._began = time.perf_counter()
        self.compile_s = 0.0

    def compiled(self, function: Callable, *arguments: Any) -> Callable:
        """Return ``function`` compiled for ``arguments``, its time counted."""
        start = time.perf_counter()
        program = jax.jit(function).lower(*arguments).compile()
        self.compile_s += time.perf_counter() - start
        return program

    def wall_s(self) -> float:
        """Return the seconds since the start."""
        return time.perf_counter() - self._began


@dataclass
class Search:
    """The best point found so far, in [0, 1]^n, and how it was found.

    ``loss`` is its objective, ``violation`` by how much it misses the limit it misses
    most. ``history`` holds the lowest loss of each start after each step, None while it
    diverges or misses a limit.
    """

    unit: np.ndarray
    loss: float = np.inf
    violation: float = 0.0
    status: Status = "step limit"
    evaluations: int = 0
    history: list[list[float | None]] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)

    def offer(self, units: np.ndarray, verdict: Verdict) -> None:
        """Take the best of ``units`` if it beats what is there.

        A point that keeps the limits beats any that does not; of those that do not,
        the one that misses them least is the best.
        """
        rank = _rank(verdict.loss, verdict.violation)
        leader = int(np.argmin(rank))
        if rank[leader] < _rank(self.loss, self.violation):
            self.loss = float(verdict.loss[leader])
            self.violation = float(verdict.violation[leader])
            self.unit = units[leader]


def _rank(loss: Any, violation: Any) -> np.ndarray:
    """Return the loss where limits are kept, else a number above every such loss."""
    loss, violation = np.asarray(loss), np.asarray(violation)
    missed = 0.5 * HOPELESS + violation
    return np.where((violation <= TOLERANCE) | (loss >= HOPELESS), loss, missed)


def search_box(
    objective: Objective, case: Case, clock: Clock, progress: Progress
) -> Search:
    """Return the best point of the case's box.

    ``Ctrl-C`` ends the search with the best point so far. Raises ValueError when the
    loop diverges at every point tried.
    """
    own, table = np.asarray(case.space.start(case.loop)), case.study.optimiser
    search = Search(own)
    try:
        points = np.concatenate([own[None], _candidates(case)])
        losses, verdict = _screen(objective, points, clock, progress)
        search.evaluations += losses.size
        chosen = _starts(losses, table.starts, search)
        search.offer(points, verdict)
        programs = compiled(objective, len(chosen), case, clock, progress)
        descend(programs, objective, points[chosen], search, table.steps, progress)
    except KeyboardInterrupt:
        search.status = "interrupted"
    return search


def _candidates(case: Case) -> np.ndarray:
    table, size = case.study.optimiser, len(case.space.paths)
    count = max(table.candidates, table.starts - 1)
    sampler = qmc.Sobol(size, rng=np.random.default_rng(case.study.seed))
    # Sobol points are balanced in powers of two.
    return sampler.random_base2(int(np.ceil(np.log2(max(count, 1)))))[:count]


def _screen(
    objective: Objective, points: np.ndarray, clock: Clock, progress: Progress
) -> tuple[np.ndarray, Verdict]:
    """Return loss and verdict of every point."""
    progress.stage(f"screening {len(points)} points of the box")
    at_once = max(1, BLOCK // objective.lanes)
    program = clock.compiled(
        lambda objective, units: in_blocks(
            lambda unit: objective.both(unit), units, size=at_once
        ),
        objective,
        as_array(points),
    )
    found = program(objective, as_array(points))
    return jax.tree.map(np.asarray, found)


def _starts(losses: np.ndarray, count: int, search: Search) -> np.ndarray:
    """Choose the study's own start and the best candidates, none that diverges."""
    stable = losses < HOPELESS
    if not stable.any():
        raise ValueError(
            f"the loop diverges or rails at the start and all {losses.size - 1} points "
            "tried in the box: lower the bounds of the gains, raise 'candidates', or "
            "check the plant's sign and sample rate"
        )
    if not stable[0]:
        search.warnings.append(
            "the study's own start diverges or rails; tuning began from the best of "
            f"{losses.size - 1} other points of the box instead"
        )
    best = 1 + np.argsort(losses[1:], kind="stable")
    ranked = np.concatenate([[0], best])
    return ranked[stable[ranked]][:count]


def descend(
    programs: "Programs",
    objective: Objective,
    starts: np.ndarray,
    search: Search,
    steps: int,
    progress: Progress,
) -> None:
    """Improve ``search`` from ``starts``, all at once, by up to ``steps`` steps.

    Limits are kept by an augmented Lagrangian: rounds of minimisation, each start with
    multipliers of its own that are raised after the round for what it violates.
    """
    units = as_array(starts)
    rounds = ROUNDS if objective.limits else 1
    progress.stage(f"tuning from {len(starts)} starts", steps)
    multipliers = programs.multipliers
    for number in range(rounds):
        share = -(-steps // rounds)
        objective = objective.with_penalty(PENALTY * GROWTH**number)
        carry = programs.begin(objective, units, multipliers)
        bests: list[float] = []
        for _ in range(share):
            carry, view, verdict = programs.advance(objective, carry, multipliers)
            units = view.unit
            view, verdict = jax.tree.map(np.asarray, (view, verdict))
            search.evaluations += len(starts)
            _record(search, view, verdict)
            bests.append(float(np.min(view.loss)))
            progress.advance(search.loss)
            if np.all(view.done) or _stalled(bests):
                if number + 1 == rounds:
                    search.status = "converged"
                break
        if number + 1 < rounds:
            multipliers = programs.raised(objective, units, multipliers)


def _record(search: Search, view: View, verdict: Verdict) -> None:
    rank = _rank(verdict.loss, verdict.violation)
    kept = [float(x) if x < 0.5 * HOPELESS else np.inf for x in rank]
    last = search.history[-1] if search.history else [None] * len(kept)
    lowest = [
        min(new, np.inf if old is None else old)
        for new, old in zip(kept, last, strict=True)
    ]
    search.history.append([x if np.isfinite(x) else None for x in lowest])
    search.offer(np.asarray(view.unit), verdict)


class Programs(NamedTuple):
    """What a descent runs, compiled, and the multipliers it begins with."""

    begin: Callable
    advance: Callable
    raised: Callable
    multipliers: jax.Array


def compiled(
    objective: Objective,
    starts: int,
    case: Case,
    clock: Clock,
    progress: Progress,
) -> Programs:
    """Return the programs of a descent from so many starts."""
    table = case.study.optimiser
    below = FORWARD_BELOW_WITH_AXES if case.study.axes else FORWARD_BELOW
    forward = len(case.space.paths) < below

    def optimiser(objective, multipliers):
        objective = objective.with_multipliers(multipliers)
        # A lambda, because a bound method would be hashed with its arrays.
        loss = with_finite_gradient(lambda u: objective.loss(u), forward=forward)
        return METHODS[table.method](
            loss, lambda u: objective.residuals(u), table.tolerance
        )

    def begin(objective, units, multipliers):
        return jax.vmap(lambda u, m: optimiser(objective, m).start(u))(
            units, multipliers
        )

    def advance(objective, carry, multipliers):
        def one(carry, multipliers):
            solver = optimiser(objective, multipliers)
            carry = solver.step(carry)
            view = solver.view(carry)
            if objective.limits:
                return carry, view, objective.verdict(view.unit)
            return carry, view, Verdict(view.loss, jnp.zeros(()))

        return jax.vmap(one)(carry, multipliers)

    def raised(objective, units, multipliers):
        found = jax.vmap(lambda unit: objective.violated(unit))(units)
        return updated(found, multipliers, objective.penalty)

    progress.stage("compiling the gradient")
    units = jnp.full((starts, len(case.space.paths)), 0.5)
    count = jax.eval_shape(lambda o: o.violated(units[0]), objective).shape[0]
    multipliers = jnp.zeros((starts, count))
    start = clock.compiled(begin, objective, units, multipliers)
    carry = jax.eval_shape(begin, objective, units, multipliers)
    return Programs(
        start,
        clock.compiled(advance, objective, carry, multipliers),
        clock.compiled(raised, objective, units, multipliers) if count else start,
        multipliers,
    )


def _stalled(bests: list[float]) -> bool:
    return len(bests) > STALL_STEPS and bests[-1 - STALL_STEPS] - bests[-1] < STALL_GAIN
