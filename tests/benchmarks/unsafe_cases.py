"""Random studies that favour unsafe gains, and their loops in NumPy.

A stage has plays, a resonance and a delay, on one axis or three coupled axes;
its controllers are PIDs or sliding modes. ``draw(number)`` returns a Case with the
study's tables. ``Loop`` steps the same equations sample by sample, sharing no code with
piezojax: with the limits and the plays, or linear about a slope of the plays.

Lengths in um, voltages in V, times in s.
"""

import dataclasses
import math

import numpy as np
from scipy.linalg import expm

RATE = 10_000.0
DT = 1.0 / RATE
LOWER, UPPER = -20.0, 120.0
AMPLITUDE = 4.0
AXES = ("X", "Y", "Z")
DELAY = 2
THREE_OF = 5
"""One study in this number has three axes."""


@dataclasses.dataclass
class Stage:
    """One axis: slope and plays (um/V, V), and the sampled resonance."""

    slope: float
    thresholds: np.ndarray
    weights: np.ndarray
    frequency: float
    damping: float

    @property
    def gain(self):
        return self.slope + self.weights.sum()

    @property
    def transition(self):
        """Return the transition of position and velocity / w under a held input."""
        w = 2.0 * math.pi * self.frequency
        return expm(np.array([[0.0, w], [-w, -2.0 * self.damping * w]]) * DT)

    @property
    def arma(self):
        """Return a, b of y(k+1) = a1 y(k) + a2 y(k-1) + b0 x(k) + b1 x(k-1)."""
        A = self.transition
        b = np.eye(2)[:, :1] - A[:, :1]
        a1, a2 = np.trace(A), -np.linalg.det(A)
        b0 = b[0, 0]
        b1 = A[0, 1] * b[1, 0] - A[1, 1] * b[0, 0]
        return (a1, a2), (b0, b1)


@dataclasses.dataclass
class Case:
    """A study, with the stages and the coupling of its axes."""

    number: int
    kind: str
    stages: list
    coupling: np.ndarray
    study: dict
    limits: dict

    @property
    def references(self):
        table = self.study["references"]
        return [*table["tune"], *table["unseen"]]


def decades(random, low, high):
    return float(10.0 ** random.uniform(low, high))


def draw(number):
    """Return the Case of a number: the same for every run."""
    random = np.random.default_rng([18, number])
    three, kind = number % THREE_OF == THREE_OF - 1, ("pid", "smc")[number // 5 % 2]
    count = 3 if three else 1
    stages = [drawn_stage(random) for _ in range(count)]
    coupling = np.eye(count) + random.uniform(-0.15, 0.15, (count, count))
    coupling[np.diag_indices(count)] = 1.0
    form = ("arma", "mode")[number // 10 % 2]
    makers = {"pid": pid, "smc": sliding_mode}
    parts = [makers[kind](random, stage) for stage in stages]
    limits = drawn_limits(random, three)
    tables, starts = zip(*parts, strict=True)
    prefixes = [f"controller.{axis}." for axis in AXES] if three else ["controller."]
    ranges = {
        prefix + path: table
        for prefix, part in zip(prefixes, starts, strict=True)
        for path, table in part.items()
    }
    plants = [[plays_table(s), *resonance_tables(s, form)] for s in stages]
    hysteresis, *rest = zip(*plants, strict=True)
    push = {"type": "LinearMap", "matrix": coupling.tolist()}
    links = [
        per_axis(hysteresis),
        {"type": "Packed", "system": push},
        *(per_axis(part) for part in rest),
    ]
    study = {
        "title": f"unsafe {number}",
        "rate": RATE,
        "seed": number,
        **({"axes": {"names": AXES, "units": ["um"] * 3}} if three else {}),
        "plant": {"type": "Series", "parts": links if three else plants[0]},
        "actuator": {"lower": LOWER, "upper": UPPER},
        "sensor": {"noise_rms": 0.002},
        "controller": per_axis(tables, AXES) if three else tables[0],
        "references": {
            "tune": ["X:SIN20 Y:SIN10 Z:PWSW20"] if three else ["SIN20", "PWSW40"],
            "unseen": ["X+Y:CIRCLE20"] if three else ["SW30"],
            "amplitude": AMPLITUDE,
            "duration": 0.15,
            "settle": 0.05,
        },
        "parameters": ranges,
        "optimiser": {"method": "bfgs", "starts": 1, "candidates": 4, "steps": 3},
        "constraints": limits,
    }
    return Case(number, f"{kind} {form}", stages, coupling, study, limits)


def drawn_stage(random):
    share, gain = random.uniform(0.05, 0.3), random.uniform(0.11, 0.2)
    weights = random.uniform(0.2, 1.0, 3)
    return Stage(
        slope=(1.0 - share) * gain,
        thresholds=np.sort(random.uniform(1.0, 30.0, 3)),
        weights=share * gain * weights / weights.sum(),
        frequency=decades(random, 2.3, 3.3),
        damping=decades(random, -2.5, -1.0),
    )


def drawn_limits(random, three):
    """Return limits, from infeasible ones to ones that are never active."""
    which = random.integers(3 if three else 4)
    if which == 0:
        return {}
    if which == 1:
        peak, delay = 1.0 + decades(random, -2.0, 0.5), decades(random, -0.5, 1.5)
        return {"sensitivity_peak": peak, "delay_margin": delay}
    if which == 2:
        return {"sensitivity_peak": "off", "delay_margin": "off"}
    return {
        "peak_voltage": decades(random, 1.4, 2.3),
        "peak_slew": decades(random, 3.5, 6.0),
    }


def per_axis(parts, names=None):
    named = {"names": list(names)} if names else {}
    return {"type": "PerAxis", "parts": list(parts), **named}


def plays_table(stage):
    return {
        "type": "PrandtlIshlinskii",
        "polynomial": [stage.slope],
        "thresholds": stage.thresholds.tolist(),
        "weights": stage.weights.tolist(),
    }


def resonance_tables(stage, form):
    a, b = stage.arma
    tables = {
        "arma": {"type": "ARMA", "autoregressive": [*a], "moving": [*b]},
        "mode": {
            "type": "Mode",
            "frequency": stage.frequency,
            "damping": stage.damping,
            "dt": DT,
        },
    }
    return [tables[form], {"type": "Delay", "samples": DELAY}]


def searched(random, middle, start=None):
    """Return a box of 0.1 to 3 decades around a multiple of ``middle``."""
    lower = middle * decades(random, -3.0, 0.7)
    width = decades(random, 0.1, 3.0)
    start = lower * width ** random.uniform(0.05, 0.95)
    return {"lower": lower, "upper": lower * width, "scale": "log"}, start


def pid(random, stage):
    """Return the table of a PID and the box of its gains."""
    # The integral gain at which an undelayed resonance turns unstable.
    critical = 2.0 * stage.damping * 2.0 * math.pi * stage.frequency / stage.gain
    proportional, first = searched(random, 2.0 * stage.damping / stage.gain)
    integral, second = searched(random, critical)
    table = {
        "type": "PID",
        "proportional": first,
        "integral": second,
        "derivative": 0.0,
        "anti_windup": 100.0,
        "dt": DT,
    }
    return table, {"proportional": proportional, "integral": integral}


def sliding_mode(random, stage):
    """Return the table of a sliding mode with a wrong model, and its box."""
    off = dataclasses.replace(
        stage, frequency=stage.frequency * random.uniform(0.8, 1.2)
    )
    a, b = off.arma
    b = [x * stage.gain * random.uniform(0.8, 1.2) for x in b]
    critical = 2.0 * stage.damping * 2.0 * math.pi * stage.frequency / stage.gain
    surface, m = searched(random, 1000.0)
    integral, i = searched(random, critical / m)
    proportional, p = searched(random, 2.0 * stage.damping / stage.gain / m)
    table = {
        "type": "SlidingMode",
        "law": {
            "type": "SwitchingPID",
            "proportional": p,
            "integral": i,
            "derivative": 0.0,
            "dt": DT,
        },
        "model": {"type": "ARMA", "autoregressive": [*a], "moving": [*b]},
        "filter": {
            "type": "AlphaBeta",
            "alpha": random.uniform(0.1, 0.9),
            "beta": decades(random, -6.0, -1.0),
            "dt": DT,
        },
        "surface": m,
        "error_weight": 1.0,
        "control_weight": decades(random, -1.0, 3.0),
    }
    box = {
        "surface": surface,
        "law.integral": integral,
        "law.proportional": proportional,
    }
    return table, box


# The loops in NumPy


class PIDLaw:
    """State: integral, last command; a PID without derivative."""

    size = 2

    def __init__(self, table):
        self.p, self.i = table["proportional"], table["integral"]
        self.anti_windup = table["anti_windup"]

    def rest(self, reference, voltage):
        return np.array([voltage, voltage])

    def step(self, x, r, r_next, z, applied):
        integral = x[0] + DT * (self.anti_windup * (applied - x[1]) + self.i * (r - z))
        command = self.p * (r - z) + integral
        return np.array([integral, command]), command


class SlidingModeLaw:
    """State: filtered position and speed, integral, last reference, last output."""

    size = 5

    def __init__(self, table):
        law, model, self.filter = table["law"], table["model"], table["filter"]
        self.p, self.i = law["proportional"], law["integral"]
        self.a, self.b = model["autoregressive"], model["moving"]
        self.m = table["surface"]
        self.share = table["error_weight"]
        self.share /= table["error_weight"] + table["control_weight"]

    def rest(self, reference, voltage):
        (a1, a2), (b0, b1) = self.a, self.b
        forward = (1.0 - a1 - a2) * reference / b0
        held = voltage * (1.0 / self.share + b1 / b0) - forward
        return np.array([reference, 0.0, held, reference, voltage])

    def step(self, x, r, r_next, z, applied):
        yh, vh, integral, r_last, f_last = x
        (a1, a2), (b0, b1) = self.a, self.b
        predicted = yh + DT * vh
        yh = predicted + self.filter["alpha"] * (z - predicted)
        vh = vh + self.filter["beta"] / DT * (z - predicted)
        e1, e2 = yh - r, vh - (r - r_last) / DT
        s = self.m * e1 + e2
        forward = (r_next - a1 * r - a2 * r_last) / b0
        # The error state one sample later, without control.
        e1_next = (a1 + a2) * e1 - a2 * DT * e2
        e2_next = (a1 + a2 - 1.0) / DT * e1 - a2 * e2
        equivalent = -(self.m * e1_next + e2_next) / (b0 * (self.m + 1.0 / DT))
        integral = integral - self.i * DT * s
        v = forward + equivalent + integral - self.p * s
        f = self.share * (v - b1 / b0 * f_last)
        return np.array([yh, vh, integral, r, f]), f


LAWS = {"PID": PIDLaw, "SlidingMode": SlidingModeLaw}


class Loop:
    """The loop of a case with the controllers of ``tables``, one for each axis.

    A state contains for each axis that of the controller, the applied voltage, position
    and speed of the resonance, and the delayed positions, the oldest last.
    """

    def __init__(self, case, tables):
        self.stages, self.coupling = case.stages, case.coupling
        self.laws = [LAWS[table["type"]](table) for table in tables]
        self.transitions = [stage.transition for stage in case.stages]
        sizes = [law.size + 3 + DELAY for law in self.laws]
        self.ends = np.cumsum(sizes)
        self.starts = self.ends - sizes

    def step(self, x, r, r_next, noise, moved):
        """Return the next state, displacements and voltages.

        ``moved(axis, voltage)`` returns the output of the plays of an axis for a
        voltage, and the voltage within the limits.
        """
        following, y, voltages = x.copy(), self.displacement(x), []
        pushed, ways = [], list(zip(self.starts, self.ends, strict=True))
        for axis, law in enumerate(self.laws):
            start = ways[axis][0]
            own = slice(start, start + law.size)
            z = y[axis] + noise[axis]
            applied = x[start + law.size]
            following[own], command = law.step(
                x[own], r[axis], r_next[axis], z, applied
            )
            push, voltage = moved(axis, command)
            following[start + law.size] = voltage
            voltages.append(voltage)
            pushed.append(push)
        pushed = self.coupling @ pushed
        for axis, (start, end) in enumerate(ways):
            at = start + self.laws[axis].size + 1
            rest = np.array([pushed[axis], 0.0])
            motion = rest + self.transitions[axis] @ (x[at : at + 2] - rest)
            following[at : at + 2] = motion
            following[at + 2 : end] = [x[at], *x[at + 2 : end - 1]]
        return following, y, np.array(voltages)

    def displacement(self, x):
        return x[self.ends - 1]

    def matrices(self, slopes):
        """Return A, B, C of the linear loop from a disturbance of y to y."""
        n, axes = self.ends[-1], len(self.laws)

        def linear(axis, command):
            return slopes[axis] * command, command

        still = np.zeros(axes)
        A = [self.step(e, still, still, still, linear)[0] for e in np.eye(n)]
        B = [self.step(np.zeros(n), still, still, e, linear)[0] for e in np.eye(axes)]
        C = np.array([self.displacement(e) for e in np.eye(n)]).T
        return np.array(A).T, np.array(B).T, C

    def run(self, references, noise):
        """Run [samples, axes] from rest; return displacements and voltages."""
        first = references[0]
        memory = [np.zeros(3) for _ in self.stages]
        held = self._holding(first)
        x = np.zeros(self.ends[-1])
        for axis, law in enumerate(self.laws):
            start = self.starts[axis]
            x[start : start + law.size] = law.rest(first[axis], held[axis])
            x[start + law.size] = held[axis]
            at = start + law.size + 1
            x[at], x[at + 2 : self.ends[axis]] = first[axis], first[axis]
            self._plays(axis, memory, held[axis])

        def moved(axis, command):
            voltage = min(max(command, LOWER), UPPER)
            return self._plays(axis, memory, voltage), voltage

        following = np.vstack([references[1:], references[-1:]])
        found = []
        for r, r_next, draw in zip(references, following, noise, strict=True):
            x, y, voltages = self.step(x, r, r_next, draw, moved)
            found.append((y, voltages))
            if not np.isfinite(x).all():
                break
        return tuple(np.array(column) for column in zip(*found, strict=True))

    def _plays(self, axis, memory, voltage):
        stage = self.stages[axis]
        low, high = voltage - stage.thresholds, voltage + stage.thresholds
        memory[axis] = np.clip(memory[axis], low, high)
        return stage.slope * voltage + stage.weights @ memory[axis]

    def _holding(self, reference):
        """Return the voltages of rest on the virgin curve, by bisection."""
        pushes = np.linalg.solve(self.coupling, reference)
        return np.array(
            [self._voltage_of(axis, push) for axis, push in enumerate(pushes)]
        )

    def _voltage_of(self, axis, push):
        low, high = -1e4, 1e4
        for _ in range(100):
            middle = 0.5 * (low + high)
            virgin = [np.zeros(3)] * (axis + 1)
            below = self._plays(axis, virgin, middle) < push
            low, high = (middle, high) if below else (low, middle)
        return 0.5 * (low + high)

    def ascending(self, reference):
        """Return the slopes of the plays that move on the virgin curve."""
        voltages = self._holding(reference)
        return [
            s.slope + s.weights[s.thresholds < abs(u)].sum()
            for s, u in zip(self.stages, voltages, strict=True)
        ]


def margins(loop, slopes):
    """Return largest eigenvalue, peak of S and least delay margin (samples)."""
    A, B, C = loop.matrices(slopes)
    poles = np.linalg.eigvals(A)
    radius = float(np.abs(poles).max())
    if radius >= 1.0:
        return radius, math.inf, 0.0
    w = grid(poles)
    z = np.exp(1j * w)
    n, axes = B.shape
    S = np.array([np.eye(axes) + C @ np.linalg.solve(k * np.eye(n) - A, B) for k in z])
    peak = float(np.linalg.norm(S, 2, axis=(1, 2)).max())
    least = min(delay_margin(w, 1.0 / S[:, axis, axis] - 1.0) for axis in range(axes))
    return radius, peak, least


def grid(poles):
    """Return frequencies in rad a sample, dense near the poles."""
    near = [
        abs(np.angle(pole)) + max(abs(np.log(abs(pole))), 1e-6) * np.linspace(-8, 8, 81)
        for pole in poles
        if abs(pole) > 1e-3
    ]
    w = np.concatenate(
        [np.geomspace(1e-4, math.pi, 600), np.linspace(1e-3, math.pi, 600), *near]
    )
    return np.unique(w[(w > 1e-5) & (w <= math.pi)])


def delay_margin(w, L):
    """Return the least delay in samples that a crossing of |L| = 1 allows."""
    size = np.log(np.abs(L))
    crossed = np.flatnonzero(np.sign(size[1:]) != np.sign(size[:-1]))
    share = size[crossed] / (size[crossed] - size[crossed + 1])
    at = w[crossed] + share * (w[crossed + 1] - w[crossed])
    phase = np.unwrap(np.angle(L))
    angle = phase[crossed] + share * (phase[crossed + 1] - phase[crossed])
    return float(np.min(np.mod(angle + math.pi, 2.0 * math.pi) / at, initial=math.inf))
