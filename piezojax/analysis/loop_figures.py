"""Figures of a loop from which constraints are evaluated."""

from collections.abc import Callable, Collection
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..core.arrays import smallest
from ..core.feedback import Feedback
from ..core.metrics import ExtremeFigures, TrackingFigures
from .stability.model_error import worst_delay_margin, worst_sensitivity
from .stability.operating_point import OperatingPoint
from .stability.sampled_margins import (
    bandwidth_of,
    closed_loop_peak_of,
    delay_margin_of,
    disk_margin_of,
    gain_margin_of,
    largest_by_band,
    peaks_of,
    phase_margin_of,
)
from .stability.small_motion import Sensitivity, references_followed, sensitivities
from .step_response import StepFigures

MarginFigures = dict[str, Float[Array, "..."]]
"""Margins of a loop by constraint, [plants, branches]; the sensitivity peaks are
[plants, branches, bands]."""


class LoopFigures(NamedTuple):
    """Figures of a loop from which constraints are evaluated.

    ``tracking`` and ``extremes`` hold arrays [plants, references, draws], ``steps``
    arrays [plants, steps]. ``margins`` are those of ``margin_figures``. ``extremes``,
    ``margins`` and ``steps`` are None unless a limit needs them. ``dt`` in s.
    ``stable`` [plants] tells whether the loop is stable for small motions, None if that
    was not asked for.
    """

    tracking: TrackingFigures
    extremes: ExtremeFigures | None
    margins: MarginFigures | None
    steps: StepFigures | None
    dt: float
    stable: Any = None


def _peaks(sensitivity: Sensitivity, error: Array | None) -> Array:
    """Return the largest |S| [bands] over the plants within ``error`` of the model."""
    if error is None:
        return peaks_of(sensitivity)
    return largest_by_band(worst_sensitivity(sensitivity[:, 0, 0], error))


def _delay(sensitivity: Sensitivity, error: Array | None) -> Array:
    """Return the least delay margin over the plants within ``error`` of the model."""
    nominal = delay_margin_of(sensitivity)
    if error is None:
        return nominal
    angle = jnp.linspace(0.0, jnp.pi, error.size)
    worst = worst_delay_margin(sensitivity[:, 0, 0], error, angle)
    return jnp.minimum(nominal, smallest(worst))


def _disk(sensitivity: Sensitivity, error: Array | None) -> Array:
    """Return the disk margin of the model, itself a margin against model errors."""
    del error
    return disk_margin_of(sensitivity)


def _gain(sensitivity: Sensitivity, error: Array | None) -> Array:
    """Return the gain margin of the model."""
    del error
    return gain_margin_of(sensitivity)


def _phase(sensitivity: Sensitivity, error: Array | None) -> Array:
    """Return the phase margin of the model."""
    del error
    return phase_margin_of(sensitivity)


_MARGINS: dict[str, Callable[[Sensitivity, Array | None], Array]] = {
    "sensitivity_peak": _peaks,
    "disk_margin": _disk,
    "delay_margin": _delay,
    "gain_margin": _gain,
    "phase_margin": _phase,
}

_FOLLOWING: dict[str, Callable[[Array, float], Array]] = {
    "bandwidth": bandwidth_of,
    "closed_loop_peak": lambda followed, dt: closed_loop_peak_of(followed),
}


def margin_figures(
    names: Collection[str],
    loop: Feedback,
    point: OperatingPoint,
    error: Float[Array, " lines"] | None,
    duration: float | None = None,
) -> MarginFigures:
    """Return the figures [branches] of those ``names`` that are margins.

    The loop is linearised at ``point``. The sensitivity peaks are those of
    ``peaks_of``, [branches, bands]. ``error`` is the bound on the relative model error
    of a plant of one axis; it is None if no bound is known. ``duration`` (s) is that of
    ``sensitivity``.
    """
    found: MarginFigures = {}
    if not _MARGINS.keys().isdisjoint(names):
        S = sensitivities(loop, point, duration)
        found |= {
            name: jax.vmap(lambda one, of=of: of(one, error))(S)
            for name, of in _MARGINS.items()
            if name in names
        }
    if not _FOLLOWING.keys().isdisjoint(names):
        followed = references_followed(loop, point, duration)
        dt = point.sample_time(loop)
        found |= {
            name: jax.vmap(lambda one, of=of: of(one, dt))(followed)
            for name, of in _FOLLOWING.items()
            if name in names
        }
    return found
