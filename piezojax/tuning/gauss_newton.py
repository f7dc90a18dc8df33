"""Gauss and Newton's method on the errors themselves, several dampings at once.

The objective of a loop is a long narrow valley, bent: gradients zigzag in it. What is
summed up in it are squared errors, so their derivatives give its curvature too. A step
along the valley leaves its floor where that bends away; the errors there, seen through
the same derivatives, lead back (a simplified Newton method: Deuflhard, Newton Methods
for Nonlinear Problems, 2004).
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .objective import HOPELESS, Verdict

LANES = 4
"""Points simulated at once: dampings tried at each step."""

DAMPINGS = 10.0 ** np.linspace(-1.8, 0.9, LANES)
"""Their dampings, as multiples of the last that was best."""

FIRST_DAMPING, LAST_DAMPING = 1.0, 1e8
"""On the unit box, where a loop's curvature is 1 to 1e6."""

CORRECTIONS = 2
"""How often a step is led back with the derivatives of the point it came from."""

MOST = 0.5
"""A correction that is a larger share of its step is not trusted."""

RUNS = 1 + LANES * (1 + CORRECTIONS)
"""How often a step simulates all references, once with derivatives."""

SAMPLES = 20_000
"""Errors that the curvature is taken from, about, over all runs."""

SHORTEST = 5
"""Least distance of two of them, samples."""

PATIENCE = 5
"""A descent ends when it gained less than its tolerance in so many steps."""

_ADDED = np.sqrt(2.0)  # a square of the Lagrangian counts whole, not half
_EDGE = 1e-9  # of the unit box


class Lanes(NamedTuple):
    """Losses of some points, and what is squared in them: a sample of the errors of
    their runs, and what the augmented Lagrangian adds.
    """

    losses: Float[Array, " lanes"]
    verdicts: Verdict
    errors: Float[Array, "lanes runs samples"]
    added: Float[Array, "lanes constraints"]


class Slopes(NamedTuple):
    """Loss and weights of the errors at a point, and derivatives of the loss, of the
    errors, and of what the augmented Lagrangian adds.
    """

    loss: Float[Array, ""]
    weights: Float[Array, " runs"]
    gradient: Float[Array, " n"]
    jacobian: Float[Array, "n runs samples"]
    added: Float[Array, "n constraints"]


def lanes_of(objective, units: Float[Array, "lanes n"], every: int) -> Lanes:
    """Return what is simulated at each of ``units``."""
    return Lanes(*jax.vmap(lambda unit: objective.errors(unit, every)[:4])(units))


def slopes_of(objective, unit: Float[Array, " n"], every: int) -> Slopes:
    """Return value and derivatives at ``unit``, all in one forward pass."""

    def values(unit):
        found = objective.errors(unit, every)
        return (found.loss, found.errors, found.added), found.weights

    (loss, *_), (gradient, jacobian, added), weights = jax.vmap(
        lambda direction: jax.jvp(values, (unit,), (direction,), has_aux=True),
        out_axes=(None, 0, None),
    )(jnp.eye(unit.shape[0]))
    return Slopes(loss, weights, gradient, jacobian, added)


def spacing(runs: int, counted: int) -> int:
    """Return every how many samples an error is taken: a prime, against aliasing."""
    most = max(2, counted // SHORTEST)
    wanted = min(max(SHORTEST, -(-runs * counted // SAMPLES)), most)
    return next(
        n for n in range(wanted, 2 * wanted + 1) if all(n % d for d in range(2, n))
    )


@dataclass
class Descent:
    """One start on its way down: ``step`` moves it.

    ``slopes(unit)`` and ``lanes(units)`` are the compiled programs; ``tolerance`` is
    the gain in ``PATIENCE`` steps below which it is ``done``.
    """

    unit: np.ndarray
    loss: float
    verdict: Verdict
    slopes: Callable[[np.ndarray], Slopes]
    lanes: Callable[[np.ndarray], Lanes]
    tolerance: float
    damping: float = FIRST_DAMPING
    done: bool = False
    losses: list[float] = field(default_factory=list)

    def step(self) -> int:
        """Move to the best of ``LANES`` points; return how often it simulated."""
        model = _Model.of(self.slopes(self.unit))
        if model is None:
            self.done = True
            return 1
        dampings = self.damping * DAMPINGS
        steps = np.stack([boxed_step(model, self.unit, d) for d in dampings])
        steps = np.clip(self.unit + steps, 0.0, 1.0) - self.unit
        start = self.unit
        found = self.lanes(start + steps)
        best = self._take(start + steps, found, -1)
        for _ in range(CORRECTIONS):
            squared = zip(
                np.asarray(found.errors), np.asarray(found.added), strict=True
            )
            steps = np.stack(
                [
                    model.corrected(start, step, model.residuals(*seen), damping)
                    for step, seen, damping in zip(
                        steps, squared, dampings, strict=True
                    )
                ]
            )
            found = self.lanes(start + steps)
            best = self._take(start + steps, found, best)
        self.damping = dampings[best] if best >= 0 else 30.0 * self.damping
        self.losses.append(self.loss)
        self.done = self.damping > LAST_DAMPING or self._stalled()
        return RUNS

    def _take(self, points: np.ndarray, found: Lanes, best: int) -> int:
        """Go to the best of ``points`` if it is better; return which led furthest."""
        losses = np.asarray(found.losses)
        leader = int(np.argmin(losses))
        if losses[leader] >= self.loss:
            return best
        self.unit, self.loss = points[leader], float(losses[leader])
        self.verdict = jax.tree.map(lambda x: np.asarray(x)[leader], found.verdicts)
        return leader

    def _stalled(self) -> bool:
        recent = self.losses[-1 - PATIENCE :]
        return len(recent) > PATIENCE and recent[0] - recent[-1] < self.tolerance


class _Model(NamedTuple):
    """The objective near a point, from the weighted errors' derivatives there."""

    gradient: np.ndarray
    curvature: np.ndarray
    jacobian: np.ndarray
    scale: np.ndarray

    @classmethod
    def of(cls, here: Slopes) -> "_Model | None":
        slopes, weights = np.asarray(here.jacobian), np.asarray(here.weights)
        gradient = np.asarray(here.gradient)
        scale = np.sqrt(np.maximum(weights, 0.0) / slopes.shape[2])[:, None]
        parts = (slopes * scale).reshape(slopes.shape[0], -1), _ADDED * here.added
        jacobian = np.concatenate(parts, axis=1)
        usable = np.all(np.isfinite(jacobian)) and np.all(np.isfinite(gradient))
        if not usable or here.loss >= HOPELESS:
            return None
        return cls(gradient, jacobian @ jacobian.T, jacobian, scale)

    def residuals(self, errors: np.ndarray, added: np.ndarray) -> np.ndarray:
        """Return what is squared, half of the squares' sum being the objective."""
        return np.concatenate([(errors * self.scale).ravel(), _ADDED * added])

    def corrected(
        self, unit: np.ndarray, step: np.ndarray, moved: np.ndarray, damping: float
    ) -> np.ndarray:
        """Return ``step`` led back to where the damped squares are least.

        By the residuals ``moved`` at its end and the derivatives at ``unit``.
        """
        free = (unit + step > _EDGE) & (unit + step < 1.0 - _EDGE)
        if not np.all(np.isfinite(moved)) or not free.any():
            return step
        force = -(self.jacobian @ moved + damping * step)[free]
        change = np.zeros_like(step)
        change[free] = _solved(self.curvature[np.ix_(free, free)], force, damping)
        if np.linalg.norm(change) > MOST * np.linalg.norm(step):
            return step
        return np.clip(unit + step + change, 0.0, 1.0) - unit


def boxed_step(model, unit: np.ndarray, damping: float) -> np.ndarray:
    """Return the damped Newton step within [0, 1]^n.

    What would leave the box stops at its side, and the rest is solved for again.
    ``model`` has a ``gradient`` and a ``curvature``.
    """
    gradient, curvature = model.gradient, model.curvature
    low, high = unit <= _EDGE, unit >= 1.0 - _EDGE
    free = ~((low & (gradient > 0.0)) | (high & (gradient < 0.0)))
    step = np.zeros_like(unit)
    for _ in range(unit.size):
        force = -(gradient + curvature @ np.where(free, 0.0, step))[free]
        step[free] = _solved(curvature[np.ix_(free, free)], force, damping)
        outside = free & ((unit + step < 0.0) | (unit + step > 1.0))
        if not outside.any():
            break
        step = np.where(outside, np.clip(unit + step, 0.0, 1.0) - unit, step)
        free &= ~outside
    return step


def _solved(curvature: np.ndarray, force: np.ndarray, damping: float) -> np.ndarray:
    return np.linalg.solve(curvature + damping * np.eye(force.size), force)
