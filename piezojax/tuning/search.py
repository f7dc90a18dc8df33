"""Search of tuning: screening of the box, then descent from the best points."""

import numpy as np
import scipy

from ..core.progress import Progress
from ..core.rollout import BLOCK
from ..engines import default_engine
from ..solve.clock import Clock
from ..solve.lockstep import LockstepDescent
from ..solve.multi_start import Strategy, minimise
from ..solve.optimisers import GAUSS_NEWTON
from ..solve.problem import FAILED_LOSS
from ..solve.sampled_errors import spacing
from ..solve.search_state import SearchState
from ..solve.successive_halving import SuccessiveHalving
from ..study import Case
from .objective import Objective

FORWARD_BELOW = {"native": 4, "loop": 5}
"""Numbers of parameters below which forward-mode differentiation is faster, by engine;
5 for others."""

FORWARD_BELOW_WITH_AXES = {"native": 4, "loop": 64}
"""The same with several axes, where XLA compiles a reverse pass for minutes, three
times as long as a forward pass."""


def make_strategy(objective: Objective, case: Case, clock: Clock) -> Strategy:
    """Return the strategy of the study's method, compiled for its objective."""
    table, size = case.study.optimiser, len(case.space.paths)
    if table.method == GAUSS_NEWTON:
        counted = objective.signals.references.shape[1] - objective.start
        every = spacing(objective.lanes, counted)
        return SuccessiveHalving(
            objective,
            size,
            clock,
            lanes=objective.lanes,
            tolerance=table.tolerance,
            every=every,
        )
    limits = FORWARD_BELOW_WITH_AXES if case.study.axes else FORWARD_BELOW
    below = limits.get(default_engine(), limits["loop"])
    return LockstepDescent(
        objective,
        size,
        clock,
        method=table.method,
        tolerance=table.tolerance,
        forward=size < below,
        at_once=max(1, BLOCK // objective.lanes),
    )


def search_box(
    objective: Objective,
    case: Case,
    progress: Progress,
    also: np.ndarray | None = None,
) -> tuple[SearchState, Strategy | None]:
    """Return the search with the best point of the case's box, and its strategy.

    ``also`` are further points [points, n] that may become starts.
    ``Ctrl-C`` ends the search with the best point so far; the strategy is None if it
    has not been compiled. Raises ValueError if the loop diverges or stays at a voltage
    limit at every point tried.
    """
    own, table = np.asarray(case.space.start(case.loop)), case.study.optimiser
    search = SearchState(own, starts=own[None])
    inner, strategy = search.history.clock, None
    try:
        points = candidates(case)
        points = points if also is None else np.concatenate([points, also])
        progress.stage(f"screening {len(points)} points of the box")
        strategy = make_strategy(objective, case, inner)
        try:
            losses, verdict = strategy.screen(objective, points)
            chosen = _starts(losses, table.starts, search)
            search.update_best(points, verdict)
            search.starts = points[chosen]
        finally:
            strategy.wait()
        minimise(strategy, objective, search.starts, search, table.steps, progress)
    except KeyboardInterrupt:
        search.status = "interrupted"
    return search, strategy


def candidates(case: Case) -> np.ndarray:
    """Return points [points, n] to screen: the study's own start, then Sobol points."""
    own = np.asarray(case.space.start(case.loop))
    table, size = case.study.optimiser, len(case.space.paths)
    count = max(table.candidates, table.starts - 1)
    sampler = scipy.stats.qmc.Sobol(size, rng=np.random.default_rng(case.study.seed))
    # Sobol points are balanced in powers of two.
    others = sampler.random_base2(int(np.ceil(np.log2(max(count, 1)))))[:count]
    return np.concatenate([own[None], others])


def _starts(losses: np.ndarray, count: int, search: SearchState) -> np.ndarray:
    """Return the indices of the study's own start and the best stable candidates.

    There are at most ``count``; the own start is left out if it is not stable. Raises
    ValueError if no point is stable.
    """
    stable = losses < FAILED_LOSS
    if not stable.any():
        raise ValueError(
            "the loop diverges or stays at a voltage limit at the start and at all "
            f"{losses.size - 1} points tried in the box: lower the bounds of the "
            "gains, raise 'candidates', or check the plant's sign and sample rate"
        )
    if not stable[0]:
        search.warnings.append(
            "the study's own start diverges or stays at a voltage limit; tuning began "
            f"from the best of {losses.size - 1} other points of the box instead"
        )
    best = 1 + np.argsort(losses[1:], kind="stable")
    order = np.concatenate([[0], best])
    return order[stable[order]][:count]
