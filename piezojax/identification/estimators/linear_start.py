"""States of linear parts before a record, and the zeros of its sensors."""

import math
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from ...core.arrays import State
from ...core.system import Series, System, resolve
from ...hysteresis.model import hystereses
from .approach import run_from, state_after

DEVIATION = 0.3
"""Standard deviation of a linear state before a record, as a share of its difference
between rest at both ends of the input's range."""

FEW = 3
"""Largest number of states of a hysteresis that are corrected like linear states."""

RESOLVED = 1e-12
"""Least relative singular value that is resolved in the normal equations of a start."""


def linear_responses(
    system: System,
    inputs: Float[Array, " samples *m"],
    levels: Float[Array, " turns *m"],
    ends: Float[Array, " 2 *m"],
    few: int = FEW,
) -> Array:
    """Return the free responses [states, samples, p] of the linear parts of ``system``.

    Each is the response to a deviation of one state before the record. The deviation
    equals the difference of this state between rest at both ``ends`` of the inputs. A
    hysteresis with more than ``few`` states has no such response: the path over
    ``levels`` determines its state. One with at most ``few`` states is treated as
    linear, because its memory fades nearly linearly along the path of the input.
    """
    law = resolve(system)  # once for all motions and runs
    state = state_after(law, inputs[0], levels)
    flat, unravel = ravel_pytree(_linear_states(system, state, few))
    rests = [
        ravel_pytree(_linear_states(system, law.init(end), few))[0] for end in ends
    ]
    size = jnp.abs(rests[1] - rests[0])

    def run(linear: Array) -> Array:
        moved = _with_linear(system, state, unravel(linear), few)
        return run_from(law, inputs, moved)

    def response(deviation: Array) -> Array:
        return jax.jvp(run, (flat,), (deviation,))[1]

    return jax.vmap(response)(jnp.diag(size))


def _is_corrected(system: System, state: State, few: int) -> bool:
    count = sum(leaf.size for leaf in jax.tree.leaves(state))
    return not hystereses(system) or count <= few


def _linear_states(system: System, state: State, few: int) -> Any:
    """Return the states of the parts of ``system`` that are corrected."""
    if not isinstance(system, Series):
        return state if _is_corrected(system, state, few) else ()
    return [
        _linear_states(part, own, few)
        for part, own in zip(system.parts, state, strict=True)
    ]


def _with_linear(system: System, state: State, linear: Any, few: int) -> State:
    """Return ``state`` with the states of ``_linear_states`` replaced."""
    if not isinstance(system, Series):
        return linear if _is_corrected(system, state, few) else state
    return tuple(
        _with_linear(part, own, new, few)
        for part, own, new in zip(system.parts, state, linear, strict=True)
    )


class Start(eqx.Module):
    """State before a record, reached by a slow motion over ``levels`` of the input.

    ``ends`` are the ends of the range of the inputs. The zeros of the outputs and the
    linear states before the record follow from ``most_likely``; ``variance`` is that of
    the remaining errors, times the number of samples that count as one.
    """

    levels: Float[Array, " turns *m"]
    ends: Float[Array, " 2 *m"]
    variance: Float[Array, ""]


def start_columns(
    system: System, inputs: Float[Array, " samples *m"], start: Start, few: int = FEW
) -> Float[Array, "k samples p"]:
    """Return the effect of sensor zeros (offsets), then of states before a record.

    A coefficient of 1 stands for a zero of 1 in the unit of the output, or for a state
    of DEVIATION times its difference between rest at both ends. ``few`` is that of
    ``linear_responses``.
    """
    responses = linear_responses(system, inputs, start.levels, start.ends, few)
    outputs = math.prod(responses.shape[2:])
    responses = responses.reshape(*responses.shape[:2], outputs)
    zeros = jnp.broadcast_to(jnp.eye(outputs)[:, None], (outputs, len(inputs), outputs))
    columns = jnp.concatenate([zeros, DEVIATION * responses])
    return jnp.where(jnp.isfinite(columns), columns, 0.0)


def most_likely(
    columns: Float[Array, "k samples p"],
    error: Float[Array, "samples p"],
    counted: Float[Array, " samples"],
    variance: Float[Array, ""],
) -> Float[Array, " k"]:
    """Return the maximum a posteriori coefficients of ``columns`` in ``error``.

    The coefficients of the states have a prior standard deviation of 1 (see
    ``start_columns``), those of the zeros an infinite one; ``variance`` is that of
    the remaining errors. Only samples with ``counted`` equal to 1 are used. The
    coefficients minimise the sum of the squared errors plus ``variance`` times the
    squared coefficients of the states.
    """
    seen = columns * counted[:, None]
    normal = jnp.einsum("ksp,lsp->kl", seen, seen)
    least = RESOLVED * jnp.max(jnp.diag(normal))
    prior = jnp.full(len(columns), jnp.maximum(variance, least))
    normal = normal + jnp.diag(prior.at[: error.shape[1]].set(least))
    return jnp.linalg.solve(normal, jnp.einsum("ksp,sp->k", seen, error))
