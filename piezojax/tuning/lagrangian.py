"""Rounds of the augmented Lagrangian: minimise, raise the multipliers, again."""

from collections.abc import Iterator

import jax
import jax.numpy as jnp

from .objective import PENALTY, Objective

ROUNDS = 5
"""How often the multipliers are raised, and once more minimised."""

GROWTH = 3.0
"""How the penalty grows from one round to the next."""


def prepared(objective: Objective) -> Objective:
    """Return ``objective`` with multipliers of its limits, all 0."""
    if not objective.limits:
        return objective
    some = jnp.full(len(objective.space.paths), 0.5)
    count = jax.eval_shape(lambda o: o.violated(some), objective).shape[0]
    return objective.with_multipliers(jnp.zeros(count))


def rounds(objective: Objective, steps: int) -> Iterator[tuple[float, int, bool]]:
    """Yield the penalty and the steps of each round, and whether it is the last.

    An objective without limits takes one.
    """
    count = ROUNDS if objective.limits else 1
    for number in range(count):
        yield PENALTY * GROWTH**number, -(-steps // count), number + 1 == count
