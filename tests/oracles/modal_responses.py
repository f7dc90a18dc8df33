"""Frequency responses of stages with modes and a delay, with noise.

Each is the sum of second-order transfer functions of s, times exp(-s delay).
"""

from typing import NamedTuple

import numpy as np


class Stage(NamedTuple):
    """Modes (Hz, 1, um/V at rest), delay (s), and relative and absolute noise."""

    frequency: np.ndarray
    damping: np.ndarray
    gain: np.ndarray
    delay: float
    noise: tuple[float, float]


NOISES = (0.01, 1e-4), (0.003, 1e-3), (0.02, 3e-4)
LEAST_RATIO = 1.15
"""Least ratio of two neighbouring resonance frequencies."""


def stage(seed):
    """Draw a stage: 1 to 4 modes of 150 to 4000 Hz with 0.5 to 10 % damping."""
    random = np.random.default_rng(seed)
    modes = 1 + seed % 4
    frequency = np.zeros(0)
    while frequency.size == 0 or np.any(frequency[1:] < LEAST_RATIO * frequency[:-1]):
        frequency = np.sort(np.exp(random.uniform(*np.log([150.0, 4000.0]), modes)))
    damping = np.exp(random.uniform(*np.log([0.005, 0.1]), modes))
    signs = np.r_[1.0, random.choice([-1.0, 1.0], modes - 1)]
    gain = 0.1 * random.uniform(0.3, 1.0, modes) * signs * 0.3 ** np.arange(modes)
    return Stage(frequency, damping, gain, random.uniform(2e-5, 3e-4), NOISES[seed % 3])


def response(one, frequency):
    """Return the exact response [lines] at ``frequency`` in Hz."""
    s = 2j * np.pi * frequency
    total = np.zeros(frequency.size, complex)
    for f, zeta, gain in zip(one.frequency, one.damping, one.gain, strict=True):
        w = 2.0 * np.pi * f
        total += gain * w**2 / (s**2 + 2.0 * zeta * w * s + w**2)
    return total * np.exp(-s * one.delay)


def measured(one, frequency, seed):
    """Return a noisy response [lines]: circular complex noise."""
    exact = response(one, frequency)
    deviation = np.hypot(one.noise[0] * np.abs(exact), one.noise[1])
    random = np.random.default_rng([18, seed])
    noise = random.standard_normal((2, frequency.size)) / np.sqrt(2.0)
    return exact + deviation * (noise[0] + 1j * noise[1])
