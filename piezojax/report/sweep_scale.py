"""What all pictures of a sweep share: what is drawn, how it is scaled and coloured."""

from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure

from .figures import ticks_in_full

LOST = "#d9d9d9"  # the colour of points that are lost
COLOUR_MAP = "viridis_r"  # dark is large: what is bad stands out
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


def kept(values: np.ndarray) -> np.ndarray:
    """Return ``values`` with NaN for what is lost: not finite, or far beyond."""
    finite = np.where(np.isfinite(values), values, np.nan)
    if not np.isfinite(finite).any():
        return finite
    middle = np.nanmedian(finite)
    far = (finite > _BEYOND * middle) if middle > 0.0 else False
    return np.where(far, np.nan, finite)


def scale_of(values: np.ndarray) -> Normalize:
    """Return the scale of colours: logarithmic where values span a decade."""
    if not np.isfinite(values).any():
        return Normalize(0.0, 1.0)
    low, high = float(np.nanmin(values)), float(np.nanmax(values))
    if low > 0.0 and high > _DECADE * low:
        return LogNorm(low, high)
    return Normalize(low, high if high > low else low + 1.0)


def colour_bar(
    picture: Figure, ax: Axes, mapped: ScalarMappable, unit: str, note: str = ""
) -> None:
    """Draw the scale of colours, its ticks at 1, 2 and 5 if it is logarithmic."""
    bar = picture.colorbar(mapped, ax=ax)
    bar.set_label("; ".join(part for part in (unit, note) if part))
    if isinstance(mapped.norm, LogNorm):
        ticks_in_full(bar.ax.yaxis)
        bar.minorticks_off()
