"""Voltages that excite the hysteresis, the creep and the dynamics of a stage.

All parts begin and end at the middle of the range. A record contains all parts twice,
with different random numbers: a model is fitted to the first half and validated on the
second.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, fields, replace
from math import ceil
from typing import NamedTuple

import numpy as np

SMALL = 0.02
"""Amplitude of the multisine, as a share of the range, if the slew rate allows it."""

LINES = 600
"""Largest number of frequencies in a multisine: about 1 % apart, so that no resonance
is missed."""

PHASES = 50
"""Number of random sets of phases; the one with the lowest crest factor is used."""

EDGE = 0.02
"""Shortest duration of a move between levels, s; a low slew rate lengthens it."""

REST = 0.1
"""Duration of the rest before the parts of a record, s."""

COARSEST = 50
"""Smallest number of samples in a cycle over the whole range."""

STRETCHES = 2, 9
"""Number of stretches in a mixture, the upper end excluded."""

LADDER = ((1.0, 1.0, 2, 1.0), (2.5, 0.6, 6, 0.15), (7.0, 0.2, 4, 1.0))
"""Groups of cycles: over the whole range, nested loops that shrink, and small loops.
Of each: frequency (times ``slowest``), height (share of the range), number of cycles,
and height of the last cycle (share of the first)."""


@dataclass(frozen=True)
class Generator:
    """Limits of a signal generator and its amplifier, and settings of the excitation.

    ``lower`` and ``upper`` are the limits of the voltage, V, ``rate`` is the sampling
    rate, Hz, and ``slew`` the largest slew rate, V/s. The cycles over the whole range
    have the frequency ``slowest`` (Hz), or a lower one if ``slew`` requires it. The
    multisine reaches ``highest`` (Hz), and each level is held for ``hold`` (s). Raises
    ValueError for limits in the wrong order, other numbers that are not above 0, and
    frequencies that the rate does not allow.
    """

    lower: float
    upper: float
    rate: float
    slew: float = np.inf
    slowest: float = 5.0
    highest: float | None = None
    hold: float = 0.25

    def __post_init__(self):
        if not self.lower < self.upper:
            raise ValueError(
                f"lower is {self.lower:g} V and upper {self.upper:g} V; lower must be "
                "below upper"
            )
        for field in fields(self)[2:]:
            value = getattr(self, field.name)
            if value is not None and not value > 0.0:
                raise ValueError(f"{field.name} is {value:g}; it must be above 0")
        if self.top > 0.5 * self.rate:
            raise ValueError(
                f"highest is {self.top:g} Hz; it must be at most half the rate, "
                f"{0.5 * self.rate:g} Hz"
            )
        if self.slowest > 0.05 * self.top:
            raise ValueError(
                f"slowest is {self.slowest:g} Hz; it must be at most a twentieth of "
                f"highest, {self.top:g} Hz"
            )

    @property
    def top(self) -> float:
        """Highest frequency of the multisine, Hz: ``highest``, or 0.4 of the rate."""
        return 0.4 * self.rate if self.highest is None else self.highest

    @property
    def span(self) -> float:
        """Range of the voltage, V."""
        return self.upper - self.lower

    @property
    def middle(self) -> float:
        """Middle of the range, V."""
        return 0.5 * (self.lower + self.upper)

    def time(self, duration: float) -> np.ndarray:
        """Return the instants of a part of ``duration``, s."""
        return np.arange(max(round(duration * self.rate), 1)) / self.rate

    def move(self, start: float, stop: float) -> np.ndarray:
        """Return a smooth move between two levels within the slew rate, V."""
        height = stop - start
        duration = max(EDGE, 0.5 * np.pi * abs(height) / self.slew)
        share = self.time(duration) / duration
        return start + 0.5 * height * (1.0 - np.cos(np.pi * share))

    def followed(self, wanted: np.ndarray) -> np.ndarray:
        """Return the voltages that follow ``wanted`` [samples] within the slew rate, V.

        They begin at the middle of the range.
        """
        voltages, most = [self.middle], self.slew / self.rate
        for voltage in wanted[1:]:
            move = min(max(voltage - voltages[-1], -most), most)
            voltages.append(voltages[-1] + move)
        return np.array(voltages)


class Part(NamedTuple):
    """A part of a record: ``voltages`` [samples] in V at ``rate`` (Hz).

    ``tells`` names the effects that a model can learn from it.
    """

    name: str
    voltages: np.ndarray
    rate: float
    tells: str

    @property
    def steepest(self) -> float:
        """Largest slew rate of the part, V/s, also if it is repeated."""
        return _steepest(self.voltages, self.rate)


def _steepest(signal: np.ndarray, rate: float) -> float:
    """Return the largest slope of a periodic ``signal``, per s."""
    return float(rate * np.abs(np.diff(signal, append=signal[0])).max())


def ladder(generator: Generator, random: np.random.Generator) -> Part:
    """Return cycles over the whole range, nested loops that shrink, and small loops."""
    level, parts = generator.middle, []
    for times, share, count, last in LADDER:
        height = share * generator.span
        base = generator.lower + random.uniform(0.2, 0.8) * (generator.span - height)
        # The first cycle is the largest and has the greatest slope.
        fastest = generator.slew / (np.pi * height)
        frequency = min(times * generator.slowest, fastest)
        turns = frequency * generator.time(count / frequency)
        shrink = last ** (np.floor(turns) / max(count - 1, 1))
        cycle = 0.5 * height * shrink * (1.0 - np.cos(2.0 * np.pi * turns))
        # Shrinking loops lie inside each other, with a common lower end.
        parts += [generator.move(level, base), base + cycle]
        level = base
    parts.append(generator.move(level, generator.middle))
    tells = "hysteresis: loops over the whole range, nested and small loops"
    return Part("ladder", np.concatenate(parts), generator.rate, tells)


def holds(generator: Generator, random: np.random.Generator) -> Part:
    """Return holds of a high level, a low level and the middle, and moves between."""
    high, low = (
        generator.lower + generator.span * random.uniform(*ends)
        for ends in ((0.75, 0.95), (0.05, 0.25))
    )
    rest = np.ones(generator.time(generator.hold).size)
    level, parts = generator.middle, []
    for following in (high, low, generator.middle):
        parts += [generator.move(level, following), following * rest]
        level = following
    tells = f"creep, up to {generator.hold:g} s"
    return Part("holds", np.concatenate(parts), generator.rate, tells)


def multisine(generator: Generator, random: np.random.Generator) -> Part:
    """Return a multisine of low crest factor around the middle of the range.

    Its frequencies lie between twice ``slowest`` and ``highest``, logarithmically
    spaced, at multiples of ``slowest`` / 2. It is one period long, and begins where it
    is nearest to the middle.
    """
    count = generator.time(2.0 / generator.slowest).size
    line = generator.rate / count
    wanted = np.geomspace(2.0 * generator.slowest, generator.top, LINES)
    lines = np.unique(np.floor(wanted / line + 1e-9).astype(int))
    best: np.ndarray = np.zeros(0)
    for _ in range(PHASES):
        spectrum = np.zeros(count // 2 + 1, complex)
        spectrum[lines] = np.exp(2j * np.pi * random.uniform(size=lines.size))
        drawn = np.fft.irfft(spectrum, count)
        drawn = drawn / np.abs(drawn).max()
        if not best.size or np.std(drawn) > np.std(best):
            best = drawn
    best = np.roll(best, -int(np.argmin(np.abs(best))))
    fastest = generator.slew / _steepest(best, generator.rate)
    amplitude = min(SMALL * generator.span, fastest)
    ends = line * lines[0], line * lines[-1]
    tells = f"modes, lags and delay from {ends[0]:g} to {ends[1]:g} Hz"
    voltages = generator.middle + amplitude * best
    return Part("multisine", voltages, generator.rate, tells)


def mixture(
    generator: Generator, samples: int, random: np.random.Generator
) -> np.ndarray:
    """Return voltages [samples] of random stretches, V.

    A stretch has two levels, many levels or a sine, of random height, base and
    frequency. Moves between levels have the slew rate of ``generator``.
    """
    count = random.integers(*STRETCHES)
    cuts = np.sort(random.integers(0, samples, count - 1))
    wanted = np.empty(samples)
    for start, stop in zip([0, *cuts], [*cuts, samples], strict=True):
        height = 0.5 * generator.span * 10.0 ** random.uniform(-1.5, 0.0)
        base = random.uniform(generator.lower + height, generator.upper - height)
        lowest = min(2.0 * generator.rate / samples, generator.top)
        frequency = np.exp(random.uniform(*np.log([lowest, generator.top])))
        turns = frequency * np.arange(stop - start) / generator.rate
        halves = np.floor(2.0 * turns).astype(int)
        shapes = (
            random.choice([-1.0, 1.0], halves.size + 1)[halves],
            random.uniform(-1.0, 1.0, halves.size + 1)[halves],
            np.sin(2.0 * np.pi * turns),
        )
        wanted[start:stop] = base + height * shapes[random.integers(len(shapes))]
    return generator.followed(wanted)


def two_levels(
    generator: Generator, samples: int, random: np.random.Generator
) -> np.ndarray:
    """Return voltages [samples] that jump between two levels around the middle, V.

    The levels follow each other at random, as in a pseudo-random binary sequence, of a
    random clock and height. Moves have the slew rate of ``generator``.
    """
    height = 0.5 * generator.span * 10.0 ** random.uniform(-1.0, 0.0)
    clock = int(np.exp(random.uniform(0.0, np.log(max(2.0, 0.1 * samples)))))
    bits = random.choice([-1.0, 1.0], samples // clock + 1)
    wanted = generator.middle + height * np.repeat(bits, clock)[:samples]
    return generator.followed(wanted)


PARTS: tuple[Callable[[Generator, np.random.Generator], Part], ...] = (
    *(ladder, holds, multisine),
)
"""The parts in the order of a record."""


def excitation(generator: Generator, seed: int = 0) -> tuple[list[Part], np.ndarray]:
    """Return the parts to record, and the voltages [samples] of a whole record, V.

    The record first rests at the middle of the range. It contains all parts twice, with
    different random numbers; the returned parts are those of its first half.
    """
    halves = [
        [part(generator, np.random.default_rng([seed, half])) for part in PARTS]
        for half in (0, 1)
    ]
    return halves[0], after_rest(
        generator, [part.voltages for half in halves for part in half]
    )


def after_rest(generator: Generator, parts: Iterable[np.ndarray]) -> np.ndarray:
    """Return the voltages of a record: a rest at the middle of the range, and parts."""
    rest = np.full(generator.time(REST).size, generator.middle)
    return np.concatenate([rest, *parts])


def buffered(generator: Generator, points: int, seed: int = 0) -> list[Part]:
    """Return the parts, each in at most ``points`` samples.

    If the ladder or the holds are too long, their rate is that of ``generator`` divided
    by a whole number. If the multisine is too long, its period becomes shorter and its
    lowest frequency higher, at the same rate. Raises ValueError if the buffer is too
    short for that.
    """
    found = []
    for part in PARTS:
        least = generator.slowest
        if part is multisine:
            least = max(least, 2.0 * generator.rate / points)
        own = replace(generator, slowest=least)
        made = part(own, np.random.default_rng([seed, 0]))
        every = ceil(made.voltages.size / max(points, 1))
        # The moves and the rounding of each part may take a few samples more.
        while made.voltages.size > points:
            if generator.rate / every < COARSEST * generator.slowest:
                raise ValueError(
                    f"{points} points are too few for the {made.name}: a cycle would "
                    f"have fewer than {COARSEST} samples"
                )
            own = replace(generator, rate=generator.rate / every, highest=None)
            made = part(own, np.random.default_rng([seed, 0]))
            every += 1
        found.append(made)
    return found
