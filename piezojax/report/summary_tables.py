"""Tables that the commands print."""

import math
from collections.abc import Iterable, Mapping, Sequence
from itertools import takewhile

from rich.table import Table
from rich.text import Text

from ..analysis.stability import StabilityReport, StabilityReports, worst_margins
from ..analysis.stability.measured_margins import MeasuredMargins
from ..core.registry import parts
from ..identification.device_scale import DeviceScale
from ..identification.estimators.estimate import FittedParameter
from ..identification.fit import FitReport
from ..identification.methods import METHODS
from ..reproduction.cell import Cell, title_of
from ..reproduction.summary import GroupedAgreement, TableAgreement
from ..tuning.result import Perturbed, Result, Scores


def models_table() -> Table:
    """Return the table of the models that can be fitted: parts and whole models."""
    table = Table(title="models; parts are joined by '+', as in coleman_hodgdon+lag")
    for column in ("model", "kind", "description or method"):
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
    """Return a table of rms errors on held-out noise, before and after tuning."""
    unit = " or ".join(dict.fromkeys(_SMALL[u] for u in result.units.values())) or "nm"
    table = Table(
        title=Text(f"{result.heading}\nrms tracking error on held-out noise, {unit}")
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
                break  # too many rows: two of three axes rest in each run
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

_MOST_ROWS = 12  # above it, axes at rest have only their geometric mean


def beside_table(result: Result) -> Table:
    """Return the table of held-out errors (nm) of the tuned and other controllers."""
    plants = result.beside["tuned"].plants
    title = "rms tracking error on the hold-out, nm: geometric mean over all references"
    if plants:
        title += f"\n(median and worst of {plants} held-out perturbed plants)"
    table = Table(title=Text(title))
    table.add_column("controller")
    columns = ("median", "worst", "unstable") if plants else ()
    for name in ("nominal", *columns, "largest Ms"):
        table.add_column(name, justify="right", no_wrap=True)
    for name, found in result.beside.items():
        of_plants = (
            _nanometres(found.geomean_rms_um),
            _nanometres(found.worst_rms_um),
            str(found.unstable),
        )
        peak = found.sensitivity_peak
        table.add_row(
            name,
            _nanometres(found.nominal_rms_um),
            *(of_plants if plants else ()),
            "-" if peak is None else f"{peak:.2f}" if peak < _ANY_PEAK else "unstable",
            style="bold" if name == "tuned" else None,
        )
    return table


_ANY_PEAK = 100.0
"""Ms from which a loop is shown as unstable: Ms is computed from the impulse response
of S, which grows in an unstable loop."""


def perturbed_text(perturbed: Perturbed) -> str:
    """Return one line on the held-out perturbed plants."""
    if perturbed.unstable or perturbed.median_better is None:
        return (
            f"{perturbed.plants} perturbed plants: {perturbed.unstable} unstable "
            f"({perturbed.unstable_before} before)"
        )
    rest = (
        f", axes at rest {perturbed.coupling_better:.2f}x"
        if perturbed.coupling_better
        else ""
    )
    return (
        f"{perturbed.plants} perturbed plants: none unstable "
        f"({perturbed.unstable_before} before), "
        f"{perturbed.median_better:.1f}x better in the median, "
        f"{perturbed.worst_better:.1f}x on the worst{rest}"
    )


def sliding_text(result: Result) -> str | None:
    """Return one line on the share of the error in the sliding variable.

    Return None for a controller without a sliding variable.
    """
    shares = [
        "-" if parts is None or parts.share is None else f"{100.0 * parts.share:.1f} %"
        for parts in (result.sliding_before, result.sliding)
    ]
    if result.sliding is None:
        return None
    return (
        f"sliding variable: {shares[1]} of its mean square is tracking error "
        f"({shares[0]} before); the rest is the lag of the observer behind the "
        "reference, and noise"
    )


def gains_table(result: Result) -> Table:
    """Return the table of the parameters before and after tuning.

    The unit of a pure number is 1; a dash stands for a unit that is not declared. Gains
    of a device have all digits that are typed in.
    """
    # The common start of the paths is in the title: long paths would crowd the numbers.
    shared, names = short_names(result.gains)
    table = Table(title=f"gains of {shared}" if shared else "gains")
    table.add_column("parameter")
    table.add_column("before", justify="right", no_wrap=True)
    table.add_column("tuned", justify="right", no_wrap=True)
    table.add_column("unit", no_wrap=True)
    for name, (path, value) in zip(names, result.gains.items(), strict=True):
        unit, step = result.gain_units.get(path), result.gain_steps.get(path)
        before, after = (typed(x, step) for x in (result.start[path], value))
        table.add_row(name, before, after, unit or "-")
    return table


def short_names(paths: Iterable[str]) -> tuple[str, list[str]]:
    """Return the common start of ``paths`` ("" without one), and the rest of each."""
    paths = list(paths)
    parents = zip(*(path.split(".")[:-1] for path in paths), strict=False)
    common = takewhile(lambda names: len(set(names)) == 1, parents)
    shared = ".".join(names[0] for names in common)
    return shared, [path.removeprefix(f"{shared}.") for path in paths]


def typed(value: float, step: float | None) -> str:
    """Return a gain in four digits, or in all digits that are typed into a device."""
    if step is None:
        return f"{value:.4g}"
    return f"{value:.{max(0, -math.floor(math.log10(step)))}f}"


def stability_table(stability: StabilityReports) -> Table:
    """Return the margins of each loop, on the worse branch of a hysteresis."""
    table = Table(
        title="margins for small motions, nominal plant, worse branch of hysteresis"
    )
    table.add_column("loop")
    for title in ("Ms", "gain margin", "phase margin", "delay margin"):
        table.add_column(title, justify="right")
    for name, branches in stability.reports.items():
        shown = "tuned" if name == "after" else name
        table.add_row(shown, *_margins(list(branches.values())))
    for name, axes in stability.axes.items():
        shown = "tuned" if name == "after" else name
        if not axes.report.stable:
            table.add_row(shown, *_UNSTABLE)
        for axis, report in zip(stability.axis_names, axes.report.axes, strict=False):
            table.add_row(f"{shown}, {axis}", *_margins([report]))
        if axes.report.disk_margin is not None:
            table.add_row(
                f"{shown}, all axes at once",
                f"{axes.report.largest_sensitivity_peak:.2f}",
                f"{20.0 * math.log10(axes.report.disk_gain_margin or 1.0):.1f} dB",
                f"{axes.report.disk_phase_margin_deg:.1f}°",
                "-",
            )
    for name in stability.problems:
        table.add_row("tuned" if name == "after" else name, "-", "-", "-", "-")
    return table


def response_table(found: Mapping[str, MeasuredMargins]) -> Table:
    """Return the margins of each loop at the measured lines of a response."""
    one = next(iter(found.values()))
    table = Table(
        title=f"on the {one.lines} measured lines of the response, "
        f"{one.lowest_Hz:.4g} to {one.highest_Hz:.4g} Hz"
    )
    table.add_column("loop")
    for title in ("Ms", "gain margin", "phase margin", "delay margin"):
        table.add_column(title, justify="right")
    for name, margins in found.items():
        shown = "tuned" if name == "after" else name
        if not margins.stable:
            table.add_row(shown, *_UNSTABLE)
            continue
        figures = (
            (margins.gain_margin_dB, "{:.1f} dB"),
            (margins.phase_margin_deg, "{:.1f}°"),
            (margins.delay_margin_samples, "{:.2f} samples"),
        )
        table.add_row(
            shown,
            f"{margins.sensitivity_peak:.2f}",
            *("-" if value is None else text.format(value) for value, text in figures),
        )
    return table


def following_table(stability: StabilityReports) -> Table:
    """Return the table of the closed-loop response of each loop of one axis."""
    table = Table(title="small motions of the reference, worse branch")
    table.add_column("loop")
    for title in ("bandwidth, -3 dB", "-1 dB", "closed-loop peak"):
        table.add_column(title, justify="right")
    for name, branches in stability.reports.items():
        shown = "tuned" if name == "after" else name
        each = [report.following for report in branches.values()]
        if any(one is None for one in each):
            table.add_row(shown, *_UNSTABLE[:3])
            continue
        least, inner = (
            min(getattr(one, field) for one in each)
            for field in ("bandwidth_Hz", "bandwidth_1dB_Hz")
        )
        peak = max(one.closed_loop_peak for one in each if one is not None)
        table.add_row(shown, _band(least), _band(inner), f"{peak:.3f}")
    return table


def _band(highest: float) -> str:
    return f"{highest:.4g} Hz" if math.isfinite(highest) else "above Nyquist"


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


def fit_table(report: FitReport, units: Mapping[str, str] | None = None) -> Table:
    """Return the parameters of a fit, with its training and validation errors.

    ``units`` holds the units by path; with it the table has a column of units.
    """
    errors = "; ".join(
        f"{name} {part.rmse:.3g} {part.unit}, {part.rmse_percent_of_span:.2f} % of span"
        for name, part in (
            ("training", report.train),
            ("validation", report.validation),
        )
    )
    table = Table(
        title=f"{report.model}: free-run rms error\n{errors}",
        caption="\n".join([*_scope(report), *_place_of_the_lag(report)]) or None,
        caption_justify="left",
    )
    return parameter_table(report.parameters, table, units)


def parameter_table(
    parameters: Mapping[str, FittedParameter],
    table: Table | str,
    units: Mapping[str, str] | None = None,
) -> Table:
    """Return ``table``, or a new one of this title, with a row for each parameter.

    ``units`` holds the units by path; with it the table has a column of units.
    """
    table = Table(title=table) if isinstance(table, str) else table
    table.add_column("parameter", no_wrap=True)
    table.add_column("value", justify="right")
    table.add_column("standard error", justify="right")
    if units is not None:
        table.add_column("unit", no_wrap=True)
    for path, parameter in parameters.items():
        deviation = parameter.standard_error
        shown = "-" if deviation is None else f"{deviation:.2g}"
        unit = [] if units is None else [units.get(path) or "-"]
        table.add_row(path, f"{parameter.value:.5g}", shown, *unit)
    return table


def scale_table(found: DeviceScale) -> Table:
    """Return the measured scale and gains of a device."""
    ((option, value),) = found.option.items()
    table = Table(
        title=f"{found.device}, {option} {value}: residual {found.residual_V:.2g} V",
        caption=f"the voltage lags the error by {found.lag} samples in the record",
        caption_justify="left",
    )
    table.add_column("", no_wrap=True)
    table.add_column("value", justify="right")
    table.add_column("standard error", justify="right")
    table.add_column("unit")
    for name in ("scale", "proportional", "integral", "derivative"):
        one = getattr(found, name)
        table.add_row(name, f"{one.value:.6g}", f"{one.standard_error:.2g}", one.unit)
    return table


def _scope(report: FitReport) -> list[str]:
    """Return a line on the band, the range and the error of a model."""
    residuals = report.residuals
    if residuals is None or residuals.error_bound is None:
        return []
    coverage, bound = residuals.coverage, residuals.error_bound
    if coverage.band_Hz is None:
        return ["the record excites no frequency above its noise"]
    low, high = coverage.input_range
    inside = [
        error
        for error, excited in zip(bound.relative, bound.excited, strict=True)
        if excited
    ]
    return [
        f"known from {coverage.band_Hz[0]:.3g} to {coverage.band_Hz[1]:.3g} Hz and "
        f"from {low:.3g} to {high:.3g} {coverage.input_unit}; there the response is "
        f"known within a factor of {1.0 + sorted(inside)[len(inside) // 2]:.3g} in the "
        f"median, {1.0 + max(inside):.3g} at worst"
    ]


def _place_of_the_lag(report: FitReport) -> list[str]:
    if report.model.split("+")[-1] != "lag":
        return []
    return [
        "a record does not distinguish a lag of the sensor from a lag of the stage; "
        "the loop controls the reading of the sensor, and the tip may move differently"
    ]


WIDE = 3
"""Largest number of columns of one table, so that it fits into 80 characters."""


def reproduction_table(
    name: str, cells: Sequence[Cell], agreement: TableAgreement
) -> Table:
    """Return printed and simulated errors, a row for each reference."""
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
        return _part_table(columns, cells, agreement, title)
    stack = Table.grid()
    for start in range(0, len(columns), WIDE):
        part = columns[start : start + WIDE]
        stack.add_row(_part_table(part, cells, agreement, "" if start else title))
    return stack


def _part_table(
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
        row_cells = [by_place[row, column] for column in columns]
        table.add_row(row, *(f"{c.paper:.4f} / {c.sim:.4f}" for c in row_cells))
    table.add_section()
    ratios = (f"{agreement.columns[c].geomean_ratio:.3f}" for c in columns)
    table.add_row("geometric-mean ratio", *ratios, style="bold")
    return table
