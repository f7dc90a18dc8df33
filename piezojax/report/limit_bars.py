"""File, picture and text on the limit of linear control."""

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ..analysis.limit import NEAR, LimitReport
from ..core.files import write_json
from .figures import (
    AFTER,
    BEFORE,
    MEASURED,
    REFERENCE,
    add_title,
    figure,
    plot_style,
    write,
)

LIMIT_FILE, LIMIT_PICTURE = "limit.json", "limit.png"

CAUSES: dict[str | None, str] = {
    "noise": "passes more sensor noise than necessary",
    "unpredicted": "cancels too little of the unpredicted disturbance",
    "predicted": "leaves an error that a linear filter of the reference would cancel",
    None: "is too nonlinear to name a cause",
}
"""Causes of a large error, by the name of ``LimitComparison.largest_excess``."""


def write_limit(report: LimitReport | str, folder: Path, title: str = "") -> None:
    """Write limit.json, and limit.png if there is a limit, into ``folder``."""
    content = {"problem": report} if isinstance(report, str) else report.as_dict()
    write_json(folder / LIMIT_FILE, content)
    if not isinstance(report, str):
        with plot_style():
            write(limit_figure(report, title), folder / LIMIT_PICTURE)


NO_LIMIT = 1e4
"""Ratio of the tuned error to the limit above which the limit is a rounding error."""


def limit_text(report: LimitReport | str) -> str:
    """Return lines on the ratio to the limit, with the causes of a large ratio."""
    if isinstance(report, str):
        return f"note: no limit of linear control: {report}"
    if report.ratio > NO_LIMIT:
        return (
            "limit of linear control: zero up to rounding, because a controller with "
            "preview would cancel every disturbance of the study"
        )
    count = len(report.references)
    lines = [
        "limit of linear control with full preview (resolution "
        f"{report.resolution:.3g} Hz): the tuned error is {report.ratio:.2f}x the "
        f"limit, {report.near} of {count} references within {NEAR:g}x; it is "
        f"{report.ratio_to_one_controller:.2f}x the error of one linear controller for "
        f"all references, {report.near_one_controller} of {count} within {NEAR:g}x"
    ]
    by_cause: dict[str | None, list[str]] = {}
    below = []
    for name, found in report.references.items():
        if found.ratio < 1.0:
            below.append(f"{name} {found.ratio:.2f}x")
        elif found.ratio > NEAR:
            by_cause.setdefault(found.largest_excess, []).append(
                f"{name} {found.ratio:.2f}x"
            )
    lines += [
        f"note: on {', '.join(names)} the loop {CAUSES[cause]}"
        for cause, names in by_cause.items()
    ]
    if below:
        lines.append(
            f"note: {', '.join(below)}: below the limit, which is possible for a "
            "nonlinear controller or one with a better model of the stage"
        )
    return "\n".join(lines)


def limit_figure(report: LimitReport, title: str = "") -> Figure:
    """Draw errors and limits by reference, and the spectra of the worst reference."""
    picture = figure(9.0, 3.8)
    left, right = picture.subplots(1, 2, width_ratios=(1.0, 1.1))
    _errors(left, report)
    _spectra(right, report)
    if title:
        add_title(picture, title)
    return picture


def _errors(ax: Axes, report: LimitReport) -> None:
    names = list(report.references)
    rows = np.arange(len(names))[::-1]
    for key, colour, marker, label in (
        ("limit", REFERENCE, "|", "limit, a linear controller for each"),
        ("one_controller", BEFORE, "d", "best linear controller for all"),
        ("tuned", AFTER, "o", "tuned"),
    ):
        values = [1e3 * getattr(report.references[name], key) for name in names]
        ax.plot(values, rows, marker, color=colour, label=label, ms=6.0, mew=1.6)
    limits = np.array([1e3 * report.references[name].limit for name in names])
    ax.hlines(rows, limits, NEAR * limits, color=MEASURED, lw=0.8)
    ax.set(
        xlabel=f"rms error (nm); lines end at {NEAR:g} times the limit",
        yticks=rows,
        yticklabels=names,
        ylim=(-0.6, len(names) + 1.4),  # room for the legend
        xlim=(0.0, None),
    )
    ax.legend(loc="upper left", fontsize=7.5)


def _spectra(ax: Axes, report: LimitReport) -> None:
    """Draw the spectra of the reference with the largest ratio of error to limit."""
    worst = report.worst
    densities = report.densities(worst)
    for name, colour, width, label in (
        ("unpredicted", MEASURED, 0.9, "disturbance, not predicted"),
        ("noise", BEFORE, 0.9, "sensor noise"),
        ("limit", REFERENCE, 1.2, "error at the limit"),
        ("tuned", AFTER, 1.2, "error, tuned"),
    ):
        nanometres = 1e3 * densities[name]
        ax.loglog(
            report.curves.frequency, nanometres, color=colour, lw=width, label=label
        )
    top = 1e3 * np.max(densities["unpredicted"])
    ax.set(
        xlim=(report.resolution / 2.0, None),
        ylim=(1e-5 * top, 30.0 * top),
        xlabel="frequency (Hz)",
        ylabel="amplitude density (nm/√Hz)",
        title=f"{worst}, {report.references[worst].ratio:.2f} times its limit",
    )
    ax.legend(loc="upper right", fontsize=7.5)
