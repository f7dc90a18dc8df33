"""Default model: the hysteresis that describes a record best, and its dynamics."""

import numpy as np

from ..core.arrays import as_array
from ..core.progress import Progress, Silent
from ..hysteresis.model import hystereses
from .chain import dynamics_of, dynamics_parts, structure
from .estimators.output_error import from_rest, output_error
from .records.record import Record

HYSTERESES = (
    "shaped_coleman_hodgdon",
    "asymmetric_prandtl_ishlinskii",
    "normalised_bouc_wen",
)
"""Hysteresis models to choose from, that with the fewest parameters first. They
represent three classes of loops: around an anhysteretic curve, with a memory that is
wiped out, and with a memory that decays along the input."""

CREEP = "exponential_creep"
"""Creep of the default model."""

CLEARLY = 0.8
"""Share of the first model's error below which another one is chosen."""

LEAST, SAMPLES = 1000, 4000
"""Fewest samples from which a hysteresis is chosen, and fewest that a trial uses."""

RESOLVED = 8.0
"""Least number of samples in a period of the fastest resonance in a trial."""

STEPS = 24
"""Number of steps of a trial."""


def automatic(record: Record, progress: Progress | None = None) -> str:
    """Return the default chain for ``record``, the training samples.

    The hysteresis is the one with the least error after short fits, which are made at a
    lower sampling rate if that resolves the resonances.
    """
    return f"{hysteresis_for(record, progress)}+{CREEP}+{dynamics_parts(record)}"


def hysteresis_for(record: Record, progress: Progress | None = None) -> str:
    """Return the name of the hysteresis in ``HYSTERESES`` that describes it best."""
    first, *others = HYSTERESES
    if record.samples < LEAST:
        return first
    (progress or Silent()).stage("choosing the hysteresis")
    slow = _slowed(record)
    least, chosen = CLEARLY * _error(first, slow), first
    for name in others:
        error = _error(name, slow)
        if error < least:
            least, chosen = error, name
    return chosen


def _slowed(record: Record) -> Record:
    """Return ``record`` at the rate of a trial."""
    import scipy.signal  # takes long to import

    every = record.samples // SAMPLES
    modes = dynamics_of(record).modes
    if modes:
        fastest = max(mode.frequency for mode in modes)
        every = min(every, int(1.0 / (RESOLVED * fastest * record.dt)))
    if every < 2:
        return record
    input, output = (
        scipy.signal.decimate(signal, every, ftype="fir")
        for signal in (record.input, record.output)
    )
    return Record(input, output, every * record.dt, source=record.source)


def _error(name: str, record: Record) -> float:
    """Return the rms error after a short fit.

    It is infinite if there is no fit, or if the fitted hysteresis has no inverse over
    the range of the input, which designs of controllers need.
    """
    shape = structure(f"{name}+{CREEP}+{dynamics_parts(record)}", record)
    every = slice(0, record.samples)
    try:
        optimum = output_error(shape, [record], every, steps=STEPS)
        system = shape.space.put(shape.system, as_array(optimum.units[0]))
        hystereses(system)[0].inverse(record.input.min(), record.input.max())
    except ValueError:
        return np.inf
    run = np.asarray(from_rest(system, as_array(record.input)))
    return float(np.std(run - record.output))
