"""The voltage that a Prandtl-Ishlinskii model needs: its inverse, solved exactly."""

import itertools

import jax
import jax.numpy as jnp

from ..core.arrays import Scalar, ScalarLike, as_array, check, check_order
from .inverse import Inverse
from .plays import Memory, memoryless, weighted
from .prandtl_ishlinskii import PrandtlIshlinskii

ITERATIONS = 20
"""Newton steps, halving where one leaves the bracket, for a polynomial P."""


class InversePrandtlIshlinskii(Inverse):
    """Voltage that moves a Prandtl-Ishlinskii model to a wanted output.

    Input f(k) in um, output u(k) in V. From a given memory the model's next output
    rises with its input in pieces, a corner where each play begins to move; the plays
    move in the order of their thresholds. Which ones do for f is seen by the outputs at
    the corners; what is left is linear and solved in closed form, or, with terms above
    the first in P, a polynomial that rises on a known interval, solved by a bracketed
    Newton method to 1e-9 um. For a linear P it is the inverse of Krejci and Kuhnen
    (2001, IEE Proc. Control Theory Appl. 148(3)), which ``operator`` gives as the
    Prandtl-Ishlinskii operator it is. The state is that of the model itself, so a
    controller whose voltage was clipped can advance it with what was really applied.

    Raises ValueError for thresholds that do not ascend, for an empty polynomial, or,
    with a linear P, for weights that do not leave the output rising with the input.
    With a polynomial P the sum must rise over the inputs that are used; where it does
    not the voltage is finite, but another.
    """

    model: PrandtlIshlinskii

    def __check_init__(self):
        check_invertible(
            self.model.polynomial, self.model.thresholds, self.model.weights
        )

    def init(self, input: ScalarLike = 0.0) -> Memory:
        virgin = (self.model.rest_input,) * len(self.model.thresholds)
        return self.model.init(self.solve(virgin, input))

    def solve(self, state: Memory, wanted: ScalarLike) -> Scalar:
        """Return the voltage (V) for which the model's next output is ``wanted``."""
        model = self.model
        return solved(
            model.polynomial, model.thresholds, model.weights, state, as_array(wanted)
        )

    def operator(self) -> PrandtlIshlinskii:
        """Return the inverse as a Prandtl-Ishlinskii operator from um to V.

        Its plays follow the wanted output alone, from the virgin state. Raises
        ValueError for a polynomial with terms above the first.
        """
        model = self.model
        first, *others = model.polynomial
        if others:
            raise ValueError(
                f"the polynomial has {len(model.polynomial)} terms; only with a linear "
                "one is the inverse a Prandtl-Ishlinskii operator"
            )
        slope, reach = first, as_array(0.0)
        thresholds, weights = [], []
        for r, w in zip(model.thresholds, model.weights, strict=True):
            thresholds.append(slope * r - reach)
            weights.append(-w / (slope * (slope + w)))
            slope, reach = slope + w, reach + w * r
        return PrandtlIshlinskii(
            (1.0 / first,), thresholds, weights, slope * model.rest_input
        )


def check_invertible(polynomial: Memory, thresholds: Memory, weights: Memory) -> None:
    """Raise ValueError unless ``solved`` finds the one input for any output."""
    if not polynomial:
        raise ValueError("the polynomial is empty; an inverse needs its linear term")
    for i, (low, high) in enumerate(itertools.pairwise(thresholds)):
        check_order(f"thresholds.{i}", low, f"thresholds.{i + 1}", high)
    if len(polynomial) == 1:
        slopes = itertools.accumulate((*polynomial, *weights))
        check("slope of the model in um/V", tuple(slopes), above=0.0)


def solved(
    polynomial: Memory,
    thresholds: Memory,
    weights: Memory,
    memory: Memory,
    wanted: Scalar,
) -> Scalar:
    """Return the input x for which P(x) + sum weights play(x) from memory is wanted.

    ``memory`` must be one that plays with these thresholds can have: two of them differ
    by no more than their thresholds do.
    """
    slope, constant = as_array(0.0), as_array(0.0)
    low, high = as_array(-jnp.inf), as_array(jnp.inf)
    # Where the i-th play begins to move all before it do, and none after it.
    moving, reach, resting = slope, slope, weighted(weights, memory)
    for r, w, m in zip(thresholds, weights, memory, strict=True):
        moving, reach, resting = moving + w, reach + w * r, resting - w * m
        upper, lower = m + r, m - r
        rises = (
            wanted > memoryless(polynomial, upper) + moving * upper - reach + resting
        )
        falls = (
            wanted < memoryless(polynomial, lower) + moving * lower + reach + resting
        )
        slope = slope + jnp.where(rises | falls, w, 0.0)
        constant = constant + w * jnp.where(rises, -r, jnp.where(falls, r, m))
        low = jnp.where(rises, upper, jnp.where(falls, low, jnp.maximum(low, lower)))
        high = jnp.where(falls, lower, jnp.where(rises, high, jnp.minimum(high, upper)))
    rest = wanted - constant
    linear = polynomial[0] + slope
    if len(polynomial) == 1:
        return rest / linear
    return _root((linear, *polynomial[1:]), rest, low, high)


def _root(polynomial: Memory, value: Scalar, low: Scalar, high: Scalar) -> Scalar:
    """Return x between low and high, infinite or not, with ``polynomial`` at value."""
    fixed, target, low, high = jax.lax.stop_gradient((polynomial, value, low, high))
    x = jnp.clip(target / jnp.where(fixed[0] > 0.0, fixed[0], jnp.inf), low, high)
    for _ in range(ITERATIONS):
        error = memoryless(fixed, x) - target
        low, high = jnp.where(error < 0.0, x, low), jnp.where(error > 0.0, x, high)
        newton = x - error / _rising(fixed, x)
        middle = 0.5 * (low + high)
        middle = jnp.where(jnp.isfinite(middle), middle, x)
        # At the root itself rounding decides which side a step falls to.
        arrived = jnp.abs(newton - x) <= 1e-9 * (1.0 + jnp.abs(x))
        inside = (newton >= low) & (newton <= high)
        x = jnp.where(inside | arrived, newton, middle)
    # One step more, differentiated with the slope held: the implicit derivative.
    return x - (memoryless(polynomial, x) - value) / _rising(fixed, x)


def _rising(polynomial: Memory, x: Scalar) -> Scalar:
    """Return the slope of ``polynomial`` at x, infinite where it does not rise."""
    derivative = jnp.zeros_like(x)
    for i, coefficient in reversed(list(enumerate(polynomial, 1))):
        derivative = derivative * x + i * coefficient
    return jnp.where(derivative > 0.0, derivative, jnp.inf)
