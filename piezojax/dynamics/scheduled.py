"""State-space dynamics scheduled by the amplitude of the input."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from ..core.arrays import Scalar, Scalars, as_array, as_scalars, check, check_order
from ..core.parameter import parameter
from ..core.system import System
from .state_space import StateSpace


class AmplitudeScheduled(System):
    """State-space dynamics interpolated between models of several drive levels.

    ``models`` holds one model per level, of equal size and sample time, whose states
    have the same meaning (as those that ``refined`` returns from one start). ``levels``
    are their rms inputs over all channels, ascending, in the unit of the input.
    ``time_constant`` (s) is that of the running mean square that measures the level.
    Between two levels the matrices are interpolated linearly in the level; beyond the
    first and the last level the nearest model applies. If every A consists of rotations
    scaled by factors below 1, the states decay at zero input however the level changes:
    the interpolation is as stable as its models.

    Raises ValueError for fewer than two models, models that differ in size or sample
    time, levels that do not ascend, or a time constant shorter than a sample.
    """

    models: tuple[StateSpace, ...]
    levels: Scalars = parameter(
        "V", "rms of the input at each model", least=0.0, converter=as_scalars
    )
    time_constant: Scalar = parameter("s", "time constant of the mean square")

    def __check_init__(self):
        if not 2 <= len(self.models) == len(self.levels):
            raise ValueError(
                f"{len(self.models)} models for {len(self.levels)} levels; "
                "there must be one model per level, and two or more"
            )
        kinds = {(model.order, *model.D.shape, model.dt) for model in self.models}
        if len(kinds) > 1:
            raise ValueError(
                f"models differ in (states, outputs, inputs, sample time): "
                f"{sorted(kinds)}; they must be the same"
            )
        for low, high in zip(self.levels[:-1], self.levels[1:], strict=True):
            check_order("a level", low, "the next", high)
        check("time constant in s", self.time_constant, least=self.models[0].dt)

    def at(self, level: Scalar) -> StateSpace:
        """Return the linear model at the rms input ``level``."""
        weights = _hats(level, jnp.stack(self.levels))

        return jax.tree.map(
            lambda *matrices: jnp.tensordot(weights, jnp.stack(matrices), 1),
            *self.models,
        )

    def init(self, input: ArrayLike = 0.0) -> tuple[Array, Scalar]:
        inputs = jnp.broadcast_to(as_array(input), self.models[0].B.shape[1:])
        square = jnp.mean(inputs**2)
        return self.at(_root(square)).init(inputs), square

    def step(
        self, state: tuple[Array, Scalar], input: Float[Array, " m"]
    ) -> tuple[tuple[Array, Scalar], Float[Array, " p"]]:
        states, square = state
        input = as_array(input)
        states, output = self.at(_root(square)).step(states, input)
        change = self.models[0].dt / self.time_constant
        return (states, square + change * (jnp.mean(input**2) - square)), output


def _hats(level: Scalar, levels: Float[Array, " n"]) -> Float[Array, " n"]:
    """Return the weights of linear interpolation at ``level``, constant beyond the
    ends."""
    share = jnp.clip((level - levels[:-1]) / jnp.diff(levels), 0.0, 1.0)
    left = jnp.concatenate([jnp.ones(1), share])
    right = jnp.concatenate([share, jnp.zeros(1)])
    return left - right


def _root(square: Scalar) -> Scalar:
    # The slope of sqrt at 0 is infinite; at rest the gradient must be 0.
    positive = square > 0.0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, square, 1.0)), 0.0)
