import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles import dynamics as oracle
from oracles.published import MODEL_533_A, MODEL_533_B, T2_G
from scipy import signal

from piezojax import (
    simulate,
)
from piezojax.dynamics import (
    ARMA,
    scaled_to_dc,
)

# a_1, ... with poles inside the unit circle, and b_0, ...
ORDERS = {
    "gain": ((), (2.5,)),
    "fir": ((), (0.5, -0.25, 0.125)),
    "first": ((0.9,), (0.1,)),
    "published": (MODEL_533_A, MODEL_533_B),
    "third": ((1.2, -0.6, 0.1), (0.3, 0.2)),
    "more zeros than poles": ((0.5,), (0.1, 0.2, 0.3, 0.4)),
    "fifth": ((0.4, 0.1, -0.2, 0.05, 0.1), (0.2, -0.1, 0.3, 0.05, -0.02, 0.1)),
}


@jax.jit
def response(system, inputs, start):
    return simulate(system, inputs, system.init(start))[1]


def rough(samples=2000):
    return np.random.default_rng(5).normal(size=samples)


@pytest.mark.parametrize(("a", "b"), ORDERS.values(), ids=ORDERS)
def test_any_order_equals_the_difference_equation(a, b):
    expected = oracle.arma(rough(), a, b)
    np.testing.assert_allclose(
        response(ARMA(a, b), rough(), 0.0), expected, rtol=0.0, atol=1e-12
    )


@pytest.mark.parametrize(("a", "b"), ORDERS.values(), ids=ORDERS)
def test_any_order_equals_lfilter(a, b):
    expected = signal.lfilter(b, [1.0, *(-c for c in a)], rough())
    np.testing.assert_allclose(
        response(ARMA(a, b), rough(), 0.0), expected, rtol=0.0, atol=1e-12
    )


@pytest.mark.parametrize(("a", "b"), ORDERS.values(), ids=ORDERS)
@pytest.mark.parametrize("level", [0.0, -3.0])
def test_rest_stays_at_rest(a, b, level):
    gain = sum(b) / (1.0 - sum(a))
    outputs = response(ARMA(a, b), np.full(2000, level), level)
    np.testing.assert_allclose(outputs, gain * level, rtol=0.0, atol=1e-11)


def test_a_start_at_rest_equals_a_long_run_before():
    model = ARMA(MODEL_533_A, MODEL_533_B)
    waited = response(model, np.concatenate([np.full(2000, 4.0), rough()]), 0.0)
    np.testing.assert_allclose(
        response(model, rough(), 4.0), waited[2000:], rtol=0.0, atol=1e-12
    )


@pytest.mark.parametrize(("a", "b"), ORDERS.values(), ids=ORDERS)
def test_dc_gain_equals_that_of_the_transfer_function(a, b):
    _, gain = signal.freqz(b, [1.0, *(-c for c in a)], worN=[0.0])
    found = ARMA(a, b).dc_gain()
    np.testing.assert_allclose(found, gain[0].real, rtol=1e-12)
    assert found.dtype == jnp.float64


def roots(values):
    return np.sort_complex(np.asarray(values, complex))


def test_poles_and_zeros_equal_those_of_a_known_filter():
    zeros, poles = [0.5, -2.0], [0.9, 0.3 + 0.4j, 0.3 - 0.4j]
    b, denominator = signal.zpk2tf(zeros, poles, 0.25)
    model = ARMA(tuple(-denominator[1:]), tuple(b))
    np.testing.assert_allclose(roots(model.poles()), roots(poles), atol=1e-12)
    np.testing.assert_allclose(roots(model.zeros()), roots(zeros), atol=1e-12)


def test_without_memory_there_are_no_poles_and_zeros():
    assert ARMA((), (2.0,)).poles().size == ARMA((), (2.0,)).zeros().size == 0


@settings(max_examples=50, deadline=None)
@given(st.integers(-10_000, 10_000).map(lambda n: 0.1 * n))
def test_scaling_sets_the_dc_gain_and_keeps_poles_and_zeros(gain):
    model = ARMA(MODEL_533_A, MODEL_533_B)
    scaled = scaled_to_dc(model, gain)
    np.testing.assert_allclose(scaled.dc_gain(), gain, rtol=1e-12)
    assert scaled.autoregressive == model.autoregressive
    ratios = np.array(scaled.moving) / np.array(model.moving)
    np.testing.assert_allclose(ratios, ratios[0], rtol=1e-12)


def test_published_dynamics_at_unit_gain():
    scaled = scaled_to_dc(ARMA(MODEL_533_A, MODEL_533_B), 1.0)
    np.testing.assert_allclose(scaled.moving, T2_G, rtol=1e-14)


@pytest.mark.parametrize(
    ("a", "b", "message"),
    [
        ((0.5,), (), "moving is empty; it must hold at least b_0"),
        ((0.5, np.nan), (1.0,), "autoregressive is nan; it must be finite"),
        ((0.5,), (1.0, -np.inf), "moving is -inf; it must be finite"),
    ],
)
def test_bad_coefficients_are_refused(a, b, message):
    with pytest.raises(ValueError, match=message):
        ARMA(a, b)
