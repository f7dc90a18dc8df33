"""Weights of a linear relation, learned sample by sample."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp

from ..core.arrays import Matrix, Scalar, as_array, as_scalars, check
from ..core.recursive_update import update
from ..core.system import Learned, System

Row = tuple[Scalar, ...]


class RecursiveWeightsState(Learned):
    """Weights and their covariance.

    The one matrix in a loop: as scalars it takes four times as long to compile, because
    every element needs every other, and runs no faster.
    """

    weights: Row
    covariance: Matrix


class RecursiveWeights(System):
    """Recursive least squares for ``target = sum_i weights[i] row[i]``.

    Input a row and its target, output the weights known after it. ``weights`` are those
    before the first sample, ``deviations`` how far off they may be (standard
    deviations, in the unit of each; 0 holds a weight), ``equation_error`` the standard
    deviation of what the relation leaves, in the unit of the target. What was learned
    is forgotten with the time constant ``memory`` (s): the covariance goes back to that
    of ``deviations``, so it is bounded where nothing moves (stabilised linear
    forgetting: Milek and Kraus 1995, Automatica 31(2)). ``dt`` in s.

    Raises ValueError for a different count of weights and deviations, deviations below
    0, or an equation error, memory or ``dt`` that is not positive.
    """

    weights: Row = eqx.field(converter=as_scalars)
    deviations: Row = eqx.field(converter=as_scalars)
    equation_error: Scalar = eqx.field(converter=as_array)
    memory: Scalar = eqx.field(converter=as_array)
    dt: float = eqx.field(static=True)

    def __check_init__(self):
        check("weights", self.weights)
        check("deviations", self.deviations, least=0.0)
        check("equation error", self.equation_error, above=0.0)
        check("memory in s", self.memory, above=0.0)
        check("sample time in s", self.dt, above=0.0)
        if len(self.weights) != len(self.deviations):
            raise ValueError(
                f"{len(self.weights)} weights and {len(self.deviations)} deviations; "
                "each weight needs one"
            )

    def init(self, input: Any = None) -> RecursiveWeightsState:
        """Return the weights that the relation starts with, whatever the input."""
        return RecursiveWeightsState(self.weights, self._prior())

    def _prior(self) -> Matrix:
        return jnp.diag(jnp.stack(self.deviations) ** 2)

    def step(
        self, state: RecursiveWeightsState, input: tuple[Row, Scalar]
    ) -> tuple[RecursiveWeightsState, Row]:
        row, target = jnp.stack(input[0]), input[1]
        weights, covariance = update(
            jnp.stack(state.weights),
            state.covariance,
            row,
            target,
            self.equation_error**2,
        )
        weights = as_scalars(weights)
        kept = jnp.exp(-self.dt / self.memory)
        covariance = kept * covariance + (1.0 - kept) * self._prior()
        return RecursiveWeightsState(weights, covariance), weights
