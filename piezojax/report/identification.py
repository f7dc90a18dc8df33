"""Pictures and files of a fit."""

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from ..files import write_text
from ..identify.fit import Fit
from ..serial import save
from .figures import AFTER, BEFORE, MEASURED, figure, legend_above, styled, write

MODEL_FILE, FIT_FILE, PICTURE_FILE = "model.json", "fit.json", "fit.png"


def write_fit(fit: Fit, folder: Path) -> None:
    """Write model.json, fit.json and fit.png into ``folder``."""
    save(fit.system, folder / MODEL_FILE)
    text = fit.report.model_dump_json(indent=2, by_alias=True)
    write_text(folder / FIT_FILE, text + "\n")
    with styled():
        write(fit_figure(fit), folder / PICTURE_FILE)


def fit_figure(fit: Fit) -> Figure:
    """Loop, time course and residual with its spectrum."""
    record, report = fit.record, fit.report
    time, error = record.time, fit.simulated - record.output
    unit = _shown(record.output_unit)
    picture = figure(9.0, 5.6)
    (loop, course), (residual, spectrum) = picture.subplots(2, 2)
    part = fit.validate
    loop.plot(
        record.input[part],
        record.output[part],
        ".",
        ms=2,
        color=MEASURED,
        label="measured",
    )
    loop.plot(record.input[part], fit.simulated[part], color=AFTER, label="simulated")
    loop.set(
        xlabel=f"input ({record.input_unit})",
        ylabel=f"output ({unit})",
        title="Hysteresis loop, validation part",
    )
    loop.legend()
    course.plot(time, record.output, color=MEASURED, label="measured")
    course.plot(time, fit.simulated, color=AFTER, lw=0.9, label="free-run simulation")
    course.set(xlabel="time (s)", ylabel=f"output ({unit})", title="Whole record\n")
    legend_above(course)
    residual.plot(time, error, color=BEFORE, lw=0.7)
    residual.axvspan(time[part.start], time[part.stop - 1], color="#eef4f6", zorder=0)
    residual.set(
        xlabel="time (s)",
        ylabel=f"residual ({unit})",
        title=f"Residual, {unit} rms: {report.train.rmse:.3g} training, "
        f"{report.validation.rmse:.3g} validation",
    )
    density = np.abs(np.fft.rfft(error[part])) * 2.0 / error[part].size
    frequency = np.fft.rfftfreq(error[part].size, record.dt)
    spectrum.loglog(frequency[1:], density[1:], color=BEFORE, lw=0.7)
    spectrum.set(
        xlabel="frequency (Hz)",
        ylabel=f"amplitude ({unit})",
        title="Spectrum of the validation residual",
    )
    picture.suptitle(f"{report.model} fitted to {record.source}")
    return picture


def _shown(unit: str) -> str:
    return unit.replace("um", "µm") if unit in ("um", "um/s") else unit
