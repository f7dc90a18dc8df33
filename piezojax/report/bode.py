"""Pictures and files of a stability report."""

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MultipleLocator

from ..analysis.stability.broken_loop import BRANCHES
from ..analysis.stability.conserved import LinearLoop
from ..analysis.stability.crossings import angle_grid
from ..analysis.stability.margins import StabilityReport, linear_loop, located_report
from ..core.files import write_text
from ..core.system import Feedback
from .axes_bode import AxesStability, axes_figure, worse_branch
from .figures import COLOURS, MEASURED, REFERENCE, figure, headed, styled, write

STABILITY_FILE, STABILITY_PICTURE = "stability.json", "stability.png"

LINES = {"ascending": "-", "descending": "--"}
_DECADES = 4.5  # below the Nyquist frequency
_REACH = 2.5  # half the side of the Nyquist plot


@dataclass
class Comparison:
    """Reports and linear loops by their name, then by branch.

    ``axes`` holds loops of several axes, whose names are ``axis_names``. ``problems``
    says, by name, why a loop has none.
    """

    reports: dict[str, dict[str, StabilityReport]] = field(default_factory=dict)
    loops: dict[str, dict[str, LinearLoop]] = field(default_factory=dict)
    problems: dict[str, str] = field(default_factory=dict)
    axes: dict[str, AxesStability] = field(default_factory=dict)
    axis_names: tuple[str, ...] = ()

    def as_dict(self) -> dict[str, Any]:
        """Return plain values for JSON: by name, then by branch, or ``problem``."""
        found: dict[str, Any] = {
            name: {branch: report.as_dict() for branch, report in reports.items()}
            for name, reports in self.reports.items()
        }
        found |= {n: one.report.as_dict() for n, one in self.axes.items()}
        return found | {n: {"problem": why} for n, why in self.problems.items()}


def compared(
    reference: Any = 0.0,
    dt: float | None = None,
    axis_names: tuple[str, ...] = (),
    **loops: Feedback,
) -> Comparison:
    """Return the stability of the named loops at ``reference`` (um), both branches.

    With several axes a reference for each of ``axis_names``, and the worse branch. A
    loop that cannot be linearised is among the problems; none is raised.
    """
    result = Comparison(axis_names=axis_names)
    for name, loop in loops.items():
        try:
            if axis_names:
                result.axes[name] = worse_branch(loop, reference, dt)
                continue
            found = {
                branch: linear_loop(loop, reference, branch, dt=dt)
                for branch in BRANCHES
            }
            result.reports[name] = {
                branch: located_report(model, float(reference), start, branch)
                for branch, (model, start) in found.items()
            }
            result.loops[name] = {b: model for b, (model, _) in found.items()}
        # Whatever goes wrong here, the gains that were found stay worth having.
        except Exception as error:
            why = str(error).partition("\n")[0] or type(error).__name__
            result.problems[name] = why
    return result


def write_stability(comparison: Comparison, folder: Path, title: str = "") -> None:
    """Write stability.json and stability.png into ``folder``."""
    text = json.dumps(comparison.as_dict(), indent=2, allow_nan=False)
    write_text(folder / STABILITY_FILE, text + "\n")
    if comparison.loops:
        with styled():
            picture = stability_figure(comparison, title)
            write(picture, folder / STABILITY_PICTURE)
    if comparison.axes:
        with styled():
            picture = axes_figure(comparison.axes, comparison.axis_names, title)
            write(picture, folder / STABILITY_PICTURE)


def stability_figure(comparison: Comparison, title: str = "") -> Figure:
    """Bode and Nyquist plots of L, and the sensitivities |S| and |T|.

    The branches of a hysteresis are drawn full (ascending) and dashed (descending),
    where they differ.
    """
    picture = figure(9.0, 6.6)
    (gain, nyquist), (phase, sensitivity) = picture.subplots(2, 2)
    for name, loops in comparison.loops.items():
        for branch, loop in _different(loops).items():
            style: dict[str, Any] = {
                "color": COLOURS.get(name, REFERENCE),
                "ls": LINES[branch],
            }
            angle = angle_grid(loop)
            angle = angle[angle > np.pi * 10.0**-_DECADES]
            hertz = angle / (2.0 * np.pi * loop.dt)
            response = loop.response(angle)
            report = comparison.reports[name][branch]
            label = _label(name, branch, loops)
            gain.loglog(hertz, np.abs(response), label=label, **style)
            degrees = np.degrees(np.unwrap(np.angle(response)))
            # Drawn in the turn in which it starts between -360 and 0.
            degrees -= 360.0 * np.ceil(degrees[0] / 360.0 - 1e-6)
            phase.semilogx(hertz, degrees, **style)
            nyquist.plot(np.real(response), np.imag(response), label=label, **style)
            _sensitivities(sensitivity, hertz, response, report, label, style)
    gain.axhline(1.0, color=REFERENCE, lw=0.8)
    gain.set(ylabel="|L| (-)", title="Loop transfer function, cut at the plant's input")
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
        title="Sensitivity |S|, and thin |T|",
    )
    low, high = sensitivity.get_ylim()
    sensitivity.set_ylim(max(low, 1e-3), 30.0 * high)  # room for the legend
    if sensitivity.get_legend_handles_labels()[1]:
        sensitivity.legend(fontsize=7.5, loc="upper left")
    if title:
        headed(picture, title)
    return picture


def _sensitivities(
    ax: Axes,
    hertz: np.ndarray,
    response: np.ndarray,
    report: StabilityReport,
    label: str,
    style: dict[str, Any],
) -> None:
    if report.sensitivity_peak is None:  # unstable: S and T say nothing
        return
    ax.loglog(
        hertz,
        np.abs(1.0 / (1.0 + response)),
        label=f"{label}: Ms = {report.sensitivity_peak:.2f}",
        **style,
    )
    ax.loglog(hertz, np.abs(response / (1.0 + response)), lw=0.6, **style)


def _different(loops: dict[str, LinearLoop]) -> dict[str, LinearLoop]:
    """Leave out a branch that is the same as the first."""
    first, *others = loops.items()
    probe = np.array([1e-3, 0.1, 1.0, np.pi])
    return dict([first]) | {
        branch: loop
        for branch, loop in others
        if not np.allclose(
            loop.response(probe), first[1].response(probe), rtol=1e-5, atol=0.0
        )
    }


def _label(name: str, branch: str, loops: dict[str, LinearLoop]) -> str:
    shown = "tuned" if name == "after" else name
    return f"{shown}, {branch}" if len(_different(loops)) > 1 else shown


def _critical_point(ax: Axes) -> None:
    turn = np.linspace(0.0, 2.0 * np.pi, 200)
    ax.plot(np.cos(turn), np.sin(turn), color=MEASURED, lw=0.7)
    ax.plot(np.cos(turn) / 2 - 1, np.sin(turn) / 2, color=MEASURED, lw=0.7, ls=":")
    ax.plot([-1.0], [0.0], "+", color=REFERENCE, ms=9.0, mew=1.4)
    ax.set(
        xlim=(-_REACH, _REACH),
        ylim=(-_REACH, _REACH),
        aspect="equal",
        xlabel="real part of L",
        ylabel="imaginary part of L",
        title="Nyquist plot; inside the dots |S| > 2",
    )
