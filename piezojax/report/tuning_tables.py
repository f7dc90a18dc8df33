"""Tables of a tuning."""

import math
from collections.abc import Iterable, Mapping, Sequence
from itertools import takewhile

from rich.table import Table
from rich.text import Text

from ..analysis.stability import StabilityReport, StabilityReports, worst_margins
from ..analysis.stability.measured_margins import MeasuredMargins
from ..tuning.result import Perturbed, Result, Scores
from .figures import small_units


def _nanometres(value: float | None) -> str:
    return "diverges" if value is None else f"{1e3 * value:.2f}"


def _ratio(before: float | None, after: float | None) -> str:
    return f"{before / after:.1f}x" if before and after else "-"


def tuning_table(result: Result) -> Table:
    """Return a table of rms errors on held-out noise, before and after tuning."""
    unit = small_units(result.units.values())
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


_MOST_ROWS = 12  # above it, axes at rest have only their geometric mean


def beside_table(result: Result) -> Table:
    """Return the table of held-out errors of the tuned and other controllers."""
    plants = result.beside["tuned"].plants
    title = (
        f"rms tracking error on the hold-out, {small_units(result.units.values())}: "
        "geometric mean over all references"
    )
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
    """Return the worst margins of each loop over its branches and references."""
    table = Table(
        title="margins for small motions, nominal plant, worst branch and reference"
    )
    table.add_column("loop")
    for title in ("Ms", "gain margin", "phase margin", "delay margin"):
        table.add_column(title, justify="right")
    for name, branches in stability.reports.items():
        shown = "tuned" if name == "after" else name
        table.add_row(shown, *_margins(list(branches.values())))
    for name, axes in stability.axes.items():
        shown = "tuned" if name == "after" else name
        branches = axes.reports
        if not all(report.stable for report in branches):
            table.add_row(shown, *_UNSTABLE)
            continue
        for axis, at in enumerate(stability.axis_names):
            each = [report.axes[axis] for report in branches]
            table.add_row(f"{shown}, {at}", *_margins(each))
        least = axes.report  # the branch with the smaller disk margin
        peak = max(report.largest_sensitivity_peak or 0.0 for report in branches)
        table.add_row(
            f"{shown}, all axes at once",
            f"{peak:.2f}",
            f"{20.0 * math.log10(least.disk_gain_margin or 1.0):.1f} dB",
            f"{least.disk_phase_margin_deg:.1f}°",
            "-",
        )
    for name in stability.problems:
        table.add_row(name.replace("after", "tuned", 1), "-", "-", "-", "-")
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
    """Return the table of the closed-loop response of each loop of one axis.

    A dash stands for a response that does not settle although the loop is stable.
    """
    table = Table(title="small motions of the reference, worse branch")
    table.add_column("loop")
    for title in ("bandwidth, -3 dB", "-1 dB", "closed-loop peak"):
        table.add_column(title, justify="right")
    for name, branches in stability.reports.items():
        shown = "tuned" if name == "after" else name
        each = [report.following for report in branches.values()]
        if any(one is None for one in each):
            stable = all(report.stable for report in branches.values())
            table.add_row(shown, *(("-",) * 3 if stable else _UNSTABLE[:3]))
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
    figures = (
        (worst.gain_margin_dB, "{:.1f} dB"),
        (worst.phase_margin_deg, "{:.1f}°"),
        (worst.delay_margin_samples, "{:.2f} samples"),
    )
    return (
        f"{worst.sensitivity_peak:.2f}",
        *(text.format(x) if math.isfinite(x) else "unlimited" for x, text in figures),
    )
