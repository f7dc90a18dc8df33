import jax
import numpy as np
import pytest

from piezojax import (
    simulate,
)
from piezojax.dynamics import (
    ExponentialCreep,
    FirstOrderLag,
    LogarithmicCreep,
    SpringDamperCreep,
)
from piezojax.hysteresis import (
    ColemanHodgdon,
)

DT = 0.01


@jax.jit
def response(system, inputs, start):
    return simulate(system, inputs, system.init(start))[1]


def test_a_step_creeps_by_exponentials():
    gains, times = (0.05, 0.1), (0.2, 3.0)
    time = DT * np.arange(1, 1001)
    found = response(ExponentialCreep(gains, times, DT), np.ones(1000), 0.0)
    expected = 1.0 + sum(
        g * (1.0 - np.exp(-time / tau)) for g, tau in zip(gains, times, strict=True)
    )
    np.testing.assert_allclose(found, expected, atol=1e-12)


@pytest.mark.parametrize("decades", [1, 2, 3])
def test_a_step_creeps_with_the_logarithm_of_time(decades):
    shortest, longest = 1.0, 10.0**decades
    samples = round(longest / DT)
    time = DT * np.arange(1, samples + 1)
    system = LogarithmicCreep(0.02, shortest, longest, DT)
    y = np.asarray(response(system, np.ones(samples), 0.0))
    inside = time > shortest
    # a straight line over log10(t) with the given slope
    slope, offset = np.polyfit(np.log10(time[inside]), y[inside], 1)
    assert slope == pytest.approx(0.02, rel=0.03)
    ripple = y[inside] - slope * np.log10(time[inside]) - offset
    assert np.max(np.abs(ripple)) < 0.03 * 0.02


def test_damped_springs_are_exact_for_a_held_force():
    stiffness, damping, spring, force = (40.0, 90.0), (8.0, 300.0), 6.0, 2.5
    levels = np.array([0.0, 30.0, -10.0, 55.0])
    u = np.repeat(levels, 250)
    y, total = np.zeros(2), []
    for volts in u:  # the equation of each element, solved over one held sample
        for i, (k, c) in enumerate(zip(stiffness, damping, strict=True)):
            end = force * volts / k
            y[i] = end - (end - y[i]) * np.exp(-k / c * DT)
        total.append(force * volts / spring + y.sum())
    system = SpringDamperCreep(stiffness, damping, spring, force, DT)
    np.testing.assert_allclose(response(system, u, 0.0), total, atol=1e-12)


def test_damped_springs_are_a_sum_of_exponentials():
    cascade = SpringDamperCreep((40.0, 90.0), (8.0, 300.0), 6.0, 6.0, DT)
    exponentials = ExponentialCreep((6.0 / 40.0, 6.0 / 90.0), (0.2, 10.0 / 3.0), DT)
    u = np.random.default_rng(1).normal(size=300).cumsum()
    np.testing.assert_allclose(
        response(cascade, u, 1.0), response(exponentials, u, 1.0), atol=1e-12
    )


U = 40.0 + 30.0 * np.sin(np.linspace(0.0, 12.0, 400))
PARALLEL = {
    "exponential": (
        ExponentialCreep((0.01,), (0.5,), DT, direct=0.0),
        ExponentialCreep((0.01,), (0.5,), DT),
    ),
    "logarithmic": (
        LogarithmicCreep(0.01, 0.1, 1.0, DT, direct=0.0),
        LogarithmicCreep(0.01, 0.1, 1.0, DT),
    ),
    "cascade": (
        SpringDamperCreep((200.0,), (100.0,), np.inf, 2.0, DT),
        SpringDamperCreep((200.0,), (100.0,), 2.0, 2.0, DT),
    ),
}


@pytest.mark.parametrize("name", PARALLEL)
def test_hysteresis_plus_creep_in_front_of_dynamics(name):
    # The creep of the voltage: the output of a creep in series minus its input.
    only, whole = PARALLEL[name]
    hysteresis = ColemanHodgdon(0.0077, 0.1167, -0.0487)
    lag = FirstOrderLag(0.05, DT)
    plant = hysteresis + only >> lag
    force = response(hysteresis, U, 0.0) + response(whole, U, 0.0) - U
    expected, held = [], 0.0
    for f in np.asarray(force):
        held = f + (held - f) * np.exp(-DT / 0.05)
        expected.append(held)
    np.testing.assert_allclose(response(plant, U, 0.0), expected, atol=1e-11)


def test_creep_in_series_follows_the_hysteresis():
    hysteresis = ColemanHodgdon(0.0077, 0.1167, -0.0487)
    creep = ExponentialCreep((0.05,), (0.5,), DT)
    force = response(hysteresis, U, 0.0)
    np.testing.assert_allclose(
        response(hysteresis >> creep >> FirstOrderLag(0.05, DT), U, 0.0),
        response(creep >> FirstOrderLag(0.05, DT), force, 0.0),
        atol=1e-12,
    )


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: ExponentialCreep((0.1,), (0.0,), DT), "time_constants in s is 0"),
        (lambda: ExponentialCreep((0.1,), (1.0, 2.0), DT), "1 gains and 2 time"),
        (lambda: ExponentialCreep((0.1,), (1.0,), 0.0), "dt in s is 0"),
        (
            lambda: ExponentialCreep((0.1,), (1.0,), DT, direct=np.nan),
            "direct is nan",
        ),
        (
            lambda: SpringDamperCreep((1.0,), (0.0,), 1.0, 1.0, DT),
            "damping in N s/um is 0; it must be finite and above 0",
        ),
        (
            lambda: SpringDamperCreep((-1.0,), (1.0,), 1.0, 1.0, DT),
            "stiffness in N/um is -1; it must be finite and above 0",
        ),
        (
            lambda: SpringDamperCreep((1.0,), (1.0, 2.0), 1.0, 1.0, DT),
            "1 springs and 2 dampers",
        ),
        (
            lambda: SpringDamperCreep((1.0,), (1.0,), 0.0, 1.0, DT),
            "compliance of the spring in um/N is inf",
        ),
        (lambda: LogarithmicCreep(0.1, 1.0, 1.0, DT), "shortest must be below longest"),
        (lambda: LogarithmicCreep(0.1, 0.0, 1.0, DT), "shortest in s is 0"),
    ],
)
def test_bad_parameters(build, message):
    with pytest.raises(ValueError, match=message):
        build()
