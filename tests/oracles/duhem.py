"""Differential hysteresis x' = F(x, u) u' + G(x, u) |u'|, branch by branch."""

import itertools
import math

import numpy as np
from scipy.integrate import solve_ivp


def along(corners, x0, rising, falling):
    """Return x at every corner: dx/du on each branch by an adaptive solver.

    `rising(x, u)` and `falling(x, u)` are dx/du. Branches are not split at x = 0: the
    tolerance suffices.
    """
    x = [x0]
    for start, stop in itertools.pairwise(corners):
        slope = rising if stop >= start else falling
        if stop == start:
            x.append(x[-1])
            continue
        branch = solve_ivp(
            lambda u, y, slope=slope: [slope(y[0], u)],
            (start, stop),
            [x[-1]],
            method="DOP853",
            rtol=1e-12,
            atol=1e-13,
        )
        x.append(branch.y[0, -1])
    return np.array(x)


def kutta(path, x0, reversible, irreversible):
    """Return x by the classical fourth-order rule, one step per sample, from x0."""
    out, x = [], x0
    for u0, u1 in itertools.pairwise([path[0], *path]):
        du = u1 - u0

        def k(x, u, du=du):
            return reversible(x, u) * du + irreversible(x, u) * abs(du)

        k1 = k(x, u0)
        k2 = k(x + k1 / 2, u0 + du / 2)
        k3 = k(x + k2 / 2, u0 + du / 2)
        k4 = k(x + k3, u1)
        x += (k1 + 2 * k2 + 2 * k3 + k4) / 6
        out.append(x)
    return np.array(out)


def bounded(corners, rho, sigma, n, w0=0.0):
    """Return w of the normalised Bouc-Wen model, (2.5), at every corner."""

    def slope(direction):
        def of(w, _):
            power = abs(w) ** n
            bend = sigma * direction * math.copysign(1.0, w) * power
            return rho * (1.0 - bend + (sigma - 1.0) * power)

        return of

    return along(corners, w0, slope(1.0), slope(-1.0))
