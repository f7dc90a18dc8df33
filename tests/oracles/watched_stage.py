"""Runs of a stage with a play and a PI controller in NumPy, many at a time."""

import numpy as np

DT = 1e-3
SAMPLES = 1000
BEFORE = 300
REFERENCE = 3.0 - 3.0 * np.cos(2.0 * np.pi * 2.0 * DT * np.arange(SAMPLES))


def runs(random, gains, noise=1e-3, walk=1e-2):
    """Return readings and voltages [runs, samples] of stages with the ``gains``.

    The plant is 0.09 um/V and a play of 4 V with 0.02 um/V, behind a lag of 5 ms. A run
    begins at the first reference, BEFORE samples before it counts. ``noise`` (um rms)
    and ``walk`` (um rms after 1 s) belong to the sensor.
    """
    gains = np.asarray(gains, dtype=float)
    inner, summed, play, drift = np.zeros((4, len(gains)))
    readings, voltages = np.empty((2, len(gains), SAMPLES))
    decay = np.exp(-DT / 5e-3)
    for k in range(-BEFORE, SAMPLES):
        drift += walk * np.sqrt(DT) * random.standard_normal(len(gains))
        reading = 0.1 * gains * inner + drift
        reading = reading + noise * random.standard_normal(len(gains))
        error = REFERENCE[max(k, 0)] - reading
        summed += 500.0 * DT * error
        voltage = 0.5 * error + summed
        play = np.clip(play, voltage - 4.0, voltage + 4.0)
        inner = decay * inner + (1.0 - decay) * (0.9 * voltage + 0.2 * play)
        if k >= 0:
            readings[:, k], voltages[:, k] = reading, voltage
    return readings, voltages
