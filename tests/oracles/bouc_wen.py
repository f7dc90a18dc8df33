"""Bouc-Wen hysteresis and the oscillator of the benchmark, from their equations.

    z' = alpha y' - beta (gamma |y'| |z|^(nu - 1) z + delta y' |z|^nu)
    m y'' + c y' + k y + z = u

Noel & Schoukens, Hysteretic benchmark with a dynamic nonlinearity, 2016.
"""

import math

import numba
import numpy as np
from scipy.integrate import solve_ivp

BENCHMARK = {
    "mass": 2.0,
    "damping": 10.0,
    "stiffness": 5e4,
    "alpha": 5e4,
    "beta": 1e3,
    "gamma": 0.8,
    "delta": -1.1,
    "nu": 1.0,
}
"""The published true values, SI units."""


def force_after(displacement, force, target, alpha, beta_gamma, beta_delta, nu):
    """Return the force at `target` on a monotone path, by an adaptive solver."""
    direction = 1.0 if target >= displacement else -1.0

    def slope(_, z):
        power = abs(z[0]) ** nu
        sign = math.copysign(1.0, z[0])
        return [alpha - (beta_gamma * direction * sign + beta_delta) * power]

    branch = solve_ivp(
        slope, (displacement, target), [force], "DOP853", rtol=1e-11, atol=1e-13
    )
    return branch.y[0, -1]


def branch_of_unit_nu(change, force, alpha, beta_gamma, beta_delta):
    """Return the force after `change`, nu = 1, on a branch of constant sign of z.

    dz/dy = alpha - k z with k = beta_gamma s + beta_delta sign(z), s that of dy.
    """
    toward = math.copysign(1.0, force) if force else math.copysign(1.0, alpha * change)
    k = beta_gamma * math.copysign(1.0, change) + beta_delta * toward
    limit = alpha / k
    return limit + (force - limit) * math.exp(-k * change)


@numba.njit
def slopes(y, v, z, u, mass, damping, stiffness, alpha, beta, gamma, delta, nu):
    magnitude = abs(z)
    inner = 0.0 if magnitude == 0.0 else magnitude ** (nu - 1.0) * z
    loop = gamma * abs(v) * inner + delta * v * magnitude**nu
    return v, (u - damping * v - stiffness * y - z) / mass, alpha * v - beta * loop


@numba.njit
def _heun(u, dt, mass, damping, stiffness, alpha, beta, gamma, delta, nu):
    p = (mass, damping, stiffness, alpha, beta, gamma, delta, nu)
    y, v, z = 0.0, 0.0, 0.0
    out = np.empty(u.size)
    for i in range(u.size):
        out[i] = y
        following = u[(i + 1) % u.size]
        a0, b0, c0 = slopes(y, v, z, u[i], *p)
        a1, b1, c1 = slopes(y + dt * a0, v + dt * b0, z + dt * c0, following, *p)
        y += 0.5 * dt * (a0 + a1)
        v += 0.5 * dt * (b0 + b1)
        z += 0.5 * dt * (c0 + c1)
    return out


def steady_displacement(force, dt, parameters, finer=256, periods=2):
    """Return the steady displacement over one period of a band-limited `force`.

    `force` is interpolated to `finer` samples per sample by its Fourier series; Heun's
    rule on that grid starts at rest; the last of `periods` periods counts.
    """
    samples = force.size
    spectrum = np.zeros(finer * samples // 2 + 1, complex)
    coarse = np.fft.rfft(force)
    spectrum[: coarse.size] = coarse
    fine = finer * np.fft.irfft(spectrum, finer * samples)
    y = _heun(np.tile(fine, periods), dt / finer, *parameters.values())
    return y[-fine.size :: finer]


def multisine(samples, lines, deviation, seed):
    """Return a random-phase multisine with equal amplitudes at the given lines."""
    phases = 2.0 * np.pi * np.random.default_rng(seed).random(len(lines))
    spectrum = np.zeros(samples // 2 + 1, complex)
    spectrum[lines] = np.exp(1j * phases)
    signal = np.fft.irfft(spectrum, samples)
    return deviation * signal / signal.std()
