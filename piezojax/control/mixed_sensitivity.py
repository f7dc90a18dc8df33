"""Discrete-time H-infinity control of a linear stage by mixed sensitivity."""

from typing import NamedTuple

import numpy as np
from scipy import linalg

from ..core.arrays import check
from ..dynamics.arma import ARMA
from ..dynamics.state_space import StateSpace
from .state_space_controller import StateSpaceController

GAMMA_TOLERANCE = 1e-3
"""Relative tolerance of gamma above its infimum."""


class Design(NamedTuple):
    """A controller, and gamma, a bound of the H-infinity norm of its weighted loop."""

    controller: StateSpaceController
    gamma: float


class _Plant(NamedTuple):
    """Generalised plant x' = A x + B [w, u], z = C x + D [w, u], y = w - measured x."""

    A: np.ndarray
    B: np.ndarray
    C: np.ndarray
    D: np.ndarray
    measured: np.ndarray


def mixed_sensitivity(
    model: ARMA,
    error_weight: StateSpace,
    effort_weight: float,
    output_weight: StateSpace | None = None,
    *,
    dt: float,
) -> Design:
    """Return the controller that minimises the H-infinity norm of the weighted loop.

    ``model`` G maps u(k) to y(k+1) in um. At all frequencies up to the Nyquist
    frequency, |W1 S|^2 + |W2 K S|^2 + |W3 T|^2 < gamma^2, with S = 1/(1 + G K) and
    T = 1 - S, W1 = ``error_weight``, W2 = ``effort_weight``, a number above 0 in um per
    unit of the input, and W3 = ``output_weight``, 0 if left out. Bisection brings
    gamma within 0.1 % of its infimum. The controller has the states of the model and of
    the weights.

    The reference r enters the error without a filter, so the error determines r. The
    second of the two Riccati equations, for the estimator (Glover and Doyle, 1988; in
    discrete time Green and Limebeer, 1995, appendix B), then has the solution zero if
    the model and the weights are stable: an integrator in W1 must be leaky. Raises
    ValueError for an unstable model or weight, weights that are not scalar or have
    another ``dt``, an effort weight that is not above 0, and if no controller is found.
    """
    check("sample time in s", dt, above=0.0)
    check("effort_weight", effort_weight, above=0.0)
    weights = {"error_weight": error_weight}
    if output_weight is not None:
        weights["output_weight"] = output_weight
    for name, weight in weights.items():
        if weight.B.shape[1] != 1 or weight.C.shape[0] != 1:
            raise ValueError(f"{name} must have one input and one output")
        if weight.dt != dt:
            raise ValueError(f"{name} has dt = {weight.dt:g} s; it must be {dt:g} s")
        _check_stable(name, weight.poles())
    _check_stable("the model", model.poles())
    plant = _augmented(model, error_weight, effort_weight, output_weight)

    upper = 1.0
    while (best := _controller(plant, upper, dt)) is None:
        upper *= 2.0
        if upper > 1e12:
            raise ValueError("no controller exists for any gamma up to 1e12")
    lower = 0.0
    while upper - lower > GAMMA_TOLERANCE * upper:
        middle = 0.5 * (lower + upper)
        controller = _controller(plant, middle, dt)
        if controller is None:
            lower = middle
        else:
            upper, best = middle, controller
    return Design(best, upper)


def first_order_weight(
    low: float, crossover: float, high: float, dt: float
) -> StateSpace:
    """Return a weight with gain ``low`` at 0, 1 at ``crossover``, ``high`` above it.

    Gains without unit, one above 1 and the other below; ``crossover`` in rad/s, below
    pi/dt, exact after the bilinear transform. Raises ValueError for other values.
    """
    check("sample time in s", dt, above=0.0)
    check("crossover in rad/s", crossover, above=0.0, below=np.pi / dt)
    check("gains low and high", (low, high), above=0.0)
    if (low - 1.0) * (high - 1.0) >= 0.0:
        raise ValueError(
            f"low is {low:g} and high {high:g}; one must be above 1, the other below"
        )
    # (high s + low p) / (s + p), s = (z - 1) / (z + 1) scaled to meet at the crossover.
    warped = np.tan(0.5 * crossover * dt)
    p = warped * np.sqrt((1.0 - high**2) / (low**2 - 1.0))
    pole = (1.0 - p) / (1.0 + p)
    direct = (high + low * p) / (1.0 + p)
    through = low * (1.0 - pole) - direct * (1.0 - pole)
    return StateSpace([[pole]], [[1.0]], [[through]], [[direct]], dt)


def _check_stable(name: str, poles: np.ndarray) -> None:
    radius = np.abs(poles).max(initial=0.0)
    if radius >= 1.0:
        raise ValueError(
            f"{name} has a pole of modulus {radius:g}; all must be below 1"
        )


def _augmented(
    model: ARMA, error: StateSpace, effort: float, output: StateSpace | None
) -> _Plant:
    """Return the generalised plant with the states of G, W1 and W3."""
    a, b = map(np.array, (model.autoregressive, model.moving))
    n = max(a.size, b.size)
    G = np.eye(n, k=1)
    G[: a.size, 0] += a
    drive = np.zeros((n, 1))
    drive[: b.size, 0] = b
    y = np.eye(1, n)
    # Each weight with its input: w - y, or y.
    weighted = [(error, 1.0, -y)] + ([] if output is None else [(output, 0.0, y)])
    blocks = [np.asarray(weight.A) for weight, _, _ in weighted]
    A = np.asarray(linalg.block_diag(G, *blocks))
    size = A.shape[0]
    B = np.zeros((size, 2))
    B[:n, 1:] = drive
    C = np.zeros((len(weighted) + 1, size))
    D = np.zeros((len(weighted) + 1, 2))
    D[-1, 1] = effort
    first = n
    for row, (weight, reference, states) in enumerate(weighted):
        rows = slice(first, first + weight.order)
        A[rows, :n] = np.asarray(weight.B) @ states
        B[rows, :1] = reference * np.asarray(weight.B)
        C[row, rows] = np.asarray(weight.C)[0]
        C[row, :n] = (np.asarray(weight.D) @ states)[0]
        D[row, 0] = reference * float(weight.D[0, 0])
        first = rows.stop
    measured = np.zeros((1, size))
    measured[:, :n] = y
    return _Plant(A, B, C, D, measured)


def _controller(plant: _Plant, gamma: float, dt: float) -> StateSpaceController | None:
    """Return the central controller for ``gamma``, or None if there is none."""
    A, B, C, D, measured = plant
    R = D.T @ D - np.diag([gamma**2, 0.0])
    try:
        X = linalg.solve_discrete_are(A, B, C.T @ C, R, s=C.T @ D)
    except np.linalg.LinAlgError:
        return None
    S = R + B.T @ X @ B
    cross = B.T @ X @ A + D.T @ C
    # Saddle-point conditions: a minimum over u and a maximum over w.
    if S[1, 1] <= 0.0 or S[0, 0] - S[0, 1] ** 2 / S[1, 1] >= 0.0:
        return None
    if np.linalg.eigvalsh(X).min() < -1e-8 * np.abs(X).max():
        return None
    closed = A - B @ linalg.solve(S, cross)
    if np.abs(np.linalg.eigvals(closed)).max() >= 1.0:
        return None
    # u = F x + f w, where w = y + measured x and the controller simulates x.
    F, f = -cross[1:] / S[1, 1], -S[1, 0] / S[1, 1]
    F = F + f * measured
    inner = A + B[:, :1] @ measured + B[:, 1:] @ F
    return StateSpaceController(
        StateSpace(inner, B[:, :1] + f * B[:, 1:], F, [[f]], dt)
    )
