"""Recursive least squares against regression on all rows at once."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import linalg

from piezojax.core.recursive_update import update, update_root

TRUE = np.array([1.6, -0.7, 30.0, 0.02])
SCALES = np.array([1.0, 1.0, 1e-3, 10.0])


def relation(count, seed=1):
    """Return rows with two elements constant in every second 500, and targets."""
    rng = np.random.default_rng(seed)
    rows = rng.standard_normal((count, 4)) * SCALES
    rows[np.arange(count) // 500 % 2 == 1, :2] = 0.0
    return rows, rows @ TRUE + 0.1 * rng.standard_normal(count)


def posterior(rows, targets, noise_variance, prior):
    """Return mean and covariance of least squares with a row for each prior weight."""
    size = rows.shape[1]
    stacked = np.vstack([rows / np.sqrt(noise_variance), np.eye(size) / np.sqrt(prior)])
    aims = np.concatenate([targets / np.sqrt(noise_variance), np.zeros(size)])
    R = linalg.qr(stacked, mode="r")[0][:size]
    inverse = linalg.solve_triangular(R, np.eye(size))
    return linalg.lstsq(stacked, aims)[0], inverse @ inverse.T


def with_root(weights, covariance, row, target, noise_variance):
    root = np.linalg.cholesky(covariance)
    weights, root = update_root(weights, root, row, target, noise_variance)
    return weights, root @ root.T


@pytest.mark.parametrize("step", [update, with_root])
def test_updates_give_the_posterior(step):
    rows, targets = relation(400)
    weights, covariance = np.zeros(4), 100.0 * np.eye(4)
    for row, target in zip(rows, targets, strict=True):
        weights, covariance = step(weights, covariance, row, target, 0.01)
    mean, expected = posterior(rows, targets, 0.01, 100.0)
    np.testing.assert_allclose(weights, mean, rtol=1e-8)
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    np.testing.assert_allclose(covariance / scale, expected / scale, atol=1e-8)


def test_several_targets_equal_separate_relations():
    rows, targets = relation(50)
    targets = np.column_stack([targets, 2.0 * targets**2])
    weights, covariance = np.zeros((2, 4)), np.eye(4)
    for row, target in zip(rows, targets, strict=True):
        weights, covariance = update(weights, covariance, row, target, 0.3)
    for found, column in zip(weights, targets.T, strict=True):
        mean, _ = posterior(rows, column, 0.3, 1.0)
        np.testing.assert_allclose(found, mean, rtol=1e-9, atol=1e-12)


def test_the_root_update_is_accurate_over_a_long_run_with_forgetting():
    """The update of the covariance becomes indefinite here."""
    forgetting, prior, count = 0.99, 1e10, 100_000
    rows, targets = relation(count)

    def step(state, sample):
        weights, root = update_root(*state, *sample, forgetting)
        return (weights, root / jnp.sqrt(forgetting)), None

    start = jnp.zeros(4), jnp.sqrt(prior) * jnp.eye(4)
    samples = jnp.asarray(rows), jnp.asarray(targets)
    (weights, root), _ = jax.jit(lambda: jax.lax.scan(step, start, samples))()
    # All rows before the last 5000 have a weight of 1e-21.
    share = np.sqrt(forgetting ** np.arange(4999, -1, -1.0))
    mean, covariance = posterior(
        rows[-5000:] * share[:, None], targets[-5000:] * share, 1.0, 1e30
    )
    np.testing.assert_allclose(weights, mean, rtol=1e-6)
    np.testing.assert_allclose(np.diag(root @ root.T), np.diag(covariance), rtol=1e-6)
