"""Contour errors of a tuning run: distances from the path before and after tuning."""

from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ..core.feedback import LoopSample
from ..signals import motions
from ..signals.contour_error import nearest_on
from ..study import Study
from .outcome import Logs

_MOST = 2  # most contours of a study
_POINTS = 1500  # approximate number of instants at which a run is evaluated
_FINER, _SEGMENTS = 16, 64_000  # most points of a path per sample, and in total


class Contour(NamedTuple):
    """Contour of a study: the number ``run`` of its reference, and its two ``axes``."""

    run: int
    axes: tuple[int, int]


class ContourError(NamedTuple):
    """Deviation of a run from its contour, at the instants of a ``ContourErrors``.

    ``nearest`` [points, 2] are the points of the contour nearest to the displacement,
    and ``error`` [points, 2] is the displacement minus ``nearest``, both in the unit of
    the axes.
    """

    nearest: Float[np.ndarray, "points 2"]
    error: Float[np.ndarray, "points 2"]

    @property
    def distance(self) -> Float[np.ndarray, " points"]:
        """Distance from the contour, in the unit of the axes."""
        return np.linalg.norm(self.error, axis=1)

    @property
    def rms(self) -> float:
        """Root mean square of the distance, NaN for a run that diverged."""
        return float(np.sqrt(np.mean(self.distance**2)))


class ContourErrors(NamedTuple):
    """Contour errors of one reference before and after tuning.

    ``path`` [points, 2] is the contour, ``time`` [points] the instants (s).
    """

    contour: Contour
    path: Float[np.ndarray, "points 2"]
    time: Float[np.ndarray, " points"]
    before: ContourError
    after: ContourError


def contours_in(study: Study) -> list[Contour]:
    """Return the contours of ``study`` in two axes of one unit, the first two at most.

    In axes of different units a distance is not defined.
    """
    if study.axes is None:
        return []
    found = []
    for run, name in enumerate((*study.references.tune, *study.references.unseen)):
        axes = _axes_of(study, name)
        if axes and len({study.axes.units[axis] for axis in axes}) == 1:
            found.append(Contour(run, axes))
    return found[:_MOST]


def _axes_of(study: Study, name: str) -> tuple[int, int] | None:
    """Return the two axes of the contour of a reference, None if it has no contour.

    A trajectory from a file has a contour if it drives two axes.
    """
    assert study.axes is not None
    if name not in study.references.files:
        return motions.contour_axes(name, study.axes.names)
    driven = [study.axes.names.index(axis) for axis in study.driven(name)]
    return (driven[0], driven[1]) if len(driven) == 2 else None


def contour_errors(study: Study, runs: dict[int, Logs]) -> list[ContourErrors]:
    """Return the errors of each contour of ``contours_in``.

    ``runs`` holds the samples before and after tuning by the number of the reference.
    """
    found = []
    for contour in contours_in(study):
        logs = runs[contour.run]
        samples = len(logs[0].reference[contour.axes[0]])
        path = _path(study, contour, logs[0])
        first = study.settled
        shown = slice(first, None, max(1, (samples - first) // _POINTS))
        time = np.arange(samples)[shown] * study.dt
        before, after = (_error(log, contour.axes, path, shown) for log in logs)
        found.append(ContourErrors(contour, path, time, before, after))
    return found


def _error(
    log: LoopSample, axes: Sequence[int], path: np.ndarray, shown: slice
) -> ContourError:
    moved = [np.asarray(log.displacement[axis])[shown] for axis in axes]
    points = np.stack(moved, axis=1)
    nearest = nearest_on(points, path)
    return ContourError(nearest, points - nearest)


def _path(study: Study, contour: Contour, log: LoopSample) -> np.ndarray:
    """Return the path [points, 2] of a contour, with points between the samples.

    The chord between two samples may lie further from the curve than the stage does. A
    trajectory of a file is linear between its samples.
    """
    assert study.axes is not None
    table = study.references
    name = (*table.tune, *table.unseen)[contour.run]
    samples = len(log.reference[contour.axes[0]])
    if name in table.files:
        return np.stack([log.reference[axis] for axis in contour.axes], axis=1)
    finer = max(1, min(_FINER, _SEGMENTS // samples))
    time = np.arange((samples - 1) * finer + 1) * study.dt / finer
    amplitudes, offsets = study.by_axis(table.amplitude), study.by_axis(table.offset)
    path = motions.motion(
        name, jnp.asarray(time), study.axes.names, amplitudes, offsets
    )
    return np.asarray(path)[:, list(contour.axes)]
