"""The controller of the limit on stages: its error equals the prediction."""

import numpy as np
import pytest
from scipy import signal

import piezojax as pj
from piezojax.analysis.limit import performance_limit, verify_limit
from piezojax.signals import waveforms as references_of

RATE, DT, START, SAMPLES = 5_000.0, 2e-4, 2_500, 6_000
NAMES = ("SIN10", "PWSW10")
TIME = references_of.time_grid(SAMPLES * DT, RATE)
REFERENCES = np.stack([references_of.signal(name, TIME) for name in NAMES])
NOISE = np.random.default_rng(8).standard_normal((2, 1, SAMPLES))


def loop_of(plant, integral):
    controller = pj.control.PID(0.0, integral, 0.0, 0.0, 50.0, dt=DT)
    limits = pj.hardware.Saturation(-200.0, 200.0)
    return pj.Feedback(controller, plant, limits, pj.hardware.Sensor(0.012))


def test_a_linear_stage_reaches_the_prediction_in_the_first_round():
    draws = np.random.default_rng(3).standard_normal(SAMPLES)
    disturbance = signal.lfilter([0.004], [1.0, -0.99], draws)
    stage = pj.series(
        slope=pj.core.system.Affine(0.15), lag=pj.dynamics.FirstOrderLag(5e-4, DT)
    )
    loop = loop_of(stage, 4000.0)
    (found,) = verify_limit(loop, REFERENCES, NOISE, disturbance, start=START, rounds=1)
    report = performance_limit(loop, NAMES, REFERENCES, NOISE, disturbance, start=START)
    shared = [one.one_controller for one in report.references.values()]
    np.testing.assert_allclose(found.predicted, shared, rtol=1e-9)
    # one draw of 0.7 s of noise
    np.testing.assert_allclose(found.simulated, found.predicted, rtol=0.1)
    # Integral control lags the reference by 0.1 um.
    assert report.references["SIN10"].tuned > 10.0 * found.simulated[0]


def test_a_hysteretic_stage_reaches_the_prediction_in_later_rounds():
    model = pj.hysteresis.ColemanHodgdon(0.0077, 0.1167, -0.0487)
    stage = pj.series(hysteresis=model, lag=pj.dynamics.FirstOrderLag(5e-4, DT))
    first, *_, last = verify_limit(
        loop_of(stage, 4000.0), REFERENCES, NOISE, start=START, rounds=3
    )
    np.testing.assert_allclose(last.simulated, last.predicted, rtol=0.2)
    worst = [np.max(found.simulated / found.predicted) for found in (first, last)]
    assert worst[1] < worst[0]


def test_verification_needs_sensor_noise():
    loop = loop_of(pj.core.system.Affine(0.15), 4000.0)
    quiet = pj.Feedback(
        loop.controller, loop.plant, loop.actuator, pj.hardware.Sensor(0.0)
    )
    with pytest.raises(ValueError, match="without sensor noise"):
        verify_limit(quiet, REFERENCES, NOISE, start=START)
