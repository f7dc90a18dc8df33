"""Records of a stage with one mode under feedback, in NumPy and SciPy alone.

The stage is a mode with a held input (matrix exponential); a PID, also behind a notch,
acts on the error within its sample; the noise adds to the output. With the response K
of the controller, the spectra of excitation and noise give in closed form what a
spectral estimate from u to y tends to (``naive_response``).
"""

from typing import NamedTuple

import numpy as np
import scipy.linalg
import scipy.signal

RATE = 10_000.0
DT = 1.0 / RATE
FREQUENCY, DAMPING, GAIN = 800.0, 0.03, 0.1
"""Mode of the stage: Hz, 1, um/V."""


class Gains(NamedTuple):
    """PID in V/um, V/(um s), V s/um; filter of D in s; notch in Hz, or None."""

    proportional: float
    integral: float
    derivative: float = 0.0
    smooth: float = 0.0
    notch: float | None = None


CONTROLLERS = {
    "slow PI": Gains(0.2, 2 * np.pi * 15.0 / GAIN),
    "fast PID": Gains(0.5, 2 * np.pi * 80.0 / GAIN, 2.5e-4, 2e-5),
    "PI with notch": Gains(1.0, 2 * np.pi * 80.0 / GAIN, notch=800.0),
}
NOTCH_DAMPING, NOTCH_DEPTH = 0.5, 0.1


def stage(frequency=FREQUENCY, damping=DAMPING, gain=GAIN):
    """Return A [2, 2], B [2] and C [2] of the mode, from u(k) to y(k+1)."""
    w = 2 * np.pi * frequency
    system = np.zeros((3, 3))
    system[:2] = [[0.0, 1.0, 0.0], [-(w**2), -2 * damping * w, w**2 * gain]]
    held = scipy.linalg.expm(system * DT)
    return held[:2, :2], held[:2, 2], np.array([1.0, 0.0])


def stage_response(frequency, *mode):
    """Return the response from u(k) to y(k) at frequencies in Hz; ``stage(*mode)``."""
    A, B, C = stage(*mode)
    z = np.exp(2j * np.pi * np.asarray(frequency) * DT)
    return np.array([C @ np.linalg.solve(x * np.eye(2) - A, B) for x in z])


def sections(gains):
    """Return numerator and denominator of each filter of the controller, in series."""
    i, d = gains.integral * DT, gains.derivative / DT
    share = DT / (DT + gains.smooth)
    # P + I z / (z - 1) + D share (z - 1) / (z - (1 - share)), in powers of 1/z.
    integrator, slope = np.array([1.0, -1.0]), np.array([1.0, share - 1.0])
    top = (
        gains.proportional * np.polymul(integrator, slope)
        + i * np.r_[slope, 0.0]
        + d * share * np.polymul(integrator, integrator)
    )
    found = [(top, np.polymul(integrator, slope))]
    if gains.notch:
        w = 2 * np.pi * gains.notch
        inner = NOTCH_DEPTH * NOTCH_DAMPING
        warped = 2 * RATE * np.tan(w * DT / 2) / w
        b = [1.0, 2 * inner * w, w**2]
        a = [1.0, 2 * NOTCH_DAMPING * w, w**2]
        # Prewarped bilinear transform.
        scale = warped / (2 * RATE)
        found.append(scipy.signal.bilinear(b, a, fs=1.0 / (2.0 * scale)))
    return found


def controller_response(gains, frequency):
    """Return the response from the error to the command at frequencies in Hz."""
    z = np.exp(-2j * np.pi * np.asarray(frequency) * DT)
    total = np.ones(z.size, complex)
    for b, a in sections(gains):
        total *= np.polyval(b[::-1], z) / np.polyval(a[::-1], z)
    return total


def run(gains, reference, dither, noise):
    """Return u (V) and the measured y (um) of the loop, from rest."""
    A, B, C = stage()
    filters = [(np.asarray(b) / a[0], np.asarray(a) / a[0]) for b, a in sections(gains)]
    states = [np.zeros(len(a) - 1) for _, a in filters]
    x = np.zeros(2)
    u, y = np.empty(reference.size), np.empty(reference.size)
    for k in range(reference.size):
        y[k] = C @ x + noise[k]
        value = reference[k] - y[k]
        for (b, a), state in zip(filters, states, strict=True):
            out = b[0] * value + state[0]
            state[:-1] = state[1:]
            state[-1] = 0.0
            state += b[1:] * value - a[1:] * out
            value = out
        u[k] = value + dither[k]
        x = A @ x + B * u[k]
    return u, y


def open_run(input, noise):
    """Return the measured y (um) of the stage alone, from rest."""
    A, B, C = stage()
    x, y = np.zeros(2), np.empty(input.size)
    for k in range(input.size):
        y[k] = C @ x + noise[k]
        x = A @ x + B * input[k]
    return y


HUM = 0.85 * np.exp(0.25j * np.pi)
NOISE_FILTER = np.real(np.poly([0.97, HUM, HUM.conj()]))
"""Denominator of the noise: slow vibration and a hum at 1250 Hz, of white noise."""


def noise(draw, samples, size):
    """Return coloured noise [samples] of white noise of the rms ``size``."""
    white = size * draw.standard_normal(samples + 500)
    return scipy.signal.lfilter([1.0], NOISE_FILTER, white)[500:]


def noise_spectrum(frequency, size):
    """Return the power of ``noise`` at frequencies in Hz, per line of white noise 1."""
    z = np.exp(-2j * np.pi * np.asarray(frequency) * DT)
    return size**2 / np.abs(np.polyval(NOISE_FILTER[::-1], z)) ** 2


def naive_response(gains, frequency, reference, dither, size):
    """Return what a spectral estimate from u to y tends to.

    ``reference`` and ``dither`` are the rms values of white excitations, ``size`` that
    of the white noise behind ``noise``.
    """
    K = controller_response(gains, frequency)
    driven = np.abs(K) ** 2 * reference**2 + dither**2
    spectrum = noise_spectrum(frequency, size)
    G = stage_response(frequency)
    return (G * driven - K.conj() * spectrum) / (driven + np.abs(K) ** 2 * spectrum)
