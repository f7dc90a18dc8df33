"""Pictures of state-space identification: singular values, transfer matrix."""

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from ..identification.estimators.frequency import EmpiricalResponse
from .figures import AFTER, BEFORE, MEASURED, figure

SHOWN = 60
"""Number of singular values drawn, or five more than the order if that is larger."""


def singular_values_figure(
    values: Sequence[float] | np.ndarray, order: int, title: str = ""
) -> Figure:
    """Draw singular values relative to the largest, with ``order`` marked."""
    shares = np.asarray(values)[: max(SHOWN, order + 5)] / np.max(values)
    number = np.arange(1, len(shares) + 1)
    picture = figure(5.6, 3.4)
    ax = picture.subplots()
    kept = number <= order
    ax.semilogy(number[kept], shares[kept], "o", ms=4, color=AFTER, label="kept")
    ax.semilogy(
        number[~kept], shares[~kept], "o", ms=4, color=MEASURED, label="left out"
    )
    ax.axvline(order + 0.5, color=BEFORE, lw=1.0)
    ax.annotate(
        f"order {order}",
        (order + 0.5, 1.0),
        xytext=(4, -2),
        textcoords="offset points",
        color=BEFORE,
        va="top",
    )
    ax.set(xlabel="number", ylabel="singular value / largest", title=title)
    ax.legend()
    return picture


def response_figure(
    measured: EmpiricalResponse,
    fitted: np.ndarray,
    inputs: Sequence[str],
    outputs: Sequence[str],
    unit: str = "um/V",
) -> Figure:
    """Draw the Bode plot of a measured transfer matrix and of the model.

    A column for each input; the measured gain has its 95 % band. ``measured.response``
    and ``fitted``, the response of the model, are [lines, p, m].
    """
    spread = measured.band()
    picture = figure(3.4 * len(inputs) + 0.6, 3.0 * len(outputs))
    panels = picture.subplots(
        2 * len(outputs),
        len(inputs),
        sharex=True,
        sharey="row",
        squeeze=False,
        height_ratios=(2, 1) * len(outputs),
    )
    unit = unit.replace("um", "µm")
    for i, output in enumerate(outputs):
        for j, name in enumerate(inputs):
            magnitude, phase = panels[2 * i, j], panels[2 * i + 1, j]
            size = np.abs(measured.response[:, i, j])
            band = spread[:, i, j]
            magnitude.fill_between(
                measured.frequency,
                np.maximum(size - band, 0.3 * size),
                size + band,
                color=MEASURED,
                alpha=0.35,
                lw=0.0,
                label="measured, 95 %",
            )
            magnitude.semilogy(measured.frequency, size, color=MEASURED, lw=0.8)
            magnitude.semilogy(
                measured.frequency,
                np.abs(fitted[:, i, j]),
                color=AFTER,
                lw=0.9,
                label="model",
            )
            magnitude.set(title=f"{name} to {output}")
            for response, colour in ((measured.response, MEASURED), (fitted, AFTER)):
                angle = np.degrees(np.angle(response[:, i, j]))
                phase.plot(measured.frequency, angle, ".", ms=0.8, color=colour)
            phase.set(ylim=(-190, 190), yticks=(-180, 0, 180))
        panels[2 * i, 0].set(ylabel=f"gain ({unit})")
        panels[2 * i + 1, 0].set(ylabel="phase (°)")
    for ax in panels[-1]:
        ax.set(xlabel="frequency (Hz)")
    panels[0, 0].legend(fontsize=7.0)
    return picture
