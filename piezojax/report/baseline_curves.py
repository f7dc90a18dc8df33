"""The table, the picture and the file of the baselines beside the search."""

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from rich.table import Table
from rich.text import Text

from ..core.files import write_text
from ..tuning.baselines import Baselines, Contestant
from ..tuning.baselines.entries import BASELINES_FILE
from .comparison_map import COLOURS, MARKERS
from .figures import AFTER, figure, headed, styled, ticks_in_full, write


def baselines_table(found: Baselines) -> Table:
    """Return loss, error and time of each method, and when ours was as good."""
    table = Table(
        title=Text(
            f"{found.title}\nbaselines on the same objective: "
            "error is the geometric mean on held-out noise\n"
            "(as good: when piezojax had a loss as low; sooner: how many times)"
        )
    )
    table.add_column("method")
    for title in ("loss", "error", "runs", "time", "as good", "sooner"):
        table.add_column(title, justify="right")
    for entry in (found.ours, *found.rivals):
        error = entry.holdout_geomean_um
        table.add_row(
            entry.method,
            "diverges" if entry.loss is None else f"{entry.loss:.4f}",
            "-" if error is None else f"{1e3 * error:.2f} nm",
            str(entry.evaluations),
            f"{entry.wall_s:.1f} s",
            _seconds(entry.reached_s) if entry is not found.ours else "",
            _times(entry.ratio) if entry is not found.ours else "",
            style="bold" if entry.method == found.best else None,
        )
        if entry is found.ours:
            table.add_section()
    return table


def baselines_text(found: Baselines) -> str:
    """Return in one line how the search did against the best baseline."""
    if found.best is None:
        return "no baseline has a stable loop"
    rival, ours = found.rival(found.best), found.ours
    if rival.ratio is None or rival.reached_s is None:
        return f"{ours.method} never was as good as {rival.method}, the best baseline"
    running, near = _times(rival.ratio_running), _times(rival.ratio_best)
    return (
        f"as good as {rival.method}, the best baseline, after {rival.reached_s:.1f} s "
        f"instead of {rival.wall_s:.1f} s: {_times(rival.ratio)} sooner, {running} "
        f"without compiling, {_times(rival.ratio_cpu)} in processor time, {near} "
        "sooner than it came within 0.001 of its end"
    )


def _seconds(value: float | None) -> str:
    return "never" if value is None else f"{value:.1f} s"


def _times(value: float | None) -> str:
    return "-" if value is None else f"{value:.1f}x"


def write_baselines(found: Baselines, folder: Path) -> None:
    """Write baselines.json and baselines.png into ``folder``."""
    write_text(folder / BASELINES_FILE, found.model_dump_json(indent=2) + "\n")
    with styled():
        write(baselines_figure(found), folder / "baselines.png")


def baselines_figure(found: Baselines) -> Figure:
    """Best loss of each method against wall time, compiling included."""
    geometric = found.aggregate == "geometric_mean"
    picture = figure(7.6, 4.0)
    ax = picture.subplots()
    colours = [colour for colour in COLOURS if colour != AFTER]
    for i, entry in enumerate(e for e in found.rivals if e.loss is not None):
        look: dict[str, Any] = {
            "color": colours[i % len(colours)],
            "label": entry.method,
        }
        if entry.unit is None:
            look |= {"marker": MARKERS[i % len(MARKERS)], "ms": 5.0, "ls": ""}
            ax.plot(entry.wall_s, _shown(entry, geometric)[-1], **look)
        else:
            ax.step(entry.times_s, _shown(entry, geometric), where="post", **look)
    ours = found.ours
    ax.step(
        ours.times_s,
        _shown(ours, geometric),
        where="post",
        color=AFTER,
        lw=2.2,
        label=ours.method,
        zorder=3,
    )
    ax.set(xscale="log", xlabel="wall time, compiling included (s)")
    headed(picture, found.title)
    ticks_in_full(ax.xaxis)
    if geometric:
        ax.set(
            yscale="log",
            ylabel="error, geometric mean of all\nreferences, relative to before (-)",
        )
        ticks_in_full(ax.yaxis)
    else:
        ax.set(ylabel="objective (-)")
    picture.legend(loc="outside right upper", fontsize=7.5)
    return picture


def _shown(entry: Contestant, geometric: bool) -> np.ndarray:
    return np.exp(entry.losses) if geometric else np.array(entry.losses)
