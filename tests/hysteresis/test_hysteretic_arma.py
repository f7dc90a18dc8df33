"""The ARMA-based hysteresis model of chapter 3 against its equations."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracles import regression

from piezojax import (
    series,
    simulate,
)
from piezojax.core.system import Affine
from piezojax.dynamics import (
    ARMA,
)
from piezojax.hysteresis import (
    ColemanHodgdon,
    HystereticARMA,
)

POLES = (1.6, -0.62)
FIRST = (0.0003, -0.0002, 0.0006)
SECOND = (0.004, 0.001, 0.009)
TIME = np.arange(300) / 300.0
VOLTAGE = 40.0 * np.sin(9.0 * TIME) * np.exp(-TIME) + 5.0 * np.sin(80.0 * TIME)


def made(**changes):
    parts = {
        "c": -0.05,
        "autoregressive": POLES,
        "moving_1": FIRST,
        "moving_2": SECOND,
        "offset": 0.7,
    }
    return HystereticARMA(**parts | changes)


@pytest.mark.parametrize("scheme", ["trapezoid", "quadratic", "voros"])
def test_each_step_equals_the_equation(scheme):
    _, found = simulate(made(scheme=scheme), jnp.asarray(VOLTAGE))
    expected = regression.model(VOLTAGE, -0.05, POLES, FIRST, SECOND, scheme, 0.7)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-11)


def test_the_output_at_the_rest_input_is_the_offset():
    system = made(rest_input=-12.0)
    output = system.step(system.init(-12.0), -12.0)[1]
    np.testing.assert_allclose(output, 0.7, rtol=1e-12)


# One hysteresis


def test_one_hysteresis_and_its_dynamics_are_recovered():
    moving = (0.1, -0.2, 0.12)  # DC gain 1 with these poles
    one = series(
        hysteresis=ColemanHodgdon(0.0077, 0.1167, -0.05),
        dynamics=ARMA(POLES, moving),
        calibration=Affine(1.0, 0.7),
    )
    two = made(
        moving_1=[0.0077 * b for b in moving], moving_2=[0.1167 * b for b in moving]
    )
    found = two.cascade(1e-12)
    assert jax.tree.structure(found) == jax.tree.structure(one)
    for leaf, expected in zip(
        jax.tree.leaves(found), jax.tree.leaves(one), strict=True
    ):
        np.testing.assert_allclose(leaf, expected, rtol=1e-9)


def test_two_hystereses_are_projected_on_request_only():
    cosine = np.dot(FIRST, SECOND) / np.linalg.norm(FIRST) / np.linalg.norm(SECOND)
    sine = np.sqrt(1.0 - cosine**2)
    message = f"moving_1 and moving_2 is {sine:.3g}; it must be at most 0.001"
    with pytest.raises(ValueError, match=re.escape(message)):
        made().cascade()
    found = made().cascade(tolerance=1.0)
    gain = 1.0 / (1.0 - sum(POLES))
    np.testing.assert_allclose(found.parts[0].a, gain * sum(FIRST), rtol=1e-12)
    np.testing.assert_allclose(found.parts[0].b, gain * sum(SECOND), rtol=1e-12)
    np.testing.assert_allclose(found.parts[1].dc_gain(), 1.0, rtol=1e-12)


@pytest.mark.parametrize(
    ("numerators", "message"),
    [
        (((0.0, 0.0), (0.0, 0.0)), "moving_1 and moving_2 are zero"),
        (((1.0, -1.0), (2.0, -2.0)), "the shared numerator sums to 0"),
    ],
)
def test_models_without_a_single_hysteresis_are_refused(numerators, message):
    first, second = numerators
    with pytest.raises(ValueError, match=message):
        made(moving_1=first, moving_2=second).cascade()


def test_a_model_with_a_pole_at_1_is_refused():
    with pytest.raises(ValueError, match="sum to 1, a pole at z = 1; there is no DC"):
        made(autoregressive=(0.7, 0.2, 0.1)).cascade(tolerance=1.0)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"c": 0.0}, "c in 1/V is 0; it must be finite and below 0"),
        ({"moving_1": (1.0,)}, "moving_1 holds 1 and moving_2 3 coefficients"),
        ({"moving_1": (), "moving_2": ()}, "moving is empty"),
        ({"autoregressive": (np.nan,)}, "autoregressive is nan"),
        ({"scheme": "euler"}, "scheme 'euler'; it must be one of"),
    ],
)
def test_bad_models_are_refused(changes, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        made(**changes)
