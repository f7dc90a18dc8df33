"""What software and wiring do to a record before it is saved, for one_sitting.py.

Each of TREATMENTS takes the voltages and the readings of a stage, and returns them as
a file would have them. Most of them hide delay, lag or resonances, which limit gains.
"""

from functools import partial

import numpy as np
from scipy import signal


def mean(voltages, readings, samples=5):
    """Average the readings over ``samples`` around each, as offline smoothing does."""
    padded = np.pad(readings, samples // 2, "edge")
    return voltages, np.convolve(padded, np.full(samples, 1.0 / samples), "valid")


def late_mean(voltages, readings, samples=5):
    """Average each reading and those before it, as an analyser does."""
    padded = np.pad(readings, (samples - 1, 0), "edge")
    return voltages, np.convolve(padded, np.full(samples, 1.0 / samples), "valid")


def zero_phase(voltages, readings, cutoff=0.1):
    """Filter the readings forwards and backwards, ``cutoff`` relative to Nyquist."""
    return voltages, signal.filtfilt(*signal.butter(2, cutoff), readings)


def monitor(voltages, readings, samples=3):
    """Record the voltage behind a lag of ``samples``, as the amplifier's monitor."""
    keep = np.exp(-1.0 / samples)
    lagged = signal.lfilter([1.0 - keep], [1.0, -keep], voltages - voltages[0])
    return voltages[0] + lagged, readings


def early(voltages, readings, samples=2):
    """Save the readings ``samples`` early, as a wrong offset of the trigger does."""
    return voltages, np.append(readings[samples:], np.full(samples, readings[-1]))


def coarse(voltages, readings, bits=8):
    """Round the readings to the range of a converter of few bits."""
    step = np.ptp(readings) / 2**bits
    return voltages, step * np.round(readings / step)


TREATMENTS = {
    "mean": mean,
    "mean-15": partial(mean, samples=15),
    "late-mean": late_mean,
    "zero-phase": zero_phase,
    "monitor": monitor,
    "monitor-10": partial(monitor, samples=10),
    "early": early,
    "coarse": coarse,
}


def treated(record_of, name):
    """Return ``record_of`` with its records treated as ``name`` says."""
    return lambda stage: TREATMENTS[name](*record_of(stage))
