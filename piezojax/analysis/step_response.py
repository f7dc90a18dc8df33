"""Step tests of a loop of one axis: small and large steps, up and down."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..core.arrays import ScalarLike
from ..core.feedback import Feedback, loop_inputs
from ..core.rollout import simulate

SMALL = 0.1
"""Height of the small steps, as a share of that of the large ones."""

LARGE = ("large step up", "large step down")
NAMES = ("small step up", "small step down", *LARGE)

BAND, FINE = 0.02, 0.001
"""Settling bands around the reference, as shares of the height."""

START, END = 0.1, 0.9
"""Shares of the height between which the rise time is measured."""

LAST = 0.1
"""Share of a run, at its end, over which the steady-state error is averaged."""


class StepFigures(NamedTuple):
    """Figures of step responses, by step.

    - ``rise_time``: s from 10 to 90 % of the height;
    - ``settling_time``, ``settling_time_fine``, ``settling_time_noise``: s from the
      step until the displacement stays within 2 %, 0.1 % and the rms noise of the
      sensor around the reference;
    - ``overshoot``: largest excess over the reference, as a share of the height;
    - ``steady_state_error``: mean distance from the reference in the last tenth of the
      run, as a share of the height.

    If the displacement does not settle within the run, the settling time is longer than
    the run and falls as the displacement ends nearer to the reference. If it does not
    reach 90 % of the height, the rise time is longer than the run and falls as the peak
    of the step response comes nearer to 90 %.
    """

    rise_time: Array
    settling_time: Array
    settling_time_fine: Array
    settling_time_noise: Array
    overshoot: Array
    steady_state_error: Array


def step_ends(references: np.ndarray) -> np.ndarray:
    """Return the references (um) before and after each step of ``NAMES``, [4, 2].

    The large steps go from the 5 % quantile of the ``references`` to the 95 % quantile:
    the extremes may be short overshoots that no stage could hold.
    """
    low, high = np.quantile(references, [0.05, 0.95])
    middle, half = (low + high) / 2.0, SMALL * (high - low) / 2.0
    up = np.array([[middle - half, middle + half], [low, high]])
    return np.stack([up[0], up[0, ::-1], up[1], up[1, ::-1]])


def step_reference(ends: Array, samples: int) -> Array:
    """Return a reference that steps from ``ends[0]`` to ``ends[1]`` at sample 1."""
    return jnp.full(samples, ends[1]).at[0].set(ends[0])


def step_figures(
    loop: Feedback,
    ends: Float[Array, "steps 2"],
    samples: int,
    dt: float,
    noise: ScalarLike,
) -> StepFigures:
    """Return the figures [steps] of ``loop`` from rest, without noise; dt in s.

    ``noise`` is the rms noise of the sensor, um. Differentiable almost everywhere.
    """

    def one(pair: Array) -> StepFigures:
        inputs = loop_inputs(step_reference(pair, samples))
        log = simulate(loop, inputs, loop.init(pair[0]))[1]
        return figures_of(log.displacement, pair, dt, noise)

    return jax.vmap(one)(ends)


@jax.jit
def figures_of(
    displacement: Float[Array, " samples"],
    ends: Float[Array, " 2"],
    dt: ScalarLike,
    noise: ScalarLike,
) -> StepFigures:
    """Return the figures of a run with ``step_reference``; see ``step_figures``."""
    height = ends[1] - ends[0]
    # The reference steps at sample 1.
    found = (displacement[1:] - ends[0]) / height
    share = jnp.nan_to_num(found, nan=1e6, posinf=1e6, neginf=-1e6)
    error = share - 1.0
    last = max(1, round(LAST * error.size))
    band = jnp.maximum(noise / jnp.abs(height), 1e-12)
    return StepFigures(
        # Infinite and undefined samples of a diverging run do not count as a rise.
        dt * _rise(jnp.nan_to_num(found, nan=-1e6, posinf=-1e6, neginf=-1e6)),
        dt * _settled(error, BAND),
        dt * _settled(error, FINE),
        dt * _settled(error, band),
        jnp.maximum(jnp.max(error), 0.0),
        jnp.mean(jnp.abs(error[-last:])),
    )


def _rise(share: Float[Array, " samples"]) -> Array:
    """Return the time, in samples, from ``START`` to ``END``."""
    highest = jnp.max(share)
    # Longer than the run, and increasing with the distance of the peak from END.
    never = share.size * (1.0 + END - highest)
    rise = _reached(share, END) - _reached(share, START)
    return jnp.where(highest >= END, rise, never)


def _reached(share: Float[Array, " samples"], level: float) -> Array:
    """Return the time, in samples, at which ``share`` first reaches ``level``.

    The result is valid only if ``share`` reaches ``level``.
    """
    at = jnp.argmax(share >= level)
    here, before = share[at], jnp.where(at > 0, share[at - 1], 0.0)
    rises = here > before
    part = (here - level) / jnp.where(rises, here - before, 1.0)
    return at - jnp.where(rises, part, 0.0)


def _settled(error: Float[Array, " samples"], band: ScalarLike) -> Array:
    """Return the time, in samples, from which ``error`` stays within ``band``."""
    size = jnp.abs(error)
    outside = size > band
    last = error.size - 1 - jnp.argmax(outside[::-1])
    far, near = size[last], size[jnp.minimum(last + 1, error.size - 1)]
    falls = far > near
    place = last + (far - band) / jnp.where(falls, far - near, 1.0)
    never = error.size * (1.0 + jnp.log(jnp.maximum(far / band, 1.0)))
    settled = jnp.where(falls, place, never)
    return jnp.where(jnp.any(outside), settled, 0.0)
