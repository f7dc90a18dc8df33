"""State of a stage before a record, modelled by a slow motion over three levels.

The last turning points determine most of the state of a hysteresis.
"""

import itertools
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ...core.arrays import Scalar, ScalarLike, State, as_array
from ...core.parameter import parameter
from ...core.rollout import simulate
from ...core.system import Series, System, resolve, series
from ...engines import run_outputs

TURNS = 3
"""Number of levels of the motion before a record."""

SAMPLES = 500
"""Number of samples of the motion from one level to the next."""

BEFORE = "before.voltage"
"""Path of the input that was in force before a record, if it is fitted."""


class Before(System):
    """The input that was in force before a record, ``voltage`` (V).

    It is a part of a chain while that is fitted to one record, and does not change its
    input. The stage rested under this voltage, which is the first one of the record
    unless that begins with a step.
    """

    voltage: Scalar = parameter("V", "input before the record")

    def init(self, input: ScalarLike = 0.0) -> State:
        return ()

    def step(self, state: State, input: ScalarLike) -> tuple[State, Scalar]:
        return state, as_array(input)


def input_before(system: System, otherwise: Any) -> Any:
    """Return the input before a record, ``otherwise`` if ``system`` has no Before."""
    parts = system.parts if isinstance(system, Series) else ()
    return next((part.voltage for part in parts if isinstance(part, Before)), otherwise)


def without_before(system: System) -> System:
    """Return ``system`` without its Before, if it has one, as a plant of any record."""
    if not isinstance(system, Series) or input_before(system, None) is None:
        return system
    named = zip(system.names, system.parts, strict=True)
    return series(**{name: p for name, p in named if not isinstance(p, Before)})


def run_after(
    system: System,
    inputs: Float[Array, " samples *m"],
    levels: Float[Array, " turns *m"],
) -> Array:
    """Return the outputs [samples, p] under ``inputs`` after a motion over ``levels``.

    The stage rests at the first level, then moves slowly to each of the others and to
    the first input. A plant maps u(k) to y(k+1), as in ``free_run``. A plant of scalar
    signals takes [samples] and [turns], and returns [samples].
    """
    system = resolve(system)  # once for the start and the run
    path = path_after(inputs, levels)
    outputs = run_outputs(system, path, system.init(levels[0]))
    return recorded(outputs)


def path_after(
    inputs: Float[Array, " samples *m"], levels: Float[Array, " turns *m"]
) -> Array:
    """Return ``inputs`` behind the motion over ``levels``, from which it starts."""
    return jnp.concatenate([*_motion(inputs[0], levels), inputs[:1], inputs])


def recorded(outputs: Array) -> Array:
    """Return those of the ``outputs`` under a ``path_after`` that are in the record."""
    return outputs[TURNS * SAMPLES : -1]


def state_after(system: System, first: Array, levels: Array) -> State:
    """Return the state one sample before the record."""
    path = jnp.concatenate(_motion(first, levels))
    state, _ = simulate(system, path, system.init(levels[0]))
    return state


def _motion(first: Array, levels: Array) -> list[Array]:
    """Return the inputs of the motion over ``levels`` to the ``first`` input."""
    way = 0.5 - 0.5 * jnp.cos(jnp.linspace(0.0, jnp.pi, SAMPLES))
    way = way.reshape(-1, *[1] * first.ndim)
    return [a + (b - a) * way for a, b in itertools.pairwise([*levels, first])]


def run_from(system: System, inputs: Array, state: State) -> Array:
    """Return the outputs from ``state``, which is one sample before the record."""
    return run_outputs(system, jnp.concatenate([inputs[:1], inputs]), state)[:-1]


@eqx.filter_jit
def runs_after(
    system: System,
    inputs: Float[Array, " samples *m"],
    levels: Float[Array, " candidates turns *m"],
) -> Array:
    """Return the outputs of ``run_after`` for each candidate of ``levels``."""
    return jax.vmap(partial(run_after, resolve(system), inputs))(levels)
