import jax
import numpy as np
import pytest
from scipy.signal import lfilter

from piezojax import (
    Record,
    simulate,
)
from piezojax.dynamics import (
    ARMA,
)
from piezojax.hysteresis import (
    Preisach,
    RateDependentPreisach,
)
from piezojax.identification import fit_preisach, fit_rate_dependent_preisach

CELLS, LOW, HIGH, LOWEST, REST = 6, -20.0, 100.0, -0.7, 10.0
WEIGHTS, FAST = np.tril(np.random.default_rng(7).uniform(0.02, 0.5, (2, CELLS, CELLS)))
DT, RATE = 1e-3, 4e3
DYNAMICS = ARMA((1.2, -0.35), (0.1, 0.08))


def drive(samples=20):
    """Return a decaying oscillation with corners in every cell of the triangle.

    There are ``samples`` from corner to corner.
    """
    tops = 40.0 + np.linspace(60.0, 0.0, 25)
    bottoms = 40.0 - np.linspace(60.0, 0.0, 25) * 0.98
    corners = [REST, *np.stack([tops, bottoms], axis=1).ravel()]
    at = np.arange(0.0, len(corners) - 1 + 1e-9, 1 / samples)
    return np.interp(at, range(len(corners)), corners)


INPUT = drive()


@jax.jit
def response(system, input):
    return simulate(system, input, system.init(input[0]))[1]


def material(start="virgin"):
    return Preisach(WEIGHTS, LOW, HIGH, LOWEST, REST, start)


def record(start="virgin", noise=0.0, dynamics=False):
    output = np.asarray(response(material(start), INPUT))
    if dynamics:
        a, b = np.array(DYNAMICS.autoregressive), np.array(DYNAMICS.moving)
        gain = b.sum() / (1.0 - a.sum())
        output = gain * output[0] + lfilter(b, [1.0, *-a], output - output[0])
    draws = np.random.default_rng(5).normal(size=output.size)
    return Record(INPUT, output + noise * draws, DT)


@pytest.mark.parametrize("start", ["virgin", "saturated"])
def test_a_known_density_is_recovered(start):
    found = fit_preisach(record(start), CELLS, limits=(LOW, HIGH), start=start)
    np.testing.assert_allclose(found.weights, WEIGHTS, rtol=0, atol=1e-9)
    np.testing.assert_allclose(found.lowest, LOWEST, rtol=0, atol=1e-9)
    assert (found.low, found.high, found.start) == (LOW, HIGH, start)


def test_a_density_before_known_dynamics_is_recovered():
    found = fit_preisach(
        record(dynamics=True), CELLS, limits=(LOW, HIGH), dynamics=DYNAMICS
    )
    np.testing.assert_allclose(found.weights, WEIGHTS, rtol=0, atol=1e-8)
    np.testing.assert_allclose(found.lowest, LOWEST, rtol=0, atol=1e-8)


def test_two_densities_are_recovered_at_two_rates():
    input = np.concatenate([INPUT, drive(6)])
    plant = RateDependentPreisach(material(), FAST, RATE, DT)
    paces = Record(input, np.asarray(response(plant, input)), DT)
    found = fit_rate_dependent_preisach(paces, RATE, CELLS, limits=(LOW, HIGH))
    np.testing.assert_allclose(found.slow.weights, WEIGHTS, rtol=0, atol=1e-8)
    np.testing.assert_allclose(found.fast_weights, FAST, rtol=0, atol=1e-8)
    np.testing.assert_allclose(found.slow.lowest, LOWEST, rtol=0, atol=1e-8)
    assert (found.rate, found.dt) == (RATE, DT)
    with pytest.raises(ValueError, match="rate in V/s is 0"):
        fit_rate_dependent_preisach(paces, 0.0, CELLS)


def test_the_fit_uses_the_given_part_of_the_record():
    found = fit_preisach(record(), CELLS, train=slice(100, None, 2), limits=(LOW, HIGH))
    np.testing.assert_allclose(found.weights, WEIGHTS, rtol=0, atol=1e-8)


def test_with_noise_weights_are_non_negative_and_the_output_fits():
    # More cells than the material and large noise: least squares would go negative.
    noisy = record(noise=0.1)
    found = fit_preisach(noisy, 2 * CELLS, limits=(LOW, HIGH))
    assert np.all(found.weights >= 0.0)
    assert np.any(np.tril(found.weights, -1)[np.tril_indices(2 * CELLS, -1)] == 0.0)
    assert np.all(np.diag(found.weights) > 0.0)
    error = np.asarray(response(found, INPUT) - response(material(), INPUT))
    assert np.sqrt(np.mean(error**2)) < 0.04


def test_smoothing_reduces_the_roughness_of_the_weights():
    noisy = record(noise=0.1)

    def roughness(smoothing):
        found = fit_preisach(
            noisy, 2 * CELLS, limits=(LOW, HIGH), smoothing=smoothing
        ).weights
        return np.abs(np.diff(np.diag(found, -2))).sum()

    assert roughness(1.0) < 0.3 * roughness(0.0)


def test_the_default_limits_are_those_of_the_record():
    found = fit_preisach(record(), 4)
    assert (found.low, found.high) == (INPUT.min(), INPUT.max())


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"cells": 0}, "cells is 0; it must be at least 1"),
        ({"smoothing": -1.0}, "smoothing is -1; it must be at least 0"),
        ({"limits": (0.0, 100.0)}, "limits are 0 to 100 V; the input runs from -18.8"),
        ({"train": slice(5, 5)}, "train is 5:5; it must hold some of"),
        ({"start": "warm"}, "start 'warm'"),
    ],
)
def test_bad_options(options, message):
    with pytest.raises(ValueError, match=message):
        fit_preisach(record(), **options)


def test_an_output_of_the_other_sign_is_refused():
    upside_down = Record(INPUT, -record().output, 1e-3)
    with pytest.raises(ValueError, match="the output falls while the input rises"):
        fit_preisach(upside_down)
