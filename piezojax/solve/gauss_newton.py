"""Damped Gauss-Newton: the quadratic model, its damped step and the trust region.

``descent`` runs it from Python, with several dampings at once and bounds as active
sets. ``damped_gauss_newton`` runs it in a compiled program, with many starts by
``jax.vmap``.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..core.arrays import as_array
from ..core.space import squash, unsquash
from .optimisers import Carry, Optimiser, View, frozen_when_done, settled

EDGE = 1e-9
"""Distance from a bound, as a share of the unit box, that counts as on it."""


class Quadratic(NamedTuple):
    """Gauss-Newton model of half a sum of squares: ``gradient`` J'r, ``curvature`` J'J.

    ``metric`` [n] weights the damping of each unknown; 1 damps all equally.
    """

    gradient: Any
    curvature: Any
    metric: Any = 1.0


class TrustRegion(NamedTuple):
    """Rule that accepts steps and adapts the damping by the predicted decrease.

    A step is taken if it achieves the share ``taken`` of the predicted decrease, else
    the damping grows by the factor ``grow``; it shrinks by ``shrink`` after a step that
    achieves the share ``good``. The constants are those of optimistix (Gould et al.
    2005, 4OR 3).
    """

    taken: float = 0.01
    good: float = 0.99
    grow: float = 4.0
    shrink: float = 3.5


class _Trial(NamedTuple):
    """Next point to try, model at the present point, and damping."""

    point: Array
    model: Quadratic
    damping: Array
    predicted: Array  # change of half the sum of squares at `point`


def damped_gauss_newton(
    linearise: Callable[[Array], tuple[Array, Array]],
    tolerance: float,
    rule: TrustRegion | None = None,
    *,
    bounded: bool = True,
) -> Optimiser:
    """Return Levenberg-Marquardt with a trust-region rule as an Optimiser.

    ``linearise(unit)`` returns Jacobian [residuals, n] and residuals
    (``problem.linearised``); it is evaluated once per step, and only J'J and J'r are
    stored, which suits long residuals of few unknowns. With the default ``rule`` the
    steps are those of optimistix, but compile in a third of the time. A ``bounded``
    problem has the domain [0, 1]^n and is searched through a sigmoid; any other problem
    is searched on the whole space.
    """
    rule = rule or TrustRegion()

    def evaluated(free):
        unit = squash(free) if bounded else free
        jacobian, value = linearise(unit)
        slope = unit * (1.0 - unit) if bounded else jnp.ones_like(free)
        gradient = slope * (jacobian.T @ value)
        curvature = jnp.outer(slope, slope) * (jacobian.T @ jacobian)
        return Quadratic(gradient, curvature, jnp.ones(())), jnp.sum(value**2)

    def start(unit):
        free = unsquash(unit) if bounded else unit
        curvature, one = jnp.zeros((free.size, free.size)), jnp.ones(())
        blank = Quadratic(jnp.zeros_like(free), curvature, one)
        first = _Trial(free, blank, one, jnp.zeros(()))
        return settled(Carry(free, first, as_array(jnp.inf), jnp.asarray(False)))

    def step(carry):
        old, point = carry.state, carry.point
        model, loss = evaluated(old.point)
        first = jnp.isinf(carry.loss)
        change = 0.5 * (loss - carry.loss)
        accept = first | (change <= rule.taken * old.predicted)
        good = accept & ~first & (change < rule.good * old.predicted)
        good = good & (old.predicted < 0.0)
        factor = jnp.where(good, 1.0 / rule.shrink, jnp.where(accept, 1.0, rule.grow))
        damping = old.damping * factor
        model = jax.tree.map(lambda n, o: jnp.where(accept, n, o), model, old.model)
        reached = jnp.where(accept, old.point, point)
        near = jnp.abs(old.point - point) < tolerance * (1.0 + jnp.abs(point))
        level = jnp.abs(change) < tolerance * (1.0 + 0.5 * carry.loss)
        done = accept & ~first & jnp.all(near) & level
        # Without a finite slope no further step exists.
        done = done | ~jnp.all(jnp.isfinite(model.curvature))
        move = _damped_step(model, damping)
        predicted = model.gradient @ move + 0.5 * move @ model.curvature @ move
        state = _Trial(reached + move, model, damping, predicted)
        kept = jnp.where(accept, loss, carry.loss)
        return frozen_when_done(carry, Carry(reached, state, kept, carry.done | done))

    def view(carry):
        unit = squash(carry.point) if bounded else carry.point
        return View(unit, carry.loss, carry.done)

    return Optimiser(start, step, view)


def _damped_step(model: Quadratic, damping: Array) -> Array:
    """Return the damped step; 0 where it is not finite."""
    # The floor keeps the matrix regular if a direction has no slope.
    floor = 1e-14 * jnp.max(jnp.diagonal(model.curvature))
    damping = jnp.maximum(jnp.maximum(damping, floor), 1e-300)
    damping = damping * model.metric * jnp.eye(model.gradient.size)
    move = -jax.scipy.linalg.cho_solve(
        jax.scipy.linalg.cho_factor(model.curvature + damping), model.gradient
    )
    return jnp.where(jnp.all(jnp.isfinite(move)), move, 0.0)


def boxed_step(
    model: Quadratic,
    point: Float[np.ndarray, " n"],
    damping: float,
    box: tuple[float, float] = (0.0, 1.0),
) -> Float[np.ndarray, " n"]:
    """Return the damped Gauss-Newton step from ``point`` within the box.

    An unknown that would leave the box stops at its bound, and the others are solved
    for again.
    """
    gradient, curvature = model.gradient, model.curvature
    lower, upper = box
    low, high = point <= lower + EDGE, point >= upper - EDGE
    free = ~((low & (gradient > 0.0)) | (high & (gradient < 0.0)))
    step = np.zeros_like(point)
    for _ in range(point.size):
        force = -(gradient + curvature @ np.where(free, 0.0, step))
        step[free] = damped_solution(model, force, damping, free)
        outside = free & ((point + step < lower) | (point + step > upper))
        if not outside.any():
            break
        step = np.where(outside, np.clip(point + step, lower, upper) - point, step)
        free &= ~outside
    return step


def damped_solution(
    model: Quadratic, force: np.ndarray, damping: float, free: np.ndarray
) -> np.ndarray:
    """Return the solution of the damped normal equations for the unknowns ``free``.

    The unknowns are scaled by the root of the metric, so that the damping is a multiple
    of the unit matrix.
    """
    scale = np.sqrt(np.broadcast_to(model.metric, force.shape))[free]
    curvature = model.curvature[np.ix_(free, free)] / np.outer(scale, scale)
    damped = curvature + damping * np.eye(scale.size)
    return np.linalg.solve(damped, force[free] / scale) / scale
