"""The 3-DOF stage P-558.TCD and its controllers (thesis, chapters 7, 8), plain loops.

Axes Z in um, Rx and Ry in urad, a sample every 2 ms. Signals have time first and the
three axes last; dimensions between them are simulated at once. At time k
a controller gets the measurement z(k) and the references r(k+1), r(k), and returns the
command u(k), which acts on y(k+1). Everything starts at zero, the references too.
"""

import numpy as np
from scipy.linalg import block_diag, expm

from .p558 import (
    ALPHA,
    ARX,
    BETA,
    CUTOFF,
    DOB_SMC_GAINS,
    PID_GAINS,
    PID_SMC_GAINS,
    PLANT,
    SLOPE,
    T,
)


def stacked():
    """Return A [9, 9], B [9, 3], C [3, 9] of (7.52)."""
    a, b, c = zip(*PLANT, strict=True)
    columns = [np.reshape(column, (3, 1)) for column in b]
    return block_diag(*a), block_diag(*columns), np.hstack(c)


class Plant:
    """x(k+1) = A x(k) + B h(k-delay), y(k) = C x(k).

    h = (1 - weight) u + weight p, where p is the play operator of u with that radius:
    an assumption for the hysteresis of the stage, of which no model is printed.
    """

    def __init__(self, shape, delay=0, weight=0.0, radius=0.0):
        self.A, self.B, self.C = stacked()
        self.weight, self.radius = weight, radius
        self.x = np.zeros((*shape, 9))
        self.p = np.zeros((*shape, 3))
        self.waiting = [np.zeros((*shape, 3)) for _ in range(delay)]

    def output(self):
        return self.x @ self.C.T

    def push(self, u):
        self.p = np.minimum(np.maximum(self.p, u - self.radius), u + self.radius)
        self.waiting.append((1.0 - self.weight) * u + self.weight * self.p)
        self.x = self.x @ self.A.T + self.waiting.pop(0) @ self.B.T


class AlphaBeta:
    """Prediction yh + T v, corrected by alpha and beta / T of the residual."""

    def __init__(self):
        self.yh = self.v = 0.0

    def step(self, z):
        ahead = self.yh + T * self.v
        residual = z - ahead
        self.yh = ahead + ALPHA * residual
        self.v = self.v + BETA / T * residual
        return self.yh


class Unfiltered:
    def step(self, z):
        return z


class Switching:
    """-(P s + I T (s(0) + ... + s(k)) + D (s(k) - s(k-1)) / T), (7.33) and (8.34)."""

    def __init__(self, gains):
        self.P, self.I = np.array(gains["P"]), np.array(gains["I"])
        self.D = np.array(gains.get("D", [0.0, 0.0, 0.0]))
        self.rate = gains.get("anti_windup", 0.0)
        self.total = self.before = self.wound = 0.0

    def wind(self, shortfall):
        self.wound = self.wound + T * self.rate * shortfall

    def step(self, s):
        self.total = self.total + s
        slope = (s - self.before) / T
        self.before = s
        return self.wound - (self.P * s + self.I * T * self.total + self.D * slope)


class PID:
    """u = P e + I T sum(e) + D (e(k) - e(k-1)) / T of e = r - z, unfiltered."""

    def __init__(self, gains=None):
        self.law = Switching(gains or PID_GAINS)

    def step(self, z, r_next, r):
        return -self.law.step(r - z), {}

    def applied(self, u):
        """Do nothing, because there is no anti-windup."""


def autoregression():
    """Return A0, A1, A2 and B0, B1, B2 of (7.26), each [3, 3].

    y(k+3) = A0 y(k) + A1 y(k+1) + A2 y(k+2) + B0 u(k) + B1 u(k+1) + B2 u(k+2), from the
    observability form of the stacked model and its first three Markov parameters.
    """
    A, B, C = stacked()
    F = np.vstack([C, C @ A, C @ A @ A])
    last = np.linalg.solve(F.T, (C @ A @ A @ A).T).T
    A0, A1, A2 = np.hsplit(last, 3)
    h0, h1, h2 = C @ B, C @ A @ B, C @ A @ A @ B
    return (A0, A1, A2), (h2 - A1 @ h0 - A2 @ h1, h1 - A2 @ h0, h0)


def reference_model(frequency, damping):
    """Return Am [2, 2], Bm [2], Cm [2] of one axis of (7.54) for a held input."""
    square = frequency * frequency
    both = np.zeros((3, 3))
    both[0, 1] = 1.0
    both[1] = [-square, -2.0 * damping * frequency, square]
    both = expm(T * both)
    return both[:2, :2], both[:2, 2], np.array([1.0, 0.0])


class PIDSMC:
    """Chapter 7: output tracking PID-SMC, static decoupling, model reference.

    Readings: the state of (7.27) is computed from past e and u2 (dead-beat); +PHI in
    (7.30); u1 causal, two samples behind (7.16).
    """

    def __init__(self, gains="dynamic", alpha_beta=True):
        gains = PID_SMC_GAINS[gains] if isinstance(gains, str) else gains
        self.filter = AlphaBeta() if alpha_beta else Unfiltered()
        self.law = Switching(gains)
        model = reference_model(gains["frequency"], gains["damping"])
        self.Am, self.Bm, self.Cm = model
        (A0, A1, A2), (B0, B1, B2) = self.A, self.B = autoregression()
        self.Ks = np.array(gains["Ks"])
        self.F1 = (np.eye(3) + 2.0 * self.Ks) @ np.linalg.inv(B0 + B1 + B2)  # (7.18)

        eye, zero = np.eye(3), np.zeros((3, 3))
        Ad = np.block([[zero, eye, zero], [zero, zero, eye], [A0, A1, A2]])
        h0, h1 = B2, B1 + A2 @ B2
        Bd = np.vstack([h0, h1, B0 + A1 @ h0 + A2 @ h1])
        m, PHI = gains["m"], np.diag(gains["PHI"])
        self.S = np.hstack([m * m * eye, 2.0 * m * eye, eye])
        self.K = np.linalg.solve(self.S @ Bd, self.S @ Ad - PHI @ self.S)  # (7.29)

        none = np.zeros(3)
        self.w = np.zeros((3, 2))  # axis, state
        self.yd = [none, none]  # k-1, k-2
        self.e, self.u1, self.u2 = [none, none], [none, none], [none, none]

    def step(self, z, r_next, r):
        (A0, A1, A2), (B0, B1, _) = self.A, self.B
        y = self.filter.step(z)

        yd = self.w @ self.Cm
        self.w = self.w @ self.Am.T + r[..., None] * self.Bm
        yd_next = self.w @ self.Cm
        R1 = yd_next - yd @ A2.T - self.yd[0] @ A1.T - self.yd[1] @ A0.T
        u1 = R1 @ self.F1.T - (self.u1[0] + self.u1[1]) @ self.Ks.T

        e, (e1, e2), (v1, v2) = y - yd, self.e, self.u2
        a = e2 @ A0.T + e1 @ A1.T + e @ A2.T + v2 @ B0.T + v1 @ B1.T
        b = e1 @ A0.T + e @ A1.T + a @ A2.T + v1 @ B0.T
        X2 = np.concatenate([e, a, b], axis=-1)
        s = X2 @ self.S.T
        u2 = self.law.step(s) - X2 @ self.K.T

        self.yd = [yd, self.yd[0]]
        self.e = [e, e1]
        self.u1 = [u1, self.u1[0]]
        self.u2 = [u2, v1]
        return u1 + u2, {"s": s, "yd": yd, "u1": u1, "u2": u2}

    def applied(self, u):
        """Store u(k) after its limits."""
        self.law.wind(u - self.u1[0] - self.u2[0])


class Observer:
    """Q Pn^-1 y - Q u of (8.14), with the corrected Q filter of (5.31)-(5.32)."""

    def __init__(self, a, b):
        (self.a1, self.a2), (self.b1, self.b2) = a, b
        x = 1.0 / (CUTOFF * T)
        gain = self.b1 + self.b2
        self.c0 = (0.25 + x * x + x) * gain
        self.c1 = (0.5 - 2.0 * x * x) * gain
        self.c2 = (0.25 + x * x - x) * gain
        self.y = self.u = self.qy = self.qu = (0.0, 0.0)  # k-1, k-2

    def step(self, y):
        top = y + self.a1 * self.y[0] + self.a2 * self.y[1]
        qy = (top - self.c1 * self.qy[0] - self.c2 * self.qy[1]) / self.c0
        top = self.b1 * self.u[0] + self.b2 * self.u[1]
        qu = (top - self.c1 * self.qu[0] - self.c2 * self.qu[1]) / self.c0
        self.y = (y, self.y[0])
        self.qy, self.qu = (qy, self.qy[0]), (qu, self.qu[0])
        return qy - qu

    def applied(self, u):
        self.u = (u, self.u[0])


class NominalSMC:
    """Chapter 8: a PID-SMC per axis, with or without the disturbance observer.

    Readings: the equivalent control (8.33) uses the state of the nominal model, one
    step ahead, and the switching part the measured error; u(k) of the predictors is
    un(k-1); b0 = 0, so (8.39) inverts the numerator by its sum; r(k+2) is extrapolated.
    """

    def __init__(
        self, gains, observer, arx="repaired", alpha_beta=True, with_epsilon=True
    ):
        model = ARX[arx] if isinstance(arx, str) else arx
        self.a1, self.a2 = np.array(model["a"]).T
        self.b1, self.b2 = np.array(model["b"]).T
        self.filter = AlphaBeta() if alpha_beta else Unfiltered()
        self.law = Switching(gains)
        R, Q = np.array(gains["R"]), np.array(gains["Q"])
        self.inverse = Q / (R + Q) / (self.b1 + self.b2)
        self.observer = None
        if observer:
            self.observer = Observer((self.a1, self.a2), (self.b1, self.b2))
        self.with_epsilon = with_epsilon and observer
        self.y1 = self.d1 = 0.0
        self.yn = self.un = (0.0, 0.0)  # k-1, k-2

    def step(self, z, r_next, r):
        a1, a2, b1, b2 = self.a1, self.a2, self.b1, self.b2
        y = self.filter.step(z)
        held = (b1 + b2) * self.un[0]

        yn = -a1 * self.yn[0] - a2 * self.yn[1] + b1 * self.un[0] + b2 * self.un[1]
        ea = yn - r
        eb = -a1 * yn - a2 * self.yn[0] + held - r_next
        d = y - yn
        v1 = (2.0 * r_next - r) + a1 * r_next + a2 * r
        v_eq = a2 * ea - (SLOPE - a1) * eb
        if self.with_epsilon:
            v_eq = v_eq - (2.0 + a1) * d - (a2 - 1.0) * self.d1

        s = SLOPE * (y - r) + (-a1 * y - a2 * self.y1 + held - r_next)
        v = v1 + v_eq + (b1 + b2) * self.law.step(s)
        un = u = self.inverse * v
        w = np.zeros_like(u)
        if self.observer is not None:
            w = self.observer.step(y)
            u = un - w

        self.w = w
        self.y1, self.d1 = y, d
        self.yn, self.un = (yn, self.yn[0]), (un, self.un[0])
        return u, {"s": s, "un": un, "w": w, "yn": yn}

    def applied(self, u):
        """Store u(k) after its limits: un and the observer depend on it."""
        un, (wanted, before) = u + self.w, self.un
        self.law.wind((un - wanted) / (self.inverse * (self.b1 + self.b2)))
        self.un = (un, before)
        if self.observer is not None:
            self.observer.applied(u)


def make_controller(name, **options):
    """Return pid, pid_smc, dob_smc or nominal_smc, with the options of its class."""
    if name == "pid":
        return PID(**options)
    if name == "pid_smc":
        return PIDSMC(**options)
    gains = options.pop("gains", DOB_SMC_GAINS[name])
    return NominalSMC(gains, name == "dob_smc", **options)


def simulate(name, references, noise=None, plant=None, limits=None, **options):
    """Run a controller on the plant (7.53), `plant` the options of `Plant`.

    references [N+1, ..., 3] for N samples, noise [N, ..., 3] adds to the measurement,
    limits (lower, upper) of the commands.
    Returns arrays [N, ..., 3]: y (the plant's output), z (measured), u, and what the
    controller logs, such as the sliding variable s.
    """
    references = np.asarray(references, dtype=float)
    steps, shape = len(references) - 1, references.shape[1:-1]
    plant = Plant(shape, **(plant or {}))
    controller = make_controller(name, **options)
    rows = []
    for k in range(steps):
        y = plant.output()
        z = y if noise is None else y + noise[k]
        u, logged = controller.step(z, references[k + 1], references[k])
        push = u if limits is None else np.clip(u, *limits)
        controller.applied(push)
        plant.push(push)
        row = {"y": y, "z": z, "u": u, **logged}
        rows.append({key: np.broadcast_to(row[key], y.shape) for key in row})
    return {key: np.array([row[key] for row in rows]) for key in rows[0]}


def tracking_rms(y, references):
    """Return the RMS of y(k) - r(k) over the second half, [..., 3]."""
    miss = (y - references[: len(y)])[len(y) // 2 :]
    return np.sqrt(np.mean(miss * miss, axis=0))


def table_sines(seconds=4.0):
    """Return sines of 10 um or urad [N+1, driven axis, 1 / 5 / 10 Hz, axis]."""
    steps = round(seconds / T)
    time = T * np.arange(steps + 1)
    references = np.zeros((steps + 1, 3, 3, 3))
    for column, hertz in enumerate((1.0, 5.0, 10.0)):
        for axis in range(3):
            references[:, axis, column, axis] = 10.0 * np.sin(2 * np.pi * hertz * time)
    return references
