"""Play and stop operators, their weighted sums and the inverse of such a sum."""

import itertools
from collections.abc import Iterable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ..core.arrays import Scalar, as_array, check, check_order
from ..core.recipe import Extent, rest_bounds, scaled_range
from ..core.space import Range

Memory = tuple[Scalar, ...]

ITERATIONS = 20
"""Newton steps for a polynomial P; bisection replaces one that leaves the bracket."""

FAR = 1e9
"""Input (V) that no model reaches: the end of an inverse without a range."""

PLAYS, FINER = 10, 2
"""Operators of a fitted Prandtl-Ishlinskii model that move in every cycle over the
range of a record, and factor by which they are closer for several records."""


def advance_plays(input: Scalar, memory: Memory, thresholds: Memory) -> Memory:
    """Advance play operators (backlashes) of half-width ``thresholds`` by one sample.

    w <- max(x - r, min(x + r, w)), Kuhnen 2003, eq. (3).
    """
    return tuple(
        _limited(w, input - r, input + r)
        for r, w in zip(thresholds, memory, strict=True)
    )


def advance_stops(change: Scalar, memory: Memory, thresholds: Memory) -> Memory:
    """Advance stop operators (spring and slider) by a change of the input.

    e <- min(r, max(-r, e + dx)), Brokate and Sprekels 1996, section 2.1: an elastic
    element that yields at +-r. Play and stop of the same input add up to this input.
    """
    return tuple(
        _limited(e + change, -r, r) for r, e in zip(thresholds, memory, strict=True)
    )


def _limited(value: Scalar, low: Scalar, high: Scalar) -> Scalar:
    # jnp.maximum divides its gradient between equal arguments, which takes twice as
    # long; jnp.where takes longer to trace.
    inside = jax.lax.select(value > high, high, value)
    return jax.lax.select(value < low, low, inside)


def check_plays(thresholds: Memory, weights: Memory, name: str = "weights") -> None:
    """Raise ValueError unless each operator has a threshold and a weight."""
    if len(thresholds) != len(weights):
        raise ValueError(
            f"{len(thresholds)} thresholds and {len(weights)} {name}; "
            "each operator needs one of each"
        )


def plays_within(extent: Extent) -> int:
    """Return the number of operators that move in every cycle over the range.

    Several records determine more of them than one.
    """
    return FINER * (PLAYS + 1) - 1 if extent.several else PLAYS


def typical_distances(extent: Extent, bounds: Iterable[str]) -> dict[str, float]:
    """Return typical distances (um/V) of weights of plays from their first guesses.

    ``bounds`` are the paths of the fitted parameters, which include these weights.
    """
    weights = [path for path in bounds if path.startswith(("weights.", "skew."))]
    return dict.fromkeys(weights, 0.2 * abs(extent.slope) / plays_within(extent))


def plays_recipe(extent: Extent) -> tuple[dict[str, Any], dict[str, Range]]:
    """Return the fields and bounds that all Prandtl-Ishlinskii models share.

    A play with a half-width above half the range of the input adds no hysteresis to its
    cycles. If the input had a wider range before the records, such a play may still
    move when the input first exceeds the extrema since then.
    """
    width, slope, plays = extent.width, extent.slope, plays_within(extent)
    count = round(extent.before * (plays + 1)) - 1
    thresholds = 0.5 * width * np.arange(1, count + 1) / (plays + 1)
    scales = [slope / width**i for i in range(3)]
    return (
        {
            "polynomial": (0.7 * slope, 0.0, 0.0),
            "thresholds": thresholds,
            "weights": (0.3 * slope / plays,) * count,
            "rest_input": extent.first[0],
        },
        {
            **{
                f"polynomial.{i}": scaled_range(s, -10.0, 10.0)
                for i, s in enumerate(scales)
            },
            **{f"weights.{i}": scaled_range(slope, 0.0, 1.0) for i in range(count)},
            **rest_bounds(extent),
        },
    )


def polynomial_part(polynomial: Memory, x: Scalar) -> Scalar:
    """Return ``polynomial[0] x + polynomial[1] x^2 + ...``."""
    total = jnp.zeros_like(x)
    for coefficient in reversed(polynomial):
        total = (total + coefficient) * x
    return total


def weighted_sum(weights: Memory, plays: Memory) -> Scalar:
    """Return the weighted sum of ``plays``."""
    return sum((w * p for w, p in zip(weights, plays, strict=True)), as_array(0.0))


def check_invertible(polynomial: Memory, thresholds: Memory, weights: Memory) -> None:
    """Raise ValueError for plays that ``invert_plays`` cannot invert.

    The slopes are checked for a linear polynomial only; ``check_rising`` tests others.
    """
    if not polynomial:
        raise ValueError("the polynomial is empty; an inverse needs its linear term")
    for i, (low, high) in enumerate(itertools.pairwise(thresholds)):
        check_order(f"thresholds.{i}", low, f"thresholds.{i + 1}", high)
    if len(polynomial) == 1:
        slopes = itertools.accumulate((*polynomial, *weights))
        check("slope of the model in um/V", tuple(slopes), above=0.0)


def invert_plays(
    polynomial: Memory,
    thresholds: Memory,
    weights: Memory,
    memory: Memory,
    wanted: Scalar,
    least: Scalar,
    most: Scalar,
) -> Scalar:
    """Return the input x at which P(x) + sum weights play(x) equals ``wanted``.

    The plays start from ``memory``, in which two plays must not differ by more than
    their thresholds do. The sum must rise with x from ``least`` to ``most``. For a
    value that it does not reach there, P continues along its tangent, and only the
    plays move that begin to move in this range.
    """
    slope, constant = as_array(0.0), as_array(0.0)
    low, high = as_array(-jnp.inf), as_array(jnp.inf)
    # Where the i-th play begins to move, all plays before it move and none after it.
    moving, reach, resting = slope, slope, weighted_sum(weights, memory)
    for r, w, m in zip(thresholds, weights, memory, strict=True):
        moving, reach, resting = moving + w, reach + w * r, resting - w * m
        upper, lower = m + r, m - r
        # Beyond the range P may fall, so that the sum there says nothing.
        rises = (upper <= most) & (
            wanted
            > polynomial_part(polynomial, upper) + moving * upper - reach + resting
        )
        falls = (lower >= least) & (
            wanted
            < polynomial_part(polynomial, lower) + moving * lower + reach + resting
        )
        slope = slope + jnp.where(rises | falls, w, 0.0)
        constant = constant + w * jnp.where(rises, -r, jnp.where(falls, r, m))
        low = jnp.where(rises, upper, jnp.where(falls, low, jnp.maximum(low, lower)))
        high = jnp.where(falls, lower, jnp.where(rises, high, jnp.minimum(high, upper)))
    rest = wanted - constant
    linear = polynomial[0] + slope
    if len(polynomial) == 1:
        return rest / linear
    ends = jax.lax.stop_gradient((least, most))
    return _root((linear, *polynomial[1:]), rest, low, high, ends)


def _root(
    polynomial: Memory,
    value: Scalar,
    low: Scalar,
    high: Scalar,
    ends: tuple[Scalar, Scalar],
) -> Scalar:
    """Return x at which ``polynomial`` equals ``value``, between ``low`` and ``high``.

    Either limit may be infinite. Beyond its ``ends`` the polynomial continues along its
    tangents.
    """
    fixed, target, low, high = jax.lax.stop_gradient((polynomial, value, low, high))
    x = jnp.clip(target / jnp.where(fixed[0] > 0.0, fixed[0], jnp.inf), low, high)
    for _ in range(ITERATIONS):
        reached, slope = _continued(fixed, x, ends)
        error = reached - target
        low, high = jnp.where(error < 0.0, x, low), jnp.where(error > 0.0, x, high)
        newton = x - error / slope
        middle = 0.5 * (low + high)
        middle = jnp.where(jnp.isfinite(middle), middle, x)
        # At the root rounding decides on which side a step ends.
        arrived = jnp.abs(newton - x) <= 1e-9 * (1.0 + jnp.abs(x))
        inside = (newton >= low) & (newton <= high)
        x = jnp.where(inside | arrived, newton, middle)
    # One more step, its slope held constant, has the derivative of the implicit
    # function.
    reached, slope = _continued(polynomial, x, ends)
    return x - (reached - value) / jax.lax.stop_gradient(slope)


def _continued(
    polynomial: Memory, x: Scalar, ends: tuple[Scalar, Scalar]
) -> tuple[Scalar, Scalar]:
    """Return ``polynomial`` at x and its slope, infinite where it does not rise.

    Beyond its ``ends`` the polynomial continues along its tangents.
    """
    inside = jnp.clip(x, *ends)
    slope = jnp.zeros_like(x)
    for i, coefficient in reversed(list(enumerate(polynomial, 1))):
        slope = slope * inside + i * coefficient
    reached = polynomial_part(polynomial, inside) + slope * (x - inside)
    return reached, jnp.where(slope > 0.0, slope, jnp.inf)
