"""What tuning minimises: normalised tracking errors over references and noise draws."""

from collections.abc import Callable
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..metrics import Tracking, TrackingFigures
from ..rollout import simulate
from ..space import Space
from ..system import Feedback, loop_inputs

Aggregate = Literal["geometric_mean", "mean_square", "worst"]

HOPELESS = 1e6
"""Objective of a run that diverged: finite, so that a line search can step back."""

RAILED = 0.9
"""A run whose actuator saturates for more than this share of it has lost its loop."""

_SHARPNESS = 20.0  # of the smooth maximum in "worst"
_FLOOR = 1e-9  # um: an error below a femtometre is as good as none


class Signals(eqx.Module):
    """References (um), unit-variance noise draws and a disturbance (um) for a loop."""

    references: Float[Array, "references samples"]
    noise: Float[Array, "references draws samples"]
    disturbance: Float[Array, " samples"] | None = None


def evaluate(
    loop_of: Callable[[Any], Feedback], parameters: Any, signals: Signals, start: int
) -> TrackingFigures:
    """Return the figures of ``loop_of(parameters)`` for each reference and noise draw.

    Every run starts at rest at its reference; samples before ``start`` do not count.
    """
    metric = Tracking(start=start)

    def one(parameters, reference, noise):
        loop = loop_of(parameters)
        inputs = loop_inputs(reference, noise, signals.disturbance)
        return simulate(loop, inputs, loop.init(reference[0]), metric=metric)[1]

    # A copy of the parameters for each run: their gradients are then summed once, at
    # the end, and not in each step.
    runs = signals.noise.shape[:2]
    copies = jax.tree.map(
        lambda x: jnp.broadcast_to(x, (*runs, *jnp.shape(x))), parameters
    )
    draws = jax.vmap(one, in_axes=(0, None, 0))
    return jax.vmap(draws)(copies, signals.references, signals.noise)


class Objective(eqx.Module):
    """The objective over a Space.

    Each reference's RMS error, over its noise draws, is divided by ``scale`` (um).
    ``aggregate`` joins them: ``geometric_mean`` (mean of logarithms: a tenfold gain
    counts the same on every reference), ``mean_square``, or ``worst`` (a smooth
    maximum of the logarithms). ``effort_weight`` and ``slew_weight`` add the mean RMS
    voltage and RMS voltage change a sample, both as a share of ``voltage_span`` (V).
    """

    loop: Feedback
    space: Space
    signals: Signals
    scale: Float[Array, " references"]
    voltage_span: Float[Array, ""]
    start: int = eqx.field(static=True)
    aggregate: Aggregate = eqx.field(static=True, default="geometric_mean")
    effort_weight: float = eqx.field(static=True, default=0.0)
    slew_weight: float = eqx.field(static=True, default=0.0)

    def _parts(self, unit: Float[Array, " n"]) -> tuple[Array, Array, Array]:
        figures = evaluate(
            lambda unit: self.space.put(self.loop, unit), unit, self.signals, self.start
        )
        square = jnp.mean(figures.rms_error**2, axis=1)
        normalised = jnp.sqrt(square + _FLOOR**2) / self.scale
        # Limits turn divergence into a limit cycle between them.
        railed = jnp.any(figures.saturated > RAILED)
        normalised = jnp.where(railed, jnp.inf, normalised)
        effort = jnp.mean(figures.rms_effort) / self.voltage_span
        slew = jnp.mean(figures.rms_slew) / self.voltage_span
        return normalised, effort, slew

    def loss(self, unit: Float[Array, " n"]) -> Float[Array, ""]:
        """Return the objective; ``HOPELESS`` where the loop diverges or rails."""
        normalised, effort, slew = self._parts(unit)
        if self.aggregate == "mean_square":
            joined = jnp.mean(normalised**2)
        elif self.aggregate == "geometric_mean":
            joined = jnp.mean(jnp.log(normalised))
        else:
            logs = _SHARPNESS * jnp.log(normalised)
            joined = jax.nn.logsumexp(logs) / _SHARPNESS
        total = joined + self.effort_weight * effort + self.slew_weight * slew
        return jnp.where(jnp.isfinite(total), total, HOPELESS)

    def residuals(self, unit: Float[Array, " n"]) -> Float[Array, " residuals"]:
        """Return what least squares minimises: the squares sum to a mean-square loss.

        Raises ValueError for another aggregate.
        """
        if self.aggregate != "mean_square":
            raise ValueError(f"least squares cannot minimise {self.aggregate!r}")
        normalised, effort, slew = self._parts(unit)
        parts = [normalised / jnp.sqrt(normalised.size)]
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
            value, push = jax.linearize(loss, fixed)
            gradient = jax.vmap(push)(jnp.eye(fixed.shape[0]))
        else:
            value, gradient = jax.value_and_grad(loss)(fixed)
        usable = jnp.all(jnp.isfinite(gradient)) & (value < HOPELESS)
        gradient = jnp.where(usable, jnp.nan_to_num(gradient), 0.0)
        return _guarded(value, gradient, unit)

    return guarded
