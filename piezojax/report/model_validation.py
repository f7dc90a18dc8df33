"""Files, picture and tables of ``validate``."""

from itertools import groupby
from pathlib import Path

from matplotlib.figure import Figure
from rich.table import Table

from ..core.files import write_report
from ..core.serial import save
from ..identification.residual_record import ResidualRecord, save_residual
from ..identification.validation import RecordCheck, Validation, ValidationReport
from .figures import (
    AFTER,
    BEFORE,
    MEASURED,
    Pictures,
    add_title,
    figure,
    legend_above,
    plot_style,
    write,
)
from .fit_pictures import MODEL_FILE, display_unit
from .page import Page

VALIDATION_FILE, VALIDATION_PICTURE = "validation.json", "validation.png"

DRAWN = 6
"""Largest number of records in one picture."""

WORDS = {"amplitude": "input range in a stretch", "rate": "input slope"}


def write_validation(
    found: Validation, folder: Path, residual: ResidualRecord | None = None
) -> Pictures:
    """Write model.json with the verdict, validation.json and the returned picture.

    ``residual`` is that of the model over its own record.
    """
    save(found.system, folder / MODEL_FILE, found.about)
    if residual is not None:
        save_residual(residual, folder / MODEL_FILE)
    write_report(folder / VALIDATION_FILE, found.report)
    with plot_style():
        return write(validation_figure(found), folder / VALIDATION_PICTURE)


def validation_figure(found: Validation) -> Figure:
    """Draw output and error of the first output of each record, six records at most."""
    shown = list(zip(found.records, found.runs, found.report.records, strict=True))
    shown = shown[:DRAWN]
    picture = figure(9.0, 2.4 * len(shown) + 0.8)
    panels = picture.subplots(len(shown), 2, squeeze=False)
    for (over_time, error), (record, run, check) in zip(panels, shown, strict=True):
        unit, time = display_unit(record.output_units[0]), record.time
        measured = record.outputs[:, 0]
        over_time.plot(time, measured, color=MEASURED, label="measured")
        over_time.plot(time, run[:, 0], color=AFTER, lw=0.9, label="model")
        over_time.set(ylabel=f"output ({unit})", title=f"{record.source}\n")
        legend_above(over_time)
        error.plot(time, run[:, 0] - measured, color=BEFORE, lw=0.7)
        rms = "diverges" if check.rmse is None else f"{check.rmse:.3g} {unit} rms"
        error.set(ylabel=f"error ({unit})", title=f"Error: {rms}")
        first, last = (time[k] for k in (check.estimated[0], check.estimated[1] - 1))
        for panel in (over_time, error):
            panel.axvspan(first, last, color="#eef4f6", zorder=0)
    for panel in panels[-1]:
        panel.set(xlabel="time (s)")
    model = found.about.record or "of unknown origin"
    add_title(
        picture,
        f"Model fitted to {model}, on other records\n"
        "shaded: state and zero estimated there, errors not counted",
    )
    return picture


def validation_page(found: Validation) -> Page:
    """Return the Page of a model that was judged on other records."""
    report = found.report
    return Page(
        "model judged on " + ", ".join(check.record for check in report.records),
        report.alarms,
        [
            validation_table(report),
            *input_lines(report),
            *(f"note: {note}" for note in report.notes),
        ],
        found.about.origin("Model of a plant"),
    )


def validation_table(report: ValidationReport) -> Table:
    """Return the errors by record."""
    table = Table(title="error of the model on other records, free run")
    table.add_column("record", overflow="fold")
    for name in ("rms", "largest", "% of span", "x fit", "zero", "judged from"):
        table.add_column(name, justify="right")
    for check in report.records:
        table.add_row(
            check.record,
            *_errors(check),
            "-" if check.times_fit is None else f"{check.times_fit:.2f}",
            ", ".join(f"{zero:.3g} {check.unit}" for zero in check.zero),
            f"{check.judged[0] / check.rate_Hz:.3g} s",
        )
    return table


def _errors(check: RecordCheck) -> tuple[str, str, str]:
    if check.rmse is None or check.largest is None or check.percent_of_span is None:
        return "diverges", "-", "-"
    return (
        f"{check.rmse:.3g} {check.unit}",
        f"{check.largest:.3g} {check.unit}",
        f"{check.percent_of_span:.2f}",
    )


def input_lines(report: ValidationReport) -> list[str]:
    """Return the errors by amplitude and rate, a line for each kind and record."""
    lines = []
    for check in report.records:
        for kind, parts in groupby(check.by_input, lambda part: part.kind):
            shown = "; ".join(
                f"{part.low:.3g} to {part.high:.3g} {part.unit}: "
                f"{part.rmse:.3g} {check.unit}"
                for part in parts
            )
            lines.append(f"{check.record}, rms error by {WORDS[kind]}: {shown}")
    return lines
