"""Errors of an exported controller in a simulated loop, by reference and precision."""

from typing import Any

import numpy as np
from pydantic import BaseModel, ConfigDict

from ..core.about import About
from ..core.system import System
from .c_project import CProject
from .compiled_loop import CompiledLoop, Runs, RunTrace, Steps
from .slots import Interface

WORST_PERCENT = 5.0
"""Largest accepted cost of a precision, in percent of the error in double."""


class FormFigures(BaseModel):
    """Cost of a step in one precision.

    ``ns`` is its time on this machine in ns, and ``state_bytes`` the size of the state.
    """

    operations: int
    state_bytes: int
    ns: float


class ReferenceCost(BaseModel):
    """Tracking errors under a reference by precision, in ``unit`` (nm or nrad).

    ``rms`` is the RMS error of the worst run. ``cost`` is its increase over that in
    double, and ``percent`` this increase in percent of the error in double.
    ``difference`` is the RMS difference from the displacements in double, in the worst
    run; in an unstable loop it is large in any precision.
    """

    unit: str
    rms: dict[str, float]
    cost: dict[str, float] = {}
    percent: dict[str, float] = {}
    difference: dict[str, float] = {}


class ExportReport(BaseModel):
    """Report on an exported controller; ``written`` is its precision.

    ``why`` is the reason if ``written`` differs from the requested precision, and
    ``not_judged`` the reason if there are no figures. ``alarms`` are the reasons not to
    use the exported controller.
    """

    model_config = ConfigDict(ser_json_inf_nan="strings")

    written: str
    why: str | None = None
    not_judged: str | None = None
    alarms: list[str] = []
    warnings: list[str] = []
    forms: dict[str, FormFigures] = {}
    references: dict[str, ReferenceCost] = {}

    def costly(self, precision: str) -> list[str]:
        """Return a sentence for each reference where ``precision`` costs too much."""
        return [
            f"{precision} costs {cost.cost[precision]:.3g} {cost.unit} under {name}, "
            f"{cost.percent[precision]:.3g} % of the error"
            for name, cost in self.references.items()
            if not cost.percent[precision] <= WORST_PERCENT  # NaN is costly
        ]

    def lost(self, precision: str) -> list[str]:
        """Return the references under which the loop diverges in ``precision``."""
        return [
            name
            for name, cost in self.references.items()
            if not np.isfinite(cost.rms[precision])
        ]


def judge(
    system: System, interface: Interface, runs: Runs, precision: str = "double"
) -> ExportReport:
    """Return the report on ``system``, compiled in double and float, over ``runs``.

    If ``precision`` is "float" and float costs more than ``WORST_PERCENT`` of the error
    under a reference, ``written`` is "compensated". A loop that diverges, in double or
    in the written precision, is an alarm.
    """
    report = ExportReport(written=precision)
    try:
        loop = CompiledLoop(runs)
        exact = _add(report, "double", system, interface, loop, runs)
        if not np.isfinite(exact.displacements).all() or report.lost("double"):
            return ExportReport(
                written=precision,
                not_judged="the loop diverges",
                alarms=[
                    "the compiled controller diverges in the simulated loop of its "
                    "study: tune it again, or check the limits of the voltage"
                ],
            )
        _add(report, "float", system, interface, loop, runs, exact)
        if precision == "float" and (costly := report.costly("float")):
            report.written, report.why = "compensated", "; ".join(costly)
        if report.written == "compensated":
            _add(report, "compensated", system, interface, loop, runs, exact)
    except ValueError as error:
        return ExportReport(written=precision, not_judged=str(error))
    if report.written == "double":
        return report
    if lost := report.lost(report.written):
        report.alarms = [
            f"the compiled controller diverges in {report.written} under "
            f"{', '.join(lost)}: use double"
        ]
    else:
        costly = report.costly(report.written)
        report.warnings = [f"{each}: use double" for each in costly]
    return report


def _add(
    report: ExportReport,
    precision: str,
    system: System,
    interface: Interface,
    loop: CompiledLoop,
    runs: Runs,
    exact: Steps | None = None,
) -> Steps:
    """Add the figures of a precision to ``report``, with its cost against ``exact``."""
    code = CProject(system, interface, "controller", About(), precision)
    steps = loop.steps(code)
    report.forms[precision] = FormFigures(
        operations=code.operations(), state_bytes=steps.state_bytes, ns=steps.ns
    )
    for trace in runs.traces:
        wanted = _counted(runs.rows[..., : len(code.outputs)], runs, trace)
        found = _counted(steps.displacements, runs, trace)
        costs = report.references.setdefault(
            trace.name, ReferenceCost(unit=f"n{trace.unit[1:]}", rms={})
        )
        costs.rms[precision] = _rms(found - wanted)
        if exact is not None:
            before = costs.rms["double"]
            cost = costs.cost[precision] = costs.rms[precision] - before
            costs.percent[precision] = 100.0 * cost / (before or cost or 1.0)
            costs.difference[precision] = _rms(
                found - _counted(exact.displacements, runs, trace)
            )
    return steps


def _counted(signals: np.ndarray, runs: Runs, trace: RunTrace) -> np.ndarray:
    return signals[trace.runs, runs.settle :, trace.axis]


def _rms(errors: Any) -> float:
    """Return the RMS of ``errors`` [runs, samples] (um or urad) in nm or nrad.

    It is that of the worst run, as in the result of tuning.
    """
    with np.errstate(over="ignore"):  # a loop that diverges has an infinite RMS
        return 1e3 * float(np.sqrt(np.mean(np.square(errors), axis=1).max()))
