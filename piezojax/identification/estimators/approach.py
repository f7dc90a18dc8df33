"""State of a stage before a record: that after a slow motion between two levels.

The last two turning points determine most of the state of a hysteresis. A record tells
them by its first part: the pair is taken whose free run scatters least about it.
"""

from itertools import product

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ...core.rollout import simulate
from ...core.system import System

SAMPLES = 1000
"""Samples of the motion."""

LEVELS = 9
"""Levels of the input tried for each of the two turning points."""

FINER = (-0.5, -0.25, 0.0, 0.25, 0.5)
"""Levels around the best ones, in steps of the first grid."""

FAR = 1e30
"""Error that stands for that of a run that diverges."""


def run_after(
    system: System, inputs: Float[Array, " samples *m"], levels: Float[Array, " 2 *m"]
) -> Array:
    """Return the outputs [samples, p] under ``inputs`` after a motion over ``levels``.

    The stage rests at the first level, then moves slowly to the second and to the first
    input. A plant maps u(k) to y(k+1), as in ``free_run``. A plant of scalar signals
    takes [samples] and [2], and returns [samples].
    """
    way = 0.5 - 0.5 * jnp.cos(jnp.linspace(0.0, jnp.pi, SAMPLES // 2))
    way = way.reshape(-1, *[1] * (inputs.ndim - 1))
    path = [
        levels[0] + (levels[1] - levels[0]) * way,
        levels[1] + (inputs[0] - levels[1]) * way,
    ]
    _, outputs = simulate(
        system, jnp.concatenate([*path, inputs]), system.init(levels[0])
    )
    return outputs[SAMPLES - 1 : -1]


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
