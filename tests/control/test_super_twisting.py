"""The super-twisting law alone, and on the equation that it is designed for."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from piezojax import (
    simulate,
)
from piezojax.control import (
    SuperTwisting,
)

DT = 1e-4


def test_far_from_the_layer_the_law_equals_the_published_one():
    law = SuperTwisting(2.0, 300.0, 1e-6, DT)
    s = np.repeat([400.0, -900.0, 25.0], 10)
    found = simulate(law, jnp.asarray(s), law.init(0.0))[1]
    w = -300.0 * DT * np.cumsum(np.sign(s))
    expected = w - 2.0 * np.sqrt(np.abs(s)) * np.sign(s)
    np.testing.assert_allclose(found, expected, rtol=1e-12)


def test_inside_the_layer_the_law_is_proportional_integral():
    law = SuperTwisting(2.0, 300.0, 100.0, DT)
    s = np.random.default_rng(5).normal(size=50) * 1e-4
    found = simulate(law, jnp.asarray(s), law.init(0.0))[1]
    expected = -0.2 * s - 300.0 * DT / 100.0 * np.cumsum(s)
    np.testing.assert_allclose(found, expected, rtol=1e-9)


@pytest.mark.parametrize("layer", [1e-3, 0.1])
def test_s_reaches_zero_against_a_ramp_without_chatter(layer):
    # ds/dt = v + d, |dd/dt| <= 8 < sign_gain: a second-order sliding mode.
    law = SuperTwisting(6.0, 12.0, layer, DT)

    def sample(carry, drive):
        state, s = carry
        state, v = law.step(state, s)
        return (state, s + DT * (v + drive)), (s, v)

    drive = 1.0 + 8.0 * DT * jnp.arange(30_000)
    _, (s, v) = jax.jit(lambda s: jax.lax.scan(sample, (law.init(0.0), s), drive))(3.0)
    # At rest in the layer, w falls by 8 V/s: s = 8 d / sqrt(12^2 - 8^2).
    np.testing.assert_allclose(s[-1], 8.0 * layer / math.sqrt(80.0), rtol=1e-2)
    assert np.ptp(np.diff(v[-2_000:])) < 1e-6


def test_the_law_rests_and_its_gradients_equal_finite_differences():
    law = SuperTwisting(2.0, 300.0, 100.0, DT)
    assert law.step(law.init(0.0), 0.0) == (0.0, 0.0)

    def last(law, s):
        return simulate(law, s * jnp.ones(3), law.init(0.0))[1][-1]

    slopes = jax.grad(last, argnums=(0, 1))
    by_law, by_s = slopes(law, jnp.asarray(0.0))
    assert (by_law.root_gain, by_law.sign_gain, by_law.layer) == (0.0, 0.0, 0.0)
    np.testing.assert_allclose(by_s, -0.2 - 3 * 300.0 * DT / 100.0)

    by_law, _ = slopes(law, jnp.asarray(70.0))
    found = [by_law.root_gain, by_law.sign_gain, by_law.layer]
    values = np.array([2.0, 300.0, 100.0])
    for i, slope in enumerate(found):
        move = 1e-6 * values * (np.arange(3) == i)
        sides = [last(SuperTwisting(*(values + t * move), DT), 70.0) for t in (1, -1)]
        expected = (sides[0] - sides[1]) / (2.0 * move[i])
        np.testing.assert_allclose(slope, expected, rtol=1e-7)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((-1.0, 1.0, 1.0, DT), "root_gain .* is -1; .* at least 0"),
        ((1.0, -1.0, 1.0, DT), "sign_gain .* is -1; .* at least 0"),
        ((1.0, 1.0, 0.0, DT), "layer .* is 0; .* above 0"),
        ((1.0, 1.0, 1.0, 0.0), "dt in s is 0; .* above 0"),
        ((1.0, np.inf, 1.0, DT), "sign_gain .* is inf"),
    ],
)
def test_bad_parameters_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        SuperTwisting(*arguments)
