"""The bounded problem that the solvers minimise: loss, residuals, constraints."""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple, Protocol, runtime_checkable

import jax
import numpy as np
from jaxtyping import Array, Float

Unit = Float[Array, " n"]
"""A point of the unit box [0, 1]^n."""

FAILED_LOSS = 1e6
"""Loss in place of a value that is not finite, so that a line search can step back."""

TOLERANCE = 1e-3
"""Largest violation with which a constraint counts as satisfied."""


class Verdict(NamedTuple):
    """Objective at a point without penalties, and the violation of each constraint.

    Violations are on the last axis, positive where a constraint is violated.
    """

    loss: Any
    violations: Any

    @property
    def violation(self) -> np.ndarray:
        """Largest violation, 0 if there is none."""
        return np.max(np.asarray(self.violations), axis=-1, initial=0.0)


class Errors(NamedTuple):
    """Least-squares form of a problem at a point.

    ``loss`` is minimised; ``errors`` are a sample of the errors of each run, ``added``
    the ``signed_terms`` of the augmented Lagrangian. A weight is the derivative of the
    loss with respect to half the mean square of the errors of a run. Half the weighted
    sum of these mean squares, plus the sum of the squares of the added terms above 0,
    has the gradient of the loss, as far as the loss depends on these terms.
    """

    loss: Float[Array, ""]
    verdict: Verdict
    errors: Float[Array, "runs samples"]
    added: Float[Array, " constraints"]
    weights: Float[Array, " runs"]


@runtime_checkable
class Problem(Protocol):
    """A loss over the unit box under constraints: an immutable pytree of arrays.

    The constraints enter the loss through an augmented Lagrangian with ``multipliers``
    and a penalty.
    """

    @property
    def limits(self) -> Mapping[str, Array]:
        """Limits of the constraints by name; empty for an unconstrained problem."""
        ...

    @property
    def constraints(self) -> int:
        """Number of constraints."""
        ...

    @property
    def multipliers(self) -> Array:
        """Multipliers of the augmented Lagrangian, one per constraint."""
        ...

    def with_multipliers(self, multipliers: Array) -> "Problem":
        """Return the problem with these multipliers."""
        ...

    def with_penalty(self, penalty: float) -> "Problem":
        """Return the problem with this penalty on violated constraints."""
        ...

    def loss(self, unit: Unit) -> Float[Array, ""]:
        """Return the augmented Lagrangian; ``FAILED_LOSS`` where it is not finite."""
        ...

    def value_and_verdict(self, unit: Unit) -> tuple[Float[Array, ""], Verdict]:
        """Return ``loss`` and the Verdict of one evaluation."""
        ...

    def errors(self, unit: Unit, every: int) -> Errors:
        """Return the least-squares form at ``unit``, with every ``every``-th error."""
        ...

    def residuals(self, unit: Unit) -> Float[Array, " residuals"]:
        """Return residuals whose squares sum to the loss, if it has this form."""
        ...


def linearised(
    residuals: Callable[[Array], Array],
) -> Callable[[Array], tuple[Array, Array]]:
    """Return a function from a point to the Jacobian and the residuals.

    The Jacobian [residuals, n] comes from forward mode, in one pass with the residuals.
    """

    def twice(point):
        value = residuals(point)
        return value, value

    return jax.jacfwd(twice, has_aux=True)
