"""The plain loops of chapters 7 and 8 against independent figures."""

import numpy as np
import pytest
from oracles import three_dof
from oracles.three_dof import T

from piezojax.catalog import p558

HYSTERESIS = {"weight": 0.02, "radius": 4.0}
"""The assumed hysteresis of the stage, about 1 % of 10 um or urad."""

# RMS of the driven axis, 10 um or urad at 1, 5 and 10 Hz in Z, Rx and Ry, from another
# simulation of the same readings on a stage with 1 % of hysteresis and sensor noise.
ELSEWHERE = {
    "PID": [0.359, 1.712, 3.127, 0.526, 2.291, 4.086, 0.473, 2.164, 4.046],
    "PID +1": [0.359, 1.738, 3.305, 0.526, 2.337, 4.382, 0.473, 2.205, 4.342],
    "SMC ab": [0.045, 0.594, 1.294, 0.165, 0.774, 1.783, 0.205, 0.986, 2.241],
    "SMC": [0.150, 0.606, 1.108, 0.209, 0.983, 2.056, 0.251, 1.214, 2.559],
    "SMC +1": [0.121, 0.983, 2.155, 0.250, 1.218, 2.634, 0.290, 1.430, 3.090],
    "DOB": [0.083, 0.274, 0.387, 0.085, 0.471, 1.870, 0.080, 0.268, 1.983],
    "nominal": [0.107, 0.376, 1.083, 0.149, 1.188, 3.183, 0.102, 1.141, 3.447],
}


CASES = {
    "PID": ("pid", {}, 0),
    "PID +1": ("pid", {}, 1),
    "SMC ab": ("pid_smc", {}, 0),
    "SMC": ("pid_smc", {"alpha_beta": False}, 0),
    "SMC +1": ("pid_smc", {"alpha_beta": False}, 1),
    "DOB": ("dob_smc", {"arx": "matched"}, 0),
    "nominal": ("nominal_smc", {"arx": "matched"}, 0),
}
"""Controller, its options, samples of extra input delay."""


@pytest.mark.parametrize("case", CASES)
def test_driven_axes(case):
    name, options, delay = CASES[case]
    references = three_dof.table_sines(2.0)
    draws = np.random.default_rng(0).standard_normal((len(references) - 1, 3, 3, 3))
    noise = draws * [0.0008, 0.013, 0.013]
    plant = {"delay": delay, **HYSTERESIS}
    y = three_dof.simulate(name, references, noise, plant, **options)["y"]
    rms = np.einsum("aca->ac", three_dof.tracking_rms(y, references))
    # At 1 Hz without an observer the error is due to the assumed hysteresis.
    atol = 0.01 if case == "nominal" else 0.004
    np.testing.assert_allclose(rms.ravel(), ELSEWHERE[case], rtol=0.02, atol=atol)


@pytest.mark.parametrize(
    ("name", "rms_of_rx_and_ry"),
    [("dob_smc", [0.74, 0.51]), ("nominal_smc", [4.24, 3.64])],
)
def test_printed_models_have_larger_errors(name, rms_of_rx_and_ry):
    references = three_dof.table_sines(2.0)[:, 1:, 0]  # 1 Hz in Rx, then in Ry
    y = three_dof.simulate(name, references, plant=HYSTERESIS, arx="printed")["y"]
    rms = np.diag(three_dof.tracking_rms(y, references)[:, 1:])
    np.testing.assert_allclose(rms, rms_of_rx_and_ry, rtol=0.02)


def test_the_pid_has_the_low_frequency_limit():
    # u is about the reference over the DC gain, so e = u' / I at 1 Hz.
    A, B, C = three_dof.stacked()
    dc = np.diag(C @ np.linalg.solve(np.eye(9) - A, B))
    references = three_dof.table_sines(2.0)[:, :, :1]
    rms = three_dof.tracking_rms(three_dof.simulate("pid", references)["y"], references)
    limit = 10.0 * 2 * np.pi / (np.array([120.0, 90.0, 100.0]) * dc * np.sqrt(2.0))
    np.testing.assert_allclose(np.diag(rms[:, 0]), limit, rtol=0.01)


def test_steps():
    # Overshoot in percent of the step, and the time to 2 % in ms.
    references = np.zeros((501, 3, 3))
    references[1:] = 10.0 * np.eye(3)
    y = three_dof.simulate("pid_smc", references, plant=HYSTERESIS, gains="step")["y"]
    y = np.einsum("taa->ta", y)
    outside = np.abs(y - 10.0) > 0.2
    settled = 1e3 * T * (len(y) - np.argmax(outside[::-1], axis=0) - 1)
    np.testing.assert_allclose(10.0 * y.max(0) - 100.0, [2.5, 6.8, 6.1], atol=0.3)
    np.testing.assert_allclose(settled, [114.0, 42.0, 44.0], atol=4.0)


def test_the_dead_beat_state_satisfies_the_sliding_dynamics():
    # From an initial displacement without other inputs: s(k+1) = PHI s(k) + SB usw(k).
    plant, controller = three_dof.Plant(()), three_dof.PIDSMC("dynamic", False)
    plant.x = np.linspace(-1.0, 1.0, 9)
    zero, rows = np.zeros(3), []
    for _ in range(60):
        u, logged = controller.step(plant.output(), zero, zero)
        plant.push(u)
        rows.append((logged["s"], u))
    s = np.array([row[0] for row in rows])
    gains = three_dof.PID_SMC_GAINS["dynamic"]
    A, B, C = three_dof.stacked()
    Bd = [C @ B, C @ A @ B, C @ A @ A @ B]
    SB = 0.49 * Bd[0] - 1.4 * Bd[1] + Bd[2]
    switching = -(s * gains["P"] + T * np.cumsum(s, 0) * gains["I"])
    expected = s[:-1] * gains["PHI"] + switching[:-1] @ SB.T
    # The state needs past values that the first samples lack.
    np.testing.assert_allclose(s[3:], expected[2:], rtol=0, atol=1e-11)
    assert np.abs(s[3]).max() > 1e-3


def test_constants_of_chapter_7():
    (A0, A1, A2), (B0, B1, B2) = three_dof.autoregression()
    A, B, C = three_dof.stacked()
    F = np.vstack([C, C @ A, C @ A @ A])
    Ad = F @ A @ np.linalg.inv(F)
    np.testing.assert_allclose(Ad[:6], np.eye(9)[3:], atol=1e-12)
    np.testing.assert_allclose(Ad[6:], np.hstack([A0, A1, A2]), atol=1e-11)
    controller = three_dof.PIDSMC()
    steady = (B0 + B1 + B2) @ np.linalg.solve(
        np.eye(3) + 2.0 * controller.Ks, controller.F1
    )
    np.testing.assert_allclose(steady, np.eye(3), atol=1e-12)
    SB = controller.S @ np.vstack([C @ B, C @ A @ B, C @ A @ A @ B])
    np.testing.assert_allclose(np.diag(SB), [0.0128, 0.0159, 0.0160], atol=5e-5)


@pytest.mark.parametrize("name", ["pid", "pid_smc", "dob_smc", "nominal_smc"])
def test_a_loop_at_rest_stays_at_rest(name):
    logs = three_dof.simulate(name, np.zeros((11, 3)), plant={"delay": 1})
    assert all(np.all(log == 0.0) for log in logs.values())


def test_the_catalogue_has_the_same_plant():
    for (A, B, C), model in zip(three_dof.PLANT, p558.CHAPTER_7, strict=True):
        for mine, printed in zip((A, B, C), ("A", "B", "C"), strict=True):
            np.testing.assert_array_equal(mine, model[printed])
