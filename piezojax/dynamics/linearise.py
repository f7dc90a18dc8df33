"""Linearisation of a System around an operating point, by differentiation."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array

from ..core.arrays import State
from ..core.paths import static_fields
from ..core.system import Learned, System
from .state_space import StateSpace


def linearise(
    system: System,
    input: Any = 0.0,
    state: State | None = None,
    dt: float | None = None,
) -> StateSpace:
    """Return ``system`` linearised around ``state`` and ``input``.

    The matrices are the exact derivatives of one step: A [n, n], B [n, m], C [p, n], D
    [p, m] for a state of n numbers, an input of m and an output of p, each in the order
    of ``jax.tree.leaves`` and in the units of the system. They map deviations from the
    operating point to deviations. Counters and ``Learned`` states are held constant and
    are not states of the model.

    Without ``state``, the state at rest under ``input`` is used. Without ``dt`` (s),
    the sample time of the parts of the system is used. At a kink of the step, such as
    that of a hysteresis at rest, the derivative is the one that JAX takes there: for
    Coleman-Hodgdon models that of the ascending branch, for a play operator that of the
    resting play. To select a branch, move ``input`` slightly to one side.

    The function works inside ``jax.jit`` and is differentiable. Raises ValueError if
    ``dt`` is not given and the parts of the system have no sample time or several.
    """
    dt = sample_time(system) if dt is None else dt
    input = jax.tree.map(lambda x: jnp.asarray(x, jnp.float64), input)
    state = system.init(input) if state is None else state
    return StateSpace(*_derivatives(system, state, input), dt)


@eqx.filter_jit
def _derivatives(
    system: System, state: State, input: Any
) -> tuple[Array, Array, Array, Array]:
    """Return A, B, C and D in one program: eagerly each operation would be one."""
    moving, held = split_static(state)
    x, unravel_state = ravel_pytree(moving)
    u, unravel_input = ravel_pytree(input)

    def step(x: Array, u: Array) -> tuple[Array, Array]:
        state = eqx.combine(unravel_state(x), held)
        state, output = system.step(state, unravel_input(u))
        return ravel_pytree(split_static(state)[0])[0], ravel_pytree(output)[0]

    (A, B), (C, D) = jax.jacfwd(step, argnums=(0, 1))(x, u)
    return A, B, C, D


def split_static(state: State) -> tuple[State, State]:
    """Return the part of ``state`` that moves, and the part held constant.

    The second part holds counters, which have no derivative, and ``Learned`` states.
    """

    def is_learned(part: Any) -> bool:
        return isinstance(part, Learned)

    def moves(part: Any) -> bool:
        return not is_learned(part) and eqx.is_inexact_array(part)

    return eqx.partition(state, moves, is_leaf=is_learned)


def sample_time(system: System) -> float:
    """Return the common sample time (s) of the parts of ``system``.

    Raises ValueError if they have no sample time, or several.
    """
    times = [float(dt) for dt in static_fields(system, "dt")]
    if times and np.allclose(times, times[0], rtol=1e-9, atol=0.0):
        return times[0]
    named = ", ".join(f"{dt:g} s" for dt in sorted(set(times))) or "none"
    raise ValueError(
        f"the sample time is not known: the sample times in the parts of the "
        f"{type(system).__name__} are {named}; give dt"
    )
