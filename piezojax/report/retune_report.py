"""Picture and tables of a retuning on a stage."""

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from rich.table import Table

from ..stages import TriedRun
from ..stages.run_files import load_samples
from ..tuning.attempts import Attempt, RetuneReport
from ..tuning.stage_bench import PROBE
from .figures import (
    AFTER,
    BEFORE,
    REFERENCE,
    Pictures,
    add_title,
    figure,
    legend_above,
    plain_tick_labels,
    plot_style,
    write,
)
from .page import Page
from .trial_report import draw_run, nanometres, stage_gains_table

RETUNE_PICTURE = "retune.png"

FIRST, BEST, BOTH = "first run", "best run", "first and best run"


def write_retuning(report: RetuneReport, folder: Path, dt: float) -> Pictures:
    """Write the picture of the runs in ``folder``; ``dt`` is their sample time, s.

    Return the picture. If no gains followed the references, there is none.
    """
    if report.best is None:
        return {}
    with plot_style():
        return write(_figure(report, folder, dt), folder / RETUNE_PICTURE)


def _figure(report: RetuneReport, folder: Path, dt: float) -> Figure:
    runs = _first_and_best(report)
    picture = figure(9.0, 0.8 + 2.2 * (1 + len(runs)))
    (attempts, drive), *panels = picture.subplots(1 + len(runs), 2)
    _draw_attempts(attempts, report)
    for (title, run), (motion, error) in zip(runs.items(), panels, strict=True):
        draw_run(motion, error, folder / run.file, dt)
        motion.set(xlabel="time (s)", title=f"{run.reference}, {title}\n")
        shown = run.stopped or f"{nanometres(run.measured_um)} rms"
        error.set(xlabel="time (s)", title=f"Error: {shown}")
        _, _, voltage = load_samples(folder / run.file)
        time = dt * np.arange(len(voltage))
        colour = AFTER if title == BEST else BEFORE
        drive.plot(time, voltage, color=colour, lw=0.8, label=title)
    drive.set(ylabel="voltage (V)", xlabel="time (s)")
    legend_above(drive)
    add_title(picture, f"Retuning on {report.stage}: {_ratio(report)}")
    return picture


def _first_and_best(report: RetuneReport) -> dict[str, TriedRun]:
    """Return the first and the best run of the first reference by their titles.

    There is one run if the first is the best, or if none was completed.
    """
    runs = [run for run in report.runs if run.reference != PROBE]
    same = [run for run in runs if run.reference == runs[0].reference]
    measured = [run for run in same if run.measured_um is not None]
    if not measured:
        return {FIRST: same[0]}
    best = min(measured, key=lambda run: run.measured_um or 0.0)
    return {BOTH: best} if best is same[0] else {FIRST: same[0], BEST: best}


def _draw_attempts(panel: Axes, report: RetuneReport) -> None:
    for name, colour in (("predicted_um", REFERENCE), ("measured_um", AFTER)):
        known = {
            place: 1e3 * value
            for place, attempt in enumerate(report.attempts, start=1)
            if (value := getattr(attempt, name))
        }
        if known:
            style = {"color": colour, "marker": "o", "ms": 4, "lw": 0.8}
            panel.plot(*zip(*known.items(), strict=True), **style, label=name[:-3])
    panel.set(yscale="log", ylabel="rms error (nm)", xlabel="attempt")
    panel.set(xticks=range(1, len(report.attempts) + 1))
    plain_tick_labels(panel.yaxis)
    legend_above(panel)


def retune_page(report: RetuneReport) -> Page:
    """Return the Page of a retuning."""
    parts = [attempts_table(report), _runs_table(report)]
    if report.best is not None:
        best = report.attempts[report.best].gains
        parts.append(stage_gains_table(report.before, best, "best", report.units))
    return Page(
        f"{report.title}: retuning on {report.stage}",
        report.alarms,
        [
            *parts,
            f"{_ratio(report)}; the stage has {_left(report)}",
            *(f"note: {note}" for note in report.notes),
        ],
    )


def _ratio(report: RetuneReport) -> str:
    if report.best is None:
        return "no gains followed the references"
    before = report.attempts[0].measured_um
    best = nanometres(report.attempts[report.best].measured_um)
    if not report.improved:
        return f"{best} rms, and no better gains were found"
    if before is None:
        return f"{best} rms after a start that was stopped"
    return f"{nanometres(before)} to {best} rms, {report.ratio:.3g} times smaller"


def _left(report: RetuneReport) -> str:
    if report.verdict == "lost":
        return "unknown gains, for the reason in the alarm"
    if report.verdict == "done" and report.best is not None:
        return f"the gains of attempt {report.best + 1}"
    return "its safe gains"


def attempts_table(report: RetuneReport) -> Table:
    """Return the table of the attempts: predicted and measured errors, and verdicts."""
    table = Table(title="attempts: rms error with noise, mean of the references")
    table.add_column("attempt", justify="right")
    for name in ("gains", "predicted", "measured"):
        table.add_column(name, justify="right")
    table.add_column("verdict", overflow="fold")
    for number, attempt in enumerate(report.attempts, start=1):
        table.add_row(
            f"{number}",
            _within(attempt),
            nanometres(attempt.predicted_um),
            nanometres(attempt.measured_um),
            attempt.verdict + (", set at the end" if number - 1 == report.best else ""),
        )
    return table


def _within(attempt: Attempt) -> str:
    if not attempt.model:
        return "of the stage"
    return (
        "within the study"
        if attempt.within is None
        else f"within a factor {attempt.within:.3g}"
    )


def _runs_table(report: RetuneReport) -> Table:
    table = Table(title="runs on the stage: rms error with noise")
    table.add_column("file")
    table.add_column("reference", overflow="fold")
    table.add_column("error", justify="right")
    table.add_column("largest", justify="right")
    table.add_column("voltage", justify="right")
    for run in report.runs:
        voltage = run.voltage_V
        table.add_row(
            run.file,
            run.reference + (f": {run.stopped}" if run.stopped else ""),
            nanometres(run.measured_um),
            nanometres(run.peak_um),
            "-" if voltage is None else f"{voltage[0]:.1f} to {voltage[1]:.1f} V",
        )
    return table
