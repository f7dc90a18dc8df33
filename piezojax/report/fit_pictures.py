"""Pictures and files of a fit."""

from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ..core.files import write_report
from ..core.serial import save
from ..identification.estimators.estimate import LinearDetail
from ..identification.fit import Fit
from ..identification.records.record import Record
from ..identification.residual_record import ResidualRecord, save_residual
from .figures import (
    AFTER,
    BEFORE,
    MEASURED,
    Pictures,
    add_title,
    figure,
    legend_above,
    plot_style,
    write,
)
from .frequency_response import response_figure, singular_values_figure

SHOWN = 400
"""Largest number of samples drawn of each output of a record with several outputs."""

MODEL_FILE, FIT_FILE, PICTURE_FILE = "model.json", "fit.json", "fit.png"


def write_fit(fit: Fit, folder: Path) -> Pictures:
    """Write model.json, fit.json and the returned pictures into ``folder``."""
    write_model(fit, folder)
    with plot_style():
        single = fit.simulations[0].shape[1] == 1
        picture = fit_figure(fit) if single else outputs_figure(fit)
        drawn = write(picture, folder / PICTURE_FILE)
        if fit.linear is not None:
            drawn |= _write_linear(fit.linear, fit.record, folder)
    return drawn


def write_model(fit: Fit, folder: Path) -> None:
    """Write model.json, its residual and fit.json into ``folder``."""
    save(fit.plant, folder / MODEL_FILE, fit.about)
    save_residual(ResidualRecord.of(fit), folder / MODEL_FILE)
    write_report(folder / FIT_FILE, fit.report)


def _write_linear(linear: LinearDetail, record: Record, folder: Path) -> Pictures:
    drawn: Pictures = {}
    for number, (title, values) in enumerate(linear.singular_values.items()):
        picture = singular_values_figure(values, linear.order, title)
        drawn |= write(picture, folder / f"singular_values_{number}.png")
    if linear.measured is not None:
        names = [
            [f"{side} {i}" for i in range(count)]
            for side, count in (
                ("input", record.inputs.shape[1]),
                ("output", record.outputs.shape[1]),
            )
        ]
        unit = f"{record.output_unit}/{record.input_unit}"
        picture = response_figure(
            linear.measured, linear.fitted(), names[0], names[1], unit
        )
        drawn |= write(picture, folder / "response.png")
    return drawn


def outputs_figure(fit: Fit) -> Figure:
    """Draw each output of the first record: last validation samples, and spectra."""
    record, run, part = fit.record, fit.simulations[0], fit.validate
    shown = slice(max(part.start, part.stop - SHOWN), part.stop)
    picture = figure(9.0, 2.4 * run.shape[1] + 0.8)
    panels = picture.subplots(run.shape[1], 2, squeeze=False)
    for i, (over_time, spectrum) in enumerate(panels):
        unit = display_unit(record.output_units[i])
        time = record.time[shown]
        over_time.plot(time, record.outputs[shown, i], color=MEASURED, label="measured")
        over_time.plot(time, run[shown, i], color=AFTER, lw=0.9, label="simulated")
        over_time.set(ylabel=f"output {i} ({unit})")
        over_time.locator_params(axis="x", nbins=5)
        sizes = fit.spectra(part, i)
        for size, colour, label in (
            (sizes.measured, MEASURED, "measured"),
            (sizes.residual, BEFORE, "residual"),
        ):
            spectrum.loglog(sizes.frequency, size, color=colour, lw=0.7, label=label)
        rmse = fit.report.validation.each[i]
        spectrum.set(
            ylabel=f"amplitude ({unit})",
            title=f"validation residual {rmse:.3g} {unit} rms",
        )
        if i == 0:
            over_time.legend()
            spectrum.legend()
    panels[-1, 0].set(xlabel="time (s)")
    panels[-1, 1].set(xlabel="frequency (Hz)")
    add_title(picture, f"{fit.report.model} fitted to {record.source}")
    return picture


def loop_panel(ax: Axes, fit: Fit, label: str) -> None:
    """Draw output against input over the validation part; ``label`` names the model."""
    record, part = fit.record, fit.validate
    ax.plot(
        record.input[part],
        record.output[part],
        ".",
        ms=2,
        color=MEASURED,
        label="measured",
    )
    ax.plot(record.input[part], fit.simulated[part], color=AFTER, label=label)
    ax.set(
        xlabel=f"input ({record.input_unit})",
        ylabel=f"output ({display_unit(record.output_unit)})",
        title="Hysteresis loop, validation part",
    )
    ax.legend()


def fit_figure(fit: Fit) -> Figure:
    """Draw the loop, the output over time, and the residual with its spectrum."""
    record, report = fit.record, fit.report
    time, error = record.time, fit.simulated - record.output
    unit = display_unit(record.output_unit)
    picture = figure(9.0, 5.6)
    (loop, over_time), (residual, spectrum) = picture.subplots(2, 2)
    part = fit.validate
    loop_panel(loop, fit, "simulated")
    over_time.plot(time, record.output, color=MEASURED, label="measured")
    over_time.plot(
        time, fit.simulated, color=AFTER, lw=0.9, label="free-run simulation"
    )
    over_time.set(xlabel="time (s)", ylabel=f"output ({unit})", title="Whole record\n")
    legend_above(over_time)
    residual.plot(time, error, color=BEFORE, lw=0.7)
    residual.axvspan(time[part.start], time[part.stop - 1], color="#eef4f6", zorder=0)
    residual.set(
        xlabel="time (s)",
        ylabel=f"residual ({unit})",
        title=f"Residual, {unit} rms: {report.train.rmse:.3g} training, "
        f"{report.validation.rmse:.3g} validation",
    )
    sizes = fit.spectra(part, 0)
    spectrum.loglog(sizes.frequency, sizes.residual, color=BEFORE, lw=0.7)
    spectrum.set(
        xlabel="frequency (Hz)",
        ylabel=f"amplitude ({unit})",
        title="Spectrum of the validation residual",
    )
    add_title(picture, f"{report.model} fitted to {record.source}")
    return picture


def display_unit(unit: str) -> str:
    """Return ``unit`` as written in pictures."""
    return unit.replace("um", "µm") if unit in ("um", "um/s") else unit
