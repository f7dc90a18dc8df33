"""Discrete forms of y' = |x'| (a x + c y) + b x', c < 0: equation (3.5).

Every sequence function maps x[0 .. N-1] to y[0 .. N-1]. Sample k steps from
x[k-1] to x[k]; sample 0 steps from (x_init, y_init) to x[0]. The direction is
s = +1 if x(k+1) >= x(k), else -1.
"""

import itertools
import math

import numpy as np


def trapezoid_step(x0, y0, x1, a, b, c):
    """Return y(k + 1) by (3.8) rising, (3.14)-(3.16) falling."""
    s = 1.0 if x1 >= x0 else -1.0
    dx = x1 - x0
    square = x1 * x1 - x0 * x0
    return (s * a * square + (2.0 + s * c * dx) * y0 + 2.0 * b * dx) / (
        2.0 - s * c * dx
    )


def exact_step(x0, y0, x1, a, b, c):
    """Return the solution of (3.5) on the monotone branch from x0 to x1 (c not zero).

    On a branch dy/dx = s (a x + c y) + b, whose particular solution is
    y = p x + q, p = -a/c, q = (p - b) / (s c); the rest decays as
    exp(s c (x1 - x0)).
    """
    s = 1.0 if x1 >= x0 else -1.0
    p = -a / c
    q = (p - b) / (s * c)
    return p * x1 + q + (y0 - p * x0 - q) * math.exp(s * c * (x1 - x0))


def quadratic_step(x_prev, y_prev, x0, y0, x1, a, b, c):
    """Return y(k+1) by (3.21)-(3.24), for two increments of one sign.

    q1, q2, q3 are c times the weights of y(k-1), y(k), y(k+1) in the integral
    over [x(k), x(k+1)] of the parabola through the three points: (3.18) and
    (3.19) with the explicit matrix inverse. (3.20) as printed is wrong;
    the form used here is (1 - s q3) y(k+1) = ... + (1 + s q2) y(k).
    """
    s = 1.0 if x1 >= x0 else -1.0
    d0 = x0 - x_prev
    d1 = x1 - x0
    q1 = -c * d1 * d1 * d1 / (6.0 * d0 * (d0 + d1))
    q2 = c * d1 * (d1 + 3.0 * d0) / (6.0 * d0)
    q3 = c * d1 * (2.0 * d1 + 3.0 * d0) / (6.0 * (d0 + d1))
    square = x1 * x1 - x0 * x0
    return (s * a / 2.0 * square + b * d1 + s * q1 * y_prev + (1.0 + s * q2) * y0) / (
        1.0 - s * q3
    )


def voros_step(x0, y0, x1, a, b, c):
    """Return y(k+1) by the explicit (2.11): f, g and y are those of sample k.

    y(k+1) = y(k) + (a x(k) + c y(k)) |x(k+1) - x(k)| + b (x(k+1) - x(k)),
    which is (2.11) with alpha f[x] = a x, g[x] = b and alpha = -c.
    """
    dx = x1 - x0
    return y0 + (a * x0 + c * y0) * abs(dx) + b * dx


def inverse_trapezoid_step(f0, u0, f1, a, b, c):
    """Return u(k+1) for which the trapezoid step from (u0, f0) gives f1; no limits.

    (5.24) for f1 > f0, (5.25) for f1 < f0, both with the corrected
    2 [f(k+1) - f(k)] in zeta; u0 again if f1 = f0. a must be positive.
    """
    if f1 > f0:
        eta = c * (f1 + f0) + 2.0 * b
        zeta = a * u0 * u0 + eta * u0 + 2.0 * (f1 - f0)
        return (-eta + math.sqrt(eta * eta + 4.0 * a * zeta)) / (2.0 * a)
    if f1 < f0:
        eta = -c * (f1 + f0) + 2.0 * b
        zeta = -a * u0 * u0 + eta * u0 + 2.0 * (f1 - f0)
        return (eta - math.sqrt(eta * eta - 4.0 * a * zeta)) / (2.0 * a)
    return u0


def clip(value, lower, upper):
    """Return the value limited to [lower, upper]."""
    return max(lower, min(upper, value))


def _run(step, x, a, b, c, x_init, y_init):
    """Apply a one-step rule along the sequence x."""
    x0 = float(x_init)
    y0 = float(y_init)
    outputs = []
    for x1 in np.asarray(x, dtype=float).tolist():
        y0 = step(x0, y0, x1, a, b, c)
        x0 = x1
        outputs.append(y0)
    return np.array(outputs)


def trapezoid(x, a, b, c, x_init=0.0, y_init=0.0):
    """Return y by the trapezoid rule (3.8), (3.14)-(3.16)."""
    return _run(trapezoid_step, x, a, b, c, x_init, y_init)


def exact(x, a, b, c, x_init=0.0, y_init=0.0):
    """Return the exact solution of (3.5) for x monotone between samples."""
    return _run(exact_step, x, a, b, c, x_init, y_init)


def voros(x, a, b, c, x_init=0.0, y_init=0.0):
    """Return y by the explicit model of Voros (2.11).

    Output k is y[k] = y[k-1] + (a x[k-1] + c y[k-1]) |x[k] - x[k-1]|
    + b (x[k] - x[k-1]), with x[-1] = x_init and y[-1] = y_init.
    """
    return _run(voros_step, x, a, b, c, x_init, y_init)


def quadratic(x, a, b, c, x_init=0.0, y_init=0.0):
    """Return y by the rule (3.21)-(3.24), or the trapezoid (3.26)-(3.29).

    A step is quadratic only if it and the step before it are both nonzero
    and of one sign. The first step (x_init to x[0]) is a trapezoid step.
    """
    x_prev, y_prev = None, None
    x0, y0 = float(x_init), float(y_init)
    outputs = []
    for x1 in np.asarray(x, dtype=float).tolist():
        d1 = x1 - x0
        d0 = 0.0 if x_prev is None else x0 - x_prev
        same_sign = (d0 > 0.0 and d1 > 0.0) or (d0 < 0.0 and d1 < 0.0)
        if same_sign:
            y1 = quadratic_step(x_prev, y_prev, x0, y0, x1, a, b, c)
        else:
            y1 = trapezoid_step(x0, y0, x1, a, b, c)
        x_prev, y_prev = x0, y0
        x0, y0 = x1, y1
        outputs.append(y1)
    return np.array(outputs)


def inverse_trapezoid(f, a, b, c, f_init, u_init, lower=-20.0, upper=120.0):
    """Return u by the corrected (5.24), (5.25) along f[0 .. N-1], each u clipped.

    The next step starts from the clipped u(k) and the commanded f(k), even
    if f(k) was not reached because of clipping.
    """
    f0 = float(f_init)
    u0 = float(u_init)
    outputs = []
    for f1 in np.asarray(f, dtype=float).tolist():
        u0 = clip(inverse_trapezoid_step(f0, u0, f1, a, b, c), lower, upper)
        f0 = f1
        outputs.append(u0)
    return np.array(outputs)


def play(x, threshold, start):
    """Return the output of a play of half-width `threshold` for x, from `start`."""
    w, out = start, []
    for value in x:
        if value - w > threshold:
            w = value - threshold
        elif value - w < -threshold:
            w = value + threshold
        out.append(w)
    return np.array(out)


def shaped_trapezoid(x, pull, slope, c, y_init):
    """Return y of y' = |x'| (p(x) + c y) + g(x) x' along x from (x[0], y_init).

    Polynomials with the lowest power first; their integrals are exact, that of y is the
    trapezoid rule: (1 - s c dx/2) y1 = (1 + s c dx/2) y0 + s [P] + [G].
    """
    big_p = np.polynomial.Polynomial(pull).integ()
    big_g = np.polynomial.Polynomial(slope).integ()
    y = [y_init]
    for x0, x1 in itertools.pairwise(x):
        s = 1.0 if x1 >= x0 else -1.0
        h = 0.5 * s * c * (x1 - x0)
        force = s * (big_p(x1) - big_p(x0)) + big_g(x1) - big_g(x0)
        y.append((force + (1.0 + h) * y[-1]) / (1.0 - h))
    return np.array(y)


def stop(x, threshold, start):
    """Return the force of a spring and slider, +-`threshold`, unloaded at `start`."""
    held, before, out = 0.0, start, []
    for value in x:
        held += value - before
        if abs(held) > threshold:
            held = math.copysign(threshold, held)
        before = value
        out.append(held)
    return np.array(out)


def inverse_prandtl_ishlinskii(f, slope, thresholds, weights, rest):
    """Return the inverse of slope x + sum w play(x) by Krejci and Kuhnen (2001).

    Plays of f with the thresholds sum_{j<=i} w_j (r_i - r_j), where r_0 = 0 and w_0 is
    the slope, and the weights 1/w_0 and -w_i / (W_i W_{i-1}), W_i = sum_{j<=i} w_j.
    """
    r, w = [0.0, *thresholds], [slope, *weights]
    x = np.asarray(f) / slope
    for i in range(1, len(r)):
        reach = sum(w[j] * (r[i] - r[j]) for j in range(i + 1))
        total = sum(w[: i + 1])
        x = x - w[i] / (total * sum(w[:i])) * play(f, reach, sum(w) * rest)
    return x


def rate_dependent_plays(x, thresholds, growth, dt, start):
    """Return plays whose half-width grows with the rate of the previous sample."""
    columns = [[start] * len(thresholds)]
    rate, before = 0.0, x[0]
    for value in x:
        row = []
        for r, w in zip(thresholds, columns[-1], strict=True):
            width = r + growth * abs(rate)
            row.append(clip(w, value - width, value + width))
        columns.append(row)
        rate, before = (value - before) / dt, value
    return np.array(columns[1:])
