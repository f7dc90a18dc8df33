import jax
import numpy as np
import pytest
from oracles import hysteresis as oracle
from scipy.integrate import solve_ivp

from piezojax import (
    simulate,
)
from piezojax.hysteresis import (
    ColemanHodgdon,
    ShapedColemanHodgdon,
)

PULL = (0.02, 0.006, -2e-5, 1e-7)
SLOPE = (0.11, -3e-4, 2e-6)
C = -0.05


def model(rest=(4.0, 1.0)):
    return ShapedColemanHodgdon(PULL, SLOPE, C, *rest)


@jax.jit
def response(system, inputs, start):
    return simulate(system, inputs, system.init(start))[1]


def drive(samples=400):
    time = np.linspace(0.0, 4.0, samples)
    return 40.0 + 30.0 * np.sin(2 * np.pi * time) * np.exp(-0.3 * time)


def test_the_response_equals_a_plain_loop():
    x = drive()
    system = model()
    first = float(system.init(x[0]).output)
    found = response(system, x, x[0])
    expected = oracle.shaped_trapezoid(x, PULL, SLOPE, C, first)
    np.testing.assert_allclose(found, expected, atol=1e-11)


@pytest.mark.parametrize("target", [60.0, -30.0, 4.0])
def test_the_virgin_curve_solves_the_differential_equation(target):
    sign = 1.0 if target >= 4.0 else -1.0

    def slope(x, y):
        p = np.polynomial.Polynomial(PULL)(x) + C * y
        return sign * p + np.polynomial.Polynomial(SLOPE)(x)

    end = solve_ivp(slope, (4.0, target), [1.0], rtol=1e-11, atol=1e-12).y[0, -1]
    np.testing.assert_allclose(model().init(target).output, end, rtol=1e-8)


def test_linear_shape_functions_give_coleman_hodgdon():
    x = drive()
    plain = ColemanHodgdon(0.0077, 0.1167, -0.0487)
    shaped = ShapedColemanHodgdon((0.0, 0.0077), (0.1167,), -0.0487)
    np.testing.assert_allclose(
        response(shaped, x, x[0]), response(plain, x, x[0]), atol=1e-12
    )


def test_the_step_is_second_order():
    coarse, fine, finest = (
        float(response(model(), np.linspace(10.0, 70.0, n), 10.0)[-1])
        for n in (31, 61, 1921)
    )
    assert 3.5 < (coarse - finest) / (fine - finest) < 4.5


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: ShapedColemanHodgdon((), (1.0,), -1.0), "pull is empty"),
        (lambda: ShapedColemanHodgdon((1.0,), (), -1.0), "slope is empty"),
        (lambda: ShapedColemanHodgdon((1.0,), (1.0,), 0.0), "c in 1/V is 0"),
        (lambda: ShapedColemanHodgdon((np.inf,), (1.0,), -1.0), "pull in .* is inf"),
    ],
)
def test_bad_parameters(build, message):
    with pytest.raises(ValueError, match=message):
        build()
