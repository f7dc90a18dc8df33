"""References of a study as signals."""

import jax
import numpy as np
from jaxtyping import Array, Float

from ..core.arrays import as_array
from ..signals import motions, waveforms
from .schema import Study


def reference_signals(study: Study) -> Float[Array, "references samples *axes"]:
    """Return the references of ``study``, the tuning ones before the unseen ones.

    They are in um, or in the units of the axes.
    """
    table = study.references
    time_s = waveforms.time_grid(table.duration, study.rate)
    names = (*table.tune, *table.unseen)
    return as_array(np.stack([_signal(study, name, time_s) for name in names]))


def _signal(study: Study, name: str, time_s: Array) -> Array:
    table = study.references
    amplitudes, offsets = study.by_axis(table.amplitude), study.by_axis(table.offset)
    if study.axes is None:
        return waveforms.signal(name, time_s, amplitudes[0], offsets[0])
    return motions.motion(name, time_s, study.axes.names, amplitudes, offsets)


def highest_reference(study: Study) -> float | tuple[float, ...]:
    """Return the highest value of all references, um; a tuple on a stage with axes.

    It is the operating point of the margins of a study.
    """
    # JAX may be tracing the caller; the references are constants all the same.
    with jax.ensure_compile_time_eval():
        peaks = np.max(np.asarray(reference_signals(study)), axis=(0, 1))
    return tuple(peaks.tolist()) if study.axes else float(peaks)
