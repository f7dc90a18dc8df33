import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles import hysteresis as oracle
from oracles.published import HYSTERESIS
from scipy.integrate import solve_ivp

from piezojax import (
    simulate,
)
from piezojax.core.system import Series
from piezojax.hysteresis import (
    ColemanHodgdon,
    InverseColemanHodgdon,
)

SCHEMES = ("trapezoid", "quadratic", "voros", "exact")
SECOND = 20_000  # samples of 1 s at 20 kHz


def model(scheme="trapezoid", parameters=HYSTERESIS, **rest):
    return ColemanHodgdon(*parameters, scheme=scheme, **rest)


@jax.jit
def response(system, inputs):
    return simulate(system, inputs, system.init(0.0))[1]


def draws(samples):
    # The explicit form of Voros diverges for steps above 2/|c| = 41 V.
    return np.random.default_rng(1).uniform(-10.0, 30.0, samples)


def sine(samples, periods=1):
    # Divisible by twice the periods, so that the extrema are samples.
    return 35.0 * (1.0 - np.cos(2.0 * np.pi * periods * np.arange(samples) / samples))


def pauses():
    lengths = np.random.default_rng(2).integers(1, 50, SECOND)
    return np.repeat(draws(SECOND), lengths)[:SECOND]


INPUTS = {"rough": draws(SECOND), "sine": sine(SECOND, 10), "pauses": pauses()}


@pytest.mark.parametrize("scheme", SCHEMES)
@pytest.mark.parametrize("inputs", INPUTS.values(), ids=INPUTS)
def test_each_scheme_equals_the_published_recursion(scheme, inputs):
    outputs = response(model(scheme), inputs)
    expected = getattr(oracle, scheme)(inputs, *HYSTERESIS)
    np.testing.assert_allclose(outputs, expected, rtol=0.0, atol=1e-9)
    assert outputs.dtype == jnp.float64


def test_exact_scheme_solves_the_differential_equation():
    a, b, c = HYSTERESIS
    corners = [0.0, 70.0, 10.0, 50.0, -15.0, 30.0]
    expected = [0.0]
    for start, stop in itertools.pairwise(corners):
        sign = np.sign(stop - start)
        branch = solve_ivp(
            lambda x, y, sign=sign: sign * (a * x + c * y) + b,
            (start, stop),
            expected[-1:],
            method="DOP853",
            rtol=1e-12,
            atol=1e-12,
        )
        expected.append(branch.y[0, -1])
    outputs = response(model("exact"), np.array(corners))
    np.testing.assert_allclose(outputs, expected, rtol=0.0, atol=1e-9)


@pytest.mark.parametrize(
    ("scheme", "order"), [("voros", 1.0), ("trapezoid", 2.0), ("quadratic", 3.0)]
)
def test_order_of_convergence(scheme, order):
    errors = []
    for samples in (64, 256, 1024):
        error = response(model(scheme), sine(samples))
        error -= oracle.exact(sine(samples), *HYSTERESIS)
        errors.append(np.sqrt(np.mean(error**2)))
    found = np.log(np.divide(errors[:-1], errors[1:])) / np.log(4.0)
    np.testing.assert_allclose(found, order, atol=0.1)


def test_exact_scheme_needs_no_fine_steps():
    coarse = response(model("exact"), sine(64))
    fine = response(model("exact"), sine(1024))
    np.testing.assert_allclose(coarse, fine[::16], rtol=0.0, atol=1e-12)


def test_quadratic_takes_trapezoid_steps_where_the_direction_turns():
    # Every sample is a turning point, so there is no parabola.
    zigzag = draws(101) + 60.0 * (np.arange(101) % 2)
    zigzag[0] = 0.0
    np.testing.assert_allclose(
        response(model("quadratic"), zigzag),
        response(model("trapezoid"), zigzag),
        rtol=0.0,
        atol=1e-12,
    )


@pytest.mark.parametrize("scheme", ["trapezoid", "voros", "exact"])
def test_repeated_samples_do_not_change_the_output(scheme):
    inputs = draws(100)
    slow = response(model(scheme), np.repeat(inputs, 3))
    for start in range(3):
        np.testing.assert_allclose(
            slow[start::3], response(model(scheme), inputs), rtol=0.0, atol=1e-11
        )


def test_quadratic_takes_trapezoid_steps_after_a_pause():
    inputs = draws(100)
    slow = response(model("quadratic"), np.repeat(inputs, 3))
    fast = response(model("trapezoid"), inputs)
    np.testing.assert_allclose(slow[2::3], fast, rtol=0.0, atol=1e-11)


@pytest.mark.parametrize("scheme", SCHEMES)
@pytest.mark.parametrize("rest", [(0.0, 0.0), (12.0, 3.0)])
def test_the_rest_state_is_on_the_loading_curve(scheme, rest):
    stage = model(scheme, rest_input=rest[0], rest_output=rest[1])
    for voltage in (-15.0, 0.0, 12.0, 90.0):
        state = stage.init(voltage)
        expected = oracle.exact_step(*rest, voltage, *HYSTERESIS)
        assert float(state.input) == voltage
        np.testing.assert_allclose(state.output, expected, rtol=0.0, atol=1e-12)
        after, output = stage.step(state, voltage)
        np.testing.assert_allclose(output, expected, rtol=0.0, atol=1e-12)
        assert jax.tree.structure(after) == jax.tree.structure(state)


@pytest.mark.parametrize("scheme", SCHEMES)
def test_slope_at_rest_equals_that_of_the_rising_branch(scheme):
    a, b, c = HYSTERESIS
    stage = model(scheme)
    state = stage.init(40.0)
    found = jax.grad(lambda x: stage.step(state, x)[1])(40.0)
    np.testing.assert_allclose(found, a * 40.0 + b + c * state.output, rtol=1e-12)


@pytest.mark.parametrize(
    ("parameters", "scheme", "message"),
    [
        ((0.1, 0.1, 0.0), "exact", r"c in 1/V is 0; it must be finite and below 0"),
        ((0.1, 0.1, 0.02), "exact", r"c in 1/V is 0\.02"),
        ((0.1, 0.1, np.nan), "exact", "c in 1/V is nan"),
        ((np.nan, 0.1, -0.1), "exact", r"a in um/V\^2 is nan; it must be finite"),
        ((0.1, np.inf, -0.1), "exact", "b in um/V is inf"),
        ((0.1, 0.1, -0.1), "cubic", "scheme 'cubic'; it must be one of .*'trapezoid'"),
    ],
)
def test_bad_parameters_are_refused(parameters, scheme, message):
    with pytest.raises(ValueError, match=message):
        model(scheme, parameters)


shares = st.floats(-1.0, 1.0).map(lambda share: round(share, 6))


@st.composite
def invertible(draw):
    b = draw(st.floats(0.05, 0.2))
    c = draw(st.floats(-0.1, -0.02))
    # Above a = 2 b |c| the falling branch starts upwards: no inverse.
    axis = draw(st.just(0.0) | st.floats(0.0, 1.6)) * b
    wanted = draw(st.lists(shares, min_size=16, max_size=16))
    # With a = 0 the output saturates at b/|c|.
    return (-axis * c, b, c), np.array(wanted) * 0.8 * b / -c


@settings(max_examples=60, deadline=None)
@given(invertible())
def test_inverse_then_model_is_the_identity(case):
    parameters, wanted = case
    stage = model(parameters=parameters)
    reached = response(Series((InverseColemanHodgdon(stage), stage)), wanted)
    np.testing.assert_allclose(reached, wanted, rtol=0.0, atol=1e-9)


def test_model_then_inverse_is_the_identity():
    stage = model()
    voltages = pauses()[:1000]
    found = response(Series((stage, InverseColemanHodgdon(stage))), voltages)
    np.testing.assert_allclose(found, voltages, rtol=0.0, atol=1e-8)


def test_inverse_equals_the_corrected_equation():
    noise = np.random.default_rng(4).normal(0.0, 0.012, SECOND)
    wanted = 5.0 * (1.0 - np.cos(2.0 * np.pi * np.arange(SECOND) / 2000)) + noise
    found = response(InverseColemanHodgdon(model()), wanted)
    expected = oracle.inverse_trapezoid(wanted, *HYSTERESIS, 0.0, 0.0)
    assert -20.0 < expected.min() < expected.max() < 120.0  # nothing was clipped
    np.testing.assert_allclose(found, expected, rtol=0.0, atol=1e-9)


@pytest.mark.parametrize("wanted", [-2.0, 0.0, 4.0, 13.0])
def test_the_inverse_at_rest_stays_at_rest(wanted):
    stage = model()
    inverse = InverseColemanHodgdon(stage)
    state = inverse.init(wanted)
    np.testing.assert_allclose(state.output, wanted, rtol=0.0, atol=1e-11)
    after, voltage = inverse.step(state, wanted)
    np.testing.assert_allclose(voltage, state.input, rtol=0.0, atol=1e-9)
    np.testing.assert_allclose(after.output, wanted, rtol=0.0, atol=1e-11)


@pytest.mark.parametrize("change", [0.0, 2.0, -2.0, 1e3, -1e3])
def test_gradient_of_the_inverse_is_finite(change):
    # At rest, up and down; with a < 0 the stroke is small.
    def voltage(stage, by):
        state = stage.init(30.0)
        return InverseColemanHodgdon(stage).solve(state, state.output + by)

    for stage in (model(), model(parameters=(-0.001, 0.15, -0.02))):
        found = jax.value_and_grad(voltage, argnums=(0, 1))(stage, change)
        assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(found))


def test_gradient_of_the_inverse_equals_the_reciprocal_slope():
    stage = model()
    state = stage.init(30.0)
    forward = jax.grad(lambda x: stage.step(state, x)[1])
    inverse = InverseColemanHodgdon(stage)
    for wanted in (float(state.output), 5.0, 1.0):
        back = jax.grad(lambda f: inverse.solve(state, f))(wanted)
        voltage = inverse.solve(state, wanted)
        np.testing.assert_allclose(back, 1.0 / forward(voltage), rtol=1e-9)


def test_inverse_of_another_scheme_is_refused():
    with pytest.raises(ValueError, match="scheme 'exact' is not available"):
        InverseColemanHodgdon(model("exact"))
