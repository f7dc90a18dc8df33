"""Small motion that shows the dynamics of a stage: sines at many frequencies."""

import numpy as np
from jaxtyping import Float

SHARE = 0.05
"""Range of the motion, as a share of the range of the reference."""

SINES = 60
"""Largest number of sines; their logarithmic spacing is rounded to whole periods."""

HIGHEST = 0.2
"""Highest frequency, as a share of the sampling rate."""

REST = 0.05
"""Share of the motion at the beginning that rises smoothly from rest."""

SEED = 22


def probe(reference: Float[np.ndarray, " samples"]) -> Float[np.ndarray, " samples"]:
    """Return a small motion (um) from the first sample of ``reference``.

    It has the length of ``reference``, stays within its range, and has no jumps, which
    a feedforward would turn into jumps of the voltage. The amplitude falls with the
    root of the frequency. The same reference gives the same motion, so that two runs
    can be compared.
    """
    samples = len(reference)
    begin, low, high = (f(reference) for f in (lambda x: x[0], np.min, np.max))
    lines = np.unique(np.geomspace(2.0, max(HIGHEST * samples, 3.0), SINES).round())
    phases = np.random.default_rng(SEED).uniform(0.0, 2.0 * np.pi, len(lines))
    time = np.arange(samples) / samples
    sines = np.cos(2.0 * np.pi * lines[:, None] * time + phases[:, None])
    motion = lines**-0.5 @ sines
    motion = SHARE * (high - low) * (motion - motion.min()) / np.ptp(motion)
    inward = motion if high - begin >= begin - low else -motion
    rise = np.clip(time / REST, 0.0, 1.0)
    return begin + inward * (0.5 - 0.5 * np.cos(np.pi * rise))
