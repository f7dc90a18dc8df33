"""H-infinity designs against norms from NumPy, a closed form of gamma, a plain loop."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracles import signals
from oracles.hysteresis import clip

from piezojax import (
    Feedback,
    loop_inputs,
    simulate,
)
from piezojax.catalog import p753
from piezojax.control import (
    StateSpaceController,
    first_order_weight,
    mixed_sensitivity,
)
from piezojax.core.feedback import Observation
from piezojax.dynamics import (
    ARMA,
    StateSpace,
)
from piezojax.hardware import (
    Sensor,
)

DT = p753.DT
MODEL = (1.6035, -0.61995), (0.0050811, -0.0036354, 0.010553)  # (5.33)
THIRD = (1.2, -0.3, 0.02), (0.006, 0.002)
ERROR = {"low": 1e3, "crossover": 600.0, "high": 0.5}
OUTPUT = {"low": 0.5, "crossover": 6e3, "high": 10.0}
DESIGNS = {  # model, error weight, effort weight, output weight
    "two weights": (MODEL, ERROR, 0.1, None),
    "three weights": (MODEL, ERROR, 1e-3, OUTPUT),
    "third order": (THIRD, ERROR, 0.05, OUTPUT),
}


@cache
def designed(name):
    model, error, effort, output = DESIGNS[name]
    return mixed_sensitivity(
        ARMA(*model),
        first_order_weight(**error, dt=DT),
        effort,
        None if output is None else first_order_weight(**output, dt=DT),
        dt=DT,
    )


def grid():
    return np.concatenate(
        [np.geomspace(1e-8, 1e-2, 2_000), np.linspace(0, np.pi, 9_000)]
    )


def response(model, w):
    """Return the response of the model with a sample of delay at w rad/sample."""
    a, b = model
    back = np.exp(-1j * w)
    numerator = sum(x * back ** (i + 1) for i, x in enumerate(b))
    return numerator / (1.0 - sum(x * back ** (i + 1) for i, x in enumerate(a)))


def law_response(law, w):
    A, B, C, D = (np.array(x) for x in (law.A, law.B, law.C, law.D))
    values, basis = np.linalg.eig(A)
    left, right = (C @ basis)[0], np.linalg.solve(basis, B + 0j)[:, 0]
    poles = np.exp(1j * w)[:, None] - values
    return (left * right / poles).sum(axis=1) + D[0, 0]


def weight_response(low, crossover, high, w):
    """Return (high s + low p) / (s + p), bilinear, prewarped to 1 at the crossover."""
    scale = crossover / np.tan(0.5 * crossover * DT)
    s = 1j * scale * np.tan(0.5 * np.minimum(w, np.pi - 1e-9))
    p = crossover * np.sqrt((1.0 - high**2) / (low**2 - 1.0))
    return (high * s + low * p) / (s + p)


def weighted(name, law):
    model, error, effort, output = DESIGNS[name]
    w = grid()
    G, K = response(model, w), law_response(law, w)
    S = 1.0 / (1.0 + G * K)
    total = np.abs(weight_response(**error, w=w) * S) ** 2 + np.abs(effort * K * S) ** 2
    if output is not None:
        total += np.abs(weight_response(**output, w=w) * G * K * S) ** 2
    return np.sqrt(total)


def closed_loop_poles(model, law):
    A, B, C, D = (np.array(x) for x in (law.A, law.B, law.C, law.D))
    a, b = model
    n = max(len(a), len(b))
    G = np.eye(n, k=1)
    G[: len(a), 0] += a
    drive = np.zeros((n, 1))
    drive[: len(b), 0] = b
    y = np.eye(1, n)
    return np.linalg.eigvals(np.block([[G - drive @ D @ y, drive @ C], [-B @ y, A]]))


@pytest.mark.parametrize("name", DESIGNS)
def test_the_weighted_norm_stays_below_gamma_and_near_it(name):
    design = designed(name)
    norm = weighted(name, design.controller.law).max()
    assert norm < design.gamma
    assert norm > 0.99 * design.gamma


@pytest.mark.parametrize("name", DESIGNS)
def test_the_loop_is_stable(name):
    poles = closed_loop_poles(DESIGNS[name][0], designed(name).controller.law)
    assert np.abs(poles).max() < 1.0


def test_gamma_equals_the_bound_from_the_zeros():
    # With almost no effort weight only the zeros of G outside the circle, -1.3 and
    # infinity (the delay), bound W1 S, which equals W1 there: Nevanlinna and Pick.
    weight = first_order_weight(100.0, 3_000.0, 0.3, DT)
    A, B, C, D = (float(x[0, 0]) for x in (weight.A, weight.B, weight.C, weight.D))
    values = np.array([C * B / (-1.3 - A) + D, D])
    nodes = np.array([-1.0 / 1.3, 0.0])
    pick = 1.0 / (1.0 - np.outer(nodes, nodes))
    squares = np.linalg.eigvals(np.linalg.solve(pick, np.outer(values, values) * pick))
    design = mixed_sensitivity(ARMA((1.5, -0.56), (0.02, 0.026)), weight, 1e-6, dt=DT)
    np.testing.assert_allclose(design.gamma, np.sqrt(squares.real.max()), rtol=2e-3)


def test_a_larger_effort_weight_reduces_the_effort():
    weight = first_order_weight(**ERROR, dt=DT)
    w = grid()
    efforts = []
    for effort in (0.05, 0.5):
        law = mixed_sensitivity(ARMA(*MODEL), weight, effort, dt=DT).controller.law
        K = law_response(law, w)
        efforts.append(np.abs(K / (1.0 + response(MODEL, w) * K)).max())
    assert efforts[1] < 0.5 * efforts[0]


@pytest.mark.parametrize("gains", [(1e3, 600.0, 0.5), (0.1, 2e4, 5.0)])
def test_the_weight_has_its_gains(gains):
    low, crossover, high = gains
    weight = first_order_weight(low, crossover, high, DT)
    found = weight.frequency_response(
        np.array([0.0, crossover / (2.0 * np.pi), 0.5 / DT])
    )
    np.testing.assert_allclose(np.abs(found[:, 0, 0]), (low, 1.0, high), rtol=1e-9)


@jax.jit
def run(loop, reference, draws):
    return simulate(loop, loop_inputs(reference, draws), loop.init(reference[0]))[1]


@pytest.mark.parametrize("start", [0.0, 3.0])
def test_the_loop_equals_numpy_and_starts_without_a_bump(start):
    law = designed("two weights").controller.law
    stage = ARMA(*MODEL)
    loop = Feedback(StateSpaceController(law), stage, p753.actuator(), Sensor(0.012))
    reference = signals.ten_references()["SIN50"][:-1] + start
    reference[:100] = start
    draws = np.random.default_rng(5).normal(size=reference.size)
    draws[:100] = 0.0
    found = run(loop, jnp.asarray(reference), jnp.asarray(draws))

    A, B, C, D = (np.array(x) for x in (law.A, law.B[:, 0], law.C[0], law.D[0, 0]))
    (a1, a2), b = MODEL
    rest = start * (1.0 - a1 - a2) / sum(b)
    x, y, past = np.zeros(len(A)), [start, start], [rest, rest]
    outputs, inputs = [], []
    for r, draw in zip(reference, draws, strict=True):
        error = r - (y[0] + 0.012 * draw)
        u = clip(rest + C @ x + D * error, -20.0, 120.0)
        x = A @ x + B * error
        outputs.append(y[0])
        inputs.append(u)
        y = [a1 * y[0] + a2 * y[1] + b[0] * u + b[1] * past[0] + b[2] * past[1], y[0]]
        past = [u, past[0]]
    np.testing.assert_allclose(found.displacement, outputs, rtol=0.0, atol=1e-9)
    np.testing.assert_allclose(found.voltage, inputs, rtol=0.0, atol=1e-8)
    np.testing.assert_allclose(found.voltage[:100], rest, rtol=0.0, atol=1e-9)


def test_the_loop_tracks_with_the_inverse_hysteresis():
    loop = p753.loop(p753.mixed_sensitivity_inversion())
    reference = jnp.asarray(signals.ten_references()["SIN10"][:8_000])
    found = run(loop, reference, jnp.zeros(reference.size))
    error = found.displacement - reference
    assert np.sqrt(np.mean(error[4_000:] ** 2)) < 0.1
    seen = Observation(*map(jnp.asarray, (5.0, 5.0, 5.0, 31.0)))
    state = loop.controller.init(seen)
    for _ in range(3):
        state, voltage = loop.controller.step(state, seen)
        np.testing.assert_allclose(voltage, 31.0, rtol=0.0, atol=1e-9)


W1 = first_order_weight(**ERROR, dt=DT)
WIDE = StateSpace([[0.5]], [[1.0, 0.0]], [[1.0]], [[0.0, 0.0]], DT)
LEAKLESS = StateSpace([[1.0]], [[1.0]], [[1.0]], [[0.0]], DT)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (
            lambda: mixed_sensitivity(ARMA((1.1,), (1.0,)), W1, 0.1, dt=DT),
            "the model has a pole of modulus 1.1; all must be below 1",
        ),
        (
            lambda: mixed_sensitivity(ARMA(*MODEL), LEAKLESS, 0.1, dt=DT),
            "error_weight has a pole of modulus 1; all must be below 1",
        ),
        (
            lambda: mixed_sensitivity(ARMA(*MODEL), W1, 0.1, WIDE, dt=DT),
            "output_weight must have one input and one output",
        ),
        (
            lambda: mixed_sensitivity(ARMA(*MODEL), W1, 0.1, dt=1e-3),
            "error_weight has dt = 5e-05 s; it must be 0.001 s",
        ),
        (
            lambda: mixed_sensitivity(ARMA(*MODEL), W1, 0.0, dt=DT),
            "effort_weight is 0; it must be finite and above 0",
        ),
        (
            lambda: first_order_weight(2.0, 600.0, 3.0, DT),
            "low is 2 and high 3; one must be above 1, the other below",
        ),
        (
            lambda: first_order_weight(2.0, 7e4, 0.5, DT),
            "crossover in rad/s is 70000; it must be .* below 62831",
        ),
        (lambda: first_order_weight(-2.0, 60.0, 0.5, DT), "gains low and high is -2"),
        (
            lambda: StateSpaceController(WIDE),
            "the law has 2 inputs and 1 outputs; it must have 1 and 1",
        ),
    ],
)
def test_bad_designs_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()
