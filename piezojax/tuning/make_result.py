"""Result of a search: scores, limits and warnings, evaluated on the hold-out."""

from collections.abc import Iterable, Mapping
from importlib.metadata import version

import jax
import numpy as np

from ..analysis.constraints import worst_by_plant
from ..analysis.loop_figures import LoopFigures
from ..core.arrays import as_array
from ..core.feedback import Feedback
from ..core.metrics import TrackingFigures
from ..identification.residual_record import SUFFIX
from ..solve.clock import Clock
from ..solve.search_state import SearchState
from ..study import Case
from .data import Data
from .evaluator import Evaluator
from .held_out import HeldOut
from .level_stages import levels_of
from .model_alarms import unchecked
from .objective import Objective
from .result import (
    ConstraintOutcome,
    FrontPoint,
    Perturbed,
    Result,
    Scores,
    scores,
)
from .steep_stage import steep_stage


def make_result(
    case: Case,
    data: Data,
    evaluator: Evaluator,
    before: TrackingFigures,
    loops: Mapping[str, HeldOut],
    search: SearchState,
    clock: Clock,
    kept: dict[str, ConstraintOutcome],
    front: list[FrontPoint] | None,
) -> Result:
    """Return the Result of ``search``.

    ``before`` are the tuning figures of the study's own gains. ``loops`` holds the
    loops "before" and "tuned", ``kept`` the outcomes of the limits in tuning.
    """
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

    start, best = loops["before"], loops["tuned"]
    holdout_before, unseen_before, coupling_before = split(_nominal(start))
    holdout, unseen_after, coupling = split(_nominal(best))
    tuned = driven[: data.tuned]
    names = data.names[: data.tuned]
    after_scores = _chosen(evaluator.figures(best.loop, data.tuning), names, tuned)
    unit = np.asarray(search.unit)
    values = case.space.from_unit(as_array(unit))
    sides = zip(case.space.paths, map(_side, unit), strict=True)
    bounds_reached = {path: side for path, side in sides if side}
    return Result(
        study=case.name,
        title=case.study.title,
        status=search.status,
        method=case.study.optimiser.method,
        gains=_named(case, values),
        start=_named(case, case.space.from_unit(case.space.start(case.loop))),
        at_bound=list(bounds_reached),
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
            best.nominal,
        ),
        front=front,
        perturbed=_perturbed(start, best, driven, case.study.limits),
        units={trace.name: trace.unit for trace in data.traces},
        gain_units={path: case.unit(path) for path in case.space.paths},
        gain_steps={
            path: bounds.step
            for path, bounds in case.space.ranges().items()
            if bounds.step is not None
        },
        warnings=[
            *case.notes,
            *search.warnings,
            *_warnings(case, bounds_reached, after_scores, holdout),
            *not_better_than_the_start(_chosen(before, names, tuned), after_scores),
        ],
        history=search.losses_by_start,
        times_s=search.times_s,
        evaluations=search.evaluations,
        compile_s=clock.compile_s,
        wall_s=clock.wall_s(),
        versions={n: version(n) for n in _VERSIONED},
        seed=case.study.seed,
    )


WORSE = 1e-3
"""Relative difference from the error of the start that does not count."""

_LONGER = "to search longer, raise 'candidates', 'starts' and 'steps'"

EDGE = 1e-2
"""Distance, as a share of the range, within which a gain is at a bound."""

_VERSIONED = ("piezojax", "jax", "jaxlib", "optimistix", "jaxopt", "equinox", "numpy")


def _nominal(held_out: HeldOut) -> TrackingFigures:
    """Return the figures [traces, draws] on the nominal plant."""
    return jax.tree.map(lambda x: x[0], held_out.nominal.tracking)


def _perturbed(
    before: HeldOut, after: HeldOut, driven: np.ndarray, limits: Mapping[str, float]
) -> Perturbed | None:
    if before.perturbed is None or after.perturbed is None:
        return None
    return Perturbed.of(before.perturbed, after.perturbed, driven, limits)


def constraint_outcomes(
    objective: Objective, evaluator: Evaluator, after: Feedback
) -> dict[str, ConstraintOutcome]:
    """Return the outcomes of the limits on the plants that were tuned on."""
    figures = evaluator.limited(
        after, objective.signals, objective.stages, evaluator.margin_stages
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


def _chosen(
    figures: TrackingFigures, names: tuple[str, ...], chosen: np.ndarray
) -> Scores:
    """Return the scores of the traces for which ``chosen`` is True."""
    where = np.flatnonzero(chosen)
    part = jax.tree.map(lambda x: np.asarray(x)[where], figures)
    return scores(part, tuple(names[i] for i in where))


def _named(case: Case, values: jax.Array) -> dict[str, float]:
    return dict(zip(case.space.paths, map(float, values), strict=True))


def _side(place: float) -> str:
    """Return the bound that ``place``, from 0 to 1 in the range, is at; "" if none."""
    if place < EDGE:
        return "lower"
    return "upper" if place > 1.0 - EDGE else ""


def _warnings(
    case: Case, bounds_reached: Mapping[str, str], after: Scores, holdout: Scores
) -> list[str]:
    found = []
    found += _hysteresis_notes(case)
    found += _residual_notes(case)
    if case.fit is not None:
        report = case.fit.report
        found += [
            f"fitted plant: {text}"
            for text in report.warnings
            if text not in report.alarms
        ]
    found += unchecked(case.plant_about, case.response is not None)
    if levels := levels_of(case.loop.plant):
        found.append(
            f"the plant is scheduled by the level of its drive: limits on margins hold "
            f"at each of its {levels} levels, the printed margins at rest only"
        )
    if bounds_reached:
        sides = ", ".join(f"{path} ({side})" for path, side in bounds_reached.items())
        found.append(f"at the edge of its bounds: {sides}")
    for where, figures in (("tuning", after), ("hold-out", holdout)):
        railed = [n for n, share in figures.saturated_percent.items() if share > 0]
        if railed:
            found.append(
                f"the actuator saturates on {where} runs of {', '.join(railed)}: a "
                "controller of your own needs the limits of [actuator], too"
            )
    return found


def _hysteresis_notes(case: Case) -> list[str]:
    """Return a note on the hysteresis that is assumed, or not, beyond the plant."""
    width = case.assumed_hysteresis
    if width > 0.0:
        checked = "are also" if steep_stage(case) else "are not"
        return [
            "the stage is assumed to have hysteresis that the plant lacks, a loop "
            f"whose width is {100.0 * width:.3g} % of its height over the references "
            "(disturbance.hysteresis): its deviation from the plant disturbs half of "
            "the runs, and the errors hold for stages with no wider loop; limits on "
            f"margins {checked} checked at its largest gain; steps are simulated "
            "without it, and the stage may overshoot more"
        ]
    if case.plant_about.small_motions:
        return [
            "disturbance.hysteresis is 0, and the plant shows only small motions: the "
            "errors hold for a stage without hysteresis"
        ]
    return []


def _residual_notes(case: Case) -> list[str]:
    """Return a note on the residual of a fitted plant: its size, or its absence."""
    about = case.plant_about
    if case.fit is not None:
        part = case.fit.report.validation
        size = f"{part.rmse:.3g} {part.unit}"
    elif about.residual_rms:
        axes = case.study.axes
        units = axes.units if axes else ("um",)
        size = ", ".join(
            f"{rms:.3g} {unit}"
            for rms, unit in zip(about.residual_rms, units, strict=False)
        )
    else:
        return []
    if case.residual is None:
        return [
            f"the fitted plant leaves {size} rms of its record unexplained, and the "
            "file of that residual is not beside the model: the runs are without it, "
            "and their errors are too small by what it would add; copy it there "
            f"(*{SUFFIX}), or fit the model again"
        ]
    return [
        f"the fitted plant leaves {size} rms of its record unexplained; this residual "
        "is a disturbance of the loop, that of the training part while tuning, that of "
        "the validation part in the hold-out, and so is an error of its gain of the "
        "same relative size"
    ]


def not_better_than_the_start(before: Scores, after: Scores) -> list[str]:
    """Return a note if gains within the limits track not better than the start."""
    if not (before.stable and after.stable):
        return []
    was, found = before.geomean_rms_um, after.geomean_rms_um
    if was is None or found is None or found < was * (1.0 - WORSE):
        return []
    if found <= was * (1.0 + WORSE):
        return [f"the search found no gains that are better than the start: {_LONGER}"]
    return [
        f"the tuned gains track worse than the start, {1e3 * found:.4g} nm against "
        f"{1e3 * was:.4g} nm: the start does not keep the limits, or fails on a drawn "
        f"plant; {_LONGER}"
    ]
