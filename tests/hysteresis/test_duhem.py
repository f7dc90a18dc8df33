import jax
import numpy as np
import pytest
from oracles import duhem as oracle

from piezojax import (
    simulate,
)
from piezojax.hysteresis import (
    BoucWen,
    ColemanHodgdon,
    Duhem,
    ShapedColemanHodgdon,
)

A, B, C = 0.0077, 0.1167, -0.0487
PULL, SLOPE = (0.02, 0.006, -2e-5, 1e-7), (0.11, -3e-4, 2e-6)
ALPHA, GAMMA, DELTA = 0.05, 0.03, -0.01  # 1/V


def coleman_hodgdon(**options):
    return Duhem(((B,),), ((0.0, A), (C,)), **options)


def bouc_wen(nu=1, **options):
    if nu == 1:
        parts = {
            "irreversible": ((), (-GAMMA,)),
            "reversible_modulus": ((-DELTA,),),
        }
        return Duhem(((ALPHA,),), **parts, **options)
    # |z|^2 is a polynomial, |z| z is one times the modulus.
    parts = {"irreversible": (), "irreversible_modulus": ((), (-GAMMA,))}
    return Duhem(((ALPHA,), (), (-DELTA,)), **parts, **options)


def curved(**options):
    """Return a general model: all four surfaces, an output of both variables."""
    return Duhem(
        reversible=((0.1, 1e-3), (-0.002,)),
        irreversible=((0.01, 2e-3), (-0.02, -1e-4)),
        reversible_modulus=((-0.003,),),
        irreversible_modulus=((0.0, 1e-5), (-0.001,)),
        output=((0.2, 0.05, 1e-4), (0.8, 1e-3), (0.01,)),
        rest_input=3.0,
        rest_memory=0.5,
        **options,
    )


@jax.jit
def padded(system, path, start):
    return simulate(system, path, system.init(start))[1]


def response(system, path, start):
    """Return the response; one program serves all paths of up to 256 samples."""
    longer = np.pad(path, (0, 256 - path.size), "edge")
    return np.asarray(padded(system, longer, start))[: path.size]


def drive(samples=200):
    time = np.linspace(0.0, 3.0, samples)
    return 40.0 + 30.0 * np.sin(2 * np.pi * time) * np.exp(-0.3 * time)


def walk(samples, span):
    return np.repeat(np.random.default_rng(0).uniform(-span, span, samples), 2)


def shares(x, u):
    """Return the two slopes of `curved` from the equations."""
    f = 0.1 + 1e-3 * u - 0.002 * x - 0.003 * abs(x)
    g = 0.01 + 2e-3 * u + (-0.02 - 1e-4 * u) * x + abs(x) * (1e-5 * u - 0.001 * x)
    return f, g


def rising(x, u):
    f, g = shares(x, u)
    return f + g


def falling(x, u):
    f, g = shares(x, u)
    return f - g


def test_the_step_equals_the_rule_of_kutta():
    path = walk(40, 20.0)
    path[0] = 3.0
    found = response(curved(), path, path[0])
    x = oracle.kutta(
        path, 0.5, lambda x, u: shares(x, u)[0], lambda x, u: shares(x, u)[1]
    )
    h = 0.2 + 0.05 * path + 1e-4 * path**2 + (0.8 + 1e-3 * path) * x + 0.01 * x**2
    np.testing.assert_allclose(found, h, rtol=0.0, atol=1e-12)


def test_the_step_has_fourth_order_convergence():
    corners = [3.0, 60.0, 20.0, 50.0, 10.0]
    x = oracle.along(corners, 0.5, rising, falling)
    assert np.all(x > 0.0)  # no branch crosses the kink
    u = np.array(corners)
    h = 0.2 + 0.05 * u + 1e-4 * u**2 + (0.8 + 1e-3 * u) * x + 0.01 * x**2
    errors = []
    for parts in (16, 32):
        path = np.interp(np.arange(0, 4 + 1e-9, 1 / parts), range(5), corners)
        found = response(curved(), path, 3.0)[parts : 4 * parts + 1 : parts]
        errors.append(np.max(np.abs(found - h[1:])))
    assert errors[1] < 1e-6
    assert 11.0 < errors[0] / errors[1] < 22.0


def test_linear_surfaces_give_coleman_hodgdon():
    path = drive()
    exact = ColemanHodgdon(A, B, C, 4.0, 1.0, scheme="exact")
    found = response(coleman_hodgdon(rest_input=4.0, rest_memory=1.0), path, path[0])
    np.testing.assert_allclose(found, response(exact, path, path[0]), atol=1e-7)


def test_surfaces_of_the_input_give_shaped_coleman_hodgdon():
    path = np.linspace(40.0, 70.0, 128)  # second order, as its step
    path = np.concatenate([path, path[::-1]])
    shaped = ShapedColemanHodgdon(PULL, SLOPE, C, 4.0, 1.0)
    duhem = Duhem((SLOPE,), (PULL, (C,)), rest_input=4.0, rest_memory=1.0)
    found, expected = (response(system, path, 40.0) for system in (duhem, shaped))
    np.testing.assert_allclose(found, expected, atol=2e-4)


@pytest.mark.parametrize("nu", [1, 2])
@pytest.mark.parametrize("substeps", [1, 3])
def test_a_modulus_gives_bouc_wen(nu, substeps):
    path = walk(60, 30.0)
    path[0] = 0.0
    classical = BoucWen(ALPHA, GAMMA, DELTA, nu, substeps=substeps)
    found = response(bouc_wen(nu, substeps=substeps), path, 0.0)
    np.testing.assert_allclose(found, response(classical, path, 0.0), atol=1e-12)


@pytest.mark.parametrize("input", [-30.0, 3.0, 80.0])
def test_the_rest_state_is_on_the_virgin_curve(input):
    system = curved()
    x = oracle.along([3.0, input], 0.5, rising, falling)[-1]
    state = system.init(input)
    np.testing.assert_allclose(state.memory, x, atol=1e-5)
    after, _ = system.step(state, input)
    assert jax.tree.all(jax.tree.map(lambda a, b: bool(a == b), state, after))


def test_slope_at_rest_equals_that_of_the_rising_branch():
    system = coleman_hodgdon()
    state = system.init(40.0)
    found = jax.grad(lambda u: system.step(state, u)[1])(40.0)
    np.testing.assert_allclose(found, A * 40.0 + B + C * state.memory, rtol=1e-12)


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"reversible": ((0.1,), (np.nan,))}, r"reversible in .* is nan"),
        ({"irreversible_modulus": ((np.inf,),)}, r"irreversible_modulus in .* is inf"),
        ({"output": ()}, "output is empty; it must hold a coefficient"),
        ({"rest_input": np.nan}, "rest_input in V is nan"),
        ({"substeps": 0}, "substeps is 0; it must be finite and at least 1"),
    ],
)
def test_bad_parameters_are_refused(changed, message):
    good = {"reversible": ((0.1,),), "irreversible": ((),)}
    with pytest.raises(ValueError, match=message):
        Duhem(**{**good, **changed})
