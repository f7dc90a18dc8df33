"""Discrete controllers of thesis Chapters 4 and 5 and a plain PID baseline.

At time k a controller gets z(k), r(k+1), r(k), r(k-1) and returns the command
u(k); it is then told the applied (clipped) u(k) through `applied`.
"""

import math
from dataclasses import dataclass

import numpy as np

from .hysteresis import inverse_trapezoid_step


def q_filter(b, cutoff, rate, corrected=True):
    """Return the denominator (c0, c1, c2) of the Q filter (5.28), cutoff in rad/s.

    Q(z) = (b0 + b1 z^-1 + b2 z^-2) / (c0 + c1 z^-1 + c2 z^-2) with unit DC
    gain (5.29). corrected=True: the bilinear transform puts both poles at
    -cutoff. corrected=False: (5.32) as printed, whose 1 / (w T)^2 terms are
    four times too small.
    """
    wt = cutoff / rate
    b_sum = b[0] + b[1] + b[2]
    if corrected:
        square = 1.0 / (wt * wt)
        middle = 2.0 / (wt * wt)
    else:
        square = 1.0 / (4.0 * wt * wt)
        middle = 1.0 / (2.0 * wt * wt)
    c0 = (0.25 + square + 1.0 / wt) * b_sum
    c1 = (0.5 - middle) * b_sum
    c2 = (0.25 + square - 1.0 / wt) * b_sum
    return c0, c1, c2


@dataclass
class AlphaBeta:
    """alpha-beta filter: position yh and velocity vh estimated from z."""

    alpha: float
    beta: float
    period: float
    yh: float = 0.0
    vh: float = 0.0

    def step(self, z):
        """Predict, then correct with the residual; returns (yh, vh)."""
        prediction = self.yh + self.period * self.vh
        residual = z - prediction
        self.yh = prediction + self.alpha * residual
        self.vh = self.vh + self.beta / self.period * residual
        return self.yh, self.vh

    def applied(self, u):
        """Do nothing: the filter does not use the voltage."""


class Kalman:
    """Fixed-gain filter on x = [y(k), ..., y(k-n+1), d], from z and past inputs.

    model_a, model_b as elsewhere; gain of x. The rest before the start is at zero.
    """

    def __init__(self, model_a, model_b, gain, period):
        n = len(gain) - 1
        self.A = np.zeros((n + 1, n + 1))
        self.A[0, : len(model_a)] = model_a
        self.A[0, n] = self.A[n, n] = 1.0
        for i in range(1, n):
            self.A[i, i - 1] = 1.0
        self.b = np.array(model_b, dtype=float)
        self.u = np.zeros_like(self.b)
        self.gain = np.array(gain, dtype=float)
        self.period = period
        self.x = np.zeros(n + 1)

    def step(self, z):
        """Predict with the inputs, then correct; returns y and (y - y') / T."""
        x = self.A @ self.x
        x[0] += self.b @ self.u
        self.x = x + self.gain * (z - x[0])
        return self.x[0], (self.x[0] - self.x[1]) / self.period

    def applied(self, u):
        """Store u(k), in the unit of the model's input."""
        self.u = np.array([u, *self.u[:-1]])


def make_observer(gains, period):
    """Return the Kalman filter if the gains contain "kalman", else an AlphaBeta."""
    if "kalman" in gains:
        return Kalman(gains["model_a"], gains["model_b"], gains["kalman"], period)
    return AlphaBeta(gains["alpha"], gains["beta"], period)


class PID:
    """Our baseline, not in the thesis: filtered D, back-calculation.

    gains: P, I, D, derivative_filter Tf [s], anti_windup K_aw [1/s]; b and c weigh
    the reference in the proportional and the derivative part, 1 if left out.
    """

    def __init__(self, gains, rate):
        self.gains = gains
        self.period = 1.0 / rate
        self.integral = 0.0
        self.derivative = 0.0
        self.r_prev = self.z_prev = 0.0
        self.saturation = 0.0  # u_applied(k-1) - u_command(k-1)
        self.command = 0.0

    def step(self, z, r_next, r, r_prev):
        """Return u(k) = P (b r - z) + q + D d; arguments as in the module docstring."""
        period = self.period
        b, c = self.gains.get("b", 1.0), self.gains.get("c", 1.0)
        e = r - z
        self.integral += period * self.gains["anti_windup"] * self.saturation
        self.integral += period * self.gains["I"] * e
        weight = period / (period + self.gains["derivative_filter"])
        slope = (c * (r - self.r_prev) - (z - self.z_prev)) / period
        self.derivative += weight * (slope - self.derivative)
        self.r_prev, self.z_prev = r, z
        self.command = self.gains["P"] * (b * r - z) + self.integral
        self.command += self.gains["D"] * self.derivative
        return self.command

    def applied(self, u):
        """Store the difference that back-calculation uses at k + 1."""
        self.saturation = u - self.command


class PIDSMC:
    """Discrete PID-based SMC; variant "smc", "bang-bang", "inversion" or "dob".

    gains: P, I, D (K for "bang-bang"), m, R, Q, alpha, beta, model_a = (a1, a2),
    model_b = (b0, b1, b2); Ke and cutoff for "dob"; hysteresis = (a, b, c) for
    "inversion". Optional q_corrected (default True) chooses the form of the
    Q filter, correction (default 1) weighs veq. All stored values start at zero.
    """

    def __init__(self, variant, gains, rate):
        self.variant = variant
        self.gains = gains
        self.period = 1.0 / rate
        self.observer = make_observer(gains, self.period)
        self.s_sum = 0.0
        self.s_prev = 0.0
        self.w = 0.0  # the disturbance behind the last command
        self.f1 = 0.0  # f(k-1), as produced
        self.f2 = 0.0  # f(k-2)
        self.u1 = 0.0  # u(k-1), as applied
        self.u2 = 0.0  # u(k-2)
        self.u3 = 0.0  # u(k-3)
        self.z1 = 0.0  # z(k-1)
        self.z2 = 0.0  # z(k-2)
        self.qy1 = self.qy2 = 0.0
        self.qu1 = self.qu2 = 0.0
        if variant == "dob":
            self.c = q_filter(
                gains["model_b"],
                gains["cutoff"],
                rate,
                gains.get("q_corrected", True),
            )

    def sliding_mode(self, z, r_next, r, r_prev):
        """Return v(k): v1 of (5.13), veq of (5.17), PID of (5.18).

        State [y, (y(k) - y(k-1)) / T]; F of (5.10) is not needed.
        """
        period = self.period
        a1, a2 = self.gains["model_a"]
        b0 = self.gains["model_b"][0]
        m = self.gains["m"]
        a11, a12 = a1 + a2, -a2 * period
        a21, a22 = (a1 + a2 - 1.0) / period, -a2

        yh, vh = self.observer.step(z)
        e1 = yh - r
        e2 = vh - (r - r_prev) / period
        s = m * e1 + e2

        v1 = (r_next - a1 * r - a2 * r_prev) / b0
        veq = -(m * (a11 * e1 + a12 * e2) + a21 * e1 + a22 * e2)
        veq = self.gains.get("correction", 1.0) * veq / (m * b0 + b0 / period)
        self.s_sum += s
        if self.variant == "bang-bang":
            dv = -self.gains["K"] * ((s > 0.0) - (s < 0.0))
        else:
            dv = -(
                self.gains["P"] * s
                + self.gains["I"] * period * self.s_sum
                + self.gains["D"] * (s - self.s_prev) / period
            )
        self.s_prev = s
        return v1 + veq + dv

    def optimal_inverse(self, v):
        """Return f(k) of (5.23), where b0 belongs to B."""
        b0, b1, b2 = self.gains["model_b"]
        weight = self.gains["Q"] / (self.gains["Q"] + self.gains["R"])
        return weight * (v - b1 / b0 * self.f1 - b2 / b0 * self.f2)

    def observer_term(self, z):
        """Return w(k) of (5.1): Q/(Ke G) z(k) - Q u(k-1), applied u."""
        a1, a2 = self.gains["model_a"]
        b0, b1, b2 = self.gains["model_b"]
        c0, c1, c2 = self.c
        qy = (z - a1 * self.z1 - a2 * self.z2) / self.gains["Ke"]
        qy = (qy - c1 * self.qy1 - c2 * self.qy2) / c0
        qu = b0 * self.u1 + b1 * self.u2 + b2 * self.u3
        qu = (qu - c1 * self.qu1 - c2 * self.qu2) / c0
        self.qy1, self.qy2 = qy, self.qy1
        self.qu1, self.qu2 = qu, self.qu1
        self.z1, self.z2 = z, self.z1
        return qy - qu

    def step(self, z, r_next, r, r_prev):
        """The command u(k), not yet clipped."""
        v = self.sliding_mode(z, r_next, r, r_prev)
        f = self.optimal_inverse(v)
        if self.variant in ("smc", "bang-bang"):
            u = f
        elif self.variant == "inversion":
            a, b, c = self.gains["hysteresis"]
            u = inverse_trapezoid_step(self.f1, self.u1, f, a, b, c)
        else:
            self.w = self.observer_term(z)
            u = f / self.gains["Ke"] - self.w
        self.f1, self.f2 = f, self.f1
        return u

    def applied(self, u):
        """Store the applied voltage u(k)."""
        self.u1, self.u2, self.u3 = u, self.u1, self.u2
        if self.variant == "dob":
            u = self.gains["Ke"] * (u + self.w)
        self.observer.applied(u)


class ModelReference:
    """Model-reference PID-SMC of section 4.5.3.3 for a model of order n.

    gains: P, I, D, m = (m_1, ..., m_{n-1}) with S = [m, 1] on the errors
    e(k-n+1), ..., e(k); R, Q, alpha, beta, model_a = (a_1, ..., a_n), model_b =
    (b_0, b_1, ...), frequency and damping (below 1) of the reference model, and
    inversion: "tikhonov" (default) or "printed" (4.21). Histories hold the value of
    k - i at index i; all start at zero. lead, in samples, moves the reference ahead
    along its next step; 0 if left out.
    """

    def __init__(self, gains, rate):
        self.gains = gains
        self.period = 1.0 / rate
        self.observer = make_observer(gains, self.period)
        # Impulse-invariant difference equation of the zero-order-hold equivalent:
        # y_d(k+1) = p1 y_d(k) + p2 y_d(k-1) + q0 r(k) + q1 r(k-1).
        w, zeta, t = gains["frequency"], gains["damping"], self.period
        decay = math.exp(-zeta * w * t)
        ratio = math.sqrt(1.0 - zeta * zeta)
        cosine, sine = math.cos(ratio * w * t), math.sin(ratio * w * t)
        self.p1, self.p2 = 2.0 * decay * cosine, -decay * decay
        self.q0 = 1.0 - decay * (cosine + zeta / ratio * sine)
        self.q1 = decay * decay + decay * (zeta / ratio * sine - cosine)
        order, lags = len(gains["model_a"]), len(gains["model_b"]) - 1
        self.yd = [0.0] * (max(order, 2) + 1)
        self.r_prev = 0.0
        self.e = [0.0] * order
        self.forward = [0.0] * lags
        self.feedback = [0.0] * lags
        self.s_sum = 0.0
        self.s_prev = 0.0
        self.command = self.wound = 0.0

    def step(self, z, r_next, r, r_prev):
        """Return the command u(k) before clipping; r(k-1) is not used."""
        gains, period = self.gains, self.period
        lead = gains.get("lead", 0.0)
        r = (1.0 - lead) * r + lead * r_next
        a, (b0, *b) = gains["model_a"], gains["model_b"]
        order = len(a)
        q, weight = gains["Q"], gains["R"]
        if gains.get("inversion", "tikhonov") == "tikhonov":
            g = b0 * q / (b0 * b0 * q + weight)
        else:
            g = q / (b0 * (q + weight))

        yh, _ = self.observer.step(z)
        e = [yh - self.yd[0], *self.e][:order]
        yd_next = self.p1 * self.yd[0] + self.p2 * self.yd[1]
        yd_next += self.q0 * r + self.q1 * self.r_prev
        self.r_prev = r

        u1 = yd_next
        for i in range(order):
            u1 -= a[i] * self.yd[i]
        for i in range(len(b)):
            u1 -= b[i] * self.forward[i]
        u1 *= g

        s = e[0]
        pushed = 0.0  # S A_e delta
        for i in range(order):
            pushed += a[i] * e[i]
        for j in range(order - 1):  # m_{j+1} weighs e(k-n+1+j)
            s += gains["m"][j] * e[order - 1 - j]
            pushed += gains["m"][j] * e[order - 2 - j]
        for i in range(len(b)):
            pushed += b[i] * self.feedback[i]
        self.s_sum += s
        u2 = (
            self.wound
            - g * pushed
            - (
                gains["P"] * s
                + gains["I"] * period * self.s_sum
                + gains["D"] * (s - self.s_prev) / period
            )
        )
        self.s_prev = s
        self.e = e
        self.yd = [yd_next, *self.yd[:-1]]
        self.forward = [u1, *self.forward][: len(b)]
        self.feedback = [u2, *self.feedback][: len(b)]
        self.command = u1 + u2
        return self.command

    def applied(self, u):
        """The observer and the back-calculation depend on the limits."""
        self.wound += back_calculated(self, u)
        self.observer.applied(u)


class Continuous:
    """Continuous PID-SMC, sampled: u = -(P s + I int s + D ds/dt), s = m e + de/dt."""

    def __init__(self, gains, rate):
        self.gains = gains
        self.period = 1.0 / rate
        self.observer = make_observer(gains, self.period)
        self.s_sum = 0.0
        self.s_prev = 0.0
        self.command = self.wound = 0.0

    def step(self, z, r_next, r, r_prev):
        """The command u(k), not yet clipped."""
        yh, vh = self.observer.step(z)
        s = self.gains["m"] * (yh - r) + vh - (r - r_prev) / self.period
        self.s_sum += s
        slope = (s - self.s_prev) / self.period
        self.s_prev = s
        total = self.gains["P"] * s + self.gains["I"] * self.period * self.s_sum
        self.command = self.wound - (total + self.gains["D"] * slope)
        return self.command

    def applied(self, u):
        """The observer and the back-calculation depend on the limits."""
        self.wound += back_calculated(self, u)
        self.observer.applied(u)


def back_calculated(controller, u):
    """Return the change of the integral by the clipping of u; anti_windup in 1/s."""
    rate = controller.gains.get("anti_windup", 0.0)
    return controller.period * rate * (u - controller.command)


def make_controller(kind, gains, rate):
    """Return the controller ``kind``: a key of the table below or a PIDSMC variant."""
    kinds = {"pid": PID, "model reference": ModelReference, "continuous": Continuous}
    if kind in kinds:
        return kinds[kind](gains, rate)
    if kind in ("smc", "bang-bang", "inversion", "dob"):
        return PIDSMC(kind, gains, rate)
    raise ValueError(f"unknown kind {kind!r}")
