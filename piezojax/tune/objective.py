"""What tuning minimises: normalised tracking errors over references and noise draws."""

import dataclasses
import math
from collections.abc import Callable, Mapping
from typing import Any, Literal, NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._types import as_array
from ..axes import PerAxisMetric
from ..metrics import Both, Extremes, Tracking, TrackingFigures
from ..rollout import Metric, simulate
from ..space import Space
from ..stability.impulse import sensitivities
from ..study import Stage
from ..system import Feedback, loop_inputs
from .constraints import Seen, augmented, needs, violations

T = TypeVar("T")

Aggregate = Literal["geometric_mean", "mean_square", "worst"]
Over = Literal["mean", "worst", "cvar"]

PENALTY = 10.0
"""First penalty on violated limits, on a scale where a factor e too much is 1."""

HOPELESS = 1e6
"""Objective of a run that diverged: finite, so that a line search can step back."""

RAILED = 0.9
"""A run whose actuator saturates for more than this share of it has lost its loop."""

_SHARPNESS = 20.0  # of the smooth maximum in "worst"
_FLOOR = 1e-9  # um: an error below a femtometre is as good as none


class Signals(eqx.Module):
    """References (um), unit-variance noise draws and disturbances (um) for a loop.

    With several axes all have a last dimension for them, in the unit of each.
    ``traces`` then are what is judged: pairs of a reference and an axis. ``holding`` is
    the input under which the loop's own plant rests at the begin of each reference,
    worked out if left out.
    """

    references: Float[Array, "references samples *axes"]
    noise: Float[Array, "references draws samples *axes"]
    disturbance: Float[Array, "references draws samples *axes"] | None = None
    traces: tuple[tuple[int, int], ...] = eqx.field(static=True, default=())
    holding: Float[Array, "*begins"] | None = None

    def for_another_plant(self) -> "Signals":
        """Return the same without ``holding``."""
        return dataclasses.replace(self, holding=None)


def evaluate(
    loop_of: Callable[[Any], Feedback],
    parameters: Any,
    signals: Signals,
    start: int,
    beside: Metric | None = None,
) -> Any:
    """Return the figures of ``loop_of(parameters)`` for each reference and noise draw.

    With several axes, for each trace and noise draw. Every run starts at rest at its
    reference; samples before ``start`` do not count. With ``beside``, another metric of
    the same runs, a pair of both figures.
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
    """Return what ``evaluate`` does, and one of ``every`` errors (um) of each run.

    The errors are those at samples counted, with time last; None unless ``every`` is
    above 1.
    """
    metric: Metric = Tracking(start=start)
    if beside is not None:
        metric = Both(metric, beside)
    if signals.references.ndim > 2:
        metric = PerAxisMetric(metric, signals.references.shape[2])

    def one(parameters, reference, noise, disturbance, holding):
        loop = loop_of(parameters)
        inputs = loop_inputs(reference, noise, disturbance)
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
    draws = jax.vmap(one, in_axes=(0, None, 0, 0, None))
    found = jax.vmap(draws)(
        copies,
        signals.references,
        signals.noise,
        signals.disturbance,
        signals.holding,
    )
    if not signals.traces:
        return found
    run, axis = (list(indices) for indices in zip(*signals.traces, strict=True))
    return jax.tree.map(lambda x: x[jnp.array(run), :, jnp.array(axis)], found)


class Verdict(NamedTuple):
    """What a point comes to: the objective, and by how much it violates what most."""

    loss: Float[Array, ""]
    violation: Float[Array, ""]


class Errors(NamedTuple):
    """A point as a problem of least squares.

    ``loss`` is what is minimised, ``errors`` of each run in um, ``added`` what the
    augmented Lagrangian adds. A weight is how much the loss rises with half the mean
    square of a run's error: with these weights, and 2 on what is added, they are
    residuals whose squares have the loss's gradient, as far as it depends on them.
    """

    loss: Float[Array, ""]
    verdict: Verdict
    errors: Float[Array, "runs samples"]
    added: Float[Array, " constraints"]
    weights: Float[Array, " runs"]


def _on_each(function: Callable[[Stage | None], T], stages: Stage | None) -> T:
    """Return ``function`` of each of the stacked ``stages``, or of None alone."""
    if stages is None:
        return jax.tree.map(lambda x: x[None], function(None))
    return eqx.filter_vmap(function)(stages)


class Objective(eqx.Module):
    """The objective over a Space.

    Each reference's RMS error, over its noise draws, is divided by ``scale`` (um), one
    for each stage and reference. ``aggregate`` joins them: ``geometric_mean`` (mean of
    logarithms: a tenfold gain counts the same on every reference), ``mean_square``, or
    ``worst`` (a smooth maximum of the logarithms). ``weights`` says how much each
    counts (alike if left out); what is ``resting``, an axis that should not move,
    counts only as far as its error exceeds its scale.

    ``stages``, stacked on a leading axis, take the place of the loop's own; ``over``
    joins them: their mean, the worst, or the mean of the worst ``tail`` of them.
    ``effort_weight`` and ``slew_weight`` add the mean RMS voltage and RMS voltage
    change a sample, both as a share of ``voltage_span``.

    ``limits`` are constraints by name (``constraints.CONSTRAINTS``), kept on every
    stage, margins on every one of ``margin_stages`` at the reference ``highest`` (um).
    ``multipliers`` and ``penalty``
    are those of the augmented Lagrangian that ``loss`` is.
    """

    loop: Feedback
    space: Space
    signals: Signals
    scale: Float[Array, "stages references"]
    voltage_span: Float[Array, ""]
    start: int = eqx.field(static=True)
    weights: Float[Array, " references"] | None = None
    stages: Stage | None = None
    margin_stages: Stage | None = None
    resting: tuple[bool, ...] = eqx.field(static=True, default=())
    aggregate: Aggregate = eqx.field(static=True, default="geometric_mean")
    over: Over = eqx.field(static=True, default="mean")
    tail: float = eqx.field(static=True, default=1.0)
    effort_weight: float = eqx.field(static=True, default=0.0)
    slew_weight: float = eqx.field(static=True, default=0.0)
    limits: dict[str, Array] = eqx.field(default_factory=dict)
    highest: Array | None = None
    dt: float = eqx.field(static=True, default=1.0)
    multipliers: Float[Array, " constraints"] = eqx.field(
        default_factory=lambda: jnp.zeros(0)
    )
    penalty: Float[Array, ""] = eqx.field(converter=as_array, default=PENALTY)

    @property
    def lanes(self) -> int:
        """Runs in one evaluation."""
        runs = self.signals.noise.shape[0] * self.signals.noise.shape[1]
        return runs * self.scale.shape[0]

    def with_multipliers(self, multipliers: Array) -> "Objective":
        """Return the objective with these multipliers of its limits."""
        return dataclasses.replace(self, multipliers=multipliers)

    def with_penalty(self, penalty: float) -> "Objective":
        """Return the objective with this penalty on violated limits."""
        return dataclasses.replace(self, penalty=penalty)

    def with_limits(self, limits: Mapping[str, float]) -> "Objective":
        """Return the objective with other limits of the same constraints."""
        arrays = {name: as_array(limit) for name, limit in limits.items()}
        return dataclasses.replace(self, limits=arrays)

    def seen(self, unit: Float[Array, " n"]) -> Seen:
        """Return what errors and constraints are read from.

        Figures of shape [stages, references, draws].
        """
        return self._sampled(unit)[0]

    def _sampled(
        self, unit: Float[Array, " n"], every: int = 1
    ) -> tuple[Seen, Array | None]:
        beside = Extremes() if needs(self.limits, "extremes") else None
        signals = self.signals
        if self.stages is not None:
            signals = signals.for_another_plant()

        def loop_of(unit, stage):
            loop = self.space.put(self.loop, unit)
            return loop if stage is None else stage.around(loop)

        def run(stage):
            return sampled(
                lambda unit: loop_of(unit, stage),
                unit,
                signals,
                self.start,
                beside,
                every,
            )

        def margins(stage):
            return sensitivities(loop_of(unit, stage), self.highest, self.dt)

        figures, errors = _on_each(run, self.stages)
        figures, extremes = figures if beside else (figures, None)
        known = needs(self.limits, "sensitivity")
        found = _on_each(margins, self.margin_stages) if known else None
        return Seen(figures, extremes, found, dt=self.dt), errors

    def _normalised(self, figures: TrackingFigures) -> Array:
        square = jnp.mean(figures.rms_error**2, axis=2)
        normalised = jnp.sqrt(square + _FLOOR**2) / self.scale
        if any(self.resting):
            # A smooth maximum with 1: no gain in stillness, a price for motion.
            above = jnp.logaddexp(0.0, _SHARPNESS * jnp.log(normalised)) / _SHARPNESS
            normalised = jnp.where(jnp.array(self.resting), jnp.exp(above), normalised)
        # Limits turn divergence into a limit cycle between them.
        railed = jnp.any(figures.saturated > RAILED)
        return jnp.where(railed, jnp.inf, normalised)

    def _prices(self, figures: TrackingFigures) -> tuple[tuple[float, Array], ...]:
        """Return weights and values of effort and slew."""
        return (
            (self.effort_weight, jnp.mean(figures.rms_effort) / self.voltage_span),
            (self.slew_weight, jnp.mean(figures.rms_slew) / self.voltage_span),
        )

    def _shares(self) -> Array:
        """Return how much each reference's error counts; the shares sum to 1."""
        count = self.scale.shape[1]
        weights = jnp.ones(count) if self.weights is None else self.weights
        return weights / jnp.sum(weights)

    def _error(self, figures: TrackingFigures) -> Array:
        """Return the errors, joined over references and then over stages."""
        normalised, shares = self._normalised(figures), self._shares()
        if self.aggregate == "mean_square":
            joined = jnp.sum(shares * normalised**2, axis=1)
        elif self.aggregate == "geometric_mean":
            joined = jnp.sum(shares * jnp.log(normalised), axis=1)
        else:
            logs = _SHARPNESS * jnp.log(normalised)
            each = jnp.broadcast_to(shares * shares.size, logs.shape)
            joined = jax.nn.logsumexp(logs, axis=1, b=each) / _SHARPNESS
        if self.over == "worst":
            return jnp.max(joined)
        if self.over == "cvar":
            worst = max(1, math.ceil(self.tail * joined.size))
            return jnp.mean(jnp.sort(joined)[-worst:])
        return jnp.mean(joined)

    def _judged(self, seen: Seen) -> tuple[Array, Array]:
        prices = [weight * value for weight, value in self._prices(seen.figures)]
        return self._error(seen.figures) + sum(prices), violations(self.limits, seen)

    def _added(self, violation: Array) -> Array:
        multipliers = self.multipliers
        if multipliers.size == 0:
            multipliers = jnp.zeros_like(violation)
        return augmented(violation, multipliers, self.penalty)

    def loss(self, unit: Float[Array, " n"]) -> Float[Array, ""]:
        """Return what is minimised; ``HOPELESS`` where the loop diverges or rails."""
        return self.both(unit)[0]

    def both(self, unit: Float[Array, " n"]) -> tuple[Float[Array, ""], Verdict]:
        """Return ``loss`` and ``verdict`` of one simulation."""
        return self._whole(self.seen(unit))[:2]

    def _whole(self, seen: Seen) -> tuple[Array, Verdict, Array]:
        """Return loss, verdict, and what the augmented Lagrangian adds."""
        total, violation = self._judged(seen)
        added = self._added(violation)
        loss, alone = (
            jnp.where(jnp.isfinite(x), x, HOPELESS)
            for x in (total + jnp.sum(added**2), total)
        )
        return loss, Verdict(alone, jnp.max(violation, initial=0.0)), added

    def errors(self, unit: Float[Array, " n"], every: int) -> Errors:
        """Return the objective and one of ``every`` errors of each run."""
        seen, errors = self._sampled(unit, every)
        assert errors is not None
        slope = jax.grad(lambda rms: self._error(seen.figures._replace(rms_error=rms)))(
            seen.figures.rms_error
        )
        weights = slope / jnp.maximum(seen.figures.rms_error, _FLOOR)
        loss, verdict, added = self._whole(seen)
        flat = errors.reshape(-1, errors.shape[-1])
        return Errors(loss, verdict, flat, added, weights.ravel())

    def verdict(self, unit: Float[Array, " n"]) -> Verdict:
        """Return the objective without constraints, and the worst violation."""
        return self.both(unit)[1]

    def violated(self, unit: Float[Array, " n"]) -> Float[Array, " constraints"]:
        """Return every violation, as ``constraints.violations``."""
        return self._judged(self.seen(unit))[1]

    def residuals(self, unit: Float[Array, " n"]) -> Float[Array, " residuals"]:
        """Return what least squares minimises: the squares sum to a mean-square loss.

        Raises ValueError for another aggregate.
        """
        if self.aggregate != "mean_square":
            raise ValueError(f"least squares cannot minimise {self.aggregate!r}")
        seen = self.seen(unit)
        normalised = self._normalised(seen.figures)
        shares = self._shares() / normalised.shape[0]
        parts = [(normalised * jnp.sqrt(shares)).ravel()]
        for weight, value in self._prices(seen.figures):
            if weight > 0.0:
                parts.append(jnp.sqrt(weight * value)[None])
        parts.append(self._added(violations(self.limits, seen)))
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
