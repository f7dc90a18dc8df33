"""The loop "three_dof_pid_smc" of the throughput benchmark, for the engines.

It has the output tracking PID sliding-mode controller of a stage with three axes
(thesis, chapter 7, gains for dynamic tracking) with its alpha-beta filter, on the stage
(7.53) of nine states, 500 Hz, float64. Every lane has its own P, I, D for each axis.
The equations are those of oracles/three_dof.py, whose controller runs here as the NumPy
engine. With e = yh - yd, and the state (7.27) of the controller, X2 = [e; a; b],

    a(k) = q(k) + A2 e(k)             q(k+1) = p(k) + A1 e(k) + B1 u2(k)
    b(k) = p(k) + A1 e(k) + A2 a(k)   p(k+1) = A0 e(k) + B0 u2(k)

it stores p and q instead of past e and u2, and S X2 and the equivalent control are sums
of constant matrices times e, q and p, as in loop_three_dof.c.

The result of a lane is the RMS of y(k) - r(k), k = steps//2 ... steps-1, for each axis.
"""

import sys
from pathlib import Path

import numpy as np
from engines import Loop

# Neither the oracles nor the benchmarks are installed.
sys.path.append(str(Path(__file__).resolve().parents[1]))
from oracles import p558, three_dof

T = p558.T
NOMINAL = p558.PID_SMC_GAINS["dynamic"]
NOMINAL_GAINS = np.array([*NOMINAL["P"], *NOMINAL["I"], *NOMINAL["D"]])
NOISE_RMS = 0.0008, 0.013, 0.013  # um, urad, urad


def problem(lanes, steps, seed=0):
    """Return gains [B, 9], reference [B, steps+1, 3] and noise [B, steps, 3].

    P and I within 10 % of the printed ones, D up to 1e-3; every axis follows a sine of
    10 um or urad peak to peak, whose frequency rises from lane to lane.
    """
    rng = np.random.default_rng(seed)
    gains = NOMINAL_GAINS * rng.uniform(0.9, 1.1, (lanes, 9))
    gains[:, 6:] = rng.uniform(0.0, 1e-3, (lanes, 3))
    phase = 2 * np.pi * T * np.arange(steps + 1)
    reference = np.empty((lanes, steps + 1, 3))
    for rows, hertz in zip(reference, np.linspace(1.0, 10.0, lanes), strict=True):
        for axis, factor in enumerate((1.0, 0.7, 0.4)):
            rows[:, axis] = 5.0 * (1.0 - np.cos(factor * hertz * phase))
    noise = rng.standard_normal((lanes, steps, 3))
    noise *= NOISE_RMS
    return gains, reference, noise


def simulate(gains, reference, noise):
    """Return RMS [B, 3]: gains [9, B], reference [T+1, B, 3], noise [T, B, 3]."""
    rows = (np.stack(axes, axis=-1) for axes in np.split(gains, 3))
    drawn = dict(zip("PID", rows, strict=True))
    plant = three_dof.Plant((gains.shape[1],))
    controller = three_dof.PIDSMC({**NOMINAL, **drawn})
    steps = len(noise)
    half, total = steps // 2, 0.0
    for k in range(steps):
        y = plant.output()
        if k >= half:
            total = total + (y - reference[k]) ** 2
        u, _ = controller.step(y + noise[k], reference[k + 1], reference[k])
        plant.push(u)
    return np.sqrt(total / (steps - half))


def design():
    """Return the constants of loop_three_dof.c, in the order of its struct design."""
    controller = three_dof.PIDSMC(NOMINAL)
    Am, Bm, Cm = controller.Am, controller.Bm, controller.Cm
    trace, q0 = np.trace(Am), Cm @ Bm
    yd = [trace, -np.linalg.det(Am), q0, Cm @ Am @ Bm - trace * q0]

    (A0, A1, A2), (B0, B1, _) = controller.A, controller.B
    F1 = controller.F1
    F = [F1, -F1 @ A2, -F1 @ A1, -F1 @ A0]
    ahead = A1 + A2 @ A2  # of e in b; A2 of q, the identity of p
    combined = []
    for rows in (controller.S, -controller.K):
        of_e, of_a, of_b = np.hsplit(rows, 3)
        combined += [of_e + of_a @ A2 + of_b @ ahead, of_a + of_b @ A2, of_b]
    s_e, s_q, _, u_e, u_q, u_p = combined

    A, B, C = zip(*p558.PLANT, strict=True)
    parts = [
        [T, p558.ALPHA, p558.BETA / T, *yd],
        *(A, C, B),
        *(F, controller.Ks),
        *(s_e, s_q, u_e, u_q, u_p),
        *(A0, B0, A1, B1),
    ]
    return np.concatenate([np.ravel(part) for part in parts])


THREE_DOF_PID_SMC = Loop(
    "three_dof_pid_smc",
    "loop_three_dof.c",
    problem,
    simulate,
    one_lane=False,
    axes=(3,),
    design=design,
    few_lanes=("-DGROUP=4",),
)
