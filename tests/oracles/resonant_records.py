"""Records of a stage with a resonance behind a slow sensor, in NumPy and SciPy only.

Hysteresis (24 plays or Coleman-Hodgdon), creep of 1 % a decade, a resonance and a
first-order sensor in one exact discretisation (matrix exponential, held input), white
noise and 16 bit.
"""

from typing import NamedTuple

import numpy as np
import scipy.linalg
import scipy.signal

RATE = 10_000.0
SLOPE = 0.12
"""Slope of the hysteresis, um/V."""

FREQUENCIES = (300.0, 450.0, 780.0, 1300.0, 1900.0, 2500.0, 3200.0, 4000.0)
DAMPINGS = (0.005, 0.01, 0.02, 0.05, 0.1)
LAGS = (0.0, 1e-4, 3e-4, 1e-3, 3e-3)
NOISES = (0.002, 0.005, 0.02)


class Case(NamedTuple):
    """A stage and its excitation: Hz, damping ratio, s, um rms, s.

    ``frequency`` is None for a stage without a resonance.
    """

    excitation: str = "mixed"
    frequency: float | None = 780.0
    damping: float = 0.02
    lag: float = 1e-3
    noise: float = 0.002
    hysteresis: str = "plays"
    seed: int = 0
    seconds: float = 2.0


NAMED = Case()
"""The stage on which the voltage of a tuned loop once jumped from limit to limit."""


def grid(count=60):
    """Return ``count`` cases: excitations and lags in turn, other values random."""
    draw = np.random.default_rng(18)
    excitations, hystereses = tuple(EXCITATIONS), tuple(HYSTERESES)
    return [
        Case(
            excitation=excitations[i % 5],
            frequency=FREQUENCIES[draw.integers(len(FREQUENCIES))],
            damping=DAMPINGS[draw.integers(len(DAMPINGS))],
            lag=LAGS[(i // 5) % 5],
            noise=NOISES[draw.integers(len(NOISES))],
            hysteresis=hystereses[draw.integers(2)],
            seed=i,
        )
        for i in range(count)
    ]


def measured(case):
    """Return the input (V) and the measured output (um) [samples] of ``case``."""
    samples = int(case.seconds * RATE)
    input = EXCITATIONS[case.excitation](samples, np.random.default_rng(case.seed))
    slow = HYSTERESES[case.hysteresis](input)
    slow = slow + crept(slow)
    output = np.concatenate([[slow[0]], dynamic(slow, case)[:-1]])
    draw = np.random.default_rng(1000 + case.seed)
    output = output + case.noise * draw.standard_normal(samples)
    step = 1.2 * np.ptp(output) / 2**16
    return input, step * np.round(output / step)


# Excitations, in V


def sweep(samples, draw):
    """Return two linear chirps to 0.45 of the rate, the second one smaller."""
    del draw
    half = samples // 2
    time = np.arange(half) / RATE
    phase = 2 * np.pi * (2.0 * time + 0.5 * 0.45 * RATE * time**2 / time[-1])
    tone = np.sin(phase)
    return 50.0 + np.concatenate([30.0 * tone, 20.0 * tone])


def multisine(samples, draw):
    """Return random phases at all lines of half a second to 0.45 of the rate."""
    period = int(RATE / 2)
    lines = np.arange(1, int(0.45 * period))
    spectrum = np.zeros(period // 2 + 1, complex)
    spectrum[lines] = np.exp(2j * np.pi * draw.uniform(size=lines.size))
    tones = np.fft.irfft(spectrum, period)
    return 50.0 + 12.0 * np.resize(tones / tones.std(), samples)


def binary(samples, draw):
    """Return a pseudo-random binary sequence with a clock of three samples."""
    bits = draw.integers(2, size=samples // 3 + 1)
    return 35.0 + 30.0 * np.repeat(bits, 3)[:samples]


def steps(samples, draw):
    """Return random levels, each held for 10 to 60 ms."""
    lengths = draw.integers(100, 600, size=samples // 100)
    levels = draw.uniform(10.0, 90.0, size=lengths.size)
    return np.repeat(levels, lengths)[:samples]


def mixed(samples, draw):
    """Return large slow loops with superposed small steps and a small multisine."""
    time = np.arange(samples) / RATE
    swing = 1.0 - 0.5 * np.floor(4.0 * time / time[-1]) / 4.0
    slow = 45.0 - 30.0 * swing * np.cos(2 * np.pi * 8.0 * time)
    small = 0.15 * (multisine(samples, draw) - 50.0)
    return slow + small + 0.1 * steps(samples, draw)


EXCITATIONS = {
    "chirp": sweep,
    "multisine": multisine,
    "PRBS": binary,
    "steps": steps,
    "mixed": mixed,
}


# The stage


def plays(input):
    """Return the output of 24 plays and a straight line, from rest at 0 V."""
    thresholds = 2.0 * np.arange(24)
    weights = 0.02 * np.exp(-thresholds / 12.0)
    weights[0] = SLOPE - weights[1:].sum()
    memory, output = np.zeros(24), np.empty(input.size)
    for k, value in enumerate(input):
        memory = np.clip(memory, value - thresholds, value + thresholds)
        output[k] = weights @ memory
    return output


def coleman_hodgdon(input):
    """Return y of y' = alpha |x'| (f x - y) + g x', one step per sample, from rest."""
    alpha, f, g = 0.04, SLOPE * 1.1, SLOPE * 0.85
    last = y = 0.0
    output = np.empty(input.size)
    for k, value in enumerate(input.tolist()):
        change, middle = value - last, 0.5 * (value + last)
        fade = np.exp(-alpha * abs(change))
        bias = f * middle
        push = g * change / max(alpha * abs(change), 1e-12)
        y = bias + (y - bias) * fade + push * (1.0 - fade)
        last = value
        output[k] = y
    return output


HYSTERESES = {"plays": plays, "Coleman-Hodgdon": coleman_hodgdon}


def crept(signal, share=0.01):
    """Return creep by ``share`` of a step in each decade of time from 1 ms to 100 s."""
    total = np.zeros_like(signal)
    for time_constant in 10.0 ** np.arange(-2.0, 2.5, 0.5):
        pole = np.exp(-1.0 / (RATE * time_constant))
        start = [pole * signal[0]]
        total += scipy.signal.lfilter([1.0 - pole], [1.0, -pole], signal, zi=start)[0]
    return 0.5 * share * total


def dynamic(signal, case):
    """Return the output of resonance and sensor, exact for a held input."""
    w = 2.0 * np.pi * (case.frequency or 0.0)
    blocks, size = [], 0
    matrix, source = np.zeros((4, 4)), None
    if case.frequency:
        matrix[:2, :2] = [[0.0, 1.0], [-(w**2), -2.0 * case.damping * w]]
        blocks.append((1, w**2))
        size, source = 2, 0
    if case.lag:
        matrix[size, size] = -1.0 / case.lag
        if source is None:
            blocks.append((size, 1.0 / case.lag))
        else:
            matrix[size, source] = 1.0 / case.lag
        source, size = size, size + 1
    if source is None:
        return signal
    system = np.zeros((size + 1, size + 1))
    system[:size, :size] = matrix[:size, :size]
    for row, gain in blocks:
        system[row, size] = gain
    held = scipy.linalg.expm(system / RATE)
    A, B = held[:size, :size], held[:size, size]
    state = np.linalg.solve(np.eye(size) - A, B * signal[0])
    output = np.empty_like(signal)
    for k, value in enumerate(signal):
        state = A @ state + B * value
        output[k] = state[source]
    return output
