"""Tables that the commands print at their end."""

import math
from collections.abc import Sequence
from itertools import takewhile

from rich.table import Table
from rich.text import Text

from ..analysis.stability import StabilityReport, StabilityReports, worst_margins
from ..core.registry import parts
from ..identification.fit import FitReport
from ..identification.methods import METHODS
from ..reproduction.cell import Cell, title_of
from ..reproduction.summary import GroupedAgreement, TableAgreement
from ..tuning.result import Perturbed, Result, Scores


def models_table() -> Table:
    """Return what can be identified: whole models, and parts to be joined by '+'."""
    table = Table(title="models; parts are joined by '+', as in coleman_hodgdon+lag")
    for column in ("model", "kind", "what it is, or how it is fitted"):
        table.add_column(column, no_wrap=column == "model", overflow="fold")
    for name, kind in parts().items():
        table.add_row(name, f"part: {kind.part.place}", kind.part.summary)
    for name, method in METHODS.items():
        for model in method.models:
            table.add_row(model, f"method: {name}", method.summary)
    return table


def _nanometres(value: float | None) -> str:
    return "diverges" if value is None else f"{1e3 * value:.2f}"


def _ratio(before: float | None, after: float | None) -> str:
    return f"{before / after:.1f}x" if before and after else "-"


def tuning_table(result: Result) -> Table:
    """Return the before/after table on held-out noise, in nm rms."""
    unit = " or ".join(dict.fromkeys(_SMALL[u] for u in result.units.values())) or "nm"
    table = Table(
        title=Text(f"{result.title}\nrms tracking error on held-out noise, {unit}")
    )
    table.add_column("reference")
    for title in ("before", "tuned", "better", "peak, tuned"):
        table.add_column(title, justify="right")
    sections: list[tuple[str, Scores | None, Scores | None]] = [
        ("geometric mean", result.holdout_before, result.holdout),
        ("geometric mean, not tuned on", result.unseen_before, result.unseen),
        ("geometric mean, axes at rest", result.coupling_before, result.coupling),
    ]
    for heading, before, after in sections:
        if before is None or after is None:
            continue
        many = len(before.per_reference_rms_um) > _MOST_ROWS
        for name, error in before.per_reference_rms_um.items():
            if many and heading == sections[-1][0]:
                break  # two of three axes rest under each reference
            tuned = after.per_reference_rms_um[name]
            peak = after.peak_error_um[name]
            table.add_row(
                name,
                _nanometres(error),
                _nanometres(tuned),
                _ratio(error, tuned),
                _nanometres(peak),
            )
        table.add_section()
        table.add_row(
            heading,
            _nanometres(before.geomean_rms_um),
            _nanometres(after.geomean_rms_um),
            _ratio(before.geomean_rms_um, after.geomean_rms_um),
            "",
            style="bold",
        )
        table.add_section()
    return table


_SMALL = {"um": "nm", "urad": "nrad"}
"""Units a thousand times smaller, in which errors are shown."""

_MOST_ROWS = 12  # of the axes at rest


def perturbed_text(found: Perturbed) -> str:
    """Return one line on the plants of the ensemble."""
    if found.unstable or found.median_better is None:
        return (
            f"{found.plants} perturbed plants: {found.unstable} unstable "
            f"({found.unstable_before} before)"
        )
    rest = (
        f", axes at rest {found.coupling_better:.2f}x" if found.coupling_better else ""
    )
    return (
        f"{found.plants} perturbed plants: none unstable "
        f"({found.unstable_before} before), {found.median_better:.1f}x better in the "
        f"median, {found.worst_better:.1f}x on the worst{rest}"
    )


def gains_table(result: Result) -> Table:
    """Return the tuned parameters beside their start."""
    # What all paths share is said once: long ones would squeeze out the numbers.
    parents = zip(*(path.split(".")[:-1] for path in result.gains), strict=False)
    alike = takewhile(lambda names: len(set(names)) == 1, parents)
    shared = ".".join(names[0] for names in alike)
    table = Table(title=f"gains of {shared}" if shared else "gains")
    table.add_column("parameter")
    table.add_column("before", justify="right", no_wrap=True)
    table.add_column("tuned", justify="right", no_wrap=True)
    table.add_column("unit", no_wrap=True)
    for path, value in result.gains.items():
        name, unit = path.removeprefix(f"{shared}."), result.gain_units.get(path, "")
        shown = "" if unit == "1" else unit
        table.add_row(name, f"{result.start[path]:.4g}", f"{value:.4g}", shown)
    return table


def stability_table(found: StabilityReports) -> Table:
    """Return the margins of each loop, on the worse branch of a hysteresis."""
    table = Table(title="stability for small motions, worse branch of the hysteresis")
    table.add_column("loop")
    for title in ("Ms", "gain margin", "phase margin", "delay margin"):
        table.add_column(title, justify="right")
    for name, branches in found.reports.items():
        shown = "tuned" if name == "after" else name
        table.add_row(shown, *_margins(list(branches.values())))
    for name, axes in found.axes.items():
        shown = "tuned" if name == "after" else name
        if not axes.report.stable:
            table.add_row(shown, *_UNSTABLE)
        for axis, report in zip(found.axis_names, axes.report.axes, strict=False):
            table.add_row(f"{shown}, {axis}", *_margins([report]))
        if axes.report.disk_margin is not None:
            table.add_row(
                f"{shown}, all axes at once",
                f"{axes.report.sensitivity_peak:.2f}",
                f"{20.0 * math.log10(axes.report.disk_gain_margin or 1.0):.1f} dB",
                f"{axes.report.disk_phase_margin_deg:.1f}°",
                "-",
            )
    for name in found.problems:
        table.add_row("tuned" if name == "after" else name, "-", "-", "-", "-")
    return table


_UNSTABLE = ("unstable", "-", "-", "-")


def _margins(reports: Sequence[StabilityReport]) -> tuple[str, ...]:
    worst = worst_margins(reports)
    if worst is None:
        return _UNSTABLE
    return (
        f"{worst.sensitivity_peak:.2f}",
        f"{worst.gain_margin_dB:.1f} dB",
        f"{worst.phase_margin_deg:.1f}°",
        f"{worst.delay_margin_samples:.2f} samples",
    )


def fit_table(report: FitReport) -> Table:
    """Return the parameters of a fit and how well it simulates the record."""
    errors = "; ".join(
        f"{name} {part.rmse:.3g} {part.unit}, {part.rmse_percent_of_span:.2f} % of span"
        for name, part in (
            ("training", report.train),
            ("validation", report.validation),
        )
    )
    table = Table(title=f"{report.model}: free-run rms error\n{errors}")
    table.add_column("parameter", no_wrap=True)
    table.add_column("value", justify="right")
    table.add_column("standard error", justify="right")
    for path, parameter in report.parameters.items():
        deviation = parameter.standard_error
        shown = "-" if deviation is None else f"{deviation:.2g}"
        table.add_row(path, f"{parameter.value:.5g}", shown)
    return table


WIDE = 3
"""Most columns of a table beside each other: what fits into 80 characters."""


def reproduction_table(
    name: str, cells: Sequence[Cell], agreement: TableAgreement
) -> Table:
    """Return paper beside simulation, a row a reference."""
    columns = list(agreement.columns)
    units = ", ".join(dict.fromkeys(cell.unit for cell in cells))
    title = (
        f"{title_of(name)}: paper / simulation in {units}\n"
        f"geometric-mean ratio {agreement.geomean_ratio:.3f}, "
        f"worst {agreement.worst_ratio:.2f}"
    )
    if isinstance(agreement, GroupedAgreement):
        title += "\n" + ", ".join(
            f"{group} {part.geomean_ratio:.3f}"
            for group, part in agreement.groups.items()
        )
    if len(columns) <= WIDE:
        return _beside(columns, cells, agreement, title)
    stack = Table.grid()
    for start in range(0, len(columns), WIDE):
        part = columns[start : start + WIDE]
        stack.add_row(_beside(part, cells, agreement, "" if start else title))
    return stack


def _beside(
    columns: Sequence[str],
    cells: Sequence[Cell],
    agreement: TableAgreement,
    title: str,
) -> Table:
    table = Table(title=title)
    table.add_column("reference")
    for column in columns:
        table.add_column(column, justify="right")
    by_place = {(cell.row, cell.column): cell for cell in cells}
    for row in dict.fromkeys(cell.row for cell in cells):
        found = [by_place[row, column] for column in columns]
        table.add_row(row, *(f"{c.paper:.4f} / {c.sim:.4f}" for c in found))
    table.add_section()
    ratios = (f"{agreement.columns[c].geomean_ratio:.3f}" for c in columns)
    table.add_row("geometric-mean ratio", *ratios, style="bold")
    return table
