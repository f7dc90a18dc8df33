import jax
import numpy as np
import pytest
from oracles import duhem as oracle

from piezojax import (
    simulate,
)
from piezojax.hysteresis import (
    BoucWen,
    NormalisedBoucWen,
)

K_X, K_W, RHO = 0.12, -1.0, 0.04  # um/V, um, 1/V
SHAPES = {
    "plain": (0.6, 1.0),
    "round": (1.2, 1.0),
    "sharp": (0.7, 2.0),
    "real": (0.9, 1.5),
}


def model(shape="plain", **options):
    sigma, n = SHAPES[shape]
    return NormalisedBoucWen(K_X, K_W, RHO, sigma, n, **options)


@jax.jit
def padded(system, path):
    return simulate(system, path, system.init(path[0]))[1]


def response(system, path):
    """Return the response; one program serves all paths of up to 256 samples."""
    longer = np.pad(path, (0, 256 - path.size), "edge")
    return np.asarray(padded(system, longer))[: path.size]


def memory(system, path):
    """Return w from the output."""
    return (response(system, path) - K_X * path) / K_W


def walk(samples):
    path = np.repeat(np.random.default_rng(0).uniform(-60.0, 80.0, samples), 2)
    return np.concatenate([[0.0], path])


@pytest.mark.parametrize("shape", ["plain", "round"])
def test_the_exact_scheme_solves_the_differential_equation(shape):
    path = walk(20)
    expected = oracle.bounded(path, RHO, *SHAPES[shape])
    found = memory(model(shape, scheme="exact"), path)
    np.testing.assert_allclose(found, expected, rtol=0.0, atol=1e-9)


@pytest.mark.parametrize("shape", SHAPES)
def test_the_runge_kutta_scheme_converges_to_the_exact_scheme(shape):
    path = walk(20)
    expected = oracle.bounded(path, RHO, *SHAPES[shape])
    found = memory(model(shape, substeps=16), path)
    # The rule has a lower order in the part in which w changes its sign.
    np.testing.assert_allclose(found, expected, rtol=0.0, atol=5e-3)


def test_order_of_convergence_on_a_branch():
    expected = oracle.bounded([0.0, 60.0], RHO, *SHAPES["sharp"])[-1]
    errors = [
        abs(
            memory(model("sharp", substeps=substeps), np.array([0.0, 60.0]))[-1]
            - expected
        )
        for substeps in (8, 16)
    ]
    np.testing.assert_allclose(np.log2(errors[0] / errors[1]), 4.0, atol=0.5)


@pytest.mark.parametrize("shape", SHAPES)
def test_the_memory_equals_the_force_of_the_classical_model(shape):
    path = walk(30)
    sigma, n = SHAPES[shape]
    # w = z / limit, limit = (alpha / (beta_gamma + beta_delta))^(1/n).
    limit, both = 40.0, RHO * 40.0 / 40.0**n
    classical = BoucWen(RHO * limit, sigma * both, (1.0 - sigma) * both, n)
    np.testing.assert_allclose(
        memory(model(shape), path), response(classical, path) / limit, atol=1e-12
    )


def test_the_memory_stays_within_one():
    found = memory(model("plain", scheme="exact"), 1e3 * walk(40))
    assert np.max(np.abs(found)) <= 1.0 + 1e-9
    np.testing.assert_allclose(np.max(found), 1.0, atol=1e-9)


def test_the_exact_scheme_needs_no_fine_steps():
    coarse = walk(10)
    fine = np.interp(np.arange(0, 20 + 1e-9, 1 / 8), range(21), coarse)
    np.testing.assert_allclose(
        memory(model("plain", scheme="exact"), fine)[::8],
        memory(model("plain", scheme="exact"), coarse),
        atol=1e-12,
    )


@pytest.mark.parametrize("scheme", ["runge_kutta", "exact"])
@pytest.mark.parametrize("input", [-30.0, 0.0, 80.0])
def test_the_rest_state_is_on_the_virgin_curve(scheme, input):
    system = model("plain", scheme=scheme)
    state = system.init(input)
    virgin = np.sign(input) * (1.0 - np.exp(-RHO * abs(input)))
    np.testing.assert_allclose(state.memory, virgin, atol=1e-8)
    after, _ = system.step(state, input)
    np.testing.assert_allclose(after.memory, state.memory, rtol=0.0, atol=1e-16)
    assert float(after.input) == input


def test_slope_at_rest_equals_that_of_the_rising_branch():
    system = model("plain", scheme="exact")
    state = system.init(40.0)
    found = jax.grad(lambda x: system.step(state, x)[1])(40.0)
    expected = K_X + K_W * RHO * (1.0 - state.memory)
    np.testing.assert_allclose(found, expected, rtol=1e-12)


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"k_x": np.nan}, "k_x in um/V is nan; it must be finite"),
        ({"k_w": np.inf}, "k_w in um is inf"),
        ({"rho": 0.0}, "rho in 1/V is 0; it must be finite and above 0"),
        ({"sigma": 0.5}, "sigma is 0.5; it must be finite and above 0.5"),
        ({"n": 0.9}, "n is 0.9; it must be finite and at least 1"),
        ({"substeps": 0}, "substeps is 0"),
        ({"scheme": "cubic"}, "scheme 'cubic'; it must be one of .*'exact'"),
        ({"scheme": "exact", "n": 2.0}, "n of the scheme 'exact' is 2; .* at most 1"),
    ],
)
def test_bad_parameters_are_refused(changed, message):
    good = {"k_x": K_X, "k_w": K_W, "rho": RHO, "sigma": 0.6}
    with pytest.raises(ValueError, match=message):
        NormalisedBoucWen(**{**good, **changed})
