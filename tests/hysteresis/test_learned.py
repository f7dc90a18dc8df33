"""The learned operator: its equation, and a loop that no other model represents."""

import jax
import numpy as np
import pytest
from oracles import hysteresis as oracle

from piezojax import (
    Record,
    identify,
    simulate,
)
from piezojax.hysteresis import (
    LearnedOperator,
)
from piezojax.identification.chain import chain

DT = 0.01
A = (0.5, -0.1)
LINEAR = (1.0, 0.4, 0.2, 0.3)
MIXING = [[0.5, -1.0, 0.2, 0.1], [1.0, 0.3, -0.8, -0.4], [-0.2, 0.6, 0.9, 0.5]]
BIAS, OUTPUT = (0.1, -0.3, 0.2), (0.5, -0.2, 0.7)
THRESHOLDS = (0.2, 0.5)
CENTRE, SCALE, PACE, REST = 30.0, 40.0, 3.0, 5.0
MODEL = LearnedOperator(
    A, LINEAR, MIXING, BIAS, OUTPUT, THRESHOLDS, CENTRE, SCALE, PACE, REST
)


@jax.jit
def response(system, inputs):
    return simulate(system, inputs, system.init(inputs[0]))[1]


def drive(samples):
    steps = np.random.default_rng(3).normal(size=samples)
    return np.clip(30.0 + 3.0 * np.cumsum(steps), -20.0, 120.0)


def driven(x):
    """Return the part of the output from the equations in the docstring."""
    v, rest = (x - CENTRE) / SCALE, (REST - CENTRE) / SCALE
    plays = [oracle.play(v, r, rest) for r in THRESHOLDS]
    s = np.stack([v, *plays, np.diff(x, prepend=x[0]) / PACE])
    hidden = np.tanh(np.array(MIXING) @ s + np.array(BIAS)[:, None])
    return np.array(LINEAR) @ s + np.array(OUTPUT) @ hidden


def test_the_response_equals_the_equation():
    x = drive(300)
    n = driven(x)
    y = [n[0] / (1.0 - sum(A))] * 2
    for value in n:
        y.append(A[0] * y[-1] + A[1] * y[-2] + value)
    np.testing.assert_allclose(response(MODEL, x), y[2:], atol=1e-11)


def test_the_operator_contains_its_dynamics():
    assert chain("learned_operator") == ["learned_operator"]
    assert chain("prandtl_ishlinskii") == ["prandtl_ishlinskii", "lag"]


def strange_loop(u):
    """Return the output of a stage whose slope depends on the state of its play.

    The product of a play and a saturated play, then a lag that is slower on the way
    down. No other model represents such a loop.
    """
    inner, outer = oracle.play(u, 6.0, 0.0), oracle.play(u, 15.0, 0.0)
    force = 0.08 * inner + 1.5 * np.tanh(outer / 30.0) * (1.0 + 0.01 * inner)
    y = [0.0]
    for f in force[:-1]:
        y.append(y[-1] + (0.7 if f > y[-1] else 0.45) * (f - y[-1]))
    return np.array(y)


NOISE = 5e-3


@pytest.fixture(scope="module")
def record():
    time = DT * np.arange(900)
    level = np.select([time < 2.0, time < 4.0, time < 7.0], [1.0, 0.5, 0.8], 0.6)
    u = 50.0 - 50.0 * level * np.cos(2.0 * np.pi * (1.1 + 0.25 * time) * time)
    u[0] = 0.0
    noise = NOISE * np.random.default_rng(1).standard_normal(u.size)
    return Record(u, strange_loop(u) + noise, DT, source="a strange loop")


def linear_error(record, train, validate, taps=25):
    """Return the held-out error (um) of the best impulse response with an offset."""
    past = np.stack(
        [
            np.concatenate([np.full(i, record.input[0]), record.input])[
                : record.samples
            ]
            for i in range(1, taps + 1)
        ]
        + [np.ones(record.samples)],
        axis=1,
    )
    weights = np.linalg.lstsq(past[train], record.output[train], rcond=None)[0]
    return np.sqrt(np.mean((past[validate] @ weights - record.output[validate]) ** 2))


@pytest.mark.slow
def test_the_operator_fits_a_loop_that_no_linear_model_fits(record):
    train, validate = slice(0, 600), slice(600, 900)
    fit = identify(record, "learned_operator", train=train, validate=validate)
    assert len(fit.report.parameters) < 60
    linear = linear_error(record, train, validate)
    assert linear > 10.0 * NOISE
    assert fit.report.validation.rmse < 0.2 * linear


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"linear": (1.0,)}, "linear has 1 weights; with 2 plays and 3 neurons"),
        (
            {"mixing": MIXING[:2]},
            "each column of mixing has 2 weights; .* it must have 3",
        ),
        ({"bias": (0.1, np.nan, 0.0)}, "bias is nan"),
        ({"thresholds": (0.0, 1.0)}, "thresholds is 0"),
        ({"scale": 0.0}, "scale in V is 0; it must be finite and above 0"),
        ({"pace": -1.0}, "pace in V is -1"),
        ({"autoregressive": (1.2, -0.2)}, "autoregressive part is 1; .* below 1"),
    ],
)
def test_bad_parameters(change, message):
    fields = {
        "autoregressive": A,
        "linear": LINEAR,
        "mixing": MIXING,
        "bias": BIAS,
        "output": OUTPUT,
        "thresholds": THRESHOLDS,
        "centre": CENTRE,
        "scale": SCALE,
        "pace": PACE,
    }
    with pytest.raises(ValueError, match=message):
        LearnedOperator(**(fields | change))
