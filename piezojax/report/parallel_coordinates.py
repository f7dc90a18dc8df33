"""Picture of parallel coordinates: points of a sweep over many parameters."""

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure

from ..sweeping.metric_maps import MetricMap
from .figures import add_title, figure
from .sweep_scale import COLOUR_MAP, LOST, Parameter, colour_bar, scale_of

MOST_LINES = 1500
"""Largest number of lines.

A third are the best points; the others are chosen at equal steps of rank."""


def parallel_coordinates(
    shown: list[MetricMap], axes: list[Parameter], title: str
) -> Figure:
    """Draw a line for each point across one vertical axis for each parameter."""
    picture = figure(max(5.5, 1.6 * len(axes) + 2.0), 0.7 + 3.4 * len(shown))
    places = picture.subplots(len(shown), 1, squeeze=False)[:, 0]
    for panel, ax in zip(shown, places, strict=True):
        values = panel.finite().ravel()
        norm = scale_of(values)
        chosen = _chosen(values)
        heights = [
            _height(axis.values[chosen], axis.values, axis.logarithmic) for axis in axes
        ]
        lost = np.isnan(values[chosen])
        colours = np.array(
            colormaps[COLOUR_MAP](norm(np.where(lost, 1.0, values[chosen])))
        )
        colours[lost] = to_rgba(LOST)
        lines = np.stack(
            [np.broadcast_to(np.arange(len(axes)), (chosen.size, len(axes))).T, heights]
        ).T
        ax.add_collection(LineCollection(list(lines), colors=colours, linewidths=0.7))
        _draw_axes(ax, axes)
        note = "grey: unstable or lost" if lost.any() else ""
        colour_bar(picture, ax, ScalarMappable(norm, COLOUR_MAP), panel.unit, note)
        least = (
            f"least: {np.nanmin(values):.3g} {panel.unit}".rstrip()
            if not lost.all()
            else ""
        )
        count = (
            f"{chosen.size} of {values.size} points"
            if chosen.size < values.size
            else ""
        )
        ax.set_title(
            "; ".join(part for part in (panel.title, least, count) if part),
            fontweight="normal",
            pad=20,
        )
    add_title(picture, title)
    return picture


def _chosen(values: np.ndarray) -> np.ndarray:
    """Return the indices of the drawn points; the best are last, to lie on top."""
    order = np.argsort(np.where(np.isnan(values), np.inf, values))
    best, rest = order[: MOST_LINES // 3], order[MOST_LINES // 3 :]
    step = max(1, -(-rest.size // (MOST_LINES - MOST_LINES // 3)))
    return np.concatenate([best, rest[::step]])[::-1]


def _height(values: np.ndarray, every: np.ndarray, logarithmic: bool) -> np.ndarray:
    """Return ``values`` relative to the range of ``every``, from 0 to 1."""
    low, high = every.min(), every.max()
    if logarithmic:
        values, low, high = np.log(values), np.log(low), np.log(high)
    return (values - low) / (high - low if high > low else 1.0)


def _draw_axes(ax: Axes, axes: list[Parameter]) -> None:
    """Draw the vertical axes and label both ends of each."""
    ax.set(xlim=(-0.25, len(axes) - 0.75), ylim=(-0.02, 1.02), yticks=[])
    ax.set_xticks(range(len(axes)), [_in_lines(axis.label) for axis in axes])
    ax.tick_params(axis="x", length=0, pad=14)
    ax.grid(False)
    ax.spines[:].set_visible(False)
    for place, axis in enumerate(axes):
        ax.axvline(place, color="#222222", lw=0.9, zorder=3)
        for height, value, where in (
            (-0.035, axis.values.min(), "top"),
            (1.035, axis.values.max(), "bottom"),
        ):
            ax.text(place, height, _number(value), ha="center", va=where, fontsize=8.0)


def _number(value: float) -> str:
    if not 1e-3 <= abs(value) < 1e6:
        return f"{value:.3g}"
    return np.format_float_positional(value, precision=3, fractional=False, trim="-")


def _in_lines(label: str) -> str:
    """Return ``label`` with a line for each part of the name."""
    name, bracket, unit = label.partition(" (")
    return name.replace(".", "\n") + bracket + unit
