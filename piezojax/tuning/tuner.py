"""Tuning of a study: search of the box, and evaluation on the hold-out."""

import math
from collections.abc import Mapping
from pathlib import Path

from ..analysis.constraints import uses
from ..analysis.stability import StabilityReports, stability_reports
from ..core.arrays import as_array
from ..core.feedback import Feedback
from ..core.progress import Progress, Silent
from ..solve.clock import Clock
from ..solve.multi_start import Strategy
from ..solve.search_state import SearchState
from ..study import Case, read, shipped
from ..study.references import highest_reference
from .alarms import alarms_of
from .baselines import Budget, compare_baselines
from .data import make_data
from .evaluator import Evaluator
from .front import trace_front
from .make_objective import make_objective
from .make_result import constraint_outcomes, make_result
from .model_alarms import model_alarms
from .objective import Objective
from .outcome import Outcome
from .reach import require_reach
from .search import search_box
from .sliding import sliding_share
from .tip import tip_note


def tune(
    study: Case | str | Path | None = None,
    *,
    baselines: Budget | None = None,
    progress: Progress | None = None,
) -> Outcome:
    """Tune the controller of a study and evaluate it on held-out noise and references.

    ``study`` is a Case, the path of a study file, or None for the default study. With
    a budget as ``baselines``, the baselines are run on the same objective afterwards.
    ``Ctrl-C`` ends the search and keeps the best gains found so far. A start that
    diverges or rails is replaced by the best of the candidates. Raises ValueError if
    a reference is beyond the stroke of the stage, or if neither the start nor any
    candidate gives a stable loop.
    """
    progress = progress or Silent()
    clock = Clock()
    case = study if isinstance(study, Case) else read(study or shipped())
    table, space = case.study, case.space
    data = make_data(case)
    require_reach(case, data)

    progress.stage("simulating the start")
    evaluator = Evaluator(clock, case)
    before = evaluator.figures(case.loop, data.tuning)
    objective = make_objective(case, data, evaluator, before)
    objective, search, strategy = _search(objective, case, evaluator, clock, progress)

    after = space.put(case.loop, as_array(search.unit))
    try:
        front, kept = None, constraint_outcomes(objective, evaluator, after)
        if table.pareto is not None and strategy and search.status != "interrupted":
            front = trace_front(objective, case, search, strategy, clock, progress)
        progress.stage("evaluating on held-out noise")
        result = make_result(
            case, data, evaluator, before, after, search, clock, kept, front
        )
    except KeyboardInterrupt:
        # The gains found are kept; only a second interrupt ends the report too.
        search.status = "interrupted"
        result = make_result(
            case, data, evaluator, before, after, search, clock, {}, None
        )
    try:
        stability = _stability(case, after)
        result.sliding_before, result.sliding = (
            sliding_share(loop, data, evaluator.start) for loop in (case.loop, after)
        )
        note = tip_note(case, after, data, evaluator.start)
        result.warnings += [note] if note else []
    except KeyboardInterrupt:
        result.status = "interrupted"
        stability = StabilityReports(problems={"after": "they were interrupted"})
    limits = table.limits
    doubts = _model_alarms(case, limits, stability)
    result.alarms = alarms_of(result, stability, limits, doubts)
    result.wall_s = clock.wall_s()
    comparison = (
        compare_baselines(objective, case, data, search, baselines, progress)
        if baselines and search.status != "interrupted"
        else None
    )
    return Outcome(result, case.loop, after, case, data.holdout, comparison, stability)


def _model_alarms(
    case: Case, limits: Mapping[str, float], stability: StabilityReports
) -> list[str]:
    """Return the alarms of the plant's model: what its record does not support."""
    return list(
        model_alarms(
            case.fit.report if case.fit else None,
            case.plant_about.error_bound,
            limits.get("sensitivity_peak", math.inf),
            stability,
        )
    )


def _stability(case: Case, after: Feedback) -> StabilityReports:
    """Return the exact stability of the loops "before" and "after".

    The operating point is the highest reference, where the branches of a hysteresis
    differ most.
    """
    study = case.study
    return stability_reports(
        {"before": case.loop, "after": after},
        highest_reference(study),
        study.dt,
        study.axes.names if study.axes else (),
    )


def _search(
    objective: Objective,
    case: Case,
    evaluator: Evaluator,
    clock: Clock,
    progress: Progress,
) -> tuple[Objective, SearchState, Strategy | None]:
    """Return the objective with its limits, the search, and its strategy.

    The defaults among the limits are rarely active, and margins in every loss cost time
    to compile. Unless the study limits a margin itself, the box is searched without
    them first, and again with them if the result violates any.
    """
    study = case.study
    own = {
        name: study.limits[name] for name in study.constraints if name in study.limits
    }
    every = objective.with_limits(study.limits)
    if uses(own, "margins") or study.pareto or own == study.limits:
        return every, *search_box(every, case, clock, progress)
    objective = objective.with_limits(own)
    search, strategy = search_box(objective, case, clock, progress)
    if search.status == "interrupted":
        return objective, search, strategy
    try:
        after = case.space.put(case.loop, as_array(search.unit))
        kept = constraint_outcomes(every, evaluator, after)
    except KeyboardInterrupt:
        search.status = "interrupted"
        return objective, search, strategy
    if all(outcome.kept for outcome in kept.values()):
        return objective, search, strategy
    again, strategy = search_box(every, case, clock, progress, search.unit[None])
    again.evaluations += search.evaluations
    return every, again, strategy
