"""Control allocation: a pose shared out among more actuators than it has axes."""

import dataclasses
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from ..core.arrays import ScalarLike, State, as_array, check, check_order
from ..core.parameter import parameter
from ..core.system import System
from .box import MOST_ACTUATORS, Numbers, Problem, clipped, null_space, within

METHODS = {"minimum_norm": clipped, "weighted": clipped, "bounded": within}
"""Ways to allocate by name."""


def _numbers(value: Any) -> Numbers:
    return tuple(float(number) for number in np.asarray(value, dtype=float).ravel())


def _rows(value: Any) -> tuple[Numbers, ...]:
    try:
        matrix = np.asarray(value, dtype=float)
    except ValueError:
        matrix = np.empty(0)
    if matrix.ndim != 2:
        raise ValueError("geometry must be numbers in rows of one length, one an axis")
    return tuple(_numbers(row) for row in matrix)


class Allocated(NamedTuple):
    """What became of a wanted pose.

    ``commands`` [actuators] and the ``pose`` [axes] that they make; ``error`` [axes],
    wanted - made; ``internal`` [actuators - axes], the part of the commands that moves
    nothing and only strains the stage, along an orthonormal basis of the null space.
    """

    commands: Float[Array, " actuators"]
    pose: Float[Array, " axes"]
    error: Float[Array, " axes"]
    internal: Float[Array, " redundancy"]


class Allocation(System):
    """Commands q within bounds for which ``geometry`` q is the wanted pose.

    Input a pose [axes], output commands [actuators], in the units between which
    ``geometry`` [axes, actuators] goes; ``lower`` and ``upper`` [actuators] in those of
    the commands. There is no state. By ``method``:

    - ``"minimum_norm"``: the pseudo-inverse, least sum q^2, cut off at the bounds as
      the actuators would: the pose is then missed, even if other commands make it.
    - ``"weighted"``: the same with least sum ``weights`` q^2.
    - ``"bounded"``: of the commands within the bounds those with the least sum
      ``axis_weights`` (pose - geometry q)^2, which is zero for every pose that can be
      made, and of these the one with the least sum ``weights`` q^2: the
      pseudo-inverse where it keeps the bounds, elsewhere shifted along the null space
      by no more than it takes.

    Weights are 1 where left out. An actuator is locked if its bounds are equal (see
    ``locked``): its effect is taken off the pose and the others make the rest.

    Nothing is iterated: the least-squares solution on each of the 3^n faces of the box
    of bounds is a fixed matrix times the pose, and the best of those within bounds is
    the answer. The matrices come from ``geometry`` and the weights when a program is
    traced, so these are no parameters to differentiate (for a stage of another geometry
    than was thought, change the stage's); pose and bounds are. The commands of
    ``"bounded"`` are continuous in both, with kinks where the face changes.

    The problem is that of Johansen and Fossen, "Control allocation - a survey",
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
                "every axis moved on its own"
            )
        if self.method not in METHODS:
            raise ValueError(
                f"method is {self.method!r}; it must be one of {', '.join(METHODS)}"
            )
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
        """Return the commands for ``pose`` with what they make of it."""
        _, commands = self.step((), pose)
        made = jnp.array(self.geometry) @ commands
        internal = jnp.array(null_space(self.geometry)) @ commands
        return Allocated(commands, made, as_array(pose) - made, internal)

    def locked(self, actuator: int, at: ScalarLike) -> "Allocation":
        """Return the same allocation with one actuator stuck ``at`` a command.

        Raises ValueError for an actuator that is not there.
        """
        count = len(self.geometry[0])
        if not 0 <= actuator < count:
            raise ValueError(f"actuator is {actuator}; it must be 0 to {count - 1}")
        return dataclasses.replace(
            self,
            lower=self.lower.at[actuator].set(at),
            upper=self.upper.at[actuator].set(at),
        )
