"""How much each axis moves the others: errors while one axis is driven alone."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ..study import Study
from .traces import traces_of


class Coupling(NamedTuple):
    """Errors of each axis while one alone is driven, [driven, measured].

    ``errors`` are root mean squares in the unit of the measured axis, NaN where no
    reference drives that axis alone or a run diverged; ``amplitudes`` are those of the
    driven axes, in their unit. ``names`` and ``units`` are the axes'.
    """

    errors: Float[np.ndarray, "driven measured"]
    amplitudes: Float[np.ndarray, " driven"]
    names: tuple[str, ...]
    units: tuple[str, ...]

    @property
    def percent(self) -> Float[np.ndarray, "driven measured"]:
        """The errors in hundredths of the driven amplitude.

        In % between axes of one unit, else in the measured unit per 100 of the driven.
        """
        return 100.0 * self.errors / self.amplitudes[:, None]


def coupling_matrix(study: Study, errors: Mapping[str, float | None]) -> Coupling:
    """Return the coupling of a study's axes from RMS errors by the name of their trace.

    Such as those of ``Result.holdout`` and ``Result.coupling`` together. References
    that drive several axes say nothing of coupling and are left out; of several that
    drive the same axis the mean square is taken. On the diagonal stands the tracking
    error. Raises ValueError for a study of one axis.
    """
    if study.axes is None:
        raise ValueError("the study has one axis; coupling takes several")
    names, units = study.axes.names, study.axes.units
    squares = np.zeros((len(names), len(names)))
    counts = np.zeros_like(squares)
    runs = (*study.references.tune, *study.references.unseen)
    for trace in traces_of(study):
        driven = list(study.driven(runs[trace.run]))
        if len(driven) > 1 or trace.name not in errors:
            continue
        place = names.index(driven[0]), trace.axis
        error = errors[trace.name]
        squares[place] += np.nan if error is None else error**2
        counts[place] += 1.0
    mean = np.where(counts > 0.0, squares / np.maximum(counts, 1.0), np.nan)
    amplitudes = np.array(study.by_axis(study.references.amplitude))
    return Coupling(np.sqrt(mean), amplitudes, names, units)
