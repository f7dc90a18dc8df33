"""Tables of models and of their fits."""

from collections.abc import Mapping

from rich.table import Table

from ..core.registry import parts
from ..identification.device_scale import DeviceScale
from ..identification.estimators.estimate import FittedParameter
from ..identification.fit import FitReport
from ..identification.methods import METHODS


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
