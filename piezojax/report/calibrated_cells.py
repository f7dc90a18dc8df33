"""Picture and table of a stage fitted to half of the cells."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure
from rich.table import Table

from ..reproduction.calibration import EXPERIMENTS, HalfFit
from ..reproduction.calibration_report import TARGET
from ..reproduction.selection import Round
from .figures import AFTER, BEFORE, REFERENCE, figure, plot_style, write

Report = Mapping[str, Mapping[str, Any]]
"""Report of an experiment by its fitted half, from ``calibration_report``."""


def write_calibration(
    fits: Mapping[str, Sequence[HalfFit]], reports: Mapping[str, Report], folder: Path
) -> None:
    """Write calibration.png into ``folder``."""
    with plot_style():
        write(calibration_figure(fits, reports), folder / "calibration.png")


def calibration_figure(
    fits: Mapping[str, Sequence[HalfFit]], reports: Mapping[str, Report]
) -> Figure:
    """Draw simulated against printed values: a row per experiment, a panel per half."""
    picture = figure(8.4, 4.2 * len(fits))
    panels = picture.subplots(len(fits), 2, squeeze=False)
    for row, (name, halves) in zip(panels, fits.items(), strict=True):
        for ax, fit in zip(row, halves, strict=True):
            both = [*fit.train, *fit.held_out]
            low = 0.8 * min(min(c.paper, c.sim) for c in both)
            high = 1.25 * max(max(c.paper, c.sim) for c in both)
            ax.plot([low, high], [low, high], color=REFERENCE, lw=0.8)
            half = reports[name][fit.half]
            for label, ratios, cells, marker, colour in (
                ("fitted", half["fitted"], fit.train, "o", BEFORE),
                ("held out", half["held_out"], fit.held_out, "s", AFTER),
            ):
                ax.loglog(
                    [c.paper for c in cells],
                    [c.sim for c in cells],
                    marker,
                    ms=4,
                    color=colour,
                    label=f"{label}: {ratios['geomean_ratio']:.3f}",
                )
            ax.set(
                title=f"{name}\nfitted to the {fit.half} cells",
                xlabel="printed (µm)",
                ylabel="simulated (µm)",
            )
            ax.legend(loc="upper left")
    return picture


def calibration_table(name: str, fits: Sequence[HalfFit], report: Report) -> Table:
    """Return the ratios, fitted values and selection rounds, one column for each half.

    A suspect number that only one half selected has a dash in the other column.
    """
    table = Table(title=f"{name}: fitted to one half of the cells, tested on the other")
    table.add_column("")
    for fit in fits:
        table.add_column(f"fitted: {fit.half}", justify="right")
    halves = [report[fit.half] for fit in fits]

    def ratios(part: str) -> list[str]:
        return [f"{half[part]['geomean_ratio']:.3f}" for half in halves]

    table.add_row("geometric-mean ratio, fitted", *ratios("fitted"))
    table.add_row("geometric-mean ratio, held out", *ratios("held_out"), style="bold")
    alone = ratios("held_out_stage_only")
    table.add_row("held out, stage alone", *alone)
    met = ("met" if half["met"] else "missed" for half in halves)
    table.add_row(f"target of {TARGET:g}", *met)
    table.add_section()
    places = [half["held_out"]["columns"] for half in halves]
    for place in sorted({name for columns in places for name in columns}):
        table.add_row(
            f"held out, {place}", *(f"{columns[place]:.3f}" for columns in places)
        )
    table.add_section()
    every = [name for fit in fits for name in fit.values]
    for quantity, about in EXPERIMENTS[name].quantities().items():
        if quantity in every:
            values = (
                f"{fit.values[quantity]:.4g}" if quantity in fit.values else "-"
                for fit in fits
            )
            table.add_row(f"{quantity} ({about.unit})", *values)
    table.add_row("weight of the penalty", *(f"{fit.penalty_weight:g}" for fit in fits))
    table.add_section()
    for number in range(max(len(fit.rounds) for fit in fits)):
        rounds = (_round_text(fit.rounds[number : number + 1]) for fit in fits)
        table.add_row(f"cross-validated inside the half, round {number + 1}", *rounds)
    return table


def held_out_table(halves: Mapping[str, Mapping[str, Any]]) -> Table:
    """Return the ratio of all held-out cells, one column for each half.

    ``halves`` is the result of ``calibration_report.held_out_ratios``.
    """
    table = Table(title="all held-out cells of Tables 5-3, 5-5 and 4-5")
    table.add_column("")
    for half in halves:
        table.add_column(f"fitted: {half}", justify="right")
    ratios = [half["held_out"]["geomean_ratio"] for half in halves.values()]
    table.add_row(
        "cells", *(str(half["held_out"]["cells"]) for half in halves.values())
    )
    table.add_row("geometric-mean ratio", *(f"{x:.3f}" for x in ratios), style="bold")
    met = ("met" if half["met"] else "missed" for half in halves.values())
    table.add_row(f"target of {TARGET:g}", *met)
    return table


def _round_text(rounds: Sequence[Round]) -> str:
    """Return the ratios of a round, without and with each finalist, one on each line.

    Return "" if ``rounds`` is empty.
    """
    return "\n".join(
        line
        for entry in rounds
        for line in (
            f"without: {entry.before:.3f}",
            *(
                f"{name}{' (taken)' if name == entry.taken else ''}: {ratio:.3f}"
                for name, ratio in entry.after.items()
            ),
        )
    )
