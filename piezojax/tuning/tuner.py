"""Tuning of a study: search of the box, and evaluation on the hold-out."""

import math
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from ..analysis.stability import StabilityReports
from ..core.arrays import as_array
from ..core.progress import Progress, Silent
from ..solve.clock import Clock
from ..study import Case, read, shipped
from ..study.schema import NOTHING_TO_TUNE
from .alarms import alarms_of, delay_notes, peak_notes
from .baselines import Budget, compare_baselines
from .beside import FiguresBeside
from .data import depends_on_loop, judging, make_data
from .device_alarms import device_alarms
from .evaluator import Evaluator
from .front import trace_front
from .held_out import held_out
from .limited_search import search_within_limits
from .make_objective import make_objective
from .make_result import constraint_outcomes, make_result
from .model_alarms import model_alarms
from .outcome import Outcome
from .reach import require_reach
from .recorded_range import recorded_range_alarms, recorded_slew_alarms
from .response_margins import margins_on_response, response_alarms
from .sliding import sliding_share
from .structure_search import search_structures
from .tip import tip_note


def tune(
    study: Case | str | Path | None = None,
    *,
    baselines: Budget | None = None,
    progress: Progress | None = None,
) -> Outcome:
    """Tune the controller of a study and evaluate it on held-out noise and references.

    ``study`` is a Case, the path of a study file, or None for the default study. With a
    budget as ``baselines``, the baselines are run on the same objective afterwards.
    Each of the ``structures`` of a study is tuned; the Outcome is that of the chosen
    one.
    ``Ctrl-C`` ends the search and keeps the best gains found so far. A start that
    diverges or stays at a voltage limit is replaced by the best of the candidates.
    Raises ValueError if a reference is beyond the stroke of the stage, if neither the
    start nor any candidate gives a stable loop, or for ``baselines`` of a study with
    ``structures``.
    """
    progress = progress or Silent()
    case = study if isinstance(study, Case) else read(study or shipped())
    if case.study.structures is None:
        return _tune(case, None, progress, baselines)
    if baselines is not None:
        raise ValueError("baselines are for one structure; leave out [structures]")
    return search_structures(case, _tune, progress)


def _tune(
    case: Case,
    also: np.ndarray | None,
    progress: Progress,
    baselines: Budget | None = None,
) -> Outcome:
    """Tune one structure; ``also`` are further points [points, n] to start from."""
    with FiguresBeside(case) as beside:
        return _tuned(case, beside, also, progress, baselines)


def _tuned(
    case: Case,
    beside: FiguresBeside,
    also: np.ndarray | None,
    progress: Progress,
    baselines: Budget | None,
) -> Outcome:
    clock = Clock()
    table, space = case.study, case.space
    if not space.paths:
        raise ValueError(NOTHING_TO_TUNE)
    data = make_data(case)
    require_reach(case, data)

    progress.stage("simulating the start")
    evaluator = Evaluator(clock, case)
    before = evaluator.figures(case.loop, data.tuning)
    own = held_out(case, evaluator, data)
    if not depends_on_loop(case):
        beside.begin(data, own)
    objective = make_objective(case, data, evaluator, before)
    objective, search, strategy, stability = search_within_limits(
        objective, case, evaluator, progress, also
    )

    after = space.put(case.loop, as_array(search.unit))
    try:
        front, kept = None, constraint_outcomes(objective, evaluator, after)
        if table.pareto is not None and strategy and search.status != "interrupted":
            front = trace_front(objective, case, search, strategy, evaluator, progress)
        text = "evaluating on held-out noise"
        if search.status == "interrupted":
            text += " the best gains so far (Ctrl-C again ends this)"
        progress.stage(text)
        data = judging(data, case, after)
        own = own.on(data.holdout)
        loops = {"before": own, "tuned": own.with_loop(after)}
        result = make_result(
            case, data, evaluator, before, loops, search, clock, kept, front
        )
    except KeyboardInterrupt:
        # Keep the gains; only a second interrupt ends this evaluation too.
        search.status = "interrupted"
        loops = {"before": own, "tuned": own.with_loop(after)}
        result = make_result(
            case, data, evaluator, before, loops, search, clock, {}, None
        )
    try:
        result.sliding_before, result.sliding = (
            sliding_share(loop, data, evaluator.start) for loop in (case.loop, after)
        )
        beside.begin(data, own)
        result.beside = beside.all(loops["tuned"], progress)
        note = tip_note(case, after, data, evaluator.start)
        result.warnings += [note] if note else []
    except KeyboardInterrupt:
        result.status = "interrupted"
    result.warnings += peak_notes(stability)
    if case.plant_about.record is not None:
        result.warnings += delay_notes(stability)
    limits = table.limits
    result.on_response = margins_on_response(case, stability)
    outcome = Outcome(result, case.loop, after, case, data.holdout, None, stability)
    of_model = [
        *response_alarms(result.on_response, limits, stability),
        *_model_alarms(case, limits, stability),
        *recorded_range_alarms(case, data),
        *recorded_slew_alarms(case, outcome),
        *device_alarms(after.controller),
    ]
    result.steps_before, result.steps = outcome.steps
    result.alarms = alarms_of(result, stability, limits, of_model)
    result.wall_s = clock.wall_s()
    if baselines and search.status != "interrupted":
        outcome.baselines = compare_baselines(
            objective, case, data, search, baselines, progress
        )
    return outcome


def _model_alarms(
    case: Case, limits: Mapping[str, float], stability: StabilityReports
) -> list[str]:
    """Return the ``model_alarms`` of the plant of ``case``."""
    return list(
        model_alarms(
            case.plant_about,
            case.fit is not None,
            limits.get("sensitivity_peak", math.inf),
            stability,
        )
    )
