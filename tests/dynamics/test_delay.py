import jax
import numpy as np
import pytest

from piezojax import (
    simulate,
)
from piezojax.core.recipe import Extent, Resonance
from piezojax.dynamics import (
    FractionalDelay,
)

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


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((-1e-3, DT, 4), "delay in s is -0.001; it must be finite and at least 0"),
        ((5e-3, DT, 4), "at most 0.004"),
        ((0.0, 0.0, 4), "dt in s is 0"),
        ((0.0, DT, 0), "longest in samples is 0"),
        ((0.0, DT, 65), "longest in samples is 65; .* at most 64"),
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
