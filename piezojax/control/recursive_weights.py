"""Recursive least squares with forgetting, for the weights of a linear relation."""

from typing import Any

import jax.numpy as jnp

from ..core.arrays import Matrix, Scalar, as_scalars
from ..core.parameter import parameter, sample_time
from ..core.recursive_update import update
from ..core.system import Learned, System

Row = tuple[Scalar, ...]


class RecursiveWeightsState(Learned):
    """Weights and their covariance.

    The covariance is kept as an array: as scalars it would take four times as long to
    compile, because every element depends on every other, and run no faster.
    """

    weights: Row
    covariance: Matrix


class RecursiveWeights(System):
    """Recursive least squares for ``target = sum_i weights[i] row[i]``.

    Input a row and its target, output the weights updated by them. Each weight has the
    unit of the target per element of the row. A deviation of 0 fixes its weight. Old
    samples are forgotten with the time constant ``memory``: the covariance returns to
    that of ``deviations``, so it stays bounded when the rows do not change (stabilised
    linear forgetting: Milek and Kraus 1995, Automatica 31(2)).

    Raises ValueError for a parameter outside its limits, or different counts of weights
    and deviations.
    """

    weights: Row = parameter(
        "[target] per term", "weights at the start", converter=as_scalars
    )
    deviations: Row = parameter(
        "[target] per term",
        "standard deviations of the weights at the start",
        least=0.0,
        converter=as_scalars,
    )
    equation_error: Scalar = parameter(
        "[target]",
        "standard deviation of the residual of the relation",
        above=0.0,
        scale="log",
    )
    memory: Scalar = parameter(
        "s", "time constant of forgetting", above=0.0, scale="log"
    )
    dt: float = sample_time()

    def __check_init__(self):
        if len(self.weights) != len(self.deviations):
            raise ValueError(
                f"{len(self.weights)} weights and {len(self.deviations)} deviations; "
                "each weight needs one"
            )

    def init(self, input: Any = None) -> RecursiveWeightsState:
        """Return the initial weights and covariance; ``input`` is not used."""
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
        forgetting = jnp.exp(-self.dt / self.memory)
        covariance = forgetting * covariance + (1.0 - forgetting) * self._prior()
        return RecursiveWeightsState(weights, covariance), weights
