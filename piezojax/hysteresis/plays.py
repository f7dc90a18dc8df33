"""Play and stop operators: what Prandtl-Ishlinskii models are sums of."""

import jax.numpy as jnp

from ..core.arrays import Scalar, as_array, check

Memory = tuple[Scalar, ...]


def played(input: Scalar, memory: Memory, thresholds: Memory) -> Memory:
    """Advance play operators (backlashes) of half-width ``thresholds`` by one sample.

    w <- max(x - r, min(x + r, w)), Kuhnen 2003, eq. (3).
    """
    return tuple(
        _limited(w, input - r, input + r)
        for r, w in zip(thresholds, memory, strict=True)
    )


def stopped(change: Scalar, memory: Memory, thresholds: Memory) -> Memory:
    """Advance stop operators (spring and slider) by a change of the input.

    e <- min(r, max(-r, e + dx)), Brokate and Sprekels 1996, section 2.1: an elastic
    element that yields at +-r. Of the same input, play and stop add up to it.
    """
    return tuple(
        _limited(e + change, -r, r) for r, e in zip(thresholds, memory, strict=True)
    )


def _limited(value: Scalar, low: Scalar, high: Scalar) -> Scalar:
    # The gradient of a maximum shares ties out, which makes it take twice as long.
    return jnp.where(value < low, low, jnp.where(value > high, high, value))


def check_plays(thresholds: Memory, weights: Memory, name: str = "weights") -> None:
    """Raise ValueError unless each operator has a positive threshold and a weight."""
    check("thresholds", thresholds, above=0.0)
    check(name, weights)
    if len(thresholds) != len(weights):
        raise ValueError(
            f"{len(thresholds)} thresholds and {len(weights)} {name}; "
            "each play operator needs one of both"
        )


def memoryless(polynomial: Memory, x: Scalar) -> Scalar:
    """Return ``polynomial[0] x + polynomial[1] x^2 + ...``."""
    total = jnp.zeros_like(x)
    for coefficient in reversed(polynomial):
        total = (total + coefficient) * x
    return total


def weighted(weights: Memory, plays: Memory) -> Scalar:
    """Return the sum of ``plays``, each by its weight."""
    return sum((w * p for w, p in zip(weights, plays, strict=True)), as_array(0.0))
