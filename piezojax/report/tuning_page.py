"""Results of tuning as tables and sentences, printed and in report.html."""

from rich.table import Table

from ..control import Device
from ..exporting import device_values
from ..identification import Fit
from ..tuning.gain_surrogate import GainSurrogate
from ..tuning.outcome import Outcome
from .baseline_curves import baselines_table, baselines_text
from .device_table import device_table
from .drive_table import drive_table
from .limit_bars import limit_text
from .page import Page
from .robustness import constraints_table, front_table
from .step_pictures import steps_table
from .structure_pictures import structures_table
from .tuning_tables import (
    beside_table,
    following_table,
    gains_table,
    perturbed_text,
    response_table,
    sliding_text,
    stability_table,
    tuning_table,
)


def tuning_page(outcome: Outcome, surrogate: GainSurrogate | str | None = None) -> Page:
    """Return the Page of a tuned study.

    ``surrogate`` is that of the sliders, or the reason why there are no sliders.
    """
    result, study = outcome.result, outcome.case.study
    stability, baselines = outcome.stability, outcome.baselines
    front = (
        front_table(result.front, study.pareto.constraint, result.units.values())
        if result.front and study.pareto
        else None
    )
    parts = [
        tuning_table(result),
        _fitted(outcome.case.fit),
        result.structures and structures_table(result.structures),
        result.beside and beside_table(result),
        gains_table(result),
        values_to_type(outcome),
        stability_table(stability),
        result.on_response and response_table(result.on_response),
        stability.reports and following_table(stability),
        outcome.steps[1] and steps_table(outcome.steps),
        drive_table(
            outcome.drive,
            study.rate,
            has_capacitance=study.actuator.capacitance is not None,
        ),
        sliding_text(result),
        result.constraints and constraints_table(result),
        front,
        limit_text(outcome.limit),
        result.perturbed and perturbed_text(result.perturbed),
        baselines and baselines_table(baselines),
        baselines and baselines_text(baselines),
        *(f"note: {note}" for note in (baselines.notes if baselines else ())),
        *(
            f"note: no margins {name} tuning: {why}"
            for name, why in stability.problems.items()
        ),
        *(f"note: {warning}" for warning in result.warnings),
        isinstance(surrogate, str) and f"note: no sliders of gains: {surrogate}",
        f"{result.status} after {result.evaluations} evaluations, "
        f"{result.wall_s:.1f} s ({result.compile_s:.1f} s of it compiling)",
    ]
    versions = ", ".join(f"{name} {text}" for name, text in result.versions.items())
    return Page(
        result.heading,
        result.alarms,
        [part for part in parts if part],
        [
            *outcome.about.origin("Gains of a tuned controller"),
            f"Versions: {versions}.",
        ],
    )


def _fitted(fit: Fit | None) -> str | None:
    """Return a sentence on the fit of the plant, or None if no model was fitted."""
    if fit is None:
        return None
    report, part = fit.report, fit.report.validation
    return (
        f"plant: {report.model} fitted to {fit.record.source}, free-run error on the "
        f"validation part {part.rmse:.3g} {part.unit} rms, "
        f"{part.rmse_percent_of_span:.2g} % of its span; "
        f"found: {report.found or 'no resonance'}"
    )


def values_to_type(outcome: Outcome) -> Table | str | None:
    """Return the table of values to type in, or a note on why there is none.

    Return None if the controller is not a Device.
    """
    if not isinstance(outcome.controller, Device):
        return None
    try:
        return device_table(device_values(outcome.controller))
    except ValueError as error:
        return f"note: no values to type in: {error}"
