import jax
import numpy as np
import pytest
from oracles import hysteresis as oracle

from piezojax import (
    simulate,
)
from piezojax.hysteresis import (
    InversePrandtlIshlinskii,
    StopPrandtlIshlinskii,
)

POLYNOMIAL = (0.2, 2e-4, -1e-6)
THRESHOLDS = (2.0, 7.0, 15.0)
WEIGHTS = (0.02, 0.015, 0.01)
REST = 5.0
MODEL = StopPrandtlIshlinskii(POLYNOMIAL, THRESHOLDS, WEIGHTS, REST)


def drive(samples=600):
    steps = np.random.default_rng(3).normal(size=samples)
    return np.clip(30.0 + 4.0 * np.cumsum(steps), -20.0, 120.0)


@jax.jit
def response(system, inputs):
    return simulate(system, inputs, system.init(inputs[0]))[1]


X = drive()


def test_play_and_stop_add_up_to_the_input():
    # first of two independent oracles, then of the package
    for r in THRESHOLDS:
        both = oracle.play(X, r, REST) + oracle.stop(X, r, REST)
        np.testing.assert_allclose(both, X, atol=1e-11)
    np.testing.assert_allclose(
        response(MODEL.as_plays(), X), response(MODEL, X), atol=1e-11
    )


def test_the_response_equals_springs_with_sliders():
    expected = sum(p * X ** (i + 1) for i, p in enumerate(POLYNOMIAL)) - sum(
        w * oracle.stop(X, r, REST) for w, r in zip(WEIGHTS, THRESHOLDS, strict=True)
    )
    np.testing.assert_allclose(response(MODEL, X), expected, atol=1e-11)


def test_the_inverse_is_that_of_plays():
    inverse = InversePrandtlIshlinskii(MODEL.as_plays())
    np.testing.assert_allclose(response(MODEL, response(inverse, X / 8.0)), X / 8.0)


@pytest.mark.parametrize(
    ("thresholds", "weights", "message"),
    [
        ((0.0,), (1.0,), "thresholds in V is 0; it must be finite and above 0"),
        ((1.0, 2.0), (1.0,), "2 thresholds and 1 weights"),
        ((1.0,), (np.inf,), "weights in um/V is inf"),
    ],
)
def test_bad_parameters(thresholds, weights, message):
    with pytest.raises(ValueError, match=message):
        StopPrandtlIshlinskii((1.0,), thresholds, weights)
