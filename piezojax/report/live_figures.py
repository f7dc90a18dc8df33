"""Pictures as interactive figures, with readout and zoom, by Bokeh."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cbook import GrouperView
from matplotlib.figure import Figure
from matplotlib.gridspec import SubplotSpec

from .live_panel import Curves, curves, has_curves_only, live_panel

if TYPE_CHECKING:
    from bokeh.model import Model
    from bokeh.models import LayoutDOM

COLUMNS = 1000
"""Largest number of columns into which the range of a curve is divided."""

BUDGET = 60_000
"""Largest number of samples in all curves of a page; each takes 8 bytes."""

NOTE = (
    "Point at a curve to read it, drag a rectangle to enlarge it, click a name to hide "
    "its curve. Long curves show the first, least, greatest and last sample of each of "
    "{} columns; a loop that repeats itself is drawn once. The PNG files show all "
    "samples."
)

_PIXELS = 105.0  # height of a panel on the screen for each inch of the picture


@dataclass(frozen=True)
class LiveFigures:
    """Interactive figures as HTML, by name, with the scripts that draw them.

    The name of a figure is that of its PNG file. ``note`` tells how to use the figures,
    and how their curves are thinned.
    """

    figures: Mapping[str, str] = field(default_factory=dict)
    scripts: str = ""
    note: str = ""


def live_figures(
    pictures: Mapping[str, Figure], widgets: "dict[str, Model] | None" = None
) -> LiveFigures:
    """Return those of ``pictures`` that consist of curves as interactive figures.

    Their curves are those of the pictures, thinned to at most ``BUDGET`` samples in
    all. ``widgets`` are added unchanged. The scripts contain Bokeh; they need no
    network.
    """
    widgets = widgets or {}
    drawn = {
        name: picture
        for name, picture in pictures.items()
        if picture.axes and all(map(has_curves_only, picture.axes))
    }
    if not (drawn or widgets):
        return LiveFigures()
    from bokeh.embed import components
    from bokeh.resources import Component, Resources

    panels = [ax for picture in drawn.values() for ax in picture.axes]
    samples, columns = _thinned(panels)
    shown: dict[str, "Model"] = {
        name: _grid(picture, samples) for name, picture in drawn.items()
    }
    script, roots = components(shown | widgets, wrap_plot_info=False)
    figures = {
        name: f'<div class="live" id="{root.elementid}" data-root-id="{root.id}"></div>'
        for name, root in roots.items()
    }
    parts: list[Component] = ["bokeh", "bokeh-widgets"] if widgets else ["bokeh"]
    inline = Resources(mode="inline", components=parts, log_level="warn").render_js()
    return LiveFigures(figures, f"{inline}\n{script}\n", NOTE.format(columns))


def _thinned(panels: Sequence[Axes]) -> tuple[dict[Axes, Curves], int]:
    """Return the curves of ``panels`` within ``BUDGET``, and the number of columns."""
    columns = COLUMNS
    while True:
        found = {ax: curves(ax, columns) for ax in panels}
        count = sum(x.size for lines in found.values() for x, _ in lines)
        if count <= BUDGET or columns == 1:
            return found, columns
        columns //= 2


def _grid(picture: Figure, samples: Mapping[Axes, Curves]) -> "LayoutDOM":
    """Return the panels of ``picture``; those that share an axis move together."""
    from bokeh.layouts import gridplot

    places = {ax: spec for ax in picture.axes if (spec := ax.get_subplotspec())}
    panels = {
        ax: live_panel(ax, _labels(ax, places), _height(spec, picture), samples[ax])
        for ax, spec in places.items()
    }
    for ax, panel in panels.items():
        panel.x_range = panels[_first(ax.get_shared_x_axes(), ax, panels)].x_range
        panel.y_range = panels[_first(ax.get_shared_y_axes(), ax, panels)].y_range
    rows, across = next(iter(places.values())).get_gridspec().get_geometry()
    grid: list[list[Any]] = [[None] * across for _ in range(rows)]
    for ax, spec in places.items():
        grid[spec.rowspan.start][spec.colspan.start] = panels[ax]
    found = gridplot(grid, toolbar_options={"logo": None})
    found.sizing_mode = "stretch_width"
    found.update(cols="minmax(0, 1fr)")  # equal widths
    return found


def _first(groups: GrouperView, ax: Axes, panels: Iterable[Axes]) -> Axes:
    """Return the first of ``panels`` that shares an axis with ``ax``."""
    return next(other for other in panels if other in groups.get_siblings(ax))


def _height(spec: SubplotSpec, picture: Figure) -> float:
    """Return the height (pixels) of the panel at ``spec``."""
    ratios = np.asarray(spec.get_gridspec().get_height_ratios(), dtype=float)
    share = ratios[spec.rowspan.start] / ratios.sum()
    return float(_PIXELS * share * picture.get_figheight())


def _labels(ax: Axes, places: Mapping[Axes, SubplotSpec]) -> tuple[str, str]:
    """Return the labels of x and y; a missing one is that of the column or row."""
    here = places[ax]
    column = [other for other, spec in places.items() if spec.colspan == here.colspan]
    row = [other for other, spec in places.items() if spec.rowspan == here.rowspan]
    x = [ax.get_xlabel(), *(other.get_xlabel() for other in reversed(column)), ""]
    y = [ax.get_ylabel(), *(other.get_ylabel() for other in row), ""]
    return next(filter(None, x), ""), next(filter(None, y), "")
