"""Picture of contours: paths with magnified error, and contour error against time."""

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from ..study import Study
from ..tuning.contouring import ContourErrors
from .figures import AFTER, BEFORE, REFERENCE, UNITS, add_title, figure, legend_above

_SHARE = 0.2  # largest error as drawn, as a share of the contour's extent


def contour_figure(
    study: Study, title: str, contours: Sequence[ContourErrors]
) -> Figure | None:
    """Draw the paths before and after tuning. Return None if there is no contour."""
    if study.axes is None or not contours:
        return None
    names = (*study.references.tune, *study.references.unseen)
    picture = figure(9.0, 4.0 * len(contours) + 0.3)
    panels = picture.subplots(len(contours), 2, squeeze=False)
    for errors, (left, right) in zip(contours, panels, strict=True):
        path, (run, axes) = errors.path, errors.contour
        unit, small = UNITS[study.axes.units[axes[0]]]
        extent = np.ptp(path, axis=0).max()
        both = (errors.before, errors.after)
        magnified = _magnification([deviation.error for deviation in both], extent)
        left.plot(*path.T, color=REFERENCE, ls="--", lw=0.9, label="reference")
        for deviation, colour, label in zip(
            both, (BEFORE, AFTER), ("before", "tuned"), strict=True
        ):
            left.plot(
                *(deviation.nearest + magnified * deviation.error).T,
                color=colour,
                label=label,
            )
            rms = 1e3 * deviation.rms
            shown = f"{label}, {rms:.4g} {small} rms" if np.isfinite(rms) else label
            right.plot(
                errors.time,
                1e3 * deviation.distance,
                color=colour,
                lw=0.9,
                label=shown,
            )
        first, second = (study.axes.names[axis] for axis in axes)
        left.set(
            xlabel=f"{first} ({unit})",
            ylabel=f"{second} ({unit})",
            title=f"{names[run]}: error magnified {magnified:g} times\n",
        )
        # The limits follow the contour: the path of a diverging run is cut off.
        middle = 0.5 * (path.min(axis=0) + path.max(axis=0))
        (x_low, y_low), (x_high, y_high) = middle - 0.7 * extent, middle + 0.7 * extent
        left.set(xlim=(x_low, x_high), ylim=(y_low, y_high), aspect="equal")
        right.set(xlabel="time (s)", ylabel=f"distance from the contour ({small})")
        legend_above(left)
        legend_above(right)
    add_title(picture, f"{title}: contours, hold-out runs")
    return picture


def _magnification(errors: list[np.ndarray], extent: float) -> float:
    """Return the magnification of errors: 1, 2 or 5 times a power of ten, at least 1.

    The largest error is drawn as at most ``_SHARE`` of the contour's ``extent``, unless
    it is larger without magnification. Runs with an error of at least ``extent`` do not
    count.
    """
    largest = [np.abs(e[np.isfinite(e)]).max(initial=0.0) for e in errors]
    near = max((value for value in largest if value < extent), default=extent)
    wanted = _SHARE * extent / max(near, 1e-6 * extent)
    if wanted < 1.0:
        return 1.0
    power = 10.0 ** np.floor(np.log10(wanted))
    return float(max(m for m in (1.0, 2.0, 5.0) if m * power <= wanted) * power)
