"""Table, picture and file of a comparison of tuned controllers."""

import math
from collections.abc import Sequence
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator
from rich.table import Table
from rich.text import Text

from ..core.files import write_report
from ..tuning.comparison import COMPARISON_FILE, ComparisonResult, TunedStudy
from .figures import (
    AFTER,
    BEFORE,
    MEASURED,
    figure,
    plain_tick_labels,
    plot_style,
    write,
)
from .page import Page

MARKERS = "osD^vPX*<>hp"
SERIES_COLOURS = (
    "#1f6f8b",
    "#c9753d",
    "#5b8c3a",
    "#8a4f9e",
    "#b03a48",
    "#7a6a2b",
    "#3f5fa8",
    "#4a4a4a",
)
_COLUMNS = 4


def comparison_page(comparison: ComparisonResult, studies: int) -> Page:
    """Return the Page of ``comparison``; ``studies`` is the number of all studies."""
    perturbed = perturbed_table(comparison)
    parts = [
        comparison_table(comparison),
        *((perturbed, perturbed_text(comparison)) if perturbed is not None else ()),
        *(f"note: {row.study}: {n}" for row in comparison.rows for n in row.notes),
        f"{comparison.status}: {len(comparison.rows)} of {studies} studies, "
        f"{comparison.wall_s:.0f} s",
    ]
    alarms = [f"{row.study}: {a}" for row in comparison.rows for a in row.alarms]
    return Page(comparison.title, alarms, parts)


def comparison_table(comparison: ComparisonResult) -> Table:
    """Return a table of rms errors before and after tuning, by controller and rate."""
    table = Table(
        title=Text(
            f"{comparison.title}\nrms tracking error on held-out noise, nm: geometric "
            "mean over the references\n(new: references that were not tuned on; "
            "* before: gains scaled from another rate; ! tuned: with an alarm)"
        )
    )
    table.add_column("controller")
    for title in ("kHz", "before", "tuned", "better", "new: before", "tuned", "better"):
        table.add_column(title, justify="right")
    for controller in dict.fromkeys(row.controller for row in comparison.rows):
        for row in _rows_of(comparison, controller):
            wins = comparison.best.get(f"{row.rate_Hz:g}") == controller
            table.add_row(
                controller,
                f"{row.rate_Hz / 1000:g}",
                _nanometres(row.before_um) + ("*" if row.start == "scaled" else ""),
                "failed" if row.status == "failed" else _tuned(row),
                _times(row.ratio),
                _nanometres(row.unseen_before_um),
                _nanometres(row.unseen_um),
                _times(row.unseen_ratio),
                style="bold" if wins else None,
            )
        table.add_section()
        better = comparison.better[controller], comparison.unseen_better[controller]
        table.add_row(
            "geometric mean", "", "", "", _times(better[0]), "", "", _times(better[1])
        )
        table.add_section()
    return table


def _tuned(row: TunedStudy) -> str:
    return _nanometres(row.after_um) + ("!" if row.alarms else "")


def perturbed_table(comparison: ComparisonResult) -> Table | None:
    """Return a table of errors on held-out perturbed plants; None without any."""
    rows = [row for row in comparison.rows if row.perturbed is not None]
    if not rows:
        return None
    several = len({row.rate_Hz for row in rows}) > 1
    table = Table(
        title=Text(
            "rms tracking error on held-out perturbed plants, nm: geometric mean over "
            "the references\n(median and worst plant; bold: lowest; ! with an alarm; "
            "Ms: largest)"
        )
    )
    table.add_column("controller")
    for title in ("gains", "before", "tuned", "worst", "unstable", "Ms"):
        table.add_column(title, justify="right", no_wrap=True)
    for row in rows:
        found = row.perturbed
        assert found is not None
        peak = found.constraints.get("sensitivity_peak")
        rate = f"{row.rate_Hz:g}"
        wins = comparison.best_perturbed.get(rate) == row.controller
        table.add_row(
            row.controller + (f", {float(rate) / 1000:g} kHz" if several else ""),
            str(row.tuned),
            _fine_nanometres(found.geomean_before_rms_um),
            _fine_nanometres(found.geomean_rms_um) + ("!" if row.alarms else ""),
            _fine_nanometres(found.worst_rms_um),
            f"{found.unstable} of {found.plants}",
            "-" if peak is None or peak.value is None else f"{peak.value:.2f}",
            style="bold" if wins else None,
        )
    return table


def perturbed_text(comparison: ComparisonResult) -> str:
    """Return a line for each rate: the two best controllers on held-out plants."""
    lines = []
    for rate, best in comparison.best_perturbed.items():
        errors = {
            row.controller: row.perturbed_um
            for row in comparison.rows
            if f"{row.rate_Hz:g}" == rate and row.perturbed_um is not None
        }
        least = errors.pop(best)
        line = f"lowest on held-out plants at {float(rate) / 1000:g} kHz: {best}"
        if errors:
            name, error = min(errors.items(), key=lambda item: item[1])
            line += f"; the next, {name}, has {error / least:.2f} times its error"
        lines.append(line)
    return "\n".join(lines)


def write_comparison(comparison: ComparisonResult, folder: Path) -> None:
    """Write comparison.json and comparison.png into ``folder``."""
    write_report(folder / COMPARISON_FILE, comparison)
    if any(row.after_um for row in comparison.rows):
        with plot_style():
            write(comparison_figure(comparison), folder / "comparison.png")


def comparison_figure(comparison: ComparisonResult) -> Figure:
    """Draw the errors of the controllers before and after tuning.

    Studies of several rates have a panel for each controller over the rate, and one for
    all, tuned. Those of one rate have a line each.
    """
    if len({row.rate_Hz for row in comparison.rows}) == 1:
        return _at_one_rate(comparison)
    controllers = list(comparison.better)
    columns = min(_COLUMNS, len(controllers) + 1)
    lines = math.ceil((len(controllers) + 1) / columns)
    picture = figure(2.45 * columns + 0.5, 2.3 * lines + 0.7)
    axes = picture.subplots(lines, columns, squeeze=False, sharex=True, sharey=True)
    places = list(axes.flat)
    lowest = _lowest_errors(comparison)
    for i, (controller, ax) in enumerate(zip(controllers, places, strict=False)):
        _before_and_tuned(ax, _rows_of(comparison, controller), lowest)
        better = comparison.better[controller]
        shown = f"{better:.3g}x better" if better else "no factor"
        ax.set_title(f"({chr(97 + i)}) {controller}\n{shown}", fontsize=8.0)
    every = places[len(controllers)]
    for i, controller in enumerate(controllers):
        rows = [row for row in _rows_of(comparison, controller) if row.after_um]
        every.plot(
            *_curve(rows, "after_um"),
            color=SERIES_COLOURS[i % len(SERIES_COLOURS)],
            marker=MARKERS[i % len(MARKERS)],
            ms=3.5,
            label=controller,
        )
    every.set_title(f"({chr(97 + len(controllers))}) all, tuned", fontsize=8.0)
    for ax in places[len(controllers) + 1 :]:
        ax.set_visible(False)
    rates = sorted({row.rate_Hz for row in comparison.rows})
    for ax in places:
        ax.set(xscale="log", yscale="log")
        ax.set_xticks([rate / 1000 for rate in rates])
        ax.set_xticklabels([f"{rate / 1000:g}" for rate in rates])
        ax.xaxis.set_minor_locator(NullLocator())
    for ax in axes[-1]:
        ax.set_xlabel("sampling rate (kHz)")
    for ax in axes[:, 0]:
        ax.set_ylabel("rms error (nm)")
    handles = _legend_handles(axes)
    picture.legend(
        handles.values(),
        handles.keys(),
        loc="outside lower center",
        ncols=columns,
        fontsize=7.5,
    )
    return picture


def _at_one_rate(comparison: ComparisonResult) -> Figure:
    rows = comparison.rows
    picture = figure(5.5, 0.9 + 0.36 * len(rows))
    ax = picture.subplots()
    places = range(len(rows))
    for place, row in zip(places, rows, strict=True):
        if row.before_um and row.after_um:
            ends = [1e3 * row.before_um, 1e3 * row.after_um]
            ax.plot(ends, [place] * 2, color=MEASURED, lw=0.8, zorder=1)
    for field, marker, colour, face, label in (
        ("before_um", "o", BEFORE, BEFORE, "before"),
        ("after_um", "s", AFTER, AFTER, "tuned"),
        ("unseen_um", "s", AFTER, "white", "tuned, other references"),
    ):
        errors = [getattr(row, field) for row in rows]
        known = [(1e3 * e, place) for e, place in zip(errors, places, strict=True) if e]
        if known:
            ax.plot(
                *zip(*known, strict=True),
                color=colour,
                mfc=face,
                marker=marker,
                ms=4.5,
                ls="",
                label=label,
            )
    ax.set_yticks([*places], [row.study + ("!" if row.alarms else "") for row in rows])
    ax.set(
        xscale="log",
        xlabel="rms error on held-out noise (nm)",
        ylim=(len(rows) - 0.5, -0.5),
    )
    plain_tick_labels(ax.xaxis)
    picture.legend(loc="outside lower center", ncols=3, fontsize=7.5)
    return picture


def _before_and_tuned(
    ax: Axes, rows: Sequence[TunedStudy], lowest: dict[float, float]
) -> None:
    ax.plot(
        [rate / 1000 for rate in lowest],
        [1e3 * error for error in lowest.values()],
        color=MEASURED,
        ls=":",
        label="lowest of all",
    )
    known = [row for row in rows if row.before_um]
    ax.plot(*_curve(known, "before_um"), color=BEFORE, lw=1.0)
    for start, face, label in (
        ("printed", BEFORE, "before, printed gains"),
        ("scaled", "white", "before, scaled gains"),
        ("rule", "#eed3bc", "before, by rule"),
        ("own", BEFORE, "before"),
    ):
        some = [row for row in known if row.start == start]
        if some:
            ax.plot(
                *_curve(some, "before_um"),
                color=BEFORE,
                mfc=face,
                marker="o",
                ms=4.5,
                ls="",
                label=label,
            )
    tuned = [row for row in rows if row.after_um]
    ax.plot(
        *_curve(tuned, "after_um"),
        color=AFTER,
        marker="s",
        ms=4.0,
        label="tuned",
    )


def _curve(rows: Sequence[TunedStudy], field: str) -> tuple[list[float], list[float]]:
    rows = sorted(rows, key=lambda row: row.rate_Hz)
    return [row.rate_Hz / 1000 for row in rows], [
        1e3 * getattr(row, field) for row in rows
    ]


def _legend_handles(axes) -> dict:
    handles: dict = {}
    for ax in axes.flat:
        for handle, label in zip(*ax.get_legend_handles_labels(), strict=True):
            handles.setdefault(label, handle)
    return handles


def _lowest_errors(comparison: ComparisonResult) -> dict[float, float]:
    lowest: dict[float, float] = {}
    for row in sorted(comparison.rows, key=lambda row: row.rate_Hz):
        if row.after_um:
            lowest[row.rate_Hz] = min(row.after_um, lowest.get(row.rate_Hz, math.inf))
    return lowest


def _rows_of(comparison: ComparisonResult, controller: str) -> list[TunedStudy]:
    return [row for row in comparison.rows if row.controller == controller]


def _nanometres(value: float | None) -> str:
    return "-" if value is None else f"{1e3 * value:.1f}"


def _fine_nanometres(value: float | None) -> str:
    return "-" if value is None else f"{1e3 * value:.2f}"


def _times(value: float | None) -> str:
    return "-" if value is None else f"{value:.1f}x"
