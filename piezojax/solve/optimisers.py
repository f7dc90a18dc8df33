"""Optimisers of optimistix and jaxopt behind one interface: start, step, view.

Each moves one point; ``jax.vmap`` runs many starts at once. Python calls every step, so
that progress can be shown, the history recorded and a run interrupted without losing
its best point.
"""

import warnings
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import optimistix as optx
from jaxtyping import Array, Bool, Float

from ..core.arrays import as_array
from ..core.space import squash, unsquash
from .problem import Unit

Function = Callable[[Unit], Array]


class View(NamedTuple):
    """Present point in [0, 1]^n, its loss, and whether the optimiser is done."""

    unit: Unit
    loss: Float[Array, ""]
    done: Bool[Array, ""]


class Optimiser(NamedTuple):
    """``start(unit) -> carry``, ``step(carry) -> carry``, ``view(carry) -> View``."""

    start: Callable[[Unit], Any]
    step: Callable[[Any], Any]
    view: Callable[[Any], View]


class Carry(NamedTuple):
    """Optimiser between two steps: point, internal state, loss, and whether it is
    done."""

    point: Array
    state: Any
    loss: Array
    done: Array


def strongly_typed(carry: Carry) -> Carry:
    """Return ``carry`` with strongly typed leaves."""
    # Weakly typed leaves would cause a second compilation of the step.
    return jax.tree.map(lambda leaf: jnp.asarray(leaf, leaf.dtype), carry)


def frozen_when_done(old: Carry, new: Carry) -> Carry:
    """Return ``new``, or ``old`` if that descent was already done."""
    kept = jax.tree.map(lambda o, n: jnp.where(old.done, o, n), old, new)
    return strongly_typed(kept)


def _optimistix(
    solver: Any, function: Function, loss_of: Callable[[Array], Array], options: dict
) -> Optimiser:
    """Wrap an optimistix solver.

    The solver has no bounds; ``squash`` maps its unbounded unknowns to the unit box.
    """

    def objective(free, _):
        value = function(squash(free))
        return value, loss_of(value)

    def initial(free):
        value, loss = eqx.filter_eval_shape(objective, free, None)
        return solver.init(objective, free, None, options, value, loss, frozenset())

    def fixed(free):
        # The state of a solver also holds functions and shapes, which a carry cannot
        # hold. They follow from the shape of the point, so each step recovers them by
        # tracing.
        shapes = eqx.filter_eval_shape(initial, free)
        return eqx.filter(shapes, _is_shape, inverse=True)

    def start(unit):
        free = unsquash(unit)
        arrays = eqx.filter(initial(free), eqx.is_array)
        return strongly_typed(
            Carry(free, arrays, as_array(jnp.inf), jnp.asarray(False))
        )

    def step(carry):
        state = eqx.combine(carry.state, fixed(carry.point))
        # The step returns the loss of the previous point; the state has the loss of the
        # present one.
        point, state, _ = solver.step(
            objective, carry.point, None, options, state, frozenset()
        )
        done, _ = solver.terminate(objective, point, None, options, state, frozenset())
        arrays = eqx.filter(state, eqx.is_array)
        return frozen_when_done(
            carry, Carry(point, arrays, state.aux, carry.done | done)
        )

    def view(carry):
        return View(squash(carry.point), carry.loss, carry.done)

    return Optimiser(start, step, view)


def _is_shape(leaf: Any) -> bool:
    return isinstance(leaf, jax.ShapeDtypeStruct)


def bfgs(loss: Function, residuals: Function, tolerance: float) -> Optimiser:
    """Return BFGS (optimistix) on the loss."""
    del residuals
    solver = optx.BFGS(rtol=tolerance, atol=tolerance)
    return _optimistix(solver, loss, lambda value: value, {})


def levenberg_marquardt(
    loss: Function, residuals: Function, tolerance: float
) -> Optimiser:
    """Return Levenberg-Marquardt (optimistix) on the residuals.

    The Jacobian comes from forward mode.
    """
    del loss
    # There are far more residuals than unknowns, so the normal equations are small. A
    # QR of the tall Jacobian would take most of the time of a step, and many times more
    # on a busy machine.
    solver = optx.LevenbergMarquardt(
        rtol=tolerance, atol=tolerance, linear_solver=lx.Normal(lx.Cholesky())
    )
    return _optimistix(
        solver, residuals, lambda value: jnp.sum(value**2), {"jac": "fwd"}
    )


def lbfgsb(loss: Function, residuals: Function, tolerance: float) -> Optimiser:
    """Return L-BFGS-B (jaxopt) on the loss, with the bounds of the box."""
    del residuals
    with warnings.catch_warnings():
        # jaxopt announces on import that it is no longer maintained.
        warnings.simplefilter("ignore", DeprecationWarning)
        import jaxopt

    solver = jaxopt.LBFGSB(
        loss, tol=tolerance, maxls=12, linesearch="backtracking", implicit_diff=False
    )

    def bounds(unit):
        return tuple(jnp.full_like(unit, side) for side in (0.0, 1.0))

    def start(unit):
        state: Any = solver.init_state(unit, bounds(unit))
        return strongly_typed(Carry(unit, state, state.value, jnp.asarray(False)))

    def step(carry):
        point, state = solver.update(carry.point, carry.state, bounds(carry.point))
        done = carry.done | (state.error <= tolerance)
        return frozen_when_done(carry, Carry(point, state, state.value, done))

    def view(carry):
        return View(carry.point, carry.loss, carry.done)

    return Optimiser(start, step, view)


METHODS: dict[str, Callable[[Function, Function, float], Optimiser]] = {
    "bfgs": bfgs,
    "levenberg_marquardt": levenberg_marquardt,
    "lbfgsb": lbfgsb,
}
"""Optimisers by the name a study uses."""

GAUSS_NEWTON = "gauss_newton"
"""Name that a study uses for SuccessiveHalving, Gauss-Newton descents on the errors."""
