"""The search: screen the box, then descend from the best starts, all at once."""

from dataclasses import dataclass, field

import jax
import numpy as np
from scipy.stats import qmc

from .._types import as_array
from ..optimisers import GAUSS_NEWTON, METHODS
from ..progress import Progress
from ..rollout import BLOCK, in_blocks
from ..study import Case
from .clock import Clock
from .course import Course
from .gauss_newton import Descent
from .objective import HOPELESS, Objective, with_finite_gradient
from .race import programs_for, race
from .result import Status

STALL_STEPS, STALL_GAIN = 20, 1e-3
"""Stop when the best start gained less than this in so many steps."""

FORWARD_BELOW, FORWARD_BELOW_WITH_AXES = 5, 64
"""Fewer parameters than this are differentiated in forward mode: with several axes the
reverse pass takes minutes to compile, three times as long."""


@dataclass
class Search:
    """The best point found so far, in [0, 1]^n, and how it was found.

    ``history`` holds the lowest loss of each start after each step, None while it
    diverges; ``course`` the best of all with its time; ``starts`` the points descended
    from.
    """

    unit: np.ndarray
    loss: float = np.inf
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
        self, units: np.ndarray, losses: np.ndarray, evaluations: int | None = None
    ) -> None:
        """Take the best of ``units`` if it beats what is there.

        It took so many evaluations; one each, if not said.
        """
        leader = int(np.argmin(losses))
        taken = len(losses) if evaluations is None else evaluations
        self.course.add(taken, float(losses[leader]))
        if losses[leader] < self.loss:
            self.loss, self.unit = float(losses[leader]), units[leader]


def search_box(
    objective: Objective, case: Case, clock: Clock, progress: Progress
) -> Search:
    """Return the best point of the case's box.

    ``Ctrl-C`` ends the search with the best point so far. Raises ValueError when the
    loop diverges at every point tried.
    """
    own = np.asarray(case.space.start(case.loop))
    search = Search(own, starts=own[None])
    way = _race if case.study.optimiser.method == GAUSS_NEWTON else _together
    try:
        way(objective, search, case, progress)
    except KeyboardInterrupt:
        search.status = "interrupted"
    clock.compile_s += search.course.clock.compile_s
    return search


def _together(
    objective: Objective, search: Search, case: Case, progress: Progress
) -> None:
    """Screen, then descend from all starts in step, by a method of ``optimisers``."""
    clock = search.course.clock
    points = candidates(case)
    losses = _screen(objective, points, clock, progress)
    _choose(points, losses, search, case)
    _descend(objective, search.starts, search, case, clock, progress)


def _race(objective: Objective, search: Search, case: Case, progress: Progress) -> None:
    """Screen, then race descents by Gauss and Newton's method."""
    clock, table = search.course.clock, case.study.optimiser
    points = candidates(case)
    progress.stage(f"screening {len(points)} points of the box")
    programs = programs_for(objective, points.shape[1], clock)
    try:
        losses = programs.losses(points)
        chosen = _choose(points, losses, search, case)
        progress.stage("compiling the derivatives")
    finally:
        programs.wait()
    progress.stage(f"tuning from {len(chosen)} starts", table.steps)

    def after(descents: list[Descent], evaluations: int) -> None:
        search.evaluations += evaluations
        found = np.array([descent.loss for descent in descents])
        search.history.append([float(loss) for loss in found])
        units = np.array([descent.unit for descent in descents])
        search.offer(units, found, evaluations)

    ended = race(
        programs,
        points[chosen],
        losses[chosen],
        steps=table.steps,
        tolerance=table.tolerance,
        progress=progress,
        after=after,
    )
    if ended:
        search.status = "converged"


def _choose(
    points: np.ndarray, losses: np.ndarray, search: Search, case: Case
) -> np.ndarray:
    """Note what screening found; return which points to descend from."""
    search.evaluations += losses.size
    chosen = _starts(losses, case.study.optimiser.starts, search)
    search.offer(points, losses)
    search.starts = points[chosen]
    return chosen


def candidates(case: Case) -> np.ndarray:
    """Return the points to be screened: the study's own start, then others."""
    own = np.asarray(case.space.start(case.loop))
    table, size = case.study.optimiser, len(case.space.paths)
    count = max(table.candidates, table.starts - 1)
    sampler = qmc.Sobol(size, rng=np.random.default_rng(case.study.seed))
    # Sobol points are balanced in powers of two.
    others = sampler.random_base2(int(np.ceil(np.log2(max(count, 1)))))[:count]
    return np.concatenate([own[None], others])


def _screen(
    objective: Objective, points: np.ndarray, clock: Clock, progress: Progress
) -> np.ndarray:
    progress.stage(f"screening {len(points)} points of the box")
    runs = objective.signals.noise.shape[0] * objective.signals.noise.shape[1]
    at_once = max(1, BLOCK // runs)
    program = clock.compiled(
        lambda objective, units: in_blocks(
            lambda unit: objective.loss(unit), units, size=at_once
        ),
        objective,
        as_array(points),
    )
    return np.asarray(program(objective, as_array(points)))


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


def _descend(
    objective: Objective,
    starts: np.ndarray,
    search: Search,
    case: Case,
    clock: Clock,
    progress: Progress,
) -> None:
    table = case.study.optimiser
    below = FORWARD_BELOW_WITH_AXES if case.study.axes else FORWARD_BELOW
    forward = len(case.space.paths) < below

    def optimiser(objective):
        # A lambda, because a bound method would be hashed with its arrays.
        loss = with_finite_gradient(lambda u: objective.loss(u), forward=forward)
        return METHODS[table.method](
            loss, lambda u: objective.residuals(u), table.tolerance
        )

    progress.stage("compiling the gradient")
    begin = clock.compiled(
        lambda objective, units: jax.vmap(optimiser(objective).start)(units),
        objective,
        as_array(starts),
    )
    carry = begin(objective, as_array(starts))

    def advance(objective, carry):
        solver = optimiser(objective)
        carry = jax.vmap(solver.step)(carry)
        return carry, jax.vmap(solver.view)(carry)

    program = clock.compiled(advance, objective, carry)
    progress.stage(f"tuning from {len(starts)} starts", table.steps)
    bests: list[float] = []
    lowest = np.full(len(starts), np.inf)
    for _ in range(table.steps):
        carry, view = program(objective, carry)
        view = jax.tree.map(np.asarray, view)
        search.evaluations += len(starts)
        losses = np.where(np.isfinite(view.loss), view.loss, np.inf)
        lowest = np.minimum(lowest, losses)
        search.history.append([float(x) if np.isfinite(x) else None for x in lowest])
        search.offer(view.unit, losses)
        bests.append(search.loss)
        progress.advance(search.loss)
        if np.all(view.done) or _stalled(bests):
            search.status = "converged"
            break


def _stalled(bests: list[float]) -> bool:
    return len(bests) > STALL_STEPS and bests[-1 - STALL_STEPS] - bests[-1] < STALL_GAIN
