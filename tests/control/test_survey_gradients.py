"""Gradients of the surveyed control schemes on the P-753."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

from piezojax import (
    loop_inputs,
    simulate,
)
from piezojax.catalog import p753
from piezojax.catalog import p753_survey as catalog
from piezojax.core.metrics import (
    Tracking,
)
from piezojax.core.system import Observation
from piezojax.signals import waveforms as signals

DRAWS = np.random.default_rng(31).normal(size=200)
CONTROLLERS = {
    "super-twisting": catalog.super_twisting,
    "feedforward and PID": catalog.feedforward_pid,
    "repetitive": catalog.repetitive,
}


@jax.jit
def at_rest(reference):
    return p753.loop(p753.pid()).init(reference)


# The boundary layer shares all but its law, whose slopes have their own test.
@pytest.mark.parametrize("name", CONTROLLERS)
def test_gradients_are_those_of_differences_and_none_at_rest(name):
    # A short period, so that the repetitive loop learns within the run.
    options = {"period": 60} if name == "repetitive" else {}
    loop = p753.loop(CONTROLLERS[name](**options))
    arrays, static = eqx.partition(loop.controller, eqx.is_array)
    flat, unravel = ravel_pytree(arrays)
    # What is zero moves less: a derivative of 1e-6 V s/um would be a strong one.
    scale = np.where(flat == 0.0, 1e-4, np.abs(flat))
    samples = 200

    @jax.jit
    @jax.value_and_grad
    def loss(moves, reference, draws, state):
        controller = eqx.combine(unravel(flat + scale * moves), static)
        seen = Observation(
            reference[0], reference[0], state.displacement, state.voltage
        )
        state = state._replace(controller=controller.init(seen))
        moved = eqx.tree_at(lambda loop: loop.controller, loop, controller)
        inputs = loop_inputs(reference, draws)
        metric = Tracking(10)
        return simulate(moved, inputs, state, metric=metric, segment=samples)[
            1
        ].rms_error

    def at(reference, draws):
        return lambda moves: loss(moves, reference, draws, at_rest(reference[0]))

    moving = at(
        signals.sine(signals.time_grid(samples * p753.DT, p753.RATE), 50.0),
        jnp.asarray(DRAWS[:samples]),
    )
    value, found = moving(np.zeros(flat.size))
    step = 1e-6
    expected = []
    for move in step * np.eye(flat.size):
        losses = [moving(times * move)[0] for times in (1, -1, 2, -2)]
        expected.append(8.0 * (losses[0] - losses[1]) - (losses[2] - losses[3]))
    expected = np.array(expected) / (12.0 * step)
    assert np.count_nonzero(expected) > flat.size / 2
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-8 * float(value))

    resting = at(jnp.full(samples, 5.0), jnp.zeros(samples))
    value, found = resting(np.zeros(flat.size))
    assert value < 1e-9
    np.testing.assert_allclose(found, 0.0, atol=1e-8)
