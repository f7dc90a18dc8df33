"""State of a stage before a record: that after a slow motion between two levels.

The last two turning points determine most of the state of a hysteresis. A record tells
them by its first part: the pair is taken whose free run scatters least about it.
"""

import math
from itertools import product
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from ...core.arrays import State
from ...core.rollout import simulate
from ...core.system import Series, System
from ...hysteresis.model import hystereses

SAMPLES = 1000
"""Samples of the motion."""

LEVELS = 9
"""Levels of the input tried for each of the two turning points."""

FINER = (-0.5, -0.25, 0.0, 0.25, 0.5)
"""Levels around the best ones, in steps of the first grid."""

DEVIATION = 0.3
"""Standard deviation of a linear state before a record, as a share of its difference
between rest at both ends of the input's range."""

REFINEMENTS = 3
"""Number of estimates of the linear states, each with the residual variance of the
estimate before."""

FEW = 3
"""Largest number of states of a hysteresis that are corrected like linear states."""

RESOLVED = 1e-12
"""Least relative singular value that is resolved in the normal equations of a start."""


def run_after(
    system: System, inputs: Float[Array, " samples *m"], levels: Float[Array, " 2 *m"]
) -> Array:
    """Return the outputs [samples, p] under ``inputs`` after a motion over ``levels``.

    The stage rests at the first level, then moves slowly to the second and to the first
    input. A plant maps u(k) to y(k+1), as in ``free_run``. A plant of scalar signals
    takes [samples] and [2], and returns [samples].
    """
    return _run_from(system, inputs, _state_after(system, inputs[0], levels))


def _state_after(system: System, first: Array, levels: Array) -> State:
    """Return the state one sample before the record."""
    way = 0.5 - 0.5 * jnp.cos(jnp.linspace(0.0, jnp.pi, SAMPLES // 2))
    way = way.reshape(-1, *[1] * first.ndim)
    path = [
        levels[0] + (levels[1] - levels[0]) * way,
        levels[1] + (first - levels[1]) * way,
    ]
    state, _ = simulate(system, jnp.concatenate(path), system.init(levels[0]))
    return state


def _run_from(system: System, inputs: Array, state: State) -> Array:
    """Return the outputs from ``state``, which is one sample before the record."""
    _, outputs = simulate(system, jnp.concatenate([inputs[:1], inputs]), state)
    return outputs[:-1]


def linear_responses(
    system: System,
    inputs: Float[Array, " samples *m"],
    levels: Float[Array, " 2 *m"],
    ends: Float[Array, " 2 *m"],
) -> Array:
    """Return the free responses [states, samples, p] of the linear parts of ``system``.

    Each is the response to a deviation of one state before the record. The deviation
    equals the difference of this state between rest at both ``ends`` of the inputs. A
    hysteresis with many states has no such response: the path over ``levels``
    determines its state. The few states of other models fade along the path of the
    input, nearly linearly.
    """
    state = _state_after(system, inputs[0], levels)
    flat, unravel = ravel_pytree(_linear_states(system, state))
    rests = [ravel_pytree(_linear_states(system, system.init(end)))[0] for end in ends]
    size = jnp.abs(rests[1] - rests[0])

    def run(linear: Array) -> Array:
        return _run_from(system, inputs, _with_linear(system, state, unravel(linear)))

    def response(deviation: Array) -> Array:
        return jax.jvp(run, (flat,), (deviation,))[1]

    return jax.vmap(response)(jnp.diag(size))


def _is_corrected(system: System, state: State) -> bool:
    count = sum(leaf.size for leaf in jax.tree.leaves(state))
    return not hystereses(system) or count <= FEW


def _linear_states(system: System, state: State) -> Any:
    """Return the states of the parts of ``system`` that are corrected."""
    if not isinstance(system, Series):
        return state if _is_corrected(system, state) else ()
    return [
        _linear_states(part, own) for part, own in zip(system.parts, state, strict=True)
    ]


def _with_linear(system: System, state: State, linear: Any) -> State:
    """Return ``state`` with the states of ``_linear_states`` replaced."""
    if not isinstance(system, Series):
        return linear if _is_corrected(system, state) else state
    return tuple(
        _with_linear(part, own, new)
        for part, own, new in zip(system.parts, state, linear, strict=True)
    )


@eqx.filter_jit
def runs_after(
    system: System,
    inputs: Float[Array, " samples *m"],
    levels: Float[Array, " candidates 2 *m"],
) -> Array:
    """Return the outputs of ``run_after`` for each candidate of ``levels``."""
    return jax.vmap(lambda pair: run_after(system, inputs, pair))(levels)


def levels_before(
    system: System,
    inputs: np.ndarray,
    outputs: np.ndarray,
    part: slice,
    ranges: np.ndarray,
) -> np.ndarray:
    """Return the two levels [2, m] of the inputs whose free run fits best.

    ``inputs`` [samples, m] or [samples], ``outputs`` [samples, p] or [samples]. Errors
    count over ``part``, except for their mean: the zero of the sensor is free.
    ``ranges`` [2, m] or [2] are the ends of the range of the inputs. Of pairs that fit
    equally well the first is taken, for which the stage rests at the first input.
    """
    low, high = ranges
    u, y = inputs[: part.stop], outputs[part].reshape(part.stop - part.start, -1)

    def best(candidates: np.ndarray) -> np.ndarray:
        runs = np.asarray(runs_after(system, jnp.asarray(u), jnp.asarray(candidates)))
        error = y - runs[:, part].reshape(len(candidates), *y.shape)
        scatter = np.var(
            np.clip(np.nan_to_num(error, nan=1e30), -1e30, 1e30), axis=1
        ).sum(-1)
        return candidates[np.argmin(scatter)]

    grid = np.linspace(0.0, 1.0, LEVELS)
    channels = [1] * (ranges.ndim - 1)
    shares = np.array([*product(grid, grid)]).reshape(-1, 2, *channels)
    first = np.broadcast_to(inputs[0], (1, *ranges.shape))
    found = best(np.concatenate([first, low + shares * (high - low)]))
    finer = np.array([*product(FINER, FINER)]).reshape(-1, 2, *channels) * grid[1]
    return best(np.clip(found + finer * (high - low), low, high))


class Start(eqx.Module):
    """What came before a record: a slow motion over two levels of the input, and more.

    ``ends`` are those of the range of the inputs. The zeros of the outputs and the
    linear states before the record are those that are ``most_likely`` if the other
    errors have the ``variance``.
    """

    levels: Float[Array, " 2 *m"]
    ends: Float[Array, " 2 *m"]
    variance: Float[Array, ""]


def start_columns(
    system: System, inputs: Float[Array, " samples *m"], start: Start
) -> Float[Array, "k samples p"]:
    """Return the effect of the unknowns before a record: zeros, then linear states.

    A zero is 1 in the unit of the output. A state is DEVIATION times its difference
    between rest at both ends.
    """
    responses = linear_responses(system, inputs, start.levels, start.ends)
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
    """Return the most likely amounts of ``columns`` in ``error``.

    The amounts of the states have a standard deviation of 1 (see ``start_columns``),
    those of the zeros an infinite one, and the other errors have the ``variance``. Only
    samples with ``counted`` equal to 1 are used. The amounts minimise the sum of the
    squared errors plus ``variance`` times the squared amounts of the states.
    """
    seen = columns * counted[:, None]
    normal = jnp.einsum("ksp,lsp->kl", seen, seen)
    least = RESOLVED * jnp.max(jnp.diag(normal))
    prior = jnp.full(len(columns), jnp.maximum(variance, least))
    normal = normal + jnp.diag(prior.at[: error.shape[1]].set(least))
    return jnp.linalg.solve(normal, jnp.einsum("ksp,sp->k", seen, error))


@eqx.filter_jit
def _fitted_run(
    system: System, inputs: Array, outputs: Array, counted: Array, start: Start
) -> tuple[Array, Array, Array]:
    """Return the run [samples, p] from ``start``, the zeros, and the variance left."""
    run = run_after(system, inputs, start.levels).reshape(outputs.shape)
    columns = start_columns(system, inputs, start)
    amounts = most_likely(columns, outputs - run, counted, start.variance)
    run = run + jnp.einsum("ksp,k->sp", columns, amounts)
    left = counted[:, None] * (outputs - run)
    variance = jnp.sum(left**2) / (jnp.sum(counted) * outputs.shape[1])
    return run, amounts[: outputs.shape[1]], variance


def start_of(
    system: System,
    inputs: np.ndarray,
    outputs: np.ndarray,
    part: slice,
    ranges: np.ndarray,
) -> tuple[Start, np.ndarray, np.ndarray]:
    """Return the start of a record, the run from it [samples, p], and the zeros [p].

    The start is estimated on the samples ``part``. The arguments are those of
    ``levels_before``.
    """
    levels = levels_before(system, inputs, outputs, part, ranges)
    y = outputs.reshape(len(outputs), -1)
    counted = np.zeros(len(y))
    counted[part] = 1.0
    u, z, of = (jnp.asarray(each) for each in (inputs, y, counted))

    def started(variance: Array) -> Start:
        return Start(jnp.asarray(levels), jnp.asarray(ranges), variance)

    start = started(jnp.asarray(np.mean(np.var(y[part], axis=0))))
    for _ in range(REFINEMENTS):
        *_, variance = _fitted_run(system, u, z, of, start)
        start = started(variance)
    run, zero, _ = _fitted_run(system, u, z, of, start)
    return start, np.asarray(run), np.asarray(zero)
