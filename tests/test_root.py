"""Roots by Newton's method against closed forms."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from piezojax.core.root import root


def squares(a, x):
    return x * x - a


@pytest.mark.parametrize("a", [[4.0], [2.0, 9.0, 1e-8]])
def test_square_roots_and_their_derivatives(a):
    a = jnp.array(a)
    of = lambda a: root(squares, a, jnp.ones_like(a))  # noqa: E731
    np.testing.assert_allclose(of(a), np.sqrt(a), rtol=1e-14)
    expected = np.diag(0.5 / np.sqrt(a))
    np.testing.assert_allclose(jax.jacfwd(of)(a), expected, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(jax.jacrev(of)(a), expected, rtol=1e-12, atol=1e-12)


def test_two_lines():
    matrix = jnp.array([[2.0, 1.0], [1.0, 3.0]])
    found = root(lambda m, x: m @ x - 1.0, matrix, jnp.zeros(2))
    np.testing.assert_allclose(found, np.linalg.solve(matrix, [1.0, 1.0]), rtol=1e-14)


def test_a_batch():
    a = jnp.array([[4.0], [9.0], [1e6]])
    found = jax.vmap(lambda a: root(squares, a, jnp.ones(1)))(a)
    np.testing.assert_allclose(found, np.sqrt(a), rtol=1e-14)


def test_without_a_root_the_iteration_ends():
    found = root(lambda a, x: x * x + a, jnp.ones(1), jnp.full(1, 0.3))
    assert np.isfinite(found).all()


def test_a_flat_function_has_no_root():
    found = root(lambda a, x: a + 0.0 * x, jnp.ones(1), jnp.zeros(1))
    assert not np.isfinite(found).any()
