"""Picture and table of a watch of a stage."""

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from rich.table import Table

from ..stages import RunFeatures, WatchReport
from .figures import (
    AFTER,
    BEFORE,
    MEASURED,
    add_title,
    figure,
    plot_style,
    write,
)
from .page import Page

WATCH_PICTURE = "watch.png"

_COLUMNS = {
    "gain_percent": "gain (%)",
    "lag_us": "lag (µs)",
    "log_error": "rms error (nm)",
    "log_rest": "rest of voltage (mV)",
}
"""Names of the features, as in pictures and tables."""


def write_watch(report: WatchReport, folder: Path) -> None:
    """Write watch.png into ``folder`` if there is a baseline."""
    if report.baseline:
        with plot_style():
            write(_figure(report), folder / WATCH_PICTURE)


def _figure(report: WatchReport) -> Figure:
    picture = figure(9.0, 4.6)
    later = [run.features for run in report.runs if run.features is not None]
    panels = picture.subplots(2, 2).ravel()
    for panel, name in zip(panels, _COLUMNS, strict=True):
        known = np.array([_shown(each, name) for each in report.baseline])
        panel.axhspan(known.min(), known.max(), color="#eef4f6", zorder=0)
        panel.plot(np.arange(1, len(known) + 1), known, "o", color=MEASURED, ms=4)
        for place, run in enumerate(report.runs, len(known) + 1):
            if run.features is not None:
                colour = BEFORE if run.moved else AFTER
                panel.plot(place, _shown(run.features, name), "D", color=colour, ms=5)
        panel.set(ylabel=_COLUMNS[name], xlabel="run")
    compared = f"{len(later)} runs compared with" if report.runs else "baseline:"
    add_title(
        picture,
        f"Watch of {report.stage} under {report.reference}: {compared} "
        f"{len(report.baseline)} runs\ngrey: baseline; blue: as before; brown: changed",
    )
    return picture


def _shown(features: RunFeatures, name: str) -> float:
    """Return a feature in the unit of its column."""
    value = getattr(features, name)
    return 10.0 ** (value + 3.0) if name.startswith("log") else value


def watch_page(report: WatchReport, title: str) -> Page:
    """Return the Page of a watch; ``title`` is that of the study."""
    changed = sum(run.moved for run in report.runs)
    verdict = (
        f"{changed} of {len(report.runs)} runs differ from the baseline; on an "
        f"unchanged stage {100.0 * report.false_alarms:g} % of the runs would"
        if report.runs
        else "these runs are a baseline; compare later ones with --baseline"
    )
    return Page(
        f"{title}: watch of {report.stage}",
        report.alarms,
        [watch_table(report), verdict],
    )


def watch_table(report: WatchReport) -> Table:
    """Return the features of the baseline and of the later runs."""
    table = Table(title=f"runs of {report.reference}: change of the stage")
    table.add_column("run")
    for name in (*_COLUMNS.values(), "T²", "threshold"):
        table.add_column(name, justify="right")
    if report.baseline:
        rows = {
            "baseline, mean": np.mean,
            "baseline, deviation": lambda values: np.std(values, ddof=1),
        }
        for label, figure_of in rows.items():
            values = [
                figure_of([_shown(each, name) for each in report.baseline])
                for name in _COLUMNS
            ]
            table.add_row(label, *(f"{value:.3g}" for value in values), "", "")
    for run in report.runs:
        if run.features is None or run.distance is None or run.threshold is None:
            table.add_row(run.file, *["-"] * len(_COLUMNS), "stopped", "")
            continue
        values = [_shown(run.features, name) for name in _COLUMNS]
        table.add_row(
            run.file,
            *(f"{value:.3g}" for value in values),
            f"{run.distance:.3g}",
            f"{run.threshold:.3g}",
        )
    return table
