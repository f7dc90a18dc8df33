"""Table, picture and file of the baselines and the search of piezojax."""

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from rich.table import Table
from rich.text import Text

from ..core.files import write_report
from ..tuning.baselines import BaselineEntry, Baselines
from ..tuning.baselines.entries import BASELINES_FILE
from .comparison_map import MARKERS, SERIES_COLOURS
from .figures import AFTER, add_title, figure, plain_tick_labels, plot_style, write


def baselines_table(baselines: Baselines) -> Table:
    """Return a table of the methods: loss, held-out error, runs and wall time.

    The last two columns hold the time at which the search of piezojax reached the loss
    of the baseline, and the ratio of the wall time of the baseline to this time.
    """
    table = Table(
        title=Text(
            f"{baselines.title}\nbaselines on the same objective: "
            "error is the geometric mean on held-out noise\n"
            "(as good: time when piezojax reached this loss; sooner: time / as good)"
        )
    )
    table.add_column("method")
    for title in ("loss", "error", "runs", "time", "as good", "sooner"):
        table.add_column(title, justify="right")
    for entry in (baselines.ours, *baselines.entries):
        error = entry.holdout_geomean_um
        table.add_row(
            entry.method,
            "diverges" if entry.loss is None else f"{entry.loss:.4f}",
            "-" if error is None else f"{1e3 * error:.2f} nm",
            str(entry.evaluations),
            f"{entry.wall_s:.1f} s",
            _seconds(entry.reached_s) if entry is not baselines.ours else "",
            _times(entry.ratio) if entry is not baselines.ours else "",
            style="bold" if entry.method == baselines.best else None,
        )
        if entry is baselines.ours:
            table.add_section()
    return table


def baselines_text(baselines: Baselines) -> str:
    """Return one line that compares the search of piezojax with the best baseline."""
    if baselines.best is None:
        return "no baseline has a stable loop"
    best, ours = baselines.entry(baselines.best), baselines.ours
    if best.ratio is None or best.reached_s is None:
        return f"{ours.method} was never as good as {best.method}, the best baseline"
    running, near = _times(best.ratio_running), _times(best.ratio_best)
    return (
        f"as good as {best.method}, the best baseline, after {best.reached_s:.1f} s "
        f"instead of {best.wall_s:.1f} s: {_times(best.ratio)} sooner, {running} "
        f"without compiling, {_times(best.ratio_cpu)} in processor time; {near} sooner "
        "than the time at which the baseline was within 0.001 of its final loss"
    )


def _seconds(value: float | None) -> str:
    return "never" if value is None else f"{value:.1f} s"


def _times(value: float | None) -> str:
    return "-" if value is None else f"{value:.1f}x"


def write_baselines(baselines: Baselines, folder: Path) -> None:
    """Write baselines.json and baselines.png into ``folder``."""
    write_report(folder / BASELINES_FILE, baselines)
    with plot_style():
        write(baselines_figure(baselines), folder / "baselines.png")


def baselines_figure(baselines: Baselines) -> Figure:
    """Draw the best loss of each method against wall time, compiling included."""
    geometric = baselines.aggregate == "geometric_mean"
    picture = figure(7.6, 4.0)
    ax = picture.subplots()
    colours = [colour for colour in SERIES_COLOURS if colour != AFTER]
    for i, entry in enumerate(e for e in baselines.entries if e.loss is not None):
        style: dict[str, Any] = {
            "color": colours[i % len(colours)],
            "label": entry.method,
        }
        if entry.unit is None:
            style |= {"marker": MARKERS[i % len(MARKERS)], "ms": 5.0, "ls": ""}
            ax.plot(entry.wall_s, _as_drawn(entry, geometric)[-1], **style)
        else:
            ax.step(entry.times_s, _as_drawn(entry, geometric), where="post", **style)
    ours = baselines.ours
    ax.step(
        ours.times_s,
        _as_drawn(ours, geometric),
        where="post",
        color=AFTER,
        lw=2.2,
        label=ours.method,
        zorder=3,
    )
    ax.set(xscale="log", xlabel="wall time, compiling included (s)")
    add_title(picture, baselines.title)
    plain_tick_labels(ax.xaxis)
    if geometric:
        ax.set(
            yscale="log",
            ylabel="error, geometric mean of all\nreferences, relative to before (-)",
        )
        plain_tick_labels(ax.yaxis)
    else:
        ax.set(ylabel="objective (-)")
    picture.legend(loc="outside right upper", fontsize=7.5)
    return picture


def _as_drawn(entry: BaselineEntry, geometric: bool) -> np.ndarray:
    """Return the losses, or their exponentials for a ``geometric`` mean."""
    return np.exp(entry.losses) if geometric else np.array(entry.losses)
