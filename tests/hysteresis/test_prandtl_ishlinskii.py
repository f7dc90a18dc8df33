import jax
import numpy as np
import pytest
from oracles import hysteresis as oracle

from piezojax import (
    simulate,
)
from piezojax.hysteresis import (
    AsymmetricPrandtlIshlinskii,
    PrandtlIshlinskii,
)

POLYNOMIAL = (0.1, 2e-4, -1e-6)
THRESHOLDS = (2.0, 7.0, 15.0)
WEIGHTS = (0.02, 0.015, 0.01)
SKEW = (-0.01, 0.004, 0.02)
REST = 5.0


def symmetric():
    return PrandtlIshlinskii(POLYNOMIAL, THRESHOLDS, WEIGHTS, REST)


def asymmetric():
    return AsymmetricPrandtlIshlinskii(
        POLYNOMIAL, THRESHOLDS, WEIGHTS, SKEW, -20.0, 120.0, REST
    )


MODELS = {"symmetric": symmetric, "asymmetric": asymmetric}


def drive(samples=600):
    steps = np.random.default_rng(3).normal(size=samples)
    return np.clip(30.0 + 4.0 * np.cumsum(steps), -20.0, 120.0)


@jax.jit
def response(system, inputs, start):
    return simulate(system, inputs, system.init(start))[1]


def expected(x, skewed):
    memoryless = sum(p * x ** (i + 1) for i, p in enumerate(POLYNOMIAL))
    plays = [
        w * oracle.play(x, r, REST) for w, r in zip(WEIGHTS, THRESHOLDS, strict=True)
    ]
    total = memoryless + sum(plays)
    if skewed:

        def square(v):
            return 0.5 * np.maximum(v + 20.0, 0.0) ** 2 / 120.0

        total += sum(
            w * oracle.play(square(x), r, square(REST))
            for w, r in zip(SKEW, THRESHOLDS, strict=True)
        )
    return total


@pytest.mark.parametrize("name", MODELS)
def test_the_response_equals_plays_in_a_plain_loop(name):
    x = drive()
    x[0] = 12.0  # the single step of init from the virgin state
    found = response(MODELS[name](), x, x[0])
    np.testing.assert_allclose(found, expected(x, name == "asymmetric"), atol=1e-12)


def test_the_asymmetric_loop_is_wider_on_one_side():
    model = asymmetric()
    up = np.linspace(0.0, 100.0, 101)
    y = np.asarray(response(model, np.concatenate([up, up[::-1], up, up[::-1]]), 0.0))
    width = y[303:404][::-1] - y[202:303]
    assert abs(width[20:50].mean() - width[51:81].mean()) > 0.1
    symmetric_y = np.asarray(
        response(symmetric(), np.concatenate([up, up[::-1], up, up[::-1]]), 0.0)
    )
    even = symmetric_y[303:404][::-1] - symmetric_y[202:303]
    np.testing.assert_allclose(even, even[::-1], atol=1e-12)


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: PrandtlIshlinskii((1.0,), (0.0,), (1.0,)), "thresholds in V is 0"),
        (lambda: PrandtlIshlinskii((1.0,), (1.0, 2.0), (1.0,)), "2 thresholds and 1"),
        (
            lambda: PrandtlIshlinskii((np.nan,), (1.0,), (1.0,)),
            "polynomial .* nan",
        ),
        (
            lambda: AsymmetricPrandtlIshlinskii((1.0,), (1.0,), (1.0,), (), 0.0, 1.0),
            "1 thresholds and 0 skew weights",
        ),
        (
            lambda: AsymmetricPrandtlIshlinskii((), (1.0,), (1.0,), (1.0,), 0.0, 0.0),
            "scale in V is 0; it must be finite and above 0",
        ),
    ],
)
def test_bad_parameters(build, message):
    with pytest.raises(ValueError, match=message):
        build()
