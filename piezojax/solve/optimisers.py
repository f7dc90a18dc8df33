"""Optimisers behind one interface: start, step, look; one point at a time.

Each is run for many starts at once by ``jax.vmap`` and stepped from Python, so that
progress can be shown, the history kept and a run stopped with its best point in hand.
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

Unit = Float[Array, " n"]
Function = Callable[[Unit], Array]


class View(NamedTuple):
    """Where an optimiser stands: a point in [0, 1]^n, its loss, whether it is done."""

    unit: Unit
    loss: Float[Array, ""]
    done: Bool[Array, ""]


class Optimiser(NamedTuple):
    """``start(unit) -> carry``, ``step(carry) -> carry``, ``view(carry) -> View``."""

    start: Callable[[Unit], Any]
    step: Callable[[Any], Any]
    view: Callable[[Any], View]


class _Carry(NamedTuple):
    point: Array
    state: Any
    loss: Array
    done: Array


def _settled(carry: _Carry) -> _Carry:
    # Weakly typed leaves would make the second step compile anew.
    return jax.tree.map(lambda leaf: jnp.asarray(leaf, leaf.dtype), carry)


def _advanced(old: _Carry, new: _Carry) -> _Carry:
    """Return ``new``, or ``old`` where that start had already finished."""
    kept = jax.tree.map(lambda o, n: jnp.where(old.done, o, n), old, new)
    return _settled(kept)


def _optimistix(
    solver: Any, function: Function, loss_of: Callable[[Array], Array], options: dict
) -> Optimiser:
    """Wrap an optimistix solver; it knows no bounds, so it works on the whole line."""

    def objective(free, _):
        value = function(squash(free))
        return value, loss_of(value)

    def initial(free):
        value, loss = eqx.filter_eval_shape(objective, free, None)
        return solver.init(objective, free, None, options, value, loss, frozenset())

    def fixed(free):
        # A solver's state also holds functions and shapes, which no carry can take:
        # they follow from the point's shape, so each step finds them again by tracing.
        shapes = eqx.filter_eval_shape(initial, free)
        return eqx.filter(shapes, _is_shape, inverse=True)

    def start(unit):
        free = unsquash(unit)
        arrays = eqx.filter(initial(free), eqx.is_array)
        return _settled(_Carry(free, arrays, as_array(jnp.inf), jnp.asarray(False)))

    def step(carry):
        state = eqx.combine(carry.state, fixed(carry.point))
        # The step returns the loss of the point before; the state has this one's.
        point, state, _ = solver.step(
            objective, carry.point, None, options, state, frozenset()
        )
        done, _ = solver.terminate(objective, point, None, options, state, frozenset())
        arrays = eqx.filter(state, eqx.is_array)
        return _advanced(carry, _Carry(point, arrays, state.aux, carry.done | done))

    def view(carry):
        return View(squash(carry.point), carry.loss, carry.done)

    return Optimiser(start, step, view)


def _is_shape(leaf: Any) -> bool:
    return isinstance(leaf, jax.ShapeDtypeStruct)


def bfgs(loss: Function, residuals: Function, tolerance: float) -> Optimiser:
    """BFGS (optimistix) on the loss."""
    del residuals
    solver = optx.BFGS(rtol=tolerance, atol=tolerance)
    return _optimistix(solver, loss, lambda value: value, {})


def levenberg_marquardt(
    loss: Function, residuals: Function, tolerance: float
) -> Optimiser:
    """Levenberg-Marquardt (optimistix) on the residuals, forward Jacobian."""
    del loss
    # Far more residuals than unknowns: their normal equations are small, where a QR of
    # the tall Jacobian takes most of a step, and many times more on a busy machine.
    solver = optx.LevenbergMarquardt(
        rtol=tolerance, atol=tolerance, linear_solver=lx.Normal(lx.Cholesky())
    )
    return _optimistix(
        solver, residuals, lambda value: jnp.sum(value**2), {"jac": "fwd"}
    )


class _Quadratic(NamedTuple):
    """The point to try next, and the quadratic model at the present one."""

    trial: Array
    hessian: Array
    gradient: Array
    size: Array  # 1 / damping
    predicted: Array  # change of half the sum of squares at `trial`


def damped_gauss_newton(residuals: Function, tolerance: float) -> Optimiser:
    """Levenberg-Marquardt, the steps of optimistix, compiled in a third of the time.

    One evaluation of residuals and forward Jacobian a step, of which J'J and J'r are
    kept: for long residuals of few unknowns. The damping follows the trust-region rule
    of optimistix with its constants (Gould et al. 2005, 4OR 3).
    """

    def objective(free):
        value = residuals(squash(free))
        return value, value

    def start(unit):
        free = unsquash(unit)
        blank = jnp.zeros((free.size, free.size))
        one, none = jnp.ones(()), jnp.zeros(())
        first = _Quadratic(free, blank, jnp.zeros_like(free), one, none)
        return _settled(_Carry(free, first, as_array(jnp.inf), jnp.asarray(False)))

    def step(carry):
        old, point = carry.state, carry.point
        jacobian, value = jax.jacfwd(objective, has_aux=True)(old.trial)
        loss = jnp.sum(value**2)
        first = jnp.isinf(carry.loss)
        change = 0.5 * (loss - carry.loss)
        accept = first | (change <= 0.01 * old.predicted)
        good = accept & ~first & (change < 0.99 * old.predicted) & (old.predicted < 0.0)
        size = old.size * jnp.where(good, 3.5, jnp.where(accept, 1.0, 0.25))
        hessian = jnp.where(accept, jacobian.T @ jacobian, old.hessian)
        gradient = jnp.where(accept, jacobian.T @ value, old.gradient)
        reached = jnp.where(accept, old.trial, point)
        near = jnp.abs(old.trial - point) < tolerance * (1.0 + jnp.abs(point))
        level = jnp.abs(change) < tolerance * (1.0 + 0.5 * carry.loss)
        done = accept & ~first & jnp.all(near) & level
        # A direction without any slope must not make the matrix singular.
        floor = 1e-14 * jnp.max(jnp.diagonal(hessian))
        damping = jnp.maximum(jnp.maximum(1.0 / size, floor), 1e-300)
        factor = jax.scipy.linalg.cho_factor(hessian + damping * jnp.eye(point.size))
        move = -jax.scipy.linalg.cho_solve(factor, gradient)
        move = jnp.where(jnp.all(jnp.isfinite(move)), move, 0.0)
        predicted = gradient @ move + 0.5 * move @ hessian @ move
        state = _Quadratic(reached + move, hessian, gradient, size, predicted)
        kept = jnp.where(accept, loss, carry.loss)
        return _advanced(carry, _Carry(reached, state, kept, carry.done | done))

    def view(carry):
        return View(squash(carry.point), carry.loss, carry.done)

    return Optimiser(start, step, view)


def lbfgsb(loss: Function, residuals: Function, tolerance: float) -> Optimiser:
    """L-BFGS-B (jaxopt) on the loss, which takes the bounds as they are."""
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
        return _settled(_Carry(unit, state, state.value, jnp.asarray(False)))

    def step(carry):
        point, state = solver.update(carry.point, carry.state, bounds(carry.point))
        done = carry.done | (state.error <= tolerance)
        return _advanced(carry, _Carry(point, state, state.value, done))

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
"""The search of ``tune.gauss_newton``: on the errors of a loop, so only for tuning."""
