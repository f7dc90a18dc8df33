"""References of a study as signals."""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Array, Float

from ..signals import motions, waveforms
from .schema import Study
from .trajectories import Trajectory


def reference_signals(
    study: Study, trajectories: Mapping[str, Trajectory]
) -> Float[np.ndarray, "references samples *axes"]:
    """Return the references of ``study``, the tuning ones before the unseen ones.

    They are in um, or in the units of the axes. ``trajectories`` holds those from
    files, by name.
    """
    table = study.references
    time_s = waveforms.time_grid(table.duration, study.rate)

    def signal(name: str) -> np.ndarray:
        if name not in trajectories:
            return np.asarray(_signal(study, name, time_s))
        values = trajectories[name].values
        return values if study.axes else values[:, 0]

    return np.stack([signal(name) for name in (*table.tune, *table.unseen)])


def _signal(study: Study, name: str, time_s: Array) -> Array:
    table = study.references
    amplitudes, offsets = study.by_axis(table.amplitude), study.by_axis(table.offset)
    if study.axes is None:
        return waveforms.signal(name, time_s, amplitudes[0], offsets[0])
    return motions.motion(name, time_s, study.axes.names, amplitudes, offsets)
