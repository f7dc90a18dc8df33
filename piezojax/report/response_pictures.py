"""Pictures and files of measured frequency responses and their models."""

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ..core.files import write_report
from ..core.serial import save
from ..identification.estimators.modal_model import CONFIDENCE, ModalFit
from ..identification.measured_response import distortion_level
from ..identification.records.response import FrequencyResponse
from ..identification.records.saved_response import save_response
from ..identification.response_levels import LevelChange, ResponseLevels
from ..identification.response_model import ResponseModel
from .figures import (
    AFTER,
    BEFORE,
    MEASURED,
    REFERENCE,
    Pictures,
    add_title,
    figure,
    legend_above,
    plot_style,
    write,
)

MODEL_FILE, REPORT_FILE, PICTURE_FILE = "model.json", "response.json", "response.png"
TABLE_FILE, LEVELS_FILE, LEVELS_PICTURE = (
    *("response.csv", "amplitudes.json"),
    "amplitudes.png",
)

LEVELS_FOLDER = "levels"
"""Folder with the files of each amplitude, numbered from 1."""


def write_measured(response: FrequencyResponse, folder: Path) -> Pictures:
    """Write response.csv and response.png of a response without a model.

    Returns the picture.
    """
    save_response(response, folder / TABLE_FILE)
    with plot_style():
        picture = measured_figure(response, None, response.source)
        return write(picture, folder / PICTURE_FILE)


def write_response(found: ResponseModel, folder: Path) -> Pictures:
    """Write model.json, response.json, response.csv and response.png to ``folder``.

    Returns the picture.
    """
    save(found.system, folder / MODEL_FILE, found.about)
    write_report(folder / REPORT_FILE, found.report)
    save_response(found.response, folder / TABLE_FILE)
    with plot_style():
        picture = measured_figure(found.response, found.fit, found.report.found)
        return write(picture, folder / PICTURE_FILE)


def write_levels(found: ResponseLevels, folder: Path) -> Pictures:
    """Write the chosen model, the files of each amplitude, and their comparison.

    Returns the pictures of the chosen model and of the comparison.
    """
    for number, model in enumerate(found.models, 1):
        inner = folder / LEVELS_FOLDER / str(number)
        inner.mkdir(parents=True)
        write_response(model, inner)
    drawn = write_response(found.chosen, folder)
    write_report(folder / LEVELS_FILE, found.report)
    with plot_style():
        return drawn | write(levels_figure(found), folder / LEVELS_PICTURE)


def measured_figure(
    response: FrequencyResponse, fit: ModalFit | None, title: str
) -> Figure:
    """Draw a response with its 95 % band, the levels of its errors, and the model.

    The levels are the standard deviations of the noise and of the nonlinear distortion
    of one realisation. The lowest panel shows the residual of the model.
    """
    hertz, unit = response.frequency, response.unit.replace("um", "µm")
    panels = 2 if fit is None else 3
    picture = figure(6.6, 2.4 + 1.5 * panels)
    ratios = (2, 1.2, 1.2)[:panels]
    gain, phase, *rest = picture.subplots(panels, 1, sharex=True, height_ratios=ratios)
    gain.set(xscale="log", yscale="log")
    _draw_measured(gain, phase, response)
    if fit is not None:
        gain.plot(hertz, np.abs(fit.fitted), color=AFTER, lw=1.2, label="model")
        for mode in fit.frequency:
            gain.axvline(mode.value, color=BEFORE, lw=0.7, ls=":")
        angle = np.degrees(np.unwrap(np.angle(fit.fitted)))
        turns = np.median(_degrees(response) - angle) / 360.0
        phase.semilogx(hertz, angle + 360.0 * np.round(turns), color=AFTER, lw=1.2)
        _draw_residual(rest[0], response, fit)
        rest[0].set(ylabel=f"residual ({unit})")
    gain.set(ylabel=f"gain ({unit})")
    legend_above(gain)
    phase.set(ylabel="phase (°)")
    (rest[0] if rest else phase).set(xlabel="frequency (Hz)")
    add_title(picture, title)
    return picture


_DOTS: dict[str, Any] = {"ls": "", "marker": ".", "ms": 3.0, "color": MEASURED}


def _degrees(response: FrequencyResponse) -> np.ndarray:
    return np.degrees(np.unwrap(np.angle(response.values)))


def _draw_measured(gain: Axes, phase: Axes, response: FrequencyResponse) -> None:
    hertz, size, angle = (
        response.frequency,
        np.abs(response.values),
        _degrees(response),
    )
    gain.plot(hertz, size, label="measured", **_DOTS)
    phase.semilogx(hertz, angle, **_DOTS)
    if response.variance is None:
        return
    magnitude, turn = response.band()
    shade: dict[str, Any] = {"color": MEASURED, "alpha": 0.35, "lw": 0.0}
    low = np.maximum(size - magnitude, 0.03 * size)
    gain.fill_between(hertz, low, size + magnitude, label="95 % band", **shade)
    known = turn < np.pi
    low, high = (
        np.where(known, angle + sign * np.degrees(turn), np.nan) for sign in (-1.0, 1.0)
    )
    phase.fill_between(hertz, low, high, **shade)
    level = distortion_level(response)
    if response.noise is None:
        label, deviation = _part_of(response), np.sqrt(response.variance)
    else:
        label, deviation = "noise of the mean", np.sqrt(response.noise)
    gain.plot(hertz, deviation, color=REFERENCE, lw=0.7, label=label)
    if level is not None:
        gain.plot(
            hertz,
            np.where(level > 0.0, level, np.nan),
            color=BEFORE,
            lw=1.0,
            label="distortion of a realisation",
        )


def _draw_residual(ax: Axes, response: FrequencyResponse, fit: ModalFit) -> None:
    error = np.abs(response.values - fit.fitted)
    ax.loglog(response.frequency, error, label="|measured - model|", **_DOTS)
    ax.loglog(
        response.frequency,
        CONFIDENCE * fit.deviation,
        color=BEFORE,
        lw=1.0,
        label=f"{_part_of(response)}, 99 %",
    )
    ax.legend(fontsize=7.5)


def _part_of(response: FrequencyResponse) -> str:
    """Return the causes of the variance of ``response``, to label its curve."""
    both = response.noise is not None or response.resolution
    return "noise and distortion" if both else "noise"


def levels_figure(found: ResponseLevels) -> Figure:
    """Draw the responses at all amplitudes, and the change of each parameter."""
    report = found.report
    unit = found.chosen.response.unit.replace("um", "µm")
    picture = figure(9.0, 4.8)
    grid = picture.add_gridspec(3, 2)
    left = picture.add_subplot(grid[:, 0])
    panels = {
        kind: picture.add_subplot(grid[i, 1])
        for i, kind in enumerate(("gain", "frequency", "damping"))
    }
    labels = level_labels(found)
    count = len(labels)
    for i, (model, label) in enumerate(zip(found.models, labels, strict=True)):
        shade = 0.25 + 0.75 * i / max(1, count - 1)
        left.loglog(
            model.response.frequency,
            np.abs(model.fit.fitted),
            color=AFTER,
            alpha=shade,
            label=label,
        )
    left.set(xlabel="frequency (Hz)", ylabel=f"gain of the model ({unit})")
    left.legend(fontsize=7.5, title="amplitude" if report.amplitudes else None)
    x = report.amplitudes or [*range(1, count + 1)]
    for change in report.changes:
        kind, _, mode = change.parameter.partition(", ")
        value, error = _relative(change)
        ax, label = panels[kind], mode or "all modes"
        ax.errorbar(x, value, error, marker="o", ms=3.0, capsize=2.0, label=label)
        ax.set(ylabel=f"{kind} (%)")
    for ax in panels.values():
        ax.legend(fontsize=7.0)
    panels["gain"].set(title="change from the first amplitude")
    name = f"rms amplitude of the input ({report.input_unit})"
    panels["damping"].set(
        xlabel=name if report.amplitudes else "number of the response"
    )
    add_title(picture, "Modes by amplitude of the input")
    return picture


def level_labels(found: ResponseLevels) -> list[str]:
    """Return a short name of each amplitude."""
    report = found.report
    if report.amplitudes is not None:
        return [f"{a:.3g} {report.input_unit}" for a in report.amplitudes]
    return [
        Path(source).name if ": " not in source else source.rpartition(": ")[2]
        for source in report.levels
    ]


def _relative(change: LevelChange) -> tuple[list[float], list[float]]:
    """Return the changes from the first level and their errors, in percent."""
    first = change.levels[0].value
    return (
        [100.0 * (one.value / first - 1.0) for one in change.levels],
        [100.0 * abs(one.standard_error / first) for one in change.levels],
    )
