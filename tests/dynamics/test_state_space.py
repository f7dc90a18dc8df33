"""StateSpace against a plain loop, scipy.signal and closed forms."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles import state_space as oracle
from scipy import signal

from piezojax import (
    load,
    save,
    simulate,
)
from piezojax.catalog import p558
from piezojax.core.serial import from_data, to_data
from piezojax.core.system import rest_output
from piezojax.dynamics import (
    StateSpace,
    stabilised,
    stacked,
)

DT = 2e-3
SIZES = {"one": (1, 1, 1), "wide": (5, 2, 3), "tall": (4, 3, 1), "large": (12, 3, 3)}


def drawn(seed, sizes):
    matrices = oracle.random_stable(seed, *sizes)
    return matrices, StateSpace(*matrices, DT)


def inputs(channels, samples=200):
    return np.random.default_rng(9).standard_normal((samples, channels))


@pytest.fixture(params=SIZES.values(), ids=SIZES)
def both(request):
    return drawn(3, request.param)


def test_the_response_equals_the_equation(both):
    (A, B, C, D), model = both
    u = inputs(B.shape[1])
    expected = oracle.simulate(A, B, C, D, u, np.zeros(len(A)))
    for run in (simulate, jax.jit(simulate)):
        found = run(model, u, model.init())[1]
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-10)


def test_the_response_equals_that_of_scipy(both):
    (A, B, C, D), model = both
    u = inputs(B.shape[1])
    _, expected, _ = signal.dlsim((A, B, C, D, DT), u)
    np.testing.assert_allclose(simulate(model, u)[1], expected, rtol=0, atol=1e-10)


def test_dc_gain_equals_the_closed_form(both):
    (A, B, C, D), model = both
    level = jnp.arange(1.0, 1.0 + B.shape[1])
    gain = C @ np.linalg.solve(np.eye(len(A)) - A, B) + D
    np.testing.assert_allclose(rest_output(model, level), gain @ level, rtol=1e-9)
    np.testing.assert_allclose(model.dc_gain(), gain, rtol=1e-9, atol=1e-12)


def test_frequency_response_equals_that_of_scipy(both):
    (A, B, C, D), model = both
    frequency = np.linspace(0.0, 240.0, 50)
    found = model.frequency_response(frequency)
    for channel in range(B.shape[1]):
        numerators, denominator = signal.ss2tf(A, B, C, D, channel)
        for row, numerator in enumerate(numerators):
            _, expected = signal.freqz(numerator, denominator, frequency, fs=1 / DT)
            # A transfer function of order 12 loses some digits.
            np.testing.assert_allclose(
                found[:, row, channel], expected, rtol=1e-5, atol=1e-8
            )


def test_markov_parameters_are_the_impulse_response(both):
    (A, B, C, D), model = both
    found = model.markov(12)
    expected = oracle.markov(A, B, C, 12)
    np.testing.assert_allclose(found, expected, rtol=1e-10, atol=1e-12)
    for channel in range(B.shape[1]):
        impulse = np.zeros((13, B.shape[1]))
        impulse[0, channel] = 1.0
        response = simulate(model, impulse, model.init())[1]
        np.testing.assert_allclose(response[0], D[:, channel], atol=1e-12)
        np.testing.assert_allclose(response[1:], found[:, :, channel], atol=1e-10)


def test_poles_are_those_of_a_known_filter():
    zeros, poles = [0.5], [0.9, 0.3 + 0.4j, 0.3 - 0.4j]
    model = StateSpace(*signal.zpk2ss(zeros, poles, 0.25), DT)
    np.testing.assert_allclose(
        np.sort_complex(model.poles()), np.sort_complex(poles), atol=1e-12
    )


def test_ahead_returns_the_next_output():
    model = p558.model("7")
    u = jnp.asarray(inputs(3, 50))
    _, now = simulate(model, u, model.init())
    _, ahead = simulate(model.one_step_ahead(), u, model.init())
    np.testing.assert_allclose(ahead[:-1], now[1:], rtol=0, atol=1e-13)
    level = jnp.array([1.0, -2.0, 3.0])
    np.testing.assert_allclose(
        rest_output(model.one_step_ahead(), level), model.dc_gain() @ level, rtol=1e-10
    )


def test_an_algebraic_loop_is_refused(both):
    with pytest.raises(ValueError, match=r"D is not zero; y\(k\) must not depend on u"):
        both[1].one_step_ahead()


def test_stacked_channels_have_the_sum_of_the_responses():
    channels = [drawn(seed, (3 + seed, 1, 3))[1] for seed in range(3)]
    u = inputs(3)
    whole = simulate(stacked(channels), u)[1]
    alone = [simulate(c, u[:, [i]])[1] for i, c in enumerate(channels)]
    np.testing.assert_allclose(whole, sum(alone), rtol=0, atol=1e-10)
    assert stacked(channels).order == 12


@settings(max_examples=30)
@given(st.integers(0, 10_000), st.integers(1, 8), st.floats(0.5, 1.8))
def test_stabilised_reflects_poles_outside_the_circle(seed, order, largest):
    (A, B, C, D), _ = drawn(seed, (order, 1, 1))
    model = StateSpace(A * largest / 0.9, B, C, D, DT)
    before, (after, moved) = model.poles(), stabilised(model)
    outside = np.abs(before) >= 1.0
    assert moved == np.sum(outside)
    assert np.abs(after.poles()).max() < 1.0
    expected = np.where(outside, 1.0 / np.conj(before), before)
    for pole in after.poles():
        # Random matrices are non-normal: their poles have rounding errors.
        assert np.abs(expected - pole).min() < 1e-5
    if not moved:
        np.testing.assert_array_equal(after.A, model.A)


def test_a_pole_on_the_circle_moves_inside():
    ones = np.ones((1, 1))
    model, moved = stabilised(StateSpace(ones, ones, ones, ones, DT))
    assert moved == 1
    assert 0.999 < model.A[0, 0] < 1.0


@pytest.mark.parametrize("name", ["model.json", "model.toml"])
def test_a_model_is_saved_and_loaded(tmp_path, name):
    model = p558.model("6")
    save(model, tmp_path / name)
    back = load(tmp_path / name)
    assert back.dt == model.dt
    for matrix in "ABCD":
        np.testing.assert_array_equal(getattr(back, matrix), getattr(model, matrix))


EYE, ONE = np.eye(2), np.ones((2, 1))


@pytest.mark.parametrize(
    ("matrices", "dt", "message"),
    [
        ((np.ones((2, 3)), ONE, EYE, ONE), DT, r"A has shape \(2, 3\); with B of"),
        ((EYE, ONE, np.ones((2, 3)), ONE), DT, r"C has shape \(2, 3\); .* be \(2, 2\)"),
        ((EYE, ONE, EYE, EYE), DT, r"D has shape \(2, 2\); .* must be \(2, 1\)"),
        ((EYE, ONE, EYE, [1.0, 2.0]), DT, r"a matrix has shape \(2,\); it must be 2-"),
        (([[1.0, 2.0], [3.0]], ONE, EYE, ONE), DT, "rows of numbers of one length"),
        (
            (EYE, ONE, np.nan * EYE, ONE),
            DT,
            r"C is \[\[nan nan\][^;]*; it must be finite",
        ),
        ((EYE, ONE, EYE, ONE), 0.0, "dt in s is 0; it must be .* above 0"),
    ],
)
def test_bad_models_are_refused(matrices, dt, message):
    with pytest.raises(ValueError, match=message):
        StateSpace(*matrices, dt)


@pytest.mark.parametrize(
    ("value", "message"),
    [
        (3.0, "system.A is 3.0; it must be a list of rows of numbers"),
        ([["a"]], "it must be a list of rows of numbers"),
        ([[1.0], [1.0, 2.0]], "it must be a list of rows of numbers"),
        ([1.0], "it must be a list of rows of numbers"),
    ],
)
def test_a_file_with_a_bad_matrix_is_refused(value, message):
    data = to_data(StateSpace([[0.5]], [[1.0]], [[1.0]], [[0.0]], DT))
    with pytest.raises(ValueError, match=message):
        from_data({**data, "A": value})


def test_inconsistent_channels_are_refused():
    two, three = drawn(1, (2, 1, 2))[1], drawn(1, (2, 1, 3))[1]
    with pytest.raises(ValueError, match=r"channels differ in .*\(2, 0.002\), \(3, 0."):
        stacked([two, three])
    with pytest.raises(ValueError, match="there are no channels to stack"):
        stacked([])


# Printed stage


@pytest.mark.parametrize(
    ("chapter", "order", "poles", "gain", "first"),
    [
        (
            "6",
            15,
            (0.67, 0.973),
            (0.991, 1.015, 0.937),
            (0.0255, 0.0193, 0.0188),
        ),
        ("7", 9, (0.0, 0.876), (1.038, 0.938, 0.943), (0.0207, 0.0342, 0.0342)),
    ],
)
def test_the_printed_models(chapter, order, poles, gain, first):
    model = p558.model(chapter)
    modulus = np.abs(model.poles())
    assert model.order == order
    assert poles[0] - 0.005 < modulus.min()
    assert modulus.max() == pytest.approx(poles[1], abs=5e-4)
    np.testing.assert_allclose(np.diag(model.dc_gain()), gain, atol=6e-4)
    np.testing.assert_allclose(np.diag(model.markov(1)[0]), first, atol=6e-5)


def test_an_unknown_chapter_is_refused():
    with pytest.raises(ValueError, match="chapter '8' prints no model; it must be one"):
        p558.channels("8")
