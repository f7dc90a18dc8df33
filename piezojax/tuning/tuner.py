"""Tuning of a study: search of the box, and evaluation on the hold-out."""

import math
from collections.abc import Iterable, Mapping
from importlib.metadata import version
from pathlib import Path

import jax
import numpy as np

from ..analysis.constraints import LoopFigures, uses, worst_by_plant
from ..analysis.stability import StabilityReports, stability_reports
from ..core.arrays import as_array
from ..core.feedback import Feedback
from ..core.metrics import TrackingFigures
from ..core.progress import Progress, Silent
from ..solve.clock import Clock
from ..solve.multi_start import Strategy
from ..solve.search_state import SearchState
from ..study import Case, read, shipped
from ..study.references import highest_reference
from .alarms import alarms_of
from .baselines import Budget, compare_baselines
from .data import Data, make_data
from .evaluator import Evaluator
from .front import trace_front
from .make_objective import make_objective
from .model_alarms import model_alarms
from .objective import Objective
from .outcome import Outcome
from .reach import require_reach
from .result import (
    ConstraintOutcome,
    FrontPoint,
    Perturbed,
    Result,
    Scores,
    scores,
)
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
        front, kept = None, _constraint_outcomes(objective, evaluator, after)
        if table.pareto is not None and strategy and search.status != "interrupted":
            front = trace_front(objective, case, search, strategy, clock, progress)
        progress.stage("evaluating on held-out noise")
        result = _report(
            case, data, evaluator, before, after, search, clock, kept, front
        )
    except KeyboardInterrupt:
        # The gains found are kept; only a second interrupt ends the report too.
        search.status = "interrupted"
        result = _report(case, data, evaluator, before, after, search, clock, {}, None)
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
        kept = _constraint_outcomes(every, evaluator, after)
    except KeyboardInterrupt:
        search.status = "interrupted"
        return objective, search, strategy
    if all(outcome.kept for outcome in kept.values()):
        return objective, search, strategy
    again, strategy = search_box(every, case, clock, progress, search.unit[None])
    again.evaluations += search.evaluations
    return every, again, strategy


def _perturbed(
    case: Case, data: Data, evaluator: Evaluator, before: Feedback, after: Feedback
) -> Perturbed | None:
    stages = case.ensemble.stages("holdout") if case.ensemble else None
    if stages is None:
        return None
    driven = np.array([trace.driven for trace in data.traces])
    figures = [
        evaluator.limited(loop, data.holdout, stages, stages)
        for loop in (before, after)
    ]
    return Perturbed.of(figures[0], figures[1], driven, case.study.limits)


def _constraint_outcomes(
    objective: Objective, evaluator: Evaluator, after: Feedback
) -> dict[str, ConstraintOutcome]:
    """Return the outcomes of the limits on the plants that were tuned on."""
    figures = evaluator.limited(
        after, objective.signals, objective.stages, objective.margin_stages
    )
    return _outcomes(evaluator.limits, evaluator.limits, figures)


def _outcomes(
    names: Iterable[str], limits: Mapping[str, float], figures: LoopFigures
) -> dict[str, ConstraintOutcome]:
    """Return the outcomes of the limits ``names`` from the figures of the plants."""
    return {
        name: ConstraintOutcome.of_values(name, limits[name], np.asarray(values))
        for name, values in worst_by_plant(names, figures).items()
    }


def _report(
    case: Case,
    data: Data,
    evaluator: Evaluator,
    before: TrackingFigures,
    after: Feedback,
    search: SearchState,
    clock: Clock,
    kept: dict[str, ConstraintOutcome],
    front: list[FrontPoint] | None,
) -> Result:
    driven = np.array([trace.driven for trace in data.traces])
    tuned_on = np.arange(len(data.traces)) < data.tuned

    def scores_of(figures: TrackingFigures, chosen: np.ndarray) -> Scores | None:
        return _chosen(figures, data.names, chosen) if chosen.any() else None

    def split(figures: TrackingFigures) -> tuple[Scores, Scores | None, Scores | None]:
        return (
            _chosen(figures, data.names, driven & tuned_on),
            scores_of(figures, driven & ~tuned_on),
            scores_of(figures, ~driven),
        )

    on_holdout = [evaluator.figures(loop, data.holdout) for loop in (case.loop, after)]
    holdout_before, unseen_before, coupling_before = split(on_holdout[0])
    holdout, unseen_after, coupling = split(on_holdout[1])
    tuned = driven[: data.tuned]
    names = data.names[: data.tuned]
    after_scores = _chosen(evaluator.figures(after, data.tuning), names, tuned)
    unit = np.asarray(search.unit)
    values = case.space.from_unit(as_array(unit))
    at_bound = [
        path
        for path, place in zip(case.space.paths, unit, strict=True)
        if place < 1e-2 or place > 1.0 - 1e-2
    ]
    return Result(
        study=case.name,
        title=case.study.title,
        status=search.status,
        method=case.study.optimiser.method,
        gains=_named(case, values),
        start=_named(case, case.space.from_unit(case.space.start(case.loop))),
        at_bound=at_bound,
        before=_chosen(before, names, tuned),
        after=after_scores,
        holdout_before=holdout_before,
        holdout=holdout,
        unseen_before=unseen_before,
        unseen=unseen_after,
        coupling_before=coupling_before,
        coupling=coupling,
        constraints=kept,
        holdout_constraints=_outcomes(
            evaluator.limits_on_runs,
            evaluator.limits,
            evaluator.run_figures(after, data.holdout),
        ),
        front=front,
        perturbed=_perturbed(case, data, evaluator, case.loop, after),
        units={trace.name: trace.unit for trace in data.traces},
        gain_units={path: case.unit(path) for path in case.space.paths},
        warnings=[
            *case.notes,
            *search.warnings,
            *_warnings(case, at_bound, after_scores, holdout),
        ],
        history=search.losses_by_start,
        times_s=search.times_s,
        evaluations=search.evaluations,
        compile_s=clock.compile_s,
        wall_s=clock.wall_s(),
        versions={n: version(n) for n in _VERSIONED},
        seed=case.study.seed,
    )


_VERSIONED = ("piezojax", "jax", "jaxlib", "optimistix", "jaxopt", "equinox", "numpy")


def _chosen(
    figures: TrackingFigures, names: tuple[str, ...], chosen: np.ndarray
) -> Scores:
    """Return the scores of the traces for which ``chosen`` is True."""
    where = np.flatnonzero(chosen)
    part = jax.tree.map(lambda x: np.asarray(x)[where], figures)
    return scores(part, tuple(names[i] for i in where))


def _named(case: Case, values: jax.Array) -> dict[str, float]:
    return dict(zip(case.space.paths, map(float, values), strict=True))


def _warnings(
    case: Case, at_bound: list[str], after: Scores, holdout: Scores
) -> list[str]:
    found = []
    if case.fit is not None:
        part = case.fit.report.validation
        found.append(
            f"the fitted plant leaves {part.rmse:.3g} {part.unit} rms of its record "
            "unexplained; this residual is a disturbance of the loop, that of the "
            "training part while tuning, that of the validation part in the hold-out"
        )
        report = case.fit.report
        found += [
            f"fitted plant: {text}"
            for text in report.warnings
            if text not in report.alarms
        ]
    if at_bound:
        found.append(f"at the edge of its bounds: {', '.join(at_bound)}")
    for where, figures in (("tuning", after), ("hold-out", holdout)):
        railed = [n for n, share in figures.saturated_percent.items() if share > 0]
        if railed:
            found.append(
                f"the actuator saturates on {where} runs of {', '.join(railed)}"
            )
    return found
