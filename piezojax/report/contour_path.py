"""The picture of a contour: the path, its error magnified, and the distance in time."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

from ..core.system import LoopSample
from ..signals import motions
from ..signals.contour_error import nearest_on
from ..study import Study
from .figures import AFTER, BEFORE, REFERENCE, UNITS, figure, headed, legend_above

_MOST = 2  # contours in the picture
_POINTS = 1500  # of each path
_FINER, _SEGMENTS = 16, 64_000  # points of the contour by sample, and in all
_SHARE = 0.2  # of the contour's extent that the largest error is drawn as


class Contour(NamedTuple):
    """Reference number ``run`` of a study, whose contour drives two ``axes``."""

    run: int
    axes: tuple[int, int]


def contours_in(study: Study) -> list[Contour]:
    """Return the references with a contour of two axes of one unit, the first few.

    Between axes of different units there is no distance.
    """
    if study.axes is None:
        return []
    found = []
    for run, name in enumerate((*study.references.tune, *study.references.unseen)):
        axes = motions.contour_axes(name, study.axes.names)
        if axes and len({study.axes.units[axis] for axis in axes}) == 1:
            found.append(Contour(run, axes))
    return found[:_MOST]


def contour_figure(
    study: Study, title: str, runs: dict[int, tuple[LoopSample, LoopSample]]
) -> Figure | None:
    """Paths before and after tuning, from the logs of all axes by run; None if none."""
    contours = contours_in(study)
    if study.axes is None or not contours:
        return None
    names = (*study.references.tune, *study.references.unseen)
    picture = figure(9.0, 4.0 * len(contours) + 0.3)
    panels = picture.subplots(len(contours), 2, squeeze=False)
    for (run, axes), (left, right) in zip(contours, panels, strict=True):
        unit, small = UNITS[study.axes.units[axes[0]]]
        samples = len(runs[run][0].reference[axes[0]])
        path = _contour(study, names[run], axes, samples)
        first = round(study.references.settle * study.rate)
        step = max(1, (samples - first) // _POINTS)
        time = np.arange(samples)[first::step] * study.dt
        off = []
        for log in runs[run]:
            points = _path(log.displacement, axes)[first::step]
            nearest = nearest_on(points, path)
            off.append((nearest, points - nearest))
        extent = np.ptp(path, axis=0).max()
        magnified = _magnification([error for _, error in off], extent)
        left.plot(*path.T, color=REFERENCE, ls="--", lw=0.9, label="reference")
        for (nearest, error), colour, label in zip(
            off, (BEFORE, AFTER), ("before", "tuned"), strict=True
        ):
            left.plot(*(nearest + magnified * error).T, color=colour, label=label)
            distance = 1e3 * np.linalg.norm(error, axis=1)
            rms = np.sqrt(np.mean(distance**2))
            shown = f"{label}, {rms:.4g} {small} rms" if np.isfinite(rms) else label
            right.plot(time, distance, color=colour, lw=0.9, label=shown)
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


def _contour(
    study: Study, name: str, axes: tuple[int, int], samples: int
) -> np.ndarray:
    """Return the path [points, 2] of a reference, with points between the samples.

    The chord between two samples of a curve may be further off it than the stage.
    """
    assert study.axes is not None
    table = study.references
    finer = max(1, min(_FINER, _SEGMENTS // samples))
    time = np.arange((samples - 1) * finer + 1) * study.dt / finer
    amplitudes, offsets = study.by_axis(table.amplitude), study.by_axis(table.offset)
    path = motions.motion(
        name, jnp.asarray(time), study.axes.names, amplitudes, offsets
    )
    return np.asarray(path)[:, list(axes)]


def _path(signals: tuple[np.ndarray, ...], axes: tuple[int, int]) -> np.ndarray:
    return np.stack([np.asarray(signals[axis]) for axis in axes], axis=1)


def _magnification(errors: list[np.ndarray], extent: float) -> float:
    """Return 1, 2 or 5 times a power of ten by which errors are drawn, at least 1.

    The largest is drawn as a share of the contour; a run that is nowhere near does not
    count.
    """
    largest = [np.abs(e[np.isfinite(e)]).max(initial=0.0) for e in errors]
    near = max((value for value in largest if value < extent), default=extent)
    wanted = _SHARE * extent / max(near, 1e-6 * extent)
    if wanted < 1.0:
        return 1.0
    power = 10.0 ** np.floor(np.log10(wanted))
    return float(max(m for m in (1.0, 2.0, 5.0) if m * power <= wanted) * power)
