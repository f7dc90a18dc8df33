"""Recursive least-squares updates by one row of a linear relation.

The relation is ``target = weights @ row + error``. Both updates give the posterior mean
of the weights and its covariance P. ``update`` carries P, so that a term may be added
to it between rows; a root would have to be factorised again at every row.
``update_root`` carries a root S of P, P = S S^T. It keeps the small variances that P
loses to rounding beside large ones: under exponential forgetting over long runs, nearly
collinear rows, or a prior many decades above the posterior.
"""

from typing import Any

import jax.numpy as jnp

from .arrays import ScalarLike

AnyArray = Any  # of NumPy or JAX: the updates serve both


def update(
    weights: AnyArray,
    covariance: AnyArray,
    row: AnyArray,
    target: AnyArray,
    noise_variance: ScalarLike,
) -> tuple[AnyArray, AnyArray]:
    """Return weights and covariance after one more row.

    ``weights`` [n] with a scalar ``target``, or [outputs, n] with ``target`` [outputs];
    ``covariance`` [n, n] of the weights of each output; ``row`` [n]. ``noise_variance``
    is the variance of the relation's error, in the squared unit of the target.
    """
    direction = covariance @ row
    gain = direction / (noise_variance + row @ direction)
    error = target - weights @ row
    return (
        weights + error[..., None] * gain,
        covariance - direction[:, None] * gain,
    )


def update_root(
    weights: AnyArray,
    root: AnyArray,
    row: AnyArray,
    target: AnyArray,
    noise_variance: ScalarLike,
) -> tuple[AnyArray, AnyArray]:
    """Return weights [n] and root [n, n] of their covariance after one more row.

    Arguments as for ``update``, with one output. Potter's square-root update.
    """
    along = root.T @ row
    variance = noise_variance + along @ along
    direction = root @ along
    weights = weights + direction / variance * (target - row @ weights)
    share = 1.0 / (variance + jnp.sqrt(noise_variance * variance))
    return weights, root - share * jnp.outer(direction, along)
