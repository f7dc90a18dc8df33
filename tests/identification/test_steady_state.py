import jax.numpy as jnp
import numpy as np
import pytest
from scipy.signal import lfilter

from piezojax import (
    Record,
)
from piezojax.core.space import Range, space_of
from piezojax.core.system import Affine
from piezojax.dynamics import (
    ARMA,
    FirstOrderLag,
)
from piezojax.identification import fit_steady_state, fit_structure, steady_response
from piezojax.identification.estimators.structure import Structure

DT = 1e-3
SAMPLES = 128
INPUT = np.random.default_rng(0).standard_normal(SAMPLES)


def settled(pole, gain=1.0):
    """Return the settled y(k + 1) = pole y(k) + gain (1 - pole) u(k), by Fourier."""
    z = np.exp(2j * np.pi * np.arange(SAMPLES // 2 + 1) / SAMPLES)
    transfer = gain * (1.0 - pole) / (z - pole)
    return np.fft.irfft(transfer * np.fft.rfft(INPUT), SAMPLES)


def record(output=None, **changed):
    output = settled(0.8) if output is None else output
    return Record(INPUT, output, DT, source="lag", **{"period": SAMPLES} | changed)


def test_response_equals_the_transfer_function():
    lag = FirstOrderLag(-DT / np.log(0.8), DT)
    found = steady_response(lag, jnp.asarray(INPUT), SAMPLES)
    np.testing.assert_allclose(found, settled(0.8), rtol=0.0, atol=1e-11)


@pytest.mark.parametrize("settle", [0, 1, 50])
def test_settling_starts_from_rest_before_the_end_of_the_period(settle):
    lag = FirstOrderLag(-DT / np.log(0.9), DT)
    driven = np.concatenate([INPUT[SAMPLES - settle :], INPUT])
    expected = lfilter([0.1], [1.0, -0.9], driven)[settle:]
    found = steady_response(lag, jnp.asarray(INPUT), settle)
    np.testing.assert_allclose(found[1:], expected[:-1], rtol=0.0, atol=1e-12)


def put(numbers):
    return ARMA((numbers[0],), (numbers[1],))


STARTS = jnp.array([[0.2, 1.0], [50.0, 1.0], [0.95, 0.1]])  # the second start diverges


def test_fit_finds_the_lag_and_survives_a_start_that_diverges():
    found, errors = fit_steady_state(put, STARTS, record())
    np.testing.assert_allclose(found, [0.8, 0.2], rtol=1e-8)
    assert max(errors[0], errors[2]) < 1e-8
    assert not errors[1] < 1.0


def test_units_do_not_change_the_fit():
    found, _ = fit_steady_state(
        put, STARTS * jnp.array([1.0, 1e-6]), record(1e-6 * settled(0.8))
    )
    np.testing.assert_allclose(found, [0.8, 0.2e-6], rtol=1e-8)


def test_the_fit_averages_the_noise():
    noise = 0.01 * np.random.default_rng(1).standard_normal(SAMPLES)
    found, errors = fit_steady_state(put, STARTS, record(settled(0.8) + noise))
    np.testing.assert_allclose(found, [0.8, 0.2], rtol=0.05)
    np.testing.assert_allclose(np.min(errors), 0.01 / np.std(settled(0.8)), rtol=0.2)


def lag_structure(upper):
    space = space_of(
        {
            "0.time_constant": Range(0.1 * DT, upper, "log"),
            "1.gain": Range(0.1, 10.0),
        }
    )
    return Structure(
        FirstOrderLag(DT, DT) >> Affine(1.0), space, np.array([[0.5, 0.5], [0.7, 0.3]])
    )


def test_a_structure_is_fitted_inside_its_box():
    system, errors = fit_structure(lag_structure(50.0 * DT), record(settled(0.8, 3.0)))
    np.testing.assert_allclose(system.parts[0].pole(), 0.8, rtol=1e-7)
    np.testing.assert_allclose(system.parts[1].gain, 3.0, rtol=1e-7)
    assert np.max(errors) < 1e-6
    system, _ = fit_structure(lag_structure(2.0 * DT), record(settled(0.8, 3.0)))
    assert 1.9 * DT < float(system.parts[0].time_constant) <= 2.0 * DT


@pytest.mark.parametrize(
    ("changed", "options", "message"),
    [
        ({"period": None}, {}, "lag: 128 samples with period None; a steady fit needs"),
        ({"period": 64}, {}, "lag: 128 samples with period 64"),
        ({}, {"settle": 129}, "settle is 129; it must lie in 0..128"),
        ({}, {"settle": -1}, "settle is -1"),
    ],
)
def test_bad_requests_are_refused(changed, options, message):
    with pytest.raises(ValueError, match=message):
        fit_steady_state(put, jnp.array([[0.5, 0.5]]), record(**changed), **options)


def test_without_a_finite_start_there_is_no_fit():
    with pytest.raises(ValueError, match="lag: no start led to a finite simulation"):
        fit_steady_state(put, jnp.full((3, 2), 50.0), record())
