"""Coupling of axes: errors of all axes while one axis is driven alone."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ..study import Study
from .traces import traces_of


class Coupling(NamedTuple):
    """Errors of each measured axis while one driven axis moves alone.

    ``errors`` [driven, measured] are root mean squares in the unit of the measured
    axis, NaN where no reference drives that axis alone or a run diverged.
    ``amplitudes`` [driven] are those of the references, in the unit of the driven axis.
    ``names`` and ``units`` are those of the axes.
    """

    errors: Float[np.ndarray, "driven measured"]
    amplitudes: Float[np.ndarray, " driven"]
    names: tuple[str, ...]
    units: tuple[str, ...]

    @property
    def percent(self) -> Float[np.ndarray, "driven measured"]:
        """Errors as percentages of the driven amplitude, [driven, measured].

        Between axes of different units an entry is the error in the measured unit for
        an amplitude of 100 in the driven unit.
        """
        return 100.0 * self.errors / self.amplitudes[:, None]


def coupling_matrix(study: Study, errors: Mapping[str, float | None]) -> Coupling:
    """Return the coupling of a study's axes from RMS ``errors`` by trace name.

    ``errors`` may join those of ``Result.holdout`` and ``Result.coupling``. References
    that drive several axes are left out, because they do not show coupling. So are
    trajectories from files, because their amplitudes differ from those of the study.
    The squares of several references that drive the same axis are averaged. The
    diagonal holds the tracking errors. Raises ValueError for a study of one axis.
    """
    if study.axes is None:
        raise ValueError("the study has one axis; coupling needs several")
    names, units = study.axes.names, study.axes.units
    squares = np.zeros((len(names), len(names)))
    counts = np.zeros_like(squares)
    runs = (*study.references.tune, *study.references.unseen)
    for trace in traces_of(study):
        run = runs[trace.run]
        driven = list(study.driven(run))
        if len(driven) > 1 or run in study.references.files or trace.name not in errors:
            continue
        place = names.index(driven[0]), trace.axis
        error = errors[trace.name]
        squares[place] += np.nan if error is None else error**2
        counts[place] += 1.0
    mean = np.where(counts > 0.0, squares / np.maximum(counts, 1.0), np.nan)
    amplitudes = np.array(study.by_axis(study.references.amplitude))
    return Coupling(np.sqrt(mean), amplitudes, names, units)
