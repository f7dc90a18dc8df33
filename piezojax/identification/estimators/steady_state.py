"""Fit of a System to one period of its steady response to a periodic input."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ...core.arrays import as_array
from ...core.rollout import simulate
from ...core.space import INSIDE, Space, squash, unsquash
from ...core.system import System
from ...solve.gauss_newton import (
    TRUST_REGION,
    Descent,
    GaussNewton,
    trials_with_models,
)
from ...solve.local_model import normal_equations
from ...solve.multi_start import descend
from ...solve.problem import linearised
from ..records.record import Record
from .structure import Structure

DIVERGED = 1e6
"""Error that replaces that of a sample without a finite simulation."""

TOLERANCE = 1e-9
"""Relative change of loss and parameters below which a descent ends."""


@eqx.filter_jit
def steady_response(
    system: System, input: Float[Array, " n *m"], settle: int
) -> Float[Array, " n *p"]:
    """Return the steady output of ``system`` over one period of ``input``.

    The simulation starts at rest under 0. It runs over the last ``settle`` samples of
    the period first, so that the transient decays. As in the loop, input k moves output
    k + 1.
    """
    # The settled state does not depend on the start, so it needs no derivative.
    state = jax.lax.stop_gradient(system).init(jnp.zeros_like(input[0]))
    if settle:
        state, _ = simulate(system, input[-settle:], state)
    _, outputs = simulate(system, input, state)
    return jnp.roll(outputs, 1, axis=0)


def fit_steady_state(
    put: Callable[[Float[Array, " n"]], System],
    starts: Float[Array, "starts n"],
    record: Record,
    *,
    settle: int | None = None,
    steps: int = 200,
) -> tuple[Float[Array, " n"], np.ndarray]:
    """Fit the parameters of ``put(parameters)`` to ``record``, one steady period.

    Levenberg-Marquardt with the forward Jacobian runs from all ``starts`` at once on
    the output error of each channel, divided by the channel's standard deviation. The
    period follows ``settle`` samples, a whole period by default. Returns the best
    parameters and the relative root mean square error reached from each start. A start
    that diverges does not affect the others. Raises ValueError if the record is not
    exactly one period, if ``settle`` is longer than it, or if no start leads to a
    finite simulation.
    """
    if record.period != record.samples:
        raise ValueError(
            f"{record.source}: {record.samples} samples with period {record.period}; "
            "a steady fit needs exactly one period"
        )
    settle = record.samples if settle is None else settle
    if not 0 <= settle <= record.samples:
        raise ValueError(
            f"settle is {settle}; it must lie in 0..{record.samples}, within the period"
        )
    # Systems with one input and output take scalars, so a single channel is flat.
    input, output = (
        jnp.asarray(columns[:, 0] if columns.shape[1] == 1 else columns)
        for columns in (record.inputs, record.outputs)
    )
    problem = _Problem(put, input, output, settle)

    def metric(curvature: np.ndarray) -> np.ndarray:
        # Marquardt's scaling; without it most starts stall half way.
        size = np.diag(curvature)
        return np.where(size > 0.0, size / output.size, 1.0)

    descents = GaussNewton(
        [
            Descent(start, TRUST_REGION, tolerance=TOLERANCE)
            for start in np.asarray(starts)
        ],
        trials_with_models(
            lambda points: _normal_equations(problem, points), len(starts), metric
        ),
    )
    standing, _ = descend(descents, steps, lambda standing: None)
    errors = np.sqrt(2.0 * standing.losses / output.size)
    errors = np.where(np.isfinite(errors), errors, np.inf)
    best = int(np.argmin(errors))
    if errors[best] >= DIVERGED:
        raise ValueError(f"{record.source}: no start led to a finite simulation")
    return as_array(standing.units[best]), errors


def fit_structure(
    structure: Structure,
    record: Record,
    *,
    settle: int | None = None,
    steps: int = 200,
) -> tuple[System, np.ndarray]:
    """Fit ``structure`` from its starts, inside its box, as ``fit_steady_state`` does.

    Returns the fitted system and the relative error reached from each start.
    """
    starts = jnp.clip(jnp.asarray(structure.starts), INSIDE, 1.0 - INSIDE)
    # A closure would compile again for every record; a Partial does not.
    put = eqx.Partial(_inside, structure.space, structure.system)
    best, errors = fit_steady_state(
        put, unsquash(starts), record, settle=settle, steps=steps
    )
    return put(best), errors


def _inside(space: Space, system: System, free: Float[Array, " n"]) -> System:
    return space.put(system, squash(free))


class _Problem(eqx.Module):
    """Fit of the parameters of ``put`` to one steady period of a record."""

    put: Callable[[Array], System]
    input: Array
    output: Array
    settle: int = eqx.field(static=True)

    def residuals(self, parameters: Array) -> Array:
        """Return the errors, each channel divided by its standard deviation."""
        found = steady_response(self.put(parameters), self.input, self.settle)
        error = (found - self.output) / jnp.std(self.output, axis=0)
        return jnp.where(jnp.isfinite(error), error, DIVERGED).ravel()


@eqx.filter_jit
def _normal_equations(
    problem: _Problem, points: Float[Array, "points n"]
) -> tuple[Array, Array, Array]:
    return normal_equations(linearised(lambda p: problem.residuals(p)), points)
