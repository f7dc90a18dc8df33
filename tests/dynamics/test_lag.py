import jax
import numpy as np
import pytest
import scipy.signal
from hypothesis import given, settings
from hypothesis import strategies as st

from piezojax import (
    simulate,
)
from piezojax.dynamics import (
    FirstOrderLag,
    SecondOrderLag,
)

DT = 5e-5


@jax.jit
def response(system, inputs, start):
    return simulate(system, inputs, system.init(start))[1]


@pytest.mark.parametrize("tau", [1e-6, DT, 1e-3, 10.0])
def test_step_response_equals_the_closed_form(tau):
    time = DT * np.arange(1, 1001)  # output k is the value at the end of sample k
    outputs = response(FirstOrderLag(tau, DT), np.full(1000, 7.0), 2.0)
    expected = 7.0 - 5.0 * np.exp(-time / tau)
    np.testing.assert_allclose(outputs, expected, rtol=0.0, atol=1e-11)


def test_ramp_is_followed_with_the_lag_of_a_held_input():
    tau, samples = 1e-3, 2000
    outputs = response(FirstOrderLag(tau, DT), np.arange(samples) * DT, 0.0)
    pole = np.exp(-DT / tau)
    behind = DT * pole / (1.0 - pole)  # settled, for a held ramp
    np.testing.assert_allclose(
        np.arange(samples)[-100:] * DT - outputs[-100:], behind, rtol=1e-9
    )


@settings(max_examples=50, deadline=None)
@given(st.floats(1e-6, 1.0), st.integers(-10_000, 10_000).map(lambda n: 0.1 * n))
def test_rest_stays_at_rest(tau, level):
    lag = FirstOrderLag(tau, DT)
    state, output = lag.step(lag.init(level), level)
    assert float(state) == float(output) == level


@pytest.mark.parametrize("tau", [DT / 10.0, 1e-3])
def test_as_arma_equals_the_lag(tau):
    inputs = np.random.default_rng(7).normal(size=500)
    lag = FirstOrderLag(tau, DT)
    np.testing.assert_allclose(
        response(lag.as_arma(), inputs, 3.0),
        response(lag, inputs, 3.0),
        rtol=0.0,
        atol=1e-13,
    )
    assert np.isclose(lag.as_arma().dc_gain(), 1.0, rtol=1e-12, atol=0.0)


def test_pole_and_its_gradient_equal_the_closed_form():
    tau = 2e-3
    found, slope = jax.value_and_grad(lambda tau: FirstOrderLag(tau, DT).pole())(tau)
    np.testing.assert_allclose(found, np.exp(-DT / tau), rtol=1e-15)
    np.testing.assert_allclose(slope, np.exp(-DT / tau) * DT / tau**2, rtol=1e-14)


@pytest.mark.parametrize(
    ("tau", "dt", "message"),
    [
        (0.0, DT, "time_constant in s is 0; it must be finite and above 0"),
        (-1.0, DT, "time_constant in s is -1"),
        (np.nan, DT, "time_constant in s is nan"),
        (1e-3, 0.0, "dt in s is 0; it must be finite and above 0"),
    ],
)
def test_bad_times_are_refused(tau, dt, message):
    with pytest.raises(ValueError, match=message):
        FirstOrderLag(tau, dt)


@pytest.mark.parametrize("damping", [0.0, 0.25, 0.7, 1.0, 1.0 + 1e-7, 1.001, 3.0])
def test_second_order_equals_the_held_transfer_function(damping):
    inputs = np.random.default_rng(8).normal(size=400)
    found = response(SecondOrderLag(3000.0, damping, DT), inputs, 0.0)
    matrices = map(
        np.array, ([[0, 1], [-9e6, -6e3 * damping]], [[0], [9e6]], [[1, 0]], [[0]])
    )
    held = scipy.signal.cont2discrete(tuple(matrices), DT, method="zoh")
    expected = scipy.signal.dlsim(held, np.append(inputs, 0.0))[1][1:, 0]
    np.testing.assert_allclose(found, expected, rtol=0.0, atol=1e-9)


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        ((0.0, 0.7, DT), "frequency in rad/s is 0; it must be finite and above 0"),
        ((1e3, -0.1, DT), "damping is -0.1; it must be finite and at least 0"),
        ((1e3, 0.7, 0.0), "dt in s is 0; it must be finite and above 0"),
    ],
)
def test_bad_second_order_lags_are_refused(parameters, message):
    with pytest.raises(ValueError, match=message):
        SecondOrderLag(*parameters)
