"""Fitting a System to one period of its steady response to a periodic input."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float

from ...core.rollout import simulate
from ...core.space import INSIDE, Space, squash, unsquash
from ...core.system import System
from ..records.record import Record
from .structure import Structure

DIVERGED = 1e6
"""What counts as the error of a sample where the simulation is not finite."""


@eqx.filter_jit
def steady_response(
    system: System, input: Float[Array, " n *m"], settle: int
) -> Float[Array, " n *p"]:
    """Return what ``system`` puts out in one period of ``input``, repeated for long.

    The last ``settle`` samples of a period come first, from rest under 0, to let the
    transient pass. As in the loop, input k moves the output that is sample k + 1.
    """
    # What is settled does not depend on the start: no derivative, no solver's failure.
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

    Levenberg-Marquardt with the forward Jacobian on the simulated output, each channel
    as a share of its deviation, from all ``starts`` at once. ``settle`` samples, a
    whole period if left out, come before the period. Returns the best parameters and
    the root mean square error that each start led to, as a share; a start that diverges
    spoils no other. Raises ValueError if the record is not exactly one period, if
    ``settle`` is longer, or when no start leads to a finite simulation.
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
    # One channel as a plain signal: the Systems for one input and output take scalars.
    input, output = (
        jnp.asarray(columns[:, 0] if columns.shape[1] == 1 else columns)
        for columns in (record.inputs, record.outputs)
    )
    found, errors = _levenberg_marquardt(put, starts, input, output, settle, steps)
    errors = np.where(np.isfinite(errors), errors, np.inf)
    best = int(np.argmin(errors))
    if errors[best] >= DIVERGED:
        raise ValueError(f"{record.source}: no start led to a finite simulation")
    return found[best], errors


def fit_structure(
    structure: Structure,
    record: Record,
    *,
    settle: int | None = None,
    steps: int = 200,
) -> tuple[System, np.ndarray]:
    """Fit ``structure``, from its own starts and inside its box; else as above.

    Returns the fitted system and the error that each start led to, as a share.
    """
    starts = jnp.clip(jnp.asarray(structure.starts), INSIDE, 1.0 - INSIDE)
    # A Partial, not a closure: another record of that length is no new compilation.
    put = eqx.Partial(_inside, structure.space, structure.system)
    best, errors = fit_steady_state(
        put, unsquash(starts), record, settle=settle, steps=steps
    )
    return put(best), errors


def _inside(space: Space, system: System, free: Float[Array, " n"]) -> System:
    return space.put(system, squash(free))


@eqx.filter_jit
def _levenberg_marquardt(
    put: Callable[[Array], System],
    starts: Array,
    input: Array,
    output: Array,
    settle: int,
    steps: int,
) -> tuple[Array, Array]:
    scale = jnp.std(output, axis=0)

    def residuals(parameters, _):
        error = (steady_response(put(parameters), input, settle) - output) / scale
        return jnp.where(jnp.isfinite(error), error, DIVERGED).ravel()

    # The normal equations: the QR of so tall a Jacobian takes ten times as long as the
    # Jacobian. A step that does 3/4 of what its linear model promised may grow; the
    # solver's own threshold, 0.99, keeps the steps through a curved valley short.
    solver = eqx.tree_at(
        lambda solver: solver.search,
        optx.LevenbergMarquardt(
            rtol=1e-9, atol=1e-9, linear_solver=lx.Normal(lx.Cholesky())
        ),
        optx.ClassicalTrustRegion(high_cutoff=0.75),
    )

    def one(start):
        # Steps are measured by what each parameter does to the output at the start
        # (Marquardt's scaling): in raw parameters most starts stall half way.
        reach = jnp.linalg.norm(jax.jacfwd(residuals)(start, None), axis=0)
        unit = jnp.where(reach > 0.0, jnp.sqrt(output.size) / reach, 1.0)
        moved = optx.least_squares(
            lambda by, _: residuals(start + unit * by, None),
            solver,
            jnp.zeros_like(start),
            options={"jac": "fwd"},
            max_steps=steps,
            throw=False,
        ).value
        found = start + unit * moved
        return found, jnp.sqrt(jnp.mean(residuals(found, None) ** 2))

    return jax.vmap(one)(starts)
