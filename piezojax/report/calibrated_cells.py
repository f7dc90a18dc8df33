"""Picture and table of a stage fitted to half of the cells."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure
from rich.table import Table

from ..reproduction.calibration import EXPERIMENTS, Swap
from ..reproduction.judged import BAR
from ..reproduction.selection import Round
from .figures import AFTER, BEFORE, REFERENCE, figure, styled, write

Judged = Mapping[str, Mapping[str, Any]]
"""Figures of an experiment by its fitted half, as ``judged.as_plain`` returns them."""


def write_calibration(
    found: Mapping[str, Sequence[Swap]], judged: Mapping[str, Judged], folder: Path
) -> None:
    """Write calibration.png into ``folder``."""
    with styled():
        write(calibration_figure(found, judged), folder / "calibration.png")


def calibration_figure(
    found: Mapping[str, Sequence[Swap]], judged: Mapping[str, Judged]
) -> Figure:
    """Draw simulation against print: a row an experiment, a panel a fitted half."""
    picture = figure(8.4, 4.2 * len(found))
    panels = picture.subplots(len(found), 2, squeeze=False)
    for row, (name, swaps) in zip(panels, found.items(), strict=True):
        for ax, swap in zip(row, swaps, strict=True):
            both = [*swap.train, *swap.held_out]
            low = 0.8 * min(min(c.paper, c.sim) for c in both)
            high = 1.25 * max(max(c.paper, c.sim) for c in both)
            ax.plot([low, high], [low, high], color=REFERENCE, lw=0.8)
            half = judged[name][swap.half]
            for label, ratios, cells, marker, colour in (
                ("fitted", half["fitted"], swap.train, "o", BEFORE),
                ("held out", half["held_out"], swap.held_out, "s", AFTER),
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
                title=f"{name}\nfitted to the {swap.half} cells",
                xlabel="printed (µm)",
                ylabel="simulated (µm)",
            )
            ax.legend(loc="upper left")
    return picture


def calibration_table(name: str, swaps: Sequence[Swap], judged: Judged) -> Table:
    """Return ratios, fitted values and the choice of the doubts, a column a half.

    A print that one half alone puts in doubt has no value in the other's column.
    """
    table = Table(title=f"{name}: fitted to one half of the cells, judged on the other")
    table.add_column("")
    for swap in swaps:
        table.add_column(f"fitted: {swap.half}", justify="right")
    halves = [judged[swap.half] for swap in swaps]

    def ratios(part: str) -> list[str]:
        return [f"{half[part]['geomean_ratio']:.3f}" for half in halves]

    table.add_row("geometric-mean ratio, fitted", *ratios("fitted"))
    table.add_row("geometric-mean ratio, held out", *ratios("held_out"), style="bold")
    alone = ratios("held_out_without_doubts")
    table.add_row("the same, the stage alone, no print in doubt", *alone)
    met = ("met" if half["met"] else "missed" for half in halves)
    table.add_row(f"bar of {BAR:g}", *met)
    table.add_section()
    places = [half["held_out"]["columns"] for half in halves]
    for place in sorted({name for columns in places for name in columns}):
        table.add_row(
            f"held out, {place}", *(f"{columns[place]:.3f}" for columns in places)
        )
    table.add_section()
    every = [name for swap in swaps for name in swap.values]
    for quantity, about in EXPERIMENTS[name].quantities().items():
        if quantity in every:
            values = (
                f"{swap.values[quantity]:.4g}" if quantity in swap.values else "-"
                for swap in swaps
            )
            table.add_row(f"{quantity} ({about.unit})", *values)
    table.add_row("pull towards print", *(f"{swap.strength:g}" for swap in swaps))
    table.add_section()
    for number in range(max(len(swap.rounds) for swap in swaps)):
        told = (_told(swap.rounds[number : number + 1]) for swap in swaps)
        table.add_row(f"cross-validated inside the half, doubt {number + 1}", *told)
    return table


def together_table(halves: Mapping[str, Mapping[str, Any]]) -> Table:
    """Return the ratio of all held-out cells, a column a half.

    ``halves`` is the result of ``judged.together``.
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
    judged = ("met" if half["met"] else "missed" for half in halves.values())
    table.add_row(f"bar of {BAR:g}", *judged)
    return table


def _told(rounds: Sequence[Round]) -> str:
    """Return what the round said, one finalist a line; nothing for no round."""
    return "\n".join(
        line
        for found in rounds
        for line in (
            f"without: {found.before:.3f}",
            *(
                f"{name}{' (taken)' if name == found.taken else ''}: {ratio:.3f}"
                for name, ratio in found.after.items()
            ),
        )
    )
