"""Forty piezo stages in NumPy: memories of the literature, modes and converters.

    voltage -> converter, delay -> slew limit -> memory -> creep -> modes -> tip
    tip -> lag of the sensor -> noise, converter -> reading

The memory is one of MEMORIES, none of them the one that ``identify`` fits by default.
Between two samples a stage has SUBSTEPS steps, in which the voltage slews; the modes
and the sensor have exact steps (matrix exponential) for a held input. All states
are in arrays that a compiled step changes in place.

Lengths in um, voltages in V, times in s. ``stage(number)`` draws one of the forty.
"""

import dataclasses
import itertools
import math

import numba
import numpy as np
from scipy.linalg import expm

SUBSTEPS = 4
POOL = 1 << 17
"""Standard normal draws of a stage; the noise repeats after as many samples."""

# Memories: (x, dx, dt, state, table) -> output, x in spans of the voltage


@numba.njit(cache=True)
def plays(x, dx, dt, state, table):
    """Return the sum of plays: rows (threshold, weight, accommodation), Kuhnen 2003.

    With an accommodation the position of a play creeps along the path towards the
    input, so that minor loops drift and do not close.
    """
    total = 0.0
    for i in range(len(table)):
        threshold, weight, accommodation = table[i, 0], table[i, 1], table[i, 2]
        state[i] += accommodation * abs(dx) * (x - state[i])
        state[i] = min(max(state[i], x - threshold), x + threshold)
        total += weight * state[i]
    return total


@numba.njit(cache=True)
def maxwell_slip(x, dx, dt, state, table):
    """Return q of x = a q + sum of elasto-slide forces, Goldfarb and Celanovic 1997.

    Row 0 has a; the others (stiffness, breakaway force). The forces are piecewise
    linear in q: the step is computed from one breakaway to the next.
    """
    left = dx
    while left != 0.0:
        way = 1.0 if left > 0.0 else -1.0
        stiffness, room, breaks = table[0, 0], math.inf, 0
        for i in range(1, len(table)):
            reserve = (table[i, 1] - way * state[i]) / table[i, 0]
            if reserve > 0.0:
                stiffness += table[i, 0]
                if reserve < room:
                    room, breaks = reserve, i
        step = abs(left) / stiffness
        last = step <= room
        if not last:
            step = room
        state[0] += way * step
        for i in range(1, len(table)):
            force = way * state[i] + table[i, 0] * step
            state[i] = way * min(force, table[i, 1])
        if last:
            break
        state[breaks] = way * table[breaks, 1]
        left -= way * step * stiffness
    return state[0]


@numba.njit(cache=True)
def _corner(table, a, b):
    """Return the integral of the symmetric density from the lowest corner to (a, b)."""
    cells = len(table) - 2
    a, b = min(max(a, 0.0), 1.0) * cells, min(max(b, 0.0), 1.0) * cells
    i, j = min(int(a), cells - 1), min(int(b), cells - 1)
    p, q = a - i, b - j
    return (
        table[1 + i, j] * (1 - p) * (1 - q)
        + table[2 + i, j] * p * (1 - q)
        + table[1 + i, j + 1] * (1 - p) * q
        + table[2 + i, j + 1] * p * q
    )


@numba.njit(cache=True)
def _triangle(table, high, low):
    """Return the weight of relays that switch up by ``high`` and down from ``low``."""
    square = _corner(table, high, high) + _corner(table, low, low)
    return 0.5 * square - _corner(table, high, low)


@numba.njit(cache=True)
def preisach(x, dx, dt, state, table):
    """Return the Preisach output with constant density in each cell, by stored extrema.

    Row 0 has the lowest input and the weight of x; the other rows have the
    integral of the density, extended symmetrically, at the corners of the cells.
    ``state[0]`` is the number of extrema in ``state[1:]``, a minimum first and the
    input itself last: Mayergoyz 1991, with their wiping-out.
    """
    place = x - table[0, 0]
    count = int(state[0])
    if count == 0:
        count, state[1], state[2] = 2, 0.0, 0.0
    rising = count % 2 == 0  # the last entry is a maximum
    if (place < state[count]) if rising else (place > state[count]):
        count += 1 if count < len(state) - 2 else -1  # or forget the smallest
        rising = not rising
    state[count] = place
    while count > 2:
        older = state[count - 2]
        if (place < older) if rising else (place > older):
            break
        count -= 2
        state[count] = place
    state[0] = count
    total = table[0, 1] * x
    for i in range(2, count + 1, 2):
        total += _triangle(table, state[i], state[i - 1])
        if i < count:
            total -= _triangle(table, state[i], state[i + 1])
    return total


@numba.njit(cache=True)
def bouc_wen(x, dx, dt, state, table):
    """Return x - h with h' = A x' - b |x'| h - c x' |h|, Low and Guo 1995.

    Row 0: A, b, c. Row 1: a share and a rate in spans per s; b decreases by about the
    share for each factor e above that rate, so that fast loops are wider.
    """
    rate = abs(dx) / dt
    b = table[0, 1] / (1.0 + table[1, 0] * math.log1p(rate / table[1, 1]))
    half = _bouc_wen_slope(state[0], dx, table[0, 0], b, table[0, 2])
    middle = state[0] + 0.5 * half * dx
    state[0] += _bouc_wen_slope(middle, dx, table[0, 0], b, table[0, 2]) * dx
    return x - state[0]


@numba.njit(cache=True)
def _bouc_wen_slope(h, dx, a, b, c):
    return a - (b if dx > 0.0 else -b) * h - c * abs(h)


@numba.njit(cache=True)
def dahl(x, dx, dt, state, table):
    """Return x minus the friction forces F, dF/dx = k |1 - F/F_c|^n, Dahl 1976.

    F/F_c has the sign of the motion. Rows: k, F_c, n.
    """
    total = x
    way = 1.0 if dx > 0.0 else -1.0
    for i in range(len(table)):
        k, most, power = table[i, 0], table[i, 1], table[i, 2]
        half = k * max(1.0 - way * state[i] / most, 0.0) ** power
        middle = state[i] + 0.5 * half * dx
        slope = k * max(1.0 - way * middle / most, 0.0) ** power
        state[i] = min(max(state[i] + slope * dx, -most), most)
        total -= state[i]
    return total


MEMORIES = (plays, maxwell_slip, preisach, bouc_wen, dahl)


@numba.njit(cache=True)
def remember(kind, x, dx, dt, state, table):
    """Step the memory number ``kind`` from x - dx to x in ``dt``."""
    if kind == 0:
        return plays(x, dx, dt, state, table)
    if kind == 1:
        return maxwell_slip(x, dx, dt, state, table)
    if kind == 2:
        return preisach(x, dx, dt, state, table)
    if kind == 3:
        return bouc_wen(x, dx, dt, state, table)
    return dahl(x, dx, dt, state, table)


# A stage


@dataclasses.dataclass(frozen=True)
class Parameters:
    """Numbers of a stage; ``memory`` is the index of its operator in MEMORIES.

    ``modes`` are rows (frequency in Hz, damping ratio, residue) with residues of sum 1,
    ``creep`` rows (time in s, share). ``bend`` is the relative rise of the gain over
    the stroke. ``delay`` is in samples, a multiple of 1 / SUBSTEPS. ``bits`` are those
    of both converters, ``ramp`` (um/s) and ``walk`` (um rms after 1 s) the drift of the
    temperature, ``zero`` (um) the reading at 0 V.
    """

    name: str
    rate: float
    lower: float
    upper: float
    stroke: float
    memory: int
    table: np.ndarray
    modes: np.ndarray
    creep: np.ndarray
    bend: float = 0.0
    sensor_lag: float = 0.0
    delay: float = 0.0
    bits: int = 18
    noise: float = 0.0
    slew: float = math.inf
    ramp: float = 0.0
    walk: float = 0.0
    zero: float = 0.0

    @property
    def span(self) -> float:
        return self.upper - self.lower


# Indices in the arrays of numbers, and of states that are single numbers.
LOWER, SPAN, GAIN, BEND, SLEW, NOISE, LSB, RAMP, WALK, DAC, DT, ZERO = range(12)
VOLTAGE, PLACE, DRAW, DRIFT, TIP, SENSED = range(6)


@numba.njit(cache=True)
def shaped(numbers, h):
    """Return the displacement (um) of a memory's output, before creep."""
    h *= numbers[GAIN]
    return h + numbers[BEND] * h * h


@numba.njit(cache=True)
def advance(
    kind, numbers, table, creep, A, B, C, single, memory, crept, x, line, pool, v
):
    """Advance a stage by one sample under the voltage ``v``; return the reading."""
    low, span, dt = numbers[LOWER], numbers[SPAN], numbers[DT]
    v = min(max(v, low), low + span)
    v = low + numbers[DAC] * round((v - low) / numbers[DAC])
    states = len(B)
    for _ in range(SUBSTEPS):
        place = int(single[PLACE])
        line[place] = v
        place = (place + 1) % len(line)
        single[PLACE] = place
        old, most = single[VOLTAGE], numbers[SLEW] * dt
        now = old + min(max(line[place] - old, -most), most)
        single[VOLTAGE] = now
        # A held voltage changes in one substep; its rate is that over the sample.
        h = remember(kind, now / span, (now - old) / span, SUBSTEPS * dt, memory, table)
        h = shaped(numbers, h)
        pushed = h
        for i in range(len(creep)):
            crept[i] += creep[i, 0] * (h - crept[i])
            pushed += creep[i, 1] * crept[i]
        for i in range(states):
            x[states + i] = B[i] * pushed
            for j in range(states):
                x[states + i] += A[i, j] * x[j]
        x[:states] = x[states:]
    return observe(numbers, C, single, x, pool)


@numba.njit(cache=True)
def observe(numbers, C, single, x, pool):
    """Move the drift by one sample and take a reading."""
    draw = int(single[DRAW])
    single[DRAW] = (draw + 2) % len(pool)
    dt = SUBSTEPS * numbers[DT]
    single[DRIFT] += numbers[RAMP] * dt + numbers[WALK] * math.sqrt(dt) * pool[draw]
    for row in range(2):
        total = single[DRIFT] + numbers[ZERO]
        for i in range(C.shape[1]):
            total += C[row, i] * x[i]
        single[TIP + row] = total
    reading = single[SENSED] + numbers[NOISE] * pool[draw + 1]
    return numbers[LSB] * round(reading / numbers[LSB])


@numba.njit(cache=True)
def advance_all(parts, voltages, readings, tips, sensed):
    for k in range(len(voltages)):
        readings[k] = advance(*parts, voltages[k])
        tips[k], sensed[k] = parts[7][TIP], parts[7][SENSED]


def linear_tail(modes, sensor_lag, dt):
    """Return A, B, C of modes in parallel and a sensor, exact for a held input.

    The outputs are the tip and the sensor's reading of it, both of unit static gain.
    """
    count = 2 * len(modes)
    states = count + (sensor_lag > 0.0)
    A, B, C = np.zeros((states, states)), np.zeros(states), np.zeros((2, states))
    for i, (frequency, damping, residue) in enumerate(modes):
        at, omega = 2 * i, 2.0 * np.pi * frequency
        # States: position, and velocity / omega.
        A[at, at + 1], A[at + 1, at] = omega, -omega
        A[at + 1, at + 1] = -2.0 * damping * omega
        B[at + 1], C[:, at] = omega, residue
    if sensor_lag > 0.0:
        A[-1] = C[0] / sensor_lag
        A[-1, -1] = -1.0 / sensor_lag
        C[1] = np.eye(states)[-1]
    whole = np.zeros((states + 1, states + 1))
    whole[:-1, :-1], whole[:-1, -1] = A, B
    exact = expm(whole * dt)
    return exact[:-1, :-1], exact[:-1, -1], C


class Stage:
    """A stage that is stepped with voltages and gives readings.

    ``step`` holds a voltage for one sample and returns the reading at its end; ``tip``
    and ``sensed`` are then the true displacement and that behind the sensor's lag, both
    without noise. ``seed`` is that of noise and drift.
    """

    def __init__(self, parameters, seed=0):
        self.parameters = p = parameters
        self.dt = 1.0 / p.rate
        dt = self.dt / SUBSTEPS
        self._numbers = np.zeros(12)
        self._creep = np.array([(-math.expm1(-dt / t), g) for t, g in p.creep])
        self._creep = self._creep.reshape(-1, 2)
        tail = map(np.ascontiguousarray, linear_tail(p.modes, p.sensor_lag, dt))
        self._tail = A, _, _ = tuple(tail)
        self._single = np.zeros(6)
        self._memory = np.zeros(1000 if MEMORIES[p.memory] is preisach else 64)
        self._crept = np.zeros(len(p.creep))
        self._x = np.zeros(2 * len(A))
        self._line = np.zeros(round(SUBSTEPS * p.delay) + 1)
        self._pool = np.zeros(POOL)
        self._parts = (p.memory, self._numbers, np.ascontiguousarray(p.table))
        self._parts += (self._creep, *self._tail, self._single, self._memory)
        self._parts += (self._crept, self._x, self._line, self._pool)
        self._scale()
        self.reset(0.0, seed)

    def _scale(self):
        """Set the numbers; the stroke follows from a slow loop over the span."""
        p, numbers = self.parameters, self._numbers
        numbers[GAIN], numbers[SPAN] = 1.0, p.span
        corners = np.array([0.0, p.upper, p.lower, p.upper])
        path = np.concatenate(
            [np.linspace(*ends, 500) for ends in itertools.pairwise(corners)]
        )
        swing = np.ptp(self._remembered(path)[500:])
        share = 1.0 + np.sum(p.creep, axis=0)[1] if len(p.creep) else 1.0
        stroke = p.stroke / share
        resolution = 2.0**-p.bits
        numbers[:] = (
            p.lower, p.span, stroke / swing, p.bend / (2.0 * stroke), p.slew, p.noise,
            1.2 * p.stroke * resolution, p.ramp, p.walk, p.span * resolution,
            self.dt / SUBSTEPS, p.zero,
        )  # fmt: skip

    def _remembered(self, path):
        """Step the memory along voltages from the virgin state; return its output."""
        p, self._memory[:] = self.parameters, 0.0
        slow, before, found = 1e9, 0.0, np.zeros(len(path))
        for k, v in enumerate(path / p.span):
            found[k] = remember(
                p.memory, v, v - before, slow, self._memory, self._parts[2]
            )
            before = v
        return found

    def reset(self, voltage=0.0, seed=None):
        """Move slowly from the virgin state to rest at ``voltage``; return a reading.

        With a ``seed`` noise and drift are drawn again, else they continue.
        """
        if seed is not None:
            entropy = np.random.SeedSequence([18, seed])
            self._pool[:] = np.random.default_rng(entropy).standard_normal(POOL)
            self._single[DRAW] = 0
        single, (A, B, C) = self._single, self._tail
        h = shaped(self._numbers, self._remembered(np.linspace(0.0, voltage, 200))[-1])
        self._crept[:], self._line[:] = h, voltage
        pushed = h * (1.0 + self._creep[:, 1].sum())
        self._x[: len(A)] = np.linalg.solve(np.eye(len(A)) - A, B * pushed)
        single[VOLTAGE], single[DRIFT] = voltage, 0.0
        return observe(self._numbers, C, single, self._x, self._pool)

    def step(self, voltage):
        """Hold ``voltage`` for one sample; return the reading at its end."""
        return advance(*self._parts, voltage)

    def respond(self, voltages):
        """Return readings, tips and sensed tips [samples] for the voltages."""
        voltages = np.ascontiguousarray(voltages, dtype=float)
        found = np.zeros((3, len(voltages)))
        advance_all(self._parts, voltages, *found)
        return found

    @property
    def tip(self):
        """True displacement, um."""
        return self._single[TIP]

    @property
    def sensed(self):
        """Displacement behind the lag of the sensor, um, without noise."""
        return self._single[SENSED]
