"""Control allocation: the commands of redundant actuators for a pose."""

import dataclasses
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from ..core.arrays import (
    ScalarLike,
    State,
    as_array,
    check,
    check_option,
    check_order,
)
from ..core.parameter import parameter
from ..core.system import System
from .box import (
    MOST_ACTUATORS,
    Numbers,
    Problem,
    bounded_commands,
    clipped_commands,
    null_space,
)

METHODS = {
    "minimum_norm": clipped_commands,
    "weighted": clipped_commands,
    "bounded": bounded_commands,
}
"""Allocation methods by name."""


def _numbers(value: Any) -> Numbers:
    return tuple(float(number) for number in np.asarray(value, dtype=float).ravel())


def _rows(value: Any) -> tuple[Numbers, ...]:
    try:
        matrix = np.asarray(value, dtype=float)
    except ValueError:
        matrix = np.empty(0)
    if matrix.ndim != 2:
        raise ValueError("geometry must be numbers in rows of one length, one per axis")
    return tuple(_numbers(row) for row in matrix)


class Allocated(NamedTuple):
    """Allocated commands, their pose, its error and the internal strain.

    ``commands`` [actuators] and the ``pose`` [axes] that they produce; ``error``
    [axes], the wanted pose less ``pose``; ``internal`` [actuators - axes], the part of
    the commands that strains the stage without moving it, in an orthonormal basis of
    the null space.
    """

    commands: Float[Array, " actuators"]
    pose: Float[Array, " axes"]
    error: Float[Array, " axes"]
    internal: Float[Array, " redundancy"]


class Allocation(System):
    """Commands q within bounds for which ``geometry`` q is the wanted pose.

    Input a pose [axes], output commands [actuators]. ``geometry`` [axes, actuators]
    maps commands to a pose and fixes the unit of both; ``lower`` and ``upper``
    [actuators] are in the unit of the commands. There is no state. ``method`` is one of

    - ``"minimum_norm"``: the pseudo-inverse, which minimises sum q^2, clipped at the
      bounds as actuators clip. A clipped command misses the pose, even where other
      commands reach it.
    - ``"weighted"``: the same with the minimum of sum ``weights`` q^2.
    - ``"bounded"``: commands within the bounds that minimise first sum ``axis_weights``
      (pose - geometry q)^2, which is zero for every reachable pose, and then sum
      ``weights`` q^2. They equal the pseudo-inverse where it satisfies the bounds;
      elsewhere they are shifted along the null space by the least amount.

    Weights are 1 by default. An actuator with equal bounds is locked (see ``locked``):
    its effect is subtracted from the pose and the others produce the remainder.

    There is no iteration. On each of the 3^n faces of the box of bounds the
    least-squares solution is linear in pose and bounds, and the best one within the
    bounds is returned. The matrices of these solutions are computed from ``geometry``
    and the weights at trace time, so only pose and bounds can be differentiated. To
    study an error of the geometry, change that of the stage. The commands of
    ``"bounded"`` are continuous in pose and bounds, with kinks where the face changes.

    The problem is stated by Johansen and Fossen, "Control allocation - a survey",
    Automatica 49 (2013). Raises ValueError for numbers that are not finite, weights
    that are not positive (or not equal with ``"minimum_norm"``), a lower bound above
    the upper, lengths that do not fit, a geometry of less than full rank or of more
    than 6 actuators, or an unknown method.
    """

    geometry: tuple[Numbers, ...] = eqx.field(static=True, converter=_rows)
    lower: Float[Array, " actuators"] = parameter("[q]", "lower bounds of the commands")
    upper: Float[Array, " actuators"] = parameter("[q]", "upper bounds of the commands")
    method: str = eqx.field(static=True, default="bounded")
    weights: Numbers = eqx.field(static=True, converter=_numbers, default=())
    axis_weights: Numbers = eqx.field(static=True, converter=_numbers, default=())

    def __check_init__(self):
        geometry = np.array(self.geometry)
        axes, actuators = geometry.shape
        if actuators > MOST_ACTUATORS:
            raise ValueError(
                f"geometry has {actuators} actuators; "
                f"it must have at most {MOST_ACTUATORS}"
            )
        for name, value, count in (
            ("lower", self.lower, actuators),
            ("upper", self.upper, actuators),
            ("weights", self.weights or (1.0,) * actuators, actuators),
            ("axis_weights", self.axis_weights or (1.0,) * axes, axes),
        ):
            if np.shape(value) != (count,):
                raise ValueError(
                    f"{name} has shape {np.shape(value)}; with geometry of shape "
                    f"{geometry.shape} it must be {(count,)}"
                )
        check("geometry", geometry)
        check_order("lower", self.lower, "upper", self.upper, equal=True)
        check("weights", self.weights, above=0.0)
        check("axis_weights", self.axis_weights, above=0.0)
        rank = np.linalg.matrix_rank(geometry)
        if rank < min(axes, actuators):
            raise ValueError(
                f"geometry has rank {rank}; it must have {min(axes, actuators)}, "
                "its full rank"
            )
        check_option("method", self.method, METHODS)
        if self.method == "minimum_norm" and len(set(self.weights)) > 1:
            raise ValueError(
                f"weights are {self.weights}; with minimum_norm they must be equal"
            )

    def init(self, input: ArrayLike = 0.0) -> State:
        return ()

    def step(
        self, state: State, input: Float[ArrayLike, " axes"]
    ) -> tuple[State, Float[Array, " actuators"]]:
        axes, actuators = len(self.geometry), len(self.geometry[0])
        problem = Problem(
            self.geometry,
            self.axis_weights or (1.0,) * axes,
            self.weights or (1.0,) * actuators,
        )
        bounds = self.lower, self.upper
        return state, METHODS[self.method](problem, bounds, as_array(input))

    def allocate(self, pose: Float[ArrayLike, " axes"]) -> Allocated:
        """Return the commands for ``pose`` with the pose and error that result."""
        _, commands = self.step((), pose)
        reached = jnp.array(self.geometry) @ commands
        internal = jnp.array(null_space(self.geometry)) @ commands
        return Allocated(commands, reached, as_array(pose) - reached, internal)

    def locked(self, actuator: int, at: ScalarLike) -> "Allocation":
        """Return the allocation with one actuator held ``at`` a constant command.

        Raises ValueError for an index without an actuator.
        """
        count = len(self.geometry[0])
        if not 0 <= actuator < count:
            raise ValueError(f"actuator is {actuator}; it must be 0 to {count - 1}")
        return dataclasses.replace(
            self,
            lower=self.lower.at[actuator].set(at),
            upper=self.upper.at[actuator].set(at),
        )
