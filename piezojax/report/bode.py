"""Pictures and files of a stability report."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MultipleLocator

from ..analysis.stability import AxesStability, StabilityReport, StabilityReports
from ..analysis.stability.assess import LoopCurves
from ..core.files import write_json
from .figures import (
    LOOP_COLOURS,
    MEASURED,
    REFERENCE,
    Pictures,
    add_title,
    figure,
    plot_style,
    write,
)

STABILITY_FILE, STABILITY_PICTURE = "stability.json", "stability.png"

LINES = {"ascending": "-", "descending": "--"}
_DECADES = 4.5  # decades drawn below the Nyquist frequency
_HALF_SIDE = 2.5  # half the side of the Nyquist plot


def write_stability(
    stability: StabilityReports, folder: Path, title: str = ""
) -> Pictures:
    """Write stability.json and stability.png into ``folder``; return the picture."""
    write_json(folder / STABILITY_FILE, stability.as_dict())
    drawn: Pictures = {}
    with plot_style():
        if stability.loops:
            picture = stability_figure(stability, title)
            drawn = write(picture, folder / STABILITY_PICTURE)
        if stability.axes:
            picture = axes_figure(stability.axes, stability.axis_names, title)
            drawn = write(picture, folder / STABILITY_PICTURE)
    return drawn


def stability_figure(stability: StabilityReports, title: str = "") -> Figure:
    """Draw the Bode and Nyquist plots of L, and |S| and |T|.

    If the branches of the hysteresis differ, the ascending one is drawn solid and the
    descending one dashed, both at the reference of the margins.
    """
    picture = figure(9.0, 6.6)
    (gain, nyquist), (phase, sensitivity) = picture.subplots(2, 2)
    for panel in (phase, sensitivity):
        panel.sharex(gain)
    for name in stability.loops:
        curves = stability.curves(name, _DECADES)
        branches = {branch: curves[branch] for branch in LINES if branch in curves}
        for branch, curves in branches.items():
            style: dict[str, Any] = {
                "color": LOOP_COLOURS.get(name, REFERENCE),
                "ls": LINES[branch],
            }
            report = stability.reports[name][branch]
            displayed = _label(name)
            label = f"{displayed}, {branch}" if len(branches) > 1 else displayed
            hertz, L = curves.frequency, curves.L
            gain.loglog(hertz, np.abs(L), label=label, **style)
            degrees = np.degrees(np.unwrap(np.angle(L)))
            # Whole turns are subtracted so that the phase starts between -360° and 0°.
            degrees -= 360.0 * np.ceil(degrees[0] / 360.0 - 1e-6)
            phase.semilogx(hertz, degrees, label=label, **style)
            nyquist.plot(np.real(L), np.imag(L), label=label, **style)
            _sensitivities(sensitivity, curves, report, label, style)
    gain.axhline(1.0, color=REFERENCE, lw=0.8)
    gain.set(ylabel="|L| (-)", title="Loop transfer function, cut at the plant's input")
    low, high = gain.get_ylim()
    gain.set_ylim(max(low, 1e-6), high)  # cuts off a zero at the Nyquist frequency
    gain.legend(fontsize=7.5)
    phase.axhline(-180.0, color=REFERENCE, lw=0.8)
    phase.set(xlabel="frequency (Hz)", ylabel="phase of L (°)")
    phase.yaxis.set_major_locator(MultipleLocator(90.0))
    low, high = phase.get_ylim()
    phase.set_ylim(max(low, -720.0), min(high, 90.0))
    _critical_point(nyquist)
    sensitivity.set(
        xlabel="frequency (Hz)",
        ylabel="|S|, |T| (-)",
        title="Sensitivity |S|; thin lines: |T|",
    )
    low, high = sensitivity.get_ylim()
    sensitivity.set_ylim(max(low, 1e-3), 30.0 * high)  # room for the legend
    if sensitivity.get_legend_handles_labels()[1]:
        sensitivity.legend(fontsize=7.5, loc="upper left")
    if title:
        add_title(picture, title)
    return picture


def _label(name: str) -> str:
    return "tuned" if name == "after" else name


def _sensitivities(
    ax: Axes,
    curves: LoopCurves,
    report: StabilityReport,
    label: str,
    style: dict[str, Any],
) -> None:
    if report.sensitivity_peak is None:  # S and T of an unstable loop have no meaning
        return
    label = f"{label}: Ms = {report.sensitivity_peak:.2f}"
    ax.loglog(curves.frequency, np.abs(curves.S), label=label, **style)
    ax.loglog(curves.frequency, np.abs(curves.T), lw=0.6, **style)


def _critical_point(ax: Axes) -> None:
    angle = np.linspace(0.0, 2.0 * np.pi, 200)
    ax.plot(np.cos(angle), np.sin(angle), color=MEASURED, lw=0.7)
    ax.plot(np.cos(angle) / 2 - 1, np.sin(angle) / 2, color=MEASURED, lw=0.7, ls=":")
    ax.plot([-1.0], [0.0], "+", color=REFERENCE, ms=9.0, mew=1.4)
    ax.set(
        xlim=(-_HALF_SIDE, _HALF_SIDE),
        ylim=(-_HALF_SIDE, _HALF_SIDE),
        aspect="equal",
        xlabel="real part of L",
        ylabel="imaginary part of L",
        title="Nyquist plot; |S| > 2 inside the dotted circle",
    )


def axes_figure(
    stabilities: dict[str, AxesStability], names: Sequence[str], title: str
) -> Figure:
    """Draw |S| of each axis, the others closed, and the largest singular value of S."""
    picture = figure(9.0, 3.6)
    left, right = picture.subplots(1, 2)
    lines = ("-", "--", "-.", ":")
    for name, stability in stabilities.items():
        report = stability.report
        if not report.stable:
            continue
        colour, curves = LOOP_COLOURS.get(name, REFERENCE), stability.curves()
        for axis, (axis_name, size) in enumerate(zip(names, curves.each, strict=True)):
            left.loglog(
                curves.frequency,
                size,
                color=colour,
                ls=lines[axis % len(lines)],
                label=f"{axis_name}, {_label(name)}",
            )
        right.loglog(
            curves.frequency,
            curves.largest,
            color=colour,
            label=f"{_label(name)}: disk margin {report.disk_margin:.2f}",
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
    add_title(picture, title)
    return picture
