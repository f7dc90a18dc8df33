"""Runs of a loop: their input signals and their figures, computed in one batch."""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..core.axes import PerAxisMetric
from ..core.feedback import Feedback, loop_inputs
from ..core.limited import Sample, Watched
from ..core.metrics import MetricPair, Tracking
from ..core.rollout import Metric
from ..core.system import resolve
from ..engines import metered
from ..study import Stage


class RunNoise(NamedTuple):
    """Noise and disturbances of runs; each run has its own.

    ``noise`` holds draws of unit variance, ``disturbance`` is added to the displacement
    (um), ``input_disturbance`` to the voltage (V), each [*runs, samples, *axes].
    """

    noise: Float[Array, "..."]
    disturbance: Float[Array, "..."] | None
    input_disturbance: Float[Array, "..."] | None

    def of(self, *run: int | slice) -> "RunNoise":
        """Return the noise and disturbances of one run, or of a slice of runs."""
        return jax.tree.map(lambda x: x[run], self)

    def undisturbed(self) -> "RunNoise":
        """Return the same noise with disturbances of 0."""
        quiet = jax.tree.map(jnp.zeros_like, self)
        return quiet._replace(noise=self.noise)


class Signals(eqx.Module):
    """References (um), unit-variance noise draws and disturbances for a loop.

    With several axes, each array has a last dimension for them, in the unit of each
    axis, and ``traces`` are the evaluated pairs of a reference and an axis.
    ``holding`` is the input under which the loop's own plant rests at the beginning of
    each reference; None leaves it to ``Feedback.init``.
    """

    references: Float[Array, "references samples *axes"]
    noise: Float[Array, "references draws samples *axes"]
    disturbance: Float[Array, "references draws samples *axes"] | None = None
    input_disturbance: Float[Array, "references draws samples *axes"] | None = None
    traces: tuple[tuple[int, int], ...] = eqx.field(static=True, default=())
    holding: Float[Array, "*begins"] | None = None

    @property
    def run_noise(self) -> RunNoise:
        """Noise and disturbances by reference and draw."""
        return RunNoise(self.noise, self.disturbance, self.input_disturbance)

    @property
    def begins(self) -> Array:
        """First samples [references, *axes], at which every run starts at rest."""
        return self.references[:, 0]

    def on(self, stage: Stage | None) -> "Signals":
        """Return the signals with the holding inputs of ``stage``, if any."""
        if stage is None:
            return self
        return dataclasses.replace(self, holding=stage.holding)


def _error(sample: Sample) -> Any:
    return jax.tree.map(jnp.subtract, sample.displacement, sample.reference)


def evaluate(
    loop_of: Callable[[Any], Feedback],
    parameters: Any,
    signals: Signals,
    start: int,
    beside: Metric | None = None,
) -> Any:
    """Return the figures of ``loop_of(parameters)`` for each reference and noise draw.

    With several axes there are figures for each trace and noise draw. Every run starts
    at rest at its reference; samples before ``start`` do not count. ``beside`` is
    another metric of the same runs; with it, the result is the pair of both figures.
    """
    return sampled(loop_of, parameters, signals, start, beside)[0]


def sampled(
    loop_of: Callable[[Any], Feedback],
    parameters: Any,
    signals: Signals,
    start: int,
    beside: Metric | None = None,
    every: int = 1,
) -> tuple[Any, Array | None]:
    """Return the figures of ``evaluate``, and every ``every``-th error (um) of a run.

    The errors are those of the samples from ``start`` on, with time on the last axis;
    None unless ``every`` is above 1.
    """
    metric: Metric = Tracking(start=start)
    if beside is not None:
        metric = MetricPair(metric, beside)
    if signals.references.ndim > 2:
        metric = PerAxisMetric(metric, signals.references.shape[2])

    def one(parameters, reference, run_noise, holding):
        loop = resolve(loop_of(parameters))  # once for the start and the run
        inputs = loop_inputs(reference, *run_noise)
        state = loop.init(reference[0], holding)
        logged = _error if every > 1 else None
        watched = Watched(loop)
        figures, log = metered(watched, inputs, state, metric, log=logged, every=every)
        if log is None:
            return figures, None
        counted = jax.tree.map(lambda x: x[start // every :], log)
        return figures, jnp.stack(counted) if isinstance(counted, tuple) else counted

    # Each run has a copy of the parameters: their gradients are summed once, after the
    # run, and not at each sample.
    runs = signals.noise.shape[:2]
    copies = jax.tree.map(
        lambda x: jnp.broadcast_to(x, (*runs, *jnp.shape(x))), parameters
    )
    draws = jax.vmap(one, in_axes=(0, None, 0, None))
    found = jax.vmap(draws)(
        copies,
        signals.references,
        signals.run_noise,
        signals.holding,
    )
    if not signals.traces:
        return found
    run, axis = (list(indices) for indices in zip(*signals.traces, strict=True))
    return jax.tree.map(lambda x: x[jnp.array(run), :, jnp.array(axis)], found)
