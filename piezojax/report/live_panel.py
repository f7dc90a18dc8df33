"""A panel of a picture as an interactive panel: the same curves, drawn by Bokeh."""

import re
from itertools import cycle
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.colors import to_hex
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import FixedFormatter, FuncFormatter

from .thinned_curves import GAP, kept_samples

# Bokeh is imported where it draws: its import takes as long as all others together.
if TYPE_CHECKING:
    from bokeh.models import GlyphRenderer
    from bokeh.plotting import figure as LivePanel  # noqa: N812

Curves = list[tuple[np.ndarray, np.ndarray]]
"""x and y of each line of a panel."""

_DASHES = {"-": "solid", "--": "dashed", "-.": "dashdot", ":": "dotted"}
_MARKERS = {".": "circle", "o": "circle", "+": "cross", "d": "diamond", "s": "square"}
_SIDES: tuple[Any, ...] = ("right", "left", "above", "below")  # of the pointer
_READING = "@y{{%.5g}} {1} at @x{{%.5g}} {0}"
_LEGEND: dict[str, Any] = {
    "orientation": "horizontal",
    "ncols": 3,
    "location": "right",
    "click_policy": "hide",
    "label_text_font_size": "11px",
    "border_line_alpha": 0.0,
    "padding": 0,
    "margin": 0,
}
_TARGET = 12.0  # size (pixels) in which a sample of a loop reacts to the pointer


def has_curves_only(ax: Axes) -> bool:
    """Return whether ``live_panel`` can draw all of ``ax``.

    It draws lines without steps, markers, and shaded bands across the whole panel. The
    panel must be in a grid and have linear or logarithmic scales with numbers as ticks.
    """
    return (
        ax.get_subplotspec() is not None
        and not (ax.collections or ax.images or ax.texts or ax.tables)
        and all(_on_axes(patch, ax) != (True, True) for patch in ax.patches)
        and all(line.get_drawstyle() == "default" for line in ax.lines)
        and {ax.get_xscale(), ax.get_yscale()} <= {"linear", "log"}
        and not any(_has_words(axis) for axis in (ax.xaxis, ax.yaxis))
    )


def live_panel(
    ax: Axes, labels: tuple[str, str], height: float, samples: Curves
) -> "LivePanel":
    """Return ``ax`` as a panel with a ``height`` in pixels.

    Colours, scales, ranges and legend are those of ``ax``; ``labels`` are those of its
    x and y axis. ``samples`` is the result of ``curves`` for ``ax``.
    """
    from bokeh.models import BoxAnnotation, HoverTool, Legend
    from bokeh.plotting import figure

    panel = figure(**_frame(ax, labels), height=round(height))
    panel.axis.axis_label_text_font_style = "normal"
    for patch in ax.patches:
        panel.add_layout(BoxAnnotation(**_shade(patch, ax)))
    drawn = [
        (line, _draw(panel, line, x, y))
        for line, (x, y) in zip(ax.lines, samples, strict=True)
    ]
    named = [(line, parts) for line, parts in drawn if _label(line)]
    for (line, parts), side in zip(named or drawn, cycle(_SIDES), strict=False):
        reading = _reading(line, labels)
        panel.add_tools(HoverTool(renderers=[parts[-1]], attachment=side, **reading))
    if ax.get_legend():
        items = [(_label(line), parts) for line, parts in named]
        panel.add_layout(Legend(items=items, **_LEGEND), "above")
    if ax.get_aspect() != "auto":
        panel.sizing_mode, panel.width = "fixed", round(height)
    return panel


def _frame(ax: Axes, labels: tuple[str, str]) -> dict[str, Any]:
    """Return title, labels, scales and ranges of ``ax``; the ranges limit the zoom."""
    from bokeh.models import Range1d

    frame: dict[str, Any] = {
        "title": ax.get_title().strip(),
        "tools": "box_zoom,pan,wheel_zoom,reset",
        "active_drag": "box_zoom",
        "sizing_mode": "stretch_width",
    }
    for side, label, (axis, ends) in zip("xy", labels, _sides(ax), strict=True):
        frame[f"{side}_range"] = Range1d(start=ends[0], end=ends[1], bounds="auto")
        frame[f"{side}_axis_type"] = axis.get_scale()
        frame[f"{side}_axis_label"] = label
    return frame


def curves(ax: Axes, columns: int) -> Curves:
    """Return x and y of the ``kept_samples`` of each line of ``ax``, NaN at gaps."""
    return [_samples(line, ax, columns) for line in ax.lines]


def _samples(line: Line2D, ax: Axes, columns: int) -> tuple[np.ndarray, np.ndarray]:
    values, shares = [], []
    for data, inside, (axis, ends) in zip(
        line.get_data(), _on_axes(line, ax), _sides(ax), strict=True
    ):
        value = np.asarray(data if inside else ends, dtype=float)
        scale = axis.get_transform()
        low, high = scale.transform(np.array(ends))
        values.append(value)
        shares.append((scale.transform(value) - low) / (high - low))
    kept = kept_samples(*shares, columns=columns)
    x, y = (np.where(kept == GAP, np.nan, value[kept]) for value in values)
    return x.astype(np.float32), y.astype(np.float32)


def _sides(ax: Axes) -> list[tuple[Axis, tuple[float, float]]]:
    """Return each axis with its range."""
    return [(ax.xaxis, ax.get_xlim()), (ax.yaxis, ax.get_ylim())]


def _on_axes(artist: Line2D | Patch, ax: Axes) -> tuple[bool, bool]:
    """Return whether x and y of ``artist`` are in data coordinates of ``ax``.

    For a line or a band across the whole panel, only one of them is.
    """
    is_patch = isinstance(artist, Patch)
    transform = artist.get_data_transform() if is_patch else artist.get_transform()
    x, y = transform.contains_branch_seperately(ax.transData)
    return x, y


def _has_words(axis: Axis) -> bool:
    """Return whether the ticks of ``axis`` are words instead of numbers."""
    return isinstance(axis.get_major_formatter(), FixedFormatter | FuncFormatter)


def _shade(patch: Patch, ax: Axes) -> dict[str, Any]:
    """Return the position and colour of a shaded band across the panel."""
    place = patch.get_window_extent().transformed(ax.transData.inverted())
    return {
        "left": place.x0,
        "right": place.x1,
        "bottom": place.y0,
        "top": place.y1,
        "fill_color": to_hex(patch.get_facecolor()),
        "fill_alpha": 1.0,
        "level": "underlay",
    }


def _draw(
    panel: "LivePanel", line: Line2D, x: np.ndarray, y: np.ndarray
) -> list["GlyphRenderer"]:
    """Draw ``line`` and its markers through the samples (x, y)."""
    from bokeh.models import ColumnDataSource

    dash, marker = line.get_linestyle(), str(line.get_marker())
    style: dict[str, Any] = {
        "source": ColumnDataSource({"x": x, "y": y}),
        "color": to_hex(line.get_color()),
        "alpha": line.get_alpha() or 1.0,
        "name": _label(line),
    }
    drawn = []
    if dash in _DASHES:
        width = line.get_linewidth()
        drawn += [
            panel.line("x", "y", line_dash=_DASHES[dash], line_width=width, **style)
        ]
    if marker in _MARKERS:
        size = line.get_markersize() * (0.7 if marker == "." else 1.4)
        drawn += [panel.scatter("x", "y", marker=_MARKERS[marker], size=size, **style)]
    if not _rises(line):
        style |= {"alpha": 0.0, "size": _TARGET}  # a thin line is hard to point at
        drawn += [panel.scatter("x", "y", **style)]
    return drawn


def _label(line: Line2D) -> str:
    """Return the label of ``line``, or "" if it has none."""
    label = str(line.get_label())
    return "" if label.startswith("_") else label


def _reading(line: Line2D, labels: tuple[str, str]) -> dict[str, Any]:
    """Return the HoverTool settings that show the values of ``line`` at the pointer."""
    return {
        "mode": "vline" if _rises(line) else "mouse",
        "limit": 1,
        "tooltips": [(_label(line), _READING.format(*map(_unit, labels)))],
        "formatters": {"@x": "printf", "@y": "printf"},
        "visible": False,
    }


def _rises(line: Line2D) -> bool:
    """Return whether x of ``line`` rises from each sample to the next."""
    return bool(np.all(np.diff(np.asarray(line.get_xdata(), dtype=float)) > 0.0))


def _unit(label: str) -> str:
    """Return the unit at the end of the label of an axis, "" if it has none."""
    found = re.search(r"\(([^()]*)\)$", label)
    return found[1] if found else ""
