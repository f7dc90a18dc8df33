"""Picture and tables of a trial of gains on a stage."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from rich.table import Table

from ..stages import Motion, TrialReport, TriedRun
from ..stages.run_files import load_samples
from .figures import (
    AFTER,
    BEFORE,
    REFERENCE,
    Pictures,
    add_title,
    figure,
    legend_above,
    plain_number,
    plot_style,
    write,
)
from .page import Page

TRIAL_PICTURE = "trial.png"

DRAWN = 6
"""Largest number of runs in one picture: the last ones."""


def write_trial(
    report: TrialReport, folder: Path, motions: Sequence[Motion], dt: float
) -> Pictures:
    """Write the picture of the runs in ``folder``; ``dt`` is their sample time, s."""
    shown = [run for run in report.runs if (folder / run.file).exists()][-DRAWN:]
    if not shown:
        return {}
    starts = {motion.name: motion.start * dt for motion in motions}
    with plot_style():
        return write(
            _trial_figure(report, shown, folder, starts, dt), folder / TRIAL_PICTURE
        )


def _trial_figure(
    report: TrialReport,
    shown: Sequence[TriedRun],
    folder: Path,
    starts: dict[str, float],
    dt: float,
) -> Figure:
    picture = figure(9.0, 2.2 * len(shown) + 0.8)
    panels = picture.subplots(len(shown), 2, squeeze=False)
    for (motion, error), run in zip(panels, shown, strict=True):
        draw_run(motion, error, folder / run.file, dt)
        motion.set(title=f"{run.reference}, {100.0 * run.share:g} %\n")
        error.set(title=_title(run))
        error.axvspan(0.0, starts[run.reference], color="#eef4f6", zorder=0)
    for panel in panels[-1]:
        panel.set(xlabel="time (s)")
    add_title(
        picture, f"Trial on {report.stage}: {report.verdict}\nshaded: not counted"
    )
    return picture


def draw_run(motion: Axes, error: Axes, file: Path, dt: float) -> None:
    """Draw reference and reading of the run in ``file``, and their difference."""
    reference, measured, _ = load_samples(file)
    time = dt * np.arange(len(reference))
    motion.plot(time, reference, color=REFERENCE, lw=0.8, label="reference")
    motion.plot(time, measured, color=AFTER, lw=0.9, label="reading")
    motion.set(ylabel="µm")
    legend_above(motion)
    error.plot(time, 1e3 * (reference - measured), color=BEFORE, lw=0.7)
    error.set(ylabel="error (nm)")


def _title(run: TriedRun) -> str:
    if run.error_um is None:
        return f"Stopped: {run.stopped}"
    return (
        f"Error: {nanometres(run.error_um)} rms, promised {nanometres(run.promised_um)}"
    )


def trial_page(report: TrialReport, title: str, units: Mapping[str, str]) -> Page:
    """Return the Page of a trial.

    ``title`` is that of the study; ``units`` holds the units of the gains by path.
    """
    return Page(
        f"{title}: trial on {report.stage}",
        report.alarms,
        [
            runs_table(report.runs),
            stage_gains_table(report.before, report.gains, "tried", units),
            f"verdict: the gains are {_VERDICTS[report.verdict]}",
            *(f"note: {note}" for note in report.notes),
        ],
    )


_VERDICTS = {
    "kept": "kept on the stage",
    "restored": "those from before the trial",
    "stopped": "the safe ones of the stage",
    "lost": "unknown, for the reason in the alarm",
    "running": "being tried",
}


def runs_table(runs: Sequence[TriedRun]) -> Table:
    """Return the errors of ``runs`` beside those that were promised."""
    table = Table(title="runs on the stage: rms error")
    table.add_column("reference", overflow="fold")
    for name in ("motion", "measured", "without noise", "promised", "ratio", "largest"):
        table.add_column(name, justify="right")
    table.add_column("voltage", justify="right")
    for run in runs:
        figures = [run.measured_um, run.error_um, run.promised_um]
        ratio = "-" if run.error_um is None else f"{run.ratio:.2f}"
        voltage = (
            "-"
            if run.voltage_V is None
            else "{:.1f} to {:.1f} V".format(*run.voltage_V)
        )
        table.add_row(
            run.reference,
            f"{100.0 * run.share:g} %",
            *map(nanometres, figures),
            ratio,
            nanometres(run.peak_um),
            voltage,
        )
    return table


def stage_gains_table(
    before: Mapping[str, float],
    gains: Mapping[str, float],
    name: str,
    units: Mapping[str, str],
) -> Table:
    """Return a table of the gains ``before``, and ``gains`` in the column ``name``."""
    table = Table(title="gains of the stage")
    table.add_column("gain", overflow="fold")
    for column in ("before", name):
        table.add_column(column, justify="right")
    table.add_column("unit")
    for path, value in gains.items():
        unit = units.get(path, "")
        table.add_row(path, f"{before[path]:.5g}", f"{value:.5g}", unit)
    return table


def nanometres(value_um: float | None) -> str:
    """Return a length in nm, "-" if it is not known."""
    return "-" if value_um is None else f"{plain_number(1e3 * value_um)} nm"
