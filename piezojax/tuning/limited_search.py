"""Search of a study within its limits, checked by the exact margins."""

from collections.abc import Mapping

import numpy as np

from ..analysis.constraints import CONSTRAINTS, uses
from ..analysis.stability import StabilityReports, stability_reports
from ..core.arrays import as_array
from ..core.progress import Progress
from ..solve.multi_start import Strategy, minimise
from ..solve.problem import TOLERANCE
from ..solve.search_state import SearchState
from ..study import Case
from .alarms import EXACT, PEAK, exact_peak
from .evaluator import Carried, Evaluator
from .make_result import constraint_outcomes
from .model_alarms import SLACK, worst_peak
from .objective import Objective
from .search import search_box

REPEATS, LEAST_SHARE = 5, 0.3
"""Largest number of repeated searches, and the smallest factor on (limit - 1) of Ms in
one of them."""

RESERVE = 0.01
"""Share of a limit on margins by which a search stays inside it on drawn plants,
because the worst of other plants is worse than that of the drawn ones."""

Found = tuple[Objective, SearchState, Strategy | None, StabilityReports]


def search_within_limits(
    objective: Objective,
    case: Case,
    evaluator: Evaluator,
    progress: Progress,
    also: np.ndarray | None = None,
) -> Found:
    """Return the objective with its limits, the search, its strategy and the stability.

    ``also`` are further points [points, n] from which the search may start.

    The default limits are rarely active, and a loss with margins takes longer to
    compile. Unless the study limits a margin itself, the box is searched without the
    default limits first, and again with them if the result violates one: also from that
    result, which is often nearer to the best gains than any point that keeps the
    limits. If margins are limited on many plants, a search carries only the worst.
    """
    study = case.study
    limits = searched_limits(study.limits, case.ensemble is not None)
    own = {name: limits[name] for name in study.constraints if name in limits}
    every = objective.with_limits(limits)
    if uses(own, "margins") or study.pareto or own == limits:
        carried = evaluator.worst_plants(case.loop)
        every = every.on_margin_stages(carried.stages)
        search, strategy = search_box(every, case, progress, also)
        return _repeated(every, case, evaluator, carried, search, strategy, progress)
    objective = objective.with_limits(own)
    search, strategy = search_box(objective, case, progress, also)
    try:
        stability = exact_stability(case, search)
        after = case.space.put(case.loop, as_array(search.unit))
        kept = constraint_outcomes(every, evaluator, after)
        fine = all(outcome.kept for outcome in kept.values())
        if search.status == "interrupted" or (
            fine and not _alarming_peak(case, stability)
        ):
            return objective, search, strategy, stability
        carried = evaluator.worst_plants(after)
    except KeyboardInterrupt:
        search.status = "interrupted"
        return objective, search, strategy, INTERRUPTED
    every = every.on_margin_stages(carried.stages)
    again, strategy = search_box(every, case, progress)
    again.evaluations += search.evaluations
    again = _or_from(search, every, case, again, strategy, progress)
    return _repeated(every, case, evaluator, carried, again, strategy, progress)


def searched_limits(limits: Mapping[str, float], drawn: bool) -> dict[str, float]:
    """Return the ``limits`` of a search, with a ``RESERVE`` if plants are drawn."""
    found = dict(limits)
    for name in limits if drawn else ():
        if CONSTRAINTS[name].source == "margins":
            upper = CONSTRAINTS[name].sense == "at most"
            found[name] *= 1.0 - RESERVE if upper else 1.0 + RESERVE
    return found


INTERRUPTED = StabilityReports(problems={"after": "their computation was interrupted"})


def exact_stability(case: Case, search: SearchState) -> StabilityReports:
    """Return the exact stability of the loops "before" and "after".

    On one axis the operating points are both ends of the range of the references.
    """
    study = case.study
    after = case.space.put(case.loop, as_array(search.unit))
    return stability_reports(
        {"before": case.loop, "after": after},
        case.margin_reference,
        study.dt,
        study.axes.names if study.axes else (),
        case.nearer_reference,
    )


def _alarming_peak(case: Case, stability: StabilityReports) -> float:
    """Return Ms if it exceeds its limit, otherwise 0.

    It is the exact Ms or that within the error bound, whichever is larger. Ms of an
    unstable loop is infinite.
    """
    limit, bound = case.study.limits.get(PEAK), case.plant_about.error_bound
    if limit is None or "after" in stability.problems:
        return 0.0
    nominal = exact_peak(stability)
    worst = 0.0
    if bound is not None and "after" in stability.loops:
        worst, _ = worst_peak(bound.respected, stability)
    alarming = nominal > limit * (1.0 + EXACT) or worst > limit * (1.0 + SLACK)
    return max(nominal, worst) if alarming else 0.0


def _or_from(
    begin: SearchState,
    objective: Objective,
    case: Case,
    search: SearchState,
    strategy: Strategy | None,
    progress: Progress,
) -> SearchState:
    """Return ``search``, or a descent from the end of ``begin`` if it ends better.

    Among the starts of the search, a cut would drop a point that violates the limits.
    """
    if strategy is None or search.status == "interrupted":
        return search
    progress.stage("searching from the gains without the limits")
    try:
        other = _descent(begin, objective, case, strategy, progress)
    except KeyboardInterrupt:
        search.status = "interrupted"
        return search
    other.evaluations += search.evaluations
    search.evaluations = other.evaluations
    return min(search, other, key=lambda state: state.rank)


def _descent(
    begin: SearchState,
    objective: Objective,
    case: Case,
    strategy: Strategy,
    progress: Progress,
) -> SearchState:
    """Return the search from the end of ``begin`` alone, with its warnings."""
    search = SearchState(begin.unit, starts=begin.unit[None], warnings=begin.warnings)
    steps = case.study.optimiser.steps
    minimise(strategy, objective, search.starts, search, steps, progress)
    return search


def _repeated(
    objective: Objective,
    case: Case,
    evaluator: Evaluator,
    carried: Carried,
    search: SearchState,
    strategy: Strategy | None,
    progress: Progress,
) -> Found:
    """Repeat the search, up to REPEATS times, while its result misses a limit.

    The search computes S from impulse responses of one length, on a grid of
    frequencies, and may miss the peak of a lightly damped mode of the closed loop: if
    Ms of a carried plant exceeds its limit, the limit of the next search is tightened.
    If a drawn plant violates a limit, the worst plants replace part of those that the
    search carries.
    """
    limits = searched_limits(case.study.limits, case.ensemble is not None)
    try:
        stability = exact_stability(case, search)
        for _ in range(REPEATS):
            if strategy is None or search.status == "interrupted":
                break
            loop = case.space.put(case.loop, as_array(search.unit))
            carried = evaluator.worst_plants(loop, carried)
            peak = max(_alarming_peak(case, stability), carried.peak)
            if peak:
                share = (case.study.limits[PEAK] - 1.0) / (peak - 1.0)
                limits[PEAK] = 1.0 + (limits[PEAK] - 1.0) * max(share, LEAST_SHARE)
                progress.stage(f"Ms is {peak:.3g}: searching below {limits[PEAK]:.3g}")
                objective = objective.with_limits(limits)
            if carried.stages is not None and carried.excess > TOLERANCE:
                progress.stage("searching with the plants whose margins are worst")
                objective = objective.on_margin_stages(carried.stages)
            elif not peak:
                break
            again = _descent(search, objective, case, strategy, progress)
            again.evaluations += search.evaluations
            search, stability = again, exact_stability(case, again)
    except KeyboardInterrupt:
        search.status, stability = "interrupted", INTERRUPTED
    return objective, search, strategy, stability
