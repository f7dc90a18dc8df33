"""Random plants of which 0 to 3 modes limit an integral loop, and the proof of it.

Nothing here uses piezojax. A plant is a gain, six modes in parallel, of which five are
light, a lag, and a delay. Modes limit the loop if a PI with notches at just these has a
much larger integral gain than with any notch less, and none with one more has a larger
one, at the same sensitivity peak. The response is the continuous one with the delay of
the loop.
"""

from typing import NamedTuple

import numpy as np

RATE = 10_000.0
DT = 1.0 / RATE
DELAY = 1
"""Delay in the plant, samples."""

LIGHT = 5
"""Number of light modes."""

LIMIT = 1.8
"""Limit on the sensitivity peak."""

OFF = 0.01
"""Largest relative difference of the frequency of a mode from that of its notch."""

WIDTHS = 0.15, 0.5
"""Damping ratios of the poles of the notches, of which the better counts."""

NEEDED, NEEDLESS = 1.5, 1.05
"""Factors on the integral gain: a notch at a limiting mode gains more than NEEDED, one
at any other mode less than NEEDLESS."""

BASE = 3000.0, 0.7
"""Frequency (Hz) and damping of the mode that is no resonance."""


class Plant(NamedTuple):
    """A plant: its modes, first the well damped one, and those that limit the loop."""

    seed: int
    gain: float
    frequency: tuple
    damping: tuple
    share: tuple
    lag: float
    limiting: tuple

    @property
    def relevant(self):
        """Frequencies of the modes that limit the loop, Hz."""
        return [self.frequency[i] for i in self.limiting]


def response(plant, frequency, notched=(), width=0.5, off=0.0):
    """Return the plant at ``frequency`` (Hz), over its gain at rest.

    It is behind notches of the ``width`` that cancel the modes ``notched``; the modes
    are higher than their notches by the relative difference ``off``.
    """
    s = 2j * np.pi * frequency
    total = np.zeros(s.shape, complex)
    modes = zip(plant.frequency, plant.damping, plant.share, strict=True)
    for i, (f, z, share) in enumerate(modes):
        w = 2.0 * np.pi * f * (1.0 + off if i else 1.0)
        total = total + share * w**2 / (s**2 + 2.0 * z * w * s + w**2)
    for i in notched:
        w, z = 2.0 * np.pi * plant.frequency[i], plant.damping[i]
        total = total * (s**2 + 2.0 * z * w * s + w**2)
        total = total / (s**2 + 2.0 * width * w * s + w**2)
    # The hold delays by half a sample.
    return total / (1.0 + s * plant.lag) * np.exp(-s * (DELAY + 0.5) * DT)


def grid(plant):
    """Return frequencies (Hz), dense around the modes."""
    side = np.geomspace(0.05, 20.0, 40)
    around = np.concatenate([-side[::-1], [0.0], side])
    modes = zip(plant.frequency, plant.damping, strict=True)
    near = [f * (1.0 + z * around) for f, z in modes]
    every = np.concatenate([np.geomspace(1.0, 0.5 * RATE, 600), *near])
    return np.unique(every[(every > 1.0) & (every < 0.5 * RATE)])


def integral_gain(plant, notched=()):
    """Return the largest integral gain (1/s) of a PI with Ms at most LIMIT.

    The controller has notches at the modes ``notched``; the limit holds for modes that
    are off by OFF to either side.

    At a frequency where L = k u, the gains k with |1 + k u| < 1 / LIMIT lie between the
    roots of a quadratic equation. The least root of all frequencies is the first gain
    above the limit; all lower gains are stable, because the loop without gain is.
    """
    f = grid(plant)
    s, times = 2j * np.pi * f, np.array([0.0, *np.geomspace(4e-5, 4e-3, 16)])[:, None]

    def first(width, off):
        u = (1.0 + s * times) / s * response(plant, f, notched, width, off)
        square = np.abs(u) ** 2
        root = np.sqrt(np.maximum(u.real**2 - square * (1.0 - LIMIT**-2), 0.0))
        inside = (u.real < 0.0) & (root > 0.0)
        return np.min(np.where(inside, (-u.real - root) / square, np.inf), axis=1)

    offs = (-OFF, 0.0, OFF)
    return max(
        float(np.min([first(width, off) for off in offs], axis=0).max())
        for width in (WIDTHS if notched else WIDTHS[:1])
    )


def draw(seed, count):
    """Return a plant of which ``count`` modes limit the loop, by the definition above.

    Plants that do not meet it are drawn again.
    """
    random = np.random.default_rng([seed, count])
    while True:
        plant = _drawn(random, seed, count)
        if plant is not None and _clear(plant):
            return plant


def _drawn(random, seed, count):
    ends = np.log([[450.0, 2500.0]] * count + [[300.0, 3500.0]] * (LIGHT - count))
    drawn = np.exp(random.uniform(*ends.T))
    order = np.argsort(drawn)
    frequency = drawn[order]
    limiting = np.flatnonzero(order < count)
    apart = frequency[limiting]
    if np.min(frequency[1:] / frequency[:-1]) < 1.15 or (
        count > 1 and np.min(apart[1:] / apart[:-1]) < 1.4
    ):
        return None
    damping, share = np.empty(LIGHT), np.empty(LIGHT)
    for i in range(LIGHT):
        sign = random.choice([1.0, 1.0, -1.0])
        damping[i] = np.exp(random.uniform(np.log(0.007), np.log(0.02)))
        ends = (3.0, 30.0) if i in limiting else (0.002, 0.3)
        peak = np.exp(random.uniform(*np.log(ends)))
        share[i] = sign * min(2.0 * damping[i] * peak, 0.5)
    return Plant(
        seed,
        float(random.uniform(0.05, 0.3)),
        (BASE[0], *map(float, frequency)),
        (BASE[1], *map(float, damping)),
        (1.0 - float(share.sum()), *map(float, share)),
        float(np.exp(random.uniform(np.log(8e-5), np.log(4e-4)))),
        tuple(int(i) + 1 for i in limiting),
    )


def _clear(plant):
    if plant.share[0] < 0.2:
        return False
    reached = integral_gain(plant, plant.limiting)
    for i in plant.limiting:
        fewer = [j for j in plant.limiting if j != i]
        if reached < NEEDED * integral_gain(plant, fewer):
            return False
    others = (i for i in range(1, LIGHT + 1) if i not in plant.limiting)
    return all(
        integral_gain(plant, [*plant.limiting, i]) < NEEDLESS * reached for i in others
    )
