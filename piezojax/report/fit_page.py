"""Results of a fit as tables and sentences, printed and in report.html."""

from ..identification.fit import Fit
from ..identification.held_dynamics import bound_text
from .fit_tables import fit_table
from .page import Page


def fit_page(fit: Fit) -> Page:
    """Return the Page of a fitted model."""
    report = fit.report
    held = fit.held and bound_text(fit.about.error_bound, fit.held.dt)
    parts = [
        fit_table(report, fit.units),
        f"found: {report.found or 'no resonance'}",
        held,
        report.closed_loop and f"closed loop: {report.closed_loop}",
        *(f"note: {warning}" for warning in report.warnings),
        f"fitted in {report.wall_s:.1f} s",
    ]
    return Page(
        f"{report.model} fitted to {fit.record.source}",
        report.alarms,
        [part for part in parts if part],
        fit.about.origin("Model of a plant"),
    )
