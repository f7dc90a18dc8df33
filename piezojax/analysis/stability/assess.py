"""Stability reports of one loop or several loops at an operating point."""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple, overload

import jax
import numpy as np

from ...core.arrays import ScalarLike
from ...core.feedback import Feedback
from .axes_margins import MultiAxisReport, axes_report_of
from .conserved import LinearAxes, LinearLoop
from .crossings import angle_grid
from .margins import (
    StabilityReport,
    largest_singular,
    linear_axes,
    linear_loop,
    located_report,
)
from .operating_point import BRANCHES, OperatingPoint

_SAME = 1e-5
"""Relative difference of L below which two branches count as equal."""


@overload
def stability_report(loop: Feedback, at: ScalarLike = 0.0) -> StabilityReport: ...


@overload
def stability_report(
    loop: Feedback, at: Sequence[ScalarLike] | np.ndarray
) -> MultiAxisReport: ...


@overload
def stability_report(loop: Feedback, at: OperatingPoint) -> Any: ...


def stability_report(
    loop: Feedback, at: Any = 0.0
) -> StabilityReport | MultiAxisReport:
    """Return the stability of ``loop`` for small motions around an operating point.

    ``at`` is an ``OperatingPoint``, or the reference (um) at which the loop rests, on
    the ascending branch of its hysteresis. For several axes the reference is a vector
    or a tuple with one number for each axis, in its unit, and the report is a
    MultiAxisReport.

    Raises ValueError if the loop cannot rest at the reference, its derivatives are not
    finite, or its sample time is not known.
    """
    point = OperatingPoint.at(at)
    if not isinstance(point.signal, tuple):
        return located_report(*linear_loop(loop, point), point)
    return _axes_stability(loop, point).report


class LoopCurves(NamedTuple):
    """Frequency responses [lines] of a loop of one axis.

    ``frequency`` in Hz; L, S = 1/(1+L) and T = L/(1+L) are complex.
    """

    frequency: np.ndarray
    L: np.ndarray
    S: np.ndarray
    T: np.ndarray


class AxesCurves(NamedTuple):
    """Magnitudes of the sensitivities of a loop of several axes.

    ``frequency`` [lines] in Hz; ``each`` [axes, lines] is |S| of one axis with all
    others closed, ``largest`` [lines] the largest singular value of S.
    """

    frequency: np.ndarray
    each: np.ndarray
    largest: np.ndarray


@dataclass(frozen=True)
class AxesStability:
    """Stability of a loop of several axes.

    ``report`` and ``loop`` are those on the branch of the hysteresis with the smaller
    disk margin. ``other`` is the report on the other branch, whose other margins may be
    smaller; None if only one branch is known.
    """

    report: MultiAxisReport
    loop: LinearAxes
    other: MultiAxisReport | None = None

    @property
    def reports(self) -> list[MultiAxisReport]:
        """Reports on the known branches."""
        return [one for one in (self.report, self.other) if one is not None]

    def as_dict(self) -> dict[str, Any]:
        """Return plain values for JSON: those of ``report``, and ``other_branch``."""
        other = self.other and self.other.as_dict()
        return self.report.as_dict() | {"other_branch": other}

    def curves(self) -> AxesCurves:
        """Return the magnitudes of the sensitivities against frequency."""
        angle = angle_grid(self.loop)
        alone = [self.loop.one_cut(axis) for axis in range(len(self.loop.C))]
        return AxesCurves(
            angle / (2.0 * np.pi * self.loop.dt),
            np.array([np.abs(1.0 / (1.0 + one.response(angle))) for one in alone]),
            largest_singular(self.loop.sensitivity(angle)),
        )


class WorstMargins(NamedTuple):
    """Largest Ms and smallest margins over the reports of several stable loops."""

    sensitivity_peak: float
    gain_margin_dB: float  # noqa: N815
    phase_margin_deg: float
    delay_margin_samples: float


def worst_margins(reports: Sequence[StabilityReport]) -> WorstMargins | None:
    """Return the worst figures of ``reports``, None if any loop is unstable."""
    if not all(report.stable for report in reports):
        return None

    def each(name: str) -> list[float]:
        return [getattr(report, name) for report in reports]

    return WorstMargins(
        max(each("sensitivity_peak")),
        min(each("gain_margin_dB")),
        min(each("phase_margin_deg")),
        min(each("delay_margin_samples")),
    )


@dataclass
class StabilityReports:
    """Stability of several loops at one reference: the content of ``stability.json``.

    ``reports`` and ``loops`` hold the reports and linear loops of one axis, by name and
    branch. ``axes`` holds those of several axes, by name; ``axis_names`` are the names
    of the axes. ``problems`` holds the reason for each loop that has no report.
    """

    reports: dict[str, dict[str, StabilityReport]] = field(default_factory=dict)
    loops: dict[str, dict[str, LinearLoop]] = field(default_factory=dict)
    problems: dict[str, str] = field(default_factory=dict)
    axes: dict[str, AxesStability] = field(default_factory=dict)
    axis_names: tuple[str, ...] = ()

    def add(
        self, name: str, at: str, loop: Feedback, points: Sequence[OperatingPoint]
    ) -> None:
        """Add ``loop`` of one axis at ``points``; ``at`` follows their branches."""
        found = {point.branch + at: linear_loop(loop, point) for point in points}
        reports = {
            key: located_report(*one, point)
            for (key, one), point in zip(found.items(), points, strict=True)
        }
        self.reports.setdefault(name, {}).update(reports)
        models = {key: model for key, (model, _) in found.items()}
        self.loops.setdefault(name, {}).update(models)

    def as_dict(self) -> dict[str, Any]:
        """Return plain values for JSON, by name.

        Each value holds the reports of one axis by branch, those of several axes, or a
        ``problem``.
        """
        found: dict[str, Any] = {
            name: {branch: report.as_dict() for branch, report in reports.items()}
            for name, reports in self.reports.items()
        }
        found |= {name: one.as_dict() for name, one in self.axes.items()}
        return found | {n: {"problem": why} for n, why in self.problems.items()}

    def curves(self, name: str, decades: float) -> dict[str, LoopCurves]:
        """Return the frequency responses of the loop ``name`` of one axis, by branch.

        They cover the last ``decades`` up to the Nyquist frequency. A branch equal to
        the first one is left out.
        """
        first, *others = self.loops[name].items()
        probe = np.array([1e-3, 0.1, 1.0, np.pi])
        expected = first[1].response(probe)
        distinct = dict([first]) | {
            branch: loop
            for branch, loop in others
            if not np.allclose(loop.response(probe), expected, rtol=_SAME, atol=0.0)
        }
        return {branch: _curves(loop, decades) for branch, loop in distinct.items()}


def _curves(loop: LinearLoop, decades: float) -> LoopCurves:
    angle = angle_grid(loop)
    angle = angle[angle > np.pi * 10.0**-decades]
    L = loop.response(angle)
    return LoopCurves(
        angle / (2.0 * np.pi * loop.dt), L, 1.0 / (1.0 + L), L / (1.0 + L)
    )


def stability_reports(
    loops: dict[str, Feedback],
    reference: Any = 0.0,
    dt: float | None = None,
    axis_names: tuple[str, ...] = (),
    other: Any = None,
) -> StabilityReports:
    """Return the stability of ``loops``, by name, on both branches at ``reference``.

    ``reference`` in um, ``dt`` in s. With ``axis_names`` the reference holds one number
    for each axis. On one axis the reports at ``other``, if it is another reference,
    have the names of their branches and of this reference. A loop that cannot be
    linearised at a reference is listed in ``problems``; its error is not raised.
    """
    result = StabilityReports(axis_names=axis_names)
    places = {"": reference}
    if other not in (None, reference) and not axis_names:
        places[f" at {other:.4g} um"] = other
    for name, loop in loops.items():
        for at, place in places.items():
            points = [OperatingPoint(place, branch, dt=dt) for branch in BRANCHES]
            try:
                if axis_names:
                    result.axes[name] = _both_branches(loop, points)
                else:
                    result.add(name, at, loop, points)
            # A failed analysis must not lose the tuned gains.
            except Exception as error:
                why = str(error).partition("\n")[0] or type(error).__name__
                result.problems[name + at] = why
    return result


def _both_branches(loop: Feedback, points: Sequence[OperatingPoint]) -> AxesStability:
    worse, other = sorted(
        (_axes_stability(loop, point) for point in points),
        key=lambda one: one.report.disk_margin or 0.0,
    )
    return dataclasses.replace(worse, other=other.report)


def _axes_stability(loop: Feedback, point: OperatingPoint) -> AxesStability:
    model, behind, start = linear_axes(loop, point)
    report = dataclasses.replace(
        axes_report_of(model, behind),
        reference=tuple(float(r) for r in jax.tree.leaves(point.signal)),
        command=tuple(float(u) for u in jax.tree.leaves(start.voltage)),
        branch=point.branch,
    )
    return AxesStability(report, model)
