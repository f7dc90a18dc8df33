"""Inverse feedforward: exact on its own model, bumpless, independent of feedback."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from piezojax import (
    Feedback,
    loop_inputs,
    simulate,
)
from piezojax.catalog import p753
from piezojax.control import (
    PID,
    FeedforwardFeedback,
    InverseFeedforward,
)
from piezojax.core.feedback import Observation
from piezojax.core.system import Affine
from piezojax.hardware import (
    Saturation,
    Sensor,
)
from piezojax.hysteresis import (
    InverseColemanHodgdon,
)
from piezojax.signals import waveforms as signals

TIME = signals.time_grid(0.2, p753.RATE)
REFERENCE = signals.signal("SIN10", TIME)
INVERSE = InverseColemanHodgdon(p753.hysteresis())
SILENT = PID(0.0, 0.0, dt=p753.DT)


@jax.jit
def run(loop, reference):
    return simulate(loop, loop_inputs(reference), loop.init(reference[0]))[1]


def around(controller, plant, actuator=None):
    return Feedback(controller, plant, actuator or p753.actuator(), Sensor(0.0))


def test_an_exact_model_cancels_the_hysteresis():
    samples = run(around(InverseFeedforward(INVERSE), p753.hysteresis()), REFERENCE)
    np.testing.assert_allclose(
        samples.displacement, samples.reference, rtol=0.0, atol=1e-9
    )
    assert np.ptp(samples.displacement) > 9.9


def test_feedforward_alone_equals_feedforward_with_zero_feedback():
    plant = p753.plant()
    alone = run(around(InverseFeedforward(INVERSE), plant), REFERENCE)
    beside = run(around(FeedforwardFeedback(INVERSE, SILENT), plant), REFERENCE)
    np.testing.assert_array_equal(alone.command, beside.command)


@pytest.mark.parametrize("feedback", [None, p753.pid()])
def test_a_wrong_model_starts_without_a_bump(feedback):
    wrong = Affine(9.0)  # V/um, and no hysteresis
    controller = (
        InverseFeedforward(wrong)
        if feedback is None
        else FeedforwardFeedback(wrong, feedback)
    )
    reference = jnp.full(200, 5.0)
    samples = run(around(controller, p753.plant()), reference)
    np.testing.assert_allclose(samples.displacement, 5.0, rtol=0.0, atol=1e-9)
    assert abs(samples.voltage[0] - 45.0) > 1.0


def test_the_feedback_receives_its_share_of_the_applied_voltage():
    # A saturated drive: the anti-windup must receive exactly the shortfall.
    controller = FeedforwardFeedback(Affine(9.0), p753.pid())
    start = Observation(*map(jnp.asarray, (1.0, 1.0, 1.0, 12.0)))
    state = controller.init(start)
    state, command = controller.step(state, start)
    np.testing.assert_allclose(command, 12.0)
    clipped = start._replace(applied=command - 2.0)
    state, command = controller.step(state, clipped)
    # a shortfall of 2 V for one sample, at 100 1/s
    np.testing.assert_allclose(command, 12.0 - 2.0 * 100.0 * p753.DT, rtol=1e-12)


def test_feedback_compensates_for_limits():
    low = Saturation(-20.0, 60.0)  # SIN10 needs up to 68 V
    controller = FeedforwardFeedback(INVERSE, p753.pid())
    samples = run(around(controller, p753.plant(), low), REFERENCE)
    error = np.abs(samples.displacement - samples.reference)
    assert np.mean(samples.voltage == 60.0) > 0.1
    assert error.max() > 1.0
    assert error[-300:].max() < 0.3
