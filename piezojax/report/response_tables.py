"""Tables of measured frequency responses, and of their change with amplitude."""

from collections.abc import Iterable

from rich.table import Table

from ..identification.measured_response import Measurement
from ..identification.response_levels import ResponseLevels
from ..identification.response_model import ResponseModel
from .fit_tables import parameter_table
from .page import Page
from .response_pictures import level_labels


def response_page(
    model: ResponseModel,
    levels: ResponseLevels | None,
    measured: Iterable[Measurement | None],
) -> Page:
    """Return the Page of ``model``.

    ``levels`` compares the amplitudes if there are several; ``model`` is the chosen one
    then. ``measured`` holds the Measurement of each response, None for one from a file.
    """
    report = model.report
    parts: list[Table | str] = [measurement_table(m) for m in measured if m is not None]
    if levels is not None:
        parts += [
            levels_table(levels),
            *(f"note: {note}" for note in levels.report.notes),
            f"model.json is the model of response {levels.report.chosen + 1}; its "
            "error bound holds for all",
        ]
    title = f"{report.lines} lines: median error {100.0 * report.error:.2g} %"
    notes = [*(report.measured.notes if report.measured else []), *report.notes]
    parts += [
        parameter_table(report.parameters, title, model.about.parameter_units),
        f"found: {report.found}",
        *(f"note: {note}" for note in notes),
    ]
    return Page(
        f"modes fitted to {model.response.source}",
        model.about.unsafe,
        parts,
        model.about.origin("Model of a plant"),
    )


def measurement_table(found: Measurement) -> Table:
    """Return the table of the settings and the accuracy of a measured response."""
    table = Table(title=f"response by {found.method}")
    table.add_column("", no_wrap=True)
    table.add_column("value", justify="right")
    band = f"{found.lowest_Hz:.4g} to {found.highest_Hz:.5g} Hz"
    rows = [
        ("realisations", str(found.realisations)),
        ("rms amplitude of the input", f"{found.amplitude:.4g} {found.input_unit}"),
        ("lines", f"{found.lines}, {band}"),
        ("half the 95 % band, median", f"{found.band_percent:.2g} % of the gain"),
    ]
    for name, percent in (
        ("noise of the mean", found.noise_percent),
        ("nonlinear distortion of one realisation", found.distortion_percent),
    ):
        if percent is not None:
            rows.append((f"{name}, median", f"{percent:.2g} % of the gain"))
    if found.coherence is not None:
        rows.append(("coherence, median", f"{found.coherence:.4g}"))
    if found.resolution_Hz:
        rows.append(("width of a line", f"{found.resolution_Hz:.3g} Hz"))
    for row in rows:
        table.add_row(*row)
    return table


def levels_table(found: ResponseLevels) -> Table:
    """Return the table of each parameter at every amplitude, and of its change."""
    table = Table(title="modes by amplitude of the input (± standard error)")
    table.add_column("parameter", no_wrap=True)
    for label in level_labels(found):
        table.add_column(label, justify="right")
    table.add_column("change", justify="right")
    for change in found.report.changes:
        table.add_row(
            f"{change.parameter} ({change.unit})",
            *(f"{one.value:.5g} ± {one.standard_error:.1g}" for one in change.levels),
            f"{change.change_percent:+.3g} ± {change.standard_error_percent:.2g} %"
            if change.certain
            else f"none seen (± {change.standard_error_percent:.2g} %)",
        )
    return table
