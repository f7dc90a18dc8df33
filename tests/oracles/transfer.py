"""Loop transfer functions from the equations.

Polynomials in p = z^-1, lowest power first; the critical point is -1.
"""

import control
import numpy as np

from .control import q_filter


def times(*factors):
    result = np.ones(1)
    for factor in factors:
        result = np.convolve(result, factor)
    return result


def plus(*terms):
    size = max(len(term) for term in terms)
    return sum(np.pad(np.asarray(t, float), (0, size - len(t))) for t in terms)


def transfer(numerator, denominator, period):
    size = max(len(numerator), len(denominator))
    num = np.pad(numerator, (0, size - len(numerator)))
    den = np.pad(denominator, (0, size - len(denominator)))
    return control.tf(np.trim_zeros(num, "f"), den, period)


def plant(a, b, gain=1.0, delay=1):
    """Return gain p^delay (b0 + b1 p + ..) / (1 - a1 p - ..) from u to y."""
    return gain * np.concatenate([np.zeros(delay), b]), np.array(
        [1.0, *(-x for x in a)]
    )


def pid_loop(proportional, integral, derivative, filter_time, period, num, den):
    """Return L for u = P e + I T sum e + D d, where d is the filtered slope of e."""
    smooth = period / (period + filter_time)
    ends, lag = np.array([1.0, -1.0]), np.array([1.0, -(1.0 - smooth)])
    top = plus(
        proportional * times(ends, lag),
        integral * period * lag,
        derivative * smooth / period * times(ends, ends),
    )
    return transfer(times(top, num), times(ends, lag, den), period)


def disturbance_observer_loop(gains, period, num, den):
    """Return L(z) for u = f / Ke - w, with f of (5.17), (5.18), (5.23).

    It is a function of z: expanded, the many factors near z = 1 would lose digits.
    """
    alpha, beta, m = gains["alpha"], gains["beta"], gains["m"]
    a1, a2 = gains["model_a"]
    b0, b1, b2 = gains["model_b"]
    c0, c1, c2 = q_filter(gains["model_b"], gains["cutoff"], 1.0 / period)
    weight = gains["Q"] / (gains["Q"] + gains["R"])

    def at(z):
        p = 1.0 / z
        # Cramer's rule on the two equations of the alpha-beta filter.
        below = (1 - (1 - alpha) * p) * (1 - (1 - beta) * p)
        below = below + (1 - alpha) * beta * p**2
        yh = (alpha * (1 - (1 - beta) * p) + (1 - alpha) * beta * p) / below
        vh = beta / period * (1 - p) / below
        s = m * yh + vh
        ahead = m * ((a1 + a2) * yh - a2 * period * vh)
        ahead = ahead + (a1 + a2 - 1) / period * yh - a2 * vh
        v = -ahead / (m * b0 + b0 / period)
        pid = gains["P"] + gains["I"] * period / (1 - p)
        v = v - (pid + gains["D"] * (1 - p) / period) * s
        f = weight * v / (1 + weight * (b1 * p + b2 * p**2) / b0)
        q = 1 / (c0 + c1 * p + c2 * p**2)
        # u = f / Ke - q (A z / Ke - p B u)
        through = (f - q * (1 - a1 * p - a2 * p**2)) / gains["Ke"]
        own = q * (b0 * p + b1 * p**2 + b2 * p**3)
        stage = np.polyval(num[::-1], p) / np.polyval(den[::-1], p)
        return -through / (1 - own) * stage

    return at
