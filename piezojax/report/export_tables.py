"""Table of the errors of an exported controller in the simulated loop."""

from rich.table import Table

from ..exporting.judge import ExportReport


def judgement(report: ExportReport) -> list[Table | str]:
    """Return a table of errors by reference and precision, with notes and warnings."""
    if report.not_judged is not None:
        return [f"note: not judged in the simulated loop: {report.not_judged}"]
    table = Table(title=f"compiled in the simulated loop; written: {report.written}")
    table.add_column("rms error")
    for precision in report.forms:
        table.add_column(precision, justify="right")
    others = list(report.forms)[1:]
    for precision in others:
        table.add_column(f"cost of {precision}", justify="right")
    for name, found in report.references.items():
        table.add_row(
            name,
            *(f"{rms:.4g} {found.unit}" for rms in found.rms.values()),
            *(
                f"{found.cost[each]:+.2g} {found.unit}, {found.percent[each]:+.2g} %"
                for each in others
            ),
        )
    return [
        table,
        *(
            f"{precision}: {form.operations} operations and {form.ns:.0f} ns a step, "
            f"{form.state_bytes} bytes of state"
            for precision, form in report.forms.items()
        ),
        *([f"note: {report.written}, because {report.why}"] if report.why else []),
        *(f"WARNING: {warning}" for warning in report.warnings),
    ]
