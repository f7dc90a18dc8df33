"""The boundary layer alone, and its limit of bang-bang switching."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from piezojax import (
    loop_inputs,
    simulate,
)
from piezojax.catalog import p753, p753_survey
from piezojax.catalog import p753_chapter4 as chapter4
from piezojax.control import (
    BoundaryLayer,
)
from piezojax.dynamics import (
    ARMA,
)

LAW = BoundaryLayer(3.0, 200.0)


def output(law, s):
    return law.step(law.init(0.0), s)[1]


def test_the_law_is_linear_inside_the_layer_and_constant_outside():
    s = jnp.asarray([-1e9, -201.0, -200.0, -50.0, 0.0, 100.0, 200.0, 201.0, 1e9])
    expected = [3.0, 3.0, 3.0, 0.75, 0.0, -1.5, -3.0, -3.0, -3.0]
    np.testing.assert_allclose(jax.vmap(lambda s: output(LAW, s))(s), expected)


def test_gradients_are_finite_everywhere_and_right_inside():
    slope = jax.grad(output, argnums=(0, 1))
    law, by_s = slope(LAW, 50.0)
    np.testing.assert_allclose(
        [law.gain, law.width, by_s], [-0.25, 3.0 * 50.0 / 200.0**2, -0.015]
    )
    np.testing.assert_allclose(slope(LAW, 0.0)[1], -0.015)
    for edge in (-200.0, 200.0):
        assert -0.015 <= slope(LAW, edge)[1] <= 0.0
    law, by_s = slope(LAW, 300.0)
    assert (law.gain, law.width, by_s) == (-1.0, 0.0, 0.0)


def test_a_layer_of_zero_width_equals_bang_bang_switching():
    printed = chapter4.bang_bang()
    thin = eqx.tree_at(
        lambda c: (c.law, c.control_weight, c.model),
        p753_survey.boundary_layer(),
        (
            BoundaryLayer(printed.law.gain, 1e-9),
            printed.control_weight,
            ARMA(**p753.DYNAMICS_BY_RATE[20_000]),
        ),
    )
    reference = jnp.asarray(np.linspace(0.0, 3.0, 400) ** 2)
    draws = jnp.asarray(np.random.default_rng(3).normal(size=400))

    @jax.jit
    def commands(loop):
        inputs = loop_inputs(reference, draws)
        return simulate(loop, inputs, loop.init(0.0))[1].command

    expected = commands(p753.loop(printed))
    np.testing.assert_allclose(commands(p753.loop(thin)), expected, rtol=0.0, atol=1e-9)
    assert np.abs(expected).max() > 10.0


SWITCHED = p753_survey.boundary_layer()


def changed(**values):
    fields = {name: getattr(SWITCHED, name) for name in vars(SWITCHED)}
    return type(SWITCHED)(**(fields | values))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: BoundaryLayer(-1.0, 1.0), "gain .* is -1; .* at least 0"),
        (lambda: BoundaryLayer(1.0, 0.0), "width .* is 0; .* above 0"),
        (lambda: BoundaryLayer(np.nan, 1.0), "gain .* is nan"),
        (lambda: changed(surface=np.inf), "surface in 1/s is inf"),
        (lambda: changed(error_weight=0.0), "error_weight is 0; .* above 0"),
        (lambda: changed(control_weight=-1.0), "control_weight is -1; .* at least 0"),
        (lambda: changed(inversion="none"), "inversion 'none'; it must be one of"),
        (
            lambda: changed(model=ARMA((), (0.5,))),
            "the model has no coefficient a_1; it must have one",
        ),
    ],
)
def test_bad_parameters_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()
