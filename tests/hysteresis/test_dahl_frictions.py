"""Dahl frictions against closed forms, a loop of many small steps and Bouc-Wen."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from oracles.stages import dahl as small_steps

from piezojax.core.rollout import simulate
from piezojax.hysteresis import DahlFrictions, InverseHysteresis, NormalisedBoucWen

HEIGHTS, RATES, EXPONENTS = (3.0, 5.0, 2.0), (0.02, 0.05, 0.2), (0.7, 1.0, 1.9)
PATH = np.array([0.0, 80.0, 20.0, 35.0, -10.0, 100.0, 60.0])


def run(model, inputs):
    return np.asarray(simulate(model, jnp.asarray(inputs), model.init(inputs[0]))[1])


def model(polynomial=(0.3,), **changed):
    fields = {"heights": HEIGHTS, "rates": RATES, "exponents": EXPONENTS} | changed
    return DahlFrictions(polynomial, **fields)


def test_a_step_equals_many_small_ones():
    fine = np.concatenate(
        [np.linspace(a, b, 20_001)[1:] for a, b in itertools.pairwise(PATH)]
    )
    table = np.column_stack([np.multiply(HEIGHTS, RATES), HEIGHTS, EXPONENTS])
    state, last, expected = np.zeros(3), 0.0, []
    for x in fine.tolist():
        expected.append(0.3 * small_steps(x, x - last, 1.0, state, table))
        last = x
    np.testing.assert_allclose(run(model(), PATH)[1:], expected[19_999::20_000], 1e-6)


@pytest.mark.parametrize(
    ("exponent", "force"),
    [
        (0.5, lambda s: 1.0 - np.maximum(1.0 - 0.5 * s, 0.0) ** 2),
        (1.0, lambda s: 1.0 - np.exp(-s)),
        (2.0, lambda s: s / (1.0 + s)),
        (3.0, lambda s: 1.0 - 1.0 / np.sqrt(1.0 + 2.0 * s)),
    ],
)
def test_the_virgin_curve_has_its_closed_form(exponent, force):
    x = np.linspace(0.0, 100.0, 41)
    one = DahlFrictions((1.0,), (8.0,), (0.04,), (exponent,))
    np.testing.assert_allclose(run(one, x), x - 8.0 * force(0.04 * x), atol=1e-12)
    np.testing.assert_allclose(run(one, -x), -run(one, x), atol=1e-12)


def test_an_exponent_of_one_is_bouc_wen():
    x = 50.0 + 45.0 * np.sin(np.linspace(0.0, 20.0, 400))
    bouc_wen = NormalisedBoucWen(0.2, -1.6, 0.04, 1.0, 1.0, scheme="exact")
    one = DahlFrictions((0.2,), (8.0,), (0.04,), (1.0,))
    np.testing.assert_allclose(run(one, x), run(bouc_wen, x), atol=1e-11)


@given(st.floats(0.5, 5.0), st.floats(-1.0, 1.0), st.floats(0.0, 200.0))
def test_a_friction_stays_within_its_height_and_ends_at_it(exponent, force, path):
    one = DahlFrictions((1.0,), (8.0,), (0.04,), (exponent,))
    before = one.init(0.0)._replace(forces=(jnp.asarray(force),))
    after = float(one.step(before, path)[0].forces[0])
    assert -1.0 <= force <= after + 1e-12
    assert after <= 1.0
    far = float(one.step(before, 1e9)[0].forces[0])
    assert far == pytest.approx(1.0, abs=1e-1 if exponent > 2.0 else 1e-6)


def test_the_output_is_continuous_in_the_exponent():
    near = [run(model(exponents=(n,) * 3), PATH) for n in (1.0, 1.0 + 1e-11)]
    np.testing.assert_allclose(*near, rtol=1e-9)
    across = [run(model(exponents=(n,) * 3), PATH) for n in (1.0009999, 1.0010001)]
    np.testing.assert_allclose(*across, rtol=1e-6)


@pytest.mark.parametrize("exponent", [0.7, 1.0, 1.0005, 2.5])
def test_derivatives_equal_differences(exponent):
    def last(values):
        rate, bend, height = values
        one = DahlFrictions((0.3, 1e-4), (height,), (rate,), (bend,))
        return simulate(one, jnp.asarray(PATH), one.init(0.0))[1][-1]

    point = jnp.asarray([0.03, exponent, 6.0])
    step = 1e-5
    moved = [
        (last(point + step * e) - last(point - step * e)) / (2.0 * step)
        for e in jnp.eye(3)
    ]
    np.testing.assert_allclose(jax.grad(last)(point), moved, rtol=1e-5, atol=1e-9)


def test_the_gradient_is_finite_where_a_friction_has_ended():
    def last(bend):
        one = DahlFrictions((1.0,), (8.0,), (0.5,), (bend,))
        x = jnp.asarray([0.0, 50.0, 60.0, 100.0])
        return jnp.sum(simulate(one, x, one.init(0.0))[1])

    assert np.isfinite(jax.grad(last)(jnp.asarray(0.6)))


def test_the_inverse_exists_while_the_steepest_branch_rises():
    InverseHysteresis(DahlFrictions((0.3,), (8.0,), (0.06,), (1.0,)), 0.0, 100.0)
    with pytest.raises(ValueError, match="output rises"):
        DahlFrictions((0.3,), (8.0,), (0.07,), (1.0,)).inverse(0.0, 100.0)


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"heights": (1.0,)}, "1 heights, 3 rates and 3 exponents"),
        ({"rates": (0.02, 0.0, 0.1)}, "rates"),
        ({"exponents": (0.4, 1.0, 1.0)}, "exponents"),
    ],
)
def test_bad_parameters_are_refused(changed, message):
    with pytest.raises(ValueError, match=message):
        model(**changed)
