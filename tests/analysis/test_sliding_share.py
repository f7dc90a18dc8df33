"""Parts of the sliding variable, against a plain alpha-beta filter in NumPy."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracles import control as oracle

from piezojax import Feedback, loop_inputs, simulate
from piezojax.analysis.sliding_share import sliding_mode_of, sliding_parts
from piezojax.catalog import p753, p753_by_rate
from piezojax.control import AlphaBeta
from piezojax.core.system import Affine
from piezojax.signals import waveforms as signals

DT = p753.DT
REFERENCE = signals.signal("SIN50", signals.time_grid(0.02, p753.RATE))
NOISE = jnp.asarray(np.random.default_rng(2).normal(size=REFERENCE.shape))
FIRST = 100
CONTROLLERS = {
    "inside an observer": p753.disturbance_observer(),
    "without a model": p753_by_rate.continuous(),
}


def around(controller):
    return Feedback(
        controller, p753.plant(), p753.actuator(), p753.loop(Affine()).sensor
    )


@jax.jit
def runs(loop):
    inputs, start = loop_inputs(REFERENCE, NOISE), REFERENCE[0]
    samples = simulate(loop, inputs, loop.init(start))[1]
    return samples, sliding_parts(loop, inputs, start, FIRST)


@pytest.mark.parametrize("name", CONTROLLERS)
def test_parts_equal_those_of_a_plain_filter(name):
    loop = around(CONTROLLERS[name])
    samples, parts = runs(loop)
    mode = sliding_mode_of(loop)
    assert mode is not None
    filter, surface = mode.filter, float(mode.surface)
    assert isinstance(filter, AlphaBeta)
    start = float(samples.measured[0] - 0.012 * NOISE[0])
    plain = oracle.AlphaBeta(float(filter.alpha), float(filter.beta), DT, start)
    seen = np.array([plain.step(float(z)) for z in samples.measured])
    reference = np.asarray(samples.reference)
    rate = np.diff(reference, prepend=reference[0]) / DT
    sliding = surface * (seen[:, 0] - reference) + seen[:, 1] - rate
    error = np.asarray(samples.displacement) - reference
    terms = surface * error + np.diff(error, prepend=error[0]) / DT
    expected = [
        np.sqrt(np.mean(part[FIRST:] ** 2))
        for part in (sliding, terms, sliding - terms)
    ]
    np.testing.assert_allclose(parts, expected, rtol=1e-6)
    share = expected[1] ** 2 / (expected[1] ** 2 + expected[2] ** 2)
    np.testing.assert_allclose(parts.share, share, rtol=1e-6)
    assert 0.05 < share < 0.95


def test_without_a_velocity_estimate_the_rate_of_the_reference_remains():
    controller = p753.disturbance_observer()
    feedback = dataclasses.replace(
        controller.feedback, surface=1.0, filter=AlphaBeta(0.99, 1e-9, DT)
    )
    loop = around(dataclasses.replace(controller, feedback=feedback))
    _, parts = runs(loop)
    rate = np.diff(np.asarray(REFERENCE))[FIRST - 1 :] / DT
    np.testing.assert_allclose(parts.sliding, np.sqrt(np.mean(rate**2)), rtol=0.02)
    assert parts.rest > 0.2 * parts.sliding


def test_other_controllers_have_no_sliding_variable():
    assert sliding_mode_of(around(p753.pid())) is None
    with pytest.raises(ValueError, match="no sliding variable m e"):
        sliding_parts(around(p753.pid()), loop_inputs(REFERENCE), REFERENCE[0], 0)
