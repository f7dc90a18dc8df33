import jax
import numpy as np
import pytest

from piezojax import ExponentialCreep, LogarithmicCreep, simulate

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
    # A straight line over log10(t), with the slope that was asked for.
    slope, offset = np.polyfit(np.log10(time[inside]), y[inside], 1)
    assert slope == pytest.approx(0.02, rel=0.03)
    ripple = y[inside] - slope * np.log10(time[inside]) - offset
    assert np.max(np.abs(ripple)) < 0.03 * 0.02


def test_creep_that_has_ended_is_at_rest():
    for system in (
        ExponentialCreep((0.1,), (0.5,), DT),
        LogarithmicCreep(0.1, 0.1, 10.0, DT),
    ):
        y = response(system, np.full(50, 3.0), 3.0)
        np.testing.assert_allclose(y, y[0], atol=1e-13)
        assert y[0] > 3.0


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: ExponentialCreep((0.1,), (0.0,), DT), "time constants in s is 0"),
        (lambda: ExponentialCreep((0.1,), (1.0, 2.0), DT), "1 gains and 2 time"),
        (lambda: ExponentialCreep((0.1,), (1.0,), 0.0), "sample time in s is 0"),
        (lambda: LogarithmicCreep(0.1, 1.0, 1.0, DT), "shortest must be below longest"),
        (lambda: LogarithmicCreep(0.1, 0.0, 1.0, DT), "shortest time in s is 0"),
    ],
)
def test_bad_parameters(build, message):
    with pytest.raises(ValueError, match=message):
        build()
