"""Alarms of tuned gains: reasons not to use them, each with a next step."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from ..analysis.constraints import CONSTRAINTS
from ..analysis.stability import MultiAxisReport, StabilityReport, StabilityReports
from ..analysis.step_response import LARGE
from .objective import RAILED
from .result import ConstraintOutcome, Perturbed, Result, Scores
from .step_tests import StepResult

PEAK = "sensitivity_peak"

EXACT = 1e-2
"""Relative error of the margins in the search, by which exact margins may violate a
limit without an alarm."""

HELD_OUT = 0.05
"""Relative violation of a limit in the hold-out without an alarm: the noise differs
from that of tuning."""

AMPLIFIED = 2.0
"""Largest peak of |y/r| without a note."""

DISAGREE = 5.0
"""Ratio of the errors on the hold-out to those of tuning without an alarm."""

DELAYED = 2.0
"""Delay margin (samples) below which a plant fitted to a record has a note: the rows of
a record are often wrong by a sample, and a trigger may be wrong by two."""

OVERSHOOT = 1.0
"""Largest overshoot of a large step without an alarm, as a share of its height. A
larger one leaves the range in which the model was tested, or that of the stage."""

_LIMITED = "stays at a limit of the voltage or of its slew rate"

_TIGHTEN = (
    "begin with gains of a stable loop, lower the bounds of the gains, or raise "
    "'candidates' and 'steps'"
)
_DRAW = "draw more plants for the search (ensemble.margins, ensemble.tune)"


def alarms_of(
    result: Result,
    stability: StabilityReports,
    limits: Mapping[str, float],
    model: Sequence[str] = (),
) -> list[str]:
    """Return the alarms of a tuned study, the most serious first.

    ``stability`` contains the exact margins of the loop "after" tuning, ``limits`` are
    those of the study, and ``model`` are the alarms of the fit of its plant.
    """
    scores = {
        "tuning": result.after,
        "hold-out": result.holdout,
        "unseen": result.unseen,
        "resting": result.coupling,
    }
    others = _not_exact(result.constraints, stability)
    return [
        *_run_alarms(scores),
        *_disagreement(result.after, result.holdout),
        *_stability_alarms(stability, limits),
        *_limit_alarms(others, result.perturbed),
        *_holdout_alarms(result.holdout_constraints),
        *_step_alarms(result.steps),
        *_plant_alarms(result.perturbed),
        *model,
    ]


def peak_notes(stability: StabilityReports) -> list[str]:
    """Return a note if the peak of |y/r| of the tuned loop exceeds ``AMPLIFIED``."""
    reports = stability.reports.get("after", {}).values()
    found = [report.following for report in reports if report.following is not None]
    worst = max(found, key=lambda one: one.closed_loop_peak, default=None)
    if worst is None or worst.closed_loop_peak <= AMPLIFIED:
        return []
    return [
        f"the tuned loop amplifies references at {worst.closed_loop_peak_Hz:.4g} Hz by "
        f"{worst.closed_loop_peak:.3g}: filter references that contain this frequency, "
        "as jumps do without a limit of their acceleration (LimitedReference), or "
        "limit constraints.closed_loop_peak"
    ]


def delay_notes(stability: StabilityReports) -> list[str]:
    """Return a note if the delay margin of the tuned loop is below ``DELAYED``."""
    figures = [found for found in exact_figures(stability).values() if found]
    known = [found["delay_margin"] for found in figures]
    least = min((margin for margin in known if margin is not None), default=np.inf)
    if least >= DELAYED:
        return []
    return [
        f"the tuned loop is unstable with {least:.3g} samples more delay than the "
        "record of its plant shows: check that no reading in the loop comes later than "
        "in the record, or raise constraints.delay_margin"
    ]


def _run_alarms(scores: Mapping[str, Scores | None]) -> Iterable[str]:
    for where, part in scores.items():
        if part is None:
            continue
        lost = [name for name, rms in part.per_reference_rms_um.items() if rms is None]
        railed = [
            name
            for name, share in part.saturated_percent.items()
            if share > 100.0 * RAILED and name not in lost
        ]
        for names, what in ((lost, "diverges"), (railed, _LIMITED)):
            if names:
                yield (
                    f"the tuned loop {what} on {where} runs of {', '.join(names)}: "
                    f"reduce the amplitude of the references, or {_TIGHTEN}"
                )


def _disagreement(tuning: Scores, holdout: Scores) -> Iterable[str]:
    """Yield an alarm if the hold-out has far larger errors than the tuning."""
    known, found = tuning.geomean_rms_um, holdout.geomean_rms_um
    if known and found and found > DISAGREE * known:
        yield (
            f"the errors on the hold-out are {found / known:.3g} times those of tuning:"
            " the gains suit only the noise and residual that they were tuned with; if "
            "the plant is fitted to a record, record the same motions in both halves "
            "(python -m piezojax.excite writes such voltages)"
        )


def _stability_alarms(
    stability: StabilityReports, limits: Mapping[str, float]
) -> Iterable[str]:
    why = stability.problems.get("after")
    if why is not None and any(name in limits for name in _EXACT_FIGURES):
        yield (
            f"the margins of the tuned loop are unknown, because {why}: test the gains "
            "at a small amplitude first, or switch the limits off in [constraints]"
        )
    for where, figures in exact_figures(stability).items():
        if figures is None:
            yield f"the tuned loop is unstable for small motions{where}: {_TIGHTEN}"
            continue
        for name, value in figures.items():
            if name in limits and _misses(name, value, limits[name]):
                yield _missed(name, value, limits[name], f"the nominal plant{where}")


_EXACT_FIGURES = (
    "sensitivity_peak",
    "delay_margin",
    "disk_margin",
    "gain_margin",
    "phase_margin",
    "bandwidth",
    "closed_loop_peak",
)


def exact_figures(
    stability: StabilityReports,
) -> dict[str, dict[str, float | None] | None]:
    """Return the exact figures of the tuned loop, None where it is unstable.

    On one axis the keys name the branch; on several the only key is "", with the worst
    of each figure over both branches.
    """
    found: dict[str, dict[str, float | None] | None] = {}
    for branch, report in stability.reports.get("after", {}).items():
        side, *place = branch.split(" ", 1)
        found[" ".join([f" on the {side} branch", *place])] = _figures(report, [report])
    if "after" in stability.axes:
        found[""] = _worst([_axes_figures(r) for r in stability.axes["after"].reports])
    return found


def _axes_figures(report: MultiAxisReport) -> dict[str, float | None] | None:
    figures = _figures(report, report.axes)
    return figures and figures | {PEAK: report.largest_sensitivity_peak}


def _worst(
    branches: Sequence[dict[str, float | None] | None],
) -> dict[str, float | None] | None:
    """Return the worst of each figure over ``branches``, None if one is unstable."""
    known = [figures for figures in branches if figures is not None]
    if len(known) < len(branches):
        return None

    def worst(name: str) -> float:
        pick = np.max if CONSTRAINTS[name].sense == "at most" else np.min
        # A figure that is not known becomes NaN, which no limit accepts.
        return float(pick(np.array([figures[name] for figures in known], float)))

    return {name: worst(name) for name in known[0]}


def exact_peak(stability: StabilityReports) -> float:
    """Return the exact Ms of the tuned loop, infinite if it is unstable or unknown."""
    figures = exact_figures(stability).values()
    peaks = [found[PEAK] if found else None for found in figures]
    return max((np.inf if peak is None else peak for peak in peaks), default=np.inf)


def _figures(
    report: Any, axes: Sequence[StabilityReport]
) -> dict[str, float | None] | None:
    if not report.stable:
        return None

    def least(name: str) -> float | None:
        known = [getattr(axis, name) for axis in axes]
        return min((margin for margin in known if margin is not None), default=None)

    found = {
        "sensitivity_peak": report.sensitivity_peak,
        "delay_margin": least("delay_margin_samples"),
        "disk_margin": report.disk_margin,
        "gain_margin": least("gain_margin_dB"),
        "phase_margin": least("phase_margin_deg"),
    }
    following = getattr(report, "following", None)
    if following is None:
        return found
    return found | {
        "bandwidth": following.bandwidth_Hz,
        "closed_loop_peak": following.closed_loop_peak,
    }


def _misses(name: str, value: float | None, limit: float) -> bool:
    if value is None or np.isnan(value):
        return True
    if CONSTRAINTS[name].sense == "at most":
        return value > limit * (1.0 + EXACT)
    return value < limit * (1.0 - EXACT)


def _not_exact(
    limits: Mapping[str, ConstraintOutcome], stability: StabilityReports
) -> dict[str, ConstraintOutcome]:
    """Return the outcomes that the exact figures of the nominal plant do not cover.

    An unstable loop has an alarm of its own, and none of its figures matters.
    """
    found = exact_figures(stability).values()
    exact = [set(_EXACT_FIGURES if figures is None else figures) for figures in found]
    covered = set.intersection(*exact) if exact else set()
    return {
        name: outcome
        for name, outcome in limits.items()
        if outcome.of > 1 or name not in covered
    }


def _limit_alarms(
    limits: Mapping[str, ConstraintOutcome], perturbed: Perturbed | None
) -> Iterable[str]:
    held_out = perturbed.constraints if perturbed else {}
    for where, outcomes, remedy in (
        ("tuned", limits, _TIGHTEN),
        ("held-out", held_out, _DRAW),
    ):
        for name, outcome in outcomes.items():
            if not outcome.kept:
                plants = f"{outcome.of - outcome.on} of {outcome.of} {where} plants"
                yield _missed(name, outcome.value, outcome.limit, plants, remedy)


def _holdout_alarms(limits: Mapping[str, ConstraintOutcome]) -> Iterable[str]:
    for name, outcome in limits.items():
        at_most = CONSTRAINTS[name].sense == "at most"
        allowance = 1.0 + HELD_OUT if at_most else 1.0 - HELD_OUT
        value = np.nan if outcome.value is None else outcome.value
        inside = value <= outcome.limit * allowance
        if not (inside if at_most else value >= outcome.limit * allowance):
            yield _missed(name, outcome.value, outcome.limit, "the hold-out")


def _missed(
    name: str, value: float | None, limit: float, where: str, remedy: str = _TIGHTEN
) -> str:
    kind = CONSTRAINTS[name]
    unit = "" if kind.unit == "1" else f" {kind.unit}"
    side = "above" if kind.sense == "at most" else "below"
    shown = "not known" if value is None else f"{value:.3g}{unit}"
    return (
        f"{name} is {shown} on {where}, {side} its limit {limit:g}{unit}: "
        f"{kind.remedy or remedy}, or change constraints.{name}"
    )


def _step_alarms(steps: Mapping[str, StepResult]) -> Iterable[str]:
    """Yield an alarm if the overshoot of a large step exceeds ``OVERSHOOT``."""

    def overshoot(step: StepResult) -> float:
        return np.inf if step.overshoot is None else step.overshoot

    large = (step for name, step in steps.items() if name in LARGE)
    step = max(large, key=overshoot, default=None)
    if step is None or (worst := overshoot(step)) <= OVERSHOOT:
        return
    known = np.isfinite(worst)
    reached = f"overshoots by {100.0 * worst:.3g} %" if known else "diverges"
    yield (
        f"a step of the reference from {step.before_um:.4g} to {step.after_um:.4g} um "
        f"{reached}: limit slew and acceleration of the reference (LimitedReference), "
        "lower these limits, or limit constraints.closed_loop_peak"
    )


def _plant_alarms(perturbed: Perturbed | None) -> Iterable[str]:
    if perturbed is not None and perturbed.unstable:
        yield (
            "the tuned loop is unstable, diverges or stays at a voltage limit on "
            f"{perturbed.unstable} of {perturbed.plants} perturbed plants: raise "
            "ensemble.tune, or tighten constraints.sensitivity_peak"
        )
