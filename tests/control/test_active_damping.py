"""Active damping against a NumPy loop, and the added damping."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.signal

import piezojax as pj
from piezojax.analysis.stability import closed_loop_poles
from piezojax.control import PID, ActiveDamping
from piezojax.core.system import Affine
from piezojax.dynamics import LowPass, SecondOrderLag, SecondOrderLowPass

DT, GAIN, FREQUENCY, DAMPING = 5e-5, 0.2, 800.0, 0.02
LIMIT = 8.0
SCHEMES = {
    "positive position feedback": (SecondOrderLowPass(900.0, 0.25, DT), 1.2),
    "integral resonant control": (LowPass(500.0, DT), 2.0),
    "resonant shift": (Affine(1.0), -1.5),
}
INTEGRAL, WINDUP = 400.0, 100.0


def stage():
    return SecondOrderLag(2.0 * np.pi * FREQUENCY, DAMPING, DT) >> Affine(GAIN)


def loop(scheme, integral=INTEGRAL):
    filter, gain = SCHEMES[scheme]
    pid = PID(0.0, integral, anti_windup=WINDUP, dt=DT)
    limits = pj.hardware.Saturation(-LIMIT, LIMIT)
    controller = ActiveDamping(pid, filter, gain)
    return pj.Feedback(controller, stage(), limits, pj.hardware.Sensor(0.0))


def coefficients(scheme):
    """Return the filter of a scheme, by SciPy's bilinear transform."""

    def warped(frequency):
        return 2.0 / DT * np.tan(np.pi * frequency * DT)

    w = warped(900.0)
    return {
        "positive position feedback": scipy.signal.bilinear(
            [1.0], [1.0 / w**2, 0.5 / w, 1.0], 1.0 / DT
        ),
        "integral resonant control": scipy.signal.bilinear(
            [1.0], [1.0 / warped(500.0), 1.0], 1.0 / DT
        ),
        "resonant shift": (np.ones(1), np.ones(1)),
    }[scheme]


@pytest.mark.parametrize("scheme", SCHEMES)
def test_the_loop_equals_the_equations(scheme):
    samples = 600
    reference = 4.0 + 4.0 * np.sign(np.sin(2 * np.pi * 90.0 * DT * np.arange(samples)))
    reference[:5] = 0.0
    tested = loop(scheme)
    start = tested.init(0.0)
    _, log = pj.simulate(tested, pj.loop_inputs(jnp.asarray(reference)), start)

    b, a = coefficients(scheme)
    w = 2.0 * np.pi * FREQUENCY
    plant = scipy.signal.cont2discrete(
        ([GAIN * w**2], [1.0, 2.0 * DAMPING * w, w**2]), DT, "zoh"
    )
    (over,), under, _ = plant
    gain = SCHEMES[scheme][1]
    filter_state, plant_state = np.zeros(len(a) - 1), np.zeros(len(under) - 1)
    z = integral = command = damping = applied = 0.0
    railed = 0
    for k in range(samples):
        assert float(log.displacement[k]) == pytest.approx(z, abs=1e-9)
        own = applied - damping
        integral += DT * (WINDUP * (own - command) + INTEGRAL * (reference[k] - z))
        command = integral
        (filtered,), filter_state = scipy.signal.lfilter(b, a, [z], zi=filter_state)
        damping = gain * filtered
        applied = np.clip(command + damping, -LIMIT, LIMIT)
        railed += abs(applied) == LIMIT
        assert float(log.voltage[k]) == pytest.approx(applied, abs=1e-9)
        # The voltage acts from the next sample on: the loop reads z(k) first.
        (_,), plant_state = scipy.signal.lfilter(over, under, [applied], zi=plant_state)
        z = plant_state[0]
    assert railed > 0


def damping_of_the_mode(tested):
    poles = np.asarray(eqx.filter_jit(closed_loop_poles)(tested))
    poles = np.log(poles[np.abs(poles) > 1e-9]) / DT
    near = poles[np.argmin(np.abs(np.abs(poles) - 2.0 * np.pi * FREQUENCY))]
    return -near.real / abs(near), abs(near) / (2.0 * np.pi)


def test_feedback_of_the_position_damps_the_mode():
    plain, _ = damping_of_the_mode(loop("resonant shift", 1e-6))
    for scheme in ("positive position feedback", "integral resonant control"):
        damped, _ = damping_of_the_mode(loop(scheme, 1e-6))
        assert damped > 3.0 * plain


def test_negative_feedback_shifts_the_mode_upwards():
    _, frequency = damping_of_the_mode(loop("resonant shift", 1e-6))
    expected = FREQUENCY * np.sqrt(1.0 + 1.5 * GAIN)
    assert frequency == pytest.approx(expected, rel=0.02)


def test_the_loop_starts_at_rest():
    tested = loop("positive position feedback")
    reference = np.full(50, 1.0)
    _, log = pj.simulate(
        tested, pj.loop_inputs(jnp.asarray(reference)), tested.init(1.0)
    )
    np.testing.assert_allclose(log.displacement, 1.0, rtol=0.0, atol=1e-9)
