"""Surveyed control schemes as plain loops, at rest at zero before the first step.

Each has step(z, r_next, r, r_prev) and applied(u), as in `control`.
"""

import math

from .control import PID, AlphaBeta
from .hysteresis import inverse_trapezoid_step


class BoundaryLayer:
    """-K sat(s / width)."""

    def __init__(self, gain, width):
        self.gain, self.width = gain, width

    def step(self, s):
        if abs(s) >= self.width:
            return -math.copysign(self.gain, s)
        return -self.gain * s / self.width


class SuperTwisting:
    """w - k1 s / (s^2 + d^2)^(1/4); w decreases by T k2 s / (s^2 + d^2)^(1/2)."""

    def __init__(self, root, sign, layer, period):
        self.root, self.sign, self.layer = root, sign, layer
        self.period = period
        self.w = 0.0

    def step(self, s):
        smooth = s / math.hypot(s, self.layer)
        self.w -= self.period * self.sign * smooth
        return self.w - self.root * math.copysign(math.sqrt(abs(s * smooth)), s)


class Switched:
    """v1 + veq + law(s), inverted with Q / (Q + R); equations as in chapter 4."""

    def __init__(self, law, gains, period):
        self.law, self.gains, self.period = law, gains, period
        self.observer = AlphaBeta(gains["alpha"], gains["beta"], period)
        self.f1 = self.f2 = 0.0

    def step(self, z, r_next, r, r_prev):
        gains, period = self.gains, self.period
        a1, a2 = gains["model_a"]
        b0, b1, b2 = gains["model_b"]
        m = gains["m"]
        yh, vh = self.observer.step(z)
        e1, e2 = yh - r, vh - (r - r_prev) / period
        v = (r_next - a1 * r - a2 * r_prev) / b0
        push = m * ((a1 + a2) * e1 - a2 * period * e2)
        push += (a1 + a2 - 1.0) / period * e1 - a2 * e2
        v -= push / (m * b0 + b0 / period)
        v += self.law.step(m * e1 + e2)
        weight = gains["Q"] / (gains["Q"] + gains["R"])
        f = weight * (v - b1 / b0 * self.f1 - b2 / b0 * self.f2)
        self.f1, self.f2 = f, self.f1
        return f

    def applied(self, u):
        """Do nothing: the controller does not depend on the limits."""


class Feedforward:
    """Inverse trapezoid hysteresis of r(k+1), plus a PID unless None."""

    def __init__(self, hysteresis, pid_gains, rate):
        self.hysteresis = hysteresis
        self.pid = None if pid_gains is None else PID(pid_gains, rate)
        self.f = self.u = 0.0

    def step(self, z, r_next, r, r_prev):
        self.u = inverse_trapezoid_step(self.f, self.u, r_next, *self.hysteresis)
        self.f = r_next
        if self.pid is None:
            return self.u
        return self.u + self.pid.step(z, r_next, r, r_prev)

    def applied(self, u):
        if self.pid is not None:
            self.pid.applied(u - self.u)


class Repetitive:
    """Any controller with the reference r + w, with complete histories.

    w(k+1) = p w(k) + (1 - p) x(k+1-N+advance), x(k) = w(k) + gain e(k + lead), with
    x zero before the errors that make it.
    """

    def __init__(self, inner, gain, pole, period, lead, advance):
        self.inner, self.gain, self.pole = inner, gain, pole
        self.delay, self.lead = period - advance, lead
        self.w = [0.0]
        self.e = []

    def step(self, z, r_next, r, r_prev):
        w, k = self.w, len(self.e)
        self.e.append(r - z)
        i = k + 1 - self.delay
        x = (w[i] if i >= 0 else 0.0) + (
            self.gain * self.e[i + self.lead] if i + self.lead >= 0 else 0.0
        )
        w.append(self.pole * w[k] + (1.0 - self.pole) * x)
        before = w[k - 1] if k > 0 else 0.0
        return self.inner.step(z, r_next + w[k + 1], r + w[k], r_prev + before)

    def applied(self, u):
        self.inner.applied(u)
