"""Scales and colours of all pictures of a sweep."""

from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure

from .figures import plain_tick_labels

LOST = "#d9d9d9"  # colour of unstable and lost points
COLOUR_MAP = "viridis_r"  # dark for large values, so that large errors stand out
_DECADE = 10.0  # values with a larger ratio have a logarithmic scale


class Parameter(NamedTuple):
    """A swept parameter: label, values, and whether its scale is logarithmic."""

    label: str
    values: np.ndarray
    logarithmic: bool


def scale_of(values: np.ndarray) -> Normalize:
    """Return the colour scale: logarithmic if positive values span over a decade."""
    if not np.isfinite(values).any():
        return Normalize(0.0, 1.0)
    low, high = float(np.nanmin(values)), float(np.nanmax(values))
    if low > 0.0 and high > _DECADE * low:
        return LogNorm(low, high)
    return Normalize(low, high if high > low else low + 1.0)


def colour_bar(
    picture: Figure, ax: Axes, mapped: ScalarMappable, unit: str, note: str = ""
) -> None:
    """Draw the colour bar, with ticks at 1, 2 and 5 if it is logarithmic."""
    bar = picture.colorbar(mapped, ax=ax)
    bar.set_label("; ".join(part for part in (unit, note) if part))
    if isinstance(mapped.norm, LogNorm):
        plain_tick_labels(bar.ax.yaxis)
        bar.minorticks_off()
