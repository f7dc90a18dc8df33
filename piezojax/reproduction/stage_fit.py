"""Least-squares fit of one stage to cells: residuals, Jacobian, optimiser."""

from collections.abc import Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ..core.arrays import as_array
from ..core.progress import Progress, Silent
from ..core.space import Space, squash, unsquash
from ..solve.gauss_newton import TRUST_REGION, Descent, GaussNewton, trials_with_models
from ..solve.local_model import normal_equations
from ..solve.multi_start import descend
from .lanes import Lanes, mean_squares
from .stage_parameters import sensor_of, stage_of

STEPS = 20
"""Largest number of optimiser steps from each start."""

CORNER = 0.1
"""|ln(sim/print)| at which the cost changes from quadratic to linear."""

TOLERANCE = 1e-4
"""Relative change of cost and point below which the descent from a start ends."""

STEEPEST = 1e4
"""Largest slope of a residual over the unit box; larger ones are set to zero.

The slopes of an unstable loop may exceed it: its voltage has limits, but they bound no
slope. The value also replaces residuals that are not finite.
"""

Point = Float[Array, " n"]
Free = Int[Array, " free"]


class Problem(eqx.Module):
    """Cells and the quantities that can be fitted to them.

    The first ``stage`` quantities are those of the stage; the candidates for suspect
    numbers follow. ``numerator`` is that of the dynamics of the stage. ``paper`` (um)
    and ``counts`` (1 or 0) are in the order of the lanes. ``start`` is the point of the
    printed values in the unit box. ``penalty_weight`` is the weight of the penalty on
    the distance of the stage from ``start``; suspect numbers have no penalty.
    """

    space: Space
    stage: int = eqx.field(static=True)
    numerator: tuple[float, ...] = eqx.field(static=True)
    lanes: list[Lanes]
    paper: Float[Array, " cells"]
    counts: Float[Array, " cells"]
    start: Point
    penalty_weight: Array

    def errors(self, values: Mapping[str, Any]) -> Float[Array, " cells"]:
        """Return the RMS error (um) of every cell for ``values`` of all quantities."""
        stage, sensor = stage_of(values, self.numerator), sensor_of(values)
        squares = [
            mean_squares(stage, sensor, lanes.scaled(values)) for lanes in self.lanes
        ]
        return jnp.sqrt(jnp.concatenate(squares))

    def log_ratios(self, point: Point) -> Float[Array, " cells"]:
        """Return ln(sim/print) of every cell at a point of the unit box."""
        return jnp.log(self.errors(self.space.named(point)) / self.paper)

    def residuals(self, point: Point) -> Array:
        """Return the residuals of the cells and of the penalty.

        The square of a residual approaches |ln(sim/print)| for large errors.
        """
        log = self.log_ratios(point)
        misfit = self.counts * log / (log**2 + CORNER**2) ** 0.25
        misfit = jnp.where(jnp.isfinite(misfit), misfit, STEEPEST)
        penalty = self.penalty_weight * (point - self.start)[: self.stage]
        return jnp.concatenate([misfit, penalty])

    def jacobian(self, point: Point, free: Free) -> tuple[Array, Array]:
        """Return the forward-mode Jacobian [residual, free] and the residuals.

        Slopes beyond ``STEEPEST`` are set to zero.
        """

        def residuals_twice(part):
            residuals = self.residuals(point.at[free].set(part))
            return residuals, residuals

        slope, value = jax.jacfwd(residuals_twice, has_aux=True)(point[free])
        return jnp.where(jnp.abs(slope) < STEEPEST, slope, 0.0), value


@eqx.filter_jit
def _normal_equations(
    problem: Problem, base: Point, free: Free, points: Float[Array, "points free"]
) -> tuple[Array, Array, Array]:
    """Return the normal equations of the quantities ``free`` at each of ``points``.

    ``points`` are in the unbounded coordinates of ``unsquash``. The other quantities
    are as in ``base``.
    """

    def linearise(point):
        part = squash(point)
        slope, value = problem.jacobian(base.at[free].set(part), free)
        return slope * part * (1.0 - part), value

    return normal_equations(linearise, points)


@eqx.filter_jit
def log_ratios(problem: Problem, point: Point) -> Float[Array, " cells"]:
    """Return ln(sim/print) of every cell at a point of the unit box."""
    return problem.log_ratios(point)


@eqx.filter_jit
def costs(problem: Problem, points: Float[Array, "points n"]) -> Array:
    """Return the sum of squared residuals at each of ``points``."""
    return jnp.sum(jax.vmap(problem.residuals)(points) ** 2, axis=1)


def fit(
    problem: Problem,
    free: Sequence[int],
    starts: Sequence[Point],
    steps: int = STEPS,
    progress: Progress | None = None,
) -> tuple[Point, float]:
    """Return the point with the least cost, from all starts, and this cost.

    Only the quantities ``free`` are varied; the others are those of the first start. A
    trial step into instability has a larger cost and is rejected; then the damping
    grows.
    """
    progress = Silent() if progress is None else progress
    base, places = starts[0], jnp.asarray(free)
    # One start at a time: a batch of all cells already keeps the processor busy.
    evaluate = trials_with_models(
        lambda points: _normal_equations(problem, base, places, points), width=1
    )
    descents = [
        Descent(np.asarray(unsquash(start[places])), TRUST_REGION, tolerance=TOLERANCE)
        for start in starts
    ]
    standing, _ = descend(
        GaussNewton(descents, evaluate),
        steps,
        lambda standing: progress.advance(2.0 * float(standing.losses.min())),
    )
    best = int(np.argmin(standing.losses))
    part = squash(as_array(standing.units[best]))
    return base.at[places].set(part), 2.0 * float(standing.losses[best])
