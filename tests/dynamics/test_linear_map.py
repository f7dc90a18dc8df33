import jax
import jax.numpy as jnp
import numpy as np
import pytest

from piezojax import (
    simulate,
)
from piezojax.core.system import rest_output
from piezojax.dynamics import (
    LinearMap,
    StateSpace,
)

DRAW = np.random.default_rng(2)
MATRIX = DRAW.normal(size=(2, 3))


def test_a_linear_map_multiplies():
    inputs = DRAW.normal(size=(50, 3))
    for run in (simulate, jax.jit(simulate)):
        found = run(LinearMap(MATRIX), inputs)[1]
        np.testing.assert_allclose(found, inputs @ MATRIX.T, rtol=0, atol=1e-14)


def test_a_linear_map_is_part_of_a_chain():
    lag = StateSpace(0.5 * np.eye(2), 0.5 * np.eye(2), np.eye(2), np.zeros((2, 2)), 1.0)
    found = rest_output(LinearMap(MATRIX) >> lag, jnp.arange(3.0))
    np.testing.assert_allclose(found, MATRIX @ np.arange(3.0), rtol=1e-12)


@pytest.mark.parametrize(
    ("matrix", "message"),
    [
        ([1.0, 2.0], r"a matrix has shape \(2,\); it must be 2-dimensional"),
        ([[1.0, np.nan]], "matrix is .*nan.*; it must be finite"),
    ],
)
def test_bad_matrices_are_refused(matrix, message):
    with pytest.raises(ValueError, match=message):
        LinearMap(matrix)
