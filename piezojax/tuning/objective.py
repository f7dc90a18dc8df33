"""Objective of tuning: normalised tracking errors over references and noise draws."""

import dataclasses
import math
from collections.abc import Callable, Collection, Mapping
from typing import Literal, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..analysis.constraints import (
    constraint_count,
    uses,
    violations,
)
from ..analysis.loop_figures import LoopFigures, MarginFigures, margin_figures
from ..analysis.stability.operating_point import OperatingPoint
from ..analysis.step_response import StepFigures, step_figures
from ..core.arrays import as_array, largest
from ..core.feedback import Feedback
from ..core.metrics import Extremes, TrackingFigures
from ..core.rollout import BLOCK, in_blocks
from ..core.space import Space
from ..solve.augmented_lagrangian import PENALTY, penalty_terms, signed_terms
from ..solve.problem import FAILED_LOSS, Errors, Verdict
from ..study import Stage
from .runs import Signals, sampled

T = TypeVar("T")

Aggregate = Literal["geometric_mean", "mean_square", "worst"]
Over = Literal["mean", "worst", "cvar"]

RAILED = 0.9
"""Share of saturated samples above which a run counts as staying at a voltage limit."""

MARGIN_BLOCK = BLOCK // 2
"""Plants whose margins are computed at once; each has two branches."""

_SHARPNESS = 20.0  # of the smooth maximum in "worst"
_FLOOR = 1e-9  # um: errors below a femtometre count as equal


def _count(stages: Stage | None) -> int:
    """Return the number of stacked ``stages``, 1 for None."""
    return 1 if stages is None else jax.tree.leaves(stages)[0].shape[0]


def _on_each(
    function: Callable[[Stage | None], T], stages: Stage | None, size: int | None = None
) -> T:
    """Return ``function`` of each of the stacked ``stages``, or of None, stacked.

    ``size`` of them are evaluated at a time, by default all.
    """
    if stages is None:
        return jax.tree.map(lambda x: x[None], function(None))
    dynamic, static = eqx.partition(stages, eqx.is_array)
    return in_blocks(
        lambda part: function(eqx.combine(part, static)),
        dynamic,
        size=size or len(jax.tree.leaves(dynamic)[0]),
    )


def margins_on(
    limits: Collection[str],
    loop_of: Callable[[Stage | None], Feedback],
    stages: Stage | None,
    point: OperatingPoint,
    model_error: Float[Array, " lines"] | None,
    duration: float | None = None,
) -> MarginFigures:
    """Return the margins [plants, branches] among ``limits`` on each of ``stages``.

    ``loop_of(stage)`` is the loop on a stage, ``model_error`` bounds the relative error
    of its plant. ``duration`` (s) is that of ``sensitivity``.
    """

    def one(stage: Stage | None) -> MarginFigures:
        return margin_figures(limits, loop_of(stage), point, model_error, duration)

    # With several axes a whole batch of matrices would not fit into memory.
    one_axis = jnp.ndim(point.reference) == 0
    return _on_each(one, stages, MARGIN_BLOCK if one_axis else 1)


class StepTest(eqx.Module):
    """Steps of the reference from rest: ``ends``, and rms ``noise`` of the sensor.

    Both are in um. A run has ``samples`` samples with the sample time ``dt`` (s).
    """

    ends: Float[Array, "steps 2"]
    noise: Float[Array, ""]
    samples: int = eqx.field(static=True)
    dt: float = eqx.field(static=True)

    def figures(self, loop: Feedback) -> StepFigures:
        """Return the figures [steps] of ``loop``."""
        return step_figures(loop, self.ends, self.samples, self.dt, self.noise)

    def figures_on(
        self, loop_of: Callable[[Stage | None], Feedback], stages: Stage | None
    ) -> StepFigures:
        """Return the figures [plants, steps] on each of ``stages``."""
        return _on_each(lambda stage: self.figures(loop_of(stage)), stages)


class Objective(eqx.Module):
    """Objective of tuning over a Space.

    The RMS error of each reference over its noise draws is divided by ``scale`` (um),
    which has one value for each stage and reference. ``aggregate`` joins the
    references: ``geometric_mean`` (mean of logarithms: a tenfold improvement counts the
    same on every reference), ``mean_square``, or ``worst`` (a smooth maximum of the
    logarithms). ``weights`` are those of the references (equal if left out). A
    ``resting`` trace is that of an axis that should not move; only the part of its
    error above the scale counts.

    ``stages``, stacked on a leading axis, replace the loop's own. ``over`` joins them:
    their mean, the worst, or the mean over the worst share ``tail``. The mean RMS
    voltage, weighted by ``effort_weight``, and the mean RMS change of voltage per
    sample, weighted by ``slew_weight``, are added to the error, both as shares of
    ``voltage_span``.

    ``limits`` are the limits of constraints by name (``constraints.CONSTRAINTS``). They
    must hold on every stage; limits on margins must hold on every one of
    ``margin_stages``, at ``margin_reference`` (um), from impulse responses of
    ``margin_duration`` (s). The limits on Ms and the delay margin must also hold for
    all plants within the relative error ``model_error`` [lines] of these stages.
    ``step_test`` evaluates the limits on steps, None on several axes. ``loss`` is an
    augmented Lagrangian with ``multipliers`` and ``penalty``.
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
    model_error: Float[Array, " lines"] | None = None
    resting: tuple[bool, ...] = eqx.field(static=True, default=())
    aggregate: Aggregate = eqx.field(static=True, default="geometric_mean")
    over: Over = eqx.field(static=True, default="mean")
    tail: float = eqx.field(static=True, default=1.0)
    effort_weight: float = eqx.field(static=True, default=0.0)
    slew_weight: float = eqx.field(static=True, default=0.0)
    limits: dict[str, Array] = eqx.field(default_factory=dict)
    margin_reference: Array | None = None
    margin_duration: float | None = eqx.field(static=True, default=None)
    step_test: StepTest | None = None
    dt: float = eqx.field(static=True, default=1.0)
    multipliers: Float[Array, " constraints"] = eqx.field(
        default_factory=lambda: jnp.zeros(0)
    )
    penalty: Float[Array, ""] = eqx.field(converter=as_array, default=PENALTY)

    @property
    def lanes(self) -> int:
        """Number of runs in one evaluation."""
        runs = self.signals.noise.shape[0] * self.signals.noise.shape[1]
        return runs * self.scale.shape[0]

    @property
    def constraints(self) -> int:
        """Number of constraints: one for every limit, plant and step or branch."""
        return constraint_count(
            self.limits, self.scale.shape[0], _count(self.margin_stages)
        )

    def with_multipliers(self, multipliers: Array) -> "Objective":
        """Return the objective with these multipliers of its limits."""
        return dataclasses.replace(self, multipliers=multipliers)

    def with_penalty(self, penalty: float) -> "Objective":
        """Return the objective with this penalty on violated limits."""
        return dataclasses.replace(self, penalty=penalty)

    def on_margin_stages(self, stages: Stage | None) -> "Objective":
        """Return the objective with margins limited on ``stages``, if any."""
        return (
            self if stages is None else dataclasses.replace(self, margin_stages=stages)
        )

    def with_limits(self, limits: Mapping[str, float]) -> "Objective":
        """Return the objective with ``limits``, by name of their constraint."""
        arrays = {name: as_array(limit) for name, limit in limits.items()}
        return dataclasses.replace(self, limits=arrays)

    def figures(self, unit: Float[Array, " n"]) -> LoopFigures:
        """Return the figures [stages, references, draws] of the loop at ``unit``."""
        return _figures(self, unit)

    def _sampled(
        self, unit: Float[Array, " n"], every: int = 1
    ) -> tuple[LoopFigures, Array | None]:
        beside = Extremes(self.start) if uses(self.limits, "extremes") else None

        def loop_of(unit, stage):
            loop = self.space.put(self.loop, unit)
            return loop if stage is None else stage.around(loop)

        def run(stage):
            return sampled(
                lambda unit: loop_of(unit, stage),
                unit,
                self.signals.on(stage),
                self.start,
                beside,
                every,
            )

        figures, errors = _on_each(run, self.stages)
        figures, extremes = figures if beside else (figures, None)
        margins = None
        if uses(self.limits, "margins"):
            margins = margins_on(
                self.limits,
                lambda stage: loop_of(unit, stage),
                self.margin_stages,
                OperatingPoint(self.margin_reference, dt=self.dt),
                self.model_error,
                self.margin_duration,
            )
        steps = None
        if self.step_test is not None and uses(self.limits, "steps"):
            steps = self.step_test.figures_on(
                lambda stage: loop_of(unit, stage), self.stages
            )
        return LoopFigures(figures, extremes, margins, steps, dt=self.dt), errors

    def _normalised(self, figures: TrackingFigures) -> Array:
        square = jnp.mean(figures.rms_error**2, axis=2)
        normalised = jnp.sqrt(square + _FLOOR**2) / self.scale
        if any(self.resting):
            # A smooth maximum with 1: only errors above the scale count.
            above = jnp.logaddexp(0.0, _SHARPNESS * jnp.log(normalised)) / _SHARPNESS
            normalised = jnp.where(jnp.array(self.resting), jnp.exp(above), normalised)
        # Voltage limits turn divergence into a limit cycle between them.
        railed = jnp.any(figures.saturated > RAILED)
        return jnp.where(railed, jnp.inf, normalised)

    def _prices(self, figures: TrackingFigures) -> tuple[tuple[float, Array], ...]:
        """Return weights and values of effort and slew."""
        return (
            (self.effort_weight, jnp.mean(figures.rms_effort) / self.voltage_span),
            (self.slew_weight, jnp.mean(figures.rms_slew) / self.voltage_span),
        )

    def _shares(self) -> Array:
        """Return the weights of the references, normalised to sum to 1."""
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
            return largest(joined)
        if self.over == "cvar":
            worst = max(1, math.ceil(self.tail * joined.size))
            return jnp.mean(jnp.sort(joined)[-worst:])
        return jnp.mean(joined)

    def _error_and_violations(self, loop: LoopFigures) -> tuple[Array, Array]:
        prices = [weight * value for weight, value in self._prices(loop.tracking)]
        return self._error(loop.tracking) + sum(prices), violations(self.limits, loop)

    def _terms(self, of: Callable[..., Array], violation: Array) -> Array:
        """Return ``signed_terms`` or ``penalty_terms`` with the multipliers, if any."""
        multipliers = self.multipliers
        if multipliers.size == 0:
            multipliers = jnp.zeros_like(violation)
        return of(violation, multipliers, self.penalty)

    def loss(self, unit: Float[Array, " n"]) -> Float[Array, ""]:
        """Return the loss; ``FAILED_LOSS`` if a run diverges or stays at a limit."""
        return self.value_and_verdict(unit)[0]

    def value_and_verdict(
        self, unit: Float[Array, " n"]
    ) -> tuple[Float[Array, ""], Verdict]:
        """Return ``loss`` and the Verdict from the same simulation."""
        return self._evaluate(self.figures(unit))[:2]

    def _evaluate(self, figures: LoopFigures) -> tuple[Array, Verdict, Array]:
        """Return the loss, the verdict, and the ``signed_terms``."""
        total, violation = self._error_and_violations(figures)
        penalty = jnp.sum(self._terms(penalty_terms, violation) ** 2)
        loss, alone = (
            jnp.where(jnp.isfinite(x), x, FAILED_LOSS) for x in (total + penalty, total)
        )
        return loss, Verdict(alone, violation), self._terms(signed_terms, violation)

    def errors(self, unit: Float[Array, " n"], every: int) -> Errors:
        """Return the loss, its terms, and every ``every``-th error of each run."""
        loop, errors = self._sampled(unit, every)
        assert errors is not None
        tracking = loop.tracking
        slope = jax.grad(lambda rms: self._error(tracking._replace(rms_error=rms)))(
            tracking.rms_error
        )
        weights = slope / jnp.maximum(tracking.rms_error, _FLOOR)
        loss, verdict, added = self._evaluate(loop)
        flat = errors.reshape(-1, errors.shape[-1])
        return Errors(loss, verdict, flat, added, weights.ravel())

    def residuals(self, unit: Float[Array, " n"]) -> Float[Array, " residuals"]:
        """Return residuals whose squares sum to the loss.

        Raises ValueError unless the aggregate is ``mean_square``.
        """
        if self.aggregate != "mean_square":
            raise ValueError(f"least squares cannot minimise {self.aggregate!r}")
        loop = self.figures(unit)
        normalised = self._normalised(loop.tracking)
        shares = self._shares() / normalised.shape[0]
        parts = [(normalised * jnp.sqrt(shares)).ravel()]
        for weight, value in self._prices(loop.tracking):
            if weight > 0.0:
                parts.append(jnp.sqrt(weight * value)[None])
        parts.append(self._terms(penalty_terms, violations(self.limits, loop)))
        every = jnp.concatenate(parts)
        finite = jnp.all(jnp.isfinite(every))
        return jnp.where(finite, every, jnp.sqrt(FAILED_LOSS / every.size))


@jax.jit
def _figures(objective: Objective, unit: Float[Array, " n"]) -> LoopFigures:
    # One trace serves loss, verdict and gradient in every program of a search.
    return objective._sampled(unit)[0]
