"""Closed loop of a controller and the plant: hysteresis, then dynamics."""

import numpy as np

from .control import make_controller
from .hysteresis import clip, exact_step, trapezoid_step

STEPS = {"exact": exact_step, "trapezoid": trapezoid_step}


def closed_loop(
    kind,
    reference,
    plant,
    gains,
    noise=None,
    limits=(-20.0, 120.0),
    rate=20000.0,
):
    """Run N steps for a reference of N + 1 samples, from rest at zero.

    plant: hysteresis = (a, b, c), step = "exact" (default) or "trapezoid",
    p = (p1, p2), g = (g0, g1, g2), delay = extra samples (default 0).
    With f_p(k) = H(u(k)) and d = delay,
    y(k+1) = p1 y(k) + p2 y(k-1) + g0 f_p(k-d) + g1 f_p(k-1-d) + g2 f_p(k-2-d)
    and z(k) = y(k) + noise(k); y(0) = 0. The reference before sample 0 is
    reference[0].

    kind names a controller of `control`, or is one of `survey`, gains then None.

    Returns arrays of length N: displacement y, measured z, voltage u (applied)
    and command (u before clipping).
    """
    r = np.asarray(reference, dtype=float).tolist()
    n = len(r) - 1
    noises = [0.0] * n if noise is None else np.asarray(noise, float).tolist()
    lower, upper = limits
    a, b, c = plant["hysteresis"]
    hysteresis_step = STEPS[plant.get("step", "exact")]
    p1, p2 = plant["p"]
    g0, g1, g2 = plant["g"]
    delay = plant.get("delay", 0)
    made = not isinstance(kind, str)
    controller = kind if made else make_controller(kind, gains, rate)

    u_prev = 0.0
    f_prev = 0.0
    y, y_prev = 0.0, 0.0
    f_past = [0.0] * (delay + 3)  # f_past[i] = f_p(k - i)
    result = {"displacement": [], "measured": [], "voltage": [], "command": []}
    for k in range(n):
        z = y + noises[k]
        r_prev = r[k - 1] if k > 0 else r[0]
        command = controller.step(z, r[k + 1], r[k], r_prev)
        u = clip(command, lower, upper)
        controller.applied(u)

        result["displacement"].append(y)
        result["measured"].append(z)
        result["voltage"].append(u)
        result["command"].append(command)

        f_prev = hysteresis_step(u_prev, f_prev, u, a, b, c)
        u_prev = u
        f_past = [f_prev, *f_past[:-1]]
        y_next = p1 * y + p2 * y_prev
        y_next += g0 * f_past[delay]
        y_next += g1 * f_past[delay + 1]
        y_next += g2 * f_past[delay + 2]
        y, y_prev = y_next, y
    return {name: np.array(values) for name, values in result.items()}


def tracking_rms(displacement, reference):
    """Return the RMS (um) of y(k) - r(k) over the second half of the run."""
    n = len(displacement)
    total = 0.0
    for k in range(n // 2, n):
        total += (float(displacement[k]) - float(reference[k])) ** 2
    return (total / (n - n // 2)) ** 0.5
