"""Picture and table of the voltages to record."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from rich.table import Table

from ..signals.excitation import Part
from ..tuning.next_record import RecordReport
from .figures import AFTER, Pictures, figure, plot_style, write
from .page import Page

PICTURE = "excitation.png"


def excitation_page(parts: Sequence[Part], files: Mapping[str, Part]) -> Page:
    """Return the Page of ``parts``, with the length of each of ``files`` (by name)."""
    notes = [
        "the stage must not reach its mechanical limits: on a new stage, begin with a "
        "small part of the range",
    ]
    tables = [excitation_table(parts), uses_table(parts)]
    return Page("voltages to record", (), [*tables, *_how_to_record(files), *notes])


def next_record_page(
    report: RecordReport, part: Part, files: Mapping[str, Part]
) -> Page:
    """Return the Page of a designed record: what it will tell, and how to record it."""
    notes = [
        "a tracking error listed above is that of one run on the plant; the promised "
        "one is that of the worst run",
        "the standard errors are for a plant of the class of the model and white noise "
        f"of {1e3 * report.noise_rms_um:.3g} nm rms; what the model leaves out comes "
        "on top: judge the new model on another record (python -m piezojax.validate)",
    ]
    tables = [
        *(figures_table(report), parameters_table(report)),
        *(excitation_table([part]), uses_table([part])),
    ]
    return Page("the next record", (), [*tables, *_how_to_record(files), *notes])


def figures_table(report: RecordReport) -> Table:
    """Return the figures on the plant, with their errors after two records."""
    table = Table(
        title="standard errors of the promised figures",
        caption=f"designed: {report.designed_s:.3g} s; usual: ladder, holds and "
        f"multisine, {report.usual_s:.3g} s",
    )
    table.add_column("figure")
    for name in ("in one run", "designed, %", "usual, %"):
        table.add_column(name, justify="right")
    for each in report.figures:
        table.add_row(
            each.name,
            f"{each.value:.4g} {each.unit.replace('1', '')}".rstrip(),
            *(f"{100.0 * error:.3g}" for error in (each.designed, each.usual)),
        )
    return table


def parameters_table(report: RecordReport) -> Table:
    """Return the parameters of the plant, with their errors after three records."""
    table = Table(title="standard errors of the parameters of the plant")
    table.add_column("parameter", overflow="fold")
    for name in ("value", "unit", "first fit", "designed", "usual"):
        table.add_column(name, justify="left" if name == "unit" else "right")
    for each in report.parameters:
        table.add_row(
            each.path,
            f"{each.value:.5g}",
            each.unit,
            "" if each.first is None else f"{each.first:.2g}",
            f"{each.designed:.2g}",
            f"{each.usual:.2g}",
        )
    return table


def _how_to_record(files: Mapping[str, Part]) -> list[str]:
    """Return sentences on the length and the use of ``files``."""
    sizes = [
        f"{name}: {part.voltages.size} samples at {part.rate:.6g} Hz, "
        f"{part.voltages.size / part.rate:.3g} s"
        for name, part in files.items()
    ]
    return [
        *sizes,
        "start with the stage at rest; record voltage and displacement at the rate of "
        "the control loop, from the first sample on",
    ]


def excitation_table(parts: Iterable[Part]) -> Table:
    """Return a table of the parts: length, range and slew rate of each."""
    table = Table(title="parts of the record")
    table.add_column("part", no_wrap=True)
    for name in ("samples", "rate, Hz", "s", "lowest, V", "highest, V", "slew, V/s"):
        table.add_column(name, justify="right")
    for part in parts:
        count = part.voltages.size
        table.add_row(
            part.name,
            str(count),
            f"{part.rate:.6g}",
            f"{count / part.rate:.3g}",
            f"{part.voltages.min():.4g}",
            f"{part.voltages.max():.4g}",
            f"{part.steepest:.3g}",
        )
    return table


def uses_table(parts: Iterable[Part]) -> Table:
    """Return a table of what each of ``parts`` identifies."""
    table = Table(title="use of the parts")
    table.add_column("part", no_wrap=True)
    table.add_column("identifies", overflow="fold")
    for part in parts:
        table.add_row(part.name, part.tells)
    return table


def write_excitation(parts: Sequence[Part], folder: Path) -> Pictures:
    """Write excitation.png, with the voltages of ``parts``, and return the picture."""
    with plot_style():
        return write(excitation_figure(parts), folder / PICTURE)


def excitation_figure(parts: Sequence[Part]) -> Figure:
    """Return a figure with a panel for each part: its voltages over time."""
    picture = figure(9.0, 2.0 * len(parts))
    for ax, part in zip(np.ravel(picture.subplots(len(parts), 1)), parts, strict=True):
        time = np.arange(part.voltages.size) / part.rate
        ax.plot(time, part.voltages, color=AFTER, linewidth=0.8)
        ax.set_title(f"{part.name}: {part.tells}", loc="left")
        ax.set_xlabel("time (s)")
        ax.set_ylabel("voltage (V)")
    return picture
