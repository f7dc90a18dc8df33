"""Augmented Lagrangian: constraint terms as squares, and multiplier updates.

Source: Nocedal and Wright, Numerical Optimization, 2006, section 17.4.
"""

from collections.abc import Iterator

import jax.numpy as jnp
from jaxtyping import Array, Float

from .problem import Problem

PENALTY = 10.0
"""Penalty of the first round, for losses and violations of order 1."""

ROUNDS = 5
"""Number of minimisations; the multipliers are updated between them."""

GROWTH = 3.0
"""Factor of the penalty from one round to the next."""


def penalty_terms(
    violation: Float[Array, " constraints"],
    multipliers: Float[Array, " constraints"],
    penalty: Array,
) -> Float[Array, " constraints"]:
    """Return the square roots of the penalty terms of the augmented Lagrangian.

    A penalty term is ``penalty``/2 max(0, g + multiplier/penalty)^2, with the violation
    g.
    """
    return jnp.maximum(signed_terms(violation, multipliers, penalty), 0.0)


def signed_terms(
    violation: Float[Array, " constraints"],
    multipliers: Float[Array, " constraints"],
    penalty: Array,
) -> Float[Array, " constraints"]:
    """Return ``penalty_terms``, but below 0 for a constraint with slack.

    Their derivatives tell a step which constraints it will meet.
    """
    return jnp.sqrt(0.5 * penalty) * (violation + multipliers / penalty)


def update_multipliers(
    violation: Float[Array, "*starts constraints"],
    multipliers: Float[Array, "*starts constraints"],
    penalty: Array,
) -> Float[Array, "*starts constraints"]:
    """Return the multipliers after a round of minimisation."""
    return jnp.maximum(multipliers + penalty * violation, 0.0)


def with_zero_multipliers(problem: Problem) -> Problem:
    """Return ``problem`` with all multipliers 0."""
    return problem.with_multipliers(jnp.zeros(problem.constraints))


def rounds(problem: Problem, steps: int) -> Iterator[tuple[float, int, bool]]:
    """Yield for each round its penalty, its step limit, and whether it is the last.

    A problem without limits takes one round.
    """
    count = ROUNDS if problem.limits else 1
    for number in range(count):
        yield PENALTY * GROWTH**number, -(-steps // count), number + 1 == count
