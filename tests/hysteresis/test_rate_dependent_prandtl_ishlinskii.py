import jax
import numpy as np
import pytest
from oracles import hysteresis as oracle

from piezojax import (
    simulate,
)
from piezojax.hysteresis import (
    PrandtlIshlinskii,
    RateDependentPrandtlIshlinskii,
)

DT = 1e-3
POLYNOMIAL = (0.1, 2e-4)
THRESHOLDS = (2.0, 7.0, 15.0)
WEIGHTS = (0.02, 0.015, 0.01)
GROWTH = 3e-3
REST = 5.0
MODEL = RateDependentPrandtlIshlinskii(
    POLYNOMIAL, THRESHOLDS, WEIGHTS, GROWTH, DT, REST
)
SAMPLES = 800


@jax.jit
def response(system, inputs):
    return simulate(system, inputs, system.init(inputs[0]))[1]


def sine(hertz):
    return 50.0 - 50.0 * np.cos(2.0 * np.pi * hertz * DT * np.arange(SAMPLES))


def area(hertz):
    """Return the area (V um) of the last whole loop."""
    x = sine(hertz)[-round(1.0 / (hertz * DT)) :]
    y = np.asarray(response(MODEL, sine(hertz)))[-x.size :]
    return abs(np.sum(0.5 * (y + np.roll(y, -1)) * (np.roll(x, -1) - x)))


def test_the_response_equals_plays_in_a_plain_loop():
    x = sine(7.0) + 10.0 * np.sin(2.0 * np.pi * 61.0 * DT * np.arange(SAMPLES))
    plays = oracle.rate_dependent_plays(x, THRESHOLDS, GROWTH, DT, REST)
    expected = POLYNOMIAL[0] * x + POLYNOMIAL[1] * x**2 + plays @ np.array(WEIGHTS)
    np.testing.assert_allclose(response(MODEL, x), expected, atol=1e-12)


def test_a_loop_widens_with_its_frequency():
    areas = [area(hertz) for hertz in (2.5, 5.0, 10.0)]
    assert areas[0] * 1.05 < areas[1] < areas[2] / 1.05


def test_a_slow_input_gives_the_rate_independent_model():
    x = 50.0 + 50.0 * np.sin(np.linspace(0.0, 6.0, SAMPLES))
    slow = RateDependentPrandtlIshlinskii(
        POLYNOMIAL, THRESHOLDS, WEIGHTS, GROWTH, 1e6, REST
    )
    plain = PrandtlIshlinskii(POLYNOMIAL, THRESHOLDS, WEIGHTS, REST)
    np.testing.assert_allclose(response(slow, x), response(plain, x), atol=1e-8)


@pytest.mark.parametrize(
    ("growth", "dt", "message"),
    [
        (-1e-3, DT, "growth in s is -0.001; it must be finite and at least 0"),
        (0.0, 0.0, "dt in s is 0; it must be finite and above 0"),
    ],
)
def test_bad_parameters(growth, dt, message):
    with pytest.raises(ValueError, match=message):
        RateDependentPrandtlIshlinskii(POLYNOMIAL, THRESHOLDS, WEIGHTS, growth, dt)
