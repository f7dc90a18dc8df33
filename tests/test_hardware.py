import jax
import jax.numpy as jnp
import numpy as np
import pytest

from piezojax import (
    simulate,
)
from piezojax.hardware import (
    Quantiser,
    Saturation,
    Sensor,
    SlewLimit,
)

DT = 5e-5


@jax.jit
def response(system, inputs):
    return simulate(system, inputs, system.init(0.0))[1]


def rough(scale=100.0, samples=1000):
    return np.random.default_rng(9).normal(0.0, scale, samples)


def test_saturation_clips():
    outputs = response(Saturation(-20.0, 120.0), rough())
    np.testing.assert_array_equal(outputs, np.clip(rough(), -20.0, 120.0))
    assert outputs.min() == -20.0
    assert outputs.max() == 120.0


def test_saturation_passes_the_gradient_only_inside():
    limits = Saturation(-20.0, 120.0)

    def output(limits, input):
        return limits.step((), input)[1]

    for input, slopes in ((50.0, (0, 0, 1)), (-30.0, (1, 0, 0)), (200.0, (0, 1, 0))):
        by_limits, by_input = jax.grad(output, argnums=(0, 1))(limits, input)
        assert (by_limits.lower, by_limits.upper, by_input) == slopes
    for edge in (-20.0, 120.0):
        assert 0.0 <= jax.grad(lambda u: output(limits, u))(edge) <= 1.0


def test_slew_limit_bounds_the_rate():
    rate, inputs = 1e5, rough(10.0)
    expected, last = [], 0.0
    for input in inputs:
        last += min(max(input - last, -rate * DT), rate * DT)
        expected.append(last)
    outputs = response(SlewLimit(rate, DT), inputs)
    np.testing.assert_allclose(outputs, expected, rtol=0.0, atol=1e-11)
    steps = np.abs(np.diff(outputs, prepend=0.0))
    np.testing.assert_allclose(steps.max(), rate * DT, rtol=1e-12)
    assert np.any(np.abs(outputs - inputs) < 1e-12)  # where the input is slower


def test_slew_limit_starts_at_the_given_value():
    limit = SlewLimit(1.0, DT)
    assert limit.step(limit.init(80.0), 80.0)[1] == 80.0


def test_gradient_of_the_slew_limit_equals_finite_differences():
    inputs, weights = rough(10.0, 50), rough(1.0, 50)

    def loss(rate):
        return weights @ response(SlewLimit(rate, DT), inputs)

    expected = (loss(1e5 + 1.0) - loss(1e5 - 1.0)) / 2.0
    np.testing.assert_allclose(jax.grad(loss)(1e5), expected, rtol=1e-7)
    assert np.isfinite(jax.grad(lambda u: SlewLimit(1e5, DT).step(5.0, u)[1])(5.0))


def test_quantiser_rounds_to_whole_steps():
    step = 0.025
    outputs = response(Quantiser(step), rough())
    np.testing.assert_allclose(outputs, step * np.round(rough() / step), rtol=1e-14)
    assert np.unique(np.round(outputs / step)).size > 100
    assert np.abs(outputs - rough()).max() <= 0.5 * step * (1.0 + 1e-9)
    np.testing.assert_allclose(outputs, step * np.rint(outputs / step), rtol=1e-14)


def test_quantiser_has_the_gradient_of_the_identity():
    converter = Quantiser(0.5)
    for input in (0.0, 0.1, 0.25, 0.75, -3.3):
        output, slope = jax.value_and_grad(lambda u: converter.step((), u)[1])(input)
        assert float(output) == 0.5 * round(input / 0.5)
        assert float(slope) == 1.0
    by_resolution = jax.grad(lambda r: Quantiser(r).step((), 3.3)[1])(0.5)
    assert float(by_resolution) == 0.0


def test_sensor_scales_the_draws():
    displacement, draws = rough(), rough(1.0)
    _, measured = simulate(Sensor(0.012), (jnp.array(displacement), jnp.array(draws)))
    np.testing.assert_array_equal(measured, displacement + 0.012 * draws)


def test_a_sensor_with_converter_rounds_the_noisy_value():
    chain = Sensor(0.3) >> Quantiser(1.0)
    state = chain.init((0.0, 0.0))
    assert float(chain.step(state, (5.0, 1.0))[1]) == 5.0
    assert float(chain.step(state, (5.0, 2.0))[1]) == 6.0


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (
            lambda: Saturation(120.0, -20.0),
            "lower is 120 and upper is -20; lower must be below",
        ),
        (lambda: Saturation(5.0, 5.0), "lower is 5 and upper is 5"),
        (lambda: Saturation(np.nan, 5.0), "lower is nan"),
        (lambda: SlewLimit(0.0, DT), "rate in V/s is 0; it must be finite and"),
        (lambda: SlewLimit(1e5, -DT), "dt in s is -5e-05; .* above 0"),
        (lambda: Quantiser(0.0), "resolution .* is 0; it must be finite and above 0"),
        (lambda: Quantiser(np.inf), "resolution .* is inf"),
        (lambda: Sensor(-0.01), r"noise_rms in um is -0\.01; .* at least 0"),
    ],
)
def test_bad_parameters_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_limits_are_checked_in_every_lane():
    upper = np.array([120.0, -30.0])
    with pytest.raises(ValueError, match="lower"):
        Saturation(np.full(2, -20.0), upper)
    limits = jax.vmap(Saturation)(np.full(2, -20.0), np.array([120.0, 60.0]))
    clipped = jax.vmap(lambda system: system.step((), 200.0)[1])(limits)
    assert clipped.tolist() == [120.0, 60.0]
