import jax
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles import bouc_wen as oracle

from piezojax import (
    simulate,
)
from piezojax.hysteresis import (
    BoucWen,
)

ALPHA = 5e4  # N/m
SHAPES = {  # beta_gamma, beta_delta, nu
    "benchmark": (800.0, -1100.0, 1.0),
    "saturating": (900.0, 300.0, 1.0),
    "sharp": (20.0, 5.0, 2.0),
    "soft": (2000.0, 500.0, 0.7),
}


def model(shape="benchmark", **options):
    return BoucWen(ALPHA, *SHAPES[shape], **options)


@jax.jit
def force(system, displacement):
    return simulate(system, displacement, system.init(0.0))[1]


def walk(samples, seed=0):
    """Return displacements (m) of some mm with pauses."""
    draw = np.random.default_rng(seed)
    return np.repeat(np.cumsum(draw.normal(0.0, 3e-4, samples)), 2)


@pytest.mark.parametrize("shape", SHAPES)
def test_force_solves_the_differential_equation(shape):
    path = walk(60)
    expected, before, at = [], 0.0, 0.0
    for target in path:
        if target != at:
            before = oracle.force_after(at, before, target, ALPHA, *SHAPES[shape])
        expected.append(before)
        at = target
    found = force(model(shape, substeps=32), path)
    # The rule has a lower order in the step in which the force changes its sign.
    np.testing.assert_allclose(found, expected, rtol=0.0, atol=2e-4 * np.ptp(expected))


@pytest.mark.parametrize("shape", ["benchmark", "saturating"])
def test_branches_of_unit_nu_equal_the_closed_form(shape):
    beta_gamma, beta_delta, _ = SHAPES[shape]
    up = np.linspace(1e-4, 2e-3, 20)
    rising = [
        oracle.branch_of_unit_nu(y, 0.0, ALPHA, beta_gamma, beta_delta) for y in up
    ]
    top = oracle.branch_of_unit_nu(2e-3, 0.0, ALPHA, beta_gamma, beta_delta)
    down = -np.linspace(2e-5, 2e-4, 10)
    falling = [
        oracle.branch_of_unit_nu(y, top, ALPHA, beta_gamma, beta_delta) for y in down
    ]
    found = force(model(shape, substeps=4), np.concatenate([up, 2e-3 + down]))
    np.testing.assert_allclose(found, rising + falling, rtol=1e-7)


def test_order_of_convergence_on_a_branch():
    errors = []
    expected = oracle.branch_of_unit_nu(2e-3, 0.0, ALPHA, 900.0, 300.0)
    for substeps in (4, 8, 16):
        found = force(model("saturating", substeps=substeps), np.array([2e-3]))[-1]
        errors.append(abs(found - expected))
    np.testing.assert_allclose(np.log2(np.divide(errors[:-1], errors[1:])), 4, atol=0.4)


def test_without_hysteresis_it_equals_a_spring():
    path = walk(50)
    np.testing.assert_allclose(
        force(BoucWen(ALPHA, 0.0, 0.0), path), ALPHA * path, rtol=0.0, atol=1e-10
    )


@pytest.mark.parametrize("shape", SHAPES)
def test_the_force_is_independent_of_the_speed(shape):
    path = walk(40)
    slow = np.repeat(path, 5)
    np.testing.assert_array_equal(
        force(model(shape), slow)[4::5], force(model(shape), path)
    )
    # The same path with twice as many samples has the same substeps.
    halfway = 0.5 * (path + np.concatenate([[0.0], path[:-1]]))
    finer = np.stack([halfway, path], axis=1).ravel()
    np.testing.assert_allclose(
        force(model(shape, substeps=2), finer)[1::2],
        force(model(shape, substeps=4), path),
        rtol=1e-9,
        atol=1e-9,
    )


@pytest.mark.parametrize("shape", SHAPES)
def test_force_is_odd_in_the_displacement(shape):
    path = walk(100)
    np.testing.assert_array_equal(
        force(model(shape), -path), -force(model(shape), path)
    )


@pytest.mark.parametrize("shape", ["saturating", "sharp", "soft"])
def test_force_saturates_at_its_known_limit(shape):
    beta_gamma, beta_delta, nu = SHAPES[shape]
    limit = (ALPHA / (beta_gamma + beta_delta)) ** (1.0 / nu)
    pulled = force(model(shape, substeps=4), np.linspace(0.0, 0.1, 1001))
    np.testing.assert_allclose(pulled[-1], limit, rtol=1e-6)
    assert np.all(np.diff(pulled) >= -1e-9 * limit)


@settings(max_examples=40, deadline=None)
@given(st.floats(0.5, 3.0), st.floats(0.0, 1.0), st.integers(0, 1000))
def test_force_stays_bounded_and_cycles_dissipate(nu, share, seed):
    # |beta_delta| <= beta_gamma: bounded and passive (Ikhouane & Rodellar 2007).
    limit = 40.0  # N
    both = ALPHA / limit**nu
    gamma_part = 0.5 + 0.5 * share
    system = BoucWen(
        ALPHA, gamma_part * both, (1.0 - gamma_part) * both, nu, substeps=4
    )
    assert np.max(np.abs(force(system, walk(100, seed)))) <= limit * (1.0 + 1e-3)
    path = 2e-3 * np.sin(2.0 * np.pi * np.arange(1600) / 400)
    found = np.asarray(force(system, path))
    work = np.sum(0.5 * (found[-401:-1] + found[-400:]) * np.diff(path[-401:]))
    assert work > 0.0
    np.testing.assert_allclose(found[-400:], found[-800:-400], atol=1e-3 * limit)


@pytest.mark.parametrize("displacement", [-2e-3, 0.0, 1e-3])
def test_the_force_at_rest_is_zero(displacement):
    state = model().init(displacement)
    after, found = model().step(state, displacement)
    assert float(found) == float(state.force) == 0.0
    assert float(after.displacement) == displacement


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"alpha": np.nan}, "alpha in N/m is nan; it must be finite"),
        ({"beta_gamma": np.inf}, "beta_gamma in .* is inf"),
        ({"beta_delta": np.nan}, "beta_delta in .* is nan"),
        ({"nu": 0.0}, "nu is 0; it must be finite and above 0"),
        ({"substeps": 0}, "substeps is 0; it must be finite and at least 1"),
    ],
)
def test_bad_parameters_are_refused(changed, message):
    good = {"alpha": 1.0, "beta_gamma": 1.0, "beta_delta": 0.0, "nu": 1.0}
    with pytest.raises(ValueError, match=message):
        BoucWen(**{**good, **changed})
