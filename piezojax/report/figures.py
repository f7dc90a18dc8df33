"""Style of all pictures, and writing of a picture to a file."""

import io
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from textwrap import fill
from typing import Any

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.ticker import FormatStrFormatter, LogLocator, NullFormatter

from ..core.files import write_bytes
from ..core.profile import DRAWING, stage

REFERENCE, BEFORE, AFTER, MEASURED = "#222222", "#c9753d", "#1f6f8b", "#8a8a8a"
"""Colours with one meaning in every picture."""

LOOP_COLOURS = {"before": BEFORE, "after": AFTER}
"""Colours of a loop by its name."""

Pictures = dict[str, Figure]
"""Figures by the name of their file."""

UNITS = {"um": ("µm", "nm"), "urad": ("µrad", "nrad")}
"""A unit as written in pictures, and the unit a thousand times smaller."""

STYLE: dict[Any, Any] = {
    "font.size": 9.0,
    "axes.titlesize": 9.5,
    "axes.titleweight": "bold",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": "#e4e4e4",
    "grid.linewidth": 0.6,
    "lines.linewidth": 1.2,
    "legend.frameon": False,
    "figure.dpi": 150.0,
}


def figure(width: float, height: float) -> Figure:
    """Return an empty figure of ``width`` x ``height`` inches.

    It is made without pyplot, which would keep global state and choose a backend.
    """
    return Figure(figsize=(width, height), layout="constrained")


def small_units(units: Iterable[str]) -> str:
    """Return the units of small errors, "nm or nrad"; "nm" if there are no units."""
    return " or ".join(dict.fromkeys(UNITS[unit][1] for unit in units)) or "nm"


def plain_number(value: float) -> str:
    """Return ``value``, at least 0, in three digits or, from 999.5, as an integer."""
    return f"{value:.3g}" if value < 999.5 else f"{value:.0f}"


def add_title(picture: Figure, title: str) -> None:
    """Put ``title`` above all panels, with long lines wrapped to the width."""
    width = int(11.0 * picture.get_figwidth())
    picture.suptitle("\n".join(fill(line, width) for line in title.splitlines()))


def legend_above(ax: Axes) -> None:
    """Put the legend of ``ax`` above its panel, so that it covers no data."""
    ax.legend(
        loc="lower right",
        bbox_to_anchor=(1.0, 0.98),
        ncols=3,
        borderaxespad=0.0,
        columnspacing=1.2,
        handlelength=1.4,
    )


def plain_tick_labels(axis: Axis) -> None:
    """Label a short logarithmic ``axis`` with numbers, not powers.

    Call it after the curves are drawn. The labels are at 1, 2 and 5, or, if the axis
    may hold only one of these, at every digit.
    """
    low, high = axis.get_view_interval()
    digits = (1.0, 2.0, 5.0) if high >= 5.0 * low else range(1, 10)
    axis.set_major_locator(LogLocator(subs=digits))
    axis.set_major_formatter(FormatStrFormatter("%g"))
    axis.set_minor_formatter(NullFormatter())


@contextmanager
def plot_style() -> Iterator[None]:
    """Apply ``STYLE`` to the pictures drawn inside; ``--profile`` counts the time."""
    with stage(DRAWING), mpl.rc_context(STYLE):
        yield


def write(picture: Figure, path: Path) -> Pictures:
    """Write ``picture`` as PNG and return it; a failure leaves no partial file."""
    buffer = io.BytesIO()
    picture.savefig(buffer, format="png")
    write_bytes(path, buffer.getvalue())
    return {path.name: picture}
