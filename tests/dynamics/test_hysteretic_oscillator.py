import jax
import numpy as np
import pytest
from oracles import bouc_wen as oracle
from scipy.integrate import solve_ivp
from scipy.signal import cont2discrete

from piezojax import (
    simulate,
)
from piezojax.hysteresis import (
    BoucWen,
    HystereticOscillator,
)

DT = 1e-3
TRUE = oracle.BENCHMARK


def model(dt=DT, substeps=4, **changed):
    values = TRUE | changed
    beta = values["beta"]
    return HystereticOscillator(
        values["mass"],
        values["damping"],
        values["stiffness"],
        BoucWen(
            values["alpha"],
            beta * values["gamma"],
            beta * values["delta"],
            values["nu"],
            substeps,
        ),
        dt,
    )


@jax.jit
def displacement(system, force):
    return simulate(system, force, system.init(0.0))[1]


def force(samples=60, seed=0):
    return 50.0 * np.random.default_rng(seed).standard_normal(samples)


@pytest.mark.parametrize(
    "changed",
    [{}, {"delta": 0.4}, {"beta": 30.0, "nu": 1.7}],
    ids=["benchmark", "saturating", "bent"],
)
def test_a_held_force_gives_the_solution_of_the_differential_equations(changed):
    values = tuple((TRUE | changed).values())
    point, expected = (0.0, 0.0, 0.0), []
    for held in force():
        point = solve_ivp(
            lambda _, p, held=held: oracle.slopes(*p, held, *values),
            (0.0, DT),
            point,
            "DOP853",
            rtol=1e-10,
            atol=1e-13,
        ).y[:, -1]
        expected.append(point[0])
    found = displacement(model(**changed, substeps=16), force())
    np.testing.assert_allclose(found, expected, rtol=0.0, atol=1e-4 * np.std(expected))


def test_without_hysteresis_it_equals_the_linear_oscillator():
    # The element is then a spring in parallel.
    stiffness = TRUE["stiffness"] + TRUE["alpha"]
    continuous = (
        np.array([[0.0, 1.0], [-stiffness / 2.0, -TRUE["damping"] / 2.0]]),
        np.array([[0.0], [0.5]]),
        np.array([[1.0, 0.0]]),
        np.zeros((1, 1)),
    )
    A, B, C, _, _ = cont2discrete(continuous, DT, "zoh")
    state, expected = np.zeros((2, 1)), []
    for held in force(200):
        state = A @ state + B * held
        expected.append((C @ state).item())
    found = displacement(model(beta=0.0, substeps=8), force(200))
    np.testing.assert_allclose(found, expected, rtol=0.0, atol=1e-6 * np.std(expected))


def test_finer_samples_of_the_same_held_force_give_the_same_motion():
    coarse = displacement(model(substeps=4), force())
    fine = displacement(model(dt=DT / 4, substeps=1), np.repeat(force(), 4))
    np.testing.assert_allclose(fine[3::4], coarse, rtol=0.0, atol=1e-15)


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"mass": 0.0}, "mass in kg is 0; it must be finite and above 0"),
        ({"damping": np.nan}, "damping in N s/m is nan; it must be finite"),
        ({"stiffness": -1.0}, "stiffness in N/m is -1; it must be finite and above 0"),
        ({"dt": 0.0}, "dt in s is 0; it must be finite and above 0"),
    ],
)
def test_bad_parameters_are_refused(changed, message):
    with pytest.raises(ValueError, match=message):
        model(**changed)
