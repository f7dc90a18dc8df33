"""Picture of the coupling between axes before and after tuning."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.image import AxesImage

from ..tuning.coupling import Coupling
from .figures import UNITS, add_title, figure

_LEAST = 1e-6  # %; smaller shares have the colour of this one


def coupling_figure(
    coupling: tuple[Coupling, Coupling] | None, title: str
) -> Figure | None:
    """Draw heat maps of the held-out errors while only one axis is driven.

    ``coupling`` holds the coupling before and after tuning. Return None if the stage
    has one axis, or if no reference drives an axis alone.
    """
    if coupling is None:
        return None
    before, after = coupling
    shares = np.stack([before.percent, after.percent])
    shown = shares[np.isfinite(shares)]
    if not shown.size:
        return None
    limits = np.maximum([shown.min(), shown.max()], _LEAST)
    norm = LogNorm(limits[0], max(limits[1], 1.001 * limits[0]))
    picture = figure(10.0, 1.1 + 0.95 * len(before.names))
    panels = picture.subplots(1, 2)
    images = [
        _map(ax, panel_coupling, norm, heading)
        for ax, panel_coupling, heading in zip(
            panels, (before, after), ("before", "tuned"), strict=True
        )
    ]
    picture.colorbar(
        images[-1],
        ax=panels,
        label="rms error, % of the driven amplitude\n"
        "(different units: µm per 100 µrad, µrad per 100 µm)",
    )
    add_title(picture, f"{title}: rms errors with one axis driven, hold-out")
    return picture


def _map(ax: Axes, coupling: Coupling, norm: LogNorm, title: str) -> AxesImage:
    shares = np.clip(coupling.percent, norm.vmin, norm.vmax)
    image = ax.imshow(shares, norm=norm, cmap="YlGnBu", aspect="auto")
    places = range(len(coupling.names))
    driven = [
        f"{name}\n{amplitude:g} {UNITS[unit][0]}"
        for name, amplitude, unit in zip(
            coupling.names, coupling.amplitudes, coupling.units, strict=True
        )
    ]
    ax.set(xlabel="axis measured", ylabel="axis driven, amplitude", title=title)
    ax.set_xticks(places, coupling.names)
    ax.set_yticks(places, driven)
    ax.grid(visible=False)
    for row in places:
        for column in places:
            dark = np.isfinite(shares[row, column]) and norm(shares[row, column]) > 0.6
            ax.text(
                column,
                row,
                _cell_text(coupling, row, column),
                ha="center",
                va="center",
                color="white" if dark else "black",
            )
    return image


def _cell_text(coupling: Coupling, row: int, column: int) -> str:
    share, error = coupling.percent[row, column], coupling.errors[row, column]
    if not np.isfinite(error):
        return "-"
    driven, (large, small) = (
        UNITS[coupling.units[row]][0],
        UNITS[coupling.units[column]],
    )
    alike = coupling.units[row] == coupling.units[column]
    ratio = f"{share:.3g} %" if alike else f"{10.0 * share:.3g} {small}/{driven}"
    amount = f"{error:.3g} {large}" if error >= 1.0 else f"{1e3 * error:.3g} {small}"
    return f"{ratio}\n{amount}"
