import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
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


@pytest.fixture(params=MODELS)
def model(request):
    return MODELS[request.param]()


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
def test_against_backlashes_in_a_plain_loop(name):
    x = drive()
    x[0] = 12.0  # the only step from the virgin state that init takes
    found = response(MODELS[name](), x, x[0])
    np.testing.assert_allclose(found, expected(x, name == "asymmetric"), atol=1e-12)


def test_a_step_under_the_same_input_changes_nothing(model):
    state = model.init(40.0)
    after, _ = model.step(state, 40.0)
    assert jax.tree.all(jax.tree.map(lambda a, b: bool(a == b), state, after))


@given(st.lists(st.floats(-20.0, 120.0), min_size=2, max_size=8))
def test_it_does_not_matter_how_fast_the_input_moves(points):
    model = symmetric()
    corners = np.array(points)
    at = np.arange(0, len(points) - 1 + 1e-9, 1 / 32)
    fine = np.interp(at, range(len(points)), corners)
    coarse = response(model, np.pad(corners, (0, 8 - corners.size), "edge"), points[0])
    slow = response(model, np.pad(fine, (0, 225 - fine.size), "edge"), points[0])
    np.testing.assert_allclose(slow[-1], coarse[-1], atol=1e-9)


@pytest.mark.parametrize("extra", [(40.0, 60.0), (20.0, 80.0, 30.0, 70.0)])
def test_a_larger_loop_wipes_out_the_smaller_ones_before_it(model, extra):
    # Madelung's rule: after 10 -> 90 nothing between is remembered.
    plain = response(model, np.array([50.0, 10.0, 90.0, 50.0]), 50.0)[-1]
    rich = response(model, np.array([50.0, *extra, 10.0, 90.0, 50.0]), 50.0)[-1]
    np.testing.assert_allclose(rich, plain, atol=1e-12)


def test_minor_loops_between_the_same_inputs_are_congruent():
    model = symmetric()
    low = response(model, np.array([0.0, 30.0, 50.0, 30.0, 50.0]), 0.0)
    high = response(model, np.array([0.0, 100.0, 30.0, 50.0, 30.0, 50.0]), 0.0)
    np.testing.assert_allclose(low[2] - low[3], high[3] - high[4], atol=1e-12)


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


def test_gradients_are_central_differences(model):
    leaves, tree = jax.tree.flatten(model)
    x = jnp.asarray(drive(120))

    def loss(values):
        system = jax.tree.unflatten(tree, list(values))
        return jnp.mean(simulate(system, x, system.init(x[0]))[1] ** 2)

    values = jnp.stack(leaves)
    found = jax.jit(jax.grad(loss))(values)
    loss = jax.jit(loss)
    for i, size in enumerate(np.maximum(1e-6 * np.abs(values), 1e-9)):
        step = np.zeros(values.size)
        step[i] = size
        slope = (loss(values + step) - loss(values - step)) / (2 * size)
        np.testing.assert_allclose(found[i], slope, rtol=1e-4, atol=1e-8)


def test_eager_is_jitted_is_a_lane_of_a_batch(model):
    x = drive(50)
    eager = simulate(model, jnp.asarray(x), model.init(x[0]))[1]
    batch = jax.vmap(lambda u: simulate(model, u, model.init(u[0]))[1])(
        jnp.stack([x, -x])
    )
    np.testing.assert_allclose(response(model, x, x[0]), eager, atol=1e-13)
    np.testing.assert_allclose(batch[0], eager, atol=1e-13)


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
