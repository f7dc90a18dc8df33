"""Pictures and the closing table of a sweep."""

from pathlib import Path
from textwrap import fill
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.colors import LogNorm, Normalize, to_rgba
from matplotlib.figure import Figure
from matplotlib.ticker import FormatStrFormatter, LogLocator
from rich.table import Table

from ..study.sweep_table import METRICS
from .figures import AFTER, UNITS, figure, styled, write

if TYPE_CHECKING:
    from xarray import Dataset

MOST_LINES = 1500
"""In a picture of parallel coordinates: the best, and an even choice of the others."""

MOST_PANELS = 12

_MAP = "viridis_r"  # dark is large: what is bad stands out
_DECADE = 10.0  # values that span more are shown on a logarithmic scale
_BEYOND = 1e3  # times the median of what can be shown: a loop that is lost


class Panel(NamedTuple):
    """A metric by point, for one plant and axis: the mean over the references."""

    title: str
    values: np.ndarray
    unit: str


class Parameter(NamedTuple):
    """A swept parameter: its points, and how to write and scale it."""

    label: str
    values: np.ndarray
    logarithmic: bool


def write_pictures(path: Path, folder: Path) -> None:
    """Draw each metric of the data set ``path`` into ``folder``."""
    with _opened(path) as dataset, styled():
        for name in (name for name in METRICS if name in dataset):
            write(metric_figure(dataset, name), folder / f"{name}.png")


def _opened(path: Path) -> "Dataset":
    import xarray as xr

    return xr.open_dataset(path, engine="h5netcdf", decode_times=False)


def metric_figure(dataset: "Dataset", name: str) -> Figure:
    """Return the picture of a metric.

    A heat map of a grid of two parameters, a curve over one, and parallel coordinates
    of samples and of larger grids.
    """
    shown = panels(dataset, name)[:MOST_PANELS]
    axes = parameters(dataset)
    title = "\n".join(
        fill(text, 60, break_on_hyphens=False)
        for text in (dataset.attrs["title"], label_of(dataset, name))
    )
    if dataset.attrs["method"] != "grid" or len(axes) > 2:
        return _parallel(shown, _flattened(dataset, axes), title)
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
    picture.suptitle(title, fontsize=10.0)
    return picture


def label_of(dataset: "Dataset", name: str) -> str:
    """Return what a picture of a metric shows."""
    label = str(dataset[name].attrs["long_name"])
    if "reference" not in dataset[name].dims:
        return label
    kind = "mean" if name == "saturated" else "geometric mean"
    return f"{label}, {kind} over {dataset.sizes['reference']} references"


def panels(dataset: "Dataset", name: str) -> list[Panel]:
    """Return a metric, by point, of each plant and axis."""
    variable = dataset[name]
    others = [d for d in ("plant", "axis") if d in variable.dims]
    found = []
    for place in np.ndindex(*(variable.sizes[d] for d in others)):
        chosen = dict(zip(others, place, strict=True))
        unit = str(variable.attrs["units"])
        if "axis" in chosen:
            unit = str(dataset["axis_unit"].values[chosen["axis"]])
        shown, factor = _shown_unit(name, unit)
        title = ", ".join(str(dataset[d].values[i]) for d, i in chosen.items())
        found.append(Panel(title, factor * _mean(variable.isel(chosen), name), shown))
    return found


def _shown_unit(name: str, unit: str) -> tuple[str, float]:
    if name in ("rms_error", "peak_error"):
        return UNITS[unit][1], 1e3
    if name == "saturated":
        return "%", 100.0
    return ("" if unit == "1" else UNITS[unit][0] if unit in UNITS else unit), 1.0


def _mean(variable: Any, name: str) -> np.ndarray:
    """Return the mean over references and draws: of logarithms, unless of a share."""
    over = [d for d in ("reference", "draw") if d in variable.dims]
    if not over:
        return np.asarray(variable.values)
    total, count = None, 0
    # One run after the other: a large data set is not held in memory.
    for place in np.ndindex(*(variable.sizes[d] for d in over)):
        values = variable.isel(dict(zip(over, place, strict=True))).values
        with np.errstate(divide="ignore"):
            values = values if name == "saturated" else np.log(values)
        total = values if total is None else total + values
        count += 1
    mean = np.asarray(total) / count
    return mean if name == "saturated" else np.exp(mean)


def parameters(dataset: "Dataset") -> list[Parameter]:
    """Return the swept parameters, in the order of the study."""
    found = []
    for name, variable in dataset.coords.items():
        if "transform" not in variable.attrs:
            continue
        parts = str(name).split(".")
        unit = variable.attrs["units"]
        # What is left of a long path still tells the parameters apart.
        label = ".".join(parts[-2:]).replace("_", " ") + (
            f" ({unit.replace('um', 'µm')})" if unit else ""
        )
        found.append(
            Parameter(label, variable.values, variable.attrs["transform"] == "log")
        )
    return found


def _flattened(dataset: "Dataset", axes: list[Parameter]) -> list[Parameter]:
    if dataset.attrs["method"] != "grid":
        return axes
    grids = np.meshgrid(*(axis.values for axis in axes), indexing="ij")
    return [
        axis._replace(values=grid.ravel())
        for axis, grid in zip(axes, grids, strict=True)
    ]


def _kept(values: np.ndarray) -> np.ndarray:
    """Return ``values`` with NaN for what is lost: not finite, or far beyond."""
    finite = np.where(np.isfinite(values), values, np.nan)
    if not np.isfinite(finite).any():
        return finite
    middle = np.nanmedian(finite)
    far = (finite > _BEYOND * middle) if middle > 0.0 else False
    return np.where(far, np.nan, finite)


def _scale(values: np.ndarray) -> Normalize:
    if not np.isfinite(values).any():
        return Normalize(0.0, 1.0)
    low, high = float(np.nanmin(values)), float(np.nanmax(values))
    if low > 0.0 and high > _DECADE * low:
        return LogNorm(low, high)
    return Normalize(low, high if high > low else low + 1.0)


def _heat_map(picture: Figure, ax: Axes, panel: Panel, axes: list[Parameter]) -> None:
    values = _kept(panel.values)
    across, up = axes[1], axes[0]
    ax.set_facecolor("#d9d9d9")  # what is lost
    mesh = ax.pcolormesh(
        across.values,
        up.values,
        values,
        shading="nearest",
        cmap=_MAP,
        norm=_scale(values),
        rasterized=True,
    )
    for axis, scale in ((across, ax.set_xscale), (up, ax.set_yscale)):
        if axis.logarithmic:
            scale("log")
    ax.set(xlabel=across.label, ylabel=up.label)
    ax.grid(False)
    _bar(picture, ax, mesh, panel.unit)
    if np.sum(values == np.nanmin(values, initial=np.inf)) == 1:
        row, column = np.unravel_index(np.nanargmin(values), values.shape)
        ax.plot(
            across.values[column],
            up.values[row],
            "o",
            ms=7,
            mfc="none",
            mec="#c9293d",
            mew=1.6,
            label=f"least: {values[row, column]:.3g} {panel.unit}".rstrip(),
        )
    if np.isnan(values).any():
        ax.plot([], [], "s", color="#d9d9d9", label="unstable or lost")
    if ax.get_legend_handles_labels()[0]:
        ax.legend(
            loc="upper center",
            bbox_to_anchor=(0.5, -0.18),
            ncols=2,
            borderaxespad=0.0,
        )


def _bar(
    picture: Figure, ax: Axes, mapped: ScalarMappable, unit: str, note: str = ""
) -> None:
    """Draw the scale of colours, its ticks at 1, 2 and 5 if it is logarithmic."""
    bar = picture.colorbar(mapped, ax=ax)
    bar.set_label("; ".join(part for part in (unit, note) if part))
    if isinstance(mapped.norm, LogNorm):
        bar.ax.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        bar.ax.yaxis.set_major_formatter(FormatStrFormatter("%g"))
        bar.minorticks_off()


def _curve(ax: Axes, panel: Panel, axis: Parameter) -> None:
    values = _kept(panel.values)
    ax.plot(axis.values, values, "o-", ms=3, color=AFTER)
    if axis.logarithmic:
        ax.set_xscale("log")
    if isinstance(_scale(values), LogNorm):
        ax.set_yscale("log")
    ax.set(xlabel=axis.label, ylabel=panel.unit)


def _parallel(shown: list[Panel], axes: list[Parameter], title: str) -> Figure:
    """A line for each point, across one upright axis for each parameter."""
    picture = figure(max(5.5, 1.6 * len(axes) + 2.0), 0.7 + 3.4 * len(shown))
    places = picture.subplots(len(shown), 1, squeeze=False)[:, 0]
    for panel, ax in zip(shown, places, strict=True):
        values = _kept(panel.values.ravel())
        norm = _scale(values)
        chosen = _chosen(values)
        heights = [
            _height(axis.values[chosen], axis.values, axis.logarithmic) for axis in axes
        ]
        lost = np.isnan(values[chosen])
        colours = np.array(colormaps[_MAP](norm(np.where(lost, 1.0, values[chosen]))))
        colours[lost] = to_rgba("#d9d9d9")
        lines = np.stack(
            [np.broadcast_to(np.arange(len(axes)), (chosen.size, len(axes))).T, heights]
        ).T
        ax.add_collection(LineCollection(list(lines), colors=colours, linewidths=0.7))
        _dress(ax, axes)
        note = "grey: unstable or lost" if lost.any() else ""
        _bar(picture, ax, ScalarMappable(norm, _MAP), panel.unit, note)
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
    picture.suptitle(title, fontsize=10.0)
    return picture


def _chosen(values: np.ndarray) -> np.ndarray:
    """Return the points that are drawn, the best last, so that they lie on top."""
    order = np.argsort(np.where(np.isnan(values), np.inf, values))
    best, rest = order[: MOST_LINES // 3], order[MOST_LINES // 3 :]
    step = max(1, -(-rest.size // (MOST_LINES - MOST_LINES // 3)))
    return np.concatenate([best, rest[::step]])[::-1]


def _height(values: np.ndarray, every: np.ndarray, logarithmic: bool) -> np.ndarray:
    """Return where ``values`` lie between the least and the largest, 0 to 1."""
    low, high = every.min(), every.max()
    if logarithmic:
        values, low, high = np.log(values), np.log(low), np.log(high)
    return (values - low) / (high - low if high > low else 1.0)


def _dress(ax: Axes, axes: list[Parameter]) -> None:
    """Draw the upright axes, with the ends of each written at them."""
    ax.set(xlim=(-0.25, len(axes) - 0.75), ylim=(-0.02, 1.02), yticks=[])
    ax.set_xticks(range(len(axes)), [_broken(axis.label) for axis in axes])
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


def _broken(label: str) -> str:
    """Return a long label in two lines."""
    name, bracket, unit = label.partition(" (")
    return name.replace(".", "\n") + bracket + unit


def best_table(path: Path) -> Table:
    """Return where the first metric is least, for each plant and axis."""
    with _opened(path) as dataset:
        name = next(name for name in METRICS if name in dataset)
        axes = parameters(dataset)
        grid = dataset.attrs["method"] == "grid"
        table = Table(
            title=f"{dataset.attrs['title']}\nleast {label_of(dataset, name)}"
        )
        table.add_column("plant")
        for axis in axes:
            table.add_column(axis.label, justify="right")
        table.add_column("least", justify="right")
        table.add_column("diverged", justify="right")
        for panel in panels(dataset, name):
            values = _kept(panel.values)
            lost = int(np.isnan(values).sum())
            share = f"{lost} of {values.size}"
            if lost == values.size:
                table.add_row(panel.title, *("-" for _ in axes), "-", share)
                continue
            place = np.unravel_index(np.nanargmin(values), values.shape)
            where = place if grid else place * len(axes)
            shown = (
                f"{axis.values[i]:.4g}" for axis, i in zip(axes, where, strict=True)
            )
            least = f"{values[place]:.4g} {panel.unit}"
            table.add_row(panel.title, *shown, least, share)
    return table
