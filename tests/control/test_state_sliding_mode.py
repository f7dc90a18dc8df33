"""State-tracking sliding mode control against a loop with SciPy's Riccati solver."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracles import three_dof
from scipy.linalg import block_diag, solve_discrete_are

from piezojax import Feedback, simulate
from piezojax.catalog import p558, p558_control
from piezojax.control import StateSlidingMode, SwitchingPID
from piezojax.core.axes import PerAxis, diagonal, packed
from piezojax.core.feedback import LoopInput
from piezojax.core.system import resolve
from piezojax.dynamics import SecondOrderLag, StateSpace
from piezojax.hardware import Saturation, Sensor

T, SAMPLES, LIMIT = three_dof.T, 400, 12.0
TIME = T * np.arange(SAMPLES + 1)
REFERENCE = np.stack(
    [12.0 * np.sin(2.0 * np.pi * f * TIME) for f in (3.0, 5.0, 2.0)], axis=1
)
NOISE = np.random.default_rng(2).standard_normal((SAMPLES, 3)) * p558.NOISE_RMS
PHI = np.array([[0.9, 0.02, 0.0], [0.0, 0.5, -0.03], [0.01, 0.0, 0.4]])
P, INTEGRAL = np.array([0.5, 1.0, 2.0]), np.array([30.0, 50.0, 40.0])
D = np.full(3, 1e-4)
EFFORT, PROCESS, DRIFT, WINDUP = 0.8, 0.7, 0.2, 5.0
FREQUENCY, DAMPING = 300.0, 0.9


def controller(**changes):
    given = {
        "law": SwitchingPID(*map(diagonal, (P, INTEGRAL, D)), dt=T, anti_windup=WINDUP),
        "model": p558.model("7"),
        "reference_model": PerAxis((SecondOrderLag(FREQUENCY, DAMPING, T),) * 3),
        "reaching": PHI,
        "effort_weight": EFFORT,
        "process": PROCESS,
        "drift": DRIFT,
    }
    return StateSlidingMode(**(given | changes))


class Plain:
    """The controller from its equations; it starts at rest at zero."""

    def __init__(self):
        self.A, self.B, self.C = A, B, C = three_dof.stacked()
        n, q = B.shape
        X = solve_discrete_are(A, B, C.T @ C, EFFORT**2 * np.eye(q))
        self.S = B.T @ X
        self.N = np.linalg.solve(np.eye(n) - A, B)
        self.N = self.N @ np.linalg.inv(C @ self.N)
        self.F = np.block([[A, B], [np.zeros((q, n)), np.eye(q)]])
        self.h = np.hstack([C, np.zeros((q, q))])
        W = block_diag(PROCESS**2 * B @ B.T, DRIFT**2 * np.eye(q))
        V = solve_discrete_are(self.F.T, self.h.T, W, np.eye(q))
        self.K = V @ self.h.T @ np.linalg.inv(self.h @ V @ self.h.T + np.eye(q))
        self.x = np.zeros(n + q)
        self.Am, self.Bm, self.Cm = three_dof.reference_model(FREQUENCY, DAMPING)
        self.w = np.zeros((q, 2))
        self.total = self.last = self.wound = np.zeros(q)

    def step(self, z, r):
        self.x = self.x + self.K @ (z - self.h @ self.x)
        n = len(self.A)
        x, d = self.x[:n], self.x[n:]
        yd = self.w @ self.Cm
        self.w = self.w @ self.Am.T + r[:, None] * self.Bm
        after = self.w @ self.Cm
        s = self.S @ (x - self.N @ yd)
        # S (A x + B (u + d) - N y_d(k+1)) = PHI s, without the law
        moved = self.S @ (self.A @ x - self.N @ after)
        u = np.linalg.solve(self.S @ self.B, PHI @ s - moved) - d
        self.total = self.total + s
        u = u - P * s - INTEGRAL * T * self.total - D * (s - self.last) / T + self.wound
        self.last, self.u = s, u
        return u

    def applied(self, u):
        self.wound = self.wound + T * WINDUP * (u - self.u)
        n = len(self.A)
        self.x = self.F @ self.x + np.concatenate([self.B @ u, np.zeros(len(u))])
        assert self.x.shape == (n + len(u),)


def expected():
    plain, plant, rows = Plain(), three_dof.Plant(()), []
    for k in range(SAMPLES):
        y = plant.output()
        u = plain.step(y + NOISE[k], REFERENCE[k])
        push = np.clip(u, -LIMIT, LIMIT)
        plain.applied(push)
        plant.push(push)
        rows.append((y, u))
    return map(np.array, zip(*rows, strict=True))


def loop_of(controller):
    limits = PerAxis(tuple(Saturation(-LIMIT, LIMIT) for _ in range(3)))
    sensor = PerAxis(tuple(Sensor(rms) for rms in p558.NOISE_RMS))
    return Feedback(controller, p558_control.stage(), limits, sensor)


@jax.jit
def run(loop, start, following, draws):
    inputs = LoopInput(following, draws)
    return packed(simulate(loop, inputs, loop.init(start))[1])


def test_the_loop_equals_the_equations():
    displacement, command = expected()
    draws = tuple(jnp.asarray((NOISE / p558.NOISE_RMS).T))
    found = run(
        loop_of(controller()),
        jnp.asarray(REFERENCE[0]),
        tuple(jnp.asarray(REFERENCE[1:].T)),
        draws,
    )
    assert 0.02 < np.mean(np.abs(command) > LIMIT) < 0.5
    np.testing.assert_allclose(found.displacement, displacement, rtol=0.0, atol=1e-9)
    np.testing.assert_allclose(found.command, command, rtol=0.0, atol=1e-8)


def test_a_start_at_rest_stays_at_rest():
    start = np.array([5.0, -3.0, 2.0])
    zero = (jnp.zeros(SAMPLES),) * 3
    held = tuple(jnp.full(SAMPLES, value) for value in start)
    found = run(loop_of(controller()), jnp.asarray(start), held, zero)
    np.testing.assert_allclose(
        found.displacement, np.broadcast_to(start, (SAMPLES, 3)), rtol=0.0, atol=1e-8
    )


@pytest.mark.parametrize("effort", [1e-3, 1.0, 1e3])
def test_the_motion_on_the_surface_is_stable(effort):
    found = resolve(controller(effort_weight=effort))
    A, B, _ = three_dof.stacked()
    S = np.asarray(found.surface)
    on = A - B @ np.linalg.solve(S @ B, S @ A)
    assert np.abs(np.linalg.eigvals(on)).max() < 1.0


WIDE = StateSpace(np.eye(2) * 0.5, np.ones((2, 1)), np.eye(2), np.zeros((2, 1)), T)
DIRECT = StateSpace(np.eye(3) * 0.5, np.eye(3), np.eye(3), np.eye(3), T)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"model": WIDE}, "the model has 1 inputs and 2 outputs; .* must be equal"),
        ({"model": DIRECT}, "D of the model is not zero"),
        ({"reaching": np.eye(2)}, "reaching is 2 x 2; it must be 3 x 3"),
        (
            {"law": SwitchingPID((1.0, 1.0), 0.0, 0.0, dt=T)},
            "law.proportional is 2 x 2; it must be 3 x 3",
        ),
        ({"effort_weight": 0.0}, "effort_weight .* is 0; .* above 0"),
    ],
)
def test_bad_parameters_are_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        controller(**changes)
