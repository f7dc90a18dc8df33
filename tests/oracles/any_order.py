"""PID-based sliding mode control on a model of any order, by the matrices of ch. 5.

The state (5.3) is [y, Dy, D2y, ...], D the difference over a sample, so that every
matrix has numbers near 1; s is divided by the sample time at the end.
"""

from math import comb

import numpy as np

from .control import make_observer
from .hysteresis import inverse_trapezoid_step


class AnyOrder:
    """Variant "smc", "inversion" or "dob" of (5.13)-(5.23) and (5.26)-(5.32).

    gains as for `control.PIDSMC`, with model_a = (a_1, ..., a_n) and model_b =
    (b_0, b_1, ...); optional anti_windup, 1/s. All stored values start at zero.
    """

    def __init__(self, variant, gains, rate):
        self.variant, self.gains, self.period = variant, gains, 1.0 / rate
        self.observer = make_observer(gains, self.period)
        n = len(gains["model_a"])
        companion = np.eye(n, k=-1)
        companion[0] = gains["model_a"]
        # x = M [y(k), y(k-1), ...]
        M = np.array([[(-1) ** j * comb(i, j) for j in range(n)] for i in range(n)])
        m = gains["m"] * self.period
        self.M = M.astype(float)
        self.A = M @ companion @ np.linalg.inv(M)
        self.B = M @ (gains["model_b"][0] * np.eye(n)[0])
        scale = m ** (2 - n) / self.period
        self.S = scale * np.array([comb(n - 1, i) * m ** (n - 1 - i) for i in range(n)])
        self.rates = np.zeros(max(n - 1, 1))  # D yh as estimated, newest first
        self.r = None  # r(k), r(k-1), ...
        self.s_sum = self.s_prev = self.wound = 0.0
        self.f = np.zeros(len(gains["model_b"]))  # f(k-1), f(k-2), ..., as produced
        self.u_last = self.f_last = 0.0
        self.shortfall = 0.0
        if variant == "dob":
            b = np.array(gains["model_b"])
            size = max(n, b.size - 1) + 1
            x = rate / gains["cutoff"]
            c = np.ones(1)
            for _ in range(size - 1):
                c = np.convolve(c, [0.5 + x, 0.5 - x])
            self.c = c * b.sum()
            self.b = np.pad(b, (0, size - b.size))
            self.a = np.pad([1.0, *(-x for x in gains["model_a"])], (0, size - n - 1))
            self.z, self.u, self.w = np.zeros((3, size))

    def sliding_mode(self, z, r_next):
        """Return v(k): v1 of (5.13), v_eq of (5.17), PID of (5.18)."""
        gains, T = self.gains, self.period
        n = len(self.B)
        yh, vh = self.observer.step(z)
        self.rates = np.array([vh * T, *self.rates])[: max(n - 1, 1)]
        x, rates = [yh], self.rates[: n - 1]
        while rates.size:
            x.append(rates[0])
            rates = rates[:-1] - rates[1:]
        following = np.array([r_next, *self.r])
        xd, xd_next = self.M @ self.r, self.M @ following[:-1]
        pseudo = self.B / (self.B @ self.B)
        v1 = pseudo @ (xd_next - self.A @ xd)
        e = np.array(x) - xd
        s = self.S @ e
        veq = -(self.S @ self.A @ e) / (self.S @ self.B)
        self.s_sum += s
        dv = gains["P"] * s + gains["I"] * T * self.s_sum
        dv += gains["D"] * (s - self.s_prev) / T
        self.s_prev = s
        self.r = following[:-1]
        return v1 + veq + self.wound - dv

    def optimal_inverse(self, v):
        """Return f(k) of (5.23), where b0 belongs to B."""
        b = np.array(self.gains["model_b"])
        weight = self.gains["Q"] / (self.gains["Q"] + self.gains["R"])
        f = weight * (v - b[1:] / b[0] @ self.f[: b.size - 1])
        self.f = np.array([f, *self.f[:-1]])
        return f

    def observer_term(self, z):
        """Return w(k) of (5.1): C(1/z) w = A(1/z) z / Ke - B(1/z) u(k-1), applied u."""
        self.z = np.array([z / self.gains["Ke"], *self.z[:-1]])
        self.w = np.array([0.0, *self.w[:-1]])
        self.w[0] = (self.a @ self.z - self.b @ self.u - self.c @ self.w) / self.c[0]
        return self.w[0]

    def step(self, z, r_next, r, r_prev):
        """Return u(k) before clipping; the reference is constant before k = 0."""
        gains = self.gains
        if self.r is None:
            self.r = np.full(len(self.B), r_prev)
            self.r[0] = r
        share = gains["Q"] / (gains["Q"] + gains["R"])
        rate = gains.get("anti_windup", 0.0)
        self.wound += self.period * rate * self.shortfall / share
        f = self.optimal_inverse(self.sliding_mode(z, r_next))
        self.command = f
        if self.variant == "inversion":
            return inverse_trapezoid_step(
                self.f_last, self.u_last, f, *gains["hysteresis"]
            )
        return f if self.variant == "smc" else f / gains["Ke"] - self.observer_term(z)

    def applied(self, u):
        """Store the applied voltage u(k)."""
        if self.variant == "inversion":
            self.f_last, self.u_last = self.command, u
            force = self.command
        elif self.variant == "dob":
            self.u = np.array([u, *self.u[:-1]])
            force = self.gains["Ke"] * (u + self.w[0])
        else:
            force = u
        self.shortfall = force - self.command
        self.observer.applied(force)
