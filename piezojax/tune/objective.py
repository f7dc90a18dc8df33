"""What tuning minimises: normalised tracking errors over references and noise draws."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..axes import PerAxisMetric
from ..metrics import Tracking, TrackingFigures
from ..rollout import Metric, simulate
from ..space import Space
from ..system import Feedback, System, loop_inputs

Aggregate = Literal["geometric_mean", "mean_square", "worst"]

HOPELESS = 1e6
"""Objective of a run that diverged: finite, so that a line search can step back."""

RAILED = 0.9
"""A run whose actuator saturates for more than this share of it has lost its loop."""

_SHARPNESS = 20.0  # of the smooth maximum in "worst"
_FLOOR = 1e-9  # um: an error below a femtometre is as good as none


class Signals(eqx.Module):
    """References (um), unit-variance noise draws and a disturbance (um) for a loop.

    With several axes references and noise have a last dimension for them, in the unit
    of each. ``traces`` then are what is judged: pairs of a reference and an axis.
    ``holding`` is the input under which the loop's own plant rests at the begin of each
    reference, worked out if left out.
    """

    references: Float[Array, "references samples *axes"]
    noise: Float[Array, "references draws samples *axes"]
    disturbance: Float[Array, " samples"] | None = None
    traces: tuple[tuple[int, int], ...] = eqx.field(static=True, default=())
    holding: Float[Array, "*begins"] | None = None

    def for_another_plant(self) -> "Signals":
        """Return the same without ``holding``."""
        return replace(self, holding=None)


def evaluate(
    loop_of: Callable[[Any], Feedback], parameters: Any, signals: Signals, start: int
) -> TrackingFigures:
    """Return the figures of ``loop_of(parameters)`` for each reference and noise draw.

    With several axes, for each trace and noise draw. Every run starts at rest at its
    reference; samples before ``start`` do not count.
    """
    return sampled(loop_of, parameters, signals, start)[0]


def sampled(
    loop_of: Callable[[Any], Feedback],
    parameters: Any,
    signals: Signals,
    start: int,
    every: int = 1,
) -> tuple[TrackingFigures, Array | None]:
    """Return what ``evaluate`` does, and one of ``every`` errors (um) of each run.

    The errors are those at samples counted, with time last; None unless ``every`` is
    above 1.
    """
    metric: Metric = Tracking(start=start)
    if signals.references.ndim > 2:
        metric = PerAxisMetric(metric, signals.references.shape[2])

    def one(parameters, reference, noise, holding):
        loop = loop_of(parameters)
        inputs = loop_inputs(reference, noise, signals.disturbance)
        state = loop.init(reference[0], holding)
        found = simulate(loop, inputs, state, metric=metric, every=every)[1]
        if every == 1:
            return found, None
        figures, log = found
        error = jax.tree.map(jnp.subtract, log.displacement, log.reference)
        counted = jax.tree.map(lambda x: x[start // every :], error)
        return figures, jnp.stack(counted) if isinstance(counted, tuple) else counted

    # A copy of the parameters for each run: their gradients are then summed once, at
    # the end, and not in each step.
    runs = signals.noise.shape[:2]
    copies = jax.tree.map(
        lambda x: jnp.broadcast_to(x, (*runs, *jnp.shape(x))), parameters
    )
    draws = jax.vmap(one, in_axes=(0, None, 0, None))
    found = jax.vmap(draws)(copies, signals.references, signals.noise, signals.holding)
    if not signals.traces:
        return found
    run, axis = (list(indices) for indices in zip(*signals.traces, strict=True))
    return jax.tree.map(lambda x: x[jnp.array(run), :, jnp.array(axis)], found)


def with_plant(loop: Feedback, plant: System) -> Feedback:
    """Return ``loop`` around another plant."""
    return Feedback(loop.controller, plant, loop.actuator, loop.sensor)


class Objective(eqx.Module):
    """The objective over a Space.

    Each reference's RMS error, over its noise draws, is divided by ``scale`` (um).
    ``aggregate`` joins them: ``geometric_mean`` (mean of logarithms: a tenfold gain
    counts the same on every reference), ``mean_square``, or ``worst`` (a smooth
    maximum of the logarithms). ``weights`` says how much each counts (alike if left
    out); what is ``resting``, an axis that should not move, counts only as far as its
    error exceeds its scale. ``plants``, stacked on a leading axis, take the place of
    the loop's own, each counting as much. ``effort_weight`` and ``slew_weight`` add the
    mean RMS voltage and RMS voltage change a sample, both as a share of
    ``voltage_span``.
    """

    loop: Feedback
    space: Space
    signals: Signals
    scale: Float[Array, " references"]
    voltage_span: Float[Array, ""]
    start: int = eqx.field(static=True)
    weights: Float[Array, " references"] | None = None
    plants: System | None = None
    resting: tuple[bool, ...] = eqx.field(static=True, default=())
    aggregate: Aggregate = eqx.field(static=True, default="geometric_mean")
    effort_weight: float = eqx.field(static=True, default=0.0)
    slew_weight: float = eqx.field(static=True, default=0.0)

    def _figures(self, unit: Float[Array, " n"]) -> TrackingFigures:
        """Return figures of shape [plants, references, draws]."""

        return self._sampled(unit, 1)[0]

    def _sampled(
        self, unit: Float[Array, " n"], every: int
    ) -> tuple[TrackingFigures, Array | None]:
        def loop_of(unit):
            return self.space.put(self.loop, unit)

        if self.plants is None:
            found = sampled(loop_of, unit, self.signals, self.start, every)
            return jax.tree.map(lambda x: x[None], found)
        return eqx.filter_vmap(
            lambda plant: sampled(
                lambda unit: with_plant(loop_of(unit), plant),
                unit,
                self.signals.for_another_plant(),
                self.start,
                every,
            )
        )(self.plants)

    def _parts(self, figures: TrackingFigures) -> tuple[Array, Array, Array]:
        square = jnp.mean(figures.rms_error**2, axis=2)
        normalised = jnp.sqrt(square + _FLOOR**2) / self.scale
        if any(self.resting):
            # A smooth maximum with 1: no gain in stillness, a price for motion.
            above = jnp.logaddexp(0.0, _SHARPNESS * jnp.log(normalised)) / _SHARPNESS
            normalised = jnp.where(jnp.array(self.resting), jnp.exp(above), normalised)
        # Limits turn divergence into a limit cycle between them.
        railed = jnp.any(figures.saturated > RAILED)
        normalised = jnp.where(railed, jnp.inf, normalised)
        effort = jnp.mean(figures.rms_effort) / self.voltage_span
        slew = jnp.mean(figures.rms_slew) / self.voltage_span
        return normalised, effort, slew

    def _shares(self, normalised: Array) -> Array:
        """Return how much each error counts; the shares sum to 1."""
        weights = jnp.ones_like(self.scale) if self.weights is None else self.weights
        weights = jnp.broadcast_to(weights, normalised.shape)
        return weights / jnp.sum(weights)

    def loss(self, unit: Float[Array, " n"]) -> Float[Array, ""]:
        """Return the objective; ``HOPELESS`` where the loop diverges or rails."""
        return self._joined(self._figures(unit))

    def errors(
        self, unit: Float[Array, " n"], every: int
    ) -> tuple[Array, Float[Array, "runs samples"], Float[Array, " runs"]]:
        """Return the objective, one of ``every`` errors of each run, and their weights.

        A weight is how much the objective rises with half the mean square of a run's
        error: weighted so, the errors are the residuals of a least-squares problem
        with the same gradient, as far as the objective depends on them.
        """
        figures, error = self._sampled(unit, every)
        assert error is not None
        loss, slope = jax.value_and_grad(
            lambda rms: self._joined(figures._replace(rms_error=rms))
        )(figures.rms_error)
        weights = slope / jnp.maximum(figures.rms_error, _FLOOR)
        return loss, error.reshape(-1, error.shape[-1]), weights.ravel()

    def _joined(self, figures: TrackingFigures) -> Float[Array, ""]:
        normalised, effort, slew = self._parts(figures)
        shares = self._shares(normalised)
        if self.aggregate == "mean_square":
            joined = jnp.sum(shares * normalised**2)
        elif self.aggregate == "geometric_mean":
            joined = jnp.sum(shares * jnp.log(normalised))
        else:
            logs = _SHARPNESS * jnp.log(normalised)
            each = shares * shares.size
            joined = jax.nn.logsumexp(logs, b=each) / _SHARPNESS
        total = joined + self.effort_weight * effort + self.slew_weight * slew
        return jnp.where(jnp.isfinite(total), total, HOPELESS)

    def residuals(self, unit: Float[Array, " n"]) -> Float[Array, " residuals"]:
        """Return what least squares minimises: the squares sum to a mean-square loss.

        Raises ValueError for another aggregate.
        """
        if self.aggregate != "mean_square":
            raise ValueError(f"least squares cannot minimise {self.aggregate!r}")
        normalised, effort, slew = self._parts(self._figures(unit))
        parts = [(normalised * jnp.sqrt(self._shares(normalised))).ravel()]
        for weight, value in ((self.effort_weight, effort), (self.slew_weight, slew)):
            if weight > 0.0:
                parts.append(jnp.sqrt(weight * value)[None])
        every = jnp.concatenate(parts)
        finite = jnp.all(jnp.isfinite(every))
        return jnp.where(finite, every, jnp.sqrt(HOPELESS / every.size))


@jax.custom_vjp
def _guarded(value: Array, gradient: Array, unit: Array) -> Array:
    return value


def _guarded_forward(value, gradient, unit):
    return value, gradient


def _guarded_backward(gradient, cotangent):
    return jnp.zeros_like(cotangent), jnp.zeros_like(gradient), cotangent * gradient


_guarded.defvjp(_guarded_forward, _guarded_backward)


def with_finite_gradient(loss, *, forward: bool):
    """Return ``loss`` of a vector with its gradient made finite and computed at once.

    The derivative of a diverged run is NaN and would spoil the optimiser's memory; it
    becomes zero. ``forward`` picks forward mode, which wins for few parameters and few
    lanes; reverse mode wins beyond.
    """

    def guarded(unit):
        fixed = jax.lax.stop_gradient(unit)
        if forward:
            # Not linearize: that would keep what every sample leaves behind.
            value, gradient = jax.vmap(
                lambda direction: jax.jvp(loss, (fixed,), (direction,)),
                out_axes=(None, 0),
            )(jnp.eye(fixed.shape[0]))
        else:
            value, gradient = jax.value_and_grad(loss)(fixed)
        usable = jnp.all(jnp.isfinite(gradient)) & (value < HOPELESS)
        gradient = jnp.where(usable, jnp.nan_to_num(gradient), 0.0)
        return _guarded(value, gradient, unit)

    return guarded
