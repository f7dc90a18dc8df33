"""The forty stages, drawn by number: their memories, modes, sensors and converters."""

import numpy as np

from .stages import MEMORIES, SUBSTEPS, Parameters, Stage, plays

COUNT = 40
RATES = (5e3, 8e3, 10e3, 16e3, 20e3)


def _spread(random, low, high):
    return float(np.exp(random.uniform(np.log(low), np.log(high))))


def _parted(random, count, total):
    parts = random.exponential(size=count)
    return total * parts / parts.sum()


def irregular_plays(random):
    """Return 12 to 40 plays: a loop of about 8 to 20 % of the stroke."""
    count = random.integers(12, 41)
    share = random.uniform(0.2, 0.5)
    thresholds = 0.45 * np.sort(random.uniform(size=count)) ** random.uniform(0.7, 1.5)
    table = np.zeros((count + 1, 3))
    table[0, 1] = 1.0 - share
    table[1:, 0], table[1:, 1] = thresholds, _parted(random, count, share)
    return table


def drifting_plays(random):
    """Return plays that creep towards the input: minor loops drift and do not close."""
    table = irregular_plays(random)
    table[1:, 2] = random.uniform(0.02, 0.3)
    return table


def slipping_elements(random):
    """Return 8 to 20 elasto-slide elements."""
    count = random.integers(8, 21)
    stiffness = _parted(random, count, random.uniform(0.25, 0.7))
    room = random.uniform(0.005, 0.45, count)
    return np.vstack([[1.0, 0.0], np.column_stack([stiffness, stiffness * room])])


def relay_grid(random):
    """Return random weights on a triangle of 12 to 30 cells, more at its diagonal."""
    cells = random.integers(12, 31)
    middle = (np.arange(cells) + 0.5) / cells
    apart = np.abs(middle[:, None] - middle)
    density = random.gamma(0.7, size=(cells, cells)) * np.exp(-apart / 0.35)
    density = np.tril(density) + np.tril(density, -1).T
    corners = np.zeros((cells + 2, cells + 1))
    corners[2:, 1:] = density.cumsum(axis=0).cumsum(axis=1)
    share = random.uniform(0.2, 0.45)
    corners *= 2.0 * share / corners[-1, -1]
    corners[0, 1] = 1.0 - share
    return corners


def rate_dependent_loop(random):
    """Return Bouc-Wen with loops that widen by 2 to 10 % per factor e of the rate."""
    rise, height = random.uniform(0.3, 0.6), random.uniform(0.05, 0.13)
    both, tilt = rise / height, random.uniform(-0.3, 0.3)
    row = [rise, both * (1.0 - tilt), both * tilt]
    return np.array([row, [random.uniform(0.02, 0.1), 0.5, 0.0]])


def frictions(random):
    """Return one to three Dahl frictions of different exponents."""
    count = random.integers(1, 4)
    rise = _parted(random, count, random.uniform(0.3, 0.6))
    height = _parted(random, count, random.uniform(0.06, 0.14))
    return np.column_stack([rise, height, random.uniform(0.7, 2.0, count)])


KINDS = {
    "plays": irregular_plays,
    "maxwell_slip": slipping_elements,
    "preisach": relay_grid,
    "bouc_wen": rate_dependent_loop,
    "dahl": frictions,
    "drifting": drifting_plays,
}


def logarithmic_creep(per_decade):
    """Return rows (time, share): two exponentials per decade from 10 ms to 300 s."""
    times = 10.0 ** np.arange(-2.0, 2.51, 0.5)
    return np.column_stack([times, np.full(len(times), 0.5 * per_decade)])


def _modes(random, rate):
    frequency = _spread(random, 250.0, min(1500.0, 0.3 * rate))
    first = [frequency, _spread(random, 0.005, 0.08), 1.0]
    second = min(frequency * random.uniform(1.6, 2.8), 0.4 * rate)
    if random.uniform() < 0.5 or second < 1.3 * frequency:
        return np.array([first])
    residue = random.choice([-1.0, 1.0]) * random.uniform(0.02, 0.12)
    first[2] -= residue
    return np.array([first, [second, _spread(random, 0.005, 0.08), residue]])


def parameters(number):
    """Return the Parameters of stage ``number``, 0 to 39."""
    random = np.random.default_rng([1869, number])
    kind = list(KINDS)[number % len(KINDS)]
    operator = "plays" if kind == "drifting" else kind
    memory = [operator.__name__ for operator in MEMORIES].index(operator)
    rate = float(random.choice(RATES))
    lower, upper = ((0.0, 100.0), (-20.0, 120.0))[random.integers(2)]
    stroke = _spread(random, 10.0, 100.0)
    per_decade = random.uniform(0.003, 0.02)
    creep = logarithmic_creep(per_decade)
    if random.uniform() < 0.4:
        times = 10.0 ** random.uniform(-1.5, 1.5, 3)
        creep = np.column_stack([times, _parted(random, 3, 4.0 * per_decade)])
    return Parameters(
        name=f"{number:02d} {kind}",
        rate=rate,
        lower=lower,
        upper=upper,
        stroke=stroke,
        memory=memory,
        table=KINDS[kind](random),
        modes=_modes(random, rate),
        creep=creep,
        bend=random.uniform(0.0, 0.15) if random.uniform() < 0.5 else 0.0,
        sensor_lag=float(random.choice([0.0, random.uniform(0.05e-3, 1e-3)])),
        delay=random.integers(3 * SUBSTEPS + 1) / SUBSTEPS,
        bits=int(random.integers(14, 19)),
        noise=1e-3 * _spread(random, 0.5, 10.0),
        slew=_spread(random, 3e4, 3e5),
        ramp=random.uniform(-0.01, 0.01),
        walk=random.uniform(0.0, 0.005),
        zero=random.uniform(-0.5, 0.5) * stroke,
    )


def stage(number, seed=0):
    """Return stage ``number``, 0 to 39, with the noise of ``seed``."""
    if not 0 <= number < COUNT:
        raise ValueError(f"stage {number}; there are 0 to {COUNT - 1}")
    return Stage(parameters(number), seed)


def audited(seed=0):
    """Return the stage of an audit: 24 plays, a mode at 780 Hz behind a slow sensor."""
    random = np.random.default_rng(780)
    table = np.zeros((25, 3))
    table[0, 1] = 0.7
    table[1:, 0], table[1:, 1] = np.linspace(0.02, 0.45, 24), _parted(random, 24, 0.3)
    audit = Parameters(
        name="audited",
        rate=10e3,
        lower=0.0,
        upper=100.0,
        stroke=40.0,
        memory=MEMORIES.index(plays),
        table=table,
        modes=np.array([[780.0, 0.02, 1.0]]),
        creep=logarithmic_creep(0.01),
        sensor_lag=1e-3,
        bits=16,
        noise=2e-3,
    )
    return Stage(audit, seed)
