"""Stability of a loop of several axes: which axis, and all at once."""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.figure import Figure

from ..analysis.stability.broken_loop import BRANCHES
from ..analysis.stability.conserved import LinearAxes
from ..analysis.stability.crossings import angle_grid
from ..analysis.stability.margins import linear_axes
from ..analysis.stability.multi_axis import MultiAxisReport, axes_report_of
from ..core.system import Feedback
from .figures import COLOURS, REFERENCE, figure, headed


@dataclass(frozen=True)
class AxesStability:
    """A report and its linear loop, on the branch of hysteresis that is worse."""

    report: MultiAxisReport
    loop: LinearAxes


def worse_branch(
    loop: Feedback, reference: Sequence[float], dt: float | None
) -> AxesStability:
    """Return the stability at ``reference`` on the branch with the smaller margin.

    Raises ValueError as ``stability_report``.
    """
    found = []
    for branch in BRANCHES:
        model, _ = linear_axes(loop, tuple(reference), branch, dt=dt)
        report = dataclasses.replace(
            axes_report_of(model), reference=tuple(reference), branch=branch
        )
        found.append(AxesStability(report, model))
    return min(found, key=lambda one: one.report.disk_margin or 0.0)


def axes_figure(
    stabilities: dict[str, AxesStability], names: Sequence[str], title: str
) -> Figure:
    """|S| of each axis with the others closed, and the largest singular value of S."""
    picture = figure(9.0, 3.6)
    left, right = picture.subplots(1, 2)
    lines = ("-", "--", "-.", ":")
    for name, found in stabilities.items():
        colour = COLOURS.get(name, REFERENCE)
        shown = "tuned" if name == "after" else name
        if not found.report.stable:
            continue
        angle = angle_grid(found.loop)
        hertz = angle / (2.0 * np.pi * found.loop.dt)
        for axis, axis_name in enumerate(names):
            response = found.loop.one_cut(axis).response(angle)
            left.loglog(
                hertz,
                np.abs(1.0 / (1.0 + response)),
                color=colour,
                ls=lines[axis % len(lines)],
                label=f"{axis_name}, {shown}",
            )
        sensitivity = found.loop.sensitivity(angle)
        largest = np.linalg.norm(sensitivity, 2, axis=(-2, -1))
        margin = found.report.disk_margin
        right.loglog(
            hertz,
            largest,
            color=colour,
            label=f"{shown}: disk margin {margin:.2f}",
        )
    left.set(
        xlabel="frequency (Hz)",
        ylabel="|S| of one axis (-)",
        title="Each axis, all others closed",
    )
    right.set(
        xlabel="frequency (Hz)",
        ylabel="largest singular value of S (-)",
        title="All axes at once",
    )
    for ax in (left, right):
        ax.set_ylim(bottom=1e-3)
        if ax.get_legend_handles_labels()[1]:
            ax.legend(fontsize=7.5, loc="lower right")
    headed(picture, title)
    return picture
