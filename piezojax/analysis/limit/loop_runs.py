"""Runs of a loop around its stage, and around a linear plant with a disturbance."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ...core.feedback import Feedback, LoopSample, loop_inputs
from ...core.rollout import simulate
from .linear_plant import LinearPlant


def simulate_runs(
    loop: Feedback, references: jax.Array, noise: jax.Array, disturbance: Any
) -> tuple[LoopSample, np.ndarray]:
    """Return the logs [runs, samples] and the voltages [runs] before the first sample.

    There is one run for each draw of ``noise`` [references, draws, samples];
    ``references`` are [references, samples]. ``disturbance``, None if there is none,
    broadcasts to the shape of the noise.
    """
    if disturbance is not None:
        disturbance = jnp.broadcast_to(disturbance, noise.shape)
    logs, rest = _logs(loop, references, noise, disturbance)
    return jax.tree.map(_flat, logs), np.asarray(rest).reshape(-1)


@jax.jit
def _logs(loop: Feedback, references: Any, noise: Any, disturbance: Any) -> Any:
    def one(reference, noise, disturbance):
        start = loop.init(reference[0])
        inputs = loop_inputs(reference, noise, disturbance)
        return simulate(loop, inputs, start)[1], start.voltage

    each = jax.vmap(one, in_axes=(None, 0, 0))
    return jax.vmap(each)(references, noise, disturbance)


def noise_free_error(
    loop: Feedback, plant: LinearPlant, references: jax.Array, left: np.ndarray
) -> np.ndarray:
    """Return the error (um) of ``loop`` around ``plant``, without noise.

    ``left`` (um) is the residual of the linear plant in each run and acts as a
    disturbance. With the noise of the run added, this simulation would reproduce the
    run. ``left`` and the error are [references, draws, samples].
    """
    # The disturbance of sample k moves the displacement at k + 1.
    ahead = np.concatenate([left[..., 1:], left[..., -1:]], axis=-1)
    return np.asarray(_errors(loop, plant, references, ahead))


@jax.jit
def _errors(loop: Feedback, plant: LinearPlant, references: Any, left: Any) -> Any:
    def one(reference, left):
        start = loop.init(reference[0])
        resting = plant.at(start.voltage, start.displacement)
        around = Feedback(loop.controller, resting, loop.actuator, loop.sensor)
        # The start is the loop's own: only the plant differs.
        begun = start._replace(plant=resting.init(start.voltage))
        log = simulate(around, loop_inputs(reference, None, left), begun)[1]
        return log.displacement - log.reference

    return jax.vmap(jax.vmap(one, in_axes=(None, 0)))(references, left)


def _flat(array: Any) -> np.ndarray:
    array = np.asarray(array)
    return array.reshape(-1, array.shape[-1])
