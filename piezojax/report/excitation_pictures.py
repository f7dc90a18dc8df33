"""Picture and table of the voltages to record."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from rich.table import Table

from ..signals.excitation import Part
from .figures import AFTER, Pictures, figure, plot_style, write
from .page import Page

PICTURE = "excitation.png"


def excitation_page(parts: Sequence[Part], files: Mapping[str, Part]) -> Page:
    """Return the Page of ``parts``, with the length of each of ``files`` (by name)."""
    sizes = [
        f"{name}: {part.voltages.size} samples at {part.rate:.6g} Hz, "
        f"{part.voltages.size / part.rate:.3g} s"
        for name, part in files.items()
    ]
    notes = [
        "start with the stage at rest; record voltage and displacement at the rate of "
        "the control loop, from the first sample on",
        "the stage must not reach its mechanical limits: on a new stage, begin with a "
        "small part of the range",
    ]
    return Page("voltages to record", (), [excitation_table(parts), *sizes, *notes])


def excitation_table(parts: Iterable[Part]) -> Table:
    """Return a table of the parts: length, range, slew rate and use of each."""
    table = Table(title="parts of the record")
    table.add_column("part")
    for name in ("samples", "rate, Hz", "s", "lowest, V", "highest, V", "slew, V/s"):
        table.add_column(name, justify="right")
    table.add_column("identifies")
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
            part.tells,
        )
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
