"""Cells to be explained by one stage: residuals, their Jacobian, and the fit."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ..core.arrays import as_array
from ..core.progress import Progress, Silent
from ..core.space import Space
from ..solve.gauss_newton import damped_gauss_newton
from ..solve.multi_start import InStep, descend
from ..solve.optimisers import Optimiser, View
from ..solve.problem import Verdict
from .lanes import Lanes, mean_squares
from .stage_parameters import sensor_of, stage_of

STEPS = 20
"""Most steps of the optimiser from each start."""

CORNER = 0.1
"""|ln(sim/print)| at which the cost turns from square into linear."""

TOLERANCE = 1e-4
"""Relative change of cost and point at which a start is done."""

STEEPEST = 1e4
"""Slope of a residual over its box that is not believed: the loop is unstable, and its
slope, unlike its voltage, has no limits. A residual without a number is as large."""

Point = Float[Array, " n"]
Free = Int[Array, " free"]


class Problem(eqx.Module):
    """Cells and what may be fitted: the stage's quantities first, then the doubts.

    ``paper`` in um and ``counts`` (1 or 0) follow the lanes one after the other;
    ``strength`` is the pull of the first ``stage`` quantities towards ``start``, the
    point of print in the unit box; what is in doubt is not pulled.
    """

    space: Space
    stage: int = eqx.field(static=True)
    numerator: tuple[float, ...] = eqx.field(static=True)
    lanes: list[Lanes]
    paper: Float[Array, " cells"]
    counts: Float[Array, " cells"]
    start: Point
    strength: Array

    def errors(self, values: Mapping[str, Any]) -> Float[Array, " cells"]:
        """Return the RMS error (um) of every cell for ``values`` of all quantities."""
        stage, sensor = stage_of(values, self.numerator), sensor_of(values)
        squares = [
            mean_squares(stage, sensor, lanes.with_doubts(values))
            for lanes in self.lanes
        ]
        return jnp.sqrt(jnp.concatenate(squares))

    def log_ratios(self, point: Point) -> Float[Array, " cells"]:
        """Return ln(sim/print) of every cell at a point of the unit box."""
        return jnp.log(self.errors(self.space.named(point)) / self.paper)

    def residuals(self, point: Point) -> Array:
        """Return what is squared and summed: nearly |ln(sim/print)|, and the pull."""
        log = self.log_ratios(point)
        misfit = self.counts * log / (log**2 + CORNER**2) ** 0.25
        misfit = jnp.where(jnp.isfinite(misfit), misfit, STEEPEST)
        pull = self.strength * (point - self.start)[: self.stage]
        return jnp.concatenate([misfit, pull])

    def jacobian(self, point: Point, free: Free) -> tuple[Array, Array]:
        """Return the residuals' forward-mode Jacobian [residual, free], and them.

        Slopes beyond ``STEEPEST`` are zero there.
        """

        def twice(part):
            found = self.residuals(point.at[free].set(part))
            return found, found

        slope, value = jax.jacfwd(twice, has_aux=True)(point[free])
        return jnp.where(jnp.abs(slope) < STEEPEST, slope, 0.0), value

    def optimiser(self, point: Point, free: Free) -> Optimiser:
        """Return damped Gauss-Newton on the quantities ``free``, the others held."""
        return damped_gauss_newton(
            lambda part: self.jacobian(point.at[free].set(part), free), TOLERANCE
        )


class _Carry(NamedTuple):
    start: Point
    state: Any


@eqx.filter_jit
def _begin(problem: Problem, starts: Float[Array, "starts n"], free: Free) -> _Carry:
    def one(start):
        return _Carry(start, problem.optimiser(start, free).start(start[free]))

    return jax.vmap(one)(starts)


@eqx.filter_jit
def _advance(
    problem: Problem, free: Free, carry: _Carry
) -> tuple[_Carry, View, Verdict]:
    def one(carry):
        optimiser = problem.optimiser(carry.start, free)
        carry = carry._replace(state=optimiser.step(carry.state))
        part, loss, done = optimiser.view(carry.state)
        view = View(carry.start.at[free].set(part), loss, done)
        return carry, view, Verdict(loss, jnp.zeros_like(loss))

    return jax.vmap(one)(carry)


@eqx.filter_jit
def log_ratios(problem: Problem, point: Point) -> Float[Array, " cells"]:
    """Return ln(sim/print) of every cell at a point of the unit box."""
    return problem.log_ratios(point)


@eqx.filter_jit
def costs(problem: Problem, points: Float[Array, "points n"]) -> Array:
    """Return the sum of squares at each of ``points``."""
    return jnp.sum(jax.vmap(problem.residuals)(points) ** 2, axis=1)


def fit(
    problem: Problem,
    free: Sequence[int],
    starts: Sequence[Point],
    steps: int = STEPS,
    progress: Progress | None = None,
) -> tuple[Point, float]:
    """Return the point where the cost is least, of all starts, and that cost.

    Only the quantities ``free`` move. A trial step into instability costs more and is
    not taken: the damping grows.
    """
    progress = Silent() if progress is None else progress
    places = jnp.asarray(free)
    # One start a program: a batch of all cells keeps the processor busy by itself.
    descents = InStep(
        lambda starts: _begin(problem, starts, places),
        lambda carry: _advance(problem, places, carry),
        np.stack([np.asarray(start) for start in starts]),
        width=1,
    )
    standing, _ = descend(
        descents, steps, lambda standing: progress.advance(float(standing.losses.min()))
    )
    best = int(np.argmin(standing.losses))
    return as_array(standing.units[best]), float(standing.losses[best])
