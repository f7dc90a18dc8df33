"""Largest and smallest elements, and their derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from piezojax.core.arrays import largest, smallest

# XLA flushes subnormal numbers to 0.
numbers = st.floats(-1e6, 1e6, allow_subnormal=False)
rows = st.lists(st.lists(numbers, min_size=4, max_size=4), min_size=1, max_size=3)


@given(rows)
def test_largest_and_smallest_equal_those_of_numpy(values):
    np.testing.assert_array_equal(largest(jnp.array(values)), np.max(values, axis=1))
    np.testing.assert_array_equal(smallest(jnp.array(values)), np.min(values, axis=1))


def test_equal_elements_have_the_derivative_of_one():
    values = jnp.array([1.0, 3.0, 3.0, -2.0])
    np.testing.assert_array_equal(jax.grad(largest)(values), [0.0, 1.0, 0.0, 0.0])
    np.testing.assert_array_equal(jax.grad(smallest)(values), [0.0, 0.0, 0.0, 1.0])


def test_an_infinite_element_does_not_affect_other_derivatives():
    found = jax.grad(lambda x: smallest(jnp.stack([x, jnp.inf])))(2.0)
    assert found == 1.0
