"""Quadratic model of a sum of squares, and its damped Gauss-Newton step."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

EDGE = 1e-9
"""Distance, as a share of the unit box, within which a point lies on a bound."""

LARGEST_CORRECTION = 0.5
"""Largest accepted correction as a share of its step."""

FLOOR = 1e-14
"""Least damping as a share of the largest curvature; it keeps the normal equations
regular where a direction has no slope."""

MEETINGS = 10
"""Most steps tried to find the constraints that a step meets."""

Box = tuple[float, float]
"""Lower and upper bound of every unknown."""

UNIT_BOX, UNBOUNDED = (0.0, 1.0), (-np.inf, np.inf)


class Slack(NamedTuple):
    """Terms of constraints that hold at the point of a model: ``values`` below 0.

    ``jacobian`` [n, terms] are their derivatives, ``places`` their indices among the
    residuals of the model. Where a linearised term is above 0, half its square is part
    of the loss.
    """

    values: np.ndarray
    jacobian: np.ndarray
    places: np.ndarray

    def after(self, step: np.ndarray) -> np.ndarray:
        """Return the linearised terms after ``step``."""
        return self.values + step @ self.jacobian


class LocalModel(NamedTuple):
    """Quadratic model of a loss at a ``point``, with the parts for corrections.

    ``gradient`` [n] and ``curvature`` [n, n] are those of the loss: J'r and J'J for
    half a sum of squares. ``metric`` [n] weights the damping of each unknown; 1 damps
    all equally. Corrections need ``jacobian`` [n, residuals], the derivatives of the
    weighted residuals, and their ``weights`` [residuals]. ``slack`` are constraints
    that a step may meet.
    """

    point: np.ndarray
    gradient: np.ndarray
    curvature: np.ndarray
    metric: Any = 1.0
    jacobian: Any = None
    weights: Any = None
    slack: Slack | None = None

    @property
    def finite(self) -> bool:
        """Whether gradient and curvature are finite."""
        return bool(
            np.isfinite(self.gradient).all() & np.isfinite(self.curvature).all()
        )

    def predicted(self, step: np.ndarray) -> float:
        """Return the change of the loss that the model predicts for ``step``."""
        change = float(self.gradient @ step + 0.5 * step @ self.curvature @ step)
        if self.slack is None:
            return change
        return change + 0.5 * float(
            np.sum(np.maximum(self.slack.after(step), 0.0) ** 2)
        )

    def _meeting(self, met: np.ndarray) -> "LocalModel":
        """Return the model with those of its ``slack`` that are ``met``."""
        assert self.slack is not None
        jacobian = self.slack.jacobian[:, met]
        return self._replace(
            gradient=self.gradient + jacobian @ self.slack.values[met],
            curvature=self.curvature + jacobian @ jacobian.T,
            slack=None,
        )

    def step(self, damping: float, box: Box) -> np.ndarray:
        """Return the damped step within the box.

        It heeds the constraints with ``slack`` that it meets.
        """
        step = self._within(damping, box)
        if self.slack is None:
            return step
        met = np.zeros(self.slack.values.shape, bool)
        for _ in range(MEETINGS):
            before, met = met, self.slack.after(step) > 0.0
            if np.array_equal(before, met):
                break
            step = self._meeting(met)._within(damping, box)
        return step

    def _within(self, damping: float, box: Box) -> np.ndarray:
        """Return the damped step of the quadratic model within the box.

        An unknown that would leave the box stops at its bound, and the others are
        solved for again.
        """
        point, (lower, upper) = self.point, box
        low, high = point <= lower + EDGE, point >= upper - EDGE
        free = ~((low & (self.gradient > 0.0)) | (high & (self.gradient < 0.0)))
        step = np.zeros_like(point)
        for _ in range(point.size):
            force = -(self.gradient + self.curvature @ np.where(free, 0.0, step))
            step[free] = self._solution(force, damping, free)
            outside = free & ((point + step < lower) | (point + step > upper))
            if not outside.any():
                break
            step = np.where(outside, np.clip(point + step, lower, upper) - point, step)
            free &= ~outside
        return step

    def corrected(
        self, step: np.ndarray, residuals: np.ndarray, damping: float, box: Box
    ) -> np.ndarray:
        """Return ``step`` corrected towards the minimum of the damped sum of squares.

        The correction uses the ``residuals`` at the end of the step and the derivatives
        at its start, and stays within the box.
        """
        (lower, upper), end = box, self.point + step
        free = (end > lower + EDGE) & (end < upper - EDGE)
        if not np.all(np.isfinite(residuals)) or not free.any():
            return step
        force = -(self.jacobian @ (residuals * self.weights) + damping * step)
        slack = self.slack
        model = self._meeting(residuals[slack.places] > 0.0) if slack else self
        change = np.zeros_like(step)
        change[free] = model._solution(force, damping, free)
        if np.linalg.norm(change) > LARGEST_CORRECTION * np.linalg.norm(step):
            return step
        return np.clip(end + change, lower, upper) - self.point

    def _solution(
        self, force: np.ndarray, damping: float, free: np.ndarray
    ) -> np.ndarray:
        """Return the solution of the damped normal equations for the unknowns ``free``.

        The unknowns are scaled by the root of the metric, so that the damping is a
        multiple of the unit matrix.
        """
        scale = np.sqrt(np.broadcast_to(self.metric, force.shape))[free]
        curvature = self.curvature[np.ix_(free, free)] / np.outer(scale, scale)
        damping = max(damping, FLOOR * np.max(np.diag(curvature), initial=0.0))
        damped = curvature + damping * np.eye(scale.size)
        return np.linalg.solve(damped, force[free] / scale) / scale


def normal_equations(
    linearise: Callable[[Array], tuple[Array, Array]], points: Float[Array, "points n"]
) -> tuple[Array, Array, Array]:
    """Return loss, gradient and curvature of half a sum of squares at every point.

    ``linearise(point)`` returns Jacobian [residuals, n] and residuals. Only J'J and J'r
    are kept, which suits many residuals and few unknowns.
    """

    def at(point):
        jacobian, residuals = linearise(point)
        loss = 0.5 * jnp.sum(residuals**2)
        return loss, jacobian.T @ residuals, jacobian.T @ jacobian

    return jax.vmap(at)(points)
