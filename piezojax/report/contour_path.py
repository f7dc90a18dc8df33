"""Picture of a contour: the path, its error magnified, and the distance in time."""

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from ..study import Study
from ..tuning.contouring import ContourErrors
from .figures import AFTER, BEFORE, REFERENCE, UNITS, figure, headed, legend_above

_SHARE = 0.2  # of the contour's extent that the largest error is drawn as


def contour_figure(
    study: Study, title: str, contours: Sequence[ContourErrors]
) -> Figure | None:
    """Draw paths before and after tuning; None if there is no contour."""
    if study.axes is None or not contours:
        return None
    names = (*study.references.tune, *study.references.unseen)
    picture = figure(9.0, 4.0 * len(contours) + 0.3)
    panels = picture.subplots(len(contours), 2, squeeze=False)
    for found, (left, right) in zip(contours, panels, strict=True):
        path, (run, axes) = found.path, found.contour
        unit, small = UNITS[study.axes.units[axes[0]]]
        extent = np.ptp(path, axis=0).max()
        both = (found.before, found.after)
        magnified = _magnification([one.error for one in both], extent)
        left.plot(*path.T, color=REFERENCE, ls="--", lw=0.9, label="reference")
        for one, colour, label in zip(
            both, (BEFORE, AFTER), ("before", "tuned"), strict=True
        ):
            left.plot(
                *(one.nearest + magnified * one.error).T, color=colour, label=label
            )
            rms = 1e3 * one.rms
            shown = f"{label}, {rms:.4g} {small} rms" if np.isfinite(rms) else label
            right.plot(
                found.time, 1e3 * one.distance, color=colour, lw=0.9, label=shown
            )
        one, other = (study.axes.names[axis] for axis in axes)
        left.set(
            xlabel=f"{one} ({unit})",
            ylabel=f"{other} ({unit})",
            title=f"{names[run]}: error magnified {magnified:g} times\n",
        )
        # A run that diverges leaves the picture.
        middle = 0.5 * (path.min(axis=0) + path.max(axis=0))
        (x_low, y_low), (x_high, y_high) = middle - 0.7 * extent, middle + 0.7 * extent
        left.set(xlim=(x_low, x_high), ylim=(y_low, y_high), aspect="equal")
        right.set(xlabel="time (s)", ylabel=f"distance from the contour ({small})")
        legend_above(left)
        legend_above(right)
    headed(picture, f"{title}: contours, hold-out runs")
    return picture


def _magnification(errors: list[np.ndarray], extent: float) -> float:
    """Return 1, 2 or 5 times a power of ten by which errors are drawn, at least 1.

    The largest is drawn as a share of the contour; a run further off than the contour
    is large does not count.
    """
    largest = [np.abs(e[np.isfinite(e)]).max(initial=0.0) for e in errors]
    near = max((value for value in largest if value < extent), default=extent)
    wanted = _SHARE * extent / max(near, 1e-6 * extent)
    if wanted < 1.0:
        return 1.0
    power = 10.0 ** np.floor(np.log10(wanted))
    return float(max(m for m in (1.0, 2.0, 5.0) if m * power <= wanted) * power)
