import jax.numpy as jnp
import numpy as np
import pytest

import piezojax as pj
from piezojax.core.feedback import Observation


class Echo(pj.System):
    """Controller whose command is the reference."""

    def init(self, input):
        return input.reference

    def step(self, state, input):
        return state, (input.reference, input.next_reference)


def seen(reference, following):
    return Observation(reference, following, jnp.zeros(()), jnp.zeros(()))


@pytest.mark.parametrize("lead", [0.0, 1.0, -0.5, 2.25])
def test_a_ramp_is_advanced_by_the_lead(lead):
    def line(k):
        return jnp.asarray(3.0 + 0.5 * k)

    anticipating = pj.control.Anticipation(Echo(), (lead,))
    _, shown = anticipating.step((), seen(line(7.0), line(8.0)))
    np.testing.assert_allclose(shown, (line(7.0 + lead), line(8.0 + lead)), rtol=1e-15)


def test_each_axis_has_its_own_lead():
    anticipating = pj.control.Anticipation(Echo(), (1.0, 0.0))
    axes = seen(
        (jnp.asarray(1.0), jnp.asarray(5.0)), (jnp.asarray(2.0), jnp.asarray(7.0))
    )
    _, (now, following) = anticipating.step((), axes)
    np.testing.assert_array_equal(now, (2.0, 5.0))
    np.testing.assert_array_equal(following, (3.0, 7.0))


def test_a_lead_compensates_the_delay_of_a_loop():
    """A loop with two samples of delay follows a slow sine without error at lead 2."""

    class Follower(pj.System):
        def init(self, input):
            return input.reference

        def step(self, state, input):
            return input.reference, state

    time = jnp.arange(500) * 1e-3
    reference = 1.0 - jnp.cos(2.0 * jnp.pi * 3.0 * time)
    errors = {}
    for lead in (0.0, 2.0):
        loop = pj.Feedback(
            pj.control.Anticipation(Follower(), (lead,)),
            pj.core.system.Affine(),
            pj.hardware.Saturation(-9.0, 9.0),
            pj.hardware.Sensor(0.0),
        )
        _, log = pj.simulate(loop, pj.loop_inputs(reference), loop.init(reference[0]))
        errors[lead] = float(jnp.max(jnp.abs(log.displacement - reference)))
    assert errors[0.0] > 0.035
    assert errors[2.0] < 1.5e-3


def test_bad_leads_are_refused():
    with pytest.raises(ValueError, match="lead in samples is inf; it must be finite"):
        pj.control.Anticipation(Echo(), (np.inf,))
