"""Filters against SciPy's bilinear transform, with slopes up to Nyquist's frequency."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.signal

from piezojax import simulate
from piezojax.core.paths import replace
from piezojax.dynamics import (
    Biquad,
    FirstOrderLowPass,
    Notch,
    SecondOrderLowPass,
)

DT = 5e-5
NYQUIST = 0.5 / DT
SHARES = (1e-6, 1e-3, 0.2, 0.5, 0.9, 0.999)
"""Frequencies as shares of Nyquist's."""


def filters(frequency):
    return {
        "first order": FirstOrderLowPass(frequency, DT),
        "second order": SecondOrderLowPass(frequency, 0.4, DT),
        "biquad": Biquad(0.7 * frequency, 0.02, frequency, 0.6, DT),
        "notch": Notch(frequency, 0.3, 0.05, DT),
    }


def warped(frequency):
    return 2.0 / DT * np.tan(np.pi * frequency * DT)


def continuous(name, frequency):
    """Return the coefficients of s of the prewarped continuous filters."""
    w, v = warped(frequency), warped(0.7 * frequency)
    return {
        "first order": ([1.0], [1.0 / w, 1.0]),
        "second order": ([1.0], [1.0 / w**2, 0.8 / w, 1.0]),
        "biquad": ([1.0 / v**2, 0.04 / v, 1.0], [1.0 / w**2, 1.2 / w, 1.0]),
        "notch": ([1.0 / w**2, 0.03 / w, 1.0], [1.0 / w**2, 0.6 / w, 1.0]),
    }[name]


NAMES = tuple(filters(1.0))


@jax.jit
def response(system, inputs, start):
    return simulate(system, inputs, system.init(start))[1]


@pytest.mark.parametrize("share", SHARES[1:])
@pytest.mark.parametrize("name", NAMES)
def test_a_filter_is_the_bilinear_transform_of_its_equation(name, share):
    frequency = share * NYQUIST
    over, under = continuous(name, frequency)
    b, a = scipy.signal.bilinear(over, under, 1.0 / DT)
    inputs = 2.0 + np.random.default_rng(3).normal(size=400)
    expected = scipy.signal.lfilter(
        b, a, inputs, zi=2.0 * scipy.signal.lfilter_zi(b, a)
    )
    found = response(filters(frequency)[name], inputs, 2.0)
    np.testing.assert_allclose(found, expected[0], rtol=0.0, atol=1e-8)


@pytest.mark.parametrize("share", [0.05, 0.8])
def test_designs_of_scipy(share):
    frequency = share * NYQUIST
    inputs = np.random.default_rng(4).normal(size=300)
    for order, system in enumerate(
        (FirstOrderLowPass(frequency, DT), SecondOrderLowPass(frequency, 0.5**0.5, DT))
    ):
        design: Any = scipy.signal.butter(order + 1, share)
        expected = scipy.signal.lfilter(design[0], design[1], inputs)
        np.testing.assert_allclose(
            response(system, inputs, 0.0), expected, rtol=0.0, atol=1e-12
        )


@pytest.mark.parametrize("depth", [0.0, 0.3, 1.0])
def test_a_notch_has_its_depth_at_its_frequency(depth):
    frequency, samples = 3000.0, 4000
    impulse = np.zeros(samples)
    impulse[0] = 1.0
    output = np.asarray(response(Notch(frequency, 0.1, depth, DT), impulse, 0.0))
    turns = np.exp(-2j * np.pi * frequency * DT * np.arange(samples))
    np.testing.assert_allclose(np.sum(output * turns), depth, rtol=0.0, atol=1e-12)
    if depth == 1.0:
        np.testing.assert_allclose(output, impulse, rtol=0.0, atol=1e-15)


@pytest.mark.parametrize("share", SHARES)
@pytest.mark.parametrize("name", NAMES)
def test_rest_stays_exactly_at_rest(name, share):
    system = filters(share * NYQUIST)[name]
    state, output = system.step(system.init(37.1), 37.1)
    assert float(output) == 37.1
    for left, right in zip(
        jax.tree.leaves(state), jax.tree.leaves(system.init(37.1)), strict=True
    ):
        assert float(left) == float(right)


def test_slopes_are_those_of_differences_and_finite_up_to_nyquist():
    shares = np.array([*SHARES, 1.0 - 1e-6, 1.0 - 1e-9])
    inputs = jnp.asarray(np.random.default_rng(5).normal(size=60))
    for name, system in filters(1000.0).items():

        def last(share, system=system):
            frequency = {"frequency": share * NYQUIST}
            outputs = simulate(replace(system, frequency), inputs, system.init(0.0))[1]
            return outputs[-1]

        values, slopes = jax.vmap(jax.value_and_grad(last))(shares)
        assert np.all(np.isfinite(values)), name
        assert np.all(np.isfinite(slopes)), name
        step = 1e-6 * shares[1:6]
        upper, lower = (jax.vmap(last)(shares[1:6] + s * step) for s in (1.0, -1.0))
        np.testing.assert_allclose(
            slopes[1:6], (upper - lower) / (2.0 * step), rtol=1e-5, atol=1e-6
        )


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Notch(0.0, 0.1, 0.1, DT), "frequency in Hz is 0; it must be finite"),
        (lambda: Notch(1e4, 0.1, 0.1, DT), "frequency in Hz is 10000; .* below 10000"),
        (lambda: Notch(1e3, 0.1, -0.1, DT), "depth is -0.1; .* at least 0"),
        (lambda: Notch(1e3, 0.0, 0.1, DT), "damping is 0; it must be finite and abo"),
        (lambda: FirstOrderLowPass(1e4, DT), "frequency in Hz is 10000"),
        (lambda: SecondOrderLowPass(1e3, 0.0, DT), "damping is 0"),
        (lambda: Biquad(2e4, 0.1, 1e3, 0.1, DT), "zero_frequency in Hz is 20000"),
        (lambda: Biquad(1e3, -0.1, 1e3, 0.1, DT), "zero_damping is -0.1"),
    ],
)
def test_values_that_are_not_allowed_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()
