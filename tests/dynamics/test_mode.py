"""The resonance: response, rest, gradients, and starting values of a fit."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg

from piezojax import Record, load, save, simulate
from piezojax.core.paths import get, replace
from piezojax.core.recipe import Extent, Resonance
from piezojax.core.registry import parts
from piezojax.dynamics import ARMA, Mode, Modes
from piezojax.identification.chain import structure

DT = 1e-4
INPUT = np.random.default_rng(3).normal(size=400)


@jax.jit
def response(system, inputs, start=0.0):
    return simulate(system, inputs, system.init(start))[1]


def by_matrix_exponential(frequency, damping, inputs, rest):
    """Return the state after each sample under a held input, by SciPy's expm."""
    w = 2.0 * np.pi * frequency
    matrix = np.zeros((3, 3))
    matrix[:2] = [[0.0, 1.0, 0.0], [-(w**2), -2.0 * damping * w, w**2]]
    held = scipy.linalg.expm(matrix * DT)
    state, outputs = np.array([rest, 0.0]), []
    for value in inputs:
        state = held[:2, :2] @ state + held[:2, 2] * value
        outputs.append(state[0])
    return np.array(outputs)


@pytest.mark.parametrize(
    ("frequency", "damping"),
    [(300.0, 0.005), (780.0, 0.02), (4000.0, 0.1), (7000.0, 0.3), (50.0, 1.5)],
)
def test_a_mode_equals_the_oscillator_with_held_input(frequency, damping):
    expected = by_matrix_exponential(frequency, damping, INPUT, 2.0)
    found = response(Mode(frequency, damping, DT), INPUT, 2.0)
    np.testing.assert_allclose(found, expected, rtol=0.0, atol=1e-9)


def test_a_mode_rests_at_its_input():
    np.testing.assert_array_equal(
        response(Mode(780.0, 0.02, DT), np.full(50, 7.0), 7.0), 7.0
    )


def test_its_gradient_equals_finite_differences():
    def last(parameters):
        return jnp.sum(response(Mode(*parameters, DT), INPUT) ** 2)

    point = np.array([780.0, 0.02])
    steps = np.diag(1e-5 * point)
    differences = [(last(point + h) - last(point - h)) / (2 * h.sum()) for h in steps]
    np.testing.assert_allclose(jax.grad(last)(point), differences, rtol=1e-6)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((0.0, 0.1, DT), "frequency in Hz is 0; it must be finite and above 0"),
        ((780.0, 0.0, DT), "damping is 0; it must be finite and above 0"),
        ((780.0, np.nan, DT), "damping is nan"),
        ((780.0, 0.1, 0.0), "dt in s is 0"),
    ],
)
def test_bad_parameters_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        Mode(*arguments)


def test_a_mode_is_saved_and_loaded(tmp_path):
    save(Mode(780.0, 0.02, DT), tmp_path / "mode.json")
    back = load(tmp_path / "mode.json")
    assert (float(back.frequency), float(back.damping), back.dt) == (780.0, 0.02, DT)


EXTENT = Extent(0.0, 100.0, (0.0, 0.0), 0.12, 0.0, 12.0, DT, 2.0)


def test_a_fit_starts_from_the_strongest_resonance_with_narrow_bounds():
    found = (Resonance(780.0, 0.02), Resonance(1900.0, 0.05))
    recipe = parts()["mode"].recipe(EXTENT._replace(modes=found))
    assert float(recipe.system.frequency) == 780.0
    assert recipe.alternatives == [{"frequency": 780.0, "damping": 0.02}]
    bound = recipe.bounds["frequency"]
    assert 770.0 < bound.lower < 780.0 < bound.upper < 790.0


def test_without_a_resonance_a_fit_starts_from_guesses_inside_the_bounds():
    recipe = parts()["mode"].recipe(EXTENT)
    for start in recipe.alternatives:
        for path, value in start.items():
            bound = recipe.bounds[path]
            assert bound.lower < value < bound.upper


def test_a_chain_contains_a_mode_a_lag_and_a_delay():
    shape = structure(
        "coleman_hodgdon+exponential_creep+mode+lag+delay",
        Record(INPUT, 0.12 * INPUT, DT),
    )
    places = ("hysteresis", "creep", "dynamics", "lag", "delay", "calibration")
    assert shape.system.names == places
    assert {"dynamics.frequency", "dynamics.damping"} <= set(shape.space.paths)


def by_three_states(frequency, damping, time_constant, inputs, rest):
    """Return a resonance and a sensor in one exact discretisation, by SciPy's expm."""
    w = 2.0 * np.pi * frequency
    matrix = np.zeros((4, 4))
    matrix[0, 1] = 1.0
    matrix[1] = [-(w**2), -2.0 * damping * w, 0.0, w**2]
    matrix[2] = [1.0 / time_constant, 0.0, -1.0 / time_constant, 0.0]
    held = scipy.linalg.expm(matrix * DT)
    state, outputs = np.array([rest, 0.0, rest]), []
    for value in inputs:
        state = held[:3, :3] @ state + held[:3, 3] * value
        outputs.append(state[2])
    return np.array(outputs)


def modes(frequency, damping, sensor):
    return Modes([frequency], [damping], DT, time_constant=[sensor])


@pytest.mark.parametrize("sensor", [1e-5, 1e-4, 3e-3])
@pytest.mark.parametrize(("frequency", "damping"), [(300.0, 0.005), (4000.0, 0.1)])
def test_a_mode_and_its_sensor_are_discretised_together(frequency, damping, sensor):
    expected = by_three_states(frequency, damping, sensor, INPUT, 2.0)
    found = response(modes(frequency, damping, sensor), INPUT, 2.0)
    np.testing.assert_allclose(found, expected, rtol=0.0, atol=1e-9)


def test_modes_are_in_parallel():
    single = [
        response(Mode(f, z, DT), INPUT, 2.0) for f, z in ((300.0, 0.01), (900.0, 0.05))
    ]
    found = response(Modes([300.0, 900.0], [0.01, 0.05], DT, [-0.1]), INPUT, 2.0)
    np.testing.assert_allclose(found, 1.1 * single[0] - 0.1 * single[1], atol=1e-9)


def test_the_gradient_of_modes_equals_finite_differences():
    @jax.jit
    def last(point):
        stage = Modes(point[:2], point[2:4], DT, point[4:5], point[5:])
        return jnp.sum(response(stage, INPUT) ** 2)

    point = np.array([780.0, 1500.0, 0.02, 0.05, 0.1, 1e-3])
    steps = np.diag(1e-5 * point)
    differences = [(last(point + h) - last(point - h)) / (2 * h.sum()) for h in steps]
    np.testing.assert_allclose(jax.jit(jax.grad(last))(point), differences, rtol=1e-5)


@pytest.mark.parametrize(
    ("lists", "message"),
    [
        (([780.0], [0.02], DT, [], [0.0]), "time_constant in s is 0; it must be"),
        (
            ([780.0], [0.02, 0.1], DT),
            "1 values of frequency, 2 of damping and 0 of",
        ),
    ],
)
def test_bad_modes_are_refused(lists, message):
    with pytest.raises(ValueError, match=message):
        Modes(*lists)


def test_modes_start_from_the_resonances_of_the_record():
    seen = (Resonance(780.0, 0.02, -0.1), Resonance(300.0, 0.05, 1.1))
    extent = EXTENT._replace(modes=seen, lags=(1e-3,))
    recipe = parts()["modes"].recipe(extent)
    paths = ("frequency.0", "damping.0", "frequency.1", "share.0", "time_constant.0")
    values = [float(get(recipe.system, path)) for path in paths]
    assert values == [300.0, 0.05, 780.0, -0.1, 1e-3]
    for path, value in zip(paths, values, strict=True):
        assert recipe.bounds[path].lower < value < recipe.bounds[path].upper


def test_an_arma_starts_as_the_resonance_of_the_record():
    recipe = ARMA.recipe(EXTENT._replace(modes=(Resonance(780.0, 0.02),)))
    (start,) = recipe.alternatives
    start = start | {"moving.2": 0.0}
    np.testing.assert_allclose(
        response(replace(recipe.system, start), INPUT),
        response(Mode(780.0, 0.02, DT), INPUT),
        atol=1e-9,
    )
