"""Reference signals (um) of thesis Table 5-1, sampled at t = k / rate."""

import math

import numpy as np

PATTERN = (1.0, 1.0, 0.5, 0.15)


def _count(duration, rate):
    """Return the number of samples N at t = k / rate, k = 0 .. N-1."""
    return round(duration * rate)


def sine(frequency, amplitude=5.0, duration=1.0, rate=20000.0):
    """Return SIN: A (1 - cos(2 pi f t)), 0 .. 2 A um, from rest."""
    values = []
    for k in range(_count(duration, rate)):
        turns = frequency * k / rate
        values.append(amplitude * (1.0 - math.cos(2.0 * math.pi * turns)))
    return np.array(values)


def piecewise_sine(frequency, amplitude=5.0, duration=1.0, rate=20000.0):
    """Return PWSW: `sine` with the amplitude times 1, 1, 0.5, 0.15 by period.

    The pattern repeats every four periods. Sample k belongs to period
    floor(f k / rate); at a boundary the value is zero for either factor.
    """
    values = []
    for k in range(_count(duration, rate)):
        turns = frequency * k / rate
        factor = PATTERN[math.floor(turns) % len(PATTERN)]
        values.append(factor * amplitude * (1.0 - math.cos(2.0 * math.pi * turns)))
    return np.array(values)


def superposed_sine(f_max, amplitude=5.0, duration=1.0, rate=20000.0):
    """Return SW: equation (4.48), with its offset, times amplitude / 5."""
    values = []
    for k in range(_count(duration, rate)):
        t = k / rate - 0.1
        w = 30.0 / 7.0 * math.sin(2.0 * math.pi * f_max / 20.0 * t + math.pi)
        w += 25.0 / 7.0 * math.sin(2.0 * math.pi * f_max / 5.0 * t + 0.5 * math.pi)
        w += 5.0 / 7.0 * math.sin(2.0 * math.pi * f_max / 2.0 * t + 0.2 * math.pi)
        w += 5.0 / 7.0 * math.sin(2.0 * math.pi * f_max * t)
        w += 5.0
        values.append(amplitude / 5.0 * w)
    return np.array(values)


def ten_references(n_extra=1, duration=1.0, rate=20000.0):
    """Return the ten inputs of Table 5-1 by name, each with N + n_extra samples.

    N = duration * rate. The extra samples continue the signal, so that
    r(k + 1) exists at the last step.
    """
    total = (_count(duration, rate) + n_extra) / rate
    signals = {}
    for frequency in (1, 10, 30, 50):
        signals[f"SIN{frequency}"] = sine(frequency, duration=total, rate=rate)
    for frequency in (10, 30, 50):
        signals[f"SW{frequency}"] = superposed_sine(
            frequency, duration=total, rate=rate
        )
    for frequency in (10, 30, 50):
        signals[f"PWSW{frequency}"] = piecewise_sine(
            frequency, duration=total, rate=rate
        )
    return signals
