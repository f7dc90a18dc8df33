"""The search: screen the box, then descend from the best starts, all at once."""

import numpy as np
import scipy

from ..core.progress import Progress
from ..solve.clock import Clock
from ..solve.optimisers import GAUSS_NEWTON
from ..study import Case
from .lockstep import Together
from .objective import HOPELESS, Objective
from .search_state import Search
from .successive_halving import Race

Way = Together | Race


def way_of(objective: Objective, case: Case, clock: Clock) -> Way:
    """Return the way in which the study's method searches."""
    method = case.study.optimiser.method
    return (Race if method == GAUSS_NEWTON else Together)(objective, case, clock)


def search_box(
    objective: Objective, case: Case, clock: Clock, progress: Progress
) -> tuple[Search, Way | None]:
    """Return the best point of the case's box, and the way, with all it compiled.

    ``Ctrl-C`` ends the search with the best point so far; there is no way if it came
    before there was one. Raises ValueError when the loop diverges at every point tried.
    """
    own, table = np.asarray(case.space.start(case.loop)), case.study.optimiser
    search = Search(own, starts=own[None])
    inner, way = search.course.clock, None
    try:
        points = candidates(case)
        progress.stage(f"screening {len(points)} points of the box")
        way = way_of(objective, case, inner)
        try:
            losses, verdict = way.losses(points)
            chosen = _starts(losses, table.starts, search)
            search.offer(points, verdict)
            search.starts = points[chosen]
        finally:
            way.wait()
        way.descend(objective, search.starts, search, table.steps, progress)
    except KeyboardInterrupt:
        search.status = "interrupted"
    clock.compile_s += inner.compile_s
    return search, way


def candidates(case: Case) -> np.ndarray:
    """Return the points to be screened: the study's own start, then others."""
    own = np.asarray(case.space.start(case.loop))
    table, size = case.study.optimiser, len(case.space.paths)
    count = max(table.candidates, table.starts - 1)
    sampler = scipy.stats.qmc.Sobol(size, rng=np.random.default_rng(case.study.seed))
    # Sobol points are balanced in powers of two.
    others = sampler.random_base2(int(np.ceil(np.log2(max(count, 1)))))[:count]
    return np.concatenate([own[None], others])


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
    order = np.concatenate([[0], best])
    return order[stable[order]][:count]
