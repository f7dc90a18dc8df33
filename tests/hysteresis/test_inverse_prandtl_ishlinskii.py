import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles import hysteresis as oracle

from piezojax import (
    simulate,
)
from piezojax.control import (
    InverseFeedforward,
)
from piezojax.core.feedback import Observation
from piezojax.core.system import Series, rest_output
from piezojax.hysteresis import (
    InversePrandtlIshlinskii,
    InverseRateDependentPrandtlIshlinskii,
    PrandtlIshlinskii,
    RateDependentPrandtlIshlinskii,
)

DT = 1e-3
THRESHOLDS = (2.0, 7.0, 15.0)
WEIGHTS = (0.02, -0.015, 0.03)  # one negative weight; the slope stays positive
REST = 5.0
POLYNOMIALS = {"linear": (0.1,), "cubic": (0.1, 2e-4, 1e-6)}
INVERSES = {
    PrandtlIshlinskii: InversePrandtlIshlinskii,
    RateDependentPrandtlIshlinskii: InverseRateDependentPrandtlIshlinskii,
}


def inverse_of(model):
    return INVERSES[type(model)](model)


def plain(polynomial):
    return PrandtlIshlinskii(polynomial, THRESHOLDS, WEIGHTS, REST)


def rated(polynomial):
    return RateDependentPrandtlIshlinskii(
        polynomial, THRESHOLDS, WEIGHTS, 2e-3, DT, REST
    )


MODELS = {
    f"{kind.__name__} {name}": kind(polynomial)
    for kind in (plain, rated)
    for name, polynomial in POLYNOMIALS.items()
}


@pytest.fixture(params=MODELS)
def model(request):
    return MODELS[request.param]


@jax.jit
def response(system, inputs):
    return simulate(system, inputs, system.init(inputs[0]))[1]


unit = st.floats(-1.0, 1.0)


@st.composite
def cases(draw):
    """Return models that rise for any input; a fifth of them only within 150 V."""
    slope = draw(st.floats(0.02, 0.5))
    gaps = draw(st.lists(st.floats(0.1, 20.0), min_size=4, max_size=4))
    weights, total, least = [], slope, slope
    for share in draw(st.lists(st.floats(-0.4, 1.0), min_size=4, max_size=4)):
        weights.append(share * total)
        total += weights[-1]
        least = min(least, total)  # the smallest slope of any moving plays
    bend = draw(unit)
    if draw(st.integers(0, 4)):
        cubic = draw(st.floats(1e-9, 1e-5))
        curve = (0.9 * bend * np.sqrt(3.0 * least * cubic), cubic)
    else:
        curve = (0.15 * bend * slope / 150.0, -0.1 * slope / 150.0**2)
        weights = [abs(w) for w in weights]
    wanted = draw(st.lists(unit, min_size=16, max_size=16))
    rest = 10.0 * draw(unit)
    return slope, curve, np.cumsum(gaps), weights, rest, 40.0 * slope * np.array(wanted)


@pytest.mark.parametrize("curved", [False, True])
@settings(max_examples=150)
@given(cases())
def test_inverse_then_model_is_the_identity(curved, case):
    slope, curve, thresholds, weights, rest, wanted = case
    polynomial = (slope, *curve) if curved else (slope,)
    model = PrandtlIshlinskii(polynomial, thresholds, weights, rest)
    reached = response(Series((inverse_of(model), model)), wanted)
    np.testing.assert_allclose(reached, wanted, rtol=0.0, atol=1e-9)


@settings(max_examples=100)
@given(cases(), st.floats(0.0, 0.02))
def test_the_rate_dependent_inverse_is_as_exact(case, growth):
    slope, _, thresholds, weights, rest, wanted = case
    model = RateDependentPrandtlIshlinskii(
        (slope,), thresholds, weights, growth, DT, rest
    )
    reached = response(Series((inverse_of(model), model)), wanted)
    np.testing.assert_allclose(reached, wanted, rtol=0.0, atol=1e-9)


@pytest.mark.parametrize("name", ["plain linear", "rated linear"])
def test_model_then_inverse_is_the_identity(name):
    model = MODELS[name]
    steps = np.random.default_rng(5).normal(size=400)
    voltages = np.clip(30.0 + 4.0 * np.cumsum(steps), -20.0, 120.0)
    found = response(Series((model, inverse_of(model))), voltages)
    np.testing.assert_allclose(found, voltages, rtol=0.0, atol=1e-8)


def test_inverse_equals_the_operator_of_krejci_and_kuhnen():
    inverse = inverse_of(MODELS["plain linear"])
    steps = np.random.default_rng(4).normal(size=400)
    wanted = 4.0 + 0.6 * np.cumsum(steps)
    expected = oracle.inverse_prandtl_ishlinskii(wanted, 0.1, THRESHOLDS, WEIGHTS, REST)
    np.testing.assert_allclose(response(inverse, wanted), expected, atol=1e-10)
    found = response(inverse.operator(), wanted)
    np.testing.assert_allclose(found, expected, atol=1e-10)


def test_the_inverse_is_exact_after_a_clipped_voltage(model):
    # The state is that of the model, so the step after any applied voltage is right.
    inverse = inverse_of(model)
    state = inverse.init(3.0)
    for applied, wanted in ((80.0, 2.0), (-15.0, 6.0), (90.0, 11.0)):
        state, _ = model.step(state, applied)
        voltage = inverse.solve(state, wanted)
        state, reached = model.step(state, voltage)
        np.testing.assert_allclose(reached, wanted, atol=1e-10)


@pytest.mark.parametrize("wanted", [-3.0, 0.0, 4.0, 12.0])
def test_the_inverse_at_rest_stays_at_rest(model, wanted):
    inverse = inverse_of(model)
    state = inverse.init(wanted)
    after, voltage = inverse.step(state, wanted)
    for one, other in zip(jax.tree.leaves(state), jax.tree.leaves(after), strict=True):
        np.testing.assert_allclose(one, other, atol=1e-9)
    np.testing.assert_allclose(rest_output(model, voltage), wanted, atol=1e-10)


def test_jit_equals_eager(model):
    inverse = inverse_of(model)
    state = model.step(model.init(30.0), 55.0)[0]
    jitted = jax.jit(lambda s, f: inverse.solve(s, f))
    for wanted in (9.0, 1.0):
        eager = inverse.solve(state, wanted)
        np.testing.assert_allclose(jitted(state, wanted), eager, rtol=1e-12)


def test_gradient_of_the_inverse_equals_the_reciprocal_slope(model):
    state = model.step(model.init(30.0), 55.0)[0]
    inverse = inverse_of(model)
    for wanted in (9.0, 6.0, 1.0):
        voltage = inverse.solve(state, wanted)
        forward = jax.grad(lambda x: model.step(state, x)[1])(voltage)
        back = jax.grad(lambda f: inverse.solve(state, f))(wanted)
        np.testing.assert_allclose(back, 1.0 / forward, rtol=1e-9)


def test_gradients_of_the_parameters_equal_central_differences():
    model = MODELS["rated cubic"]
    leaves, tree = jax.tree.flatten(model)
    state = model.step(model.init(30.0), 31.0)[0]

    @jax.jit
    def voltage(values):
        return inverse_of(jax.tree.unflatten(tree, list(values))).solve(state, 8.0)

    values = jnp.stack(leaves)
    found = jax.grad(voltage)(values)
    for i, size in enumerate(np.maximum(1e-6 * np.abs(values), 1e-9)):
        step = size * np.eye(values.size)[i]
        slope = (voltage(values + step) - voltage(values - step)) / (2 * size)
        np.testing.assert_allclose(found[i], slope, rtol=1e-5, atol=1e-7)


def test_out_of_reach_the_voltage_and_its_gradient_are_finite():
    # P falls beyond 58 V, so large outputs are unreachable.
    model = PrandtlIshlinskii((0.1, 0.0, -1e-5), THRESHOLDS, WEIGHTS, REST)
    state = model.init(20.0)
    for wanted in (-1e3, 1e3):
        found = jax.value_and_grad(lambda f: inverse_of(model).solve(state, f))(wanted)
        assert np.all(np.isfinite(found))


ENDS = (0.0, 100.0)


@st.composite
def bent(draw):
    """Return models that rise from 0 to 100 V and fall soon after one of the ends.

    Also return inputs, and outputs as shares of the reach of the next step.
    """
    slopes = draw(st.floats(0.02, 0.5)), draw(st.floats(0.002, 0.1))
    first, last = slopes if draw(st.booleans()) else slopes[::-1]
    # P' is the line from one slope to the other, plus a parabola that is 0 at the ends
    # and takes at most nine tenths of the smaller slope in the middle.
    curve = draw(st.floats(-0.9, 0.9)) * min(first, last) * 4.0
    linear, square = (last - first + curve) / 100.0, -curve / 100.0**2
    polynomial = np.array([first, 0.5 * linear, square / 3.0])
    gaps = draw(st.lists(st.floats(0.5, 30.0), min_size=4, max_size=4))
    weights = draw(st.lists(st.floats(0.0, 0.02), min_size=4, max_size=4))
    inputs = draw(st.lists(st.floats(*ENDS), min_size=3, max_size=3))
    shares = draw(st.lists(st.floats(0.0, 1.0), min_size=8, max_size=8))
    return polynomial, np.cumsum(gaps), np.array(weights), inputs, np.array(shares)


def next_output(polynomial, thresholds, weights, memory, x):
    """Return the output for the input x."""
    plays = np.clip(memory, x - thresholds, x + thresholds)
    return polynomial @ np.array([x, x**2, x**3]) + weights @ plays


def bisected(wanted, *at):
    """Return the input between the ends at which the next output is ``wanted``."""
    low, high = ENDS
    for _ in range(80):
        middle = 0.5 * (low + high)
        falls_short = next_output(*at, middle) < wanted
        low, high = (middle, high) if falls_short else (low, middle)
    return 0.5 * (low + high)


@jax.jit
def solved(inverse, state, wanted):
    """Return voltages and their derivatives by the wanted outputs."""
    return jax.vmap(jax.value_and_grad(lambda f: inverse.solve(state, f)))(wanted)


@pytest.mark.parametrize("kind", INVERSES)
@settings(max_examples=100)
@given(bent())
def test_the_inverse_holds_where_p_falls_outside_the_range(kind, case):
    polynomial, thresholds, weights, inputs, shares = case
    rate = (0.0, DT) if kind is RateDependentPrandtlIshlinskii else ()
    model = kind(polynomial, thresholds, weights, *rate, inputs[0])
    inverse = INVERSES[kind](model, *ENDS)
    state, memory = model.init(inputs[0]), np.full(4, inputs[0])
    for x in inputs[1:]:
        state = model.step(state, x)[0]
        memory = np.clip(memory, x - thresholds, x + thresholds)
    at = polynomial, thresholds, weights, memory
    low, high = (next_output(*at, end) for end in ENDS)
    wanted = low + shares * (high - low)
    steepest = 10.0 / min(polynomial[0], polynomial @ np.array([1.0, 200.0, 3e4]))
    for voltage, slope, f in zip(*solved(inverse, state, wanted), wanted, strict=True):
        assert next_output(*at, voltage) == pytest.approx(f, abs=1e-9)
        assert voltage == pytest.approx(bisected(f, *at), abs=1e-5)
        assert 0.0 < slope < 1.001 * steepest


def test_plays_that_begin_to_move_beyond_the_range_rest():
    """P falls from 111 V on, and the widest play would move from 145 V on."""
    thresholds, weights = (10.0, 20.0, 30.0, 45.0), (0.005,) * 4
    model = PrandtlIshlinskii((0.1, -4.5e-4), thresholds, weights, 100.0)
    state, output = model.step(model.init(100.0), 100.0)
    inverse = model.inverse(*ENDS)
    assert inverse.solve(state, output) == pytest.approx(100.0, abs=1e-9)
    # Out of reach the voltage still rises, along the tangent of P, 0.01 um/V.
    beyond, slopes = solved(inverse, state, output + np.array([0.01, 0.1, 1.0]))
    np.testing.assert_allclose(beyond, 100.0 + np.array([1.0, 10.0, 100.0]), rtol=1e-9)
    np.testing.assert_allclose(slopes, 100.0, rtol=1e-9)
    widening = RateDependentPrandtlIshlinskii(
        model.polynomial, thresholds, weights, 1e-3, DT, 100.0
    )
    found = widening.inverse(*ENDS).solve(widening.init(100.0), output)
    assert found == pytest.approx(100.0, abs=1e-9)


def test_the_inverse_drives_a_stage_in_open_loop():
    model = MODELS["plain cubic"]
    control = InverseFeedforward(inverse_of(model))
    at = Observation(2.0, 2.0, 2.0, inverse_of(model).step(model.init(REST), 2.0)[1])
    state, plant = control.init(at), model.init(at.applied)
    for wanted in (3.0, 7.0, 1.0, 4.0):
        state, voltage = control.step(state, at._replace(next_reference=wanted))
        plant, reached = model.step(plant, voltage)
        np.testing.assert_allclose(reached, wanted, atol=1e-9)


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: PrandtlIshlinskii((), (1.0,), (1.0,)), "polynomial is empty"),
        (
            lambda: PrandtlIshlinskii((1.0,), (2.0, 1.0), (1.0, 1.0)),
            "thresholds.0 must be below thresholds.1",
        ),
        (
            lambda: PrandtlIshlinskii((1.0,), (1.0, 2.0), (-1.5, 1.0)),
            "slope of the model in um/V is -0.5; it must be finite and above 0",
        ),
        (
            lambda: RateDependentPrandtlIshlinskii((0.0,), (1.0,), (1.0,), 0.0, DT),
            "slope of the model in um/V is 0",
        ),
    ],
)
def test_a_model_without_an_inverse_is_refused(build, message):
    with pytest.raises(ValueError, match=message):
        inverse_of(build())


def test_a_polynomial_inverse_has_no_operator_form():
    with pytest.raises(ValueError, match="polynomial has 3 terms; only with a linear"):
        inverse_of(MODELS["plain cubic"]).operator()
