"""Picture and table of iterative learning on a stage."""

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from rich.table import Table

from ..stages.learning import LEARNED_FILE, LearnReport
from ..stages.run_files import load_samples
from .figures import (
    AFTER,
    BEFORE,
    Pictures,
    add_title,
    figure,
    legend_above,
    plain_tick_labels,
    plot_style,
    write,
)
from .page import Page
from .trial_report import nanometres

LEARN_PICTURE = "learn.png"


def write_learning(report: LearnReport, folder: Path, dt: float) -> Pictures:
    """Write the picture of the runs in ``folder``; ``dt`` is their sample time, s.

    Return the picture. If no run was completed, there is none.
    """
    if report.best is None:
        return {}
    with plot_style():
        return write(_figure(report, folder, dt), folder / LEARN_PICTURE)


def _figure(report: LearnReport, folder: Path, dt: float) -> Figure:
    assert report.best is not None
    picture = figure(9.0, 5.2)
    (runs, correction), (error, motion) = picture.subplots(2, 2)
    measured = [1e3 * (run.measured_um or np.nan) for run in report.runs]
    runs.plot(np.arange(1, len(measured) + 1), measured, "o-", color=AFTER, ms=4)
    runs.set(yscale="log", xlabel="run", ylabel="rms error (nm)")
    runs.set(xticks=range(1, len(measured) + 1))
    plain_tick_labels(runs.yaxis)
    shown = {"first run": (0, BEFORE), f"run {report.best + 1}": (report.best, AFTER)}
    for label, (place, colour) in shown.items():
        wanted, reading, _ = load_samples(folder / report.runs[place].file)
        time = dt * np.arange(len(wanted))
        error.plot(time, 1e3 * (wanted - reading), color=colour, lw=0.7, label=label)
    error.set(xlabel="time (s)", ylabel="error (nm)")
    legend_above(error)
    table = np.loadtxt(folder / LEARNED_FILE, delimiter=",", skiprows=1)
    time, wanted, learned = table.T
    correction.plot(time, 1e3 * (learned - wanted), color=AFTER, lw=0.8)
    correction.set(xlabel="time (s)", ylabel="correction (nm)")
    motion.plot(time, learned, color=AFTER, lw=0.8)
    motion.set(xlabel="time (s)", ylabel="learned reference (µm)")
    add_title(picture, f"Learning {report.reference} on {report.stage}")
    return picture


def learn_page(report: LearnReport, title: str) -> Page:
    """Return the Page of iterative learning; ``title`` is that of the study."""
    return Page(
        f"{title}: learning {report.reference} on {report.stage}",
        report.alarms,
        [
            _table(report),
            _outcome(report),
            *(f"note: {note}" for note in report.notes),
        ],
    )


def _outcome(report: LearnReport) -> str:
    left = {
        "done": "the gains from before",
        "stopped": "its safe gains",
        "lost": "unknown gains, for the reason in the alarm",
        "running": "the gains of the runs",
    }[report.verdict]
    if report.best is None:
        return f"no run was completed; the stage has {left}"
    first, best = (report.runs[i].measured_um for i in (0, report.best))
    return (
        f"{nanometres(first)} to {nanometres(best)} rms, {report.ratio:.3g} times "
        f"smaller; the reference of run {report.best + 1} is in {LEARNED_FILE}; the "
        f"stage has {left}"
    )


def _table(report: LearnReport) -> Table:
    table = Table(title=f"runs of {report.reference}: error with noise")
    table.add_column("run", justify="right")
    for name in ("rms", "largest", "voltage"):
        table.add_column(name, justify="right")
    for number, run in enumerate(report.runs, start=1):
        voltage = run.voltage_V
        table.add_row(
            f"{number}" + (f": {run.stopped}" if run.stopped else ""),
            nanometres(run.measured_um),
            nanometres(run.peak_um),
            "-" if voltage is None else f"{voltage[0]:.1f} to {voltage[1]:.1f} V",
        )
    return table
