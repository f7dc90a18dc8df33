"""Pictures and files of a model from a frequency response."""

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from ..core.files import write_text
from ..core.serial import save
from ..identification.estimators.modal_fit import CONFIDENCE
from ..identification.response_model import ResponseModel
from .figures import AFTER, BEFORE, MEASURED, add_title, figure, plot_style, write

MODEL_FILE, REPORT_FILE, PICTURE_FILE = "model.json", "response.json", "response.png"


def write_response(found: ResponseModel, folder: Path) -> None:
    """Write model.json, response.json and response.png into ``folder``."""
    save(found.system, folder / MODEL_FILE, found.about)
    text = found.report.model_dump_json(indent=2)
    write_text(folder / REPORT_FILE, text + "\n")
    with plot_style():
        write(modal_figure(found), folder / PICTURE_FILE)


def modal_figure(found: ResponseModel) -> Figure:
    """Draw the measured response, the response of the model, and the residual."""
    response, fit = found.response, found.fit
    hertz, unit = response.frequency, response.unit.replace("um", "µm")
    picture = figure(6.6, 6.4)
    gain, phase, left = picture.subplots(3, 1, sharex=True, height_ratios=(2, 1.2, 1.2))
    dots = {"ls": "", "marker": ".", "ms": 3.0, "color": MEASURED}
    gain.loglog(hertz, np.abs(response.values), label="measured", **dots)
    gain.loglog(hertz, np.abs(fit.fitted), color=AFTER, lw=1.2, label="model")
    for mode in fit.frequency:
        gain.axvline(mode.value, color=BEFORE, lw=0.7, ls=":")
    gain.set(ylabel=f"gain ({unit})")
    gain.legend()
    for values, style in (
        (response.values, dots),
        (fit.fitted, {"color": AFTER, "lw": 1.2}),
    ):
        phase.semilogx(hertz, np.degrees(np.unwrap(np.angle(values))), **style)
    phase.set(ylabel="phase (°)")
    error = np.abs(response.values - fit.fitted)
    left.loglog(hertz, error, label="|measured - model|", **dots)
    left.loglog(
        hertz,
        CONFIDENCE * fit.deviation,
        color=BEFORE,
        lw=1.0,
        label="noise, 99 %",
    )
    left.set(xlabel="frequency (Hz)", ylabel=f"residual ({unit})")
    left.legend()
    add_title(picture, found.report.found)
    return picture
