"""Pole placement of the sliding variable, (4.14)-(4.18)."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracles import signals
from oracles.any_order import AnyOrder
from oracles.loop import closed_loop
from oracles.published import plant_t2, smc_gains

from piezojax import simulate
from piezojax.catalog import p753, p753_survey
from piezojax.control import PlacedPID
from piezojax.core.feedback import LoopInput

DT, DRIVE = 1e-3, 0.4
POLES = {"apart": (0.9, 0.3, -0.2), "at zero": (0.0, 0.0, 0.0), "slow": (0.99, 0.9, 0)}


def solved(poles, drive, dt):
    """Return P, I, D of (4.18) with the corrected right-hand side."""
    g2, g1, g0 = np.poly(poles)[1:]
    H = np.array([[1, dt, 1 / dt], [1, 0, 2 / dt], [0, 0, 1 / dt]]) * drive
    return np.linalg.solve(H, [1.0 + g2, -g1, g0])


@pytest.mark.parametrize("name", POLES)
def test_the_gains_solve_the_equation(name):
    pid = PlacedPID(POLES[name], DRIVE, DT).placed()
    found = pid.proportional, pid.integral, pid.derivative
    np.testing.assert_allclose(found, solved(POLES[name], DRIVE, DT), atol=1e-9)


@pytest.mark.parametrize("name", POLES)
def test_the_sliding_variable_has_the_poles(name):
    # s(k+1) = drive v(k) + a step of phi at k = 0 (4.16): a response of order 3.
    law = PlacedPID(POLES[name], DRIVE, DT)
    state, s, found = law.init(0.0), jnp.zeros(()), []
    for k in range(12):
        found.append(float(s))
        state, v = law.step(state, s)
        s = DRIVE * v + (1.0 if k >= 2 else 0.0)
    expected = np.zeros(12)
    p = np.poly(POLES[name])
    for k in range(3, 12):
        expected[k] = (k == 3) - p[1:] @ expected[k - 3 : k][::-1]
    np.testing.assert_allclose(found, expected, rtol=0.0, atol=1e-12)


def test_the_catalogued_loop_equals_the_equations():
    controller = p753_survey.pole_placement()
    law = controller.law
    gains = smc_gains("smc", "5-3")
    gains |= zip("PID", solved(law.poles, float(law.drive), p753.DT), strict=True)
    assert gains["I"] == pytest.approx(60.0, rel=0.02)
    reference = signals.ten_references()["SIN50"][:2_001]
    draws = np.random.default_rng(1).normal(size=2_000)

    @jax.jit
    def run(loop, reference):
        return simulate(loop, LoopInput(reference[1:], draws), loop.init(0.0))[1]

    found = run(p753.loop(controller), jnp.asarray(reference))
    expected = closed_loop(
        AnyOrder("smc", gains, 20e3),
        reference,
        plant_t2("trapezoid"),
        None,
        noise=0.012 * draws,
    )
    for column, values in expected.items():
        np.testing.assert_allclose(
            getattr(found, column), values, rtol=0.0, atol=1e-9, err_msg=column
        )


@pytest.mark.parametrize(
    ("poles", "message"),
    [
        ((0.5, 0.1), "poles holds 2 numbers; it must hold 3"),
        ((1.1, 0.1, 0.1), "poles is 1.1; it must be finite and above -1 and at most 1"),
    ],
)
def test_other_poles_are_refused(poles, message):
    with pytest.raises(ValueError, match=message):
        PlacedPID(poles, DRIVE, DT)
