"""Table and picture of the structures of a study."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from rich.table import Table
from rich.text import Text

from ..tuning.structure_choice import LIMITING, Structure, StructureSearch
from .figures import AFTER, MEASURED, REFERENCE, add_title, figure, plain_tick_labels


def structures_table(search: StructureSearch) -> Table:
    """Return the structures with their errors on the hold-out in nm, and the choice."""
    table = Table(title=Text(f"structures; chosen: {search.criterion}"))
    table.add_column("notches at, Hz")
    for name in ("parameters", "error, nm", "worst, nm", "Ms"):
        table.add_column(name, justify="right", no_wrap=True)
    table.add_column("choice")
    for one in search.structures:
        table.add_row(
            label_of(one),
            str(one.parameters or "-"),
            _nanometres(one.error_um),
            _nanometres(one.worst_um),
            "-" if one.sensitivity_peak is None else f"{one.sensitivity_peak:.2f}",
            one.reason,
            style="bold" if one.chosen else None,
        )
    return table


def label_of(one: Structure) -> str:
    """Return the number of notches of a structure with their frequencies in Hz."""
    shown = one.notches_Hz or (one.at_Hz if one.gains else [])
    if not one.notches:
        return "none"
    where = ", ".join(f"{frequency:.4g}" for frequency in shown)
    return f"{one.notches}: {where}" if shown else f"{one.notches}"


def _nanometres(value: float | None) -> str:
    return "-" if value is None else f"{1e3 * value:.2f}"


def structures_figure(search: StructureSearch | None, title: str) -> Figure | None:
    """Draw the errors of each structure, and the modes in two of the tuned loops.

    They are the loops of the first structure and of the chosen one. Return None if
    fewer than two structures were tuned.
    """
    tuned = [one for one in search.structures if one.log_errors] if search else []
    if len(tuned) < 2:
        return None
    picture = figure(9.0, 3.4)
    left, right = picture.subplots(1, 2)
    _draw_errors(left, tuned)
    _draw_modes(right, tuned)
    add_title(picture, title)
    return picture


def _draw_errors(panel: Axes, tuned: Sequence[Structure]) -> None:
    for place, one in enumerate(tuned):
        errors = [1e3 * np.exp(x) for x in one.log_errors if x is not None]
        colour = AFTER if one.chosen else MEASURED
        spread = np.linspace(-0.18, 0.18, len(errors)) if len(errors) > 1 else [0.0]
        panel.plot(place + np.asarray(spread), errors, "o", ms=2.5, color=colour)
        if one.error_um is not None:
            ends = [place - 0.3, place + 0.3]
            panel.plot(ends, [1e3 * one.error_um] * 2, color=colour, lw=2.0)
    labels = [label_of(one).replace(": ", "\n") for one in tuned]
    panel.set_xticks(range(len(tuned)), labels, fontsize=7.5)
    panel.set_yscale("log")
    plain_tick_labels(panel.yaxis)
    panel.set(
        xlabel="notches, at Hz",
        ylabel="rms error on the hold-out (nm)",
        title="each plant or reference; bar: median or mean",
    )


def _draw_modes(panel: Axes, tuned: Sequence[Structure]) -> None:
    chosen = next(one for one in tuned if one.chosen)
    first = tuned[0]
    shown = [(first, MEASURED, "s", label_of(first))]
    if chosen is not first:
        shown.append((chosen, AFTER, "o", f"{label_of(chosen)}, chosen"))
    for one, colour, marker, label in shown:
        points = [
            (m.frequency_Hz, m.part_of_loop_gain)
            for m in one.modes
            if m.part_of_loop_gain
        ]
        if points:
            panel.plot(
                *zip(*points, strict=True),
                marker,
                color=colour,
                label=f"notches: {label}" if one.notches else "no notch",
            )
    for frequency in chosen.notches_Hz:
        panel.axvline(frequency, color=AFTER, lw=0.8, ls=":")
    panel.axhline(LIMITING, color=REFERENCE, ls="--", lw=0.9, label="limits the loop")
    panel.set(
        xscale="log",
        yscale="log",
        xlabel="mode of the plant (Hz)",
        ylabel="its part of the loop gain |L| (-)",
        title="tuned loops; dotted: the notches",
    )
    plain_tick_labels(panel.xaxis)
    panel.legend(fontsize=7.5)
