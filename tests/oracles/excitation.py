"""Records of a stage: careful ones, and ones that are too poor."""

import numpy as np

CHIRP, MULTISINE, RAMP = 0.4, 0.35, 0.02
"""Durations, s; a ramp connects two levels."""

SMALL = 0.02
"""Amplitude of chirp and multisine in spans, if the amplifier is fast enough."""

CYCLES = ((6.0, 0.96, 2), (15.0, 0.5, 3), (40.0, 0.15, 4))
"""Frequency (Hz), height (spans) and number of the large cycles of each half."""


def _time(duration, dt):
    return dt * np.arange(round(duration / dt))


def _ramp(start, stop, dt, duration=RAMP):
    share = _time(duration, dt) / duration
    return start + (stop - start) * 0.5 * (1.0 - np.cos(np.pi * share))


def _fade(count):
    """Return a window with edges of a twentieth of the samples at each end."""
    edge = np.minimum(np.arange(count), np.arange(count)[::-1]) / (0.05 * count)
    return 0.5 * (1.0 - np.cos(np.pi * np.minimum(edge, 1.0)))


def large_cycles(p, random):
    """Return cycles of three heights and frequencies, the first over the whole span."""
    dt, place, parts = 1.0 / p.rate, 0.0, []
    for frequency, height, count in CYCLES:
        frequency *= random.uniform(0.85, 1.2)
        height *= random.uniform(0.8, 1.0) if height < 0.9 else 1.0
        base = p.lower + p.span * (0.02 + random.uniform(0.0, 0.96 - height))
        time = _time(count / frequency, dt)
        cycle = 0.5 * p.span * height * (1.0 - np.cos(2.0 * np.pi * frequency * time))
        parts += [_ramp(place, base, dt), base + cycle]
        place = base
    return np.concatenate(parts)


def _small(p):
    return min(SMALL * p.span, 0.5 * p.slew / (2.0 * np.pi * 0.4 * p.rate))


def chirp(p, random):
    """Return a logarithmic chirp from 5 Hz to 0.4 of the rate."""
    time, ratio = _time(CHIRP, 1.0 / p.rate), 0.4 * p.rate / 5.0
    turns = 5.0 * CHIRP / np.log(ratio) * (ratio ** (time / CHIRP) - 1.0)
    phase = random.uniform(0.0, 2.0 * np.pi)
    return _small(p) * np.sin(2.0 * np.pi * turns + phase) * _fade(time.size)


def multisine(p, random):
    """Return 60 sines of random phase up to 0.4 of the rate."""
    time = _time(MULTISINE, 1.0 / p.rate)
    found = np.zeros(time.size)
    for frequency in np.geomspace(20.0, 0.4 * p.rate, 60):
        phase = random.uniform(0.0, 2.0 * np.pi)
        found += np.sin(2.0 * np.pi * frequency * time + phase)
    return _small(p) * found / np.abs(found).max() * _fade(time.size)


def _half(p, random, fast=True):
    """Return one half of a record, from 0 V to 0 V."""
    middle = p.lower + p.span * random.uniform(0.35, 0.65)
    cycles = large_cycles(p, random)
    parts = [cycles, _ramp(cycles[-1], middle, 1.0 / p.rate)]
    if fast:
        parts += [middle + chirp(p, random), middle + multisine(p, random)]
    parts.append(_ramp(middle, 0.0, 1.0 / p.rate))
    return np.concatenate(parts)


def _rest(p):
    return np.zeros(round(0.05 * p.rate))


def careful(p, random):
    """Return voltages: at rest, then twice large cycles, a chirp and a multisine."""
    return np.concatenate([_rest(p), _half(p, random), _half(p, random)])


def slow(p, random):
    """Return large cycles alone: nothing above 50 Hz."""
    return np.concatenate([_rest(p), *(_half(p, random, False) for _ in range(4))])


def timid(p, random):
    """Return the careful record at a fiftieth of its amplitude, about the middle."""
    middle = p.lower + 0.5 * p.span
    return middle + 0.02 * (careful(p, random) - middle)


def short(p, random):
    """Return the first 0.15 s of the careful record: less than a cycle."""
    return careful(p, random)[: round(0.15 * p.rate)]


def tone(p, random):
    """Return one sine of 10 Hz over half of the span."""
    time = _time(1.5, 1.0 / p.rate)
    return p.lower + 0.25 * p.span * (1.2 - np.cos(2.0 * np.pi * 10.0 * time))


KINDS = {
    "careful": careful,
    "slow": slow,
    "timid": timid,
    "short": short,
    "tone": tone,
}


def record(stage, kind="careful", seed=0):
    """Return the voltages and the readings of ``stage`` [samples] under ``kind``.

    Reading k is taken when voltage k starts to act. The stage rests at the first
    voltage before; ``seed`` is that of its noise and of the excitation.
    """
    voltages = KINDS[kind](stage.parameters, np.random.default_rng([40, seed]))
    first = stage.reset(voltages[0], seed)
    return voltages, np.concatenate([[first], stage.respond(voltages[:-1])[0]])


def small_response(stage, share=0.02, periods=12, lines=100, length=1 << 14):
    """Return frequencies (Hz) and the response (um/V) of ``stage`` to small motions.

    A multisine of random phase moves around the middle voltage, where the stage has
    rested for some time, with ``share`` of the span as its amplitude. Two periods are
    left out.
    """
    p, random = stage.parameters, np.random.default_rng(1)
    places = np.geomspace(4.0, 0.45 * length, lines).round().astype(int)
    places = np.unique(places)
    spectrum = np.zeros(length // 2 + 1, complex)
    spectrum[places] = np.exp(2j * np.pi * random.random(places.size))
    signal = np.fft.irfft(spectrum, length)
    signal *= share * p.span / np.abs(signal).max()
    middle = 0.5 * (p.lower + p.upper)
    rest = np.concatenate([np.linspace(0.0, middle, 4000), np.full(8000, middle)])
    stage.reset(0.0)
    voltages = np.concatenate([rest, middle + np.tile(signal, periods)])
    # A reading shows the voltage of the sample before.
    readings = np.roll(stage.respond(voltages)[0], 1)[rest.size :]
    mean = readings.reshape(periods, length)[2:].mean(axis=0)
    values = np.fft.rfft(mean)[places] / np.fft.rfft(signal)[places]
    return places * p.rate / length, values
