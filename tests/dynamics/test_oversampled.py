import jax.numpy as jnp
import numpy as np
import pytest

from piezojax import (
    simulate,
)
from piezojax.catalog import p753
from piezojax.dynamics import (
    Oversampled,
)

STAGE = p753.plant()


@pytest.mark.parametrize("samples", [1, 4, 20])
def test_output_equals_every_nth_output_under_a_held_input(samples):
    inputs = 40.0 + 40.0 * np.random.default_rng(3).uniform(-1.0, 1.0, 50)
    found = simulate(Oversampled(STAGE, samples), jnp.asarray(inputs))[1]
    repeated = simulate(STAGE, jnp.asarray(np.repeat(inputs, samples)))[1]
    np.testing.assert_allclose(
        found, repeated[samples - 1 :: samples], rtol=0.0, atol=1e-12
    )


@pytest.mark.parametrize(
    ("samples", "message"),
    [
        (0, "samples is 0; it must be finite and at least 1"),
        (65, "samples is 65; it must be finite .* at most 64"),
    ],
)
def test_bad_numbers_of_samples_are_refused(samples, message):
    with pytest.raises(ValueError, match=message):
        Oversampled(STAGE, samples)
