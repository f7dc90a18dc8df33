"""The rules of rule_designs.py give published numbers, and its judgement is right."""

import importlib
import sys
from pathlib import Path

import control
import numpy as np
import pytest
from scipy import signal

# The benchmark is a script beside its modules, not a package.
sys.path.insert(0, str(Path(__file__).parent))
rules = importlib.import_module("rule_designs")

FAST = 1e-2
"""Sample time (s) at which a plant with lags of 1 s is nearly continuous."""

FOUR_LAGS = rules.LinearPlant(1.0, (), (1.0,) * 4, 0, FAST)
"""1/(s + 1)^4, example 2 of Astrom and Hagglund (2004)."""

MODEL = rules.FirstOrder(1.0, 2.9, 1.42)
"""Its model there."""


def test_model_of_a_step_response():
    found = rules.first_order(FOUR_LAGS.step_response(4000), FAST)
    np.testing.assert_allclose(found, MODEL, rtol=0.02)


def test_amigo():
    """K = 0.414 and Ti = 2.66 for PI; K = 1.12, Ti = 2.40, Td = 0.619 for PID."""
    np.testing.assert_allclose(rules.amigo_pi(MODEL)[:2], (0.414, 2.66), rtol=2e-3)
    np.testing.assert_allclose(rules.amigo_pid(MODEL), (1.12, 2.40, 0.619), rtol=2e-3)


def test_simc():
    """1/((s + 1)(0.2 s + 1)), case E1 of Skogestad (2003): Kc = 5.5, Ti = 0.8."""
    halved = rules.FirstOrder(1.0, 1.0 + 0.2 / 2.0, 0.2 / 2.0)
    np.testing.assert_allclose(rules.simc_pi(halved)[:2], (5.5, 0.8), rtol=1e-12)
    # In series form the derivative of a third of the delay leaves Kc and Ti.
    K, Ti, Td = rules.simc_pid(halved)
    share = 0.5 * (1.0 + np.sqrt(1.0 - 4.0 * Td / Ti))
    series = K * share, Ti * share, Td / share
    np.testing.assert_allclose(series, (5.5, 0.8, 0.1 / 3.0), rtol=1e-12)


def test_ultimate_gain_of_four_lags():
    """1/(i + 1)^4 = -1/4 at 1 rad/s; the hold delays by half a sample."""
    angle = FOUR_LAGS.grid()
    gain, period = rules.ultimate(FOUR_LAGS, angle, FOUR_LAGS.response(angle))
    assert gain == pytest.approx(4.0, rel=0.02)
    assert period == pytest.approx(2.0 * np.pi, rel=0.01)
    np.testing.assert_allclose(
        rules.ziegler_nichols_pid(8.0, 4.0), (4.8, 2.0, 0.5), rtol=1e-12
    )
    np.testing.assert_allclose(
        rules.ziegler_nichols_pi(8.0, 6.0)[:2], (3.6, 5.0), rtol=1e-12
    )


@pytest.mark.parametrize("degrees", [-80.0, -120.0, -150.0])
def test_phase_margin(degrees):
    """The continuous PID times the plant is 1 with a phase of -120 degrees."""
    plant, w = 0.3 * np.exp(1j * np.radians(degrees)), 7.0
    K, Ti, Td = rules.phase_margin_pid(plant, w)
    L = plant * K * (1.0 + 1.0 / (1j * w * Ti) + 1j * w * Td)
    assert pytest.approx(np.exp(-1j * np.radians(120.0)), abs=1e-9) == L
    assert Td == pytest.approx(0.0 if degrees > -100.0 else Ti / 4.0)
    assert rules.phase_margin_pid(-1.0 + 0j, w) is not None
    assert rules.phase_margin_pid(1j, w) is None


STAGE = rules.LinearPlant(
    0.1,
    (rules.Mode(3000.0, 0.7, 0.6), rules.Mode(800.0, 0.01, 0.4)),
    (2e-4,),
    2,
    1e-4,
)


def test_response_of_a_stage_is_that_of_python_control():
    s = control.tf("s")
    modes = sum(
        share
        * (2 * np.pi * f) ** 2
        / (s**2 + 4 * np.pi * f * z * s + (2 * np.pi * f) ** 2)
        for f, z, share in STAGE.modes
    )
    sampled = control.c2d(control.ss(0.1 * modes / (1.0 + 2e-4 * s)), 1e-4, "zoh")
    angle = np.array([1e-3, 0.1, 0.5, 0.503, 1.0, 3.0])
    expected = sampled(np.exp(1j * angle)) * np.exp(-2j * angle)
    np.testing.assert_allclose(STAGE.response(angle), expected, rtol=1e-6)
    step = STAGE.step_response(3000)
    assert step[-1] == pytest.approx(0.1, rel=1e-3)
    assert step[:2].tolist() == [0.0, 0.0]


def test_controllers_are_those_of_the_difference_equations():
    """A PID and a notch, stepped sample by sample, on a sine of 0.3 rad/sample."""
    P, Ki, D, Tf, dt = 0.7, 300.0, 1e-4, 2e-4, 1e-4
    error = np.exp(0.3j * np.arange(4000))
    integral, rate, before, command = 0.0, 0.0, 0.0, np.empty(4000, complex)
    for k, e in enumerate(error):
        integral += Ki * dt * e
        rate += dt / (dt + Tf) * ((e - before) / dt - rate)
        before, command[k] = e, P * e + integral + D * rate
    # What the integral holds of the start is constant.
    response = np.diff(command)[-1] / np.diff(error)[-1]
    found = rules.pid_response(np.array([0.3]), dt, P, Ki, D, Tf)
    assert found[0] == pytest.approx(response, rel=1e-9)
    w = 2.0 / dt * np.tan(np.pi * 800.0 * dt)
    b, a = signal.bilinear([1.0, 0.06 * w, w**2], [1.0, 0.6 * w, w**2], 1.0 / dt)
    _, expected = signal.freqz(b, a, [0.4])
    found = rules.notch_response(np.array([0.4]), dt, 800.0, 0.3, 0.1)
    assert found[0] == pytest.approx(expected[0], rel=1e-9)


def test_limit_on_the_sensitivity_peak():
    angle = STAGE.grid()
    L = rules.pid_response(angle, 1e-4, 0.0, 100.0, 0.0, 1e-4) * STAGE.response(angle)
    factor = rules.limited_gain(L, 1.8)
    assert rules.peak(factor * L) == pytest.approx(1.8, rel=1e-9)
    assert rules.is_stable(angle, factor * L)


def test_stability_is_that_of_the_closed_loop_poles():
    plant = STAGE._replace(delay=0)
    A, B, C = plant.matrices()
    angle, dt = plant.grid(), plant.dt
    response = plant.response(angle)
    stable = []
    for gain in np.geomspace(10.0, 1e4, 20):
        # q+ = q - dt C x,  x+ = A x + B gain q+
        closed = np.block(
            [
                [A - gain * dt * np.outer(B, C), gain * B[:, None]],
                [-dt * C[None], np.ones((1, 1))],
            ]
        )
        stable.append(np.abs(np.linalg.eigvals(closed)).max() < 1.0)
        L = rules.pid_response(angle, dt, 0.0, gain, 0.0, 1e-4) * response
        assert rules.is_stable(angle, L) == stable[-1]
    assert stable[0]
    assert not stable[-1]


def test_error_of_a_loop_is_that_of_its_samples():
    """y(k + 1) = u(k), integral control, and noise on the measurement."""
    dt, gain, noise = 1e-3, 0.2, 0.05
    time = dt * np.arange(40_000)
    random = np.random.default_rng(1)
    references = {
        "SIN10": 1.0 - np.cos(2.0 * np.pi * 10.0 * time),
        "TRI20": 1.0 - signal.sawtooth(2.0 * np.pi * 20.0 * time + np.pi, 0.5),
    }
    rms = []
    for reference in references.values():
        y, u, squares = 0.0, 0.0, []
        for r, n in zip(
            reference, noise * random.standard_normal(time.size), strict=True
        ):
            squares.append((r - y) ** 2)
            u += gain * (r - y - n)
            y = u
        rms.append(np.sqrt(np.mean(squares[2000:])))

    def loop_at(angle):
        return gain / (1.0 - np.exp(-1j * angle)) * np.exp(-1j * angle)

    found = rules.error(loop_at, [*references], 1.0, noise, dt)
    assert found == pytest.approx(np.sqrt(rms[0] * rms[1]), rel=0.01)


def test_lqg_is_stable_and_integrates():
    angle = STAGE.grid()
    C = rules.lqg_response(STAGE, angle, 1e3, 1e-2)
    assert rules.is_stable(angle, C * STAGE.response(angle))
    # An integrator: the gain rises as the frequency falls.
    assert abs(C[0]) == pytest.approx(abs(C[4]) * angle[4] / angle[0], rel=0.02)
