"""Published tuning rules and designs by python-control, for a discrete linear plant.

Nothing here uses piezojax. A plant maps the voltage u(k) to the position y(k); its
``LinearPlant`` is that of a loop that samples, computes and holds. Controllers are
transfer functions from the error (um) to the voltage (V).

Sources: J. G. Ziegler and N. B. Nichols, Trans. ASME 64 (1942), 759; K. J. Astrom and
T. Hagglund, J. Process Control 14 (2004), 635, and Advanced PID Control (2006), chapter
7 (AMIGO); S. Skogestad, J. Process Control 13 (2003), 291 (SIMC). The design with a
phase margin of 60 degrees at a given crossover follows the description of the tuning
in the Control System Toolbox: the phase margin is kept, the crossover is free.
"""

import warnings
from typing import NamedTuple

import control
import numpy as np
from scipy import linalg

FILTER = 8.0
"""Ratio of the derivative time to the time constant of the derivative's filter."""

MARGIN = 60.0
"""Phase margin, degrees."""


class Mode(NamedTuple):
    """Mode of a plant: frequency (Hz), damping ratio, share of the static gain."""

    frequency: float
    damping: float
    share: float = 1.0


class LinearPlant(NamedTuple):
    """Parallel modes, then lags (s), then a delay (samples); ``gain`` in um/V."""

    gain: float
    modes: tuple
    lags: tuple
    delay: int
    dt: float

    def matrices(self):
        """Return A, B, C without the delay, exact for a voltage held between samples.

        A state of a mode that changes from sample k to k + 1 moves y(k + 1).
        """
        size = 2 * len(self.modes) + len(self.lags)
        F, G, output = np.zeros((size, size)), np.zeros(size), np.zeros(size)
        for i, (frequency, damping, share) in enumerate(self.modes):
            w, at = 2.0 * np.pi * frequency, 2 * i
            F[at, at + 1], F[at + 1, at], F[at + 1, at + 1] = w, -w, -2.0 * damping * w
            G[at + 1], output[at] = w, share
        direct = 0.0 if self.modes else 1.0
        for at, lag in enumerate(self.lags, 2 * len(self.modes)):
            F[at], F[at, at], G[at] = output / lag, -1.0 / lag, direct / lag
            output, direct = np.zeros(size), 0.0
            output[at] = 1.0
        whole = np.zeros((size + 1, size + 1))
        whole[:size, :size], whole[:size, size] = F, G
        held = linalg.expm(self.dt * whole)
        return held[:size, :size], held[:size, size], self.gain * output

    def response(self, angle):
        """Return the plant at exp(i angle), angle in rad/sample."""
        A, B, C = self.matrices()
        z = np.exp(1j * angle)
        resolvent = z[:, None, None] * np.eye(len(A)) - A
        found = np.linalg.solve(resolvent, B[:, None] + 0j)[:, :, 0] @ C
        return found * z**-self.delay

    def step_response(self, samples):
        """Return y(1), y(2), ... after a step of 1 V at sample 0."""
        A, B, C = self.matrices()
        x, found = np.zeros(len(A)), np.zeros(samples + self.delay)
        for k in range(samples):
            x = A @ x + B
            found[k + self.delay] = C @ x
        return found[:samples]

    def grid(self, lines=1500):
        """Return angles up to the Nyquist frequency, dense around the modes."""
        side = np.geomspace(0.02, 30.0, 60)
        around = np.concatenate([-side[::-1], [0.0], side])
        near = [2 * np.pi * self.dt * f * (1.0 + z * around) for f, z, _ in self.modes]
        every = np.concatenate([np.geomspace(1e-4, np.pi, lines), *near])
        return np.unique(every[(every > 5e-5) & (every < np.pi)])


class PID(NamedTuple):
    """``K (1 + 1 / (Ti s) + Td s / (1 + Td s / FILTER))``: V/um, s, s."""

    gain: float
    integral_time: float
    derivative_time: float = 0.0

    def gains(self):
        """Return P, I, D and the time constant of the derivative's filter."""
        K, Ti, Td = self
        return K, K / Ti, K * Td, Td / FILTER


def pid_response(angle, dt, proportional, integral, derivative, filter_time):
    """Return a sampled PID: rectangular integral, derivative of the filtered error."""
    back = np.exp(-1j * angle)
    share = dt / (dt + filter_time)
    slope = derivative * share / dt * (1.0 - back) / (1.0 - (1.0 - share) * back)
    return proportional + integral * dt / (1.0 - back) + slope


def notch_response(angle, dt, frequency, damping, depth):
    """Return a notch by the bilinear transform, prewarped at its frequency (Hz)."""
    ratio = np.tan(0.5 * angle) / np.tan(np.pi * frequency * dt)
    rest, damped = 1.0 - ratio**2, 2j * damping * ratio
    return (rest + depth * damped) / (rest + damped)


# Rules


class FirstOrder(NamedTuple):
    """Model ``gain exp(-delay s) / (1 + lag s)``: um/V, s, s."""

    gain: float
    lag: float
    delay: float


def first_order(step, dt):
    """Return the model of a step response, as Astrom and Hagglund (2004) do.

    The delay is where the steepest tangent leaves the start, the lag the time from
    there to 63 % of the final value.
    """
    final = float(step[-1])
    y = np.concatenate([[0.0], step]) / final
    slope = np.gradient(y)
    at = int(np.argmax(slope))
    delay = max(at - y[at] / slope[at], 0.0)
    above = int(np.argmax(y >= 1.0 - np.exp(-1.0)))
    reached = above - (y[above] - 1.0 + np.exp(-1.0)) / (y[above] - y[above - 1])
    return FirstOrder(final, max(reached - delay, 1e-3) * dt, max(delay, 0.5) * dt)


def amigo_pi(model):
    """Return the PI of AMIGO."""
    K, T, L = model
    gain = 0.15 / K + (0.35 - L * T / (L + T) ** 2) * T / (K * L)
    time = 0.35 * L + 13.0 * L * T**2 / (T**2 + 12.0 * L * T + 7.0 * L**2)
    return PID(gain, time)


def amigo_pid(model):
    """Return the PID of AMIGO."""
    K, T, L = model
    return PID(
        (0.2 + 0.45 * T / L) / K,
        (0.4 * L + 0.8 * T) / (L + 0.1 * T) * L,
        0.5 * L * T / (0.3 * L + T),
    )


def simc_pi(model, closed=None):
    """Return the PI of SIMC; ``closed`` is the time constant of the closed loop, s.

    By default it is the delay.
    """
    K, T, L = model
    wanted = L if closed is None else closed
    return PID(T / (K * (wanted + L)), min(T, 4.0 * (wanted + L)))


def simc_pid(model, closed=None):
    """Return the improved SIMC of Grimholt and Skogestad (2018), with a derivative.

    Its derivative time is a third of the delay, in the series form.
    """
    K, Ti, _ = simc_pi(model, closed)
    Td = model.delay / 3.0
    return PID(K * (1.0 + Td / Ti), Ti + Td, Td / (1.0 + Td / Ti))


def ultimate(plant, angle, response):
    """Return the ultimate gain (V/um) and period (s) of a proportional loop."""
    phase = np.unwrap(np.angle(response))
    first = int(np.argmax(phase <= -np.pi))
    share = (phase[first - 1] + np.pi) / (phase[first - 1] - phase[first])
    at = angle[first - 1] + share * (angle[first] - angle[first - 1])
    size = np.interp(at, angle, np.abs(response))
    return 1.0 / size, 2.0 * np.pi * plant.dt / at


def ziegler_nichols_pi(gain, period):
    """Return the PI of Ziegler and Nichols, from the ultimate gain and period."""
    return PID(0.45 * gain, period / 1.2)


def ziegler_nichols_pid(gain, period):
    """Return the PID of Ziegler and Nichols, from the ultimate gain and period."""
    return PID(0.6 * gain, period / 2.0, period / 8.0)


def phase_margin_pid(response, pulsation, margin=MARGIN):
    """Return the PID with this phase margin (degrees) at a crossover (rad/s).

    ``response`` is that of the plant there. It is a PI if that suffices, else a PID
    with Ti = 4 Td; None if neither has enough phase.
    """
    wanted = np.radians(margin) - np.pi - np.angle(response)
    wanted = (wanted + np.pi) % (2.0 * np.pi) - np.pi
    size = 1.0 / abs(response)
    if -np.radians(85.0) < wanted < -np.radians(5.0):
        ratio = np.tan(-wanted)  # 1 / (w Ti)
        return PID(size / np.hypot(1.0, ratio), 1.0 / (pulsation * ratio))
    if not -np.radians(5.0) <= wanted < np.radians(65.0):
        return None
    slope = np.tan(wanted)
    Td = 0.5 * (slope + np.hypot(slope, 1.0)) / pulsation
    return PID(size / np.hypot(1.0, slope), 4.0 * Td, Td)


# Designs by python-control


def lqg_response(plant, angle, effort, noise):
    """Return the LQG controller with an integrator, by ``control.dlqr`` and ``dlqe``.

    ``effort`` weights the voltage against the integral of the error, ``noise`` is the
    variance of the measurement over that of a disturbance of the voltage.
    """
    A, B, C = plant.matrices()
    for _ in range(plant.delay):  # the voltage passes one state each sample
        size = len(A)
        A = np.block([[A, B[:, None]], [np.zeros((1, size + 1))]])
        B, C = np.eye(size + 1)[-1], np.append(C, 0.0)
    size = len(A)
    C = C / plant.gain  # in shares of the voltage
    whole = np.block([[A, np.zeros((size, 1))], [-C[None], np.ones((1, 1))]])
    Q = np.zeros((size + 1, size + 1))
    Q[-1, -1] = 1.0
    K = control.dlqr(whole, np.append(B, 0.0)[:, None], Q, [[effort]])[0][0]
    G = control.dlqe(A, B[:, None], C[None], [[1.0]], [[noise]])[0]
    z = np.exp(1j * angle)
    F = A - G @ C[None] - np.outer(B, K[:size])
    # x+ = F x + G y - B K_i q,  u = -K x - K_i q,  q+ = q - y,  for y = -error.
    resolvent = z[:, None, None] * np.eye(size) - F
    q = -1.0 / (z - 1.0)
    drive = G.T - B[None] * (K[-1] * q)[:, None]
    x = np.linalg.solve(resolvent, drive[:, :, None])[:, :, 0]
    return (x @ K[:size] + K[-1] * q) / plant.gain


def h_infinity_response(plant, angle, bandwidth, effort):
    """Return the mixed-sensitivity controller of ``control.mixsyn``; needs slycot.

    The weights are ``(s / 2 + w) / (s + 1e-4 w)`` on S, with the ``bandwidth`` w in
    rad/s, and ``effort`` on the voltage in shares of the position. The delay is a Pade
    approximation, the controller is sampled by the bilinear transform.
    """
    s = control.tf("s")
    G = control.ss(control.tf([1.0], [1.0]))
    for i, (frequency, damping, share) in enumerate(plant.modes):
        w = 2.0 * np.pi * frequency
        mode = control.ss(share * w**2 / (s**2 + 2.0 * damping * w * s + w**2))
        G = G + mode if i else mode
    for lag in plant.lags:
        G = G * control.ss(1.0 / (1.0 + lag * s))
    delay = (plant.delay + 0.5) * plant.dt
    G = G * control.ss(control.tf(*control.pade(delay, 3)))
    of_error = control.ss((0.5 * s + bandwidth) / (s + 1e-4 * bandwidth))
    with warnings.catch_warnings():
        # python-control uses a function of its own that it deprecates.
        warnings.simplefilter("ignore", FutureWarning)
        K = control.mixsyn(G, of_error, control.ss([], [], [], [[effort]]))[0]
    sampled = control.c2d(K, plant.dt, "tustin")
    A, B, C, D = sampled.A, sampled.B[:, 0], sampled.C[0], sampled.D[0, 0]
    resolvent = np.exp(1j * angle)[:, None, None] * np.eye(len(A)) - A
    x = np.linalg.solve(resolvent, B[:, None] + 0j)[:, :, 0]
    return (x @ C + D) / plant.gain


# Judgement


def limited_gain(L, limit):
    """Return the largest factor on L up to which Ms is at most ``limit``.

    At a line where |1 + k L| = 1 / limit, k is the root of a quadratic equation. The
    least of all lines is the first gain above the limit; all lower ones are stable,
    because L is that of a stable plant with an integrator.
    """
    square = np.abs(L) ** 2
    under = L.real**2 - square * (1.0 - limit**-2)
    inside = (L.real < 0.0) & (under > 0.0)
    root = np.sqrt(np.maximum(under, 0.0))
    return float(np.min(np.where(inside, (-L.real - root) / square, np.inf)))


def peak(L):
    """Return Ms on the grid of L."""
    return float(np.max(1.0 / np.abs(1.0 + L)))


def is_stable(angle, L):
    """Return whether a loop with one pole of L at 1 and all others inside is stable.

    (z - 1) (1 + L) is positive at z = 1 and turns by half a circle along the upper half
    of the unit circle.
    """
    turn = np.unwrap(np.angle((np.exp(1j * angle) - 1.0) * (1.0 + L)))
    return bool(abs(turn[-1] - np.pi) < 0.5)


def error(loop_at, references, amplitude, noise, dt):
    """Return the rms error, the geometric mean over periodic references.

    ``loop_at(angle)`` returns L. A reference is "SIN" or "TRI" with its frequency in
    Hz, from 0 to twice the ``amplitude``; ``noise`` is the rms value of the sensor.
    """
    every = (np.arange(2000) + 0.5) * np.pi / 2000
    L = loop_at(every)
    of_noise = noise**2 * np.mean(np.abs(L / (1.0 + L)) ** 2)
    found = []
    for name in references:
        frequency = float(name[3:])
        n = np.arange(1, int(0.5 / (dt * frequency)), 2)
        if name[:3] == "SIN":
            n, heights = np.ones(1), amplitude * np.ones(1)
        else:
            heights = 8.0 * amplitude / (np.pi * n) ** 2
        L = loop_at(2.0 * np.pi * dt * frequency * n)
        square = np.sum(0.5 * np.abs(heights / (1.0 + L)) ** 2)
        found.append(np.sqrt(square + of_noise))
    return float(np.exp(np.mean(np.log(found))))
