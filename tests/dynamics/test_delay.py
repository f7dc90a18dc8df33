import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads
from scipy.interpolate import BarycentricInterpolator
from scipy.signal import cont2discrete, lfilter

from piezojax import Record, identify, simulate
from piezojax.core.recipe import Extent, Resonance
from piezojax.dynamics import FractionalDelay

DT = 1e-3
INPUT = np.random.default_rng(0).normal(size=40)


@jax.jit
def response(system, inputs, start):
    return simulate(system, inputs, system.init(start))[1]


@pytest.mark.parametrize("samples", [0.0, 0.4, 1.0, 2.7, 4.0])
def test_a_delay_interpolates_between_samples(samples):
    at = np.arange(40) - samples
    expected = np.interp(at, np.arange(-10, 40), np.r_[np.full(10, 0.5), INPUT])
    found = response(FractionalDelay(samples * DT, DT, 4), INPUT, 0.5)
    np.testing.assert_allclose(found, expected, atol=1e-12)


@pytest.mark.parametrize("samples", [0.0, 0.4, 1.0, 1.3, 2.7, 4.0])
def test_order_3_takes_the_cubic_through_the_adjacent_samples(samples):
    values = np.r_[np.full(10, 0.5), INPUT]
    # No sample is newer than the last one: its cubic serves for the first interval.
    newest = np.arange(10, 50) - max(0, math.floor(samples) - 1)
    expected = []
    for last, at in zip(newest, np.arange(10, 50) - samples, strict=True):
        taken = np.arange(last - 3, last + 1)
        expected.append(BarycentricInterpolator(taken, values[taken])(at))
    found = response(FractionalDelay(samples * DT, DT, 4, order=3), INPUT, 0.5)
    np.testing.assert_allclose(found, expected, atol=1e-12)


@pytest.mark.parametrize("samples", [0.3, 0.5, 1.5, 3.25])
def test_order_3_hardly_changes_a_vibration_at_a_tenth_of_the_sampling_rate(samples):
    angle = 0.2 * np.pi * np.arange(400)
    expected = np.sin(angle - 0.2 * np.pi * samples)
    linear, cubic = (
        np.max(np.abs(response(part, np.sin(angle), 0.0) - expected)[10:])
        for part in (
            FractionalDelay(samples * DT, DT, 4, order=order) for order in (1, 3)
        )
    )
    assert cubic < 7e-3 < 3e-2 < linear


def test_order_3_has_the_derivative_of_its_delay():
    def moved(delay):
        part = FractionalDelay(delay, DT, 4, order=3)
        return jnp.sum(response(part, INPUT, 0.5) ** 2)

    for samples in (0.4, 2.3):
        check_grads(moved, (samples * DT,), order=1, eps=1e-8, rtol=1e-5)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((-1e-3, DT, 4), "delay in s is -0.001; it must be finite and at least 0"),
        ((5e-3, DT, 4), "at most 0.004"),
        ((0.0, 0.0, 4), "dt in s is 0"),
        ((0.0, DT, 0), "longest in samples is 0"),
        ((0.0, DT, 65), "longest in samples is 65; .* at most 64"),
        ((0.0, DT, 4, 2), r"order is 2; it must be one of \(1, 3\)"),
        ((0.0, DT, 4, 5), r"order is 5; it must be one of \(1, 3\)"),
    ],
)
def test_bad_parameters(arguments, message):
    with pytest.raises(ValueError, match=message):
        FractionalDelay(*arguments)


def test_the_delay_of_several_records_may_change_as_much_as_the_lag_beside_it():
    mode = Resonance(500.0, 0.01, 1.0)
    alone = Extent(
        low=0.0, high=100.0, first=(0.0, 0.0), slope=0.1, centre=0.0, span=10.0,
        dt=5e-5, duration=1.0, modes=(mode,), lags=(9e-4,), delay=1.5e-4,
    )  # fmt: skip
    one, several = (
        FractionalDelay.recipe(extent).bounds["delay"]
        for extent in (alone, alone._replace(before=1.4))
    )
    assert (one.lower, one.upper) == pytest.approx((1.375e-4, 1.625e-4))
    assert (several.lower, several.upper) == pytest.approx((0.475e-4, 2.5e-4))


def test_a_fit_finds_a_mode_behind_a_delay_between_samples():
    frequency, damping, delay, parts = 160.0, 0.02, 1.5, 4
    u = np.repeat(np.random.default_rng(0).uniform(10.0, 90.0, 30), 30)
    w = 2.0 * np.pi * frequency
    mode = ([0.1 * w**2], [1.0, 2.0 * damping * w, w**2])
    (b,), a, _ = cont2discrete(mode, DT / parts, "zoh")
    late = np.r_[np.full(round(delay * parts), u[0]), np.repeat(u, parts)]
    y = 0.1 * u[0] + lfilter(b, a, late - u[0])[: u.size * parts : parts]
    fit = identify(Record(u, y, DT), "modes+delay")
    found = {name: one.value for name, one in fit.report.parameters.items()}
    # Straight lines between samples give a damping of 0.018.
    assert found["dynamics.damping.0"] == pytest.approx(damping, rel=0.03)
    assert found["calibration.gain"] == pytest.approx(0.1, rel=0.01)
    assert found["dynamics.frequency.0"] == pytest.approx(frequency, rel=1e-3)
    assert found["delay.delay"] == pytest.approx(delay * DT, rel=0.01)
