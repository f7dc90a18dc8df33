"""Pictures of a sweep, and the table of its best points."""

from pathlib import Path
from textwrap import fill
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from rich.table import Table

from ..study.sweep_table import SENSITIVITY
from ..sweeping.metric_maps import (
    MetricMap,
    averaging,
    metric_maps,
    metrics_in,
    open_dataset,
)
from .figures import AFTER, UNITS, Pictures, add_title, figure, plot_style, write
from .page import Page
from .parallel_coordinates import parallel_coordinates
from .sweep_scale import COLOUR_MAP, LOST, Parameter, colour_bar, scale_of

if TYPE_CHECKING:
    from xarray import Dataset

MOST_PANELS = 12


def write_pictures(path: Path, folder: Path) -> Pictures:
    """Write a picture of each metric of the data set ``path`` into ``folder``.

    Returns the pictures.
    """
    drawn: Pictures = {}
    with open_dataset(path) as dataset, plot_style():
        for name in metrics_in(dataset):
            drawn |= write(metric_figure(dataset, name), folder / f"{name}.png")
    return drawn


def metric_figure(dataset: "Dataset", name: str) -> Figure:
    """Return the picture of a metric.

    A grid of one parameter gives a curve, a grid of two a heat map; larger grids and
    samples give parallel coordinates.
    """
    shown = panels(dataset, name)[:MOST_PANELS]
    axes = parameters(dataset)
    title = "\n".join(
        fill(text, 60, break_on_hyphens=False)
        for text in (dataset.attrs["title"], label_of(dataset, name))
    )
    if dataset.attrs["method"] != "grid" or len(axes) > 2:
        return parallel_coordinates(shown, _flattened(dataset, axes), title)
    columns = min(len(shown), 3)
    rows = -(-len(shown) // columns)
    picture = figure(0.6 + 4.4 * columns, 0.5 + 3.4 * rows)
    places = picture.subplots(rows, columns, squeeze=False).ravel()
    for panel, ax in zip(shown, places, strict=False):
        if len(axes) == 2:
            _heat_map(picture, ax, panel, axes)
        else:
            _curve(ax, panel, axes[0])
        if len(shown) > 1:
            ax.set_title(panel.title)
    for ax in places[len(shown) :]:
        ax.remove()
    add_title(picture, title)
    return picture


def label_of(dataset: "Dataset", name: str) -> str:
    """Return the label of a metric, with its average over references if it has one."""
    label = str(dataset[name].attrs["long_name"])
    if "reference" not in dataset[name].dims:
        return label
    return f"{label}, {averaging(name)} over {dataset.sizes['reference']} references"


def panels(dataset: "Dataset", name: str) -> list[MetricMap]:
    """Return the map of a metric for each plant and axis, in the units of pictures."""
    maps = []
    for metric in metric_maps(dataset, name):
        unit, factor = _shown_unit(name, metric.unit)
        maps.append(MetricMap(metric.title, factor * metric.values, unit))
    return maps


def _shown_unit(name: str, unit: str) -> tuple[str, float]:
    if name in ("rms_error", "peak_error"):
        return UNITS[unit][1], 1e3
    if name == "saturated":
        return "%", 100.0
    return ("" if unit == "1" else UNITS[unit][0] if unit in UNITS else unit), 1.0


def parameters(dataset: "Dataset") -> list[Parameter]:
    """Return the swept parameters, in the order of the study."""
    swept = []
    for name, variable in dataset.coords.items():
        if "scale" not in variable.attrs:
            continue
        parts = str(name).split(".")
        unit = variable.attrs["units"]
        # The last two names of a path distinguish the parameters.
        label = ".".join(parts[-2:]).replace("_", " ") + (
            f" ({unit.replace('um', 'µm')})" if unit not in ("", "1") else ""
        )
        swept.append(
            Parameter(label, variable.values, variable.attrs["scale"] == "log")
        )
    return swept


def _flattened(dataset: "Dataset", axes: list[Parameter]) -> list[Parameter]:
    if dataset.attrs["method"] != "grid":
        return axes
    grids = np.meshgrid(*(axis.values for axis in axes), indexing="ij")
    return [
        axis._replace(values=grid.ravel())
        for axis, grid in zip(axes, grids, strict=True)
    ]


def _heat_map(
    picture: Figure, ax: Axes, panel: MetricMap, axes: list[Parameter]
) -> None:
    values = panel.finite()
    horizontal, vertical = axes[1], axes[0]
    ax.set_facecolor(LOST)
    mesh = ax.pcolormesh(
        horizontal.values,
        vertical.values,
        values,
        shading="nearest",
        cmap=COLOUR_MAP,
        norm=scale_of(values),
        rasterized=True,
    )
    for axis, scale in ((horizontal, ax.set_xscale), (vertical, ax.set_yscale)):
        if axis.logarithmic:
            scale("log")
    ax.set(xlabel=horizontal.label, ylabel=vertical.label)
    ax.grid(False)
    colour_bar(picture, ax, mesh, panel.unit)
    least = panel.argmin()
    if least is not None and np.sum(values == values[least]) == 1:
        row, column = least
        ax.plot(
            horizontal.values[column],
            vertical.values[row],
            "o",
            ms=7,
            mfc="none",
            mec="#c9293d",
            mew=1.6,
            label=f"least: {values[row, column]:.3g} {panel.unit}".rstrip(),
        )
    if np.isnan(values).any():
        ax.plot([], [], "s", color=LOST, label="unstable or lost")
    if ax.get_legend_handles_labels()[0]:
        ax.legend(
            loc="upper center",
            bbox_to_anchor=(0.5, -0.18),
            ncols=2,
            borderaxespad=0.0,
        )


def _curve(ax: Axes, panel: MetricMap, axis: Parameter) -> None:
    values = panel.finite()
    ax.plot(axis.values, values, "o-", ms=3, color=AFTER)
    if axis.logarithmic:
        ax.set_xscale("log")
    if isinstance(scale_of(values), LogNorm):
        ax.set_yscale("log")
    ax.set(xlabel=axis.label, ylabel=panel.unit)


def sweep_page(path: Path) -> Page:
    """Return the Page of the data set at ``path``."""
    with open_dataset(path) as dataset:
        attributes = dict(dataset.attrs)
    return Page(
        str(attributes["title"]),
        (),
        [best_table(path)],
        [f"{name}: {value}" for name, value in attributes.items()],
    )


def best_table(path: Path) -> Table:
    """Return the point where the first metric is least, for each plant and axis."""
    with open_dataset(path) as dataset:
        name = metrics_in(dataset)[0]
        axes = parameters(dataset)
        grid = dataset.attrs["method"] == "grid"
        table = Table(
            title=f"{dataset.attrs['title']}\nleast {label_of(dataset, name)}"
        )
        table.add_column("plant")
        for axis in axes:
            table.add_column(axis.label, justify="right")
        table.add_column("least", justify="right")
        table.add_column("unstable or lost", justify="right")
        if SENSITIVITY not in dataset and "axis" not in dataset.dims:
            table.caption = (
                "Only runs were judged: a point may be unstable for small motions. "
                f"{SENSITIVITY} among sweep.metrics leaves such points out."
            )
        for panel in panels(dataset, name):
            values = panel.finite()
            lost = int(np.isnan(values).sum())
            share = f"{lost} of {values.size}"
            place = panel.argmin()
            if place is None:
                table.add_row(panel.title, *("-" for _ in axes), "-", share)
                continue
            where = place if grid else place * len(axes)
            shown = (
                f"{axis.values[i]:.4g}" for axis, i in zip(axes, where, strict=True)
            )
            least = f"{values[place]:.4g} {panel.unit}"
            table.add_row(panel.title, *shown, least, share)
    return table
